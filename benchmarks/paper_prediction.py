"""The paper's experiments whose results are errors of prediction: its table 4 and figure 6."""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import bayesian
import numpy as np
import sheet
from ground_truth import NAMES, PARAMETERS, Fabric, case, every, mean_square
from matplotlib.figure import Figure
from plots import COLORS, MARKERS, save

import warp_yarn as wy
from warp_yarn.calibration.learn import CalibrationProblem, learn, with_values
from warp_yarn.presets import paper

METHODS = ("ours", "BO", "sheet")

BASELINES = METHODS[1:]

TABLE_4 = {
    ("plain (1, 2)", 5): {"ours": 1.152e-4, "BO": 0.512, "sheet": 1.461},
    ("plain (1, 2)", 25): {"ours": 3.962e-5, "BO": 0.109, "sheet": 0.4124},
    ("plain (1, 3)", 5): {"ours": 1.516e-4, "BO": 1.280, "sheet": 1.608},
    ("plain (1, 3)", 25): {"ours": 3.555e-5, "BO": 0.738, "sheet": 0.4567},
    ("plain (2, 3)", 5): {"ours": 5.233e-4, "BO": 28.19, "sheet": 1.952},
    ("plain (2, 3)", 25): {"ours": 2.117e-5, "BO": 18.16, "sheet": 0.2294},
}
"""The paper's errors of prediction [1e-6 m²] by fabric and frames to learn from."""

# -- what each method learns ------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Learned:
    """What a method learned of a fabric.

    Args:
        runs: simulations that it took, gradients counted as such.
        seconds: it took.
        predict: positions [frames, nodes, 3] (m) of a cloth with so many yarns in so many frames after rest; fewer
            frames, or not finite ones, where the simulation failed.
    """

    runs: int
    seconds: float
    predict: Callable[[int, int], np.ndarray]


def prediction_error(predicted: np.ndarray, truth: np.ndarray) -> float:
    """Mean squared distance [m²], infinite where the prediction ends early or is not finite."""
    if len(predicted) < len(truth) or not np.isfinite(predicted).all():
        return np.inf
    return mean_square(predicted, truth)


def of_yarns(
    fabric: Fabric, values: Mapping[str, float], times: int, **options: Any
) -> Callable[[int, int], np.ndarray]:
    """The prediction of our model with these values and so many steps a frame."""

    def predict(size: int, frames: int) -> np.ndarray:
        scene = with_values(fabric.model(size), values)
        simulator = wy.Simulator(scene, step=paper.STEP / times, **options)
        try:
            motion = simulator.run(frames * times, progress=True)
        except wy.SimulationError as error:
            motion = error.trajectory
        return every(motion, times).position[1:]

    return predict


def methods(fabric: Fabric, size: int, target: wy.Trajectory, runs: int, **options: Any) -> dict[str, Learned]:
    """Those of METHODS that there are, after learning from the same frames; the sheet only where Newton is installed.

    Args:
        target: the rest and the frames to learn from.
        runs: simulations that the baselines may use.
    """
    model, positions = fabric.model(size), target.position[1:]
    result = learn(CalibrationProblem(model, target, PARAMETERS, **options), progress=True)
    ours = of_yarns(fabric, result.values, result.problem.steps_per_frame, **options)
    found = {"ours": Learned(result.simulations + result.gradients, result.seconds, ours)}

    begin = time.perf_counter()
    task = CalibrationProblem(model, target, PARAMETERS, **options)
    still = mean_square(positions, target.position[0])
    best = bayesian.minimize(task.loss, task.low, task.high, runs, failed=still)
    values = dict(zip(NAMES, best.tolist(), strict=True))
    found["BO"] = Learned(task.simulations, time.perf_counter() - begin, of_yarns(fabric, values, 1, **options))

    if sheet.available():
        begin = time.perf_counter()
        start = sheet.bounds(model.cloth, {p.name: p.start for p in PARAMETERS})
        fitted = sheet.fit(sheet.Sheet(model), positions, start, runs)

        def predict(size: int, frames: int) -> np.ndarray:
            return sheet.Sheet(fabric.model(size)).run(fitted, frames)

        found["sheet"] = Learned(runs, time.perf_counter() - begin, predict)
    return found


# -- table 4: prediction ----------------------------------------------------------------------------------------------


