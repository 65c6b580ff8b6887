"""Learns throws into the box by the gradient of the simulator: forces by themselves, or a network that gives them.

Needs the extra ``torch``.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch

from ..description.scene import Scene
from ..errors import GradientError, InputError, SimulationError, integer, real
from ..gradients.rollout import Frames, Rollout
from ..simulation.simulator import Simulator
from ..simulation.state import State, Trajectory
from . import box

FLIGHT = 200
"""Steps until whatever is thrown into the box has arrived."""
LIFT = 0.5
"""Of the largest force, about: upward, where learning begins. A cloth that is pressed onto the table stays there."""
SPREAD = 0.5
"""Of the start by chance, about as much."""
BOUND = 1.0
"""Largest norm of a gradient that is followed as it is, with lengths in units of the box's distance."""
RETREAT = 0.9
"""What is left of parameters whose throw cannot be simulated."""


class Throw:
    """A throw as a function of its policy: how far from the target it arrives, with a gradient.

    A policy is called with the state before each of the first ``box.PUSHED`` steps and gives forces [4, 3] (N).

    Args:
        at: the step whose centre counts, or None: where the centre falls through the height ``box.ARRIVES``, before
            anything but air decides.
        touches: "nothing", "table" or "all" (``box.TOUCHES``): what the cloth touches while it learns.
        friction: μ of it, while it learns.
        place: the box's middle, in x and y [m].
        options: of the Rollout, but its step.

    Raises:
        InputError: ``at`` before forces have ended, or as of ``box.scene`` and a Rollout.

    Attributes:
        start: the state in which the cloth lies on the table.
    """

    def __init__(
        self,
        *,
        at: int | None = None,
        touches: str = "nothing",
        friction: float = box.FRICTION,
        place: Any = box.PLACE,
        **options: Any,
    ):
        if "step" in options:
            raise InputError(f"step = {options['step']!r} is no option of a Throw: forces act for {box.PUSHED} ms")
        self.at, self.place = at, place
        self.cloth = box.cloth()
        scene = box.scene(self.cloth, np.zeros((1, 4, 3)), place=place, friction=friction, touches=touches)
        options = {"step": box.STEP, "integrator": box.INTEGRATOR, **options}
        rest = integer("at", FLIGHT if at is None else at, least=box.PUSHED + 1) - box.PUSHED
        frames = None if at is None else [rest]
        self._push = Rollout(scene, 1, frames=[1], **options)
        # it begins where forces have ended
        self._fly = Rollout(scene, rest, frames=frames, **options)
        lies = self._push.simulator.state
        self.start = State(*(torch.as_tensor(getattr(lies, name).copy()) for name in Frames._fields))
        self.target = torch.as_tensor(box.target(place))
        self.length = float(np.linalg.norm(box.target(place)))

    def __call__(self, policy: Callable[[State, int], torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        """Makes the throw.

        Returns:
            The squared distance of the centre from the target, in units of the box's distance, and the forces
            [PUSHED, 4, 3] (N).

        Raises:
            SimulationError: a step that could not be made.
        """
        state, forces = self.start, []
        for step in range(box.PUSHED):
            forces.append(policy(state, step))
            state = self._push(state=state, forces=forces[-1][None]).last
        path = self._fly(state=state, steps_done=1).position.mean(dim=1)
        centre = box.arrival(path) if self.at is None else path[-1]
        return ((centre - self.target) / self.length).square().sum(), torch.stack(forces)


class Forces(torch.nn.Module):
    """Forces without a policy: 60 numbers, each bounded by ``box.FORCE`` through tanh.

    Args:
        seed: of the start, by chance about an upward force.
        lift: of its mean, 0 for none.
    """

    def __init__(self, seed: int, lift: float = LIFT):
        super().__init__()
        chance = torch.Generator().manual_seed(seed)
        start = SPREAD * torch.randn((box.PUSHED, 4, 3), generator=chance, dtype=torch.float64)
        start[..., 2] += lift
        self.inner = torch.nn.Parameter(start)

    def forward(self, state: State, step: int) -> torch.Tensor:
        """Gives the forces of a step [4, 3] (N)."""
        return box.FORCE * torch.tanh(self.inner[step])


class Network(torch.nn.Module):
    """The network of the paper before the simulator, 250 → 125 → 60 → 12 for a cloth of 5 × 5, with ReLU between: it
    sees positions, (u, v) and the rates of both, and gives a force to each corner along each axis, bounded by
    ``box.FORCE`` through tanh.

    Args:
        seed: of its weights.
        lift: of the mean start, upward.
    """

    def __init__(self, seed: int, lift: float = LIFT):
        super().__init__()
        self.layers = layers(seed, 12)
        with torch.no_grad():
            self.layers[-1].bias.view(4, 3)[:, 2] += lift

    def forward(self, state: State, step: int) -> torch.Tensor:
        """Gives the forces of a step [4, 3] (N)."""
        return box.FORCE * torch.tanh(self.layers(seen(state))).view(4, 3)


def layers(seed: int, outputs: int) -> torch.nn.Sequential:
    """Makes the paper's layers for a cloth of 5 × 5: 250 → 125 → 60 → outputs."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        sizes = (2 * (box.SIDE**2 * 3 + box.SIDE**2 * 2), 125, 60, outputs)
        linear = [torch.nn.Linear(a, b, dtype=torch.float64) for a, b in itertools.pairwise(sizes)]
    return torch.nn.Sequential(linear[0], torch.nn.ReLU(), linear[1], torch.nn.ReLU(), linear[2])


def seen(state: State) -> torch.Tensor:
    """Gives what the network sees of a state, [250]: lengths in millimetres, speeds in m/s."""
    lengths = [1e3 * x.flatten() for x in (state.position, state.euler)]
    return torch.cat([*lengths, state.velocity.flatten(), state.euler_velocity.flatten()])


RATES = {Forces: 0.1, Network: 0.003}
"""Learning rates of Adam."""


@dataclasses.dataclass(frozen=True)
class Epoch:
    """What an epoch found.

    Args:
        loss: that was learned from; NaN: the throw could not be simulated.
        gradient: its norm, before it was bounded.
        forces: [PUSHED, 4, 3] (N).
        miss: how far from the box's middle the throw arrives in the true scene [m]; NaN as of loss.
        success: whether it ended inside the box.
        seconds: since the start, judging included.
    """

    loss: float
    gradient: float
    forces: np.ndarray
    miss: float
    success: bool
    seconds: float


def learn(
    throw: Throw,
    policy: torch.nn.Module,
    epochs: int,
    *,
    rate: float | None = None,
    bound: float = BOUND,
    judged: Callable[[np.ndarray, Any], tuple[float, bool]] | None = None,
) -> Iterator[Epoch]:
    """Learns a policy by Adam, and judges the throw of each epoch in the true scene.

    Args:
        throw: what is learned from.
        epochs: how many, at least 1.
        rate: of Adam, above 0; None: as in ``RATES``.
        bound: of the gradient's norm, above 0.
        judged: ``judge``, or what stands for it.
    """
    integer("epochs", epochs, least=1)
    rate = real("rate", RATES[type(policy)] if rate is None else rate, above=0.0)
    real("bound", bound, above=0.0)
    judged = judge if judged is None else judged
    optimizer = torch.optim.Adam(policy.parameters(), lr=rate)
    begin = time.perf_counter()
    for _ in range(epochs):
        optimizer.zero_grad()
        try:
            loss, given = throw(policy)
            loss.backward()
        except (SimulationError, GradientError):
            with torch.no_grad():
                for parameter in policy.parameters():
                    parameter *= RETREAT
            yield Epoch(np.nan, np.nan, np.full((box.PUSHED, 4, 3), np.nan), np.nan, False, time.perf_counter() - begin)
            continue
        gradient = float(torch.nn.utils.clip_grad_norm_(policy.parameters(), bound))
        forces = given.detach().numpy().copy()
        miss, success = judged(forces, throw.place)
        yield Epoch(float(loss.detach()), gradient, forces, miss, success, time.perf_counter() - begin)
        optimizer.step()


def true_throw(forces: np.ndarray, place: Any = box.PLACE) -> Trajectory:
    """Makes the throw in the true scene: table, floor, walls and friction.

    Args:
        forces: [PUSHED, 4, 3] (N).
    """
    scene: Scene = box.scene(box.cloth(), forces, place=place)
    return Simulator(scene, step=box.STEP, integrator=box.INTEGRATOR).run(box.STEPS)


def judge(forces: np.ndarray, place: Any = box.PLACE) -> tuple[float, bool]:
    """Makes the throw of these forces in the true scene, and tells how far from the box's middle it arrives, along x
    and y [m], and whether it succeeds; NaN where it cannot be simulated."""
    try:
        trajectory = true_throw(forces, place)
    except SimulationError:
        return np.nan, False
    off = box.arrival(trajectory.position.mean(axis=1)) - box.target(place)
    return float(np.linalg.norm(off[:2])), box.success(trajectory.position, trajectory.velocity, place)
