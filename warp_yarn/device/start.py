"""How Warp is started: without its banner, and without a warning of CUDA where there is none."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
import tempfile
from collections.abc import Iterator
from typing import Any

import warp as wp

from .exclusive import ALONE

NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"


def device(name: Any) -> Any:
    """Gives a device of Warp, which this starts where nobody has."""
    with ALONE:
        if wp._src.context.runtime is None:
            # whoever asks for more than the default is told
            level = wp.LOG_WARNING if wp.config.log_level == wp.LOG_INFO else wp.config.log_level
            with wp.ScopedLogLevel(level), without_line(NO_DRIVER, where=not _has_driver()):
                wp.init()
    return wp.get_device(name)


def _has_driver() -> bool:
    """Finds out whether there is a CUDA driver: then what Warp says of it is news."""
    try:
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return False
    return True


@contextlib.contextmanager
def without_line(text: bytes, *, where: bool) -> Iterator[None]:
    """Keeps lines with a text from stderr, that compiled code writes there in the block; the others come after it."""
    try:
        kept = os.dup(2) if where else -1
    except OSError:  # there is no stderr
        kept = -1
    if kept < 0:
        yield
        return
    with tempfile.TemporaryFile() as told:
        os.dup2(told.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            told.seek(0)
            for line in told:
                if text not in line:
                    os.write(2, line)
