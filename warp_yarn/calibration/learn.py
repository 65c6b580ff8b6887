"""Learns parameters of a fabric from frames of its motion. Needs the extras ``torch`` and ``bench`` (SciPy).

A ``Task`` is a least-squares problem: frames, a scene that is to reproduce them, and what may change in it within which
ranges. ``learn`` solves it and says how sure the answer is. ``docs/learning.md`` tells how to read it.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import itertools
import math
import os
import re
import time
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import scipy.optimize
import torch
import tqdm

from ..description.scene import Scene
from ..device.arrays import STATE_TYPES
from ..errors import GradientError, InputError, SimulationError, finite_array
from ..errors import integer as whole
from ..errors import real as number
from ..gradients.rollout import Rollout
from ..io.files import atomic_write as whole_file
from ..simulation.simulator import Simulator
from ..simulation.state import CLOTH_NUMBERS, FIELDS, Trajectory

# -- parameters -------------------------------------------------------------------------------------------------------

OF_YARNS = ("density", "stretch", "bend")
OF_CLOTHS = tuple(name for name in CLOTH_NUMBERS if name not in ("spacing", "radius"))
OF_WINDS = {"wind_velocity": "velocity", "wind_density": "density", "wind_drag": "drag"}


@dataclasses.dataclass(frozen=True)
class Parameter:
    """What is to be learned, in its own unit.

    Args:
        name: "density[k]", "stretch[k]", "bend[k]" of material k; a number of the cloth, such as "shear" or "friction";
            "wind_velocity[k]", "wind_density", "wind_drag", "gravity[k]" or "pin_stiffness", where the scene has them.
        low, high: the range, its ends included; low below high.
        start: where learning begins, in the range.
    """

    name: str
    low: float
    high: float
    start: float

    def __post_init__(self) -> None:
        for end in ("low", "high", "start"):
            number(f"{self.name}: {end}", getattr(self, end))
        if not self.low < self.high:
            raise InputError(f"{self.name}: low = {self.low:g}, must be below high = {self.high:g}")
        if not self.low <= self.start <= self.high:
            raise InputError(f"{self.name}: start = {self.start:g}, must be from {self.low:g} to {self.high:g}")


PAPER = (
    Parameter("density[0]", 1e-3, 3e-3, 2.25e-3),
    Parameter("density[1]", 1e-3, 3e-3, 2.45e-3),
    Parameter("stretch[0]", 0.0, 8e5, 3.35e5),
    Parameter("stretch[1]", 0.0, 3e5, 1.45e5),
    Parameter("bend[0]", 5e-5, 1.8e-4, 1.25e-4),
    Parameter("bend[1]", 5e-5, 1.8e-4, 1.0e-4),
    Parameter("shear", 0.0, 1200.0, 600.0),
    Parameter("friction", 0.0, 1.0, 0.7),
)
"""What the paper learns, with ranges and starts."""


def split(name: str) -> tuple[str, int | None]:
    """``bend[1]`` as ("bend", 1), and ``shear`` as ("shear", None)."""
    match = re.fullmatch(r"(\w+)(?:\[(\d+)\])?", name)
    if match is None:
        raise InputError(f"parameter {name!r}, must be a name, or a name and an index such as 'bend[0]'")
    return match[1], None if match[2] is None else int(match[2])


def learnable(scene: Scene) -> dict[str, int | None]:
    """What can be learned of a scene: the name, and how many numbers it has; None: one, which takes no index."""
    result: dict[str, int | None] = {**dict.fromkeys(OF_YARNS, len(scene.cloth.yarns)), **dict.fromkeys(OF_CLOTHS)}
    if scene.wind is not None:
        result |= {"wind_velocity": 3, "wind_density": None, "wind_drag": None}
    if scene.gravity is not None:
        result["gravity"] = 3
    if len(scene.pins) and scene.pin_stiffness is not None:
        result["pin_stiffness"] = None
    return result


def value_of(scene: Scene, name: str) -> float:
    """The scene's own value of a parameter, named as in ``Parameter``."""
    base, k = split(name)
    counts = learnable(scene)
    if base not in counts:
        raise InputError(f"parameter {name!r}, must be one that this scene has: {', '.join(counts)}")
    count = counts[base]
    if count is None and k is not None:
        raise InputError(f"parameter {name!r}: {base} is one number, it takes no index")
    if count is not None and (k is None or k >= count):
        raise InputError(f"parameter {name!r}, must have an index from 0 to {count - 1}, such as '{base}[0]'")
    if base in OF_YARNS and k is not None:
        return float(getattr(scene.cloth.yarns[k], base))
    if base in OF_CLOTHS:
        return float(getattr(scene.cloth, base))
    value = getattr(scene.wind, OF_WINDS[base]) if base in OF_WINDS else getattr(scene, base)
    return float(value if k is None else value[k])


def with_values(scene: Scene, values: Mapping[str, float]) -> Scene:
    """A copy of a scene with other values of these parameters, named as in ``Parameter``.

    Raises:
        InputError: a name that the scene does not have, or a value that it does not allow.
    """
    for name in values:
        value_of(scene, name)
    parts: dict[tuple[str, int | None], Any] = {split(name): float(value) for name, value in values.items()}
    old = scene.cloth
    changes: dict[str, Any] = {}
    yarns = [
        dataclasses.replace(yarn, **{base: value for (base, j), value in parts.items() if base in OF_YARNS and j == k})
        for k, yarn in enumerate(old.yarns)
    ]
    numbers = {name: parts.get((name, None), getattr(old, name)) for name in CLOTH_NUMBERS}
    changes["cloth"] = old.replace(yarns=yarns, pose=old.position, **numbers)
    if scene.wind is not None:
        velocity: Any = tuple(parts.get(("wind_velocity", k), value) for k, value in enumerate(scene.wind.velocity))
        rest = {OF_WINDS[name]: parts[name, None] for name in ("wind_density", "wind_drag") if (name, None) in parts}
        changes["wind"] = dataclasses.replace(scene.wind, velocity=velocity, **rest)
    if scene.gravity is not None:
        changes["gravity"] = np.array([parts.get(("gravity", k), value) for k, value in enumerate(scene.gravity)])
    if ("pin_stiffness", None) in parts:
        changes["pin_stiffness"] = parts["pin_stiffness", None]
    return scene.replace(**changes)


