"""What Warp has once for a whole process, shared by threads and kept whole when Ctrl-C comes.

Warp 1.19 has one capture, one tape and one set of modules for all threads: what a thread launches, copies or allocates
while another captures a graph goes into that graph, or ends the process. So:

- who launches, copies, allocates or loads kernels holds ``ALONE``;
- who replays a captured graph does not: threads replay side by side, and a capture waits for all of them;
- locks are taken in one order: a simulator's own, then ``ALONE``. What is captured takes none.

Python raises KeyboardInterrupt between any two of its own operations, but never between a built-in lock's ``with`` and
its block: only such locks are used here, and captures run in a thread of their own, where no signal is handled.
"""

from __future__ import annotations

import _thread
import contextlib
import threading
import weakref
from collections.abc import Callable
from typing import Any

import warp as wp

from ..errors import InputError

ALONE = threading.RLock()
"""Held by whoever uses Warp otherwise than by replaying graphs."""

_thread_local = threading.local()
_registering = threading.Lock()
_replaying: weakref.WeakSet[Any] = weakref.WeakSet()
"""A lock for each thread that replays graphs, held while it does."""


def _own_lock() -> Any:
    try:
        return _thread_local.lock
    except AttributeError:
        with _registering:  # a capture holds it: new threads wait too
            lock = threading.RLock()
            _replaying.add(lock)
            _thread_local.lock = lock
        return lock


def replay(graph: Any) -> None:
    """Launches a captured graph."""
    with _own_lock():
        wp.capture_launch(graph)


def capture(device: Any, part: Callable[[], None]) -> Any:
    """Captures what a function launches.

    Returns:
        The graph.

    Raises:
        InputError: kernels cannot be compiled into Warp's kernel cache.
    """

    def captured() -> Any:
        with contextlib.ExitStack() as stack:
            stack.enter_context(_registering)
            for lock in list(_replaying):
                stack.enter_context(lock)
            with wp.ScopedCapture(device=device, force_module_load=False) as scope:
                part()
            return scope.graph

    with ALONE, compiling():
        return uninterrupted(captured)


@contextlib.contextmanager
def compiling() -> Any:
    """Names the folder where Warp cannot write the kernels that it compiles."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"kernels cannot be compiled into {wp.config.kernel_cache_dir} ({error}): give Warp a folder that can be "
            "written, by the environment variable WARP_CACHE_PATH"
        ) from error


def uninterrupted(function: Callable[[], Any]) -> Any:
    """Calls a function in a thread of its own, which Ctrl-C does not reach, and waits for its end in any case.

    Returns or raises what the function does, or what came while it was waited for.
    """
    claim, end = _thread.allocate_lock(), _thread.allocate_lock()
    end.acquire()
    result: list[Any] = []
    error: list[BaseException] = []

    def work() -> None:
        if not claim.acquire(blocking=False):
            return  # given up before it began
        try:
            result.append(function())
        except BaseException as raised:
            error.append(raised)
        finally:
            end.release()

    try:
        _thread.start_new_thread(work, ())
        end.acquire()
    finally:
        if not claim.acquire(blocking=False):
            while not result and not error:  # Ctrl-C again
                with contextlib.suppress(BaseException):
                    end.acquire(timeout=0.1)
    if error:
        raise error[0]
    return result[0]


def refuse_recording(device: Any) -> None:
    """Refuses to run where somebody else records what is launched: it would not run, or have no gradient.

    To be called with ``ALONE``: no capture or tape of ours is open then.

    Raises:
        InputError: a tape or a capture is open.
    """
    if device.is_capturing:
        raise InputError("a graph capture of Warp is open: a simulator captures its own, so use it outside")
    runtime: Any = wp._src.context.runtime
    if runtime.tape is not None:
        raise InputError("a wp.Tape is open: it would not see a simulation; for gradients use warp_yarn.torch")
