"""Blocks of the matrix beyond the weave's stencil: of nodes that touch, wherever they are along the cloth.

    y += C x,   C_pq = −B_pq = C_qp,   of every pair p, q of a list

Their diagonal blocks are in the matrix as all others are, so the preconditioners know a contact's stiffness, but not
whom it is with: at the default stiffness that takes some iterations more, and no factorization of a changing pattern.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.variant import Variant

PAIRS = 1
"""Place of ``touching``."""


@functools.cache
def structs(variant: Variant) -> SimpleNamespace:
    sym33 = variant.sym33

    @wp.struct
    class Pairs:
        """Of each node as many rows as ``near_room`` says: the nodes that are near it, and of those that touch it the
        block B, which is 0 for the others. ``touching[PAIRS]`` is 0 where no two of the cloth touch."""

        near_room: int
        near_count: wp.array(dtype=int)
        near: wp.array(dtype=int)
        near_block: wp.array(dtype=sym33)
        touching: wp.array(dtype=int)

    return SimpleNamespace(Pairs=Pairs)


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    scalar, vec3 = variant.scalar, variant.vec3
    Pairs = structs(variant.forward).Pairs

    @wp.func
    def add_pairs(pairs: Pairs, begin: int, end: int, x: wp.array(dtype=vec3), y: wp.array(dtype=vec3)) -> scalar:
        """y += C x in a range of rows, and their part of x·C x."""
        energy = scalar(0.0)
        for p in range(begin, end):
            total = vec3()
            for k in range(p * pairs.near_room, p * pairs.near_room + pairs.near_count[p]):
                b = pairs.near_block[k]
                z = x[pairs.near[k]]
                total -= vec3(
                    b[0] * z[0] + b[1] * z[1] + b[2] * z[2],
                    b[1] * z[0] + b[3] * z[1] + b[4] * z[2],
                    b[2] * z[0] + b[4] * z[1] + b[5] * z[2],
                )
            y[p] = y[p] + total
            energy += wp.dot(x[p], total)
        return energy

    return SimpleNamespace(add_pairs=add_pairs)
