"""What the data leave open where the loss does not change as the Jacobian says: runs at other values tell.

``uncertainty`` takes the model for linear over its standard deviations. Here that is looked at, and where it is not so,
the other parameters are learned anew with one held, by another ``LevenbergMarquardt``.
"""

from __future__ import annotations

import numpy as np

from ..errors import SimulationError
from .differences import missed_by_the_step
from .levenberg_marquardt import LevenbergMarquardt
from .uncertainty import DETERMINED_DEVIATION, Uncertainty

PROBED_DEVIATIONS = 3.0
"""How far a parameter is moved to see whether the model is linear [standard deviations], and by which factor further
[1]."""

FURTHEST = 0.5
"""How far it is moved at most [ranges]."""

LINEARITY_TOLERANCE = 2.0
"""How far the loss may be from what the Jacobian says, of a rise by 9, to count as linear [variances of a residual]."""

SUSPECT_PART = 0.1
"""Part of the step's error of unknown shape above which other values are allowed their own step's error [1]."""

PROBING_ITERATIONS = 10
"""Iterations in which other values are to show how good they are."""


def probed(search: LevenbergMarquardt, now: Uncertainty) -> np.ndarray:
    """Estimates standard deviations of the data as the loss shows them, where the model does not respond linearly [p].

    Each determined parameter is moved by three of them, to where it has more room, and the others with it. Where the
    loss does not change as the Jacobian says, the others are learned anew there, and further away too, as far as half
    of the range: a rise by n variances of a residual tells a deviation of 1/√n of the way.
    """
    problem, result = search.problem, now.of_data.copy()
    for k, deviation in enumerate(now.of_data):
        side, reach = (1.0 if search.y[k] < 0.5 else -1.0), PROBED_DEVIATIONS * deviation
        start = np.clip(search.y + side * reach * now.covariance[:, k] / now.covariance[k, k], 0.0, 1.0)
        if deviation >= DETERMINED_DEVIATION or is_linear(search, start, now):
            continue
        while result[k] < DETERMINED_DEVIATION:
            move = min(reach, FURTHEST)
            start[k] = search.y[k] + side * move
            rise, values = rise_at(search, k, problem.physical(start), now)
            away = np.abs(values - search.values) / problem.width
            result = np.maximum(result, away / np.sqrt(max(rise, 1.0)))
            if move == FURTHEST:
                break
            reach, start = PROBED_DEVIATIONS * reach, problem.scaled(problem.start)
    return result


def is_linear(search: LevenbergMarquardt, y: np.ndarray, now: Uncertainty) -> bool:
    """Tells whether the loss there is what the Jacobian says, but for some variances of a residual."""
    expected = search.residuals + search.jacobian @ (y - search.y)
    try:
        residuals = search.problem.residuals(search.problem.physical(y))
    except SimulationError:
        return False
    return abs(residuals @ residuals - expected @ expected) < LINEARITY_TOLERANCE * now.variance


def rise_at(search: LevenbergMarquardt, k: int, values: np.ndarray, now: Uncertainty) -> tuple[float, np.ndarray]:
    """Learns the others from these values on with k held, as long as the loss is too high.

    Returns:
        How many variances the loss rises by that the step's error does not allow, and the values [p].
    """
    problem = search.problem
    suspect = now.unexplained > SUSPECT_PART
    allowed = now.moved**2 if suspect else 0.0

    def rise(residuals: np.ndarray) -> float:
        return (residuals @ residuals - search.loss - allowed) / now.variance

    try:
        residuals = problem.residuals(values)
        if rise(residuals) > 1.0 and len(values) > 1:
            other = LevenbergMarquardt(problem.held(k, values), search.resolution, halvings=0)
            other.begin()
            while rise(other.residuals) > 1.0 and len(other.history) <= PROBING_ITERATIONS and other.advance() is None:
                pass
            problem.simulations = other.problem.simulations
            values, residuals = np.insert(other.values, k, values[k]), other.residuals
        result = rise(residuals)
        if result > 1.0 and suspect:
            # the step's error there, which may be greater
            there = now.unexplained**2 * float(np.sum(missed_by_the_step(problem, values, residuals) ** 2))
            result -= max(0.0, there - allowed) / now.variance
    except SimulationError:
        return np.inf, values
    return result, values
