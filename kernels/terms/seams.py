"""Seams that draw pairs of nodes together, each by a spring.

    V = ½ k |x_b − x_a|²

Parameters: ``seam_stiffness`` k of every pair [N/m]. A pair may be of any two nodes, of one cloth or of two.

The matrix holds k, the exact second derivative. Its blocks beside the diagonal stand in two slots beyond the weave's
stencil, so a scene with seams has a stencil eight wide (``warp_yarn/description/seams.py``).
"""

import warp as wp

from ..core.indexing import index
from ..core.structs import structs
from ..core.variant import Term, TermParameter, Variant


def define(variant: Variant) -> wp.Kernel:
    scalar, vec3 = variant.scalar, variant.vec3
    BlockMatrix = structs(variant).BlockMatrix

    @variant.kernel("terms")
    def seam_term(
        seam_nodes: wp.array(dtype=int),
        seam_block: wp.array(dtype=int),
        seam_stiffness: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        force: wp.array(dtype=vec3),
        matrix: int,
        blocks: BlockMatrix,
    ):
        e = index(wp.tid())
        a = index(seam_nodes[2 * e])
        b = index(seam_nodes[2 * e + 1])
        f = (position[b] - position[a]) * seam_stiffness[0]
        wp.atomic_add(force, a, f)
        wp.atomic_add(force, b, -f)
        if matrix != 0:
            k = wp.identity(n=3, dtype=scalar) * (blocks.coefficients[0][2] * seam_stiffness[0])
            wp.atomic_add(blocks.diagonal_xx, a, k)
            wp.atomic_add(blocks.diagonal_xx, b, k)
            wp.atomic_add(blocks.upper_xx, index(seam_block[e]), -k)

    return seam_term


def define_energy(variant: Variant) -> wp.Kernel:
    scalar, vec3 = variant.scalar, variant.vec3

    @variant.kernel("energy")
    def seam_energy(
        seam_nodes: wp.array(dtype=int),
        seam_stiffness: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        energy: wp.array(dtype=scalar),
    ):
        e = wp.tid()
        gap = position[seam_nodes[2 * e + 1]] - position[seam_nodes[2 * e]]
        wp.atomic_add(energy, 0, scalar(0.5) * seam_stiffness[0] * wp.dot(gap, gap))

    return seam_energy


TERM = Term(
    name="seams",
    elements="seams",
    define=define,
    energy=define_energy,
    parameters=(TermParameter("seam_stiffness", "N/m", above=0.0),),
    absent=lambda scene: "" if len(scene.seams) else "there is no seam",
    stencil=8,
    energy_watched_as="elastic_energy",
    kept=True,
)
