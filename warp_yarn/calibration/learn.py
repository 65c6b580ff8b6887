"""Learns parameters of a fabric from frames of its motion. Needs the extras ``torch`` and ``bench`` (SciPy).

A ``CalibrationProblem`` is a least-squares problem: frames, a scene that is to reproduce them, and what may change in
it within which ranges. ``learn`` solves it and says how sure the answer is. ``docs/learning.md`` tells how to read it.

This is the way in: what users write is importable from here, also as ``warp_yarn.learn``.
"""

from __future__ import annotations

import dataclasses
import os
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import tqdm

from ..errors import GradientError, InputError, integer, real
from . import checkpoint as checkpoints
from .differences import missed_by_the_step
from .levenberg_marquardt import Iteration, LevenbergMarquardt
from .parameters import PAPER, Parameter, learnable, split, value_of, with_values
from .probing import probed
from .problem import CalibrationProblem
from .uncertainty import DETERMINED_DEVIATION

__all__ = [
    "PAPER",
    "CalibrationProblem",
    "Iteration",
    "Parameter",
    "Result",
    "learn",
    "learnable",
    "split",
    "value_of",
    "with_values",
]

PROGRESS_FORMAT = "{desc} {n_fmt} {elapsed}{postfix}"
"""No bar but text, which fits beside eight values: nobody knows how many iterations it will take."""


def __getattr__(name: str) -> Any:
    """Finds names as they were before."""
    if name != "Task":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    warnings.warn(f"{__name__}.Task is CalibrationProblem now", DeprecationWarning, stacklevel=2)
    return CalibrationProblem


@dataclasses.dataclass(frozen=True)
class Result:
    """What was learned.

    Args:
        problem: with the model's step that the values were learned with; the one given, or one so many times halved.
        parameters: what was to be learned.
        values: by name.
        uncertainty: standard deviations, by name: what the data leave open (``uncertainties``; where the model does not
            respond linearly, as the loss rises) and the step's error, as far as it is known and as far as it is not.
        step_error: by name, how much of the value is due to the model's time step, estimated (``step_errors``) from a
            run with half the step; 0 where that run fails, and of what is not determined.
        step_share: how much of the step's error the data do not have, from 0, data of the same method and step, to 1,
            data of a continuous motion.
        status: by name: "determined" or "not determined" by the data, and then ", at its lower bound" or ", at its
            upper bound".
        correlation: of the errors [parameters, parameters]; near ±1 where the data cannot tell two apart.
        loss: at the values [m²].
        gradient: of the loss, exact, with respect to (value − low)/(high − low) [parameters] (m²); NaN where it fails.
        history: every iteration.
        simulations, gradients, seconds: what it took, as of an Iteration.
        ended: why it ended.
    """

    problem: CalibrationProblem
    parameters: tuple[Parameter, ...]
    values: dict[str, float]
    uncertainty: dict[str, float]
    step_error: dict[str, float]
    step_share: float
    status: dict[str, str]
    correlation: np.ndarray
    loss: float
    gradient: np.ndarray
    history: list[Iteration]
    simulations: int
    gradients: int
    seconds: float
    ended: str

    @property
    def corrected(self) -> dict[str, float]:
        """The values without the step's error, by name, within their ranges."""
        without = {p.name: self.values[p.name] - self.step_error[p.name] for p in self.parameters}
        return {p.name: float(np.clip(without[p.name], p.low, p.high)) for p in self.parameters}

    @property
    def task(self) -> CalibrationProblem:
        """The problem, by its name of before."""
        warnings.warn("Result.task is Result.problem now", DeprecationWarning, stacklevel=2)
        return self.problem


