"""Runs as differentiable torch operations. Needs the extra ``torch``; import it as ``import warp_yarn.torch``.

A ``Rollout`` is a function from tensors (materials, wind, pins, forces, initial state: whatever is given) to the frames
of a run. A ``Fabric`` is an ``nn.Module`` around it whose parameters are bounded physical values.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp
from torch.autograd.function import once_differentiable

from .adjoint import FRAMES, Adjoint
from .arrays import STATE_TYPES, YARN_PARAMETERS
from .errors import GradientError, InputError, whole
from .scene import Scene
from .simulator import Simulator
from .state import FIELDS, State


class Frames(NamedTuple):
    """Frames of a run, as tensors with a leading axis of frames."""

    position: torch.Tensor
    """[frames, nodes, 3] (m)"""
    euler: torch.Tensor
    """[frames, nodes, 2] (m)"""
    velocity: torch.Tensor
    """[frames, nodes, 3] (m/s)"""
    euler_velocity: torch.Tensor
    """[frames, nodes, 2] (m/s)"""


NUMBERS = (
    "shear",
    "friction",
    "friction_stiffness",
    "friction_damping",
    "friction_sharpness",
    "parallel_stiffness",
    "wind_density",
    "wind_drag",
    "pin_stiffness",
)
VECTORS = ("gravity", "wind_velocity")
ARRAY_OF_PATH = {"pin_path": "pin_target", "forces": "applied_force"}


class Rollout:
    """A run of a scene as a function on tensors.

    Args:
        scene: the scene; its values stand for every input that a call leaves out.
        steps: number of steps, at least 1.
        frames: the frames that a call returns, from 0 (the initial state) to steps, increasing; None: all of them.
        checkpoint_every: keep every so many states for the backward pass, and compute those between again. 1 keeps all.
        options: of the Simulator: step, device, precision, tolerance and so on. The tolerance is that of the adjoint
            solves too, so it bounds what digits of the gradient are right.
    """

    def __init__(
        self,
        scene: Scene,
        steps: int,
        *,
        frames: Sequence[int] | None = None,
        checkpoint_every: int = 1,
        **options: Any,
    ):
        self.scene = scene
        self.steps = whole("steps", steps, least=1)
        self.checkpoint_every = whole("checkpoint_every", checkpoint_every, least=1)
        self.frames = np.arange(steps + 1) if frames is None else np.asarray(frames, dtype=np.int64)
        if len(self.frames) == 0 or self.frames[0] < 0 or self.frames[-1] > steps or (np.diff(self.frames) <= 0).any():
            raise InputError(f"frames = {frames}, must increase from 0 at least to {steps} at most")
        chunk = None if checkpoint_every == 1 else checkpoint_every
        self.simulator = Simulator(scene, chunk=chunk, differentiable=True, **options)
        self.dtype = {"double": torch.float64, "single": torch.float32}[self.simulator.model.precision]
        self.device = wp.device_to_torch(self.simulator.model.device)
        self.defaults = self._defaults()
        self._adjoints: dict[tuple[str, ...], Adjoint] = {}

    def _defaults(self) -> dict[str, torch.Tensor]:
        """The scene's own value of every array that an input can replace, and of the initial state."""
        arrays = self.simulator.arrays
        names = [*YARN_PARAMETERS, *NUMBERS, *VECTORS]
        values = {name: arrays[name].numpy() for name in names if arrays.get(name) is not None}
        values = {k: v.reshape(()) if k in NUMBERS else v.reshape(-1) for k, v in values.items()}
        for name, array in ARRAY_OF_PATH.items():
            if f"{array}_path" in arrays:
                path = arrays[f"{array}_path"].numpy().reshape(-1, len(arrays[array]), 3)
                values[name] = path[:-1] if name == "forces" else path
            elif array in arrays:
                values[name] = arrays[array].numpy()
        state = self.simulator.state
        values |= {name: getattr(state, name) for name in FIELDS if name != "anchor"}
        return {name: torch.tensor(value, dtype=self.dtype, device=self.device) for name, value in values.items()}

    @property
    def inputs(self) -> dict[str, tuple[int, ...]]:
        """Everything that a call takes, and that a gradient can be asked for: name and shape.

        density, stretch and bend are of each material; with ``yarn_`` before them, of each yarn, the warp yarns first.
        pin_path and forces have the shapes that the scene gave them.
        """
        shapes = {name: tuple(value.shape) for name, value in self.defaults.items()}
        for name in YARN_PARAMETERS:
            shapes[f"yarn_{name}"] = shapes[name]
            shapes[name] = (len(self.scene.cloth.yarns),)
        shapes["anchor"] = shapes["euler"]
        return shapes

    def __call__(self, **inputs: torch.Tensor) -> Frames:
        """Runs the scene with these inputs (see ``inputs``) in place of its own values.

        Raises:
            InputError: an input that the scene does not have, of another shape, or not finite.
            SimulationError: a step that could not be made.
        """
        values = {name: self._checked(name, value) for name, value in inputs.items()}
        material = torch.as_tensor(self.scene.cloth.material, device=self.device)
        for name in YARN_PARAMETERS:
            if name in values and f"yarn_{name}" in values:
                raise InputError(f"{name} and yarn_{name} are both given, must be one of them")
            if name in values:
                values[name] = values[name][material]
            elif f"yarn_{name}" in values:
                values[name] = values.pop(f"yarn_{name}")
        if "euler_velocity" in values:
            crossing = torch.as_tensor(self.scene.cloth.topology.is_crossing != 0, device=self.device)
            values["euler_velocity"] = values["euler_velocity"] * crossing[:, None]
        if "euler" in values:
            values.setdefault("anchor", values["euler"])
        elif "anchor" not in values:
            values["anchor"] = self.defaults["euler"]
        names = tuple(values)
        return Frames(*_Run.apply(self, names, *values.values()))

    def _checked(self, name: str, value: Any) -> torch.Tensor:
        shapes = self.inputs
        if name not in shapes:
            raise InputError(
                f"{name!r} is no input of this scene, so it is fixed and has no gradient; "
                f"the inputs are {', '.join(sorted(shapes))}"
            )
        tensor = torch.as_tensor(value).to(device=self.device, dtype=self.dtype)
        if name in NUMBERS and tensor.shape == (1,):
            tensor = tensor.reshape(())
        if tuple(tensor.shape) != shapes[name]:
            raise InputError(f"{name} has shape {tuple(tensor.shape)}, must be {shapes[name]}")
        if not bool(torch.isfinite(tensor).all()):
            raise InputError(f"{name} is not finite: {tensor.detach()}")
        return tensor

    # -- forward and backward ----------------------------------------------------------------------------------------

    def _upload(self, values: Mapping[str, torch.Tensor]) -> None:
        """Puts inputs, and the scene's own values of the others, into the simulator."""
        arrays = self.simulator.arrays
        given = {**self.defaults, **values}
        for name, value in given.items():
            if name in FIELDS:
                continue
            target = arrays[ARRAY_OF_PATH.get(name, name)]
            if name in ARRAY_OF_PATH and value.ndim == 3:
                target = arrays[f"{ARRAY_OF_PATH[name]}_path"]
            _flat(target)[: value.numel()].copy_(value.reshape(-1))
        self.simulator.state = State(*(given[name].cpu().numpy() for name in FIELDS))
        self.simulator.steps_done = 0
        self.simulator.split_steps = {}

    def _store(self, kept: Mapping[str, torch.Tensor], first: int, count: int, at: int) -> None:
        """Copies frames first... of the chunk on the device to frames at... of the kept ones."""
        for name, target in kept.items():
            frames = _flat(self.simulator.arrays[f"frame_{name}"]).view(-1, *target.shape[1:])
            target[at : at + count].copy_(frames[first : first + count])

    def run(self, values: Mapping[str, torch.Tensor]) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
        """Makes the steps.

        Returns:
            The frames that the call returns, and the states that the backward pass starts from.
        """
        self._upload(values)
        simulator, nodes, every = self.simulator, self.scene.cloth.nodes, self.checkpoint_every
        moving = [name for name in FIELDS if simulator.moves(name)]
        checkpoints = -(-self.steps // every) + (every == 1)

        def room(count: int) -> dict[str, torch.Tensor]:
            return {
                name: torch.empty((count, nodes, STATE_TYPES[name]), dtype=self.dtype, device=self.device)
                for name in moving
            }

        kept = room(checkpoints)
        whole_run = every == 1 and len(self.frames) == self.steps + 1
        result = kept if whole_run else room(len(self.frames))
        done = 0
        while done < self.steps:
            asked = min(simulator.chunk, self.steps - done)
            made = simulator.run_chunk(asked)
            if made < asked:
                simulator.fail(done + made + 1, simulator.chunk_trajectory(made + 1))
            if every == 1:
                self._store(kept, 0, made + 1, done)
            else:
                self._store(kept, 0, 1, done // every)
            if not whole_run:
                first = 0 if done == 0 else 1
                for at in np.flatnonzero((self.frames >= done + first) & (self.frames <= done + made)):
                    self._store(result, int(self.frames[at]) - done, 1, int(at))
            done += made
        given = {**self.defaults, **values}
        frames = {
            name: result[name] if name in result else given[name].detach().expand(len(self.frames), -1, -1).clone()
            for name in FRAMES
        }
        return frames, kept

    def backward(
        self,
        values: Mapping[str, torch.Tensor],
        kept: Mapping[str, torch.Tensor],
        wanted: Sequence[str],
        losses: Mapping[str, torch.Tensor | None],
    ) -> dict[str, torch.Tensor]:
        """Gradients of the wanted inputs, from those of the frames."""
        self._upload(values)
        simulator, every = self.simulator, self.checkpoint_every
        adjoint = self._adjoint(wanted)
        adjoint.clear()
        length = simulator.chunk
        for first in reversed(range(0, self.steps, length)):
            steps = min(length, self.steps - first)
            if every == 1:
                self._restore(kept, first, steps + 1)
            else:
                self._restart(kept, first)
                simulator.run_chunk(steps)
            self._set_losses(losses, first, steps)
            adjoint.backward_chunk(first, steps)
        self._set_losses(losses, -1, 1, move=1)
        adjoint.finish()
        return {name: self._gradient(name, values) for name in wanted}

    def _adjoint(self, wanted: Sequence[str]) -> Adjoint:
        parameters = tuple(sorted(ARRAY_OF_PATH.get(name, name) for name in wanted if name not in FIELDS))
        if parameters not in self._adjoints:
            self._adjoints[parameters] = Adjoint(self.simulator, parameters)
        return self._adjoints[parameters]

    def _restore(self, kept: Mapping[str, torch.Tensor], first: int, count: int) -> None:
        for name, source in kept.items():
            frames = _flat(self.simulator.arrays[f"frame_{name}"]).view(-1, *source.shape[1:])
            frames[:count].copy_(source[first : first + count])

    def _restart(self, kept: Mapping[str, torch.Tensor], first: int) -> None:
        """Puts the state that a chunk starts from back."""
        for name, source in kept.items():
            _flat(self.simulator.arrays[name]).copy_(source[first // self.checkpoint_every].reshape(-1))
        self.simulator.steps_done = first

    def _set_losses(self, losses: Mapping[str, torch.Tensor | None], first: int, steps: int, move: int = 0) -> None:
        """Puts the gradients of frames first + 1 ... first + steps where the backward steps look for them."""
        inside = np.flatnonzero((self.frames > first) & (self.frames <= first + steps))
        for name in FRAMES:
            target = _flat(self.simulator.arrays[f"loss_{name}"]).view(-1, self.scene.cloth.nodes, STATE_TYPES[name])
            target[: steps + 1].zero_()
            loss = losses[name]
            if loss is not None and len(inside):
                rows = torch.as_tensor(self.frames[inside] - first - move, device=self.device)
                target[rows] = loss[int(inside[0]) : int(inside[-1]) + 1]

    def _gradient(self, name: str, values: Mapping[str, torch.Tensor]) -> torch.Tensor:
        arrays = self.simulator.arrays
        array = arrays[ARRAY_OF_PATH.get(name, name)]
        if name in ARRAY_OF_PATH and values[name].ndim == 3:
            array = arrays[f"{ARRAY_OF_PATH[name]}_path"]
        if array is None:  # a part of the state that this scene does not have
            return torch.zeros_like(values[name])
        shape = values[name].shape
        return _flat(array.grad)[: shape.numel()].reshape(shape).clone()


def _flat(array: wp.array) -> torch.Tensor:
    """An array's numbers as a one-dimensional tensor on the same memory."""
    scalar = getattr(array.dtype, "_wp_scalar_type_", array.dtype)
    count = array.size * getattr(array.dtype, "_length_", 1)
    view = wp.array(ptr=array.ptr, dtype=scalar, shape=count, device=array.device, copy=False)
    return wp.to_torch(view, requires_grad=False)


class _Run(torch.autograd.Function):
    """Rollout.run and Rollout.backward as one torch operation."""

    @staticmethod
    def forward(ctx: Any, rollout: Rollout, names: tuple[str, ...], *tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        values = {name: tensor.detach() for name, tensor in zip(names, tensors, strict=True)}
        frames, kept = rollout.run(values)
        ctx.rollout, ctx.names, ctx.kept_names = rollout, names, tuple(kept)
        ctx.split = dict(rollout.simulator.split_steps)
        ctx.save_for_backward(*tensors, *kept.values())
        ctx.set_materialize_grads(False)
        return tuple(frames[name] for name in FRAMES)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        for k, part in ctx.split.items():
            raise GradientError(
                f"step {k} could only be made in parts, the smallest {part:g} s, and has no gradient; "
                f"try a smaller step than {ctx.rollout.simulator.step_size:g} s",
                step=k,
                term=None,
            )
        names, saved = ctx.names, ctx.saved_tensors
        values = dict(zip(names, saved[: len(names)], strict=True))
        kept = dict(zip(ctx.kept_names, saved[len(names) :], strict=True))
        wanted = [name for name, needed in zip(names, ctx.needs_input_grad[2:], strict=True) if needed]
        gradients = ctx.rollout.backward(values, kept, wanted, dict(zip(FRAMES, grads, strict=True)))
        return (None, None, *(gradients.get(name) for name in names))


class Fabric(torch.nn.Module):
    """A rollout whose physical parameters are learned within ranges: ω = a·sigmoid(y) + b, as in the paper.

    Args:
        scene, steps, options: as of Rollout.
        learn: {input: (lowest, highest)}, in the input's unit; highest above lowest.
        initial: {input: value} to start from, strictly inside the range; the scene's own value where it is left out.
    """

    def __init__(
        self,
        scene: Scene,
        steps: int,
        *,
        learn: Mapping[str, tuple[float, float]],
        initial: Mapping[str, Any] | None = None,
        **options: Any,
    ):
        super().__init__()
        self.rollout = Rollout(scene, steps, **options)
        self.ranges = {name: (float(low), float(high)) for name, (low, high) in learn.items()}
        self.y = torch.nn.ParameterDict()
        shapes = self.rollout.inputs
        for name, (low, high) in self.ranges.items():
            if name not in shapes:
                raise InputError(f"learn names {name!r}, must be among {', '.join(sorted(shapes))}")
            if not low < high:
                raise InputError(f"learn[{name!r}] = ({low:g}, {high:g}), the second must be above the first")
            self.y[name] = torch.nn.Parameter(torch.zeros(shapes[name], dtype=self.rollout.dtype))
            self.set(name, (initial or {}).get(name, self._default(name)))

    def _default(self, name: str) -> torch.Tensor:
        if name in YARN_PARAMETERS:
            return torch.tensor([getattr(yarn, name) for yarn in self.rollout.scene.cloth.yarns])
        return self.rollout.defaults[name.removeprefix("yarn_")]

    def value(self, name: str) -> torch.Tensor:
        """A parameter in its physical unit; differentiable."""
        low, high = self.ranges[name]
        return low + (high - low) * torch.sigmoid(self.y[name])

    @property
    def values(self) -> dict[str, torch.Tensor]:
        """Every parameter in its physical unit; differentiable."""
        return {name: self.value(name) for name in self.ranges}

    @torch.no_grad()
    def set(self, name: str, value: Any) -> None:
        """Sets a parameter to a physical value strictly inside its range."""
        low, high = self.ranges[name]
        y = self.y[name]
        fraction = (torch.as_tensor(value, dtype=y.dtype, device=y.device).expand(y.shape) - low) / (high - low)
        if not bool(((fraction > 0.0) & (fraction < 1.0)).all()):
            raise InputError(f"{name} = {value}, must be strictly between {low:g} and {high:g}")
        y.copy_(torch.logit(fraction))

    def forward(self, **inputs: torch.Tensor) -> Frames:
        """The frames of a run with the present parameters, and any other inputs."""
        return self.rollout(**self.values, **inputs)