def with_paths(scene: Scene, start: np.ndarray, first: int | Fraction, ratio: Fraction, steps: int) -> Scene:
    """Give a scene the rows of ``pin_path`` and ``forces`` that a model needs whose steps are not the scene's rows.

    Row k of a path is of the time from k to k + 1, in rows. The model's step j is of the time from first + j ratio to
    first + (j + 1) ratio. Pins move linearly from row to row, and a force is its mean over the model's step: the motion
    of the pins and the impulse of the forces are the same with every step.

    Args:
        scene: the scene, left as it is.
        start: where the pins are at time 0 and before, ahead of their first row [pins, 3] (m).
        first: time at which the model's first step begins, a whole number of rows or of the model's steps from one;
            before time 0 there is the force of row 0.
        ratio: the model's step in rows.
        steps: how many it makes.
    """
    changes: dict[str, Any] = {}
    # as integers over the denominator, so that times of rows are hit exactly
    origin = int(first * ratio.denominator)
    times = np.array([origin + j * ratio.numerator for j in range(steps + 1)]) / ratio.denominator
    if scene.pin_path is not None:
        places = np.concatenate([start[None], scene.pin_path]).reshape(len(scene.pin_path) + 1, -1)
        moves = [np.interp(times[1:], np.arange(len(places)), of_time) for of_time in places.T]
        changes["pin_path"] = np.stack(moves, axis=1).reshape(steps, -1, 3)
    if len(scene.force_path) > 1:
        last = len(scene.force_path) - 1
        path = np.zeros((steps + 1, *scene.force_path.shape[1:]))
        for j, (begin, end) in enumerate(itertools.pairwise(times)):
            rows = np.arange(math.floor(begin), math.ceil(end))
            share = (np.minimum(rows + 1, end) - np.maximum(rows, begin)) / (end - begin)
            path[j] = np.tensordot(share, scene.force_path[np.clip(rows, 0, last)], axes=1)
        forces = enumerate(scene.forces.items())
        changes["forces"] = {node: f if f.ndim == 1 else path[:-1, k] for k, (node, f) in forces}
    return scene.replace(**changes)


# -- the problem ------------------------------------------------------------------------------------------------------

DIFFERENCE = 1e-4
"""Width of differences of runs [ranges]: curvature adds some 1e-4 of a derivative to it."""

WIDER, WIDEST = 30.0, 0.1
"""Where differences may be what the solver leaves of runs, and do not agree with their neighbours, they are taken so
many times as wide, and so wide at most [ranges]."""

SOLVED = 1e-10
"""``newton_tolerance`` of runs in double precision. What 1e-8, that of gradients, leaves of runs of light, stiff yarns
is as large as what small changes of some parameters make, and a search finds no way through it."""

TINY = 1e-8
"""A change of all values that changes little but what the solver leaves [ranges]."""

CLEAR = 30.0
"""A change of residuals that is so many times what one run shows that the solver leaves is a change."""

SURE = 1e-6
"""So is one that is this part of the nodes' paths: the solver sometimes leaves much more than one run shows, some 4e-7
of the path of light, stiff yarns."""


