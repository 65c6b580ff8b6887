"""Files that appear whole or not at all."""

import contextlib
import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

from ..errors import InputError
from ..moved import renamed


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
    with _tidied_up():
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


@contextlib.contextmanager
def _tidied_up() -> Iterator[None]:
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


__getattr__ = renamed(__name__, {"whole_file": "atomic_write"})
