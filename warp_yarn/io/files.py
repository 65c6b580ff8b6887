"""Files that appear whole or not at all."""

import contextlib
import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..moved import renamed

try:
    import resource
except ImportError:  # Windows has none
    resource = None  # type: ignore[assignment]


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike) -> Iterator[Path]:
    """Gives a temporary path with the ending of `path`, and moves it there when the block ends without an error.

    A link is followed: what it leads to is replaced. SIGTERM ends the block as Ctrl-C does, and leaves nothing behind.

    Raises:
        InputError: the folder does not exist.
        OSError: it cannot be written, or is full.
    """
    check_writable(path)
    target = Path(os.path.realpath(path))
    with ended_by_exception():
        folder = tempfile.mkdtemp(dir=target.parent, prefix=f".{target.stem}-")
        try:
            temporary = Path(folder) / target.name
            yield temporary
            os.replace(temporary, target)
        except OSError as error:
            if error.errno is None or error.filename is not None:
                raise
            # what a write raises does not know its file
            raise OSError(error.errno, error.strerror, str(path)) from error
        finally:
            shutil.rmtree(folder, ignore_errors=True)


def check_writable(path: str | os.PathLike) -> None:
    """Finds out whether a file can be made or replaced, before there is anything to lose.

    Raises:
        InputError: the folder does not exist, or the path is one itself.
        OSError: nothing can be written there.
    """
    target = Path(os.path.realpath(path))
    if not target.parent.is_dir():
        raise InputError(f"{path}: the folder {target.parent} does not exist, make it first")
    if target.is_dir():
        raise InputError(f"{path}: is a folder, must be a file")
    try:
        with tempfile.TemporaryFile(dir=target.parent):
            pass
    except OSError as error:
        raise OSError(f"{path}: nothing can be written into its folder ({error})") from error


def room(path: Path) -> float:
    """Finds how many bytes a file can still grow by: on its disk, and by the limit of the process."""
    free: float = shutil.disk_usage(path.parent).free
    if resource is not None:
        limit, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
        if limit != resource.RLIM_INFINITY:
            free = min(free, limit - (path.stat().st_size if path.exists() else 0))
    return free


@contextlib.contextmanager
def ended_by_exception() -> Iterator[None]:
    """Turns SIGTERM into SystemExit, where nobody has other plans with it; only the main thread can."""
    mine = threading.current_thread() is threading.main_thread()
    if not mine or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return

    def end(number: int, frame: object) -> None:
        raise SystemExit(128 + number)

    signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


@contextlib.contextmanager
def deferred() -> Iterator[None]:
    """Lets Ctrl-C and SIGTERM wait until the block has ended; only the main thread can, and no other gets any."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[tuple[int, Any]] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    # None: set by no Python code, which could not be put back
    mine = {number: handler for number, handler in before.items() if callable(handler)}
    for number in mine:
        signal.signal(number, lambda number, frame: came.append((number, frame)))
    try:
        yield
    finally:
        for number, handler in mine.items():
            signal.signal(number, handler)
        for which, frame in came[:1]:
            mine[signal.Signals(which)](which, frame)


__getattr__ = renamed(__name__, {"whole_file": "atomic_write"})
