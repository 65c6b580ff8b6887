"""Processor cores that share a model's linear solves: the host's side of ``kernels/linear/threads.py``."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from ..description.cloths import Cloths
from ..errors import InputError
from . import declarations

if TYPE_CHECKING:
    from .model import Model

NARROWEST = 8
"""Columns of a thread's part of the cloth; the sweeps need 3 at least, and fewer than these do not pay."""
SOLVED = ("rhs", "euler_rhs", "tolerance", "solution", "euler_solution")
"""Arrays that differ from one linear solve to another."""
COUNT, WAITING, ENDED = 3, 4, 2
"""Places in the array of signals: how many threads, the last helper to wait, whether helpers are to end."""


class Threads:
    """The threads of a model.

    Args:
        model: the model.
        asked: how many threads are wanted.

    Attributes:
        count: how many share a solve, each a part of the cloth's columns.

    Raises:
        InputError: more than one where a solve cannot be shared.
    """

    def __init__(self, model: Model, asked: int):
        self.model = model
        a = model.arrays
        if asked > 1 and not (model.device.is_cpu and model.preconditioner != "jacobi"):
            raise InputError(
                f"threads = {asked}, must be 1 on {model.device} with the {model.preconditioner!r} preconditioner: "
                "only the CPU's 'incomplete' and 'multilevel' ones share their work"
            )
        cloth = model.scene.cloth
        if asked > 1 and cloth.columns == cloth.nodes:
            what = "several cloths" if isinstance(cloth, Cloths) else "a cloth that is cut"
            raise InputError(f"threads = {asked} with {what}, must be 1: threads share the columns of a rectangle")
        self.count = max(1, min(asked, a["columns"] // NARROWEST))
        a.sizes |= {"thread": self.count, "signal": 16 + 16 * self.count}
        a.make(declarations.LINEAR_WORKSPACE)
        self._begin_anew(1)
        if self.count > 1:
            a.make(declarations.THREADS_WORKSPACE)

    def _begin_anew(self, count: int) -> None:
        """Begin to count signals anew, for so many threads."""
        signals = self.model.arrays["signals"]
        signals.assign(np.where(np.arange(len(signals)) == COUNT, count, 0).astype(np.int32))

    def solve(self, arrays: dict[str, Any]) -> None:
        """Launch the first thread's part of a solve; the helpers were launched before, with arrays of their own."""
        model, own = self.model, self._own()
        for name, array in arrays.items():
            model.arrays.copy_into(own[name], array)
        model.launch_solve(0, own)
        for name in ("solution", "euler_solution"):
            model.arrays.copy_into(arrays[name], own[name])

    def _own(self) -> dict[str, Any]:
        return {name: self.model.arrays[f"helper_{name}"] for name in SOLVED}

    @contextlib.contextmanager
    def at_hand(self) -> Iterator[None]:
        """Keep the helpers at hand for linear solves, for as long as a block lasts."""
        if self.count == 1:
            yield
            return
        self._begin_anew(self.count)
        signals = self.model.arrays["signals"].numpy()  # on the CPU the array itself
        helpers = []
        try:
            for thread in range(1, self.count):
                arguments = (thread, self._own())
                helpers.append(threading.Thread(target=self.model.launch_solve, args=arguments, daemon=True))
                helpers[-1].start()
                while signals[WAITING] != thread and helpers[-1].is_alive():
                    time.sleep(1e-5)
            yield
        finally:
            signals[ENDED] = 1
            for helper in helpers:
                helper.join()
            self._begin_anew(1)
