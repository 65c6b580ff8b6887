"""The default tolerances on random scenes: whether they add to a step's own error, and whether anything fails or gains.

    python benchmarks/defaults.py [--scenes 180] [--first 0] [--integrator sdirk2]

A scene is known by its number, which seeds all of it: a fabric, a weave, 4 to 9 yarns each way, Y × 0.01 to × 1e4, a
step of 0.1 ms to 1/24 s, 8 to 20 of them, sliding or not, and a motion: free (let go strained), thrown (spinning, at
up to 5 m/s), hung by two corners, carried by them at up to 10 m/s, or clamped along a side; with wind or without. It is
made by default; with ``newton_tolerance=1e-10`` and ``tolerance=1e-12``; and so with an eighth of the step.
Distances are root mean squares over all nodes and frames, of positions:

    ratio       from the default to the tight run, over the default to the fine one: what share of the error that a step
                makes anyway the tolerance adds. Where the fine run is no nearer to the truth than the default, this
                means little: "doubt" is from a run with a quarter of the step to the fine one, over the same.
    of motion   from the default to the tight run, over how far nodes have moved, as seen by one who falls, flies and is
                carried along with the cloth.
    of all      the same, as seen by one who flies and is carried along, and does not fall.
    gain        the most that any frame's energy has above the first one's and the work of wind and pins since, over
                the most kinetic and elastic energy that there was.

Work is none of the solver's numbers. Pins all move alike, so they do what the cloth's momentum and the impulse of
gravity and wind leave of their impulse, times their velocity. Wind's force is taken along cubics through the recorded
positions and velocities, at ``WITHIN`` points of every step.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from common import RESULTS, environment, print_table, write_csv

import warp_yarn as wy
from warp_yarn.device.defaults import stretch_rate
from warp_yarn.presets.fabrics import STUDIED

TIGHT = {"newton_tolerance": 1e-10, "tolerance": 1e-12}
KINDS = ("free", "thrown", "hung", "carried", "clamped")
FINER = 8
WITHIN = 8
"""Points of a step at which wind is looked at."""


@dataclasses.dataclass(frozen=True)
class Case:
    """A random scene, known by its number."""

    number: int
    kind: str
    fabric: str
    weave: str
    rows: int
    columns: int
    stretch: float
    step: float
    steps: int
    sliding: bool
    exact: bool
    wind: tuple[float, float, float] | None
    speed: tuple[float, float, float]
    spin: tuple[float, float, float]
    strain: float

    @classmethod
    def of(cls, number: int) -> Case:
        """Make the scene of a number. Motions and fabrics take turns; all else is drawn."""
        rng = np.random.default_rng([20, number])

        def direction(most: float) -> tuple[float, float, float]:
            v = rng.normal(size=3)
            return tuple((v * rng.uniform(0.0, most) / np.linalg.norm(v)).tolist())  # type: ignore[return-value]

        kind = KINDS[number % len(KINDS)]
        return cls(
            number=number,
            kind=kind,
            fabric=list(STUDIED)[number // len(KINDS) % len(STUDIED)],
            weave=str(rng.choice(list(wy.WEAVES))),
            rows=int(rng.integers(4, 10)),
            columns=int(rng.integers(4, 10)),
            stretch=float(10.0 ** rng.uniform(-2.0, 4.0)),
            step=float(np.exp(rng.uniform(np.log(1e-4), np.log(1.0 / 24.0)))),
            steps=int(rng.integers(8, 21)),
            sliding=bool(rng.integers(2)),
            exact=bool(rng.integers(2)),
            wind=direction(8.0) if rng.integers(2) else None,
            speed=direction({"thrown": 5.0, "carried": 10.0}.get(kind, 0.0)),
            spin=direction(40.0 if kind == "thrown" else 0.0),
            strain=float(rng.uniform(0.0, 0.02)),
        )

    def cloth(self) -> wy.Cloth:
        """Make the cloth, of yarns that are as much stiffer."""
        cloth = STUDIED[self.fabric](rows=self.rows, columns=self.columns, weave=self.weave)
        yarns = [dataclasses.replace(yarn, stretch=self.stretch * yarn.stretch) for yarn in cloth.yarns]
        return cloth.replace(yarns=yarns, pose="upright" if self.number % 2 else "flat")

    def scene(self, finer: int = 1) -> wy.Scene:
        """Make the scene, for steps that are so many times shorter."""
        cloth = self.cloth()
        pins: list[int] = []
        if self.kind in ("hung", "carried"):
            pins = cloth.corners("top")
        if self.kind == "clamped":
            pins = [cloth.node(row, column) for row in range(cloth.weave.rows) for column in (0, 1)]
        options: dict[str, Any] = {"pins": pins, "sliding": self.sliding}
        if pins and self.exact:
            options["pin_stiffness"] = None
        if self.kind == "carried":
            t = self.step / finer * np.arange(1, finer * self.steps + 1)
            options["pin_path"] = cloth.position[pins] + t[:, None, None] * np.array(self.speed)
        if self.wind is not None:
            options["wind"] = wy.Wind(velocity=self.wind)
        return wy.Scene(cloth, **options)

    def start(self, scene: wy.Scene, state: wy.State) -> wy.State:
        """Make the first state: all of the cloth flies, spins or is carried, and is strained a little but where it is
        held."""
        rng = np.random.default_rng([21, self.number])
        x = state.position
        jitter = rng.uniform(-1.0, 1.0, x.shape) * self.strain * scene.cloth.spacing
        jitter[scene.pins] = 0.0
        state.velocity[:] = self.speed + np.cross(self.spin, x - x.mean(axis=0))
        state.position += jitter
        return state


@dataclasses.dataclass(frozen=True)
class Run:
    """What a run leaves: its frames at the whole steps, or why there are none."""

    simulator: wy.Simulator
    frames: wy.Trajectory | None
    failure: str
    seconds: float

    @classmethod
    def of(cls, case: Case, finer: int = 1, **options: Any) -> Run:
        scene = case.scene(finer)
        simulator = wy.Simulator(scene, step=case.step / finer, **options)
        simulator.state = case.start(scene, simulator.state)
        begin = time.perf_counter()
        try:
            frames = simulator.run(finer * case.steps)
        except wy.SimulationError as error:
            return cls(simulator, None, str(error), time.perf_counter() - begin)
        kept = {name: getattr(frames, name)[::finer] for name in ("position", "euler", "velocity", "euler_velocity")}
        kept["anchor"] = frames.anchor[::finer]
        frames = dataclasses.replace(frames, step=case.step, **kept)
        return cls(simulator, frames, "", time.perf_counter() - begin)


def distance(a: np.ndarray, b: np.ndarray | float) -> float:
    """Measure how far two arrays of positions are from each other, root mean square [m]."""
    return float(np.sqrt(((a - b) ** 2).sum(axis=-1).mean()))


def motion(case: Case, frames: wy.Trajectory, *, falling: bool) -> float:
    """Measure how far nodes move, as seen by one who flies and is carried along, and falls with a cloth that is free
    [m]."""
    x = frames.position - frames.position[0]
    if falling and case.kind in ("free", "thrown"):
        x = x - x.mean(axis=1, keepdims=True)
        return distance(x, 0.0)
    return distance(x, frames.time[:, None, None] * np.array(case.speed))


def along(frames: wy.Trajectory, k: int, share: float) -> wy.State:
    """Make a state within the step from frame k, on a cubic through its ends."""
    h, t = frames.step, share
    a, b = frames[k], frames[k + 1]
    x = a.position * (1 + 2 * t) * (1 - t) ** 2 + b.position * t * t * (3 - 2 * t)
    x += h * (a.velocity * t * (1 - t) ** 2 - b.velocity * t * t * (1 - t))
    v = 6 * t * (1 - t) / h * (b.position - a.position)
    v += a.velocity * (1 - t) * (1 - 3 * t) + b.velocity * t * (3 * t - 2)
    euler = a.euler * (1 - t) + b.euler * t
    return wy.State(x, euler, v, a.euler_velocity * (1 - t) + b.euler_velocity * t)


def momentum(simulator: wy.Simulator, state: wy.State) -> np.ndarray:
    """Add up the momentum of all nodes [kg m/s]."""
    mass = simulator.system(state, weights=(1.0, 0.0, 0.0))
    rates = [state.velocity, state.euler_velocity] if simulator.scene.sliding else [state.velocity]
    v = np.concatenate([part.ravel() for part in rates])
    product = np.zeros(len(v))
    np.add.at(product, mass.rows, mass.entries * v[mass.columns])
    return product[: state.velocity.size].reshape(-1, 3).sum(axis=0)


def energies(case: Case, simulator: wy.Simulator, frames: wy.Trajectory) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Add up the energy of every frame, that beside gravity, and the work done since the first [J]."""
    h, scene = frames.step, simulator.scene
    speed = np.array(case.speed) * (case.kind == "carried")
    total, inner, work = [], [], [0.0]
    impulse = np.zeros(3)
    start = momentum(simulator, frames[0])
    before = 0.0
    for k in range(len(frames)):
        state = frames[k]
        energy = simulator.energy(state)
        if "pins" in energy:
            offset = state.position[scene.pins] - scene.cloth.position[scene.pins] - k * h * speed
            energy["pins"] = 0.5 * scene.pin_stiffness * float((offset**2).sum())
        total.append(sum(energy.values()))
        inner.append(total[-1] - energy.get("gravity", 0.0))
        if k:
            of_wind = 0.0
            for share in (np.arange(WITHIN) + 0.5) / WITHIN:
                here = along(frames, k - 1, share)
                forces = simulator.forces(here)
                if "wind" in forces:
                    wind = forces["wind"][0]
                    of_wind += float((wind * here.velocity).sum()) * h / WITHIN
                    impulse += wind.sum(axis=0) * h / WITHIN
                impulse += forces["gravity"][0].sum(axis=0) * h / WITHIN
            before += of_wind
            pins = float(speed @ (momentum(simulator, state) - start - impulse))
            work.append(before + pins)
    return np.array(total), np.array(inner), np.array(work)