class Task:
    """Frames, and a scene that is to reproduce them.

    The model starts in the state of one of the frames (positions, velocities, (u, v), friction's anchors), and its
    positions are compared with those of the frames after it. Methods take the values of the parameters, in their units
    and in their order, as an array [parameters].

    ``pin_path`` and ``forces`` of the scene go by the target's frames, whatever the model's step: row k is of the time
    from frame k to frame k + 1, so that learning from frame ``first`` on begins with row ``first``. In steps of another
    length pins move linearly from row to row (to row 0 from where frame 0 has them), and a force is its mean over the
    step: that of the row where the step lies in one.

    A task can be copied, pickled and sent to another process, and so can a ``Result``; its rollout is made there anew.

    Args:
        scene: the model; what is not learned keeps its values.
        target: the frames.
        parameters: what to learn.
        frames: how many frames to compare with, at least 1; None: all that there are.
        first: the frame to start from.
        every: take only every so many-th frame after it (10: data at 0.1 ms as frames of 1 ms).
        step: h of the model [s]; the time between compared frames must be a whole multiple of it. None: that time.
        options: of the Simulator: integrator, tolerance, device, ... ``newton_tolerance`` is 1e-10 in double precision.

    Attributes:
        initial: the state that the model starts in.
        positions: what it is compared with [frames, nodes, 3] (m).
        path: length of the nodes' paths from frame to frame, root mean square [m].
        step: its step [s].
        rollout: of the scene with its own values, of the model's step.
        cost: how many runs one of its runs counts as: 1, or so many times as its step was halved, in powers of 2.
        simulations: runs made so far, those that gradients begin with among them.
        gradients: backward runs made so far.
    """

    def __init__(
        self,
        scene: Scene,
        target: Trajectory,
        parameters: Sequence[Parameter],
        *,
        frames: int | None = None,
        first: int = 0,
        every: int = 1,
        step: float | None = None,
        **options: Any,
    ):
        self.scene, self.parameters, self.options = scene, tuple(parameters), options
        if options.get("precision", "double") == "double":
            options.setdefault("newton_tolerance", SOLVED)
        self.names = [p.name for p in self.parameters]
        self.low, self.high, self.start = (
            np.array([getattr(p, end) for p in self.parameters], dtype=np.float64) for end in ("low", "high", "start")
        )
        self._check_parameters()
        chosen = self._chosen_frames(target, frames, first, every)
        self.initial = target[int(chosen[0])]
        self.positions = target.position[chosen[1:]].copy()
        self.frame_time = target.step * every
        self._first, self._every = first, every
        paths = np.diff(target.position[chosen], axis=0)
        self.path = float(np.sqrt(np.mean(np.linalg.norm(paths, axis=2).sum(axis=0) ** 2)))
        self._pins_at_start = target.position[0, scene.pins].copy()
        self._state = {name: torch.as_tensor(getattr(self.initial, name)) for name in FIELDS}
        self._prepare(1 if step is None else self._steps_per_frame(number("step", step, above=0.0)))
        self.cost = 1
        self.simulations = self.gradients = 0

    def _prepare(self, steps_per_frame: int) -> None:
        """Settles the step, and with it the rollout."""
        self.steps_per_frame, self.step = steps_per_frame, self.frame_time / steps_per_frame
        self.__dict__.pop("rollout", None)
        self.rollout.simulator.state = self.initial  # to have it checked

    @functools.cached_property
    def rollout(self) -> Rollout:
        after = np.arange(1, len(self.positions) + 1) * self.steps_per_frame
        scene = self._in_steps(self.scene, self.steps_per_frame, len(self.positions))
        return Rollout(scene, int(after[-1]), frames=after.tolist(), step=self.step, **self.options)

    def __getstate__(self) -> dict[str, Any]:
        # what is on the device stays there
        return {name: value for name, value in self.__dict__.items() if name != "rollout"}

    def _in_steps(self, scene: Scene, steps_per_frame: int, frames: int) -> Scene:
        """A scene whose paths go by the model's steps. Its runs begin after one step, which ends with the pins at
        their places in the initial state."""
        ratio = Fraction(self._every, steps_per_frame)
        return with_paths(scene, self._pins_at_start, self._first - ratio, ratio, 1 + steps_per_frame * frames)

    def halved(self) -> Task:
        """The same task for a model of half the step, with the runs that this one has made."""
        result = copy.copy(self)
        result._prepare(2 * self.steps_per_frame)
        result.cost = 2 * self.cost
        return result

    def held(self, k: int, values: np.ndarray) -> Task:
        """The same task without parameter k, which has its value of these; the others start with theirs."""
        result = copy.copy(self)
        result.scene = with_values(self.scene, {self.names[k]: values[k]})
        kept = [j for j in range(len(values)) if j != k]
        result.parameters = tuple(dataclasses.replace(self.parameters[j], start=values[j]) for j in kept)
        result.names = [self.names[j] for j in kept]
        result.low, result.high, result.start = self.low[kept], self.high[kept], values[kept]
        result._prepare(self.steps_per_frame)
        return result

    def _check_parameters(self) -> None:
        if not self.names:
            raise InputError("parameters is empty, must name at least one")
        for name in self.names:
            if self.names.count(name) > 1:
                raise InputError(f"parameters names {name!r} twice")
        for ends in (self.low, self.high):
            self.scene_with(ends)

    def _chosen_frames(self, target: Trajectory, frames: int | None, first: int, every: int) -> np.ndarray:
        """Indices of the frame to start from and of those to compare with."""
        ours, theirs = self.scene.cloth.weave, target.cloth.weave
        if (ours.rows, ours.columns) != (theirs.rows, theirs.columns):
            raise InputError(
                f"target has {theirs.rows} × {theirs.columns} nodes, must have the scene's {ours.rows} × {ours.columns}"
            )
        for name in FIELDS:
            shape = (len(target), self.scene.cloth.nodes, STATE_TYPES[name])
            finite_array(f"target.{name}", getattr(target, name), shape)
        first, every = whole("first", first, least=0), whole("every", every, least=1)
        there = max(0, len(target) - 1 - first) // every
        wanted = there if frames is None else whole("frames", frames, least=1)
        if wanted > there or there == 0:
            raise InputError(
                f"frames = {wanted or 'all'}, first = {first}, every = {every}: the target has {len(target)} frames, "
                f"which leaves {there} to compare with"
            )
        return first + every * np.arange(wanted + 1)

    def _steps_per_frame(self, step: float) -> int:
        frame = self.frame_time
        result = round(frame / step)
        # 1e-6: what decimal times and their quotient leave of a whole number
        if result < 1 or abs(frame / step - result) > 1e-6:
            raise InputError(f"step = {step:g} s, must fit a whole number of times into the {frame:g} s of a frame")
        return result

    def scene_with(self, values: np.ndarray) -> Scene:
        """The scene with these values."""
        return with_values(self.scene, dict(zip(self.names, values, strict=True)))

    def _own(self, base: str) -> np.ndarray:
        """The scene's own values of all numbers of this name."""
        count = learnable(self.scene)[base]
        if count is None:
            return np.array(value_of(self.scene, base))
        return np.array([value_of(self.scene, f"{base}[{k}]") for k in range(count)])

    def _inputs(self, values: np.ndarray, differentiated: bool) -> dict[str, torch.Tensor]:
        """What the rollout takes."""
        arrays: dict[str, np.ndarray] = {}
        for name, value in zip(self.names, values, strict=True):
            base, k = split(name)
            if base not in arrays:
                arrays[base] = self._own(base)
            arrays[base][() if k is None else k] = value
        leaves = {name: torch.tensor(value, requires_grad=differentiated) for name, value in arrays.items()}
        return {**self._state, **leaves}

    def _run(self, inputs: dict[str, torch.Tensor]) -> torch.Tensor:
        """The residuals of a run."""
        self.simulations += self.cost
        offset = self.rollout(**inputs, steps_done=1).position.double().cpu() - torch.as_tensor(self.positions)
        return offset / np.sqrt(len(self.positions) * self.scene.cloth.nodes)

    @torch.no_grad()
    def residuals(self, values: np.ndarray) -> np.ndarray:
        """(x − x̂)/√(frames·nodes), flat [frames·nodes·3] (m): their squares add up to the loss. One simulation.

        Raises:
            SimulationError: the model cannot be simulated with these values.
        """
        return self._run(self._inputs(values, differentiated=False)).numpy().ravel()

    def loss(self, values: np.ndarray) -> float:
        """Mean over frames and nodes of the squared distance to the data [m²]: the paper's 𝓛, of positions."""
        residuals = self.residuals(values)
        return float(residuals @ residuals)

    def loss_and_gradient(self, values: np.ndarray) -> tuple[float, np.ndarray]:
        """The loss, and its exact gradient by the adjoint, per unit of each parameter [parameters].

        Raises:
            SimulationError: the model cannot be simulated with these values.
            GradientError: it can, but not differentiated.
        """
        inputs = self._inputs(values, differentiated=True)
        loss = self._run(inputs).square().sum()
        self.gradients += self.cost
        loss.backward()
        parts = [(inputs[base].grad, k) for base, k in map(split, self.names)]
        return float(loss.detach()), np.array([float(part if k is None else part[k]) for part, k in parts])

    def jacobian(self, values: np.ndarray, residuals: np.ndarray) -> np.ndarray:
        """∂residuals/∂y [residuals, parameters], y = (value − low)/(high − low), by differences.

        A run a parameter, and one that shows what the solver leaves. A difference that may be no more than that is
        compared with one from there on, and taken wider until the two agree; 0 where the widest have nothing in common.

        Args:
            values: where.
            residuals: there.

        Raises:
            SimulationError: the model can be simulated on neither side.
        """
        inwards = np.where(values < 0.5 * (self.low + self.high), 1.0, -1.0)
        moves = np.diag(inwards)
        columns = [self._difference(values, residuals, DIFFERENCE, move) for move in moves]
        tiny = self._difference(values, residuals, TINY, inwards)
        left = TINY * float(np.linalg.norm(tiny - np.sum(columns, axis=0)))
        for k, move in enumerate(moves):
            if DIFFERENCE * np.linalg.norm(columns[k]) < max(CLEAR * left, SURE * self.path):
                columns[k] = self._confirmed(values, residuals, columns[k], move)
        return np.stack(columns, axis=1) * inwards

    def _confirmed(self, values: np.ndarray, residuals: np.ndarray, column: np.ndarray, move: np.ndarray) -> np.ndarray:
        """A difference by ``move`` that another agrees with, beginning with a column of the usual width."""
        width = DIFFERENCE
        while True:
            try:
                both = self._difference(values, residuals, 2.0 * width, move)
            except SimulationError:  # so far from here the model fails: what there is must do
                return column
            # the other is 2 both − column
            apart, together = np.linalg.norm(2.0 * (both - column)), np.linalg.norm(2.0 * both)
            if apart < 0.25 * together:
                return both
            if width == WIDEST:
                return both if apart < together else np.zeros_like(both)
            width = min(WIDER * width, WIDEST)
            try:
                column = self._difference(values, residuals, width, move)
            except SimulationError:
                return both

    def _difference(self, values: np.ndarray, residuals: np.ndarray, width: float, move: np.ndarray) -> np.ndarray:
        """(r(y + width · move) − r(y))/width, with −width where the model fails and values stay in their ranges."""
        change = width * move * (self.high - self.low)
        try:
            return (self.residuals(values + change) - residuals) / width
        except SimulationError:
            if np.any(values - change < self.low) or np.any(values - change > self.high):
                raise
            return (self.residuals(values - change) - residuals) / -width

    def trajectory(self, values: np.ndarray, frames: int | None = None, *, refine: int = 1) -> Trajectory:
        """The model's motion with these values: the initial state, and frames as far apart as those compared.

        Args:
            frames: how many after the first; None: as many as are compared.
            refine: how many times as short a step to take.

        Raises:
            SimulationError: a step that could not be made; its trajectory has every step before.
        """
        count = len(self.positions) if frames is None else whole("frames", frames, least=1)
        every = self.steps_per_frame * whole("refine", refine, least=1)
        # The kernels that learning has compiled, though nothing is differentiated.
        options = {**self.options, "step": self.frame_time / every, "differentiable": True}
        simulator = Simulator(self._in_steps(self.scene_with(values), every, count), **options)
        simulator.state, simulator.steps_done = self.initial, 1
        motion = simulator.run(count * every)
        parts = {name: getattr(motion, name)[::every] for name in FIELDS}
        return dataclasses.replace(motion, step=self.frame_time, scene=None, start=0, **parts)


