"""Obstacles that are put elsewhere between steps."""

from typing import Any

import numpy as np

from ..description.obstacles import unit_quaternion
from ..errors import InputError, finite_array
from .alone import alone
from .inspection import Inspection


class Placing(Inspection):
    """Places what stands still. The base of the simulator, with what ``Inspection`` has of it."""

    @alone
    def place_obstacles(self, position: Any, rotation: Any = None) -> None:
        """Places obstacles that stand still elsewhere, which needs no other simulator; the state stays as it is.

        Frames still name the scene, with obstacles where that has them.

        Args:
            position: p of every obstacle, in the scene's order [obstacles, 3] (m).
            rotation: quaternions (x, y, z, w) [obstacles, 4]; None: they are not turned.

        Raises:
            InputError: a scene without obstacles, or with one that has a path; or a place nearer to the present state
                than cloth may come: obstacles then stay where they were.
        """
        contact, a = self.model.contact, self.model.arrays
        if not contact.obstacles or contact.obstacles_move:
            raise InputError("place_obstacles: the scene must have obstacles, and none of them a path")
        count = len(self.model.scene.obstacles)
        places = {"obstacle_position": finite_array("position", position, (count, 3)) - a.origin}
        if rotation is not None:
            turned = finite_array("rotation", rotation, (count, 4))
            places["obstacle_rotation"] = np.array([unit_quaternion(f"rotation[{k}]", q) for k, q in enumerate(turned)])
        before = {name: a[name].numpy().copy() for name in places}

        def put(values: dict[str, np.ndarray]) -> None:
            for name, value in values.items():
                a[name].assign(value)
            # what lies on an obstacle goes on elsewhere, which is no gain of energy
            self.model.energy.forget()

        try:
            put(places)
            self.check_clear()
            self.stepper.frames.inputs_changed = True
        except BaseException:
            put(before)
            raise
