"""Indices into arrays, which the compiler knows are not negative."""

import warp as wp


@wp.func
def index(i: int) -> int:
    """Return i, which is not negative.

    Warp adds an array's length to an index below 0, at every access anew, since lengths differ. Where the compiler sees
    that there is none it leaves that out: a third of the time of kernels that compute little on what they read.
    """
    return i & 0x7FFFFFFF


@wp.func
def ends(segments: wp.array(dtype=wp.vec4i), e: int):
    """Look up a segment: its nodes a and b, where their coordinates along its yarn stand, its yarn, its direction."""
    segment = segments[e]
    a = index(segment[0])
    b = index(segment[1])
    direction = index(segment[3])
    return a, b, 2 * a + direction, 2 * b + direction, index(segment[2]), direction


@wp.func
def coordinates(segments: wp.array(dtype=wp.vec4i), e: int):
    """Look up where the coordinates of a segment's two ends stand, along its yarn."""
    segment = segments[e]
    return index(2 * segment[0] + segment[3]), index(2 * segment[1] + segment[3])
