"""Solves that take along what compressed yarns take from the matrix (``kernels/linear/beside.py``)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp

from ..device import declarations
from ..device.model import Model


class Compression:
    """What compressed yarns take from the matrix of a stage, where it is asked for.

    Args:
        model: the model.
    """

    def __init__(self, model: Model):
        self.model = model
        # crimp interchange stretches yarns by another law, and the Jacobi preconditioner is there to compare with
        self._sees = "stretch" in model.scene.terms and model.preconditioner != "jacobi"
        if model.arrays["before"] is None:
            a = model.arrays
            a.conditions.add("Newton's iteration")
            a.make(declarations.COMPRESSION)
            segments = a["segments"].numpy()
            before = np.full(2 * a["nodes"], -1, dtype=np.int32)
            before[2 * segments[:, 1] + segments[:, 3]] = segments[:, 0]
            a["before"].assign(before)

    def find(self) -> None:
        """Finds it at the present state, for the solves to come."""
        if self._sees:
            self.model.arrays.zero("compressed")
            self.model.launch("find_compression", "segments")

    def forget(self) -> None:
        """Leaves it out of the solves to come."""
        if self._sees:
            self.model.arrays.zero("compressed")

    def solve(self, solve: Callable[[], None]) -> None:
        """Launches a solve, and once more without it where the matrix is indefinite with it.

        Args:
            solve: launches it, from its start.
        """
        solve()
        if self._sees:
            wp.capture_if(self.model.arrays["indefinite"], on_true=lambda: self._solve_without(solve))

    def _solve_without(self, solve: Callable[[], None]) -> None:
        self.model.arrays.zero("compressed", "indefinite")
        solve()