def table4(options: argparse.Namespace) -> Iterator[list[dict[str, Any]]]:
    """A row of each fabric and number of frames."""
    size, simulator = options.size, options.simulator
    for kind in options.truth:
        for fabric in options.fabrics:
            truth = fabric.truth(size, max(options.test, *options.frames), kind, **simulator)
            for frames in options.frames:
                about = case(fabric, kind, size, frames)
                found = methods(fabric, size, truth.cut(frames + 1), options.runs, **simulator)
                columns = prediction_columns(
                    found, truth.cut(options.test + 1), size, TABLE_4.get((fabric.name, frames), {})
                )
                yield [about | columns]


def prediction_columns(
    found: Mapping[str, Learned], truth: wy.Trajectory, size: int, papers: Mapping[str, float]
) -> dict[str, Any]:
    """Errors [1e-6 m²], how many times ours the baselines' are, the paper's, and what learning took."""
    test = truth.position[1:]
    errors = {name: 1e6 * prediction_error(method.predict(size, len(test)), test) for name, method in found.items()}
    row: dict[str, Any] = {name: errors.get(name, "") for name in METHODS}
    row |= {f"{name} / ours": errors[name] / errors["ours"] if name in errors else "" for name in BASELINES}
    row |= {f"paper's {name}": papers.get(name, "") for name in ("ours", *BASELINES)}
    row["ratio"] = papers["ours"] / errors["ours"] if papers else ""
    for what in ("runs", "seconds"):
        names = ("ours", *BASELINES)
        row |= {f"{what} of {name}": getattr(found[name], what) if name in found else "" for name in names}
    return row


# -- figure 6: how errors grow ----------------------------------------------------------------------------------------


BETWEEN = 10
"""Frames from one error over time to the next."""


def figure6(options: argparse.Namespace) -> Iterator[list[dict[str, Any]]]:
    """Rows of errors by frames to learn from, by time, and by size."""
    (kind,), fabric, size, simulator = options.truth, options.fabrics[0], options.size, options.simulator

    def row(panel: str, method: str, x: int, error: float) -> dict[str, Any]:
        about = {"panel": panel, "fabric": fabric.name, "ground truth": kind, "method": method}
        return {**about, "x": x, "error [m²]": error}

    def errors(panel: str, x: int, found: Mapping[str, Learned], size: int, truth: np.ndarray) -> list[dict[str, Any]]:
        return [
            row(panel, name, x, prediction_error(method.predict(size, len(truth)), truth))
            for name, method in found.items()
        ]

    truth = fabric.truth(size, max(options.test, *options.frames), kind, **simulator)
    found: dict[str, Learned] = {}
    for frames in options.frames:
        case(fabric, kind, size, frames)
        found = methods(fabric, size, truth.cut(frames + 1), options.runs, **simulator)
        yield errors("frames", frames, found, size, truth.position[1 : options.test + 1])

    case(fabric, kind, size, options.long)
    long = fabric.truth(size, options.long, kind, **simulator).position[1:]
    for name, method in found.items():
        predicted = method.predict(size, options.long)
        error = ((predicted - long[: len(predicted)]) ** 2).sum(axis=-1).mean(axis=-1)
        yield [row("time", name, k + 1, float(error[k])) for k in range(BETWEEN - 1, len(error), BETWEEN)]

    for times in options.times:
        case(fabric, kind, times * size, options.grow)
        large = fabric.truth(times * size, options.grow, kind, **simulator).position[1:]
        yield errors("size", times, found, times * size, large)


def plot_figure6(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Three panels, as the paper's."""
    labels = {
        "frames": ("frames to learn from", "error of prediction [m²]"),
        "time": ("frames of 1 ms", "error at that frame [m²]"),
        "size": ("size, relative to that learned on", "error of prediction [m²]"),
    }
    names = {"ours": "ours", "BO": "Bayesian optimization", "sheet": "sheet (Newton)"}
    figure = Figure(figsize=(12.0, 4.0), layout="constrained")
    for axes, (panel, (x, y)) in zip(figure.subplots(1, 3), labels.items(), strict=True):
        for name, color, marker in zip(METHODS, COLORS, MARKERS, strict=False):
            points = [(row["x"], row["error [m²]"]) for row in rows if (row["panel"], row["method"]) == (panel, name)]
            if points:
                style = {"marker": "" if panel == "time" else marker, "color": color}
                axes.semilogy(*zip(*points, strict=True), **style, label=names[name])
        if panel != "time":
            axes.set_xticks(sorted({row["x"] for row in rows if row["panel"] == panel}))
        axes.set_xlabel(x)
        axes.set_ylabel(y)
        axes.grid(alpha=0.3)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=len(METHODS))
    save(figure, path)
