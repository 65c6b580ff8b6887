"""What changes a problem's residuals, by differences of runs: the parameters (the Jacobian), and the model's step.

A solver that ends within its tolerance leaves something of every run, and a difference of two runs shows that too. So
what may be no more than that is compared with a wider one, until two agree.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..errors import SimulationError

if TYPE_CHECKING:
    from .problem import CalibrationProblem

WIDTH = 1e-4
"""Width of differences [ranges]: curvature adds about as much of a derivative to it."""

WIDENING, LARGEST_WIDTH = 30.0, 0.1
"""Where differences may be what the solver leaves of runs, and do not agree with their neighbours, they are taken so
many times as wide [1], and so wide at most [ranges]."""

TINY_WIDTH = 1e-8
"""A change of all values that changes little but what the solver leaves [ranges]."""

CLEARLY_MORE = 30.0
"""A change of residuals that is so many times what one run shows that the solver leaves is a change [1]."""

SURELY_MORE = 1e-6
"""So is one that is this part of the nodes' paths [1]: of light, stiff yarns the solver sometimes leaves much more than
one run shows."""

AGREEMENT = 0.25
"""Two differences agree that are no further apart than this part of their sum [1]."""


def jacobian(problem: CalibrationProblem, values: np.ndarray, residuals: np.ndarray) -> np.ndarray:
    """Estimates ∂residuals/∂y [residuals, parameters], y = (value − low)/(high − low).

    A run a parameter, and one that shows what the solver leaves. A difference that may be no more than that is
    compared with one from there on, and taken wider until the two agree; 0 where the widest have nothing in common.

    Args:
        values: where.
        residuals: there.

    Raises:
        SimulationError: the model can be simulated on neither side.
    """
    inwards = np.where(values < 0.5 * (problem.low + problem.high), 1.0, -1.0)
    moves = np.diag(inwards)
    columns = [difference(problem, values, residuals, WIDTH, move) for move in moves]
    tiny = difference(problem, values, residuals, TINY_WIDTH, inwards)
    left = TINY_WIDTH * float(np.linalg.norm(tiny - np.sum(columns, axis=0)))
    for k, move in enumerate(moves):
        if WIDTH * np.linalg.norm(columns[k]) < max(CLEARLY_MORE * left, SURELY_MORE * problem.path):
            columns[k] = confirmed(problem, values, residuals, columns[k], move)
    return np.stack(columns, axis=1) * inwards


def confirmed(
    problem: CalibrationProblem, values: np.ndarray, residuals: np.ndarray, column: np.ndarray, move: np.ndarray
) -> np.ndarray:
    """Finds a difference by ``move`` that another agrees with, beginning with a column of the usual width."""
    width = WIDTH
    while True:
        try:
            both = difference(problem, values, residuals, 2.0 * width, move)
        except SimulationError:  # so far from here the model fails: what there is must do
            return column
        # the other is 2 both − column
        apart, together = np.linalg.norm(2.0 * (both - column)), np.linalg.norm(2.0 * both)
        if apart < AGREEMENT * together:
            return both
        if width == LARGEST_WIDTH:
            return both if apart < together else np.zeros_like(both)
        width = min(WIDENING * width, LARGEST_WIDTH)
        try:
            column = difference(problem, values, residuals, width, move)
        except SimulationError:
            return both


def difference(
    problem: CalibrationProblem, values: np.ndarray, residuals: np.ndarray, width: float, move: np.ndarray
) -> np.ndarray:
    """Computes (r(y + width · move) − r(y))/width; with −width where the model fails and there is room on that side."""
    change = width * move * problem.width
    try:
        return (problem.residuals(values + change) - residuals) / width
    except SimulationError:
        if np.any(values - change < problem.low) or np.any(values - change > problem.high):
            raise
        return (problem.residuals(values - change) - residuals) / -width


def missed_by_the_step(problem: CalibrationProblem, values: np.ndarray, residuals: np.ndarray) -> np.ndarray:
    """Estimates what the residuals at these values would gain if the step went to 0 [residuals]; 0 if unknown.

    From a run with half the step, by the method's order.
    """
    problem.simulations += 2 * problem.cost
    try:
        finer = problem.trajectory(values, refine=2).position[1:]
    except SimulationError:
        return np.zeros(len(residuals))
    offset = (finer - problem.positions).ravel() / np.sqrt(len(problem.positions) * problem.scene.cloth.nodes)
    power = 2.0**problem.rollout.simulator.integrator.order
    return (offset - residuals) * power / (power - 1.0)
