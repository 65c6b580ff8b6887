"""What a solve takes along beside the blocks of the weave's stencil, which preconditioners do not see:

    y += (C − G) x

C is of nodes that touch (``pair_blocks.py``). G is what compressed yarns take from A:

    g (I − t tᵀ)(x_a − x_b) at a, the opposite at b, of every segment a, b,   g = η² kₛ (1 − |w|)/l > 0

A compressed yarn pushes its nodes out of its line. A leaves that out, so as to be positive definite whatever the
state (``terms/stretch.py``). Near a minimum of a stage's energy A − G is positive definite too, and Newton's iteration
with it converges fast where that with A goes on by a steady factor: wherever yarns are buckled.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core import memory
from ..core.indexing import index
from ..core.structs import structs
from ..core.variant import Variant
from . import pair_blocks
from .pair_blocks import PAIRS_TOUCH


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    scalar, vec3, vec4 = variant.scalar, variant.vec3, variant.vec4
    BlockMatrix, Pairs = structs(variant).BlockMatrix, structs(variant).Pairs
    load, store = memory.functions(variant).load, memory.functions(variant).store
    add_pairs = pair_blocks.functions(variant).add_pairs

    @wp.func
    def takes_compression(blocks: BlockMatrix) -> bool:
        """Tell whether a solve is of A − G."""
        if blocks.compressed.shape[0] > 0:
            return blocks.compressed[0] != 0
        return False

    @wp.func
    def has_more(blocks: BlockMatrix, pairs: Pairs) -> bool:
        """Tell whether there is anything beside."""
        return pairs.touching[wp.static(PAIRS_TOUCH)] != 0 or takes_compression(blocks)

    @wp.func
    def transverse(g: vec4, z: vec3) -> vec3:
        """Compute g (I − t tᵀ) z of (t, g)."""
        t = vec3(g[0], g[1], g[2])
        return (z - t * wp.dot(t, z)) * g[3]

    @wp.func
    def subtract_compression(
        blocks: BlockMatrix, begin: int, end: int, x: wp.array(dtype=vec3), y: wp.array(dtype=vec3)
    ) -> scalar:
        """Compute y −= G x in a range of rows, and return their part of −x·G x."""
        energy = scalar(0.0)
        for i in range(begin, end):
            total = vec3()
            for direction in range(2):
                behind = blocks.compression[index(2 * i + direction)]
                if behind[3] > scalar(0.0):
                    after = index(blocks.neighbour[index(blocks.stencil * i + direction)])
                    total -= transverse(behind, load(x, i) - load(x, after))
                before = blocks.before[index(2 * i + direction)]
                if before >= 0:
                    ahead = blocks.compression[index(2 * before + direction)]
                    if ahead[3] > scalar(0.0):
                        total -= transverse(ahead, load(x, i) - load(x, before))
            store(y, i, load(y, i) + total)
            energy += wp.dot(load(x, i), total)
        return energy

    @wp.func
    def add_beside(
        blocks: BlockMatrix, pairs: Pairs, begin: int, end: int, x: wp.array(dtype=vec3), y: wp.array(dtype=vec3)
    ) -> scalar:
        """Compute y += (C − G) x in a range of rows, and return their part of x·(C − G) x."""
        energy = scalar(0.0)
        if pairs.touching[wp.static(PAIRS_TOUCH)] != 0:
            energy += add_pairs(pairs, begin, end, x, y)
        if takes_compression(blocks):
            energy += subtract_compression(blocks, begin, end, x, y)
        return energy

    return SimpleNamespace(takes_compression=takes_compression, has_more=has_more, add_beside=add_beside)
