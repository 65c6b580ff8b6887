"""Indices into arrays, which the compiler knows are not negative."""

import warp as wp


@wp.func
def index(i: int) -> int:
    """i, which is not negative.

    Warp adds an array's length to an index below 0, at every access anew, since lengths differ. Where the compiler sees
    that there is none it leaves that out: a third of the time of kernels that compute little on what they read.
    """
    return i & 0x7FFFFFFF


@wp.func
def coordinates(
    segment_nodes: wp.array(dtype=wp.vec2i),
    segment_yarn: wp.array(dtype=int),
    yarn_direction: wp.array(dtype=int),
    e: int,
):
    """Where the Eulerian coordinates of a segment's two ends stand, along its yarn."""
    direction = yarn_direction[index(segment_yarn[e])]
    return index(2 * segment_nodes[e][0] + direction), index(2 * segment_nodes[e][1] + direction)
