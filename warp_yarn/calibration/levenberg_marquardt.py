"""Least squares within ranges, by the method of Levenberg and Marquardt, for a model whose own step may be halved.

Here is where learning is and how it goes on. When it is to end, and what is told of its end, is the matter of
``learn``.
"""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np
import scipy.optimize

from ..errors import SimulationError
from .differences import missed_by_the_step
from .parameters import split
from .problem import CalibrationProblem
from .uncertainty import Uncertainty, estimate, residual_variance

CONVERGED_STEP = 0.03
"""Learning ends where a full step would be shorter than this [standard deviations of what is learned]."""

SHORTEST_STEP = 1e-7
"""A step that is not worth a run [ranges]."""

PRECISE_DEVIATION = 0.015
"""Standard deviation of a value for whose sake no shorter step is tried [ranges]: at most 3 % of the paper's values."""

WORTHWHILE_PART = 0.9
"""What must be left of a standard deviation, as far as can be foreseen, for a shorter step to be worth its runs [1]."""

FIRST_DAMPING, LEAST_DAMPING = 1e-3, 1e-12
"""λ of the normal equations JᵀJ + λ diag(JᵀJ) [1]."""

ACCEPTED_QUALITY = 1e-3
"""A step is taken that lowers the loss by more than this part of what was predicted [1]."""

POOR_QUALITY, GOOD_QUALITY = 0.25, 0.5
"""Below the first the Jacobian is taken anew, and λ raised; above the second λ is lowered [1]."""

FAILED_FACTOR, POOR_FACTOR, GOOD_FACTOR = 10.0, 4.0, 0.1
"""By which λ changes after a step that is not taken, and after one of poor or good quality [1]."""


@dataclasses.dataclass(frozen=True)
class Iteration:
    """What is known after an iteration; number 0 is the start.

    Args:
        values: of the parameters, in their units [parameters].
        loss: at them [m²].
        step: of the model [s].
        simulations, gradients: runs so far, as of a CalibrationProblem.
        seconds: wall time so far; compiling, where kernels changed, is part of it.
    """

    values: np.ndarray
    loss: float
    step: float
    simulations: int
    gradients: int
    seconds: float


