"""Wind on the cloth's triangles, two to a cell of the grid.

    F = ρ_w A |v_n| v_n n + c_d A (v_r − v_n n),   v_r = wind − mean vertex velocity,   v_n = n·v_r

a third of it on each vertex.

Parameters: ``wind_velocity`` [m/s]; ``wind_density`` ρ_w [kg/m³]; ``wind_drag`` c_d [kg/(m² s)]. Where there are gusts,
the mean of the nodes' ``gust`` comes to the wind's velocity.

The matrix holds the exact derivative by velocity, which is symmetric positive semi-definite:
−∂F/∂v = A (2 ρ_w |v_n| n nᵀ + c_d (I − n nᵀ)). The derivative by position is not symmetric, and left out.
"""

import warp as wp

from ..core.indexing import index
from ..core.structs import structs
from ..core.variant import Term, TermParameter, Variant


def define(variant: Variant) -> wp.Kernel:
    return _define(variant, gusty=False)


def define_gusty(variant: Variant) -> wp.Kernel:
    """Define the kernel of wind with gusts, in a module of its own: who has none does not compile it."""
    return _define(variant, gusty=True)


def _define(variant: Variant, *, gusty: bool) -> wp.Kernel:
    scalar, vec3 = variant.scalar, variant.vec3
    BlockMatrix = structs(variant).BlockMatrix

    @variant.kernel("gusts" if gusty else "terms")
    def wind_term(
        # topology
        triangle_nodes: wp.array(dtype=wp.vec3i),
        triangle_blocks: wp.array(dtype=wp.vec3i),
        # parameters
        wind_velocity: wp.array(dtype=vec3),
        wind_density: wp.array(dtype=scalar),
        wind_drag: wp.array(dtype=scalar),
        gust: wp.array(dtype=vec3),
        # state in
        position: wp.array(dtype=vec3),
        velocity: wp.array(dtype=vec3),
        # forces and momentum out
        force: wp.array(dtype=vec3),
        momentum: wp.array(dtype=vec3),
        # matrix out
        matrix: int,
        blocks: BlockMatrix,
    ):
        e = index(wp.tid())
        i = index(triangle_nodes[e][0])
        j = index(triangle_nodes[e][1])
        k = index(triangle_nodes[e][2])
        third = scalar(wp.static(1.0 / 3.0))
        cross = wp.cross(position[j] - position[i], position[k] - position[i])
        area = scalar(0.5) * wp.length(cross)
        n = wp.normalize(cross)
        mean_velocity = (velocity[i] + velocity[j] + velocity[k]) * third
        relative = wind_velocity[0] - mean_velocity
        if wp.static(gusty):
            relative += (gust[i] + gust[j] + gust[k]) * third
        v_n = wp.dot(n, relative)
        pressure = wind_density[0] * area * wp.abs(v_n)
        drag = wind_drag[0] * area
        f = (n * (v_n * (pressure - drag)) + relative * drag) * third
        wp.atomic_add(force, i, f)
        wp.atomic_add(force, j, f)
        wp.atomic_add(force, k, f)

        if matrix != 0:
            h = blocks.coefficients[0][1] * third * third
            xx = wp.outer(n, n) * ((scalar(2.0) * pressure - drag) * h) + wp.identity(n=3, dtype=scalar) * (drag * h)
            p = xx * (mean_velocity * scalar(3.0))
            wp.atomic_add(momentum, i, p)
            wp.atomic_add(momentum, j, p)
            wp.atomic_add(momentum, k, p)
            wp.atomic_add(blocks.diagonal_xx, i, xx)
            wp.atomic_add(blocks.diagonal_xx, j, xx)
            wp.atomic_add(blocks.diagonal_xx, k, xx)
            slots = triangle_blocks[e]
            wp.atomic_add(blocks.upper_xx, index(slots[0]), xx)
            wp.atomic_add(blocks.upper_xx, index(slots[1]), xx)
            wp.atomic_add(blocks.upper_xx, index(slots[2]), xx)

    return wind_term


TERM = Term(
    name="wind",
    elements="triangles",
    define=define,
    parameters=(
        TermParameter("wind_velocity", "m/s", size=3),
        TermParameter("wind_density", "kg/m³", least=0.0),
        TermParameter("wind_drag", "kg/(m² s)", least=0.0),
    ),
    absent=lambda scene: "wind is None" if scene.wind is None else "",
    stencil=6,
    works=True,
    explicit_in_ros2=True,
)
