"""Forces that a test reads: reactions of pins, the work that is done, and the equilibrium."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..device.model import Model
from ..errors import InputError, NoAttributeError, finite_array
from .alone import alone
from .placing import Placing
from .reactions import Steps, reactions, work
from .relaxation import Relaxation, Relaxed
from .state import Trajectory

FIXED = ("scene", "step_size", "step_error", "chunk")
"""Attributes that a simulator has taken into its arrays when it was made."""


class Loads(Placing):
    """Reads what holds the cloth and moves it. A base of the simulator."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name in FIXED and name in vars(self):
            raise NoAttributeError(
                f"simulator.{name} cannot be set: its arrays are made; make another Simulator, and give it the state"
            )
        super().__setattr__(name, value)

    @alone
    def reactions(self, trajectory: Trajectory | None = None) -> np.ndarray:
        """Computes the forces that pins exert on the cloth, exact pins too: of a step its impulse over h.

        They close each step's balance of momentum to the solver's tolerance, by the equations of its method's stages.
        They are computed when asked for, from the frames at both ends of a step.

        Args:
            trajectory: frames of this simulator, with its present parameters; None: the last step. Those of another one
                of the same scene and options do too, if no step was made in parts, which only their maker knows.

        Returns:
            [pins, 3] (N), in the order of ``scene.pins``; of a trajectory [steps, pins, 3]. A step in parts is made
            again; NaN, with a WarpYarnWarning, where it ends elsewhere. A WarpYarnWarning too where spring pins that
            are moved give way by over 1 % of their way, and where an iteration more on a step of a trajectory would
            change its reactions by over 3 %: it was solved roughly, or is another simulator's.

        Raises:
            InputError: no step was made since the state was set, or what it had by ``set_inputs`` or
                ``place_obstacles``; frames of another cloth, scene, method or step, or not of every step; a step that
                is far from solving this simulator's equations, such as one of another's that was made in parts; impact
                zones, which have no forces; a registered integrator that is no StageMethod.
        """
        steps = Steps(self.stepper, trajectory)
        return steps.shaped(reactions(steps))

    @alone
    def work(self, trajectory: Trajectory | None = None) -> dict[str, np.ndarray]:
        """Computes the work done on the cloth from outside in each step [J], by who does it.

        Args:
            trajectory: as of ``reactions``.

        Returns:
            {"pins": ..., "wind": ..., "applied": ..., "contact": ...}, those that the scene has, and registered terms
            that do work; each a number of the last step, or [steps] of a trajectory. Pins and obstacles ("contact")
            do work where they are moved. Gravity does none: it has an energy. What was done less what ``energy``
            gained is what was dissipated, up to the method's error.

        Raises:
            InputError: as of ``reactions``.
        """
        steps = Steps(self.stepper, trajectory)
        return {name: steps.shaped(values) for name, values in work(steps).items()}

    @alone
    def set_inputs(
        self, *, gravity: Any = None, wind: Any = None, forces: Mapping[int, Any] | None = None, pins: Any = None
    ) -> None:
        """Sets inputs from the next step on, as a hook does before each; what is None stays as it is.

        Args:
            gravity: 3 numbers [m/s²], where the scene has gravity.
            wind: the air's velocity, 3 numbers [m/s], where the scene has a wind.
            forces: {node: 3 numbers} [N], nodes that the scene has a force on.
            pins: where the next step brings the pins [pins, 3] (m), where the scene has a pin_path with a row for it.

        Raises:
            InputError: what the scene does not have, or is given by a function.
        """
        checked = checked_inputs(self.model, self.stepper.steps_done, gravity=gravity, wind=wind, pins=pins)
        of_nodes = checked_forces(self.model, forces)
        first, frames = self.stepper.steps_done, self.stepper.frames
        for name, value in checked.items():
            frames.inputs_changed |= self.model.inputs.put(name, value, first=first)
        for node, force in of_nodes.items():
            frames.inputs_changed |= self.model.inputs.put("applied_force", force, first=first, node=node)
        if not self.model.inputs.hooked:
            # another height or place is no gain of energy; where a hook sets them, the watch counts their work
            self.stepper.owe(self.model.energy.forget)
            self.stepper.pay()

    @property
    def time(self) -> float:
        """Time since the beginning [s]: steps_done times the step."""
        return self.stepper.steps_done * self.model.step_size

    @alone
    def relax(self, *, residual: float | None = None, most: int = 1000) -> Relaxed:
        """Brings the cloth to rest in equilibrium, which is the state then; ``steps_done`` stays as it is.

        Pins and applied forces stay where the last step has them. Friction between yarns holds, by its springs; that
        on obstacles and of cloth on cloth acts by speed, and holds nothing at rest. It has no gradient itself: a
        Rollout of one long step from its state has (``docs/forces.md``).

        Args:
            residual: the largest force to leave on a node, or along a yarn at a crossing [N], above 0; None: 1e-3 of
                a node's mean weight, or more where rounding leaves more.
            most: implicit steps to try, at least 1.

        Returns:
            The residual, the steps that were tried and the pins' reactions [pins, 3] (N).

        Raises:
            InputError: nothing holds a cloth that forces move as a whole; an obstacle that moves; impact zones.
            SimulationError: there is none, or it was not found; the state is as before.
        """
        return Relaxation(self.stepper, residual, most).find()


def checked_inputs(model: Model, steps_done: int, **given: Any) -> dict[str, np.ndarray]:
    """Checks gravity, wind and pins that are not None; gives values by the names of arrays."""
    arrays = {"gravity": "gravity", "wind": "wind_velocity", "pins": "pin_target"}
    result = {}
    for name, value in given.items():
        if value is None:
            continue
        if name in model.scene.functions:
            raise InputError(f"{name} cannot be set: the scene gives it by a function")
        count = len(model.scene.pins)
        result[arrays[name]] = finite_array(name, value, (count, 3) if name == "pins" else (3,))
        if name == "pins":
            rows = 0 if model.scene.pin_path is None else len(model.scene.pin_path)
            if steps_done >= rows:
                raise InputError(
                    f"pins cannot be set after {steps_done} steps: scene.pin_path has {rows} rows, must have one for "
                    "every step to set"
                )
            result[arrays[name]] -= model.arrays.origin
        elif arrays[name] not in model.arrays:
            raise InputError(f"{name} cannot be set: the scene has none; make it with one, if of 0")
    return result


def checked_forces(model: Model, forces: Any) -> dict[int, np.ndarray]:
    """Checks {node: 3 numbers}."""
    if forces is None:
        return {}
    if not isinstance(forces, Mapping):
        raise InputError(f"forces = {forces!r}, must be a dictionary, {{node: 3 numbers}}")
    result = {}
    for node, force in forces.items():
        if node in model.scene.functions:
            raise InputError(f"forces[{node}] cannot be set: the scene gives it by a function")
        if node not in model.scene.force_nodes.tolist():
            raise InputError(f"forces names node {node!r}, must be one that the scene has a force on, if of 0")
        result[node] = finite_array(f"forces[{node}]", force, (3,))
    return result
