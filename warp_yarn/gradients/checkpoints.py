"""States of a run that are kept for its backward pass, and frames between them that are made again.

A run is made in chunks. Where every state is kept, chunks come back as they were; else a chunk begins with a kept state
and is simulated anew.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
import warp as wp

from ..device.arrays import MOVING
from ..errors import GradientError
from ..simulation.simulator import Simulator


class Checkpoints:
    """Keeps states of runs, as tensors on the device.

    What a run keeps is a dict of the parts of the state that move in this scene, each [states, nodes, width].

    Args:
        simulator: that makes the runs; its chunk is ``every``, if that is not 1.
        steps: of a run.
        every: keep every so many states; 1: all.
        dtype: of the tensors.
    """

    def __init__(self, simulator: Simulator, steps: int, every: int, dtype: torch.dtype):
        self.simulator, self.every, self.dtype = simulator, every, dtype
        self.count = -(-steps // every) + (every == 1)

    def room(self, count: int | None = None) -> dict[str, torch.Tensor]:
        """Makes room for so many frames of what moves; None: for what a run keeps."""
        simulator = self.simulator
        device, nodes = wp.device_to_torch(simulator.model.device), simulator.scene.cloth.nodes
        frames = self.count if count is None else count
        return {
            name: torch.empty((frames, nodes, width), dtype=self.dtype, device=device)
            for name, width in MOVING.items()
            if simulator.moves(name)
        }

    def store(self, target: Mapping[str, torch.Tensor], rows: np.ndarray, at: int) -> None:
        """Copies these frames of the chunk on the device to frames at... of the target."""
        for name, values in target.items():
            picked = torch.as_tensor(rows, device=values.device)
            frames = flat(self.simulator.arrays[f"frame_{name}"]).view(-1, *values.shape[1:])
            values[at : at + len(rows)] = frames[picked]

    def keep(self, kept: Mapping[str, torch.Tensor], done: int, made: int) -> None:
        """Keeps what is to be kept of the chunk on the device, which was begun after so many steps."""
        if self.every == 1:
            self.store(kept, np.arange(made + 1), done)
        else:
            self.store(kept, np.arange(1), done // self.every)

    def bring_back(
        self,
        kept: Mapping[str, torch.Tensor],
        first: int,
        steps: int,
        steps_done: int,
        start: Mapping[str, torch.Tensor] | None = None,
    ) -> None:
        """Puts the frames of a chunk, or of a piece of it, on the device again.

        Args:
            kept: what the run kept.
            first: steps of the run before them.
            steps: how many.
            steps_done: steps since the beginning, before the run.
            start: what moves of the state that a piece starts from, where it is not the chunk's first; flat.

        Raises:
            GradientError: a step that was made at once cannot be made so again.
        """
        simulator = self.simulator
        if self.every == 1:
            for name, source in kept.items():
                frames = flat(simulator.arrays[f"frame_{name}"]).view(-1, *source.shape[1:])
                frames[: steps + 1].copy_(source[first : first + steps + 1])
            return
        for name, source in kept.items():
            state = source[first // self.every].reshape(-1) if start is None else start[name]
            flat(simulator.arrays[name]).copy_(state)
        simulator.steps_done = steps_done + first
        # after the number of steps, which begins to watch anew
        simulator.model.energy.trust()
        made = simulator.run_chunk(steps)
        again = [k - steps_done for k in simulator.split_steps]
        if made < steps or again:
            step = min(again, default=first + made + 1)
            raise GradientError(f"step {step} was made at once, and could not be made so again", step=step, term=None)


def flat(array: wp.array) -> torch.Tensor:
    """Views an array's numbers as a one-dimensional tensor on the same memory."""
    scalar = getattr(array.dtype, "_wp_scalar_type_", array.dtype)
    count = array.size * getattr(array.dtype, "_length_", 1)
    view = wp.array(ptr=array.ptr, dtype=scalar, shape=count, device=array.device, copy=False)
    return wp.to_torch(view, requires_grad=False)
