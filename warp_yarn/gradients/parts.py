"""Steps of a run that were made in parts, as the backward pass needs them: a chain of shorter steps.

Which parts a step is made in is decided by tests that jump; so sizes and methods are held constant, and the gradient
is that of the steps as they were made. What a part needs is kept, and it is not made again: whether a step is made in
parts depends on what the watch over energy had seen before it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from typing import Any

import torch

from ..device.arrays import MOVING
from ..device.exclusive import ALONE
from ..simulation.simulator import Simulator
from .checkpoints import flat


@dataclasses.dataclass(frozen=True)
class Part:
    """A part of a step.

    Args:
        size: of the step.
        left: part of the step that was left when it began, itself included.
        method: the integrator that made it.
        start: what moves of the state that it started from, flat, by names.
        projected: what impact zones did at its end; None: nothing.
    """

    size: float
    left: float
    method: Any
    start: Mapping[str, torch.Tensor]
    projected: Any = None


@dataclasses.dataclass
class SplitStep:
    """A step that was made in parts: these, in their order, and what moves of the state at its end."""

    parts: list[Part]
    end: Mapping[str, torch.Tensor]

    def put(self, simulator: Simulator, k: int) -> None:
        """Puts the start of part k in frame 0 of the device, and its end in frame 1."""
        end = self.parts[k + 1].start if k + 1 < len(self.parts) else self.end
        for name, start in self.parts[k].start.items():
            frames = flat(simulator.arrays[f"frame_{name}"])
            frames[: len(start)].copy_(start)
            frames[len(start) : 2 * len(start)].copy_(end[name])
        if simulator.model.zones is not None:
            simulator.model.zones.put(1, [self.parts[k].projected])


class PartsRecorder:
    """Keeps steps that a simulator makes in parts.

    Args:
        simulator: the simulator.
        steps_done: steps since the beginning, before the run.

    Attributes:
        steps: by their number in the run, from 1 on.
    """

    def __init__(self, simulator: Simulator, steps_done: int):
        self.simulator, self.steps_done = simulator, steps_done
        self.steps: dict[int, SplitStep] = {}

    @contextlib.contextmanager
    def recording(self) -> Iterator[None]:
        """Records for as long as a block lasts."""
        self.simulator.substepping.watcher = self._note
        try:
            yield
        finally:
            self.simulator.substepping.watcher = None

    def _note(self, method: Any, size: float, left: float) -> None:
        """Takes down a part that was made, whose end is the present state."""
        with ALONE:
            arrays = self.simulator.arrays
            moving = [name for name in MOVING if self.simulator.moves(name)]
            start, end = ({name: flat(arrays[of + name]).clone() for name in moving} for of in ("kept_", ""))
            step = int(arrays["counters"].numpy()[1]) - self.steps_done
            zones = self.simulator.model.zones
            projected = None if zones is None else zones.made.get(int(arrays["counters"].numpy()[0]))
        if left == 1.0:  # whatever was begun before, and given up
            self.steps[step] = SplitStep([], end)
        self.steps[step].parts.append(Part(size, left, method, start, projected))
        self.steps[step].end = end


def pieces(steps: int, chunk: int, split: Mapping[int, SplitStep]) -> list[tuple[int, int]]:
    """Cuts a run into what is taken back at once: chunks, and each step that was made in parts alone.

    Returns:
        First step and number of steps of each piece, in their order.
    """
    result = []
    for first in range(0, steps, chunk):
        end = min(first + chunk, steps)
        cuts = sorted({first, end, *(at for k in split if first < k <= end for at in (k - 1, k))})
        result += [(a, b - a) for a, b in itertools.pairwise(cuts)]
    return result
