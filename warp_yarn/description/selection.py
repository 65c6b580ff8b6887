"""Which terms a scene models, and the parameters of those that were registered."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError, choice, finite_array, real
from ..kernels import Term, TermParameter, in_order, own, parameters

if TYPE_CHECKING:
    from .scene import Scene


def selected_terms(scene: Scene, names: Sequence[str] | None) -> tuple[str, ...]:
    """Finds the terms to model: those that are named, or all that the scene has a use for."""
    if names is not None and (isinstance(names, str) or not isinstance(names, Iterable)):
        raise InputError(f"terms = {names!r}, must be a list of names")
    names = None if names is None else tuple(names)
    known = in_order()
    missing = {name: reason for name, term in known.items() if (reason := lacks(scene, term))}
    if names is None:
        values = scene.parameters
        given = {name for name, term in known.items() if any(p.name in values for p in term.parameters)}
        return tuple(name for name, term in known.items() if name not in missing and (own(term) or name in given))
    for name in names:
        choice("terms", name, known)
        if name in missing:
            raise InputError(f"terms names {name!r}, but {missing[name]}")
    return tuple(name for name in known if name in names or name == "mass")


def lacks(scene: Scene, term: Term) -> str:
    """Tells why the scene has no use for a term, or ""."""
    if term.sliding_only and not scene.sliding:
        return "yarns do not slide (sliding=False)"
    for parameter in () if own(term) else term.parameters:
        if parameter.default is None and parameter.name not in scene.parameters:
            return f"parameters has no {parameter.name!r}"
    return term.absent(scene) if term.absent is not None else ""


def checked_parameters(given: Any, materials: int) -> dict[str, Any]:
    """Checks {name: value}, each as ``checked_parameter`` leaves it."""
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise InputError(f"parameters = {given!r}, must be a dictionary, {{name: value}}")
    known = {p.name: p for term in in_order().values() if not own(term) for p in term.parameters}
    others, result = parameters(), {}
    for name, value in given.items():
        if name not in known and name in others:
            raise InputError(f"parameters names {name!r}, must be given to Yarn, Cloth, Wind or Scene by its argument")
        if name not in known:
            raise InputError(
                f"parameters names {name!r}, must be of a registered term: {', '.join(known) or 'there is none'}"
            )
        result[name] = checked_parameter(known[name], value, materials)
    return result


def checked_parameter(parameter: TermParameter, value: Any, materials: int) -> Any:
    """Checks a value of a term's parameter: a number, 3 numbers of a vector, or one for each material."""
    if parameter.size == 3:
        return tuple(finite_array(parameter.name, value, (3,)).tolist())
    if parameter.of == "yarn" and not np.isscalar(value):
        values = finite_array(parameter.name, value, (materials,)).tolist()
        return tuple(real(f"{parameter.name}[{k}]", v, **parameter.range) for k, v in enumerate(values))
    return real(parameter.name, value, **parameter.range)
