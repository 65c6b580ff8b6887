"""The equilibrium of a cloth: where forces vanish, found by implicit steps from rest that grow.

A step of implicit Euler from rest minimizes V + M/(2η²) |x − x₀|²: Newton's iteration on the static problem, held by
the cloth's mass, which also holds what nothing else does. Where one cannot be made η falls; else it grows, until what
is left of the forces is small.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..description.sanity import GRAVITY
from ..device.exclusive import ALONE
from ..device.memory import put_slopes, slopes
from ..device.model import Model
from ..errors import InputError, SimulationError, integer, real
from ..integrators.implicit_euler import ImplicitEuler
from ..integrators.made import held
from ..kernels.core.status import CROWDED
from .inspection import with_room
from .reactions import rounding_force
from .state import FIELDS, State
from .stepper import Stepper

GROWTH, SHRINKAGE = 3.0, 0.1
"""Of η, after a step that was made and one that was not."""
LONGEST, SHORTEST = 1e9, 1e-6
"""η, in steps of the simulator: the damping of sliding, which acts by rates, is to vanish beside stiffness."""
STILL = 1e-3
"""Of a node's mean weight: the force that is left by default."""
ROUGH = 0.1
"""Of it: what rounding may leave at most where nothing is said."""
GONE = 10.0
"""Times the size of the cloth: how far it may move as a whole before nothing holds it."""


class Relaxed(NamedTuple):
    """An equilibrium that was found.

    Args:
        residual: the largest force that is left on a node, or along a yarn at a crossing [N].
        iterations: steps that were tried.
        reactions: forces of pins on the cloth [pins, 3] (N).
    """

    residual: float
    iterations: int
    reactions: np.ndarray


