"""The paper's published data: HDF5 files with a scene and every frame of its simulation by the authors' own code.

    Properties/Size                   one record: width, length (columns and rows of nodes)
    Properties/Physical properties    one record, PROPERTIES below
    Steps/Position/Node i j/          LPOS x, EPOS (u, v), EPOSBar the anchors (ū, v̄); [frames, 3 or 2]
    Steps/Velocity/Node i j/          LVEL ẋ, EVEL (u̇, v̇)

i counts along the width, j along the length. Yarns alternate. The pins act from the second step on, so that frame 0 is
the pose, and frame 1 the first that a simulation can start from.
"""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..description.cloth import Cloth, Yarn
from ..description.scene import Scene, Wind
from ..description.weave import WEAVES
from ..errors import InputError, finite_array, missing_extra
from ..presets import paper
from ..simulation.state import FIELDS, Trajectory

if TYPE_CHECKING:
    import h5py

WEAVE_CODES = ("plain", "twill", "satin")
"""What the numbers 0, 1, 2 stand for as woven_pattern."""

PROPERTIES = (
    "Gravity", "Yarn1_rho", "Yarn2_rho", "R", "L", "Yarn1_Y", "Yarn2_Y", "Yarn1_B", "Yarn2_B", "kc", "kf", "df", "mu",
    "S", "handle_stiff", "wind_velocity_x", "wind_velocity_y", "wind_velocity_z", "wind_density", "wind_drag",
    "woven_pattern",
)  # fmt: skip

DATASETS = {
    "position": ("Position", "LPOS", 3),
    "euler": ("Position", "EPOS", 2),
    "velocity": ("Velocity", "LVEL", 3),
    "euler_velocity": ("Velocity", "EVEL", 2),
    "anchor": ("Position", "EPOSBar", 2),
}
"""Where each array of the state is: its group, its name, its numbers a node."""


@dataclasses.dataclass(frozen=True)
class Published:
    """What a published file holds.

    Args:
        scene: its cloth and what acts on it, with friction in the published scaling.
        trajectory: its frames, 1 ms apart.
    """

    scene: Scene
    trajectory: Trajectory

    def distance(self, position: np.ndarray, frame: int) -> tuple[float, float]:
        """Measures how far positions [nodes, 3] (m) are from those of a frame.

        Returns:
            The root mean square over the nodes of the distance [m], and that of the published displacement since
            frame 1 [m], to compare it with.
        """
        published = self.trajectory.position
        return _rms(position - published[frame]), _rms(published[frame] - published[1])


def _rms(offset: np.ndarray) -> float:
    return float(np.sqrt((offset**2).sum(axis=1).mean()))


def read_published(path: str | os.PathLike) -> Published:
    """Reads a file of the paper's published data. Needs the extra ``data``.

    Raises:
        InputError: h5py is not installed, or the file is missing, open in another program, not HDF5, damaged, or not of
            this structure.
    """
    try:
        import h5py
    except ImportError as error:
        raise missing_extra("h5py", "published data need", "data") from error
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: there is no such file")
    try:
        with h5py.File(path) as file:
            return _read(file)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except BlockingIOError as error:
        raise InputError(f"{path}: another program has it open to write to it; close it there ({error})") from error
    except (MemoryError, RecursionError) as error:  # of sizes that a damaged file says
        raise InputError(f"{path}: damaged, or too large for this machine ({error})") from error
    except Exception as error:  # what h5py and NumPy say of foreign, truncated and damaged files is of every kind
        raise InputError(f"{path}: not a whole HDF5 file ({error})") from error


def _read(file: h5py.File) -> Published:
    width, length = (int(n) for n in _record(file, "Properties/Size", ("width", "length")))
    p = dict(zip(PROPERTIES, _record(file, "Properties/Physical properties", PROPERTIES), strict=True))
    code = int(p["woven_pattern"])
    if code not in range(len(WEAVE_CODES)):
        codes = ", ".join(f"{k} {name}" for k, name in enumerate(WEAVE_CODES))
        raise InputError(f"woven_pattern = {code}, must be one of {codes}")
    _check_nodes(file, width, length)
    weave = WEAVES[WEAVE_CODES[code]](rows=length, columns=width)
    yarns = [
        Yarn(
            density=p[f"Yarn{k}_rho"],
            stretch=p[f"Yarn{k}_Y"],
            bend=p[f"Yarn{k}_B"],
            color=paper.YARNS[k].color,
        )
        for k in (1, 2)
    ]
    frames: dict[str, Any] = _frames(file, width, length)
    cloth = Cloth(
        weave,
        yarns=yarns,
        spacing=p["L"],
        radius=p["R"],
        shear=p["S"],
        friction=p["mu"],
        friction_stiffness=p["kf"],
        friction_damping=p["df"],
        parallel_stiffness=p["kc"],
        pose=frames["position"][0],
    )
    scene = paper.hung(
        cloth,
        gravity=(0.0, 0.0, -p["Gravity"]),
        wind=Wind(
            velocity=(p["wind_velocity_x"], p["wind_velocity_y"], p["wind_velocity_z"]),
            density=p["wind_density"],
            drag=p["wind_drag"],
        ),
        pin_stiffness=p["handle_stiff"],
        published_scaling=True,
    )
    return Published(scene, Trajectory(cloth, paper.STEP, **frames))


def _dataset(file: h5py.File, name: str) -> np.ndarray:
    found = file.get(name)
    if not hasattr(found, "dtype"):
        raise InputError(f"has no dataset {name!r}")
    return found[()]


def _record(file: h5py.File, name: str, fields: tuple[str, ...]) -> list[float]:
    """Reads the numbers of a dataset of one record."""
    data = np.asarray(_dataset(file, name))
    missing = [field for field in fields if field not in (data.dtype.names or ())]
    if missing:
        raise InputError(f"{name!r} has no field {missing[0]!r}")
    if data.shape != (1,):
        raise InputError(f"{name!r} has shape {data.shape}, must be (1,)")
    return finite_array(repr(name), [data[0][field] for field in fields], (len(fields),)).tolist()


def _node(i: int, j: int) -> str:
    return f"Node {i} {j}"


def _check_nodes(file: h5py.File, width: int, length: int) -> None:
    """Checks the nodes, before anything as large as a wrong size says is allocated."""
    for group in ("Steps/Position", "Steps/Velocity"):
        present = file.get(group, ())
        for j in range(length):
            for i in range(width):
                if _node(i, j) not in present:
                    raise InputError(f"has no {group}/{_node(i, j)}, must have every node of {width} × {length}")


def _frames(file: h5py.File, width: int, length: int) -> dict[str, np.ndarray]:
    """Reads every array of the state [frames, nodes, 3 or 2], the nodes in our order."""
    names = [_node(i, j) for j in range(length) for i in range(width)]
    frames = len(np.atleast_1d(_dataset(file, f"Steps/Position/{names[0]}/LPOS")))
    if frames < 2:
        raise InputError(f"has {frames} frames, must have at least 2: a simulation starts from frame 1")
    result = {}
    for field in FIELDS:
        group, kind, numbers = DATASETS[field]
        paths = [f"Steps/{group}/{name}/{kind}" for name in names]
        parts = [finite_array(path, _dataset(file, path), (frames, numbers)) for path in paths]
        result[field] = np.stack(parts, axis=1)
    return result
