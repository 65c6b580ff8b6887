"""Numbers of a cloth: single ones of a plain cloth, in a general one those of every segment, yarn, node or corner.

    spacing       [2 nodes]      L from a node to the next one of its warp yarn and of its weft yarn, at rest in space
    radius        [2 yarns]      half the width and half the thickness of a yarn
    lock_angle    [4 crossings]  φ_l of a corner
    shear, friction, friction_stiffness, friction_damping  [nodes]

Kernels of a plain cloth read entry 0 of each, at no cost: ``own`` is then 0 at compile time.
"""

import functools
from types import SimpleNamespace

import warp as wp

from .variant import Variant

NUMBERS = {"spacing", "radius", "lock_angle", "shear", "friction", "friction_stiffness", "friction_damping"}
"""Arrays that have one number of a plain cloth."""


def reads(kernel: wp.Kernel) -> bool:
    """Tell whether a kernel reads a cloth's numbers."""
    return any(argument.label in NUMBERS for argument in kernel.adj.args)


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    """Make the Warp functions that find numbers of a cloth."""
    scalar = variant.scalar

    if variant.general:

        @wp.func
        def own(i: int) -> int:
            """Return i."""
            return i

    else:

        @wp.func
        def own(i: int) -> int:
            """Return 0: there is one number for all."""
            return 0

    @wp.func
    def half_width_across(radius: wp.array(dtype=scalar), node_yarns: wp.array(dtype=int), node: int, direction: int):
        """Look up half the width of the yarn that crosses one of this direction at a node, 0 where none does."""
        yarn = node_yarns[2 * node + 1 - direction]
        if yarn >= 0:
            return radius[2 * yarn]
        return scalar(0.0)

    return SimpleNamespace(own=own, half_width_across=half_width_across)
