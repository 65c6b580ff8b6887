"""Arrays that kernels take together, as one argument.

A field is found by its name, as an argument is (``warp_yarn/device/declared.py``), at every launch anew: Warp keeps
what an array and its gradient were when it was put into a struct. What a scene does not have is an array of no length.
"""

import functools
from types import SimpleNamespace

import warp as wp

from .variant import Variant

ONCE = -2
"""``evaluations`` where there is one matrix a step, an even number as that of a first evaluation."""


@functools.cache
def structs(variant: Variant) -> SimpleNamespace:
    """Make the structs of a variant."""
    scalar, vec3, mat33, sym33 = variant.scalar, variant.vec3, variant.mat33, variant.sym33
    quat, vec4 = variant.quat, variant.vec4

    @wp.struct
    class BlockMatrix:
        """The matrix (``linear/block_matrix.py`` tells its layout), what M, D and H are multiplied by in it, and how
        many evaluations there were in the stage: where Newton's iteration goes to and fro, terms fill it otherwise.
        And what compressed yarns take from it, where that is asked for (``linear/beside.py``)."""

        stencil: int
        neighbour: wp.array(dtype=int)
        coefficients: wp.array(dtype=vec3)
        evaluations: wp.array(dtype=int)
        compressed: wp.array(dtype=int)
        indefinite: wp.array(dtype=int)
        compression: wp.array(dtype=vec4)
        before: wp.array(dtype=int)
        diagonal_xx: wp.array(dtype=mat33)
        diagonal_xs: wp.array(dtype=vec3)
        diagonal_ss: wp.array(dtype=scalar)
        upper_xx: wp.array(dtype=mat33)
        upper_xs: wp.array(dtype=vec3)
        upper_sx: wp.array(dtype=vec3)
        upper_ss: wp.array(dtype=scalar)

    @wp.struct
    class Crimp:
        """What crimp interchange runs over (``description/crimp.py``): of each node its four segments, what is at
        their ends and the matrix blocks between those of two yarns, its two yarns; of each yarn 1/cos θ₀."""

        crimp_sides: wp.array(dtype=wp.vec4i)
        crimp_around: wp.array(dtype=wp.vec4i)
        crimp_corners: wp.array(dtype=wp.vec4i)
        node_yarns: wp.array(dtype=int)
        lengthening: wp.array(dtype=scalar)

    @wp.struct
    class SolverWork:
        """Vectors that a conjugate gradient works with, and a place for the sums of its threads."""

        r_x: wp.array(dtype=vec3)
        r_s: wp.array(dtype=scalar)
        p_x: wp.array(dtype=vec3)
        p_s: wp.array(dtype=scalar)
        q_x: wp.array(dtype=vec3)
        q_s: wp.array(dtype=scalar)
        t_x: wp.array(dtype=vec3)
        t_s: wp.array(dtype=scalar)
        sums: wp.array(dtype=scalar)

    @wp.struct
    class SolveReport:
        """How a linear solve ended."""

        iterations: wp.array(dtype=int)
        residual: wp.array(dtype=scalar)
        status: wp.array(dtype=int)

    @wp.struct
    class NewtonControl:
        """What Newton's iteration remembers from one evaluation to the next, and what it decided."""

        shortest: wp.array(dtype=scalar)
        newton_tolerance: wp.array(dtype=scalar)
        last_norm: wp.array(dtype=scalar)
        contraction: wp.array(dtype=scalar)
        kinetic: wp.array(dtype=scalar)
        kinetic_left: wp.array(dtype=scalar)
        change: wp.array(dtype=scalar)
        first_change: wp.array(dtype=scalar)
        directional_derivative: wp.array(dtype=scalar)
        step_length: wp.array(dtype=scalar)
        residual_norm: wp.array(dtype=scalar)
        evaluations: wp.array(dtype=int)
        steps: wp.array(dtype=int)
        iterate: wp.array(dtype=int)
        take_unchecked_step: wp.array(dtype=int)
        new_direction: wp.array(dtype=int)
        rebuild_matrix: wp.array(dtype=int)
        asks_for_compression: wp.array(dtype=int)
        newton_iterations: wp.array(dtype=int)

    @wp.struct
    class StateAdjoint:
        """Running adjoints of the state: gradients of its arrays."""

        position_grad: wp.array(dtype=vec3)
        euler_grad: wp.array(dtype=scalar)
        velocity_grad: wp.array(dtype=vec3)
        euler_velocity_grad: wp.array(dtype=scalar)

    @wp.struct
    class Levels:
        """Index arrays of ``warp_yarn.description.levels.Levels``, and the preconditioner's numbers."""

        coarse_levels: int
        blocks_per_node: int
        warp_lines: int
        coarse_warp_lines: int
        exact: int
        line_start: wp.array(dtype=int)
        line_node: wp.array(dtype=int)
        lower: wp.array(dtype=int)
        level_start: wp.array(dtype=int)
        coarse_line_start: wp.array(dtype=int)
        coarse_line_node: wp.array(dtype=int)
        parent: wp.array(dtype=int)
        parent_weight: wp.array(dtype=scalar)
        child_start: wp.array(dtype=int)
        child: wp.array(dtype=int)
        child_weight: wp.array(dtype=scalar)
        block_start: wp.array(dtype=int)
        part: wp.array(dtype=int)
        part_weight: wp.array(dtype=scalar)
        coarsest_slot: wp.array(dtype=int)
        # numbers: matrices of the coarse levels, factors of all lines, ½ D⁻¹ of both lines of a node, the last level
        coarse_block: wp.array(dtype=mat33)
        line_factor: wp.array(dtype=scalar)
        coarse_line_factor: wp.array(dtype=scalar)
        halves: wp.array(dtype=sym33)
        coarse_halves: wp.array(dtype=sym33)
        coarsest: wp.array(dtype=scalar)
        # strips of two yarns (``warp_yarn.description.strips.Strips``), if there are any
        strips: int
        strip_phase: wp.array(dtype=int)
        strip_start: wp.array(dtype=int)
        strip_node: wp.array(dtype=int)
        strip_source: wp.array(dtype=int)
        strip_factor: wp.array(dtype=scalar)
        strip_work: wp.array(dtype=scalar)
        # work space
        line_work: wp.array(dtype=scalar)
        coarse_line_work: wp.array(dtype=scalar)
        coarse_r: wp.array(dtype=vec3)
        coarse_z: wp.array(dtype=vec3)

    @wp.struct
    class Pairs:
        """Samples that are near each other (nodes, or middles of segments too, which are behind them): of each
        ``near_room`` places, of which ``near_count`` are taken. Of those that touched it when the matrix was filled, as
        many as ``touch_count`` in ``touch_room`` places, and their blocks. Where middles touch, the segments at each
        node, else nothing."""

        near_room: int
        near_count: wp.array(dtype=int)
        near: wp.array(dtype=int)
        touch_room: int
        touch_count: wp.array(dtype=int)
        touch: wp.array(dtype=int)
        touch_block: wp.array(dtype=sym33)
        touching: wp.array(dtype=int)
        segments: wp.array(dtype=wp.vec4i)
        node_segments: wp.array(dtype=int)

    @wp.struct
    class Obstacles:
        """Of each obstacle: shape, size, friction, pose, velocity ṗ and spin ω; of a mesh the first of its faces."""

        obstacle_shape: wp.array(dtype=int)
        obstacle_size: wp.array(dtype=vec3)
        obstacle_friction: wp.array(dtype=scalar)
        obstacle_position: wp.array(dtype=vec3)
        obstacle_rotation: wp.array(dtype=quat)
        obstacle_velocity: wp.array(dtype=vec3)
        obstacle_spin: wp.array(dtype=vec3)
        first_face: wp.array(dtype=int)

    @wp.struct
    class Faces:
        """Of each face of all meshes three corners and its obstacle; of each sample ``face_room`` places, of which
        ``face_count`` are taken by faces that are near."""

        face_room: int
        mesh_corner: wp.array(dtype=vec3)
        face_obstacle: wp.array(dtype=int)
        face_count: wp.array(dtype=int)
        near_face: wp.array(dtype=int)

    return SimpleNamespace(
        Pairs=Pairs,
        Obstacles=Obstacles,
        Faces=Faces,
        BlockMatrix=BlockMatrix,
        Crimp=Crimp,
        SolverWork=SolverWork,
        SolveReport=SolveReport,
        NewtonControl=NewtonControl,
        StateAdjoint=StateAdjoint,
        Levels=Levels,
    )