# -- the search -------------------------------------------------------------------------------------------------------

ENOUGH = 0.03
"""Learning ends where a full step would be shorter than this, in standard deviations of what is learned."""

BAR = "{desc} {n_fmt} {elapsed}{postfix}"
"""No bar but text, which fits beside eight values: nobody knows how many iterations it will take."""

SHORTEST = 1e-7
"""A step that is not worth a run [ranges]."""

KNOWN = 0.015
"""Standard deviation of a value for whose sake no shorter step is tried [ranges]: at most 3 % of the paper's values."""

LESS = 0.9
"""What must be left of a standard deviation, as far as can be foreseen, for a shorter step to be worth its runs."""

UNKNOWN = 1.0 / np.sqrt(12.0)
"""Standard deviation of a uniform distribution over a range [ranges]."""

DETERMINED = 0.5 * UNKNOWN
"""Standard deviation below which the data determine a parameter [ranges]: half of what the range alone says."""

SUSPECT = 0.1
"""Part of the step's error of unknown shape above which other values are allowed their own step's error."""

LINEAR = 2.0
"""Variances of 9, by which the loss rises within three standard deviations, that are linear enough."""

PROBING = 10
"""Iterations in which other values are to show how good they are (``_Search._probed``)."""


@dataclasses.dataclass(frozen=True)
class Iteration:
    """What is known after an iteration; number 0 is the start.

    Args:
        values: of the parameters, in their units [parameters].
        loss: at them [m²].
        step: of the model [s].
        simulations, gradients: runs so far, as of a Task.
        seconds: wall time so far; compiling, where kernels changed, is part of it.
    """

    values: np.ndarray
    loss: float
    step: float
    simulations: int
    gradients: int
    seconds: float


