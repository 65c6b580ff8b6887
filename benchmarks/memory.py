"""How much memory this process uses, as Linux tells it."""

from __future__ import annotations

import ctypes
import gc
import os
import platform
from pathlib import Path

PROC = Path("/proc/self")

M_MMAP_THRESHOLD = -3
"""Of glibc's mallopt."""


def resident() -> int | None:
    """Memory of this process that is in use [bytes], None where the system does not tell."""
    try:
        pages = int((PROC / "statm").read_text().split()[1])
    except OSError:
        return None
    return pages * os.sysconf("SC_PAGE_SIZE")


def settle() -> None:
    """Gives memory that was freed back to the system, and has it be so from now on, so that growth shows."""
    gc.collect()
    if platform.libc_ver()[0] == "glibc":
        libc = ctypes.CDLL(None)
        libc.mallopt(M_MMAP_THRESHOLD, 1 << 14)
        libc.malloc_trim(0)


def forget_peak() -> None:
    """Starts ``peak`` anew, where the system allows it."""
    try:
        (PROC / "clear_refs").write_text("5")
    except OSError:
        return


def peak() -> int | None:
    """The most memory that was in use since ``forget_peak`` [bytes], None where the system does not tell."""
    try:
        lines = (PROC / "status").read_text().splitlines()
    except OSError:
        return None
    (kilobytes,) = (line.split()[1] for line in lines if line.startswith("VmHWM:"))
    return 1024 * int(kilobytes)
