"""Threads that share a linear solve, each with its part of the cloth's columns, on a processor core of its own.

A sweep goes along the rows, one after the other, and a thread follows its neighbours: forwards, it begins a row when
the thread before has ended it, and ends it when the thread behind has begun the last one, by ``EDGE`` nodes; backwards
the other way round. So they all work, a row or two apart, and what they compute is what one core does. They run one
kernel at the same time, and wait for each other by ``signals``:

    [0] how often threads came to a barrier   [1] the number of the solve       [2] 1: helpers are to end
    [3] how many threads                      [4] the last helper to wait       [5] [0] before the solve
    [16 + 16 k] rows that thread k has ended, of all sweeps, and [17 + 16 k] those that it has begun

A GPU has one thread and never waits.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.variant import Variant

EDGE = 3
"""Nodes of a row that share neighbours with the next thread: the matrix couples second next ones."""

_BARRIER = """
#if !defined(__CUDA_ARCH__)
    __atomic_add_fetch(&signals.data[0], 1, __ATOMIC_ACQ_REL);
    while (__atomic_load_n(&signals.data[0], __ATOMIC_ACQUIRE) < goal) {}
#endif
"""
_BEGIN = """
#if !defined(__CUDA_ARCH__)
    signals.data[5] = __atomic_load_n(&signals.data[0], __ATOMIC_ACQUIRE);
    __atomic_add_fetch(&signals.data[1], 1, __ATOMIC_ACQ_REL);
#endif
"""
_AWAIT = """
#if !defined(__CUDA_ARCH__)
    __atomic_store_n(&signals.data[4], thread, __ATOMIC_RELEASE);
    while (__atomic_load_n(&signals.data[1], __ATOMIC_ACQUIRE) == last
           && !__atomic_load_n(&signals.data[2], __ATOMIC_ACQUIRE)) {}
#endif
"""
_ENDED = """
#if !defined(__CUDA_ARCH__)
    __atomic_store_n(&signals.data[16 + 16 * thread], rows, __ATOMIC_RELEASE);
#endif
"""
_BEGUN = """
#if !defined(__CUDA_ARCH__)
    __atomic_store_n(&signals.data[17 + 16 * thread], rows, __ATOMIC_RELEASE);
#endif
"""
_UNTIL_ENDED = """
#if !defined(__CUDA_ARCH__)
    while (__atomic_load_n(&signals.data[16 + 16 * thread], __ATOMIC_ACQUIRE) < rows) {}
#endif
"""
_UNTIL_BEGUN = """
#if !defined(__CUDA_ARCH__)
    while (__atomic_load_n(&signals.data[17 + 16 * thread], __ATOMIC_ACQUIRE) < rows) {}
#endif
"""


@wp.func_native(_BEGIN)
def begin_solve(signals: wp.array(dtype=int)):
    """Begins a solve."""
    ...


@wp.func_native(_AWAIT)
def wait_for_solve(signals: wp.array(dtype=int), last: int, thread: int):
    """Waits for a solve after the last one, or the end of all."""
    ...


@wp.func_native(_BARRIER)
def barrier(signals: wp.array(dtype=int), goal: int):
    """Comes to a barrier, and waits until so many have come."""
    ...


@wp.func_native(_ENDED)
def ended(signals: wp.array(dtype=int), thread: int, rows: int):
    """Tells the other threads how many rows this one has ended."""
    ...


@wp.func_native(_BEGUN)
def begun(signals: wp.array(dtype=int), thread: int, rows: int):
    """Tells the other threads in how many rows this one is past its first nodes."""
    ...


@wp.func_native(_UNTIL_ENDED)
def until_ended(signals: wp.array(dtype=int), thread: int, rows: int):
    """Waits until a thread has ended so many rows."""
    ...


@wp.func_native(_UNTIL_BEGUN)
def until_begun(signals: wp.array(dtype=int), thread: int, rows: int):
    """Waits until a thread is past its first nodes of so many rows."""
    ...


@wp.func
def partition(whole: int, thread: int, threads: int) -> int:
    """Find where the part of a thread begins."""
    return int(wp.int64(whole) * wp.int64(thread) / wp.int64(threads))


@wp.func
def keep_pace(
    signals: wp.array(dtype=int), thread: int, before: int, behind: int, threads: int, step: int, width: int, rows: int
):
    """Comes before the step-th node of a row, when a thread has swept so many rows; waits until it may be taken.

    The thread before is the one that this one takes up a row from, that behind the one which takes it up.
    Forwards, the last nodes of a row spread to some that the thread behind spreads to from the first of the row before;
    backwards, they read what it made there. Further on in its row it touches none of theirs, so it may lag by one.
    """
    if step == 0:
        if before >= 0 and before < threads:
            until_ended(signals, before, rows + 1)
    if step == wp.static(EDGE):
        begun(signals, thread, rows + 1)
    if step == width - wp.static(EDGE):
        if behind >= 0 and behind < threads:
            until_begun(signals, behind, rows)


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    scalar = variant.scalar

    @wp.func
    def total(
        mine: scalar,
        slot: int,
        thread: int,
        threads: int,
        arrived: int,
        signals: wp.array(dtype=int),
        sums: wp.array(dtype=scalar),
    ) -> scalar:
        """Add up the sum over the threads, when all have come to it."""
        if threads == 1:
            return mine
        sums[threads * slot + thread] = mine
        barrier(signals, arrived)
        result = scalar(0.0)
        for k in range(threads):
            result += sums[threads * slot + k]
        return result

    return SimpleNamespace(total=total)