@dataclasses.dataclass(frozen=True)
class Result:
    """What was learned.

    Args:
        task: with the model's step that the values were learned with; the task's own, or one so many times halved.
        parameters: what was to be learned.
        values: by name.
        uncertainty: standard deviations, by name: what the data leave open (``uncertainties``; where the model does not
            respond linearly, as the loss rises) and the step's error, as far as it is known and as far as it is not.
        step_error: by name, how much of the value is due to the model's time step, estimated (``step_errors``) from a
            run with half the step; 0 where that run fails, and of what is not determined.
        step_share: how much of the step's error the data do not have, from 0, data of the same method and step, to 1,
            data of a continuous motion.
        corrected: the values without the step's error, by name, within their ranges.
        status: by name: "determined" or "not determined" by the data, and then ", at its lower bound" or ", at its
            upper bound".
        correlation: of the errors [parameters, parameters]; near ±1 where the data cannot tell two apart.
        loss: at the values [m²].
        gradient: of the loss, exact, with respect to (value − low)/(high − low) [parameters] (m²); NaN where it fails.
        history: every iteration.
        simulations, gradients, seconds: what it took, as of an Iteration.
        ended: why it ended.
    """

    task: Task
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
        without = {p.name: self.values[p.name] - self.step_error[p.name] for p in self.parameters}
        return {p.name: float(np.clip(without[p.name], p.low, p.high)) for p in self.parameters}


def learn(
    task: Task,
    *,
    iterations: int = 100,
    resolution: float = 1e-9,
    halvings: int = 3,
    checkpoint: str | os.PathLike | None = None,
    progress: bool = False,
    watch: Callable[[Iteration], None] = lambda iteration: None,
) -> Result:
    """Minimizes a task's loss within the ranges, by the method of Levenberg and Marquardt.

    The Jacobian comes from differences of runs; each step then corrects it by what it saw (Broyden), and differences
    are taken again where it predicted badly, and at the end. ``benchmarks/optimizers.py`` has other methods.

    Args:
        iterations: at most.
        resolution: how far the data's positions may be off at least, root mean square [m], above 0. Learning ends where
            the model is as near as that, and a parameter that moves positions by less is left where it is.
        halvings: how many times the model's step may be halved. It is where it leaves a value less sure than KNOWN, as
            far as its error stands in the residuals (``Result.step_share``), and where a model of half the step, with
            values without the step's part, is nearer to the data. Those of the model's own step and method are not.
        checkpoint: a file, ending in .npz, that is written at the start and after every iteration. Where it is there
            already, learning goes on from it, and ends where it would have ended without the interruption.
        progress: show a bar with the loss and the values, on a terminal.
        watch: called after every iteration.

    Raises:
        InputError: an argument out of its range, or a checkpoint of another task.
        SimulationError: the model cannot be simulated with the start values, or not on either side of later ones. A
            step to such values is shortened.

    Every exception, KeyboardInterrupt too, has the iterations until then as ``iterations`` [list of Iteration]: the
    last one's values are the best so far.
    """
    whole("iterations", iterations, least=0)
    search = _Search(task, number("resolution", resolution, above=0.0), whole("halvings", halvings, least=0))
    path = None if checkpoint is None else Path(checkpoint)
    if path is not None and path.suffix != ".npz":
        raise InputError(f"checkpoint = {str(checkpoint)!r}, must end in .npz")
    try:
        return _iterate(search, iterations, path, progress, watch)
    except BaseException as error:
        error.iterations = list(search.history)  # type: ignore[attr-defined]
        raise


def _iterate(
    search: _Search, iterations: int, path: Path | None, progress: bool, watch: Callable[[Iteration], None]
) -> Result:
    # The first run compiles the kernels where they changed, which takes many seconds, and says so meanwhile.
    with tqdm.tqdm(desc="compiling", bar_format=BAR, disable=None if progress else True) as bar:
        if path is not None and path.exists():
            search.load(path)
        else:
            search.begin()
            if path is not None:
                search.save(path)
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
                    search.save(path)
                watch(search.history[-1])
    return search.result(ended)


@dataclasses.dataclass(frozen=True)
class _Answer:
    """What the data leave open where the search is, in ranges.

    Args:
        covariance: of the values, as far as the residuals tell [p, p].
        of_data: standard deviations without the known part of the step's error [p].
        deviation: standard deviations, all of the step's error included [p].
        without_step: what they would be without the part of the residuals that the step explains [p].
        step_error: the part of the values that is due to the step [p].
        share: of the step's error that the data are without.
        unexplained: part of the step's error that is of unknown shape, from 0 to 1.
        moved: by how much that changes the model [m].
        variance: of a residual, with the unknown part of the step's error [m²].
    """

    covariance: np.ndarray
    of_data: np.ndarray
    deviation: np.ndarray
    without_step: np.ndarray
    step_error: np.ndarray
    share: float
    unexplained: float
    moved: float
    variance: float