def learn(
    problem: CalibrationProblem,
    *,
    iterations: int = 100,
    resolution: float = 1e-9,
    halvings: int = 3,
    checkpoint: str | os.PathLike | None = None,
    progress: bool = False,
    watch: Callable[[Iteration], None] = lambda iteration: None,
) -> Result:
    """Minimizes a problem's loss within the ranges, by the method of Levenberg and Marquardt.

    The Jacobian comes from differences of runs; each step then corrects it by what it saw (Broyden), and differences
    are taken again where it predicted badly, and at the end. ``benchmarks/optimizers.py`` has other methods.

    Args:
        iterations: at most.
        resolution: how far the data's positions may be off at least, root mean square [m], above 0. Learning ends where
            the model is as near as that, and a parameter that moves positions by less is left where it is.
        halvings: how many times the model's step may be halved. It is where it leaves a value less sure than
            ``PRECISE_DEVIATION``, as far as its error stands in the residuals (``Result.step_share``), and where a
            model of half the step, with values without the step's part, is nearer to the data. Those of the model's own
            step and method are not.
        checkpoint: a file, ending in .npz, that is written at the start and after every iteration. Where it is there
            already, learning goes on from it, and ends where it would have ended without the interruption.
        progress: show a bar with the loss and the values, on a terminal.
        watch: called after every iteration.

    Raises:
        InputError: an argument out of its range, or a checkpoint of another problem.
        SimulationError: the model cannot be simulated with the start values, or not on either side of later ones. A
            step to such values is shortened.

    Every exception, KeyboardInterrupt too, has the iterations until then as ``iterations`` [list of Iteration]: the
    last one's values are the best so far.
    """
    integer("iterations", iterations, least=0)
    resolution, halvings = real("resolution", resolution, above=0.0), integer("halvings", halvings, least=0)
    search = LevenbergMarquardt(problem, resolution, halvings)
    path = None if checkpoint is None else Path(checkpoint)
    if path is not None and path.suffix != ".npz":
        raise InputError(f"checkpoint = {str(checkpoint)!r}, must end in .npz")
    try:
        return _iterate(search, iterations, path, progress, watch)
    except BaseException as error:
        error.iterations = list(search.history)  # type: ignore[attr-defined]
        raise


def _iterate(
    search: LevenbergMarquardt,
    iterations: int,
    path: Path | None,
    progress: bool,
    watch: Callable[[Iteration], None],
) -> Result:
    """Iterates to an end, with a checkpoint after each iteration where there is a path."""
    # The first run compiles the kernels where they changed, which takes many seconds, and says so meanwhile.
    with tqdm.tqdm(desc="compiling", bar_format=PROGRESS_FORMAT, disable=None if progress else True) as bar:
        if path is not None and path.exists():
            checkpoints.load(search, path)
        else:
            search.begin()
            if path is not None:
                checkpoints.save(search, path)
        watch(search.history[-1])
        bar.set_description("learning", refresh=False)
        ended = None
        while ended is None:
            bar.set_postfix_str(search.describe(), refresh=False)
            bar.update(len(search.history) - 1 - bar.n)
            if len(search.history) > iterations:
                ended = f"after {len(search.history) - 1} iterations"
                break
            ended = search.advance()
            if ended is None:
                if path is not None:
                    checkpoints.save(search, path)
                watch(search.history[-1])
    return _result(search, ended)


def _result(search: LevenbergMarquardt, ended: str) -> Result:
    """Says what was learned, and how sure it is."""
    if not search.fresh:
        search.differentiate()
    problem = search.problem
    missed = missed_by_the_step(problem, search.values, search.residuals)
    found = search.uncertainty(missed, probed(search, search.uncertainty(missed)))
    of_residuals = np.sqrt(np.diag(found.covariance))
    try:
        _, gradient = problem.loss_and_gradient(search.values)
    except GradientError:  # what was learned is not to be lost for it
        gradient = np.full(len(search.y), np.nan)

    def by_name(values: np.ndarray) -> dict[str, float]:
        return dict(zip(problem.names, values.tolist(), strict=True))

    return Result(
        problem=problem,
        parameters=problem.parameters,
        values=by_name(search.values),
        uncertainty=by_name(found.deviation * problem.width),
        step_error=by_name(found.step_error * problem.width),
        step_share=found.share,
        status={name: _status(*of) for name, *of in zip(problem.names, search.y, found.of_data, strict=True)},
        correlation=found.covariance / np.outer(of_residuals, of_residuals),
        loss=search.loss,
        gradient=gradient * problem.width,
        history=search.history,
        simulations=problem.simulations,
        gradients=problem.gradients,
        seconds=time.perf_counter() - search.began,
        ended=ended,
    )


def _status(y: float, deviation: float) -> str:
    """Says whether the data determine a parameter, and on which bound it is."""
    bound = {0.0: ", at its lower bound", 1.0: ", at its upper bound"}.get(float(y), "")
    return ("determined" if deviation < DETERMINED_DEVIATION else "not determined") + bound
