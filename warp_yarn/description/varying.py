"""What acts on the cloth and varies: rows of steps, and functions of time or of place and time."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ..errors import InputError, finite_array

Varying = Any
"""3 numbers, steps × 3, or a function."""


def checked_vectors(name: str, value: Any) -> np.ndarray | Callable:
    """Gives 3 numbers, rows of steps [steps, 3], or a function as it is."""
    if callable(value):
        kind_of(name, value)
        return value
    try:
        rows = np.ndim(value) == 2
    except ValueError as error:  # ragged
        raise InputError(f"{name} must be 3 numbers, or steps × 3, got {value!r}") from error
    result = finite_array(name, value, (None, 3) if rows else (3,))
    if not len(result):
        raise InputError(f"{name} has no step, must have at least one")
    return result


def kind_of(name: str, function: Callable) -> str:
    """Tells what a function is of: "time", "place" (position, time) or, a wp.func of those, "device"."""
    if hasattr(function, "input_types") and hasattr(function, "native_func"):
        if len(function.input_types) != 2:
            raise InputError(f"{name} is a wp.func of {len(function.input_types)} arguments, must be (position, time)")
        return "device"
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} = {function!r}, whose arguments are not known: must be a def or lambda") from error
    needed = [p for p in parameters if p.default is p.empty and p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    if len(needed) not in (1, 2):
        raise InputError(f"{name} takes {len(needed)} arguments, must be of (time) or of (position, time)")
    return "time" if len(needed) == 1 else "place"


def evaluated(name: str, function: Callable, time: float, position: np.ndarray) -> np.ndarray:
    """Gives what a function says: 3 numbers, or of one of place and time [nodes, 3]."""
    if kind_of(name, function) == "time":
        return finite_array(f"{name}({time:g})", function(time), (3,))
    found = function(position, time)
    shape = (3,) if np.ndim(found) == 1 else (len(position), 3)
    return np.broadcast_to(finite_array(f"{name}(position, {time:g})", found, shape), position.shape)


def of_time(name: str, value: Any) -> Any:
    """Gives value; an InputError where it is a function of place, which this is not."""
    if callable(value) and kind_of(name, value) != "time":
        raise InputError(f"{name} is a function of place, must be one of time, or numbers")
    return value


def has_gusts(functions: Mapping[Any, Callable]) -> bool:
    """Tells whether the wind of a scene with these functions is another one at each node."""
    return "wind" in functions and kind_of("wind velocity", functions["wind"]) != "time"
