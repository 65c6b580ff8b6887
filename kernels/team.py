"""Processor cores that share a linear solve, each with a strip of the cloth's columns.

A sweep goes along the rows, one after the other, and a strip follows its neighbours: forwards, it begins a row when the
strip before has ended it, and ends it when the strip behind has ended the last one; backwards the other way round. So
they all work, one row apart, and what they compute is what one core does. They run one kernel at the same time, and
``team`` is where they meet:

    team[0] how often strips came to a meeting   team[1] the number of the solve   team[2] 1: helpers are to go home
    team[3] how many strips                      team[4] the last helper to wait   team[5] team[0] before the solve
    team[16 + 16 k] rows that strip k has swept, of all sweeps

A GPU has one strip and never waits.
"""

import functools
from types import SimpleNamespace

import warp as wp

from .variant import Variant

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
_SWEPT = """
#if !defined(__CUDA_ARCH__)
    __atomic_store_n(&team.data[16 + 16 * strip], rows, __ATOMIC_RELEASE);
#endif
"""
_FOLLOW = """
#if !defined(__CUDA_ARCH__)
    while (__atomic_load_n(&team.data[16 + 16 * strip], __ATOMIC_ACQUIRE) < rows) {}
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


@wp.func_native(_SWEPT)
def tell(team: wp.array(dtype=int), strip: int, rows: int):
    """Tells the other strips how many rows this one has swept."""
    ...


@wp.func_native(_FOLLOW)
def follow(team: wp.array(dtype=int), strip: int, rows: int):
    """Waits until a strip has swept so many rows."""
    ...


@wp.func
def share(whole: int, strip: int, strips: int) -> int:
    """Where the share of a strip begins."""
    return int(wp.int64(whole) * wp.int64(strip) / wp.int64(strips))


@wp.func
def follow_backwards(team: wp.array(dtype=int), strip: int, strips: int, column: int, width: int, rows: int):
    """Waits until a backward sweep, rows of all sweeps behind it, may go to a column of its row."""
    if strip + 1 < strips and column == width - 1:
        follow(team, strip + 1, rows + 1)
    if strip > 0 and column == 0:
        follow(team, strip - 1, rows)


@wp.func
def follow_forwards(team: wp.array(dtype=int), strip: int, strips: int, column: int, width: int, rows: int):
    """As ``follow_backwards``. The last three columns spread to some that the strip behind spreads to from the row
    before."""
    if strip > 0 and column == 0:
        follow(team, strip - 1, rows + 1)
    if strip + 1 < strips and column == width - 3:
        follow(team, strip + 1, rows)


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
