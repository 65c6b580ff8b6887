"""The least-squares problem: frames, a scene that is to reproduce them, and what may change in it.

Here the model runs: its residuals, their loss with its exact gradient, its motion. How the problem is solved is the
matter of ``levenberg_marquardt``, how the residuals' Jacobian is found of ``differences``.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import itertools
import math
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import numpy as np
import torch

from ..description.cloth import Cloth
from ..description.cloths import Cloths
from ..description.scene import Scene
from ..description.weave import Weave
from ..device.arrays import STATE_TYPES
from ..errors import InputError, finite_array, integer, real
from ..gradients.rollout import Rollout
from ..simulation.simulator import Simulator
from ..simulation.state import FIELDS, Trajectory
from . import differences
from .parameters import Parameter, as_inputs, checked, split, with_values

NEWTON_TOLERANCE = 1e-10
"""``newton_tolerance`` of runs in double precision [1]. What that of gradients leaves of runs of light, stiff yarns is
as large as what small changes of some parameters make, and a search finds no way through it."""

WHOLE_STEPS = 1e-6
"""What decimal times and their quotient leave of a whole number of steps to a frame [1]."""


class CalibrationProblem:
    """Frames, and a scene that is to reproduce them.

    The model starts in the state of one of the frames (positions, velocities, (u, v), friction's anchors), and its
    positions are compared with those of the frames after it. Methods take the values of the parameters, in their units
    and in their order, as an array [parameters].

    ``pin_path`` and ``forces`` of the scene go by the target's frames, whatever the model's step: row k is of the time
    from frame k to frame k + 1, so that learning from frame ``first`` on begins with row ``first``. In steps of another
    length pins move linearly from row to row (to row 0 from where frame 0 has them), and a force is its mean over the
    step: that of the row where the step lies in one.

    A problem can be copied, pickled and sent to another process, and so can a ``Result``; its rollout is made there
    anew.

    Args:
        scene: the model; what is not learned keeps its values.
        target: the frames; where ``pin_path`` or ``forces`` change, every step of a run from its beginning.
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
            options.setdefault("newton_tolerance", NEWTON_TOLERANCE)
        self.names = [p.name for p in self.parameters]
        self.low, self.high, self.start = (
            np.array([getattr(p, end) for p in self.parameters], dtype=np.float64) for end in ("low", "high", "start")
        )
        checked(scene, self.parameters)
        chosen = chosen_frames(scene, target, frames, first, every)
        self.initial = target[int(chosen[0])]
        self.positions = target.position[chosen[1:]].copy()
        self.frame_time = target.step * every
        self._first, self._every = first, every
        paths = np.diff(target.position[chosen], axis=0)
        self.path = float(np.sqrt(np.mean(np.linalg.norm(paths, axis=2).sum(axis=0) ** 2)))
        self._pins_at_start = target.position[0, scene.pins].copy()
        self._state = {name: torch.as_tensor(getattr(self.initial, name)) for name in FIELDS}
        self._prepare(1 if step is None else steps_per_frame(self.frame_time, real("step", step, above=0.0)))
        self.cost = 1
        self.simulations = self.gradients = 0

    def _prepare(self, steps_per_frame: int) -> None:
        """Settles the step, and with it the rollout."""
        self.steps_per_frame, self.step = steps_per_frame, self.frame_time / steps_per_frame
        self.__dict__.pop("rollout", None)
        self.rollout.simulator.state = self.initial  # to have it checked

    @functools.cached_property
    def rollout(self) -> Rollout:
        """The rollout of the scene with its own values, made when it is first asked for."""
        after = np.arange(1, len(self.positions) + 1) * self.steps_per_frame
        scene = self._in_steps(self.scene, self.steps_per_frame, len(self.positions))
        return Rollout(scene, int(after[-1]), frames=after.tolist(), step=self.step, **self.options)

    def __getstate__(self) -> dict[str, Any]:
        """Leaves out what is on the device."""
        return {name: value for name, value in self.__dict__.items() if name != "rollout"}

    def _in_steps(self, scene: Scene, steps_per_frame: int, frames: int) -> Scene:
        """Gives a scene paths that go by the model's steps. Its runs begin after one step, which ends with the pins at
        their places in the initial state."""
        ratio = Fraction(self._every, steps_per_frame)
        return with_paths(scene, self._pins_at_start, self._first - ratio, ratio, 1 + steps_per_frame * frames)

    def halved(self) -> CalibrationProblem:
        """Makes the same problem for a model of half the step, with the runs that this one has made."""
        result = copy.copy(self)
        result._prepare(2 * self.steps_per_frame)
        result.cost = 2 * self.cost
        return result

    def held(self, k: int, values: np.ndarray) -> CalibrationProblem:
        """Makes the same problem without parameter k, which has its value of these; the others start with theirs."""
        result = copy.copy(self)
        result.scene = with_values(self.scene, {self.names[k]: values[k]})
        kept = [j for j in range(len(values)) if j != k]
        result.parameters = tuple(dataclasses.replace(self.parameters[j], start=values[j]) for j in kept)
        result.names = [self.names[j] for j in kept]
        result.low, result.high, result.start = self.low[kept], self.high[kept], values[kept]
        result._prepare(self.steps_per_frame)
        return result

    @property
    def width(self) -> np.ndarray:
        """How wide the ranges are [parameters]."""
        return self.high - self.low

    def scaled(self, values: np.ndarray) -> np.ndarray:
        """Takes values to y = (value − low)/(high − low) [parameters]."""
        return (values - self.low) / self.width

    def physical(self, y: np.ndarray) -> np.ndarray:
        """Takes y = (value − low)/(high − low) to values in their units [parameters]."""
        return self.low + y * self.width

    def field(self, residuals: np.ndarray) -> np.ndarray:
        """Shapes residuals as [frames, rows, columns, 3]; of a cloth that is cut all nodes are one row."""
        weave, nodes = _weave(self.scene.cloth), self.scene.cloth.nodes
        rows = weave.rows if nodes == weave.rows * weave.columns else 1
        return residuals.reshape(-1, rows, nodes // rows, 3)

    def scene_with(self, values: np.ndarray) -> Scene:
        """Copies the scene with these values."""
        return with_values(self.scene, dict(zip(self.names, values, strict=True)))

    def _inputs(self, values: np.ndarray, differentiated: bool) -> dict[str, torch.Tensor]:
        """Lists what the rollout takes."""
        arrays = as_inputs(self.scene, self.names, values)
        leaves = {name: torch.tensor(value, requires_grad=differentiated) for name, value in arrays.items()}
        return {**self._state, **leaves}

    def _run(self, inputs: dict[str, torch.Tensor]) -> torch.Tensor:
        """Runs the model. Returns its residuals."""
        self.simulations += self.cost
        offset = self.rollout(**inputs, steps_done=1).position.double().cpu() - torch.as_tensor(self.positions)
        return offset / np.sqrt(len(self.positions) * self.scene.cloth.nodes)

    @torch.no_grad()
    def residuals(self, values: np.ndarray) -> np.ndarray:
        """Computes (x − x̂)/√(frames·nodes), flat [frames·nodes·3] (m): their squares add up to the loss. One run.

        Raises:
            SimulationError: the model cannot be simulated with these values.
        """
        return self._run(self._inputs(values, differentiated=False)).numpy().ravel()

    def loss(self, values: np.ndarray) -> float:
        """Computes the mean over frames and nodes of squared distances to the data [m²]: the paper's 𝓛 of positions."""
        residuals = self.residuals(values)
        return float(residuals @ residuals)

    def loss_and_gradient(self, values: np.ndarray) -> tuple[float, np.ndarray]:
        """Computes the loss, and its exact gradient by the adjoint, per unit of each parameter [parameters].

        Raises:
            SimulationError: the model cannot be simulated with these values.
            GradientError: it can, but not differentiated.
        """
        inputs = self._inputs(values, differentiated=True)
        loss = self._run(inputs).square().sum()
        self.gradients += self.cost
        loss.backward()
        parts = [(inputs[base].grad.reshape(-1), k) for base, k in map(split, self.names)]
        return float(loss.detach()), np.array([float(part[k or 0]) for part, k in parts])

    def jacobian(self, values: np.ndarray, residuals: np.ndarray) -> np.ndarray:
        """Estimates ∂residuals/∂y [residuals, parameters] at values with these residuals, y as of ``scaled``.

        Raises:
            SimulationError: the model can be simulated on neither side.
        """
        return differences.jacobian(self, values, residuals)

    def trajectory(self, values: np.ndarray, frames: int | None = None, *, refine: int = 1) -> Trajectory:
        """Simulates the model with these values: the initial state, and frames as far apart as those compared.

        Args:
            frames: how many after the first; None: as many as are compared.
            refine: how many times as short a step to take.

        Raises:
            SimulationError: a step that could not be made; its trajectory has every step before.
        """
        count = len(self.positions) if frames is None else integer("frames", frames, least=1)
        every = self.steps_per_frame * integer("refine", refine, least=1)
        # The kernels that learning has compiled, though nothing is differentiated.
        options = {**self.options, "step": self.frame_time / every, "differentiable": True}
        simulator = Simulator(self._in_steps(self.scene_with(values), every, count), **options)
        simulator.state, simulator.steps_done = self.initial, 1
        motion = simulator.run(count * every)
        parts = {name: getattr(motion, name)[::every] for name in FIELDS}
        return dataclasses.replace(motion, step=self.frame_time, scene=None, start=0, **parts)


def chosen_frames(scene: Scene, target: Trajectory, frames: int | None, first: int, every: int) -> np.ndarray:
    """Picks the frame to start from and those to compare with, by their indices [1 + frames].

    Raises:
        InputError: a target of another size, not finite, or with fewer frames.
    """
    ours, theirs = _weave(scene.cloth), _weave(target.cloth)
    if (ours.rows, ours.columns) != (theirs.rows, theirs.columns):
        raise InputError(
            f"target has {theirs.rows} × {theirs.columns} nodes, must have the scene's {ours.rows} × {ours.columns}"
        )
    for name in FIELDS:
        finite_array(f"target.{name}", getattr(target, name), (len(target), scene.cloth.nodes, STATE_TYPES[name]))
    moves = scene.pin_path is not None or len(scene.force_path) > 1
    if moves and (target.start, target.every) != (0, 1):
        raise InputError(
            f"target.start = {target.start:g} and every = {target.every:g}, must be 0 and 1: pin_path and forces of "
            "the scene go by the target's frames; the arguments first and every take some of them"
        )
    first, every = integer("first", first, least=0), integer("every", every, least=1)
    there = max(0, len(target) - 1 - first) // every
    wanted = there if frames is None else integer("frames", frames, least=1)
    if wanted > there or there == 0:
        raise InputError(
            f"frames = {wanted or 'all'}, first = {first}, every = {every}: the target has {len(target)} frames, "
            f"which leaves {there} to compare with"
        )
    return first + every * np.arange(wanted + 1)


def steps_per_frame(frame_time: float, step: float) -> int:
    """Counts the steps of this length in a frame's time [s], or raises an InputError."""
    result = round(frame_time / step)
    if result < 1 or abs(frame_time / step - result) > WHOLE_STEPS:
        raise InputError(f"step = {step:g} s, must fit a whole number of times into the {frame_time:g} s of a frame")
    return result


def with_paths(scene: Scene, start: np.ndarray, first: int | Fraction, ratio: Fraction, steps: int) -> Scene:
    """Gives a scene the rows of pins, forces, gravity and wind that a model needs whose steps are not its rows.

    Row k of a path is of the time from k to k + 1, in rows. The model's step j is of the time from first + j ratio to
    first + (j + 1) ratio. Pins move linearly from row to row, and a force is its mean over the model's step, as gravity
    and wind are: the motion of the pins and the impulse of the forces are the same with every step.

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
        path = _means(scene.force_path, times)
        forces = enumerate(scene.forces.items())
        changes["forces"] = {node: path[:, k] if np.ndim(f) == 2 else f for k, (node, f) in forces}
    if scene.gravity is not None and np.ndim(scene.gravity) == 2:
        changes["gravity"] = _means(scene.gravity, times)
    if scene.wind is not None and np.ndim(scene.wind.velocity) == 2:
        changes["wind"] = scene.wind.replace(velocity=_means(np.asarray(scene.wind.velocity), times))
    return scene.replace(**changes)


def _means(path: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Takes the means of rows, of which the last one stays, from each of these times to the next."""
    result = np.zeros((len(times) - 1, *path.shape[1:]))
    for j, (begin, end) in enumerate(itertools.pairwise(times)):
        rows = np.arange(math.floor(begin), math.ceil(end))
        share = (np.minimum(rows + 1, end) - np.maximum(rows, begin)) / (end - begin)
        result[j] = np.tensordot(share, path[np.clip(rows, 0, len(path) - 1)], axes=1)
    return result


def _weave(cloth: Cloth | Cloths) -> Weave:
    """Finds the weave of a single cloth, or raises an InputError."""
    if isinstance(cloth, Cloths):
        raise InputError("a scene of several cloths cannot be learned from, must have one")
    return cloth.weave
