"""The task of the box as a Gymnasium environment, with the exact gradient of its return beside."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from ..errors import InputError, SimulationError, choice, finite_array, real
from ..simulation.simulator import Simulator
from ..simulation.state import State, Trajectory
from . import box
from .picture import picture

if TYPE_CHECKING:
    import torch

    from .gradient import Throws

SHIFT, TURN = 5e-3, np.pi / 4.0
"""How far a random start is from the table's middle along x and y, and how far it is turned, at most [m, rad]."""
PLACES = ((50e-3, -20e-3), (70e-3, 20e-3))
"""Lowest and highest x and y of the middle of a box at random [m]."""
FAR, FAST = 1.0, 20.0
"""Bounds of observed positions and velocities [m, m/s]: no throw comes near them."""
LOOK = 20
"""Steps of a flight between two looks at whether the cloth lies still."""
OPTIONS: dict[str, Any] = {"step": box.STEP, "integrator": box.INTEGRATOR}
"""Of the simulator, and of throws that have a gradient."""


class ThrowIntoBox(gymnasium.Env):
    """A cloth lies on a table: throw it into the box beside, by forces on its corners in the first five milliseconds.

    Each of the ``box.PUSHED`` steps of an episode is one step of the simulator, 1 ms; the last goes on until the cloth
    lies still. The scene, table and box with friction, is that of ``warp_yarn.envs.box``.

    Action, float32 [12]: forces on the four corners (as ``Cloth.corners()`` lists them) along x, y and z, from −1 to 1
    times 4 mN. What is outside is clipped; another shape, or what is not finite, is an InputError (a ValueError).

    Observation, float32 [153]: positions of the 25 nodes (m) and their velocities (m/s), three numbers each, then x and
    y of the box's middle (m) and which part of the pushes is done, from 0 to 1.

    Reward: 0, and in the end −d/(20 mm), d the distance between the middle of the box and that of the cloth where it
    first comes down to a quarter of the walls' height above the bottom, along x and y; without that, where it ends. So
    −1 is the middle of a wall.

    An episode is terminated when the cloth lies still, truncated after ``box.STEPS`` milliseconds, or where a step
    cannot be made, which ``info["failed"]`` then tells. ``info["is_success"]``, in the end: whether every node
    was inside and at rest for 20 ms; ``info["distance"]``: d [m].

    Args:
        render_mode: "rgb_array", or None.
        random: whether start and box are at random at a reset: the cloth's middle up to 5 mm off along x and y, turned
            up to 45°, the box's middle at 50 to 70 mm and −20 to 20 mm. Else they are in the middle of these.
        friction: μ of table, floor and walls, at least 0.

    Attributes:
        trajectory: the frames since the reset, with their scene, to be drawn by ``wy.write_usd`` and others.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012  as Gymnasium declares it

    def __init__(self, render_mode: str | None = None, *, random: bool = True, friction: float = box.FRICTION):
        if render_mode is not None:
            choice("render_mode", render_mode, self.metadata["render_modes"])
        self.render_mode, self.random = render_mode, bool(random)
        self.friction = real("friction", friction, least=0.0)
        self.cloth = box.cloth()
        nodes = self.cloth.nodes
        high = np.concatenate([np.full(3 * nodes, FAR), np.full(3 * nodes, FAST), np.full(2, FAR), np.ones(1)])
        self._low, self._high = np.append(-high[:-1], 0.0), high
        self.observation_space = gymnasium.spaces.Box(self._low.astype(np.float32), high.astype(np.float32))
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (12,), np.float32)
        self.simulator = Simulator(box.scene(self.cloth, friction=self.friction), **OPTIONS)
        self._rest = self.simulator.state
        self._throws: dict[str, Throws] = {}
        self.shift, self.turn, self.place = np.zeros(2), 0.0, np.array(box.PLACE)
        self._pushed = -1
        """Steps done with forces; -1: there was no reset yet."""
        self._forces = np.zeros((box.PUSHED, 4, 3))
        self._parts: list[Trajectory] = []

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins an episode.

        Args:
            seed: of all that is random from now on.
            options: where this start is: {"shift": 2 numbers [m], "turn": [rad], "place": of the box, 2 numbers [m]};
                what is left out is as ``random`` says.

        Raises:
            InputError: an option that there is not, or a start that touches something.
        """
        super().reset(seed=seed)
        given = {} if options is None else dict(options)
        for name in given:
            choice("a name in options", name, ("shift", "turn", "place"))
        low, high = (np.array(value) for value in PLACES)
        # always drawn, so that what is given changes nothing of the others
        drawn = self.np_random.uniform(-1.0, 1.0, 5) * self.random
        self.shift = finite_array("shift", given.get("shift", SHIFT * drawn[:2]), (2,))
        self.turn = real("turn", given.get("turn", TURN * drawn[2]))
        self.place = finite_array("place", given.get("place", 0.5 * (low + high + (high - low) * drawn[3:])), (2,))
        self.simulator.reset()
        self.simulator.place_obstacles(box.obstacle_position(self.place))
        self.simulator.state = self._start()
        self._pushed, self._parts, self._forces = 0, [], np.zeros((box.PUSHED, 4, 3))
        return self._observed(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Makes a step with these forces; after the last of them, the rest of the throw.

        Raises:
            InputError: an action of another shape, or one that is not finite.
            gymnasium.error.ResetNeeded: an episode that is over, or that did not begin.
        """
        if not 0 <= self._pushed < box.PUSHED:
            raise gymnasium.error.ResetNeeded("the episode is over, or did not begin: call reset() first")
        share = np.clip(finite_array("action", action, (12,)), -1.0, 1.0)
        self._forces[self._pushed] = box.FORCE * share.reshape(4, 3)
        # its last row is what stays after the pushes
        self.simulator.arrays["applied_force_path"].assign(
            np.pad(self._forces, ((0, 1), (0, 0), (0, 0))).reshape(-1, 3)
        )
        self._pushed += 1
        info: dict[str, Any] = {}
        terminated = truncated = False
        try:
            self._parts.append(self.simulator.run(1))
            if self._pushed == box.PUSHED:
                terminated = self._fly()
                truncated = not terminated
        except SimulationError as error:
            self._parts.append(error.trajectory)
            self._pushed, truncated, info["failed"] = box.PUSHED, True, str(error)
        if not terminated and not truncated:
            return self._observed(), 0.0, False, False, info
        position, velocity = self._frames("position"), self._frames("velocity")
        distance = float(np.linalg.norm((box.arrival(position.mean(axis=1)) - box.target(self.place))[:2]))
        info |= {"is_success": terminated and box.success(position, velocity, self.place), "distance": distance}
        return self._observed(), -distance / (0.5 * box.INNER), terminated, truncated, info

    def _fly(self) -> bool:
        """Makes steps without forces until the cloth lies still, or the time is over; tells whether it lies still."""
        done = box.PUSHED
        while done < box.STEPS:
            steps = min(LOOK, box.STEPS - done)
            part = self.simulator.run(steps)
            self._parts.append(part)
            done += steps
            if box.at_rest(self._frames("velocity")[-box.REST_STEPS :]).all():
                return True
        return False

    def render(self) -> np.ndarray | None:
        """Draws the present state, from the side and from above, uint8 [height, width, 3]; None without render_mode."""
        if self.render_mode is None:
            return None
        return picture(self.simulator.state.position, self.cloth.weave.columns, self.place)

    @property
    def trajectory(self) -> Trajectory:
        """The frames since the reset, with the scene that makes them."""
        if self._pushed < 0:
            raise InputError("there are no frames: call reset() first")
        cloth = self.cloth.replace(pose=self._start().position)
        scene = box.scene(cloth, self._forces, place=self.place, friction=self.friction)
        names = ("position", "euler", "velocity", "euler_velocity", "anchor")
        if not self._parts:
            values = {name: getattr(self.simulator.state, name)[None] for name in names}
        else:
            values = {name: self._frames(name) for name in names}
        return Trajectory(scene.cloth, box.STEP, **values, scene=scene, start=0)

    def differentiable(self, actions: Any, *, touches: str = "all") -> torch.Tensor:
        """Computes the return of the episode that was reset last, had it these actions, with its exact gradient.

        It is the sum of rewards that ``step`` would give, to the tolerance that steps are solved to, which is 1e-8
        here. The episode itself stays where it is. Needs the extra ``torch``.

        Args:
            actions: a tensor of the episode's actions [box.PUSHED, 12]; those outside −1 to 1 are clipped, and have no
                gradient there.
            touches: what there is to be touched, as of ``box.scene``.

        Returns:
            The return, a tensor without dimensions; ``-differentiable(actions)`` is a loss.

        Raises:
            InputError: actions of another shape, or that are not finite; no reset before.
            SimulationError, GradientError: as of a Rollout.
        """
        if self._pushed < 0:
            raise InputError("there is no episode: call reset() first")
        from .gradient import Throws

        if touches not in self._throws:
            scene = box.scene(self.cloth, touches=touches, friction=self.friction)
            self._throws[touches] = Throws(scene, **OPTIONS)
        return self._throws[touches].returned(actions, self._start(), self.place)

    def _start(self) -> State:
        """Makes the state that the episode starts from."""
        return dataclasses.replace(self._rest, position=box.pose(self.cloth, self.shift, self.turn))

    def _frames(self, name: str) -> np.ndarray:
        """Joins the frames since the reset [frames, nodes, width]."""
        parts = [getattr(part, name) for part in self._parts]
        return np.concatenate([parts[0][:1], *(part[1:] for part in parts)])

    def _observed(self) -> np.ndarray:
        state, done = self.simulator.state, max(self._pushed, 0) / box.PUSHED
        seen = np.concatenate([state.position.ravel(), state.velocity.ravel(), self.place, [done]])
        return np.clip(seen, self._low, self._high).astype(np.float32)
