"""What yarns under compression take from a matrix, beside it:

    y −= G x,   of every segment g (I − t tᵀ)(x_a − x_b) at a and its opposite at b,   g = η² kₛ (1 − |w|)/l > 0

A compressed yarn pushes its nodes out of its line. A leaves that out, so as to be positive definite whatever the state
(``terms/stretch.py``); near a minimum of a stage's energy A − G is positive definite too, and Newton's iteration with
it converges quadratically where that with A goes on by a steady factor: where an impact has buckled yarns. The
preconditioner is that of A.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.structs import structs
from ..core.variant import Variant


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    scalar, vec3, vec4 = variant.scalar, variant.vec3, variant.vec4
    BlockMatrix = structs(variant).BlockMatrix

    @wp.func
    def takes_compression(blocks: BlockMatrix) -> bool:
        """Tell whether a solve is to be of A − G."""
        if blocks.compressed.shape[0] > 0:
            return blocks.compressed[0] != 0
        return False

    @wp.func
    def taken(g: vec4, z: vec3) -> vec3:
        """Compute g (I − t tᵀ) z."""
        t = vec3(g[0], g[1], g[2])
        return (z - t * wp.dot(t, z)) * g[3]

    @wp.func
    def subtract_compression(
        blocks: BlockMatrix, begin: int, end: int, x: wp.array(dtype=vec3), y: wp.array(dtype=vec3)
    ) -> scalar:
        """Compute y −= G x in a range of rows, and return minus their part of x·G x."""
        energy = scalar(0.0)
        for i in range(begin, end):
            total = vec3()
            for direction in range(2):
                after = blocks.neighbour[blocks.stencil * i + direction]
                if after >= 0:
                    total -= taken(blocks.compression[2 * i + direction], x[i] - x[after])
                before = blocks.before[2 * i + direction]
                if before >= 0:
                    total -= taken(blocks.compression[2 * before + direction], x[i] - x[before])
            y[i] = y[i] + total
            energy += wp.dot(x[i], total)
        return energy

    return SimpleNamespace(takes_compression=takes_compression, subtract_compression=subtract_compression)
