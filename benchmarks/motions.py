"""The motions that the charts measure, by name: of the paper's cloth and of real ones.

Each starts from a state of its own and is driven by constant forces, so that it is the same motion at every step size:
what follows a path by the step, springs or forces, is constant within a step, and would itself be of first order. A
path of exact pins is none of that: within a step they go evenly from one place of it to the next.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

import warp_yarn as wy
from warp_yarn.presets import paper
from warp_yarn.presets.fabrics import FABRICS


@dataclasses.dataclass(frozen=True)
class Motion:
    """A cloth, what acts on it, how it starts, and when it is looked at.

    Args:
        title: a few words, for charts.
        acts: options of the Scene of a cloth.
        duration: the time at which positions are compared [s].
        finest: the finest step of a second-order reference [s].
        speed: of every node at the beginning, 3 numbers [m/s].
        spin: of the cloth about its centre at the beginning, 3 numbers [rad/s].
        along: whether the motion is seen by one who moves with ``speed``: pins go on with it, and displacements are
            those from where it would have brought the cloth.
        fabric: a name of ``warp_yarn.presets.fabrics``.
        pose: of the Cloth.
        rows: of the cloth; None: as many as columns.
    """

    title: str
    acts: Callable[[wy.Cloth], dict[str, Any]]
    duration: float
    finest: float
    speed: tuple[float, float, float] = (0.0, 0.0, 0.0)
    spin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    along: bool = False
    fabric: str = "paper"
    pose: str = "upright"
    rows: int | None = None

    def cloth(self, size: int) -> wy.Cloth:
        """Make the cloth, of so many columns."""
        return FABRICS[self.fabric](rows=self.rows or size, columns=size, pose=self.pose)

    def about(self, size: int) -> dict[str, str]:
        """Name the fabric and its rows × columns, as columns of a table."""
        return {"fabric": self.fabric, "size": f"{self.rows or size} × {size}"}

    def scene(self, size: int, step: float) -> wy.Scene:
        """Make the scene, for steps of one length [s]: a path of its pins is one."""
        cloth = self.cloth(size)
        options = self.acts(cloth)
        if self.along and "pins" in options:
            times = step * np.arange(1, self.steps(step) + 1)
            options["pin_path"] = cloth.position[options["pins"]] + times[:, None, None] * np.array(self.speed)
        return wy.Scene(cloth, **options)

    def simulator(self, size: int, *, step: float, **options: Any) -> wy.Simulator:
        """Make a simulator at the beginning of the motion."""
        simulator = wy.Simulator(self.scene(size, step), step=step, **options)
        start = simulator.state
        start.velocity[:] = self.speed + np.cross(self.spin, start.position - start.position.mean(axis=0))
        simulator.state = start
        return simulator

    def moved(self, position: np.ndarray, size: int) -> float:
        """Measure how far the cloth has moved at the end, root mean square over the nodes [m]."""
        carried = np.array(self.speed) * (self.duration * self.along)
        return distance(position - carried, self.cloth(size).position)

    def steps(self, step: float) -> int:
        """Count the steps that the motion takes, or raise an InputError where they are not whole."""
        count = round(self.duration / step)
        if count < 1 or abs(count * step - self.duration) > 1e-9 * self.duration:
            raise wy.InputError(f"step = {step:g}, must fit whole times into the motion's {self.duration:g} s")
        return count


def hung(cloth: wy.Cloth) -> dict[str, Any]:
    """The paper's scene: the cloth begins to swing from its two top corners in a wind of 5 m/s."""
    return {"wind": wy.Wind(velocity=paper.WIND), "pins": cloth.corners("top")}


def snap(cloth: wy.Cloth) -> dict[str, Any]:
    """The cloth has fallen 13 mm freely when springs of 100 N/m catch its top corners: until then all of it moves
    alike, so the motion begins there."""
    return {"pins": cloth.corners("top"), "pin_stiffness": 100.0}


def pull(cloth: wy.Cloth) -> dict[str, Any]:
    """The cloth is held along its top row and pulled along its diagonal by twice its weight: shear takes up dozens of
    times the energy of stretch, of the paper's."""
    top = [cloth.node(0, column) for column in range(cloth.weave.columns)]
    return {"pins": top, "gravity": (14.0, 0.0, -14.0)}


def free(cloth: wy.Cloth) -> dict[str, Any]:
    """Nothing holds the cloth, and gravity alone acts."""
    return {}


def held(cloth: wy.Cloth) -> dict[str, Any]:
    """The cloth is held by two corners, exactly."""
    return {"pins": cloth.corners("top"), "pin_stiffness": None}


def clamped(cloth: wy.Cloth) -> dict[str, Any]:
    """The first two nodes of every warp yarn are held, exactly: they can neither move nor turn."""
    nodes = [cloth.node(row, column) for row in range(cloth.weave.rows) for column in (0, 1)]
    return {"pins": nodes, "pin_stiffness": None}


THROWN: dict[str, Any] = {
    "speed": (3.0, 1.0, 2.0),
    "spin": (30.0, -10.0, 20.0),
    "along": True,
    "fabric": "handkerchief",
    "pose": "flat",
}
CARRIED: dict[str, Any] = {"speed": (5.0, 0.0, 0.0), "along": True, "fabric": "handkerchief", "pose": "flat"}

MOTIONS = {
    "hung": Motion("a hung cloth in the wind", hung, 0.025, 1e-3 / 64),
    "snap": Motion("a fall into its pins", snap, 0.010, 1e-3 / 256, (0.0, 0.0, -0.5)),
    "pull": Motion("a pull along the bias", pull, 0.020, 1e-3 / 64),
    "throw": Motion("a tumbling throw", free, 0.050, 1e-3 / 64, **THROWN),
    "drop": Motion("let go by two corners", held, 0.050, 1e-3 / 64, fabric="handkerchief", pose="flat"),
    "strip": Motion("a strip clamped at one end", clamped, 0.010, 1e-3 / 256, fabric="cotton", pose="flat", rows=5),
    "carried": Motion("let go, carried at 5 m/s", held, 0.050, 1e-3 / 64, **CARRIED),
}
"""By name. Any of them can be made of another fabric."""


def find(name: str, fabric: str | None = None) -> Motion:
    """Look a motion up, made of another fabric where one is named."""
    found = MOTIONS[name]
    return found if fabric is None else dataclasses.replace(found, fabric=fabric)


def add_options(parser: argparse.ArgumentParser, default: Sequence[str] | None = None) -> None:
    """Add --motions and --fabric."""
    names, text = (list(MOTIONS), "all") if default is None else (list(default), " ".join(default))
    parser.add_argument("--motions", nargs="+", choices=MOTIONS, default=names, help=f"({text})")
    parser.add_argument("--fabric", choices=FABRICS, help="of all these motions (each its own)")


def distance(a: np.ndarray, b: np.ndarray) -> float:
    """Root mean square over the nodes of the distance of two arrays of positions [m]."""
    return float(np.sqrt(((a - b) ** 2).sum(axis=-1).mean()))
