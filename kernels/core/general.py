"""Numbers of a cloth: single ones of a plain cloth, in a general one those of every segment, yarn, node or corner.

    spacing       [4 nodes]      L from a node to the next one of its warp yarn and of its weft yarn, at rest in space;
                                 after those of all nodes, half the widths of its two yarns
    radius        [3 yarns]      half the width and half the thickness of a yarn; after those of all, 1 + crimp
    lock_angle    [4 crossings]  φ_l of a corner
    shear, friction, friction_stiffness, friction_damping  [nodes]

Kernels of a plain cloth read entry 0 of each, at no cost: ``own`` is then 0 at compile time. What of ``node_yarns`` and
``lengthening`` the kernels of every step need stands in these too: Warp copies the arguments for every thread, so that
one more array takes a tenth of the time of a kernel over segments, of a plain cloth too.
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
    def half_width(spacing: wp.array(dtype=scalar), node: int, direction: int) -> scalar:
        """Look up half the width of a node's yarn of this direction, 0 where it has none."""
        return spacing[spacing.shape[0] / 2 + 2 * node + direction]

    @wp.func
    def longer(radius: wp.array(dtype=scalar), yarn: int) -> scalar:
        """Look up 1 + crimp of a yarn."""
        return radius[2 * (radius.shape[0] / 3) + yarn]

    return SimpleNamespace(own=own, half_width=half_width, longer=longer)
