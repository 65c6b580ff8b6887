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

from ..description.scene import Scene
from ..device.arrays import STATE_TYPES, YARN_PARAMETERS
from ..device.exclusive import ALONE, refuse_recording
from ..errors import GradientError, InputError, choice
from ..errors import integer as whole
from ..errors import real as number
from ..simulation.simulator import Simulator
from ..simulation.state import FIELDS, State
from .adjoint import Adjoint


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
    anchor: torch.Tensor
    """[frames, nodes, 2] (m)"""

    @property
    def last(self) -> State:
        """The last of the frames, as tensors: what another call goes on from, as its ``state``."""
        return State(*(values[-1] for values in self))


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
ABOVE_0 = ("density", "friction_stiffness", "friction_sharpness", "pin_stiffness")
"""Of the yarns' parameters and the numbers; the others are at least 0: the ranges of Yarn, Cloth, Wind and Scene."""
MOST_STEPS = 2**31 - 1
"""The device counts in 32 bits."""
ARRAY_OF_PATH = {"pin_path": "pin_target", "forces": "applied_force"}


class Rollout:
    """A run of a scene as a function on tensors.

    A call depends on its inputs alone, not on the calls before it, and what it returns is the caller's own memory. A
    rollout can be copied and pickled: the copy is made anew from the scene and the options.

    Args:
        scene: the scene; its values stand for every input that a call leaves out.
        steps: number of steps, at least 1.
        frames: the frames that a call returns, from 0 (the initial state) to steps, increasing; None: all of them.
        checkpoint_every: keep every so many states for the backward pass, and compute those between again. 1 keeps all.
        options: of the Simulator, but chunk and differentiable: step, device, precision, tolerance and so on. The
            tolerance is that of the adjoint solves too, so it bounds what digits of the gradient are right.
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
        self.frames = np.arange(steps + 1) if frames is None else np.array(frames)
        if self.frames.ndim != 1 or self.frames.dtype.kind not in "iu" or not self._are_in_order():
            raise InputError(
                f"frames = {frames}, must be whole numbers that increase from 0 at least to {steps} at most"
            )
        for name in ("chunk", "differentiable"):
            if name in options:
                raise InputError(
                    f"{name} = {options[name]!r} is no option of a Rollout, whose checkpoint_every settles it"
                )
        chunk = None if checkpoint_every == 1 else checkpoint_every
        self.simulator = Simulator(scene, chunk=chunk, differentiable=True, **options)
        # by its name: a device of Warp's cannot be pickled
        self._options = {**options, "device": str(self.simulator.model.device)}
        self.dtype = {"double": torch.float64, "single": torch.float32}[self.simulator.model.precision]
        self.device = wp.device_to_torch(self.simulator.model.device)
        self._defaults = self._scene_values()
        self._adjoint: Adjoint | None = None

    def __getstate__(self) -> dict[str, Any]:
        made_of = {"scene": self.scene, "steps": self.steps, "frames": self.frames}
        return {**made_of, "checkpoint_every": self.checkpoint_every, **self._options}

    def __setstate__(self, made_of: dict[str, Any]) -> None:
        Rollout.__init__(self, **made_of)

    def _are_in_order(self) -> bool:
        frames = self.frames.astype(object)  # no unsigned differences
        return len(frames) > 0 and frames[0] >= 0 and frames[-1] <= self.steps and bool((np.diff(frames) > 0).all())

    def _scene_values(self) -> dict[str, torch.Tensor]:
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
        values |= {name: getattr(state, name) for name in FIELDS}
        return {name: torch.tensor(value, dtype=self.dtype, device=self.device) for name, value in values.items()}

    @property
    def defaults(self) -> dict[str, torch.Tensor]:
        """The scene's own value of everything that an input can replace, density, stretch and bend by yarn; a copy."""
        return {name: value.clone() for name, value in self._defaults.items()}

    @property
    def inputs(self) -> dict[str, tuple[int, ...]]:
        """Everything that a call takes, and that a gradient can be asked for: name and shape.

        density, stretch and bend are of each material; with ``yarn_`` before them, of each yarn, the warp yarns first.
        pin_path and forces have the shapes that the scene gave them. Nodes on the border have no Eulerian coordinate:
        their rows of euler_velocity are taken for 0.
        """
        shapes = {name: tuple(value.shape) for name, value in self._defaults.items()}
        for name in YARN_PARAMETERS:
            shapes[f"yarn_{name}"] = shapes[name]
            shapes[name] = (len(self.scene.cloth.yarns),)
        return shapes

    def __call__(self, *, state: State | None = None, steps_done: int = 0, **inputs: Any) -> Frames:
        """Runs the scene with these inputs (see ``inputs``) in place of its own values.

        Args:
            state: what the run starts from, in place of position, euler, velocity, euler_velocity and anchor: the
                ``last`` of another call's frames, or a State of a Simulator. Where euler is given without anchor, as
                None here, friction's springs start unstrained.
            steps_done: how many steps were made before the state, by which pin_path and forces are looked up, at
                least 0. A run in parts is the same as at once: ``rollout(state=frames.last, steps_done=10)``.
            inputs: tensors, or arrays of numbers.

        Raises:
            InputError: an input that the scene does not have, of another shape, not real, not finite, or out of the
                range that Yarn, Cloth, Wind and Scene give; a call under torch.func, a wp.Tape or a graph's capture.
            SimulationError: a step that could not be made.
            GradientError: where an input needs a gradient, a step that could only be made in parts.
        """
        _refuse_transforms()
        steps_done = whole("steps_done", steps_done, least=0)
        if steps_done + self.steps > MOST_STEPS:
            raise InputError(f"steps_done = {steps_done}, must be at most {MOST_STEPS - self.steps}")
        if state is not None and not isinstance(state, State):
            raise InputError(f"state = {state!r}, must be a State, such as frames.last")
        for name in FIELDS if state is not None else ():
            if name in inputs:
                raise InputError(f"state and {name} are both given, must be one of them")
            if getattr(state, name) is not None:
                inputs[name] = getattr(state, name)
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
        with self.simulator.lock:  # a run and its frames are one thread's until it has them
            if torch.is_grad_enabled() and any(value.requires_grad for value in values.values()):
                return Frames(*_Run.apply(self, tuple(values), steps_done, *values.values()))
            values = {name: value.detach() for name, value in values.items()}
            return Frames(**self._run(values, steps_done, differentiable=False)[0])

    def _checked(self, name: str, value: Any) -> torch.Tensor:
        shapes = self.inputs
        if name not in shapes:
            raise InputError(
                f"{name!r} is no input of this scene, so it is fixed and has no gradient; "
                f"the inputs are {', '.join(sorted(shapes))}"
            )
        tensor = _real(name, value).to(device=self.device, dtype=self.dtype)
        if name in NUMBERS and tensor.shape == (1,):
            tensor = tensor.reshape(())
        if tuple(tensor.shape) != shapes[name]:
            raise InputError(f"{name} has shape {tuple(tensor.shape)}, must be {shapes[name]}")
        if not bool(torch.isfinite(tensor).all()):
            raise InputError(f"{name} is not finite: {tensor.detach()}")
        if _range(name):
            at = int(tensor.argmin())
            number(f"{name}[{at}]" if tensor.ndim else name, tensor.reshape(-1)[at].item(), **_range(name))
        # Whoever changes theirs in place before the backward pass shall not change this run's.
        return tensor.clone()

    # -- forward and backward ----------------------------------------------------------------------------------------

    def _upload(self, values: Mapping[str, torch.Tensor], steps_done: int) -> None:
        """Puts inputs, and the scene's own values of the others, into the simulator, whatever the last run left."""
        simulator, arrays = self.simulator, self.simulator.arrays
        given = {**self._defaults, **values}
        for name, value in given.items():
            if name in FIELDS:
                continue
            target = arrays[ARRAY_OF_PATH.get(name, name)]
            if name in ARRAY_OF_PATH and value.ndim == 3:
                target = arrays[f"{ARRAY_OF_PATH[name]}_path"]
            _flat(target)[: value.numel()].copy_(value.reshape(-1))
        simulator.state = State(*(given[name].cpu().numpy() for name in FIELDS))
        simulator.steps_done = steps_done
        simulator.split_steps, simulator.damped_steps = {}, set()
        # an interrupted run may have left these
        arrays.zero("status")
        simulator.integrator.set_times(simulator.step_size, simulator.step_size)

    def _store(self, kept: Mapping[str, torch.Tensor], rows: np.ndarray, at: int) -> None:
        """Copies these frames of the chunk on the device to frames at... of the kept ones."""
        picked = torch.as_tensor(rows, device=self.device)
        for name, target in kept.items():
            frames = _flat(self.simulator.arrays[f"frame_{name}"]).view(-1, *target.shape[1:])
            target[at : at + len(rows)] = frames[picked]

    def _run(
        self, values: Mapping[str, torch.Tensor], steps_done: int, *, differentiable: bool
    ) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
        """Makes the steps.

        Returns:
            The frames that the call returns, and the states that the backward pass starts from. They share no memory:
            a frame that is changed in place would turn the gradient.
        """
        with ALONE:
            refuse_recording(self.simulator.model.device)
            self._upload(values, steps_done)
        simulator, nodes, every = self.simulator, self.scene.cloth.nodes, self.checkpoint_every
        moving = [name for name in FIELDS if simulator.moves(name)]
        checkpoints = -(-self.steps // every) + (every == 1)

        def room(count: int) -> dict[str, torch.Tensor]:
            return {
                name: torch.empty((count, nodes, STATE_TYPES[name]), dtype=self.dtype, device=self.device)
                for name in moving
            }

        kept = room(checkpoints) if differentiable else {}
        result = room(len(self.frames))
        done = 0
        while done < self.steps:
            asked = min(simulator.chunk, self.steps - done)
            made = simulator.run_chunk(asked)
            if differentiable:
                self._refuse_split_steps(steps_done)
            if made < asked:
                simulator.fail(done + made + 1, simulator.chunk_trajectory(made + 1))
            inside = np.flatnonzero((self.frames >= done + (done > 0)) & (self.frames <= done + made))
            with ALONE:
                if every == 1:
                    self._store(kept, np.arange(made + 1), done)
                else:
                    self._store(kept, np.arange(1), done // every)
                if len(inside):
                    self._store(result, self.frames[inside] - done, int(inside[0]))
            done += made
        given = {**self._defaults, **values}
        frames = {
            name: result[name] if name in result else given[name].expand(len(self.frames), -1, -1).clone()
            for name in FIELDS
        }
        return frames, kept

    def _refuse_split_steps(self, steps_done: int) -> None:
        for k, part in self.simulator.split_steps.items():
            step = k - steps_done
            raise GradientError(
                f"step {step} could only be made in parts, the smallest {part:g} s, and has no gradient; "
                f"try a smaller step than {self.simulator.step_size:g} s",
                step=step,
                term=None,
            )

    def _backward(
        self,
        values: Mapping[str, torch.Tensor],
        steps_done: int,
        kept: Mapping[str, torch.Tensor],
        wanted: Sequence[str],
        losses: Mapping[str, torch.Tensor | None],
    ) -> list[torch.Tensor]:
        """Gradients of the wanted inputs, from those of the frames."""
        _refuse_transforms(*losses.values())
        refuse_recording(self.simulator.model.device)
        self._upload(values, steps_done)
        simulator, every = self.simulator, self.checkpoint_every
        adjoint = self._adjoint_of(wanted)
        adjoint.clear()
        length = simulator.chunk
        for first in reversed(range(0, self.steps, length)):
            steps = min(length, self.steps - first)
            if every == 1:
                self._restore(kept, first, steps + 1)
            else:
                self._restart(kept, first)
                simulator.steps_done = steps_done + first
                simulator.run_chunk(steps)
            self._set_losses(losses, first, steps)
            adjoint.backward_chunk(first, steps, steps_done)
        self._set_losses(losses, -1, 1, move=1)
        adjoint.finish()
        return [self._gradient(name, values[name], losses) for name in wanted]

    def _adjoint_of(self, wanted: Sequence[str]) -> Adjoint:
        """The adjoint for these inputs: the last one, or a new one, since a simulator has one at a time."""
        parameters = tuple(sorted(ARRAY_OF_PATH.get(name, name) for name in wanted if name not in FIELDS))
        last, self._adjoint = self._adjoint, None  # and none if this is interrupted
        if last is None or last.parameters != parameters:
            if last is not None:
                last.release()
            last = Adjoint(self.simulator, parameters)
        self._adjoint = last
        return last

    def _restore(self, kept: Mapping[str, torch.Tensor], first: int, count: int) -> None:
        for name, source in kept.items():
            frames = _flat(self.simulator.arrays[f"frame_{name}"]).view(-1, *source.shape[1:])
            frames[:count].copy_(source[first : first + count])

    def _restart(self, kept: Mapping[str, torch.Tensor], first: int) -> None:
        """Puts the state that a chunk starts from back."""
        self.simulator.model.trust_energy()
        for name, source in kept.items():
            _flat(self.simulator.arrays[name]).copy_(source[first // self.checkpoint_every].reshape(-1))

    def _set_losses(self, losses: Mapping[str, torch.Tensor | None], first: int, steps: int, move: int = 0) -> None:
        """Puts the gradients of frames first + 1 ... first + steps where the backward steps look for them."""
        inside = np.flatnonzero((self.frames > first) & (self.frames <= first + steps))
        for name, width in STATE_TYPES.items():
            array = self.simulator.arrays[f"loss_{name}"]
            if array is None:
                continue
            target = _flat(array).view(-1, self.scene.cloth.nodes, width)
            target[: steps + 1].zero_()
            loss = losses[name]
            if loss is not None and len(inside):
                rows = torch.as_tensor(self.frames[inside] - first - move, device=self.device)
                target[rows] = loss[int(inside[0]) : int(inside[-1]) + 1]

    def _gradient(self, name: str, value: torch.Tensor, losses: Mapping[str, torch.Tensor | None]) -> torch.Tensor:
        arrays = self.simulator.arrays
        array = arrays[ARRAY_OF_PATH.get(name, name)]
        if name in ARRAY_OF_PATH and value.ndim == 3:
            array = arrays[f"{ARRAY_OF_PATH[name]}_path"]
        loss = losses.get(name)
        repeated = None if loss is None else loss.sum(dim=0)
        if array is None:  # a part of the state that this scene does not have: every frame repeats it
            return torch.zeros_like(value) if repeated is None else repeated
        gradient = _flat(array.grad)[: value.numel()].reshape(value.shape).clone()
        if name == "anchor" and repeated is not None:  # as it does the border's, which no kernel takes back
            border = self.scene.cloth.topology.is_crossing == 0
            gradient[border] = repeated[border]
        return gradient


def _refuse_transforms(*tensors: torch.Tensor | None) -> None:
    """Refuses what stands for other tensors, as transforms have them, and has no numbers of its own."""
    if torch.jit.is_tracing():  # which would keep this run's frames as constants
        raise InputError("a Rollout cannot be traced by torch.jit: torch runs none of its steps")
    transformed = torch._C._are_functorch_transforms_active()  # no public function says so
    try:
        for tensor in tensors:
            if tensor is not None:
                tensor.data_ptr()
    except RuntimeError:
        transformed = True
    if transformed:
        raise InputError(
            "a Rollout cannot be transformed by torch.func (vmap, grad, ...), nor its gradients batched: call it, and "
            "torch.autograd, one by one"
        )


def _range(name: str) -> dict[str, float]:
    """What ``number`` is to check of an input."""
    name = name.removeprefix("yarn_")
    if name not in (*YARN_PARAMETERS, *NUMBERS):
        return {}
    return {"above": 0.0} if name in ABOVE_0 else {"least": 0.0}


def _real(name: str, value: Any) -> torch.Tensor:
    """value as a dense tensor of real numbers, or an InputError."""
    if not isinstance(value, torch.Tensor):
        try:
            array = np.asarray(value)
        except (TypeError, ValueError, RuntimeError) as error:  # ragged, or a list of tensors that need a gradient
            raise InputError(f"{name} must be a tensor or an array of numbers ({error}), got {value!r}") from error
        if array.dtype.kind not in "fiub":
            raise InputError(f"{name} must be a tensor or an array of real numbers, got {value!r}")
        return torch.as_tensor(array.astype(np.float64))
    if value.is_complex() or value.layout != torch.strided:
        raise InputError(f"{name} is a tensor of {value.dtype}, {value.layout}: it must be one of real numbers, dense")
    return value


def _flat(array: wp.array) -> torch.Tensor:
    """An array's numbers as a one-dimensional tensor on the same memory."""
    scalar = getattr(array.dtype, "_wp_scalar_type_", array.dtype)
    count = array.size * getattr(array.dtype, "_length_", 1)
    view = wp.array(ptr=array.ptr, dtype=scalar, shape=count, device=array.device, copy=False)
    return wp.to_torch(view, requires_grad=False)


class _Run(torch.autograd.Function):
    """A run as one torch operation."""

    @staticmethod
    def forward(
        ctx: Any, rollout: Rollout, names: tuple[str, ...], steps_done: int, *tensors: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        values = {name: tensor.detach() for name, tensor in zip(names, tensors, strict=True)}
        frames, kept = rollout._run(values, steps_done, differentiable=True)
        ctx.rollout, ctx.names, ctx.kept_names, ctx.steps_done = rollout, names, tuple(kept), steps_done
        ctx.save_for_backward(*tensors, *kept.values())
        ctx.set_materialize_grads(False)
        return tuple(frames[name] for name in FIELDS)

    @staticmethod
    def backward(ctx: Any, *losses: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        ctx.wanted = [name for name, needed in zip(ctx.names, ctx.needs_input_grad[3:], strict=True) if needed]
        saved, inputs = ctx.saved_tensors, len(ctx.names)  # once: torch.utils.checkpoint gives them no second time
        kept = dict(zip(ctx.kept_names, saved[inputs:], strict=True))
        found = _Gradient.apply(ctx, kept, *losses, *saved[:inputs])
        gradients = dict(zip(ctx.wanted, found, strict=True))
        return (None, None, None, *(gradients.get(name) for name in ctx.names))

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> None:
        raise GradientError("a Rollout has no forward mode: use loss.backward()", step=None, term=None)


class _Gradient(torch.autograd.Function):
    """The backward pass as a torch operation on the frames' gradients and the run's inputs, without a derivative.

    It says so even where the frames' gradients are constants, as a linear loss's are: the gradient still depends on the
    inputs.
    """

    @staticmethod
    def forward(
        ctx: Any, run: Any, kept: dict[str, torch.Tensor], *tensors: torch.Tensor | None
    ) -> tuple[torch.Tensor, ...]:
        losses = dict(zip(FIELDS, tensors, strict=False))
        values = dict(zip(run.names, tensors[len(FIELDS) :], strict=True))
        with run.rollout.simulator.lock, ALONE:
            return tuple(run.rollout._backward(values, run.steps_done, kept, run.wanted, losses))

    @staticmethod
    def backward(ctx: Any, *_: Any) -> None:
        raise GradientError(
            "a Rollout has no second derivatives: take differences of its gradient", step=None, term=None
        )


class Fabric(torch.nn.Module):
    """A rollout whose physical parameters are learned within ranges: ω = a·sigmoid(y) + b, as in the paper.

    A ``state_dict`` holds the ranges too. Loaded into a Fabric with other ranges it keeps the physical values, which
    must lie in these.

    Args:
        scene, steps, options: as of Rollout.
        learn: {input: (lowest, highest)}, in the input's unit, within the range that the input has; highest above
            lowest.
        initial: {input of learn: value} to start from, strictly inside the range; the scene's own value where it is
            left out.
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
        shapes, initial = self.rollout.inputs, {} if initial is None else initial
        for name, value in (("learn", learn), ("initial", initial)):
            if not isinstance(value, Mapping):
                raise InputError(f"{name} = {value!r}, must be a dict by names of inputs")
        for name in initial:
            choice("a name in initial", name, learn)
        self.ranges = {}
        self.y = torch.nn.ParameterDict()
        for name, pair in learn.items():
            if name not in shapes:
                raise InputError(f"learn names {name!r}, must be among {', '.join(sorted(shapes))}")
            self.ranges[name] = _pair(name, pair)
            self.y[name] = torch.nn.Parameter(torch.zeros(shapes[name], dtype=self.rollout.dtype))
            self.set(name, initial.get(name, self._default(name)))

    def _default(self, name: str) -> torch.Tensor:
        if name in YARN_PARAMETERS:
            return torch.tensor([getattr(yarn, name) for yarn in self.rollout.scene.cloth.yarns], dtype=torch.float64)
        return self.rollout.defaults[name.removeprefix("yarn_")]

    def value(self, name: str) -> torch.Tensor:
        """A parameter in its physical unit; differentiable."""
        low, high = self.ranges[choice("name", name, self.ranges)]
        return low + (high - low) * torch.sigmoid(self.y[name])

    @property
    def values(self) -> dict[str, torch.Tensor]:
        """Every parameter in its physical unit; differentiable."""
        return {name: self.value(name) for name in self.ranges}

    @torch.no_grad()
    def set(self, name: str, value: Any) -> None:
        """Sets a parameter to a physical value strictly inside its range."""
        y = self.y[choice("name", name, self.ranges)]
        value = _real(name, value).to(dtype=y.dtype, device=y.device)
        try:
            value = value.expand(y.shape)
        except RuntimeError as error:
            raise InputError(f"{name} has shape {tuple(value.shape)}, must be {tuple(y.shape)}") from error
        y.copy_(self._inverse(name, value))

    def _inverse(self, name: str, value: torch.Tensor) -> torch.Tensor:
        """y of a physical value."""
        low, high = self.ranges[name]
        fraction = (value - low) / (high - low)
        if not bool(((fraction > 0.0) & (fraction < 1.0)).all()):
            raise InputError(f"{name} = {value}, must be strictly between {low:g} and {high:g}")
        return torch.logit(fraction)

    def forward(self, **inputs: Any) -> Frames:
        """The frames of a run with the present parameters, and any other inputs, as of Rollout."""
        for name in inputs:
            if name in self.ranges:
                raise InputError(f"{name} is learned, so a call cannot be given it: use set")
        return self.rollout(**self.values, **inputs)

    # -- state_dict --------------------------------------------------------------------------------------------------

    def get_extra_state(self) -> dict[str, tuple[float, float]]:
        return dict(self.ranges)

    def set_extra_state(self, state: Any) -> None:
        """Nothing: the ranges stay, and y was taken to them."""

    @torch.no_grad()
    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *others: Any) -> None:
        saved = state_dict.get(f"{prefix}_extra_state")
        for name in self.ranges:
            key = f"{prefix}y.{name}"
            if key not in state_dict:
                continue
            if not isinstance(saved, Mapping) or name not in saved:
                raise InputError(f"state_dict has no range of {name!r}, without which its {key!r} means nothing")
            low, high = _pair(name, saved[name])
            if (low, high) != self.ranges[name]:
                value = low + (high - low) * torch.sigmoid(state_dict[key].to(self.rollout.dtype))
                state_dict[key] = self._inverse(name, value)
        super()._load_from_state_dict(state_dict, prefix, *others)


def _pair(name: str, pair: Any) -> tuple[float, float]:
    """A range of an input, from lowest to highest, or an InputError."""
    try:
        low, high = pair
    except (TypeError, ValueError) as error:
        raise InputError(f"learn[{name!r}] = {pair!r}, must be two numbers, (lowest, highest)") from error
    # every value in between is allowed where the lowest is, or is just not
    least = 0.0 if _range(name) else None
    low, high = number(f"learn[{name!r}][0]", low, least=least), number(f"learn[{name!r}][1]", high)
    if not low < high:
        raise InputError(f"learn[{name!r}] = ({low:g}, {high:g}), the second must be above the first")
    return low, high
