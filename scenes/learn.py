"""Learns what the yarns of a fabric are made of from frames of its motion.

python scenes/hang.py --size 5 --steps 50 --record out/hang.npz
python scenes/learn.py out/hang.npz                       the paper's eight parameters: out/learn.json, .png and .usdc
python scenes/learn.py out/hang.npz --parameters bend[0] bend[1] shear --frames 10
python scenes/learn.py out/hang.npz --parameters wind_drag --range wind_drag 0 2 --start wind_drag 1
python scenes/learn.py wind_plain_12_5x5.h5 --step 2.5e-4

FILE is a recording (of hang.py --record or Trajectory.save) or one of the paper's published HDF5 files. Cloth,
weave and yarns are those of the file, and so is what is not learned. What is learned begins at its start, not at the
file's value; the plot shows both. .json: values, uncertainties, correlations and every iteration. .png: the path of
each parameter through its range. .usdc: the data and, at their right, the model with what it has learned.

Ctrl-C stops; the same command with --resume goes on. docs/learning.md tells how to read the answer. Needs the extras
torch and bench, and data for HDF5.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from common import add_slowdown, command, file_ending, make_folders, optional, parse, read_number
from pxr import Gf, Sdf, Usd, UsdGeom

import warp_yarn as wy
from warp_yarn.errors import integer
from warp_yarn.integrators import INTEGRATORS
from warp_yarn.io import recordings
from warp_yarn.io.files import atomic_write
from warp_yarn.io.usd import LAYERS, reload, writing
from warp_yarn.presets import paper
from warp_yarn.simulation.state import FIELDS

with optional("torch"):
    from warp_yarn.calibration.learn import (
        PAPER,
        CalibrationProblem,
        Parameter,
        Result,
        learn,
        learnable,
        split,
        value_of,
    )
with optional("bench"):
    from matplotlib.figure import Figure

HDF5 = (".h5", ".hdf5")

FRAMES = 25
"""What the paper learns from."""


def parser() -> argparse.ArgumentParser:
    result = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    add = result.add_argument
    add("file", type=file_ending(".npz", *HDF5), metavar="FILE", help="the frames")
    add(
        "--parameters", nargs="+", metavar="NAME", help="what to learn, such as stretch[0] or shear (the paper's eight)"
    )
    add("--range", nargs=3, action="append", default=[], metavar=("NAME", "LOW", "HIGH"), help="(the paper's)")
    add("--start", nargs=2, action="append", default=[], metavar=("NAME", "VALUE"), help="(the paper's, or the middle)")
    add("--frames", type=int, help="how many to learn from, after the first (25, or all where there are fewer)")
    add("--first", type=int, help="frame to start from (0; 1 of a published file, whose pins act from there on)")
    add("--every", type=int, default=1, help="take every so many-th frame only (%(default)s)")
    add("--step", type=float, metavar="SECONDS", help="time step of the model to begin with (the time between frames)")
    add("--halvings", type=int, default=3, help="of the step at most, where its error asks for them (%(default)s)")
    add("--integrator", choices=INTEGRATORS, help="method of the model (the simulator's default)")
    add("--wind", type=float, nargs=3, metavar=("X", "Y", "Z"), help="of an old recording without a scene, m/s (0 5 0)")
    add("--iterations", type=int, default=100, help="at most (%(default)s)")
    add("--resolution", type=float, default=1e-9, metavar="METRES", help="of the data, at best (%(default)g)")
    add("--resume", action="store_true", help="go on where the same command was stopped")
    add("--output", type=file_ending(*LAYERS), default=Path("out/learn.usdc"), metavar="USD", help="(%(default)s)")
    add("--plot", type=file_ending(".png"), metavar="PNG", help="(the USD file's name, .png)")
    add("--result", type=file_ending(".json"), metavar="JSON", help="(the USD file's name, .json)")
    add_slowdown(result)
    return result


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """Learns, writes, and tells what was learned.

    Returns:
        What the JSON file says.

    Raises:
        InputError: an option or a file that cannot be used.
        SimulationError: the start values, or the motion with the learned ones, cannot be simulated.
        KeyboardInterrupt: Ctrl-C, after saying how to go on.
    """
    options = parse(parser(), arguments)
    options.plot = options.plot or options.output.with_suffix(".png")
    options.result = options.result or options.output.with_suffix(".json")
    checkpoint = options.output.with_suffix(".checkpoint.npz")
    make_folders([options.output, options.plot, options.result])
    scene, target = read(options)
    method = {} if options.integrator is None else {"integrator": options.integrator}
    task = CalibrationProblem(
        scene,
        target,
        chosen(scene, options),
        frames=options.frames,
        first=options.first,
        every=options.every,
        step=options.step,
        **method,
    )
    if not options.resume:
        checkpoint.unlink(missing_ok=True)
    elif not checkpoint.exists():
        raise wy.InputError(f"--resume: there is no {checkpoint} to go on from")
    try:
        result = learn(
            task,
            iterations=options.iterations,
            resolution=options.resolution,
            halvings=options.halvings,
            checkpoint=checkpoint,
            progress=True,
        )
    except KeyboardInterrupt:
        if checkpoint.exists():
            print(f"\nThe same command with --resume goes on from {checkpoint}.", file=sys.stderr)
        raise
    task = result.problem  # its step may be shorter now
    numbers = summary(task, result, options.file)
    with atomic_write(options.result) as temporary:
        temporary.write_text(json.dumps(numbers, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    plot(options.plot, task, result)
    tell(task, result)
    animate(options.output, task, result, target, options)
    print("written:", ", ".join(str(file) for file in (options.result, options.plot, options.output)))
    return numbers


def read(options: argparse.Namespace) -> tuple[wy.Scene, wy.Trajectory]:
    """The scene and the frames of the file; which of them to take is settled."""
    if options.file.suffix in HDF5 and not recordings.is_one(options.file):
        if options.wind is not None:
            raise wy.InputError(f"--wind does not go with {options.file}, which has its own")
        published = wy.read_published(options.file)
        scene, target, first = published.scene, published.trajectory, 1
    else:
        target, first = wy.Trajectory.load(options.file), 0
        if target.scene is not None and options.wind is not None:
            raise wy.InputError(f"--wind does not go with {options.file}, which has its own")
        scene = target.scene
        if scene is None:
            scene = paper.hung(target.cloth, wind=wy.Wind(velocity=tuple(options.wind or paper.WIND)))
    if options.first is None:
        options.first = first
    if options.frames is None and len(target) - 1 - options.first > FRAMES * integer("every", options.every, least=1):
        options.frames = FRAMES
    return scene, target


def chosen(scene: wy.Scene, options: argparse.Namespace) -> list[Parameter]:
    """What to learn: the paper's choice where nothing else is said."""
    known = {p.name: p for p in PAPER}
    ranges = {name: tuple(read_number(f"--range {name}", text) for text in ends) for name, *ends in options.range}
    starts = {name: read_number(f"--start {name}", text) for name, text in options.start}
    counts = learnable(scene)
    places = {name: split(name) for name in known}
    own = [name for name, (base, k) in places.items() if (counts[base] is None if k is None else k < counts[base])]
    names = options.parameters or own
    for option, given in (("--range", ranges), ("--start", starts)):
        for name in given:
            if name not in names:
                raise wy.InputError(f"{option} {name}: not among what is learned, {', '.join(names)}")
    result = []
    for name in names:
        value_of(scene, name)  # or there is no such parameter
        if name not in ranges and name not in known:
            raise wy.InputError(f"{name}: the paper has no range for it, give one: --range {name} LOW HIGH")
        low, high = ranges[name] if name in ranges else (known[name].low, known[name].high)
        middle = 0.5 * (low + high) if name in ranges or name not in known else known[name].start
        result.append(Parameter(name, low, high, starts.get(name, middle)))
    return result


