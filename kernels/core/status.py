"""What can go wrong in a step, as a number on the device."""

import warp as wp

NOT_FINITE, ORDER_LOST, NOT_CONVERGED, STALLED, INACCURATE, GAINED = 1, 2, 3, 4, 5, 6
OVERLAPPING, CROWDED, IMPACT, UNRESOLVED = 7, 8, 9, 10
"""The first number of ``status``; ``status[1]`` is the node or -1, ``status[2]`` the step of its chunk."""


@wp.func
def fail(status: wp.array(dtype=int), code: int, node: int):
    """Write down what went wrong, and at which node, unless something did before."""
    if wp.atomic_cas(status, 0, 0, code) == 0:
        status[1] = node
