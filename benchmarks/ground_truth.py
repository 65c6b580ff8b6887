"""What the paper's experiments learn from: motions of fabrics whose yarns are known (paper, section 4 and table 1).

Nine fabrics, three pairs of yarns in three weaves, hang by two corners in a wind of 5 m/s, a frame a millisecond. Their
friction is Coulomb's, eq. 4 with both of its tanh as signs, and has no derivative where a crossing breaks away; the
model that learns has eq. 4 as it is. There are two kinds of ground truth:

    same    of the model's own step and method: but for friction, the model can reproduce it
    finer   of a step ten times finer, by a method of second order: the model cannot

Both are solved to tight tolerances, so that they are their step's motion and nothing else.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

import warp_yarn as wy
from warp_yarn.calibration.learn import PAPER as PARAMETERS
from warp_yarn.calibration.learn import value_of, with_values
from warp_yarn.presets import paper
from warp_yarn.simulation.state import FIELDS

KINDS = ("same", "finer")

COULOMB = 1e4
"""friction_sharpness of a tanh that is a sign, but within 5e-4 of where it changes (of μF_n, and of μF_n/k_f).

Against the model's friction it moves the nine fabrics by 4e-10 m in 25 frames of 17 × 17. 1e5 and 1e6 move them by no
more than 2e-12 m beside that, but are too hard for Newton's iteration: it then splits steps, and a split step moves the
cloth by 3e-7 m, so that the truth would not be of the model's step."""

FINER = 10
"""Steps a frame of the finer kind."""

FINER_METHOD = "sdirk2"

TIGHT = {"newton_tolerance": 1e-8}
"""Options for data and models to learn from: the default tolerance leaves 2e-7 m, which learning would see."""

NAMES = [p.name for p in PARAMETERS]
"""What is learned: density, stretch and bend of both yarns, and then shear and friction."""


@dataclasses.dataclass(frozen=True)
class Fabric:
    """One of the nine: a weave by its name, and the numbers of two of the paper's yarns."""

    weave: str
    yarns: tuple[int, int]

    @property
    def name(self) -> str:
        return f"{self.weave} ({self.yarns[0]}, {self.yarns[1]})"

    def model(self, size: int) -> wy.Scene:
        """The scene that learns, with size × size yarns; its values are the true ones."""
        return paper.hung_cloth(self.weave, size, size, self.yarns)

    def value(self, parameter: str) -> float:
        """The true value of a parameter, named as in ``warp_yarn.calibration.learn.Parameter``."""
        return value_of(self.model(3), parameter)

    def truth(self, size: int, frames: int, kind: str, **options: Any) -> wy.Trajectory:
        """The rest and the frames after it, 1 ms apart.

        Args:
            kind: "same" or "finer".
            options: of the model's Simulator, which the same kind shares.
        """
        scene = with_values(self.model(size), {"friction_sharpness": COULOMB})
        times = 1
        if kind == "finer":
            times, options = FINER, {**TIGHT, "integrator": FINER_METHOD}
        simulator = wy.Simulator(scene, step=paper.STEP / times, **options)
        motion = simulator.run(frames * times, progress=True)
        if simulator.split_steps:
            print(f"ground truth: steps made in parts: {', '.join(map(str, simulator.split_steps))}", flush=True)
        return every(motion, times)


PLAIN = Fabric("plain", (1, 2))
"""That of the paper's tables 2 and 3."""


def every(trajectory: wy.Trajectory, times: int) -> wy.Trajectory:
    """Each so many-th frame of it, from the first on."""
    parts = {name: getattr(trajectory, name)[::times] for name in FIELDS}
    return dataclasses.replace(trajectory, step=trajectory.step * times, **parts)


def mean_square(a: np.ndarray, b: np.ndarray) -> float:
    """Mean over frames and nodes of the squared distance of positions [..., 3]: the paper's 𝓛 of positions [m²]."""
    return float(((a - b) ** 2).sum(axis=-1).mean())


def case(fabric: Fabric, kind: str, size: int, frames: int) -> dict[str, Any]:
    """Columns of a table that say which case a row is of; printed too, as the case begins."""
    columns = {"fabric": fabric.name, "ground truth": kind, "size": f"{size} × {size}", "frames": frames}
    print(", ".join(f"{name} {value}" for name, value in columns.items()), flush=True)
    return columns
