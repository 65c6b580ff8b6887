"""What can go wrong, as exceptions that say where, with which value, and what is allowed."""

import difflib
import functools
import importlib.metadata
import re
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

import numpy as np

from .moved import renamed

T = TypeVar("T")
LONGEST = 200
"""Characters of a value in a message."""


class WarpYarnError(Exception):
    """Every error that warp_yarn raises on purpose."""


class InputError(WarpYarnError, ValueError):
    """An argument or a file that cannot be used. The message names it, its value and what is allowed."""


class NoAttributeError(InputError, AttributeError):
    """An attribute that cannot be had, or cannot be set."""


class NoNameError(InputError, KeyError):
    """A name that nothing has. The message tells which there are, and which are near."""

    __str__ = Exception.__str__  # a KeyError's is its repr


class SimulationError(WarpYarnError, RuntimeError):
    """A step that could not be made.

    Attributes:
        step: number of the step, counted from 1 in this run.
        node: index of the node (column + row·columns), or -1 where no single node is to blame.
        term: name of the term that is largest or not finite there, or None.
        trajectory: the frames before it, ready to be written.
    """

    def __init__(self, message: str, *, step: int, node: int, term: str | None, trajectory: Any):
        super().__init__(message)
        self.step, self.node, self.term, self.trajectory = step, node, term, trajectory

    def __reduce__(self) -> tuple[Any, ...]:
        # Exceptions are pickled as their positional arguments alone, and a process would hang that is sent this one.
        numbers = {"step": self.step, "node": self.node, "term": self.term, "trajectory": self.trajectory}
        return functools.partial(type(self), **numbers), self.args, self.__dict__


class WarpYarnWarning(UserWarning):
    """What can be used and is likely not meant: a number in another unit, or a reading that pins turn."""


class GradientError(WarpYarnError, RuntimeError):
    """A gradient that could not be computed.

    Attributes:
        step: number of the step, counted from 1 in this run; 0 is the initial state; None: of no single step.
        term: the kernel whose reverse is to blame, or None.
    """

    def __init__(self, message: str, *, step: int | None, term: str | None):
        super().__init__(message)
        self.step, self.term = step, term

    def __reduce__(self) -> tuple[Any, ...]:  # as of a SimulationError
        return functools.partial(type(self), step=self.step, term=self.term), self.args, self.__dict__


def finite_array(name: str, value: Any, shape: tuple[int | None, ...]) -> np.ndarray:
    """Gives value as a new float64 array of the shape (None: any length), or an InputError."""
    try:
        given = np.asarray(value)
        if given.dtype.kind not in "biuf":  # NumPy would read text, and drop imaginary parts
            raise TypeError(f"of type {given.dtype}")
        array = np.array(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be an array of numbers, got {brief(value)}") from error
    wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
    if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
        raise InputError(f"{name} has shape {array.shape}, must be {wanted}")
    if not np.isfinite(array).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise InputError(f"{name}{list(where)} is {array[where]}, must be finite")
    return array


def real(name: str, value: Any, *, above: float | None = None, least: float | None = None) -> float:
    """Gives value as a finite float in the open (above) or closed (least) range, or an InputError."""
    allowed = "finite"
    if above is not None:
        allowed = f"finite and above {above:g}"
    if least is not None:
        allowed = f"finite and at least {least:g}"
    try:
        if isinstance(value, str | bytes | bool):
            raise TypeError("text, or true or false")
        result = float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name} = {brief(value)}, must be a number, {allowed}") from error
    if not np.isfinite(result) or (above is not None and result <= above) or (least is not None and result < least):
        raise InputError(f"{name} = {brief(value)}, must be {allowed}")
    return result


def integer(name: str, value: Any, *, least: int, most: int | None = None) -> int:
    """Gives value as an int of at least `least` and at most `most`, or an InputError."""
    wrong = isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least
    if wrong or (most is not None and value > most):
        allowed = f"at least {least}" if most is None else f"from {least} to {most}"
        raise InputError(f"{name} = {brief(value)}, must be a whole number, {allowed}")
    return int(value)


def flag(name: str, value: Any) -> bool:
    """Gives value as True or False, or an InputError: text such as "no" would be taken for True."""
    if not isinstance(value, bool | np.bool_):
        raise InputError(f"{name} = {brief(value)}, must be True or False")
    return bool(value)


def choice(name: str, value: Any, allowed: Iterable[str]) -> str:
    """Gives value, or an InputError where it is none of the allowed names."""
    names = list(allowed)
    if value not in names:
        raise InputError(_of_names(name, value, names))
    return value


def _of_names(name: str, value: Any, names: list[str]) -> str:
    """Tells which names are allowed, and which are near to a value that is none."""
    near = difflib.get_close_matches(value, names) if isinstance(value, str) else []
    return f"{name} = {brief(value)}, must be one of {', '.join(names)}" + (
        f"; near: {', '.join(near)}" if near else ""
    )


class Named(dict[str, T]):
    """Things by name, which tells the names that are near to one that is not there.

    Args:
        what: they are.
        things: by name.
    """

    def __init__(self, what: str, things: Mapping[str, T]):
        super().__init__(things)
        self.what = what

    def __missing__(self, name: Any) -> T:
        raise NoNameError(_of_names(self.what, name, list(self)))

    def attribute(self, name: str) -> T:
        """Gives one by its name, as an attribute of a module that has them; or a NoAttributeError."""
        if name.startswith("__"):
            raise AttributeError(name)
        try:
            return self[name]
        except NoNameError as error:
            raise NoAttributeError(str(error)) from None


def indices(name: str, value: Any, count: int, what: str) -> np.ndarray:
    """Gives value as an int32 array of distinct indices below count, or an InputError."""
    try:
        array = np.atleast_1d(np.asarray(value))
    except ValueError:  # ragged
        array = np.empty((1, 1))
    if array.size == 0:
        return np.zeros(0, dtype=np.int32)
    if array.ndim != 1 or not np.issubdtype(array.dtype, np.integer):
        raise InputError(f"{name} = {brief(value)}, must be a list of whole numbers, the {what}")
    outside = array[(array < 0) | (array >= count)]
    if outside.size:
        raise InputError(f"{name} names {what} {int(outside[0])}, must be from 0 to {count - 1}")
    if len(np.unique(array)) != len(array):
        raise InputError(f"{name} names a {what} twice: {brief(array.tolist())}")
    return array.astype(np.int32)


def brief(value: Any) -> str:
    """Shows a value in a few words: of arrays, and what prints as much, the kind and the shape."""
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    text = repr(value)
    if "\n" in text or "array(" in text:
        return f"an object of type {type(value).__name__}"
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}…"


def missing_extra(package: str, needed_by: str, extra: str) -> InputError:
    """Makes the error that says which extra is not installed, and how to install it: an index need not have
    warp_yarn, but it has what the extra is made of."""
    try:
        wanted = importlib.metadata.requires("warp_yarn") or []
    except importlib.metadata.PackageNotFoundError:
        wanted = []
    packages = [each.split(";")[0].strip() for each in wanted if re.search(rf"extra == ['\"]{extra}['\"]", each)]
    anywhere = " ".join(f'"{each}"' for each in packages) or package
    return InputError(
        f'{package} is not installed, which {needed_by}: pip install ".[{extra}]" in the clone of warp_yarn, or '
        f"pip install {anywhere}"
    )


__getattr__ = renamed(__name__, {"number": "real", "whole": "integer"})
