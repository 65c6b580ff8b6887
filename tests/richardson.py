"""Derivatives by differences that say how good they are."""

import itertools
from collections.abc import Callable

import numpy as np


def richardson(function: Callable[[float], float], x: float, scale: float) -> tuple[float, float]:
    """Derivative by central differences, extrapolated, at the step where it agrees best with itself; and its error,
    which is not less than what rounding leaves: at short steps values agree by chance."""
    best = (0.0, np.inf)
    rounding = 1e-14 * abs(function(x))
    for step in scale * np.array([0.1, 0.03, 0.01, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5]):
        table = [[(function(x + h) - function(x - h)) / (2.0 * h) for h in step / 2.0 ** np.arange(4)]]
        for m in (1, 2, 3):
            coarse = table[-1]
            table.append([(4**m * b - a) / (4**m - 1) for a, b in itertools.pairwise(coarse)])
            for k, value in enumerate(table[-1]):
                error = max(abs(value - coarse[k]), abs(value - coarse[k + 1]), rounding / (step / 8.0))
                if error < best[1]:
                    best = (value, error)
    return best
