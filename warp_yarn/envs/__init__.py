"""Tasks to learn by control, as Gymnasium environments. Needs the extra ``rl``.

Importing this registers them: ``gymnasium.make("warp_yarn.envs:warp_yarn/ThrowIntoBox-v0")`` imports it by itself. The
task's scene, loss and test of success, in ``box``, need no Gymnasium.
"""

from __future__ import annotations

import importlib.util
from typing import Any

from ..errors import NoAttributeError, missing_extra

NAME = "warp_yarn/ThrowIntoBox-v0"

if importlib.util.find_spec("gymnasium") is not None:
    import gymnasium

    gymnasium.register(NAME, entry_point="warp_yarn.envs.throw:ThrowIntoBox")


def __getattr__(name: str) -> Any:
    """Imports the environment when it is asked for."""
    if name != "ThrowIntoBox":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        from .throw import ThrowIntoBox
    except ModuleNotFoundError as error:
        if error.name != "gymnasium":
            raise
        # what hasattr and getattr with a default take for an answer
        raise NoAttributeError(str(missing_extra("gymnasium", "environments need", "rl"))) from error
    return ThrowIntoBox
