"""What each term of a scene costs and changes: the scene again with its terms left out in turn, and without sliding."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np

from ..description.obstacles import Obstacle
from ..description.scene import Scene
from ..errors import InputError, SimulationError, integer, real
from ..kernels import TERMS
from .simulator import Simulator
from .state import State

DEARER = -0.1
"""Costs below this are worth a word: the solver needs the term more than the cloth does."""

TIMED_ONCE = 5.0
"""Times as long as the whole scene's: runs from there on are timed once."""


@dataclasses.dataclass(frozen=True)
class Change:
    """A scene with something left out or done otherwise, beside the whole one.

    Args:
        name: of what was left out: a term, "sliding" (yarns do not slide, and the terms that only sliding has), or the
            names of several.
        moved: how far that moves the cloth: root mean square over nodes and frames of the distance of positions,
            relative to that of the displacement from the beginning; None: the run failed.
        cost: what it takes of the whole scene's time, 1 − the ratio of times; negative where leaving it out makes the
            rest dearer; None: the run failed.
        spread: interquartile range of the cost.
        failure: what happened, or "".
    """

    name: str
    moved: float | None
    cost: float | None
    spread: float
    failure: str = ""

    def __str__(self) -> str:
        if self.moved is None or self.cost is None:
            return f"{self.name} cannot be left out: {self.reason}"
        moved = f"{self.name} moves the cloth by {percent(self.moved)}"
        if self.cost <= DEARER:
            return f"{moved}, and without it a step takes {1.0 - self.cost:.1f} times as long"
        return f"{moved} and costs {self.price}"

    @property
    def reason(self) -> str:
        """The first sentence of the failure."""
        return self.failure.split(". ")[0]

    @property
    def price(self) -> str:
        return f"{100 * self.cost:.0f} % of the step" if self.cost is not None and self.cost >= 0.005 else "nothing"


@dataclasses.dataclass(frozen=True)
class Ablation:
    """What leaving things out of a scene does.

    Args:
        seconds: wall time of a step of the whole scene, the median of repeated runs [s].
        step_error: how far the same scene at half its step moves the cloth, as ``Change.moved``: about half of the
            error of a first-order method's step, and three quarters of a second-order one's.
        changes: one for each thing that was left out.
        unneeded: the names of those that move the cloth less than halving the step does, and cost something; without
            those that only sliding has, where sliding is among them.
        together: all of these left out at once; None where there are fewer than two.
    """

    seconds: float
    step_error: float
    changes: tuple[Change, ...]
    unneeded: tuple[str, ...]
    together: Change | None

    def lines(self) -> list[str]:
        """Says what was found, in words."""
        found = [str(change) for change in self.changes]
        found.append(f"half the step moves the cloth by {percent(self.step_error)}")
        if not self.unneeded:
            return [*found, "at this step the scene needs all of it"]
        text = f"at this step the scene does not need: {', '.join(self.unneeded)}"
        if self.together is None:
            return [*found, text]
        if self.together.moved is None:
            return [*found, f"{text}; but it needs one of them: {self.together.reason}"]
        moved, price = percent(self.together.moved), self.together.price
        return [*found, f"{text}; together they move the cloth by {moved} and cost {price}"]


def percent(fraction: float) -> str:
    """Writes a fraction in percent, with two digits."""
    return f"{100 * fraction:.2g} %" if fraction < 0.995 else f"{100 * fraction:.0f} %"


def ablate(
    scene: Scene, *, steps: int = 100, step: float = 1e-3, repeats: int = 5, start: State | None = None, **options: Any
) -> Ablation:
    """Runs a scene, and again without each of its terms in turn, without sliding, and at half the step.

    Args:
        scene: the whole scene.
        steps: how many, at least 1; what the scene does later has no part in the result.
        step: h [s], above 0.
        repeats: timed runs of each, at least 1, after one that compiles; in turn, so that what else the machine does
            falls on all alike.
        start: the state to start from; None: at rest.
        options: of the Simulator.

    Raises:
        InputError: an argument that cannot be used, or a cloth that does not move.
        SimulationError: the whole scene cannot be simulated. Another one that cannot is a Change with a failure.
    """
    steps, repeats = integer("steps", steps, least=1), integer("repeats", repeats, least=1)
    step = real("step", step, above=0.0)

    def run(scene: Scene, fine: int = 1) -> _Run:
        return _Run(scene, fine * steps, step / fine, start, options)

    full, half = run(scene), run(_halved(scene, start), 2)
    full.make()
    half.make()
    left_out = [name for name in scene.terms if not TERMS[name].kept] + ["sliding"] * scene.sliding
    moved = full.distance(full.position[0])
    if moved == 0.0:
        raise InputError("the cloth does not move: there is nothing that a change could be relative to")
    step_error = full.distance(half.position[::2]) / moved
    changes = _compared(full, moved, repeats, {name: run(_without(scene, {name})) for name in left_out})
    unneeded = _unneeded(changes, step_error)
    together = None
    if len(unneeded) > 1:
        (together,) = _compared(full, moved, repeats, {", ".join(unneeded): run(_without(scene, set(unneeded)))})
    return Ablation(float(np.median(full.seconds)) / steps, step_error, tuple(changes), unneeded, together)


