"""The paper's experiments whose results are parameters: its tables 2 and 3, and the bias that time steps put in."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from ground_truth import NAMES, PARAMETERS, PLAIN, TIGHT, Fabric, case, mean_square
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator
from plots import COLORS, save

import warp_yarn as wy
from warp_yarn.calibration.learn import CalibrationProblem, Result, learn, value_of
from warp_yarn.integrators import INTEGRATORS

OF_YARNS = 6
"""So many of NAMES are of the yarns."""

TABLE_2 = {
    5: (2.028e-3, 2.450e-3, 479523.0, 172928.0, 1.387e-4, 1.112e-4, 949.0, 0.437),
    10: (1.991e-3, 2.448e-3, 484719.0, 173843.0, 1.325e-4, 1.026e-4, 932.0, 0.455),
    17: (1.969e-3, 2.440e-3, 505421.0, 171304.0, 1.323e-4, 1.034e-4, 947.0, 0.402),
    25: (2.069e-3, 2.443e-3, 510215.0, 173920.0, 1.488e-4, 1.201e-4, 913.0, 0.380),
}
"""What the paper learned on plain (1, 2) from 25 frames, by size, in the order of NAMES."""

TABLE_3 = {
    5: (2.030e-3, 2.450e-3, 494301.0, 169597.0, 1.357e-4, 1.130e-4),
    10: (2.037e-3, 2.443e-3, 491717.0, 169543.0, 1.379e-4, 1.130e-4),
    25: (2.038e-3, 2.447e-3, 491873.0, 167217.0, 1.367e-4, 1.096e-4),
}
"""What it learned by frames, of the yarns."""

# -- tables 2 and 3: parameters ---------------------------------------------------------------------------------------


def parameter_rows(result: Result, true: Mapping[str, float]) -> list[dict[str, Any]]:
    """A row for each parameter that was learned; errors and uncertainty are relative to the true value."""
    rows = []
    for p in result.parameters:
        right, found, ours = true[p.name], result.values[p.name], result.corrected[p.name]
        errors = {"found's error": found / right - 1.0, "ours": ours, "error": ours / right - 1.0}
        sure = {"uncertainty": result.uncertainty[p.name] / right, "status": result.status[p.name]}
        cost = {"runs": result.simulations + result.gradients, "seconds": result.seconds}
        rows.append({"parameter": p.name, "true": right, "found": found, **errors, **sure, **cost})
    return rows


def ratio(theirs: float, ours: float) -> float:
    return abs(theirs / ours) if ours else np.inf


def learned(
    fabric: Fabric, kind: str, size: int, frames: int, papers: Sequence[float], **options: Any
) -> list[dict[str, Any]]:
    """Learns a fabric from so many frames, and puts what the paper found of the first of NAMES beside ours."""
    about = case(fabric, kind, size, frames)
    target = fabric.truth(size, frames, kind, **options)
    result = learn(CalibrationProblem(fabric.model(size), target, PARAMETERS, **options), progress=True)
    rows = []
    for row in parameter_rows(result, {name: fabric.value(name) for name in NAMES}):
        theirs = dict.fromkeys(("paper", "paper's error", "ratio"), "")
        if len(rows) < len(papers):
            value = papers[len(rows)]
            error = value / row["true"] - 1.0
            theirs = {"paper": value, "paper's error": error, "ratio": ratio(error, row["error"])}
        rows.append({**about, **row, "step [ms]": 1e3 * result.problem.step, **theirs})
    return rows


def table2(options: argparse.Namespace) -> Iterator[list[dict[str, Any]]]:
    """Rows of each size."""
    for kind in options.truth:
        for fabric in options.fabrics:
            for size in options.sizes:
                papers = TABLE_2.get(size, ()) if fabric == PLAIN and options.frames == 25 else ()
                yield learned(fabric, kind, size, options.frames, papers, **options.simulator)


def table3(options: argparse.Namespace) -> Iterator[list[dict[str, Any]]]:
    """Rows of each number of frames."""
    for kind in options.truth:
        for fabric in options.fabrics:
            for frames in options.frames:
                papers = TABLE_3.get(frames, ()) if fabric == PLAIN else ()
                yield learned(fabric, kind, options.size, frames, papers, **options.simulator)


# -- bias: what a method's time step does to the values ---------------------------------------------------------------


def bias(options: argparse.Namespace) -> Iterator[list[dict[str, Any]]]:
    """Rows of each method and step with the finer ground truth, and then of each method with the published data."""
    fabric, size = options.fabrics[0], options.size
    truth = fabric.truth(size, options.frames, "finer")
    cases = [("finer", fabric.model(size), truth, 0, method, h) for method in INTEGRATORS for h in options.steps]
    if options.data is not None:
        published = wy.read_published(options.data)
        scene, frames = published.scene, published.trajectory
        cases += [("published", scene, frames, 1, method, frames.step) for method in INTEGRATORS]
    for data, scene, target, first, method, step in cases:
        print(f"{data} data, {method}, step {1e3 * step:g} ms", flush=True)
        about = {"data": data, "integrator": method, "order": INTEGRATORS[method].order, "step [ms]": 1e3 * step}
        try:
            what = {"frames": options.frames, "first": first, "step": step, "integrator": method}
            task = CalibrationProblem(scene, target, PARAMETERS, **what, **TIGHT)
            result = learn(task, halvings=0, progress=True)
        except wy.SimulationError as error:
            print(f"{method} cannot start with this step: {error}")
            continue
        moved = mean_square(task.positions, target.position[first])
        fit = {"residual": float(np.sqrt(result.loss / moved))}
        true = {parameter: value_of(scene, parameter) for parameter in NAMES}
        yield [{**about, **row, **fit} for row in parameter_rows(result, true)]


def plot_bias(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Errors of each value by method, and by step the largest of the yarns' values."""
    integrators = list(dict.fromkeys(row["integrator"] for row in rows))
    coarsest = max(row["step [ms]"] for row in rows)
    titles = {"finer": "learned from data of a finer step", "published": "learned from the published data"}
    drawn = [data for data in titles if any(row["data"] == data for row in rows)]
    figure = Figure(figsize=(5.0 * (len(drawn) + 1), 5.5), layout="constrained")
    *values, by_step = figure.subplots(1, len(drawn) + 1)
    for axes, data in zip(values, drawn, strict=True):
        draw_values(axes, [r for r in rows if r["data"] == data and r["step [ms]"] == coarsest], integrators)
        axes.set_title(f"{titles[data]}, {coarsest:g} ms")
    of_yarns = [row for row in rows if row["data"] == "finer" and row["parameter"] in NAMES[:OF_YARNS]]
    steps = sorted({row["step [ms]"] for row in of_yarns})
    for integrator, color in zip(integrators, COLORS, strict=False):
        for column, style in (("found's error", "o-"), ("error", "x--")):
            worst = [
                max(abs(row[column]) for row in of_yarns if (row["integrator"], row["step [ms]"]) == (integrator, h))
                for h in steps
            ]
            by_step.loglog(steps, 100.0 * np.array(worst), style, color=color)
    by_step.set_xticks(steps, [f"{step:g} ms" for step in steps])
    by_step.minorticks_off()
    by_step.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    by_step.yaxis.set_major_formatter("{x:g} %")
    by_step.set_title("largest error of the yarns' values, by step")
    by_step.grid(alpha=0.3)
    marks = {
        "found": {"marker": "o"},
        "found, not determined": {"marker": "o", "markerfacecolor": "white"},
        "without the step's error, as estimated": {"marker": "x"},
    }
    handles = [Line2D([], [], color=color, label=name) for name, color in zip(integrators, COLORS, strict=False)]
    handles += [Line2D([], [], color="grey", linestyle="", label=name, **mark) for name, mark in marks.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    save(figure, path)


def draw_values(axes: Axes, rows: Sequence[Mapping[str, Any]], integrators: Sequence[str]) -> None:
    """A mark for each value found, with its uncertainty, and a cross for what is left without the step's error."""
    for row in rows:
        k = integrators.index(row["integrator"])
        y = NAMES.index(row["parameter"]) + 0.7 * ((k + 0.5) / len(integrators) - 0.5)
        face = COLORS[k] if row["status"].startswith("determined") else "white"
        error, uncertainty = 100.0 * row["found's error"], 100.0 * row["uncertainty"]
        axes.errorbar(error, y, xerr=uncertainty, color=COLORS[k], marker="o", markerfacecolor=face)
        axes.plot(100.0 * row["error"], y, "x", color=COLORS[k])
    axes.axvline(0.0, color="black", linewidth=0.8)
    axes.set_xscale("symlog", linthresh=1.0)
    ticks = [-100, -10, -1, 0, 1, 10, 100]
    axes.set_xticks(ticks, [f"{tick} %" for tick in ticks])
    axes.set_yticks(range(len(NAMES)), NAMES)
    axes.invert_yaxis()
    axes.set_xlabel("error")
    axes.grid(alpha=0.3)
