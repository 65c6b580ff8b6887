"""Pins that hold nodes by a spring.

    V = ½ k_h |x − x_pin|²

Parameters: ``pin_stiffness`` k_h [N/m]; ``pin_target`` x_pin of each pin [m]. Exact pins are no term: they take their
nodes out of the system (``kernels/stepping/linear.py``).
"""

import warp as wp

from ..core.indexing import index
from ..core.structs import structs
from ..core.variant import Term, TermParameter, Variant


def define(variant: Variant) -> wp.Kernel:
    scalar, vec3 = variant.scalar, variant.vec3
    BlockMatrix = structs(variant).BlockMatrix

    @variant.kernel("terms")
    def pin_term(
        pin_node: wp.array(dtype=int),
        pin_stiffness: wp.array(dtype=scalar),
        pin_target: wp.array(dtype=vec3),
        position: wp.array(dtype=vec3),
        force: wp.array(dtype=vec3),
        matrix: int,
        blocks: BlockMatrix,
    ):
        e = index(wp.tid())
        i = index(pin_node[e])
        wp.atomic_add(force, i, (pin_target[e] - position[i]) * pin_stiffness[0])
        if matrix != 0:
            wp.atomic_add(
                blocks.diagonal_xx, i, wp.identity(n=3, dtype=scalar) * (blocks.coefficients[0][2] * pin_stiffness[0])
            )

    return pin_term


def define_energy(variant: Variant) -> wp.Kernel:
    scalar, vec3 = variant.scalar, variant.vec3

    @variant.kernel("energy")
    def pin_energy(
        pin_node: wp.array(dtype=int),
        pin_stiffness: wp.array(dtype=scalar),
        pin_target: wp.array(dtype=vec3),
        position: wp.array(dtype=vec3),
        energy: wp.array(dtype=scalar),
    ):
        e = wp.tid()
        offset = position[pin_node[e]] - pin_target[e]
        wp.atomic_add(energy, 0, scalar(0.5) * pin_stiffness[0] * wp.dot(offset, offset))

    return pin_energy


TERM = Term(
    name="pins",
    elements="pins",
    define=define,
    energy=define_energy,
    parameters=(TermParameter("pin_stiffness", "N/m", above=0.0),),
    absent=lambda scene: (
        "" if len(scene.pins) and scene.pin_stiffness is not None else "there is no pin with a stiffness"
    ),
    energy_watched_as="elastic_energy",
    kept=True,
)
