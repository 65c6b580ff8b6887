"""What can go wrong in a step, as a number on the device."""

NOT_FINITE, ORDER_LOST, NOT_CONVERGED, STALLED, INACCURATE, GAINED, OVERLAPPING, CROWDED, IMPACT = (
    1,
    2,
    3,
    4,
    5,
    6,
    7,
    8,
    9,
)
"""The first number of ``status``; ``status[1]`` is the node or -1, ``status[2]`` the step of its chunk."""