# -- what is written --------------------------------------------------------------------------------------------------


def summary(task: CalibrationProblem, result: Result, file: Path) -> dict[str, Any]:
    """What was learned, for the JSON file."""
    weave = task.scene.cloth.weave
    return {
        "file": str(file),
        "weave": weave.name,
        "rows": weave.rows,
        "columns": weave.columns,
        "frames": len(task.positions),
        "step [s]": task.step,
        "integrator": task.rollout.simulator.integrator.name,
        "ended": result.ended,
        "loss [m²]": result.loss,
        "share of the step's error": result.step_share,
        "simulations": result.simulations,
        "gradients": result.gradients,
        "seconds": result.seconds,
        "parameters": {
            p.name: {
                "value": result.values[p.name],
                "uncertainty": result.uncertainty[p.name],
                "without the step's error": result.corrected[p.name],
                "status": result.status[p.name],
                "range": [p.low, p.high],
                "start": p.start,
                "in the file": value_of(task.scene, p.name),
            }
            for p in result.parameters
        },
        "gradient of the loss, per range [m²]": [float(g) if np.isfinite(g) else None for g in result.gradient],
        "correlation": result.correlation.tolist(),
        "losses [m²]": [i.loss for i in result.history],
        "paths": {p.name: [float(i.values[k]) for i in result.history] for k, p in enumerate(result.parameters)},
        "simulations by iteration": [i.simulations for i in result.history],
        "steps [s]": [i.step for i in result.history],
    }


