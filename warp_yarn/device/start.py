"""How Warp is started: without its banner, lines of modules, and a warning of CUDA where there is none."""

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


def be_quiet() -> None:
    """Leaves out what Warp tells by default, a banner and a line for each module that it loads, until somebody asks for
    it: ``wp.config.log_level = wp.LOG_INFO`` after warp_yarn is imported. Another level stays as it is."""
    if wp.config.log_level == wp.LOG_INFO:
        wp.config.log_level = wp.LOG_WARNING


def device(name: Any) -> Any:
    """Gives a device of Warp, which this starts where nobody has."""
    with ALONE:
        if wp._src.context.runtime is None:
            with without_line(NO_DRIVER, where=not _has_driver()):
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
