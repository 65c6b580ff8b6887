"""What touches where nodes alone do not: nodes, and the middles of segments between them.

    c_p = x_p of a node,   c_p = ½ (x_a + x_b) of the middle of a segment a, b

Contact is of these samples, as if they were nodes: places and velocities are gathered from nodes, and forces and blocks
of the matrix are scattered to them, by the same weights. So virtual work is the same, and momentum is kept.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.indexing import ends, index
from ..core.status import OVERLAPPING, fail
from ..core.structs import structs
from ..core.variant import Variant
from . import limits

TO_SPARE = 0.5
"""Of what a node's way to the start of a stage leaves of its gap, what that of a middle has to leave at least."""


@functools.cache
def define_reversible(variant: Variant) -> SimpleNamespace:
    """Define what gathers from nodes and scatters to them, in reverse too."""
    scalar, vec3 = variant.scalar, variant.vec3

    @variant.kernel("samples")
    def gather_samples(
        nodes: int, segments: wp.array(dtype=wp.vec4i), source: wp.array(dtype=vec3), target: wp.array(dtype=vec3)
    ):
        """Gather what samples have of what nodes have."""
        p = index(wp.tid())
        if p < nodes:
            target[p] = source[p]
        else:
            a, b, _sa, _sb, _yarn, _direction = ends(segments, p - nodes)
            target[p] = (source[a] + source[b]) * scalar(0.5)

    @variant.kernel("samples")
    def scatter_forces(
        nodes: int,
        segments: wp.array(dtype=wp.vec4i),
        sample_force: wp.array(dtype=vec3),
        force: wp.array(dtype=vec3),
    ):
        """Scatter forces on samples to nodes."""
        p = index(wp.tid())
        f = sample_force[p]
        if p < nodes:
            wp.atomic_add(force, p, f)
        else:
            a, b, _sa, _sb, _yarn, _direction = ends(segments, p - nodes)
            wp.atomic_add(force, a, f * scalar(0.5))
            wp.atomic_add(force, b, f * scalar(0.5))

    return SimpleNamespace(gather_samples=gather_samples, scatter_forces=scatter_forces)


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, vec3, mat33, quat = variant.scalar, variant.vec3, variant.mat33, variant.quat
    BlockMatrix, Obstacles, Faces = structs(variant).BlockMatrix, structs(variant).Obstacles, structs(variant).Faces
    ways = limits.functions(variant)
    nearest, reach, taken = ways.nearest, ways.reach, ways.taken
    module = variant.module("sample_limits")

    @wp.kernel(module=module, enable_backward=False)
    def scatter_blocks(
        nodes: int, segments: wp.array(dtype=wp.vec4i), sample_block: wp.array(dtype=mat33), blocks: BlockMatrix
    ):
        """Scatter the samples' own blocks: a middle couples both ends of its segment."""
        p = index(wp.tid())
        b = sample_block[p]
        if p < nodes:
            wp.atomic_add(blocks.diagonal_xx, p, b)
        else:
            i, j, _sa, _sb, _yarn, direction = ends(segments, p - nodes)
            b = b * scalar(0.25)
            wp.atomic_add(blocks.diagonal_xx, i, b)
            wp.atomic_add(blocks.diagonal_xx, j, b)
            wp.atomic_add(blocks.upper_xx, index(blocks.stencil * i + direction), b)

    @wp.kernel(module=module, enable_backward=False)
    def mark_middles(
        obstacles: Obstacles,
        faces: Faces,
        meshes: wp.array(dtype=wp.uint64),
        obstacle_position_before: wp.array(dtype=vec3),
        obstacle_rotation_before: wp.array(dtype=quat),
        contact_distance: wp.array(dtype=scalar),
        stage_size: wp.array(dtype=scalar),
        segments: wp.array(dtype=wp.vec4i),
        position: wp.array(dtype=vec3),
        base_position: wp.array(dtype=vec3),
        solution: wp.array(dtype=vec3),
        is_last: int,
        taken_by: wp.array(dtype=int),
        status: wp.array(dtype=int),
    ):
        """Mark the ends of segments whose middle would not come to a stage's start in the clear, by the obstacle in the
        way (from 1); at last there is to be none."""
        a, b, _sa, _sb, _yarn, _direction = ends(segments, index(wp.tid()))
        half = scalar(0.5)
        x = (position[a] + position[b]) * half
        end = (base_position[a] + base_position[b] + (solution[a] + solution[b]) * stage_size[0]) * half
        for k in range(obstacles.obstacle_shape.shape[0]):
            # seen from the obstacle, as of nodes
            begin = taken(obstacles, k, obstacle_position_before, obstacle_rotation_before, x)
            above = nearest(obstacles, faces, meshes, k, begin)[3] - contact_distance[0]
            limit = contact_distance[0] + scalar(wp.static(limits.LEFT * TO_SPARE)) * above
            if reach(obstacles, faces, meshes, k, begin, end - begin, limit) < scalar(1.0):
                if is_last != 0:
                    fail(status, wp.static(OVERLAPPING), a)
                else:
                    wp.atomic_max(taken_by, a, k + 1)
                    wp.atomic_max(taken_by, b, k + 1)

    @wp.kernel(module=module, enable_backward=False)
    def stay_with_obstacle(
        obstacles: Obstacles,
        obstacle_position_before: wp.array(dtype=vec3),
        obstacle_rotation_before: wp.array(dtype=quat),
        taken_by: wp.array(dtype=int),
        is_free: wp.array(dtype=int),
        stage_size: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        base_position: wp.array(dtype=vec3),
        solution: wp.array(dtype=vec3),
    ):
        """Let a marked node start where it was, beside the obstacle; so does a middle of two such."""
        i = index(wp.tid())
        k = taken_by[i] - 1
        if k >= 0 and is_free[i] != 0:
            x = taken(obstacles, k, obstacle_position_before, obstacle_rotation_before, position[i])
            solution[i] = (x - base_position[i]) / stage_size[0]

    return SimpleNamespace(
        scatter_blocks=scatter_blocks, mark_middles=mark_middles, stay_with_obstacle=stay_with_obstacle
    )
