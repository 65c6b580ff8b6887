"""Runs as differentiable torch operations. Needs the extra ``torch``; users import it as ``import warp_yarn.torch``.

A ``Rollout`` is a function from tensors (materials, wind, pins, forces, initial state: whatever is given) to the frames
of a run. Here torch is told of it; what it takes is the matter of ``inputs``, what happens on the device of ``run``.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from ..description.scene import Scene
from ..device.exclusive import ALONE
from ..errors import GradientError, InputError, integer
from ..simulation.simulator import Simulator
from ..simulation.state import FIELDS, State
from .inputs import Inputs, refuse_transforms
from .run import DeviceRun, Kept

MOST_STEPS = 2**31 - 1
"""The device counts in 32 bits."""


def __getattr__(name: str) -> Any:
    """Finds ``Fabric`` where it was before."""
    if name != "Fabric":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from .fabric import Fabric

    warnings.warn(f"{__name__}.Fabric is warp_yarn.torch.Fabric now", DeprecationWarning, stacklevel=2)
    return Fabric


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
        self.steps = integer("steps", steps, least=1)
        self.checkpoint_every = integer("checkpoint_every", checkpoint_every, least=1)
        self.frames = np.arange(steps + 1) if frames is None else np.array(frames)
        if not are_in_order(self.frames, steps):
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
        self._inputs = Inputs(self.simulator)
        self.dtype, self.device = self._inputs.dtype, self._inputs.device
        self.of_yarns, self.of_crossings = self._inputs.of_yarns, self._inputs.of_crossings
        self._run = DeviceRun(self.simulator, self._inputs, self.steps, self.frames, self.checkpoint_every)

    def __getstate__(self) -> dict[str, Any]:
        """Keeps what it is made of, and nothing on the device."""
        made_of = {"scene": self.scene, "steps": self.steps, "frames": self.frames}
        return {**made_of, "checkpoint_every": self.checkpoint_every, **self._options}

    def __setstate__(self, made_of: dict[str, Any]) -> None:
        """Makes it anew."""
        Rollout.__init__(self, **made_of)

    @property
    def defaults(self) -> dict[str, torch.Tensor]:
        """The scene's own value of everything that an input can replace, density, stretch and bend by yarn; a copy."""
        return {name: value.clone() for name, value in self._inputs.defaults.items()}

    @property
    def inputs(self) -> dict[str, tuple[int, ...]]:
        """Everything that a call takes, and that a gradient can be asked for: name and shape.

        density, stretch and bend are of each material; with ``yarn_`` before them, of each yarn, the warp yarns first.
        shear, friction, friction_stiffness and friction_damping have the cloth's own shapes: a number, one of each pair
        of materials, or one of each node; where any number of the cloth is not the same everywhere, with ``node_``
        before them, of each node, of which those on the border mean nothing.
        pin_path and forces have the shapes that the scene gave them. Nodes on the border have no Eulerian coordinate:
        their rows of euler_velocity are taken for 0.
        """
        return dict(self._inputs.shapes)

    def __call__(self, *, state: State | None = None, steps_done: int = 0, **inputs: Any) -> Frames:
        """Runs the scene with these inputs (see ``inputs``) in place of its own values.

        Args:
            state: what the run starts from, in place of position, euler, velocity, euler_velocity and anchor: the
                ``last`` of another call's frames, or a State of a Simulator. Where euler is given without anchor, as
                None here, friction's springs start unstrained.
            steps_done: how many steps were made before the state, by which pin_path and forces are looked up, at
                least 0. A run in parts is the same as at once: ``rollout(state=frames.last, steps_done=10)``, but with
                "esdirk3", which goes on by a slope that no state tells.
            inputs: tensors, or arrays of numbers.

        Raises:
            InputError: an input that the scene does not have, of another shape, not real, not finite, or out of the
                range that Yarn, Cloth, Wind and Scene give; a call under torch.func, a wp.Tape or a graph's capture.
            SimulationError: a step that could not be made.
        """
        refuse_transforms()
        steps_done = integer("steps_done", steps_done, least=0)
        if steps_done + self.steps > MOST_STEPS:
            raise InputError(f"steps_done = {steps_done}, must be at most {MOST_STEPS - self.steps}")
        values = self._inputs.by_yarn(state, inputs)
        with self.simulator.lock:  # a run and its frames are one thread's until it has them
            if torch.is_grad_enabled() and any(value.requires_grad for value in values.values()):
                return Frames(*_Forward.apply(self._run, tuple(values), steps_done, *values.values()))
            values = {name: value.detach() for name, value in values.items()}
            return Frames(**self._run.forward(values, steps_done, differentiable=False)[0])


def are_in_order(frames: np.ndarray, steps: int) -> bool:
    """Tells whether these are whole numbers that increase, from 0 at least to the steps at most."""
    if frames.ndim != 1 or frames.dtype.kind not in "iu":
        return False
    frames = frames.astype(object)  # no unsigned differences
    return len(frames) > 0 and frames[0] >= 0 and frames[-1] <= steps and bool((np.diff(frames) > 0).all())


class _Forward(torch.autograd.Function):
    """A run as one torch operation."""

    @staticmethod
    def forward(
        ctx: Any, run: DeviceRun, names: tuple[str, ...], steps_done: int, *tensors: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Makes the run."""
        values = {name: tensor.detach() for name, tensor in zip(names, tensors, strict=True)}
        frames, kept = run.forward(values, steps_done, differentiable=True)
        ctx.run, ctx.names, ctx.steps_done = run, names, steps_done
        ctx.kept_names, ctx.split, ctx.projected = tuple(kept.states), kept.split, kept.projected
        ctx.save_for_backward(*tensors, *kept.states.values())
        ctx.set_materialize_grads(False)
        return tuple(frames[name] for name in FIELDS)

    @staticmethod
    def backward(ctx: Any, *losses: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        """Asks for the gradients of those inputs that need one."""
        ctx.wanted = [name for name, needed in zip(ctx.names, ctx.needs_input_grad[3:], strict=True) if needed]
        saved, inputs = ctx.saved_tensors, len(ctx.names)  # once: torch.utils.checkpoint gives them no second time
        kept = Kept(dict(zip(ctx.kept_names, saved[inputs:], strict=True)), ctx.split, ctx.projected)
        found = _Backward.apply(ctx, kept, *losses, *saved[:inputs])
        gradients = dict(zip(ctx.wanted, found, strict=True))
        return (None, None, None, *(gradients.get(name) for name in ctx.names))

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> None:
        """Raises a GradientError."""
        raise GradientError("a Rollout has no forward mode: use loss.backward()", step=None, term=None)


class _Backward(torch.autograd.Function):
    """The backward pass as a torch operation on the frames' gradients and the run's inputs, without a derivative.

    It says so even where the frames' gradients are constants, as a linear loss's are: the gradient still depends on the
    inputs.
    """

    @staticmethod
    def forward(ctx: Any, forward: Any, kept: Kept, *tensors: torch.Tensor | None) -> tuple[torch.Tensor, ...]:
        """Goes back over the run that ``forward`` is the context of."""
        losses = dict(zip(FIELDS, tensors, strict=False))
        values = dict(zip(forward.names, tensors[len(FIELDS) :], strict=True))
        with forward.run.simulator.lock, ALONE:
            refuse_transforms(*losses.values())
            return tuple(forward.run.backward(values, forward.steps_done, kept, forward.wanted, losses))

    @staticmethod
    def backward(ctx: Any, *_: Any) -> None:
        """Raises a GradientError."""
        raise GradientError(
            "a Rollout has no second derivatives: take differences of its gradient", step=None, term=None
        )
