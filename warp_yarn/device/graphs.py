"""Captured graphs of a model's launches."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from . import exclusive


class GraphCache(dict[str, Any]):
    """Launches by name, captured at their first call and replayed from then on: twenty of them cost microseconds."""

    def __init__(self, device: Any):
        super().__init__()
        self.device = device

    def run(self, name: str, part: Callable[[], None]) -> None:
        """Launches what a function launches; the function is called the first time alone."""
        if name not in self:
            self[name] = exclusive.capture(self.device, part)
        exclusive.replay(self[name])