def plot(path: Path, task: CalibrationProblem, result: Result) -> None:
    """The loss and the path of every parameter through its range, by iteration."""
    panels = 1 + len(result.parameters)
    columns = min(3, panels)
    rows = -(-panels // columns)
    figure = Figure(figsize=(3.4 * columns, 2.4 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    steps = range(len(result.history))
    grid[0].semilogy(steps, [i.loss for i in result.history], color="tab:gray", marker=".")
    grid[0].set_title("loss [m²]")
    for k, (axes, p) in enumerate(zip(grid[1:panels], result.parameters, strict=True)):
        axes.axhline(value_of(task.scene, p.name), color="tab:green", linestyle="--", label="in the file")
        axes.plot(steps, [i.values[k] for i in result.history], color="tab:blue", marker=".", label="learned")
        value, deviation = result.values[p.name], result.uncertainty[p.name]
        axes.errorbar(steps[-1], value, deviation, color="tab:blue", capsize=4, label="± uncertainty")
        axes.set_title(p.name)
        if result.status[p.name] != "determined":
            box = {"facecolor": "white", "alpha": 0.7, "linewidth": 0.0}
            place = {"transform": axes.transAxes, "horizontalalignment": "center", "size": "small"}
            axes.text(0.5, 0.06, result.status[p.name], color="tab:red", bbox=box, **place)
        margin = 0.04 * (p.high - p.low)
        axes.set_ylim(p.low - margin, p.high + margin)
        axes.axhspan(p.low, p.high, color="tab:gray", alpha=0.12, linewidth=0.0, label="range")
        axes.ticklabel_format(axis="y", scilimits=(-2, 4))
    for axes in grid[:panels]:
        axes.title.set_size("medium")
        axes.xaxis.get_major_locator().set_params(integer=True)
    for axes in grid[panels:]:
        axes.set_axis_off()
    for axes in grid[panels - columns : panels]:
        axes.set_xlabel("iteration")
    handles, labels = grid[1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=150)


def animate(
    path: Path, task: CalibrationProblem, result: Result, target: wy.Trajectory, options: argparse.Namespace
) -> None:
    """Data and model side by side, to the end of the data: /comparison/data and, at its right, /comparison/model."""
    data = thinned(target, options.first, options.every, task.frame_time)
    values = np.array(list(result.values.values()))
    stop = None
    try:
        model = task.trajectory(values, len(data) - 1)
    except wy.SimulationError as error:
        stop, model = error, thinned(error.trajectory, 0, task.steps_per_frame, task.frame_time)
        data = data.cut(len(model))
    side_by_side(path, {"data": data, "model": model}, options.slowdown)
    if stop is not None:
        print("the model goes no further than the frames written:", file=sys.stderr)
        raise stop


def thinned(trajectory: wy.Trajectory, first: int, every: int, step: float) -> wy.Trajectory:
    """Every so many-th frame, from the first on."""
    parts = {name: getattr(trajectory, name)[first::every] for name in FIELDS}
    return dataclasses.replace(trajectory, step=step, scene=None, start=0, **parts)


def side_by_side(path: Path, trajectories: dict[str, wy.Trajectory], slowdown: float) -> None:
    """Trajectories as one USD file: /comparison, and below it a name each, next to each other along x."""
    with tempfile.TemporaryDirectory() as folder, atomic_write(path) as temporary, writing(path):
        # as write_usd: no stage may hold the file when it is moved
        _write_side_by_side(Path(folder), temporary, trajectories, slowdown)
    reload(path)


def _write_side_by_side(folder: Path, path: Path, trajectories: dict[str, wy.Trajectory], slowdown: float) -> None:
    stage = Usd.Stage.CreateNew(str(path))
    layer = stage.GetRootLayer()
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/comparison").GetPrim())
    for k, (name, trajectory) in enumerate(trajectories.items()):
        part = folder / f"{name}.usdc"
        wy.write_usd(part, trajectory, slowdown=slowdown)
        source = Sdf.Layer.FindOrOpen(str(part))
        if k == 0:
            for key in source.pseudoRoot.ListInfoKeys():
                if key not in ("defaultPrim", "documentation", "primChildren"):
                    layer.pseudoRoot.SetInfo(key, source.pseudoRoot.GetInfo(key))
        Sdf.CopySpec(source, Sdf.Path("/cloth"), layer, Sdf.Path(f"/comparison/{name}"))
        width = np.ptp(trajectory.cloth.position[:, 0]) + 4.0 * trajectory.cloth.radius
        place = UsdGeom.Xformable(stage.GetPrimAtPath(f"/comparison/{name}"))
        # beside the translation that a cloth far from the origin has
        place.AddTranslateOp(opSuffix="beside").Set(Gf.Vec3d(1.25 * width * k, 0.0, 0.0))
    stage.Save()


def tell(task: CalibrationProblem, result: Result) -> None:
    """A table of what was learned, and a few lines about how well."""
    print(f"{'':14}{'value':>12}{'± uncertainty':>16}{'without step error':>20}{'in the file':>14}")
    for p in result.parameters:
        columns = (result.values[p.name], result.uncertainty[p.name], result.corrected[p.name])
        own = value_of(task.scene, p.name)
        status = result.status[p.name]
        note = "" if status == "determined" else f"  {status}"
        print("{:14}{:12.5g}{:16.1e}{:20.5g}{:14.5g}{}".format(p.name, *columns, own, note))
    for line in alike(result):
        print(line)
    distance, moved = np.sqrt(result.loss), task.positions[-1] - task.initial.position
    print(
        f"{result.ended}; {1e6 * distance:.3g} µm from the data, which move by "
        f"{1e6 * np.sqrt((moved**2).sum(axis=1).mean()):.3g} µm (root mean squares); "
        f"{result.simulations} simulations, {result.gradients} gradient, {result.seconds:.1f} s"
    )
    if task.step < result.history[0].step:
        print(
            f"the data look as if made with a shorter step than {1e3 * result.history[0].step:g} ms: the model's was "
            f"halved to {1e3 * task.step:g} ms, and a run with that counts as {task.cost}"
        )
    if result.step_share > 0.5:
        print("the data look as if made with a shorter step than the model's: see the values without its error")


def alike(result: Result, least: float = 0.95) -> list[str]:
    """Which parameters the data can hardly tell apart, measured in ranges."""
    names = [p.name for p in result.parameters]
    pairs = [(i, j) for i in range(len(names)) for j in range(i) if abs(result.correlation[i, j]) > least]
    return [
        f"{names[j]} and {names[i]}: their errors have a correlation of {result.correlation[i, j]:.3f}, "
        f"so that their {'difference' if result.correlation[i, j] > 0.0 else 'sum'} is known better than each"
        for i, j in pairs
    ]


if __name__ == "__main__":
    sys.exit(command(main))
