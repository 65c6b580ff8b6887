"""Processor cores that share a linear solve, each with a strip of the cloth's columns.

A sweep goes along the rows, one after the other, and a strip follows its neighbours: forwards, it begins a row when the
strip before has ended it, and ends it when the strip behind has begun the last one, by ``EDGE`` nodes; backwards the
other way round. So they all work, a row or two apart, and what they compute is what one core does. They run one kernel
at the same time, and ``team`` is where they meet:

    team[0] how often strips came to a meeting   team[1] the number of the solve   team[2] 1: helpers are to go home
    team[3] how many strips                      team[4] the last helper to wait   team[5] team[0] before the solve
    team[16 + 16 k] rows that strip k has ended, of all sweeps, and team[17 + 16 k] those that it has begun

A GPU has one strip and never waits.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.variant import Variant

EDGE = 3
"""Nodes of a row that share neighbours with the next strip: the matrix couples second next ones."""

_MEET = """
#if !defined(__CUDA_ARCH__)
    __atomic_add_fetch(&team.data[0], 1, __ATOMIC_ACQ_REL);
    while (__atomic_load_n(&team.data[0], __ATOMIC_ACQUIRE) < goal) {}
#endif
"""
_CALL = """
#if !defined(__CUDA_ARCH__)
    team.data[5] = __atomic_load_n(&team.data[0], __ATOMIC_ACQUIRE);
    __atomic_add_fetch(&team.data[1], 1, __ATOMIC_ACQ_REL);
#endif
"""
_AWAIT = """
#if !defined(__CUDA_ARCH__)
    __atomic_store_n(&team.data[4], strip, __ATOMIC_RELEASE);
    while (__atomic_load_n(&team.data[1], __ATOMIC_ACQUIRE) == last
           && !__atomic_load_n(&team.data[2], __ATOMIC_ACQUIRE)) {}
#endif
"""
_ENDED = """
#if !defined(__CUDA_ARCH__)
    __atomic_store_n(&team.data[16 + 16 * strip], rows, __ATOMIC_RELEASE);
#endif
"""
_BEGUN = """
#if !defined(__CUDA_ARCH__)
    __atomic_store_n(&team.data[17 + 16 * strip], rows, __ATOMIC_RELEASE);
#endif
"""
_UNTIL_ENDED = """
#if !defined(__CUDA_ARCH__)
    while (__atomic_load_n(&team.data[16 + 16 * strip], __ATOMIC_ACQUIRE) < rows) {}
#endif
"""
_UNTIL_BEGUN = """
#if !defined(__CUDA_ARCH__)
    while (__atomic_load_n(&team.data[17 + 16 * strip], __ATOMIC_ACQUIRE) < rows) {}
#endif
"""


@wp.func_native(_CALL)
def call(team: wp.array(dtype=int)):
    """Begins a solve."""
    ...


@wp.func_native(_AWAIT)
def wait_for_call(team: wp.array(dtype=int), last: int, strip: int):
    """Waits for a solve after the last one, or the end of all."""
    ...


@wp.func_native(_MEET)
def meet(team: wp.array(dtype=int), goal: int):
    """Comes to a meeting, and waits until so many have come."""
    ...


@wp.func_native(_ENDED)
def ended(team: wp.array(dtype=int), strip: int, rows: int):
    """Tells the other strips how many rows this one has ended."""
    ...


@wp.func_native(_BEGUN)
def begun(team: wp.array(dtype=int), strip: int, rows: int):
    """Tells the other strips in how many rows this one is past its first nodes."""
    ...


@wp.func_native(_UNTIL_ENDED)
def until_ended(team: wp.array(dtype=int), strip: int, rows: int):
    """Waits until a strip has ended so many rows."""
    ...


@wp.func_native(_UNTIL_BEGUN)
def until_begun(team: wp.array(dtype=int), strip: int, rows: int):
    """Waits until a strip is past its first nodes of so many rows."""
    ...


@wp.func
def share(whole: int, strip: int, strips: int) -> int:
    """Where the share of a strip begins."""
    return int(wp.int64(whole) * wp.int64(strip) / wp.int64(strips))


@wp.func
def keep_pace(
    team: wp.array(dtype=int), strip: int, before: int, behind: int, strips: int, step: int, width: int, rows: int
):
    """Comes before the step-th node of a row, when a strip has swept so many rows; waits until it may be taken.

    The strip before is the one that this one takes up a row from, that behind the one which takes it up.
    Forwards, the last nodes of a row spread to some that the strip behind spreads to from the first of the row before;
    backwards, they read what it made there. Further on in its row it touches none of theirs, so it may lag by one.
    """
    if step == 0:
        if before >= 0 and before < strips:
            until_ended(team, before, rows + 1)
    if step == wp.static(EDGE):
        begun(team, strip, rows + 1)
    if step == width - wp.static(EDGE):
        if behind >= 0 and behind < strips:
            until_begun(team, behind, rows)


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    scalar = variant.scalar

    @wp.func
    def total(
        mine: scalar,
        slot: int,
        strip: int,
        strips: int,
        met: int,
        team: wp.array(dtype=int),
        sums: wp.array(dtype=scalar),
    ) -> scalar:
        """The sum over the strips, when all have come to it."""
        if strips == 1:
            return mine
        sums[strips * slot + strip] = mine
        meet(team, met)
        result = scalar(0.0)
        for k in range(strips):
            result += sums[strips * slot + k]
        return result

    return SimpleNamespace(total=total)
