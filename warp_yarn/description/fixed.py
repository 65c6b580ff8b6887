"""What cannot be changed once it is made."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ..errors import InputError, NoAttributeError


class Fixed:
    """What cannot be changed once it is made: simulators take its values when they are made themselves."""

    _arguments: dict[str, Any]
    """All that it was made of."""

    def _fix(self, **arguments: Any) -> None:
        """Ends the making: arrays and attributes are read-only from now on."""
        self._arguments = arguments
        for value in vars(self).values():
            for part in value if isinstance(value, tuple) else (value,):
                if isinstance(part, np.ndarray):
                    part.setflags(write=False)

    def __setattr__(self, name: str, value: Any) -> None:
        if "_arguments" in vars(self):
            self._refuse_setting(name, value)
        super().__setattr__(name, value)

    def _refuse_setting(self, name: str, value: Any) -> None:
        kind = type(self).__name__
        raise NoAttributeError(
            f"{kind.lower()}.{name} cannot be set: a {kind} does not change once it is made, and simulators would "
            f"not know; make another one, such as by {kind.lower()}.replace({name}=...)"
        )

    def __delattr__(self, name: str) -> None:
        raise NoAttributeError(f"{type(self).__name__.lower()}.{name} cannot be deleted")

    def replace(self, **changes: Any) -> Any:
        """Makes another one, of the same arguments but for these.

        Raises:
            InputError: an argument that there is not, or a value that does not go with the others.
        """
        for name in changes:
            if name not in self._arguments:
                raise InputError(f"replace({name}=...): must be one of {', '.join(self._arguments)}")
        return type(self)(**{**self._arguments, **changes})


def says_why(cls: type) -> type:
    """Decorates a frozen dataclass: setting an attribute tells how to make another one, as of a ``Fixed``."""
    cls.__setattr__ = Fixed._refuse_setting  # type: ignore[method-assign,assignment]
    cls.__delattr__ = Fixed.__delattr__  # type: ignore[method-assign,assignment]
    return cls


class Replaceable:
    """A frozen dataclass that can be made again with other values."""

    def replace(self, **changes: Any) -> Any:
        """Makes another one, of the same values but for these.

        Raises:
            InputError: a name that there is not, or a value that is not allowed.
        """
        names = [field.name for field in dataclasses.fields(self)]  # type: ignore[arg-type]
        for name in changes:
            if name not in names:
                raise InputError(f"replace({name}=...): must be one of {', '.join(names)}")
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]