class _Search:
    """Where learning is: y = (value − low)/(high − low), the residuals there, and the Jacobian as far as known."""

    def __init__(self, task: Task, resolution: float, halvings: int):
        self.task, self.resolution = task, resolution
        self.most_steps = task.steps_per_frame * 2**halvings
        self.y = (task.start - task.low) / (task.high - task.low)
        self.residuals = np.zeros(0)
        self.jacobian: Any = None  # or an array
        self.fresh = False  # whether the Jacobian is of differences taken here
        self.damping = 1e-3
        self.scale = np.zeros(len(self.y))  # the largest norm of each column so far, as Marquardt scales
        self.history: list[Iteration] = []
        self.began = time.perf_counter()

    @property
    def values(self) -> np.ndarray:
        return self._physical(self.y)

    def _physical(self, y: np.ndarray) -> np.ndarray:
        return self.task.low + y * (self.task.high - self.task.low)

    @property
    def loss(self) -> float:
        return float(self.residuals @ self.residuals)

    def begin(self) -> None:
        self.residuals = self.task.residuals(self.values)
        self._note()

    def _note(self) -> None:
        seconds = time.perf_counter() - self.began
        task = self.task
        self.history.append(Iteration(self.values, self.loss, task.step, task.simulations, task.gradients, seconds))

    def describe(self) -> str:
        values: dict[str, str] = {}
        for name, value in zip(self.task.names, self.values, strict=True):
            base = split(name)[0]
            values[base] = values.get(base, base) + f" {value:.3g}"
        return ", ".join((f"loss {self.loss:.1e}", *values.values()))

    def advance(self) -> str | None:
        """An iteration: a step that lowers the loss, or a shorter step of the model. Returns why there is none."""
        while True:
            if self.loss <= self.resolution**2:
                return "as near to the data as their resolution"
            if self.jacobian is None:
                self._differentiate()
            _, gain = self._step(0.0)
            variance = residual_variance(self._field(self.residuals), len(self.y), self.resolution)
            if gain <= variance and self._halve():  # as near as this step deserves, the Jacobian being old or not
                return None
            if gain > ENOUGH**2 * variance:
                if self._try():
                    return None
                if self.fresh:
                    return "no step lowers the loss"
            elif self.fresh:
                return "converged"
            self.jacobian = None

    def _differentiate(self) -> None:
        self.jacobian = self.task.jacobian(self.values, self.residuals)
        self.fresh = True
        self.scale = np.maximum(self.scale, np.linalg.norm(self.jacobian, axis=0))

    def _step(self, damping: float) -> tuple[np.ndarray, float]:
        """The step within the ranges that lowers the linearized and damped loss most, and how much it lowers the loss.

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
        """Steps, ever shorter until the loss falls. False: it did not, as far as this Jacobian goes."""
        while True:
            step, predicted = self._step(self.damping)
            if np.abs(step).max() < SHORTEST:
                return False
            try:
                residuals = self.task.residuals(self._physical(self.y + step))
                quality = (self.loss - float(residuals @ residuals)) / predicted
            except SimulationError:
                quality = -np.inf
            if quality > 1e-3:
                break
            if not self.fresh:
                return False
            self.damping *= 10.0
        surprise = residuals - self.residuals - self.jacobian @ step
        self.y, self.residuals = self.y + step, residuals
        self.fresh = False
        if quality < 0.25:
            self.damping *= 4.0
            self.jacobian = None
        else:
            # in Marquardt's scaling: what moves nothing is not to blame
            along = self.scale**2 * step
            self.jacobian = self.jacobian + np.outer(surprise, along) / (along @ step)
        if quality > 0.5:
            self.damping = max(0.1 * self.damping, 1e-12)
        self._note()
        return True

    def _halve(self) -> bool:
        """Goes on with half the model's step, from values without its error, where that is worth it and nearer."""
        if self.task.steps_per_frame == self.most_steps:
            return False
        now = self._answer(self._missed_by_the_step(self.values, self.residuals))
        if not np.any((now.deviation > KNOWN) & (now.without_step < LESS * now.deviation)):
            return False
        finer, y = self.task.halved(), np.clip(self.y - now.step_error, 0.0, 1.0)
        try:
            residuals = finer.residuals(self._physical(y))
        except SimulationError:
            residuals = None
        self.task.simulations = finer.simulations
        if residuals is None or float(residuals @ residuals) >= self.loss:  # what looked like the step's error was none
            return False
        self.task, self.y, self.residuals, self.fresh = finer, y, residuals, False
        self._note()
        return True

    # -- files -------------------------------------------------------------------------------------------------------

    def _identity(self) -> dict[str, Any]:
        """What a checkpoint must agree with."""
        return {
            "names": np.array(self.task.names),
            "low": self.task.low,
            "high": self.task.high,
            "start": self.task.start,
            "resolution": np.array(self.resolution),
        }

    def save(self, path: Path) -> None:
        history: dict[str, Any] = {
            field: np.array([getattr(i, field) for i in self.history]) for field in _OF_ITERATIONS
        }
        known = np.zeros((0, len(self.y))) if self.jacobian is None else self.jacobian
        state: dict[str, Any] = {
            "y": self.y,
            "steps_per_frame": self.task.steps_per_frame,
            "damping": self.damping,
            "scale": self.scale,
            "jacobian": known,
        }
        with whole_file(path) as temporary, open(temporary, "wb") as file:
            np.savez(file, **self._identity(), **state, **{f"history_{name}": rows for name, rows in history.items()})

    def load(self, path: Path) -> None:
        """Goes on from a checkpoint. Its loss, computed again, must be what it was: then the task is the same."""
        try:
            with np.load(path) as data:
                same = all(np.array_equal(data[name], value) for name, value in self._identity().items())
                y, damping, scale, known = (data[name] for name in ("y", "damping", "scale", "jacobian"))
                steps_per_frame = int(data["steps_per_frame"])
                rows = zip(*(data[f"history_{name}"].tolist() for name in _OF_ITERATIONS), strict=True)
                history = [Iteration(np.array(values), *rest) for values, *rest in rows]
                last = history[-1]
        except Exception as error:  # zip, pickle and key errors of a foreign or truncated file
            raise InputError(f"{path}: not a checkpoint of learning ({error}); remove it to begin anew") from error
        if not same:
            raise InputError(f"{path}: of other parameters, ranges, starts or resolution; remove it to begin anew")
        self.y, self.damping, self.scale, self.history = y, float(damping), scale, history
        self.jacobian = known if len(known) else None
        while self.task.steps_per_frame < steps_per_frame:
            self.task = self.task.halved()
        self.residuals = self.task.residuals(self.values)
        # 1e-6: another processor may round otherwise
        if not np.isclose(self.loss, last.loss, rtol=1e-6, atol=0.0):
            raise InputError(
                f"{path}: of another task: it has a loss of {last.loss:.6e} m² where this one has {self.loss:.6e} m²; "
                "remove it to begin anew"
            )
        self.task.simulations, self.task.gradients = last.simulations, last.gradients
        self.began = time.perf_counter() - last.seconds

    # -- the answer --------------------------------------------------------------------------------------------------

    def _answer(self, missed: np.ndarray, least: np.ndarray | float = 0.0) -> _Answer:
        """What the data leave open here, at least so much; ``missed`` is the step's error."""
        shift, rest, share = step_errors(self.jacobian, self.residuals, missed, self.resolution)
        left = self.residuals + share * rest

        def variance(residuals: np.ndarray) -> float:
            return residual_variance(self._field(residuals), len(self.y), self.resolution)

        # Of all that is left, not of what the step does not explain: where the step is too long for its error to be one
        # of first order, that would be too sure (stretch[1] of 5 × 5: 11 % off with 0.6 %).
        of_residuals = variance(self.residuals)
        unexplained = unexplained_part(self._field(rest), self._field(left))
        moved = unexplained * float(np.linalg.norm(missed))
        of_step = moved**2 / independent(self._field(missed))
        own = uncertainties(self.jacobian, of_residuals + of_step)
        of_data = np.sqrt(np.diag(own))
        # a motion that differs by no more than the step's error may be the true one
        for i in self.history:
            if i.loss - self.loss <= moved**2:
                of_data = np.maximum(of_data, np.abs(i.values - self.values) / (self.task.high - self.task.low))
        of_data = np.minimum(np.maximum(of_data, least), UNKNOWN)
        determined = of_data < DETERMINED
        # noise makes a share where there is none
        spread = min(1.0, float(np.sqrt(of_residuals / max(rest @ rest, np.finfo(float).tiny))))
        step_error = np.where(determined, share * shift, 0.0)
        deviation = np.hypot(of_data, np.where(determined, np.hypot(share, spread) * shift, 0.0))
        without_step = np.sqrt(np.diag(uncertainties(self.jacobian, variance(left))))
        variance_left = of_residuals + of_step
        return _Answer(own, of_data, deviation, without_step, step_error, share, unexplained, moved, variance_left)

    def _probed(self, answer: _Answer) -> np.ndarray:
        """Standard deviations of the data as the loss shows them, where the model does not respond linearly [p].

        Each determined parameter is moved by three of them, to where it has more room, and the others with it. Where
        the loss does not change as the Jacobian says, the others are learned anew there, and further away too, as far
        as half of the range: a rise by n variances of a residual tells a deviation of 1/√n of the way.
        """
        result = answer.of_data.copy()
        for k, deviation in enumerate(answer.of_data):
            side, reach = (1.0 if self.y[k] < 0.5 else -1.0), 3.0 * deviation
            start = np.clip(self.y + side * reach * answer.covariance[:, k] / answer.covariance[k, k], 0.0, 1.0)
            if deviation >= DETERMINED or self._is_linear(start, answer):
                continue
            while result[k] < DETERMINED:
                move = min(reach, 0.5)
                start[k] = self.y[k] + side * move
                rise, values = self._rise(k, self._physical(start), answer)
                away = np.abs(values - self.values) / (self.task.high - self.task.low)
                result = np.maximum(result, away / np.sqrt(max(rise, 1.0)))
                if move == 0.5:
                    break
                reach, start = 3.0 * reach, (self.task.start - self.task.low) / (self.task.high - self.task.low)
        return result

    def _is_linear(self, y: np.ndarray, answer: _Answer) -> bool:
        """Whether the loss there is what the Jacobian says, but for some variances of a residual."""
        expected = self.residuals + self.jacobian @ (y - self.y)
        try:
            residuals = self.task.residuals(self._physical(y))
        except SimulationError:
            return False
        return abs(residuals @ residuals - expected @ expected) < LINEAR * answer.variance

    def _rise(self, k: int, values: np.ndarray, answer: _Answer) -> tuple[float, np.ndarray]:
        """How many variances the loss rises by that the step's error does not allow, with k held as here; and where."""
        task = self.task

        def rise(residuals: np.ndarray) -> float:
            return (residuals @ residuals - self.loss - allowed) / answer.variance

        suspect = answer.unexplained > SUSPECT
        allowed = answer.moved**2 if suspect else 0.0

        try:
            residuals = task.residuals(values)
            if rise(residuals) > 1.0 and len(values) > 1:
                other = _Search(task.held(k, values), self.resolution, halvings=0)
                other.begin()
                while rise(other.residuals) > 1.0 and len(other.history) <= PROBING and other.advance() is None:
                    pass
                task.simulations = other.task.simulations
                values, residuals = np.insert(other.values, k, values[k]), other.residuals
            result = rise(residuals)
            if result > 1.0 and suspect:
                # the step's error there, which may be greater
                there = answer.unexplained**2 * float(np.sum(self._missed_by_the_step(values, residuals) ** 2))
                result -= max(0.0, there - allowed) / answer.variance
        except SimulationError:
            return np.inf, values
        return result, values

    def result(self, ended: str) -> Result:
        task, width = self.task, self.task.high - self.task.low
        if not self.fresh:
            self._differentiate()
        missed = self._missed_by_the_step(self.values, self.residuals)
        answer = self._answer(missed, self._probed(self._answer(missed)))
        of_residuals = np.sqrt(np.diag(answer.covariance))
        try:
            _, gradient = task.loss_and_gradient(self.values)
        except GradientError:  # of steps that could only be made in parts
            gradient = np.full(len(self.y), np.nan)

        def by_name(values: np.ndarray) -> dict[str, float]:
            return dict(zip(task.names, values.tolist(), strict=True))

        return Result(
            task=task,
            parameters=task.parameters,
            values=by_name(self.values),
            uncertainty=by_name(answer.deviation * width),
            step_error=by_name(answer.step_error * width),
            step_share=answer.share,
            status={name: _status(*of) for name, *of in zip(task.names, self.y, answer.of_data, strict=True)},
            correlation=answer.covariance / np.outer(of_residuals, of_residuals),
            loss=self.loss,
            gradient=gradient * width,
            history=self.history,
            simulations=task.simulations,
            gradients=task.gradients,
            seconds=time.perf_counter() - self.began,
            ended=ended,
        )

    def _field(self, residuals: np.ndarray) -> np.ndarray:
        """Residuals as [frames, rows, columns, 3]."""
        weave = self.task.scene.cloth.weave
        return residuals.reshape(-1, weave.rows, weave.columns, 3)

    def _missed_by_the_step(self, values: np.ndarray, residuals: np.ndarray) -> np.ndarray:
        """Estimate of what the residuals at these values would gain if the step went to 0 [residuals]; 0 if unknown."""
        task = self.task
        task.simulations += 2 * task.cost
        try:
            finer = task.trajectory(values, refine=2).position[1:]
        except SimulationError:
            return np.zeros(len(residuals))
        offset = (finer - task.positions).ravel() / np.sqrt(len(task.positions) * task.scene.cloth.nodes)
        power = 2.0**task.rollout.simulator.integrator.order
        return (offset - residuals) * power / (power - 1.0)