class LevenbergMarquardt:
    """Where learning is: y = (value − low)/(high − low), the residuals there, and the Jacobian as far as known.

    The Jacobian is of differences, corrected by each step (Broyden), until it predicts badly.

    Args:
        problem: what to solve.
        resolution: of the data [m].
        halvings: how many times the model's step may be halved.

    Attributes:
        problem: the one given, or, of a model with a shorter step, what came of it.
        y, residuals: the present values, in ranges [p], and what is left of the data there [residuals] (m).
        jacobian: ∂residuals/∂y [residuals, p], or None where it is to be taken anew.
        fresh: whether it is of differences taken here.
        damping, scale: λ, and the largest norm of each column so far, by which Marquardt scales it [p].
        history: every iteration.
        began: when, on the clock of ``time.perf_counter`` [s].
    """

    def __init__(self, problem: CalibrationProblem, resolution: float, halvings: int):
        self.problem, self.resolution = problem, resolution
        self.most_steps = problem.steps_per_frame * 2**halvings
        self.y = problem.scaled(problem.start)
        self.residuals = np.zeros(0)
        self.jacobian: Any = None
        self.fresh = False
        self.damping, self.scale = FIRST_DAMPING, np.zeros(len(self.y))
        self.history: list[Iteration] = []
        self.began = time.perf_counter()

    @property
    def values(self) -> np.ndarray:
        """The present values, in their units [p]."""
        return self.problem.physical(self.y)

    @property
    def loss(self) -> float:
        """The present loss [m²]."""
        return float(self.residuals @ self.residuals)

    def begin(self) -> None:
        """Makes the run of the start values."""
        self.residuals = self.problem.residuals(self.values)
        self._note()

    def _note(self) -> None:
        """Adds the present to the history."""
        seconds = time.perf_counter() - self.began
        of = self.problem
        self.history.append(Iteration(self.values, self.loss, of.step, of.simulations, of.gradients, seconds))

    def describe(self) -> str:
        """Says the loss and the values in a line."""
        values: dict[str, str] = {}
        for name, value in zip(self.problem.names, self.values, strict=True):
            base = split(name)[0]
            values[base] = values.get(base, base) + f" {value:.3g}"
        return ", ".join((f"loss {self.loss:.1e}", *values.values()))

    def advance(self) -> str | None:
        """Makes an iteration: a step that lowers the loss, or a shorter step of the model. Returns why, if none."""
        while True:
            if self.loss <= self.resolution**2:
                return "as near to the data as their resolution"
            if self.jacobian is None:
                self.differentiate()
            _, gain = self._step(0.0)
            field = self.problem.field(self.residuals)
            variance = residual_variance(field, len(self.y), self.resolution)
            if gain <= variance and self._halve():  # as near as this step deserves, the Jacobian being old or not
                return None
            if gain > CONVERGED_STEP**2 * variance:
                if self._try():
                    return None
                if self.fresh:
                    return "no step lowers the loss"
            elif self.fresh:
                return "converged"
            self.jacobian = None

    def differentiate(self) -> None:
        """Takes the Jacobian here, by differences."""
        self.jacobian = self.problem.jacobian(self.values, self.residuals)
        self.fresh = True
        self.scale = np.maximum(self.scale, np.linalg.norm(self.jacobian, axis=0))

    def uncertainty(self, missed: np.ndarray, least: np.ndarray | float = 0.0) -> Uncertainty:
        """Estimates what the data leave open here; ``missed`` and ``least`` as of ``uncertainty.estimate``, flat."""
        field, width = self.problem.field, self.problem.width
        others = [(i.loss - self.loss, np.abs(i.values - self.values) / width) for i in self.history]
        return estimate(
            self.jacobian, field(self.residuals), field(missed), self.resolution, others=others, least=least
        )

    def _step(self, damping: float) -> tuple[np.ndarray, float]:
        """Finds the step within the ranges that lowers the linearized and damped loss most, and by how much it does.

        Beside the damping of Levenberg and Marquardt there is that of the range: what would move positions by less than
        they tell, noise of the residuals' size or their resolution, over all of its range, stays where it is.
        """
        range_damping = 12.0 * max(self.loss / len(self.residuals), self.resolution**2)
        q, r = np.linalg.qr(self.jacobian)
        a = np.vstack([r, np.diag(np.sqrt(damping * self.scale**2 + range_damping))])
        b = np.concatenate([-(q.T @ self.residuals), np.zeros(len(self.y))])
        found = scipy.optimize.lsq_linear(a, b, bounds=(-self.y, 1.0 - self.y), method="bvls")
        step = np.clip(self.y + found.x, 0.0, 1.0) - self.y
        after = self.residuals + self.jacobian @ step
        return step, self.loss - float(after @ after)

    def _try(self) -> bool:
        """Tries steps, ever shorter until the loss falls. False: it did not, as far as this Jacobian goes."""
        while True:
            step, predicted = self._step(self.damping)
            if np.abs(step).max() < SHORTEST_STEP:
                return False
            try:
                residuals = self.problem.residuals(self.problem.physical(self.y + step))
                quality = (self.loss - float(residuals @ residuals)) / predicted
            except SimulationError:
                quality = -np.inf
            if quality > ACCEPTED_QUALITY:
                break
            if not self.fresh:
                return False
            self.damping *= FAILED_FACTOR
        surprise = residuals - self.residuals - self.jacobian @ step
        self.y, self.residuals = self.y + step, residuals
        self.fresh = False
        if quality < POOR_QUALITY:
            self.damping *= POOR_FACTOR
            self.jacobian = None
        else:
            # in Marquardt's scaling: what moves nothing is not to blame
            along = self.scale**2 * step
            self.jacobian = self.jacobian + np.outer(surprise, along) / (along @ step)
        if quality > GOOD_QUALITY:
            self.damping = max(GOOD_FACTOR * self.damping, LEAST_DAMPING)
        self._note()
        return True

    def _halve(self) -> bool:
        """Goes on with half the model's step, from values without its error, where that is worth it and nearer."""
        if self.problem.steps_per_frame == self.most_steps:
            return False
        now = self.uncertainty(missed_by_the_step(self.problem, self.values, self.residuals))
        unsure = now.deviation > PRECISE_DEVIATION
        if not np.any(unsure & (now.without_step < WORTHWHILE_PART * now.deviation)):
            return False
        finer, y = self.problem.halved(), np.clip(self.y - now.step_error, 0.0, 1.0)
        try:
            residuals = finer.residuals(self.problem.physical(y))
        except SimulationError:
            residuals = None
        self.problem.simulations = finer.simulations
        if residuals is None or float(residuals @ residuals) >= self.loss:  # what looked like the step's error was none
            return False
        self.problem, self.y, self.residuals, self.fresh = finer, y, residuals, False
        self._note()
        return True