class Relaxation:
    """Brings a stepper's model to rest. An exception leaves the state as it was.

    Args:
        stepper: of the simulator.
        residual: the force to end with [N]; None: by the cloth's weight.
        most: steps to try.
    """

    def __init__(self, stepper: Stepper, residual: float | None, most: int):
        self.stepper, self.model = stepper, stepper.model
        self.arrays, self.frames = self.model.arrays, stepper.frames
        self.most = integer("most", most, least=1)
        self.allowed = _default(self.model) if residual is None else real("residual", residual, above=0.0)
        if self.model.zones is not None:
            raise InputError("contact.method is 'impact-zones', must be 'barrier': impact zones have no forces")
        if self.model.contact.obstacles_move:
            raise InputError("an obstacle moves along its path, must stand still: replace the scene's obstacles")
        crossing = np.repeat(self.model.scene.cloth.topology.is_crossing[:, None] != 0, 2, axis=1)
        self.free = np.column_stack([np.ones((len(crossing), 3), dtype=bool), crossing]) & ~held(self.model)

    def find(self) -> Relaxed:
        """Finds the equilibrium, and makes it the simulator's state."""
        start, model = self.frames.state(), self.model
        watched, kept = model.energy.on, slopes(model)

        def go_home() -> None:
            model.energy.on = watched
            self.frames.upload(start)
            put_slopes(model, kept)
            model.energy.forget()
            self.arrays.put("status", 0, 0, 0)
            self.stepper.integrator.set_times(model.step_size, model.step_size)

        self.frames.close()
        self.stepper.owe(go_home)
        # the energy that each step takes away with the velocity is none that was lost
        model.energy.on = False
        with ALONE:
            self.method = ImplicitEuler(model)
        with model.threads.at_hand():
            result = self._steps(self.method, start)
        found = self.frames.state()
        self.stepper.pay()
        self.stepper.begin_from(found)
        return result

    def _steps(self, method: ImplicitEuler, start: State) -> Relaxed:
        """Makes steps until the residual is small."""
        model, size = self.model, self.model.step_size
        is_held = len(model.scene.pins) or model.contact.obstacles
        state = self._still(self.frames.state())
        self._begin(method, size)
        forces = self._forces()
        if not is_held and (total := np.linalg.norm(forces[:, :3].sum(axis=0))) > self.allowed:
            raise InputError(
                f"nothing holds the cloth, no pin and no obstacle, and {total:.3g} N move it as a whole: it has no "
                "equilibrium; pin a node, or leave out gravity, wind and forces that do not cancel"
            )
        extent = float(np.ptp(start.position, axis=0).max())
        for k in range(self.most + 1):
            left = np.abs(np.where(self.free, forces, 0.0)).max()
            if left <= self.allowed:
                return Relaxed(float(left), k, self._reactions(forces))
            if np.linalg.norm((state.position - start.position).mean(axis=0)) > GONE * extent:
                self._fail(k, left, "it falls or flies, and nothing holds it", state)
            if size < SHORTEST * model.step_size:
                self._fail(k, left, "no shorter step helps: it buckles, or the residual is below rounding", state)
            if k == self.most:
                break
            self._begin(method, size)
            method.advance()
            code = int(self.arrays["status"].numpy()[0])
            if code:
                self.arrays.put("status", 0, 0, 0)
                if code == CROWDED:
                    self.stepper.make_room()
                    method.forget_graphs()
                else:
                    size *= SHRINKAGE
                self.frames.upload(state)
                continue
            state = self._still(self.frames.state())
            size = min(GROWTH * size, LONGEST * model.step_size)
            self._begin(method, size)
            forces = self._forces()
        rounded = f"; rounding alone may leave {rounding_force(model):.2g} N" if model.precision == "single" else ""
        self._fail(self.most, left, f"after as many steps as it may take (most){rounded}", state)
        raise AssertionError

    def _still(self, state: State) -> State:
        """Stops the cloth in place."""
        for name in ("velocity", "euler_velocity"):
            getattr(state, name)[:] = 0.0
            if self.arrays[name] is not None:
                self.arrays[name].zero_()
        return state

    def _begin(self, method: ImplicitEuler, size: float) -> None:
        """Sets the length of the next step, and inputs to where they are now."""
        done = self.stepper.steps_done
        method.set_times(size, size)
        # pins and forces stay where the last step has brought them; before the first one, where they start
        self.arrays["stage_times"].fill_(float(done > 0))
        self.arrays.put("counters", 0, max(0, done - 1))
        if self.model.inputs.functions:
            self.model.inputs.evaluate(max(0, done - 1), self.frames.state().position)

    def _forces(self) -> np.ndarray:
        """Computes the forces on the cloth at rest, along x and (u, v) [nodes, 5] (N)."""
        a, nodes = self.arrays, self.model.scene.cloth.nodes
        self.model.inputs.load()
        if with_room(self.stepper, self.model.contact.find):
            self.method.forget_graphs()
        self.model.assemble(matrix=False)
        result = np.zeros((nodes, 5))
        size = float(a["step_size"].numpy()[0])
        result[:, :3] = a["rhs"].numpy()
        if a["euler_rhs"] is not None:
            result[:, 3:] = a["euler_rhs"].numpy().reshape(nodes, 2)
        return result / size

    def _reactions(self, forces: np.ndarray) -> np.ndarray:
        """Computes what pins give: what is left at exact ones, and the springs of others."""
        scene, a = self.model.scene, self.arrays
        if self.model.has_hard_pins:
            return -forces[scene.pins, :3]
        if "pins" not in scene.terms:
            return np.zeros((len(scene.pins), 3))
        stiffness = float(a["pin_stiffness"].numpy()[0])
        return stiffness * (a["pin_target"].numpy() - a["position"].numpy()[scene.pins]).astype(np.float64)

    def _fail(self, k: int, left: float, why: str, state: State) -> None:
        """Raises a SimulationError that says how far it came."""
        worst = int(np.abs(np.where(self.free, self._forces(), 0.0)).max(axis=1).argmax())
        trajectory = self.frames.room(1, self.stepper.steps_done)
        for name in FIELDS:
            getattr(trajectory, name)[0] = getattr(state, name)
        place = self.model.scene.cloth.place(worst)
        raise SimulationError(
            f"found no equilibrium: {left:.3g} N are left at node {worst} ({place}), asked for {self.allowed:.3g} N; "
            f"{why}. The state is as before; the error's trajectory has where it ended",
            step=k,
            node=worst,
            term=None,
            trajectory=trajectory,
        )


def _default(model: Model) -> float:
    """Gives the force to end with: a part of a node's weight, but what rounding of positions leaves at least."""
    rounding = rounding_force(model)
    weight = GRAVITY * model.arrays.node_mass()
    if rounding > ROUGH * weight:
        raise InputError(
            f"residual = None, must be given here: positions in {model.precision} precision leave forces of some "
            f"{rounding:.2g} N, a node weighs {weight:.2g} N; precision='double' comes nearer"
        )
    return max(STILL * weight, rounding)
