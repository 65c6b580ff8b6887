"""Forces that a test reads: reactions of pins, the work that is done, and the equilibrium."""

from __future__ import annotations

import numpy as np

from .alone import alone
from .inspection import Inspection
from .relaxation import Relaxation, Relaxed
from .reactions import Steps, reactions, work
from .state import Trajectory


class Loads(Inspection):
    """Reads what holds the cloth and moves it. A base of the simulator."""

    @alone
    def reactions(self, trajectory: Trajectory | None = None) -> np.ndarray:
        """Computes the forces that pins exert on the cloth, exact pins too: of a step its impulse over h.

        They close each step's balance of momentum to the solver's tolerance, by the equations of its method's stages.
        They are computed when asked for, from the frames at both ends of a step.

        Args:
            trajectory: frames of this simulator, with its present parameters; None: the last step.

        Returns:
            [pins, 3] (N), in the order of ``scene.pins``; of a trajectory [steps, pins, 3]. A step in parts is made
            again; NaN, with a WarpYarnWarning, where it ends elsewhere. A WarpYarnWarning too where spring pins that
            are moved give way by over 1 % of their way.

        Raises:
            InputError: no step was made since the state was set; frames of another cloth or step; impact zones, which
                have no forces; a registered integrator that is no StageMethod.
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
