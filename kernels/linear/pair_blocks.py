"""Blocks of the matrix beyond the weave's stencil: of nodes that touch, wherever they are along the cloth.

    y += C x,   C_pq = −B_pq = C_qp,   of every pair p, q that touched when the matrix was filled

Where middles of segments touch as well, x is theirs, the mean of both ends, and half of y goes to either.

Their diagonal blocks are in the matrix as all others are, so the preconditioners know a contact's stiffness, but not
whom it is with: at the default stiffness that takes some iterations more, and no factorization of a changing pattern.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.structs import structs
from ..core.variant import Variant

TOUCHES, PAIRS_TOUCH, IMPACTS = 0, 1, 2
"""Places of ``touching``: whether anything touches, two nodes of the cloth, anything so fast that it is an impact."""


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    scalar, vec3 = variant.scalar, variant.vec3
    Pairs = structs(variant).Pairs

    @wp.func
    def sample(pairs: Pairs, nodes: int, p: int, x: wp.array(dtype=vec3)) -> vec3:
        """Find x of a sample."""
        if p < nodes:
            return x[p]
        segment = pairs.segments[p - nodes]
        return (x[segment[0]] + x[segment[1]]) * scalar(0.5)

    @wp.func
    def row(pairs: Pairs, nodes: int, p: int, x: wp.array(dtype=vec3)) -> vec3:
        """Compute the row of C x of a sample."""
        total = vec3()
        for k in range(p * pairs.touch_room, p * pairs.touch_room + pairs.touch_count[p]):
            b = pairs.touch_block[k]
            z = sample(pairs, nodes, pairs.touch[k], x)
            total -= vec3(
                b[0] * z[0] + b[1] * z[1] + b[2] * z[2],
                b[1] * z[0] + b[3] * z[1] + b[4] * z[2],
                b[2] * z[0] + b[4] * z[1] + b[5] * z[2],
            )
        return total

    @wp.func
    def add_samples(pairs: Pairs, begin: int, end: int, x: wp.array(dtype=vec3), y: wp.array(dtype=vec3)) -> scalar:
        """Do as ``add_pairs`` where middles touch as well."""
        nodes = pairs.node_segments.shape[0] / 4
        energy = scalar(0.0)
        for i in range(begin, end):
            total = row(pairs, nodes, i, x)
            for slot in range(4 * i, 4 * i + 4):
                if pairs.node_segments[slot] >= 0:
                    total += row(pairs, nodes, nodes + pairs.node_segments[slot], x) * scalar(0.5)
            y[i] = y[i] + total
            energy += wp.dot(x[i], total)
        return energy

    @wp.func
    def add_pairs(pairs: Pairs, begin: int, end: int, x: wp.array(dtype=vec3), y: wp.array(dtype=vec3)) -> scalar:
        """Add y += C x in a range of rows, and return their part of x·C x."""
        if pairs.node_segments.shape[0] > 0:
            return add_samples(pairs, begin, end, x, y)
        energy = scalar(0.0)
        for p in range(begin, end):
            total = vec3()
            for k in range(p * pairs.touch_room, p * pairs.touch_room + pairs.touch_count[p]):
                b = pairs.touch_block[k]
                z = x[pairs.touch[k]]
                total -= vec3(
                    b[0] * z[0] + b[1] * z[1] + b[2] * z[2],
                    b[1] * z[0] + b[3] * z[1] + b[4] * z[2],
                    b[2] * z[0] + b[4] * z[1] + b[5] * z[2],
                )
            y[p] = y[p] + total
            energy += wp.dot(x[p], total)
        return energy

    return SimpleNamespace(add_pairs=add_pairs)
