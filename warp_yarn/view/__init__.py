"""What yarns look like: their curves and tubes, pictures, movies, and simulations in the browser.

Imports no simulator. Called, it shows one: ``wy.view(simulator)`` is ``view.live.view``.
"""

import sys
import types
from typing import Any


class _Callable(types.ModuleType):
    def __call__(self, simulator: Any, **options: Any) -> Any:
        from .live import view

        return view(simulator, **options)


sys.modules[__name__].__class__ = _Callable
