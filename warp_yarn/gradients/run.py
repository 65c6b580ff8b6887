"""A run on the device, forward and backward: tensors in, frames out; gradients of frames in, of inputs out.

Here torch's tensors meet Warp's arrays, and nothing is recorded by torch: that is the matter of ``rollout``.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from ..device.arrays import STATE_TYPES
from ..device.exclusive import ALONE, refuse_recording
from ..simulation.simulator import Simulator
from ..simulation.state import FIELDS, State
from .adjoint import Adjoint, Crowded
from .checkpoints import Checkpoints, flat
from .inputs import ARRAY_OF_PATH, Inputs, array_of
from .parts import PartsRecorder, SplitStep, pieces


class Kept(NamedTuple):
    """What a run keeps for its backward pass."""

    states: dict[str, torch.Tensor]
    """What moves of the states that ``Checkpoints`` keeps."""
    split: dict[int, SplitStep]
    """Steps that were made in parts, by their number in the run."""
    projected: list[Any]
    """What impact zones did at the end of each step; empty where there are none."""


class DeviceRun:
    """Makes runs of a simulator that depend on their inputs alone, and takes them back.

    Whoever calls holds the simulator's lock.

    Args:
        simulator: of the scene, differentiable.
        inputs: of the scene.
        steps: of a run.
        frames: which of its frames are asked for, increasing.
        checkpoint_every: keep every so many states for the backward pass.
    """

    def __init__(self, simulator: Simulator, inputs: Inputs, steps: int, frames: np.ndarray, checkpoint_every: int):
        self.simulator, self.inputs, self.steps, self.frames = simulator, inputs, steps, frames
        self.checkpoints = Checkpoints(simulator, steps, checkpoint_every, inputs.dtype)
        self._adjoint: Adjoint | None = None

    def forward(
        self, values: Mapping[str, torch.Tensor], steps_done: int, *, differentiable: bool
    ) -> tuple[dict[str, torch.Tensor], Kept]:
        """Makes the steps.

        Args:
            values: of inputs, named as ``Inputs.defaults``, which has the others.
            steps_done: steps since the beginning.
            differentiable: whether a backward pass is to follow.

        Returns:
            The frames that are asked for, and what the backward pass starts from. They share no memory: a frame that is
            changed in place would turn the gradient.
        """
        simulator = self.simulator
        with ALONE:
            refuse_recording(simulator.model.device)
            self._upload(values, steps_done)
        kept = self.checkpoints.room() if differentiable else {}
        result = self.checkpoints.room(len(self.frames))
        recorder, done = PartsRecorder(simulator, steps_done), 0
        zones, projected = simulator.model.zones, []
        while done < self.steps:
            asked = min(simulator.chunk, self.steps - done)
            with recorder.recording() if differentiable else contextlib.nullcontext():
                made = simulator.run_chunk(asked)
            if made < asked:
                simulator.fail(done + made + 1, simulator.chunk_trajectory(made + 1))
            inside = np.flatnonzero((self.frames >= done + (done > 0)) & (self.frames <= done + made))
            with ALONE:
                self.checkpoints.keep(kept, done, made)
                if zones is not None and differentiable:
                    projected += [zones.made.get(k + 1) for k in range(made)]
                if len(inside):
                    self.checkpoints.store(result, self.frames[inside] - done, int(inside[0]))
            done += made
        given = {**self.inputs.defaults, **values}
        frames = {
            name: result[name] if name in result else given[name].expand(len(self.frames), -1, -1).clone()
            for name in FIELDS
        }
        return frames, Kept(kept, recorder.steps, projected)

    def backward(
        self,
        values: Mapping[str, torch.Tensor],
        steps_done: int,
        kept: Kept,
        wanted: Sequence[str],
        losses: Mapping[str, torch.Tensor | None],
    ) -> list[torch.Tensor]:
        """Goes back over a run.

        Args:
            values, steps_done: as of ``forward``.
            kept: what it kept.
            wanted: names of inputs.
            losses: gradients of the frames by the parts of the state; None: 0.

        Returns:
            Gradients of the wanted inputs.
        """
        refuse_recording(self.simulator.model.device)
        while True:
            try:
                self._go_back(values, steps_done, kept, wanted, losses)
            except Crowded:
                self.simulator.stepper.make_room()
            else:
                return [self._gradient(name, values[name], losses) for name in wanted]

    def _go_back(
        self,
        values: Mapping[str, torch.Tensor],
        steps_done: int,
        kept: Kept,
        wanted: Sequence[str],
        losses: Mapping[str, torch.Tensor | None],
    ) -> None:
        """Goes back over a run, and leaves gradients on the device."""
        self._upload(values, steps_done)
        adjoint = self._adjoint_of(wanted)
        adjoint.clear()
        for first, steps in reversed(pieces(self.steps, self.simulator.chunk, kept.split)):
            step = kept.split.get(first + 1)
            if step is None:
                before = kept.split.get(first)
                start = None if before is None or first % self.simulator.chunk == 0 else before.end
                self.checkpoints.bring_back(kept.states, first, steps, steps_done, start)
                if self.simulator.model.zones is not None:
                    self.simulator.model.zones.put(1, kept.projected[first : first + steps])
                self._set_losses(losses, first, steps)
                adjoint.backward_chunk(first, steps, steps_done)
                continue
            self._set_losses(losses, first, steps)
            for k, part in reversed(list(enumerate(step.parts))):
                step.put(self.simulator, k)
                adjoint.backward_part(part.method, part.size, part.left, first + 1, steps_done)
        self._set_losses(losses, -1, 1, move=1)
        adjoint.finish()

    def _upload(self, values: Mapping[str, torch.Tensor], steps_done: int) -> None:
        """Puts inputs, and the scene's own values of the others, into the simulator, whatever the last run left."""
        simulator, arrays = self.simulator, self.simulator.arrays
        given = {**self.inputs.defaults, **values}
        for name, value in given.items():
            if name not in FIELDS:
                flat(arrays[array_of(name, value)])[: value.numel()].copy_(value.reshape(-1))
        simulator.state = State(*(given[name].cpu().numpy() for name in FIELDS))
        simulator.steps_done = steps_done
        simulator.split_steps, simulator.damped_steps = {}, set()
        # an interrupted run may have left these
        arrays.zero("status")
        simulator.integrator.set_times(simulator.step_size, simulator.step_size)

    def _adjoint_of(self, wanted: Sequence[str]) -> Adjoint:
        """Finds the adjoint for these inputs: the last one, or a new one, since a simulator has one at a time."""
        parameters = tuple(sorted(ARRAY_OF_PATH.get(name, name) for name in wanted if name not in FIELDS))
        last, self._adjoint = self._adjoint, None  # and none if this is interrupted
        if last is None or last.parameters != parameters:
            if last is not None:
                last.release()
            last = Adjoint(self.simulator, parameters)
        self._adjoint = last
        return last

    def _set_losses(self, losses: Mapping[str, torch.Tensor | None], first: int, steps: int, move: int = 0) -> None:
        """Puts the gradients of frames first + 1 ... first + steps where the backward steps look for them."""
        inside = np.flatnonzero((self.frames > first) & (self.frames <= first + steps))
        for name, width in STATE_TYPES.items():
            array = self.simulator.arrays[f"loss_{name}"]
            if array is None:
                continue
            target = flat(array).view(-1, self.inputs.cloth.nodes, width)
            target[: steps + 1].zero_()
            loss = losses[name]
            if loss is not None and len(inside):
                rows = torch.as_tensor(self.frames[inside] - first - move, device=self.inputs.device)
                target[rows] = loss[int(inside[0]) : int(inside[-1]) + 1]

    def _gradient(self, name: str, value: torch.Tensor, losses: Mapping[str, torch.Tensor | None]) -> torch.Tensor:
        """Reads an input's gradient from the device."""
        array = self.simulator.arrays[array_of(name, value)]
        loss = losses.get(name)
        repeated = None if loss is None else loss.sum(dim=0)
        if array is None:  # a part of the state that this scene does not have: every frame repeats it
            return torch.zeros_like(value) if repeated is None else repeated
        gradient = flat(array.grad)[: value.numel()].reshape(value.shape).clone()
        if name == "anchor" and repeated is not None:  # as it does the border's, which no kernel takes back
            border = self.inputs.cloth.topology.is_crossing == 0
            gradient[border] = repeated[border]
        return gradient