_OF_ITERATIONS = tuple(field.name for field in dataclasses.fields(Iteration))


def _status(y: float, deviation: float) -> str:
    bound = {0.0: ", at its lower bound", 1.0: ", at its upper bound"}.get(float(y), "")
    return ("determined" if deviation < DETERMINED else "not determined") + bound


def uncertainties(jacobian: np.ndarray, variance: float) -> np.ndarray:
    """What least squares leaves open: the covariance (JᵀJ/s² + 12)⁻¹ of parameters in units of their ranges [p, p].

    JᵀJ is the Gauss-Newton Hessian. 12 is the range's part: a uniform distribution over it has the variance 1/12, which
    a parameter keeps that the data do not see.

    Args:
        jacobian: J, of the residuals with respect to the p parameters [residuals, p] (m).
        variance: s², of a residual that counts as one of so many as there are (``residual_variance``) [m²].
    """
    return np.linalg.inv(jacobian.T @ jacobian / variance + 12.0 * np.eye(jacobian.shape[1]))


def residual_variance(residuals: np.ndarray, parameters: int, resolution: float) -> float:
    """s² = max(|r|²/(n' (1 − p/n)), resolution²) of n residuals r [frames, rows, columns, 3] (m), p parameters [m²].

    n' counts independent residuals (``independent``): data that differ from the model by noise have as many as numbers,
    data that differ by what the model cannot do have few. Of what they differ by, the parameters have taken p/n away.
    """
    left = max(1.0 - parameters / residuals.size, 1.0 / residuals.size)
    return max(float((residuals**2).sum()) / (independent(residuals) * left), resolution**2)


