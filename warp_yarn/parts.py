"""Steps made in parts: those that cannot be made at once, and all of them where each may only be so far off."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from .arrays import STATE_TYPES
from .exclusive import ALONE
from .kernels.step import INACCURATE
from .model import Graphs, Model

SMALLEST = 2.0**-7
"""Of a step, where a part is halved because it cannot be made."""
SMALLEST_CONTROLLED = 2.0**-14
"""Of a step, where parts follow the error: a step is then what lies between two frames, and may be long."""
SAFETY = 0.9
"""Of the size at which a part would have the allowed error."""
MOST_GROWTH = 2.0
MOST_SHRINKAGE = 0.2
"""From a part to the next: the error need not be of third order in it."""


class Parts:
    """Makes a step in parts: each half of one that could not be made, or as large as its error allows.

    Args:
        model: with the state that a step starts from.
        method: the integrator, one with an error estimate where ``allowed`` is given.
        allowed: error of a part, as of ``error`` [m]; None: any.

    Attributes:
        size: of the next part, in steps; it follows the error from step to step.
        tried: size of the last part.
        made, rejected: parts made since the beginning, and those that were not good enough or could not be made.
    """

    def __init__(self, model: Model, method: Any, allowed: float | None):
        self.model, self.method, self.allowed = model, method, allowed
        self.reset()
        self._graphs = Graphs(model.device)

    def reset(self) -> None:
        """Begins anew, as for another motion."""
        self.size = self.tried = 1.0
        self.made = self.rejected = 0

    def make(self, count: Callable[[], None]) -> float:
        """Makes a step from the present state.

        Args:
            count: tells the device which frame the step starts from, before each part.

        Returns:
            The smallest part, in steps; 0 where one could not be made, and ``status`` says why.
        """
        step, done, smallest = self.model.step_size, 0.0, 1.0
        least = SMALLEST if self.allowed is None else SMALLEST_CONTROLLED
        while done < 1.0:
            left = 1.0 - done
            # as many of one size as fit; rounding is not to add another
            parts = max(1, math.ceil(left / self.size - 1e-9))
            size = self.tried = left / parts
            self._copy("kept_", "")
            count()
            self.method.set_times(size * step, left * step)
            self.method.advance()
            if not self._accepts(size):
                self.rejected += 1
                if self.size < least:
                    return 0.0
                self.model.arrays.put("status", 0, 0, 0)
                self._copy("", "kept_")
                continue
            self.made += 1
            smallest = min(smallest, size)
            done = 1.0 if parts == 1 else done + size
        return smallest

    def _accepts(self, size: float) -> bool:
        """Whether the part is good; says what size the next is to have."""
        if self.model.arrays["status"].numpy()[0]:
            self.size = 0.5 * size
            return False
        if self.allowed is None:
            return True
        ratio = self.error() / self.allowed
        factor = MOST_GROWTH if ratio == 0.0 else SAFETY * ratio ** (-1.0 / (self.method.order + 1))
        self.size = size * min(MOST_GROWTH, max(MOST_SHRINKAGE, factor))
        if ratio > 1.0:
            self.model.arrays.put("status", INACCURATE, -1, 0)
        return ratio <= 1.0

    def error(self) -> float:
        """Estimated error of the last part: how far the node is off that is farthest off [m]."""
        return float(self.model.arrays["step_error"].numpy()[0])

    def _copy(self, target: str, source: str) -> None:
        """The state, put by or brought back."""
        model, a = self.model, self.model.arrays
        moving = [name for name in STATE_TYPES if a[name] is not None]
        for name in moving:
            if f"kept_{name}" not in a:
                with ALONE:
                    a[f"kept_{name}"] = a.zeros(a[name].shape[0], a[name].dtype)
        self._graphs.run(target, lambda: model.copy(**{target + name: source + name for name in moving}))