def _unneeded(changes: list[Change], step_error: float) -> tuple[str, ...]:
    names = [
        c.name for c in changes if c.moved is not None and c.moved < step_error and c.cost is not None and c.cost > 0
    ]
    if "sliding" in names:
        names = [name for name in names if name == "sliding" or not TERMS[name].sliding_only]
    return tuple(names)


class _Run:
    """Runs of one scene: positions of its frames and times [s]."""

    def __init__(self, scene: Scene, steps: int, step: float, start: State | None, options: dict[str, Any]):
        self.simulator = Simulator(scene, step=step, **options)
        if start is not None:
            if not scene.sliding:
                start = dataclasses.replace(start, euler_velocity=np.zeros_like(start.euler_velocity))
            self.simulator.state = start
        self.start, self.steps = self.simulator.state, steps
        self.position = np.zeros(0)
        self.seconds: list[float] = []

    def make(self) -> float:
        """Makes one run from the beginning, and gives its wall time [s]."""
        self.simulator.state, self.simulator.steps_done = self.start, 0
        begin = time.perf_counter()
        self.position = self.simulator.run(self.steps).position
        return time.perf_counter() - begin

    def distance(self, position: np.ndarray) -> float:
        return float(np.sqrt(((self.position - position) ** 2).sum(axis=-1).mean()))


def _compared(full: _Run, moved: float, repeats: int, runs: dict[str, _Run]) -> list[Change]:
    """Compares runs with that of the whole scene, timed in turn with it."""
    failures = {}
    for name, run in runs.items():
        try:
            run.make()
        except SimulationError as error:
            failures[name] = str(error)
    made = {name: run for name, run in runs.items() if name not in failures}
    ratios: dict[str, list[float]] = {name: [] for name in made}
    for _ in range(repeats):
        whole_time = full.make()
        full.seconds.append(whole_time)
        for name, run in made.items():
            # what takes that much longer needs no second look
            if not ratios[name] or ratios[name][0] < TIMED_ONCE:
                ratios[name].append(run.make() / whole_time)
    changes = []
    for name, run in runs.items():
        if name in failures:
            changes.append(Change(name, None, None, 0.0, failures[name]))
            continue
        lower, median, upper = np.percentile(ratios[name], [25.0, 50.0, 75.0])
        changes.append(Change(name, full.distance(run.position) / moved, 1.0 - float(median), float(upper - lower)))
    return changes


def _without(scene: Scene, names: set[str]) -> Scene:
    """Makes the scene without these terms, or sliding."""
    sliding = scene.sliding and "sliding" not in names
    left = (name for name in scene.terms if name not in names)
    return scene.replace(sliding=sliding, terms=[name for name in left if sliding or not TERMS[name].sliding_only])


def _halved(scene: Scene, start: State | None) -> Scene:
    """Makes the scene for half the step: pins and obstacles go evenly to where they are at a step's end, and forces,
    gravity and wind stay for two."""
    path = scene.pin_path
    if path is not None:
        first = (scene.cloth if start is None else start).position[scene.pins]
        before = np.concatenate([first[None], path[:-1]])
        path = np.stack([0.5 * (before + path), path], axis=1).reshape(-1, *path.shape[1:])

    def twice(rows: Any) -> Any:
        return np.repeat(rows, 2, axis=0) if np.ndim(rows) == 2 else rows

    forces = {node: twice(force) for node, force in scene.forces.items()}
    wind = None if scene.wind is None else scene.wind.replace(velocity=twice(scene.wind.velocity))
    obstacles = [o if o.path is None else o.replace(path=_halved_poses(o, o.path)) for o in scene.obstacles]
    return scene.replace(pin_path=path, forces=forces, obstacles=obstacles, gravity=twice(scene.gravity), wind=wind)


def _halved_poses(obstacle: Obstacle, path: np.ndarray) -> np.ndarray:
    """Adds poses in the middle of an obstacle's steps."""
    before = np.vstack([[*obstacle.position, *obstacle.rotation], path[:-1]])
    after = path.copy()
    # the shorter way round; halfway, the mean of two rotations is the one between
    after[:, 3:] *= np.where((before[:, 3:] * after[:, 3:]).sum(axis=1, keepdims=True) < 0.0, -1.0, 1.0)
    middle = 0.5 * (before + after)
    middle[:, 3:] /= np.linalg.norm(middle[:, 3:], axis=1, keepdims=True)
    return np.stack([middle, path], axis=1).reshape(-1, 7)