def step_errors(
    jacobian: np.ndarray, residuals: np.ndarray, missed: np.ndarray, resolution: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """What a model's time step puts into values that were learned with it, to first order.

    Let e be what the residuals would gain with a step of 0. As far as the data are without the step's error, least
    squares has put A e into the values, A = (JᵀJ + 12 resolution²)⁻¹ Jᵀ, and could not put e − J A e, whose opposite
    then stands in the residuals. How much of it does is taken for how much of e the data are without: its share.

    Args:
        jacobian: J [residuals, p] (m), of p parameters in units of their ranges.
        residuals: [residuals] (m).
        missed: e [residuals] (m).
        resolution: of the data [m].

    Returns:
        A e [p], in ranges; e − J A e [residuals] (m); and the share, from 0 to 1.
    """
    square = jacobian.T @ jacobian + 12.0 * resolution**2 * np.eye(jacobian.shape[1])
    shift = np.linalg.solve(square, jacobian.T @ missed)
    rest = missed - jacobian @ shift
    share = np.clip(-(residuals @ rest) / max(rest @ rest, np.finfo(float).tiny), 0.0, 1.0)
    return shift, rest, float(share)


def unexplained_part(rest: np.ndarray, left: np.ndarray) -> float:
    """How much of the step's error, from 0 to 1, the values may have taken in without its being known how.

    ``step_errors`` goes by the shape of e, which is that of the error only where the step resolves the motion. A
    pattern in what that leaves of the residuals may be the step's error in another shape: as much of it as the pattern
    is of the part of e that the values could not take in. Noise has no pattern.

    Args:
        rest: e − J A e [frames, rows, columns, 3] (m).
        left: the residuals without what the step explains, likewise.
    """
    pattern = np.linalg.norm(left) * np.sqrt(max(0.0, 1.0 - independent(left) / left.size))
    return float(min(1.0, pattern / max(np.linalg.norm(rest), np.finfo(float).tiny)))


def independent(residuals: np.ndarray) -> float:
    """How many of these residuals [frames, rows, columns, 3] are independent, at the least.

    What is learned is a weighted sum of residuals, and the variance of one whose weights have the norm 1 is at most the
    largest eigenvalue λ of their correlation, which is 1 where they are independent. So n along an axis count as n/λ,
    with the correlation along it as the other axes show it: as 1 where all are alike, and as 1 or 2 where they
    oscillate, though neighbours differ then. In N samples of noise λ is some (1 + √(n/N))² (Marchenko and Pastur), in
    one case of a thousand it is more than that and 3.27 of its widths (Johnstone, "On the distribution of the largest
    eigenvalue in principal components analysis", 2001): what is below counts as 1. N counts samples that may be alike
    too, which errs to the safe side.
    """
    result = float(residuals.shape[3])
    for axis in range(3):
        n = residuals.shape[axis]
        along = np.moveaxis(residuals, axis, 0).reshape(n, -1)
        covariance = along @ along.T
        mean = np.trace(covariance) / n
        largest = np.linalg.eigvalsh(covariance)[-1]
        size = np.sqrt(along.shape[1]) + np.sqrt(n)
        width = size * (1.0 / np.sqrt(along.shape[1]) + 1.0 / np.sqrt(n)) ** (1.0 / 3.0)
        of_noise = (size**2 + 3.27 * width) / along.shape[1]
        result *= n * mean / largest if largest > of_noise * mean else n
    return result
