"""Methods by their Butcher tableau."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..errors import InputError, finite_array
from .stage import StageMethod

ROUNDING = 1e-12
"""Of a tableau's numbers."""


def sdirk(name: str, a: Any, b: Any) -> type[StageMethod]:
    """Make a method of one or two implicit stages of its Butcher tableau, for ``wy.register_integrator``.

    Supported are singly diagonally implicit methods with b₁ + b₂ = 1 that are A-stable, since yarns are stiff:

        γ | γ               γ | γ
          | 1, γ ≥ 1/2      1 | 1 − γ  γ
                              | 1 − γ  γ,   1 − 1/√2 ≤ γ ≤ 1 + 1/√2, γ ≠ 1

    Two stages are stiffly accurate: the last row of a is b. One stage is of order 2 where γ = 1/2, two where
    γ = 1 ± 1/√2; else of order 1. "sdirk2" is the one of 1 − 1/√2, "implicit-midpoint" and "implicit-euler" are those
    of one stage with γ = 1/2 and 1.

    Args:
        name: of the method.
        a: coefficients of the stages [stages, stages], stages 1 or 2.
        b: weights of the stages [stages].

    Raises:
        InputError: a tableau that is not supported; the message says which condition it breaks.
    """
    supported = "must be a singly diagonally implicit, A-stable method of one stage, or of two, stiffly accurate"
    weights = finite_array("b", b, (None,))
    stages = len(weights)
    if stages not in (1, 2):
        raise InputError(f"b has {stages} stages, {supported}")
    matrix = finite_array("a", a, (stages, stages))
    gamma = float(matrix[0, 0])
    if np.triu(matrix, 1).any():
        raise InputError(f"a = {matrix.tolist()}, {supported}: it has numbers above its diagonal")
    if np.abs(np.diag(matrix) - gamma).max() > ROUNDING:
        raise InputError(f"a = {matrix.tolist()}, {supported}: the numbers on its diagonal differ")
    if abs(weights.sum() - 1.0) > ROUNDING:
        raise InputError(f"b = {weights.tolist()}, must add up to 1, or the method would not converge")
    least, most = (0.5, math.inf) if stages == 1 else (1.0 - 0.5**0.5, 1.0 + 0.5**0.5)
    if not least - ROUNDING <= gamma <= most + ROUNDING:
        raise InputError(f"a[0][0] = {gamma:g}, {supported}: A-stable is {least:.6g} to {most:.6g}")
    if stages == 2 and np.abs(matrix[1] - weights).max() > ROUNDING:
        raise InputError(f"b = {weights.tolist()}, {supported}: stiffly accurate is b = a[1], {matrix[1].tolist()}")
    if stages == 2 and abs(weights[0]) <= ROUNDING:
        raise InputError("a[1][0] = 0: the first stage has no part in the step, must be another number")
    order = 2 if abs(float(weights @ matrix.sum(axis=1)) - 0.5) <= ROUNDING else 1
    # one stage of γ = 1 is the step's end itself
    carried = float(weights[0]) if stages == 2 else float(abs(gamma - 1.0) > ROUNDING)
    values = {
        "__doc__": f"The method of the Butcher tableau a = {matrix.tolist()}, b = {weights.tolist()}.",
        "name": name,
        "order": order,
        "fraction": gamma,
        "carried": carried,
        "stages": stages,
        "fallback": "implicit-euler" if stages == 2 else None,
    }
    if stages == 2 and order == 2 and carried > 0.0:
        # z³ of the stability function (1 + (1 − 2γ) z)/(1 − γ z)² less that of exp
        values["local_error"] = 3.0 * gamma**2 - 2.0 * gamma**3 - 1.0 / 6.0
    return type("".join(part.capitalize() for part in str(name).split("-")), (StageMethod,), values)