def compare(case: Case, integrator: str = "sdirk2", newton_tolerance: float | None = None) -> dict[str, Any]:
    """One row of the table."""
    options: dict[str, Any] = {"integrator": integrator}
    by_default = Run.of(case, **options, newton_tolerance=newton_tolerance)
    tight = Run.of(case, **options, **TIGHT)
    fine = Run.of(case, FINER, **options, **TIGHT)
    less = Run.of(case, FINER // 2, **options, **TIGHT)
    row: dict[str, Any] = {**dataclasses.asdict(case), "wind": case.wind is not None, "speed": "", "spin": ""}
    row["speed"], row["spin"] = (float(np.linalg.norm(v)) for v in (case.speed, case.spin))
    model = by_default.simulator.model
    row["k_s h²/(m L)"] = float((stretch_rate(model.scene).max() * case.step) ** 2)
    row["preconditioner"] = model.preconditioner
    row |= {"ratio": "", "doubt": "", "of motion": "", "of all": "", "error": "", "gain": "", "gain of tight": ""}
    row["split"], row["damped"] = len(by_default.simulator.split_steps), len(by_default.simulator.damped_steps)
    row["failure"], row["tight failure"] = by_default.failure, tight.failure
    row["fine failure"] = fine.failure or less.failure
    row["seconds"], row["tight seconds"] = by_default.seconds, tight.seconds
    if by_default.frames is not None and tight.frames is not None:
        off = distance(by_default.frames.position, tight.frames.position)
        row["of motion"] = off / motion(case, tight.frames, falling=True)
        row["of all"] = off / motion(case, tight.frames, falling=False)
        if fine.frames is not None:
            error = distance(by_default.frames.position, fine.frames.position)
            row["ratio"] = off / error
            row["error"] = error / motion(case, fine.frames, falling=True)
            if less.frames is not None:
                row["doubt"] = distance(less.frames.position, fine.frames.position) / error
    for name, run in (("gain", by_default), ("gain of tight", tight)):
        if run.frames is not None:
            total, inner, work = energies(case, run.simulator, run.frames)
            row[name] = float((total - total[0] - work)[1:].max() / np.maximum(inner.max(), 1e-300))
    return row


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=180, help="(%(default)s)")
    parser.add_argument("--first", type=int, default=0, help="number of the first scene (%(default)s)")
    parser.add_argument("--integrator", default="sdirk2", help="(%(default)s)")
    parser.add_argument("--newton-tolerance", type=float, help="in place of the default's")
    parser.add_argument("--output", type=Path, default=RESULTS / "defaults.csv", help="CSV file (%(default)s)")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    about = environment()
    rows = []
    shown = (
        "number",
        "kind",
        "fabric",
        "stretch",
        "step",
        "sliding",
        "ratio",
        "doubt",
        "of motion",
        "of all",
        "error",
        "gain",
    )
    for number in range(options.first, options.first + options.scenes):
        rows.append(compare(Case.of(number), options.integrator, options.newton_tolerance))
        row = rows[-1]
        failed = "; ".join(f"{name}: {row[name]}" for name in ("failure", "tight failure", "fine failure") if row[name])
        values = (f"{row[key]:.3g}" if isinstance(row[key], float) else str(row[key]) for key in shown)
        print("  ".join(values), f"split {row['split']} damped {row['damped']}", failed, flush=True)
    print_table([{key: row[key] for key in shown} for row in rows])
    known = [row["ratio"] for row in rows if row["ratio"] != ""]
    print(f"ratio: {np.percentile(known, [0, 25, 50, 75, 90, 100])} (least, quartiles, 90 %, most)")
    print("failed:", sum(row["failure"] != "" for row in rows), "of", len(rows))
    print("most gained:", max(row["gain"] for row in rows if row["gain"] != ""))
    write_csv(options.output, rows, about)
    print("written:", options.output)


if __name__ == "__main__":
    main()
