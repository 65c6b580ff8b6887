"""Steps made in parts: those that cannot be made at once, and all of them where each may only be so far off.

A part that gains energy is made by the method's fallback, which damps. So is one that cannot be made however small.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from ..device.arrays import MOVING
from ..device.exclusive import ALONE
from ..device.graphs import GraphCache
from ..device.model import Model
from ..kernels.core.status import CROWDED, GAINED, IMPACT, INACCURATE
from ..moved import renamed, renamed_attribute

SMALLEST = {"double": 2.0**-10, "single": 2.0**-7}
"""Of a step, where a part is halved because it cannot be made. In single precision rounding ends shorter ones."""
SMALLEST_CONTROLLED = 2.0**-14
"""Of a step, where parts follow the error: a step is then what lies between two frames, and may be long."""
SAFETY = 0.9
"""Of the size at which a part would have the allowed error."""
MOST_GROWTH = 2.0
MOST_SHRINKAGE = 0.2
"""From a part to the next: the error need not be of third order in it."""


class Substepping:
    """Makes a step in parts: each half of one that could not be made, or as large as its error allows.

    Args:
        model: with the state that a step starts from.
        method: the integrator, one with an error estimate where ``allowed`` is given.
        allowed: error of a part, which ``error`` estimates [m]; None: any.
        fallback: makes the method for parts that gain energy; None: there is none.

    Attributes:
        next_size: of the next part, in steps; it follows the error from step to step.
        last_size: of the last part, in steps.
        accepted, rejected: parts made since the beginning, and those that were not good enough or could not be made.
        damped: parts that the fallback made.
        watcher: called after every part that was made, with the method, the part's size and what was left of the step
            before it, in steps. The state is at its end then, and ``kept_position`` and so on are its start.
    """

    def __init__(self, model: Model, method: Any, allowed: float | None, fallback: Callable[[], Any] | None = None):
        self.model, self.method, self.allowed = model, method, allowed
        self._make_fallback: Any = fallback
        self._fallback: Any = None
        self.watcher: Callable[[Any, float, float], None] | None = None
        self.reset()
        self._graphs = GraphCache(model.device)

    def reset(self) -> None:
        """Begins anew, as for another motion."""
        self.next_size = self.last_size = 1.0
        self.accepted = self.rejected = self.damped = 0

    @property
    def counts(self) -> tuple[float, int, int, int]:
        """What a step in parts changes: next_size, accepted, rejected and damped."""
        return self.next_size, self.accepted, self.rejected, self.damped

    @counts.setter
    def counts(self, counts: tuple[float, int, int, int]) -> None:
        self.next_size, self.accepted, self.rejected, self.damped = counts

    def forget_graphs(self) -> None:
        """Captures anew, after arrays have changed their place."""
        self._graphs.clear()
        if self._fallback is not None:
            self._fallback.forget_graphs()

    def make(self, count: Callable[[], None], make_room: Callable[[], None], *, gained: bool = False) -> float:
        """Makes a step from the present state.

        Args:
            count: tells the device which frame the step starts from, before each part.
            make_room: for more that is near, where a part finds more than there is room for.
            gained: whether the whole step was seen to gain energy.

        Returns:
            The smallest part, in steps; 0 where one could not be made, and ``status`` says why.
        """
        done, smallest = 0.0, 1.0
        # what a rejected part has put by is put back, but an account that it opened
        self._graphs.run("open", self.model.begin_step)
        least = SMALLEST[self.model.precision] if self.allowed is None else SMALLEST_CONTROLLED
        while done < 1.0:
            left = 1.0 - done
            # as many of one size as fit; rounding is not to add another
            parts = max(1, math.ceil(left / self.next_size - 1e-9))
            size = self.last_size = left / parts
            self._copy("kept_", "")
            method, accepted = self.method, not gained and self._try(self.method, count, make_room, size, left)
            if not accepted and self._is_to_damp(gained, least):
                gained = False
                self._restore()
                accepted = self._damp(count, make_room, size, left, last=0.5 * size < least)
                method = self._fallback
            if not accepted:
                self.rejected += 1
                if self.next_size < least:
                    return 0.0
                self._restore()
                continue
            self.accepted += 1
            if self.watcher is not None:
                self.watcher(method, size, left)
            smallest = min(smallest, size)
            done = 1.0 if parts == 1 else done + size
        return smallest

    def _try(
        self, method: Any, count: Callable[[], None], make_room: Callable[[], None], size: float, left: float
    ) -> bool:
        """Makes a part, and says whether it is good."""
        count()
        method.set_times(size * self.model.step_size, left * self.model.step_size)
        method.advance()
        while self._status() == CROWDED:
            make_room()
            self._restore()
            count()
            method.advance()
        if method is self.method:
            return self._accepts(size)
        self.next_size = size if self._status() == 0 else 0.5 * size
        return self._status() == 0

    def _is_to_damp(self, gained: bool, least: float) -> bool:
        """Tells whether the fallback is to make the part: it gains energy, has an impact, or could not be made
        and is the smallest."""
        if not self.can_damp or self._status() == INACCURATE:
            return False
        return gained or self._status() in (GAINED, IMPACT) or self.next_size < least

    def _damp(
        self, count: Callable[[], None], make_room: Callable[[], None], size: float, left: float, *, last: bool
    ) -> bool:
        """Makes a part by the fallback, and says whether it is good. The last resort, which cannot be halved, may gain
        more."""
        if self._fallback is None:
            with ALONE:
                self._fallback = self._make_fallback()
        self.model.arrays.put("damps", 2 if last else 1)
        accepted = self._try(self._fallback, count, make_room, size, left)
        self.model.arrays.put("damps", 0)
        self.damped += accepted
        return accepted

    @property
    def can_damp(self) -> bool:
        """Whether there is a fallback."""
        return self._make_fallback is not None

    def _status(self) -> int:
        return int(self.model.arrays["status"].numpy()[0])

    def _restore(self) -> None:
        """Goes back to where the part started."""
        self.model.arrays.put("status", 0, 0, 0)
        self._copy("", "kept_")
        # the bounds of energy may be those from before the run's first audit
        self.model.arrays.put("audit_due", 1)

    def _accepts(self, size: float) -> bool:
        """Tells whether the part is good, and sets the size that the next is to have."""
        if self._status():
            self.next_size = 0.5 * size
            return False
        if self.allowed is None:
            return True
        ratio = self.error() / self.allowed
        factor = MOST_GROWTH if ratio == 0.0 else SAFETY * ratio ** (-1.0 / (self.method.order + 1))
        self.next_size = size * min(MOST_GROWTH, max(MOST_SHRINKAGE, factor))
        if ratio > 1.0:
            self.model.arrays.put("status", INACCURATE, -1, 0)
        return ratio <= 1.0

    def error(self) -> float:
        """Estimates the error of the last part: how far the node is off that is farthest off [m]."""
        return float(self.model.arrays["step_error"].numpy()[0])

    def _copy(self, target: str, source: str) -> None:
        """Puts the state by, or brings it back."""
        model, a = self.model, self.model.arrays
        moving = [name for name in (*MOVING, "bounds") if a.get(name) is not None]
        for name in moving:
            if f"kept_{name}" not in a:
                with ALONE:
                    a[f"kept_{name}"] = a.zeros(a[name].shape[0], a[name].dtype)
        self._graphs.run(target, lambda: model.copy(**{target + name: source + name for name in moving}))

    size = renamed_attribute("size", "next_size")
    tried = renamed_attribute("tried", "last_size")
    made = renamed_attribute("made", "accepted")


__getattr__ = renamed(__name__, {"Parts": "Substepping"})
