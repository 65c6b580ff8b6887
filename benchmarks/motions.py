"""The motions that the charts measure: a smooth one, a violent one, and one that is mostly shear.

Each starts from a state of its own and is driven by constant forces, so that it is the same motion at every step size:
what follows a path by the step, pins or forces, is constant within a step, and would itself be of first order.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

import warp_yarn as wy
from warp_yarn import paper


@dataclasses.dataclass(frozen=True)
class Motion:
    """A scene, how it starts, and when it is looked at.

    Args:
        title: a few words, for charts.
        scene: of a cloth of so many rows and columns.
        duration: the time at which positions are compared [s].
        finest: the finest step of a second-order reference [s].
        speed: of every node at the beginning, 3 numbers [m/s].
    """

    title: str
    scene: Callable[[int], wy.Scene]
    duration: float
    finest: float
    speed: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def simulator(self, size: int, **options: Any) -> wy.Simulator:
        """A simulator at the beginning of the motion."""
        simulator = wy.Simulator(self.scene(size), **options)
        start = simulator.state
        start.velocity[:] = self.speed
        simulator.state = start
        return simulator

    def steps(self, step: float) -> int:
        """How many steps the motion takes, or an InputError where they are not whole."""
        count = round(self.duration / step)
        if count < 1 or abs(count * step - self.duration) > 1e-9 * self.duration:
            raise wy.InputError(f"step = {step:g}, must fit whole times into the motion's {self.duration:g} s")
        return count


def hung(size: int) -> wy.Scene:
    """The paper's: a plain cloth of yarns 1 and 2 begins to swing from its two top corners in a wind of 5 m/s."""
    return paper.hung_cloth(rows=size, columns=size)


def snap(size: int) -> wy.Scene:
    """The cloth has fallen 13 mm freely when springs of 100 N/m catch its top corners: until then all of it moves
    alike, so the motion begins there."""
    cloth = paper.cloth(rows=size, columns=size)
    return wy.Scene(cloth, pins=cloth.corners("top"), pin_stiffness=100.0)


def pull(size: int) -> wy.Scene:
    """The cloth is held along its top row and pulled along its diagonal by twice its weight: shear takes up dozens of
    times the energy of stretch."""
    cloth = paper.cloth(rows=size, columns=size)
    top = [cloth.node(0, column) for column in range(size)]
    return wy.Scene(cloth, pins=top, gravity=(14.0, 0.0, -14.0))


MOTIONS = {
    "hung": Motion("the paper's hung cloth", hung, 0.025, 1e-3 / 64),
    "snap": Motion("a fall into its pins", snap, 0.010, 1e-3 / 256, (0.0, 0.0, -0.5)),
    "pull": Motion("a pull along the bias", pull, 0.020, 1e-3 / 64),
}


def distance(a: np.ndarray, b: np.ndarray) -> float:
    """Root mean square over the nodes of the distance of two arrays of positions [m]."""
    return float(np.sqrt(((a - b) ** 2).sum(axis=-1).mean()))
