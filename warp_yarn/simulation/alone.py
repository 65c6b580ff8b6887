"""One thread at a time on a simulator, and none on one that an exception has left half done."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from ..device.exclusive import ALONE, compiling, refuse_recording


def alone(method: Callable) -> Callable:
    """Lets a method of a simulator, which has a ``lock`` and a ``stepper``, launch and copy."""

    @functools.wraps(method)
    def called_alone(self: Any, *arguments: Any, **options: Any) -> Any:
        with self.lock, ALONE, compiling():
            refuse_recording(self.stepper.model.device)
            self.stepper.settle()
            return method(self, *arguments, **options)

    return called_alone
