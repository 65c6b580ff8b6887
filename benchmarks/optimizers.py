"""How many runs methods of optimization need to learn a fabric, and how long that takes.

    python benchmarks/optimizers.py [--sizes 5 17] [--runs 200]

The paper's eight parameters are learned from 25 frames of its plain cloth of yarns 1 and 2, from its starts and within
its ranges; the data have hard friction, and the model's method and step. A method has arrived when the seven parameters
that positions determine, all but friction, are within 1 % of the truth.

    ours               warp_yarn.learn: Levenberg-Marquardt, differences once, then Broyden's updates
    least_squares      SciPy's trust region, differences at every step
    L-BFGS-B           SciPy's, on exact gradients by the adjoint
    Adam               torch's, on exact gradients
    gradient descent   the paper's, on exact gradients

The first three see (value − low)/(high − low), the last two y with value = a·sigmoid(y) + b as in the paper, and their
rates are the best of RATES. "runs" are simulations, of differences and gradients too; a gradient costs about two more.
"nearest" is the largest error of the seven where it was smallest.
"""

from __future__ import annotations

import argparse
import contextlib
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy.optimize
import torch
import warp as wp
from common import RESULTS, environment, one_core, print_table, write_csv
from ground_truth import Fabric

import warp_yarn as wy
from warp_yarn.calibration.learn import PAPER, CalibrationProblem, learn, value_of

FABRIC = Fabric("plain", (1, 2))
WITHIN = 0.01
RATES = {"Adam": (0.03, 0.1, 0.3), "gradient descent": (0.03, 0.1, 0.3)}


class Enough(Exception):
    """A method has had its runs."""


class Record(CalibrationProblem):
    """A task that notes how near to the truth it was asked to look, and when; it allows so many runs."""

    def begin(self, runs: int) -> Record:
        self.truth = np.array([value_of(self.scene, name) for name in self.names])
        self.loss_and_gradient(self.start)  # compiles
        self.simulations = self.gradients = 0
        self.runs, self.nearest, self.arrived = runs, np.inf, None
        self.began = time.perf_counter()
        return self

    def note(self, values: np.ndarray) -> None:
        determined = [name != "friction" for name in self.names]
        error = float(np.abs(values / self.truth - 1.0)[determined].max())
        self.nearest = min(self.nearest, error)
        if self.arrived is None and error < WITHIN:
            self.arrived = (self.simulations, self.gradients, time.perf_counter() - self.began)
        if self.simulations >= self.runs:
            raise Enough

    def residuals(self, values: np.ndarray) -> np.ndarray:
        result = super().residuals(values)
        self.note(values)
        return result

    def loss_and_gradient(self, values: np.ndarray) -> tuple[float, np.ndarray]:
        result = super().loss_and_gradient(values)
        if hasattr(self, "began"):
            self.note(values)
        return result


def least_squares(task: CalibrationProblem, rate: float | None) -> None:
    width = task.high - task.low
    scipy.optimize.least_squares(
        lambda y: 1e6 * task.residuals(task.low + width * y),  # in µm, so that no tolerance ends it early
        (task.start - task.low) / width,
        bounds=(0.0, 1.0),
        x_scale="jac",
        diff_step=1e-4,
    )


def lbfgsb(task: CalibrationProblem, rate: float | None) -> None:
    width = task.high - task.low
    first = task.loss(task.start)

    def of(y: np.ndarray) -> tuple[float, np.ndarray]:
        loss, gradient = task.loss_and_gradient(task.low + width * y)
        return loss / first, gradient * width / first

    start, bounds = (task.start - task.low) / width, [(0.0, 1.0)] * len(width)
    scipy.optimize.minimize(of, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"ftol": 0.0, "gtol": 0.0})


def sigmoid_descent(optimizer: Callable[..., torch.optim.Optimizer]) -> Callable[[CalibrationProblem, float], None]:
    """Descent of y by one of torch's optimizers, with value = a·sigmoid(y) + b, of the loss relative to its first."""

    def descend(task: CalibrationProblem, rate: float) -> None:
        low, width = (torch.tensor(of) for of in (task.low, task.high - task.low))
        y = torch.logit((torch.tensor(task.start) - low) / width).requires_grad_()
        descent = optimizer([y], lr=rate)
        first = task.loss(task.start)
        while True:
            values = low + width * torch.sigmoid(y)
            _, gradient = task.loss_and_gradient(values.detach().numpy())
            descent.zero_grad()
            values.backward(torch.tensor(gradient / first))
            descent.step()

    return descend


METHODS: dict[str, Callable[[CalibrationProblem, float | None], Any]] = {
    "ours": lambda task, rate: learn(task),
    "least_squares": least_squares,
    "L-BFGS-B": lbfgsb,
    "Adam": sigmoid_descent(torch.optim.Adam),
    "gradient descent": sigmoid_descent(torch.optim.SGD),
}


def row(method: str, size: int, frames: int, runs: int) -> dict[str, Any]:
    """One row of the table: the best of a method's rates."""
    target = FABRIC.truth(size, frames, "same", integrator="linear")
    tasks = {}
    for rate in RATES.get(method, (None,)):
        task = Record(FABRIC.model(size), target, PAPER, integrator="linear").begin(runs)
        with contextlib.suppress(Enough, wy.SimulationError):
            METHODS[method](task, rate)
        tasks[rate] = task
    rate, best = min(tasks.items(), key=lambda item: (item[1].arrived or (np.inf,), item[1].nearest))
    simulations, gradients, seconds = best.arrived or ("", "", "")
    return {
        "method": method,
        "rate": "" if rate is None else rate,
        "size": f"{size} × {size}",
        "runs to 1 %": simulations,
        "gradients": gradients,
        "seconds": seconds,
        "nearest": best.nearest,
        "of runs": best.simulations,
    }


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[5, 17], help="rows and columns (5 17)")
    parser.add_argument("--frames", type=int, default=25, help="to learn from (%(default)s)")
    parser.add_argument("--runs", type=int, default=200, help="simulations that a method may make (%(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS / "optimizers.csv", help="CSV file (%(default)s)")
    options = parser.parse_args(arguments)
    one_core()
    torch.set_num_threads(1)
    wp.config.log_level = wp.LOG_WARNING
    about = environment("scipy", "torch")
    torch.optim.SGD([torch.zeros(1, requires_grad=True)])  # imports for seconds, which no method shall be charged for
    rows = [row(method, size, options.frames, options.runs) for size in options.sizes for method in METHODS]
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    print_table(rows)
    write_csv(options.output, rows, about)
    print("written:", options.output)


if __name__ == "__main__":
    main()
