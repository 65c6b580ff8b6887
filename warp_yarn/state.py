"""The state of a cloth, and a sequence of states."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np

from .cloth import CLOTH_NUMBERS, Cloth, Yarn
from .errors import InputError, finite_array
from .files import whole_file
from .weave import Weave


@dataclasses.dataclass
class State:
    """Where every node is, and how it moves. NumPy, float64.

    Args:
        position: x [nodes, 3] (m).
        euler: (u, v) [nodes, 2] (m).
        velocity: ẋ [nodes, 3] (m/s).
        euler_velocity: (u̇, v̇) [nodes, 2] (m/s).
        anchor: (ū, v̄), where friction's springs are anchored [nodes, 2] (m); None: at (u, v), no spring is strained.
    """

    position: np.ndarray
    euler: np.ndarray
    velocity: np.ndarray
    euler_velocity: np.ndarray
    anchor: np.ndarray | None = None

    def checked(self, nodes: int) -> State:
        """A copy with every array finite and of the right shape, and Δs > 0 left to the simulator; or an InputError."""
        euler = finite_array("state.euler", self.euler, (nodes, 2))
        return State(
            finite_array("state.position", self.position, (nodes, 3)),
            euler,
            finite_array("state.velocity", self.velocity, (nodes, 3)),
            finite_array("state.euler_velocity", self.euler_velocity, (nodes, 2)),
            euler.copy() if self.anchor is None else finite_array("state.anchor", self.anchor, (nodes, 2)),
        )


FIELDS = tuple(field.name for field in dataclasses.fields(State))


@dataclasses.dataclass
class Trajectory:
    """Every frame of a simulation, the initial state first: arrays as in State, with a leading axis of frames."""

    cloth: Cloth
    step: float
    """Time from frame to frame [s]."""
    position: np.ndarray
    euler: np.ndarray
    velocity: np.ndarray
    euler_velocity: np.ndarray
    anchor: np.ndarray

    def __len__(self) -> int:
        return len(self.position)

    def __getitem__(self, frame: int) -> State:
        """One frame, as a State; negative frames count from the end."""
        return State(*(getattr(self, name)[frame].copy() for name in FIELDS))

    @property
    def time(self) -> np.ndarray:
        """Time of every frame [s]."""
        return np.arange(len(self)) * self.step

    def cut(self, frames: int) -> Trajectory:
        """The first frames of it."""
        return dataclasses.replace(self, **{name: getattr(self, name)[:frames] for name in FIELDS})

    def joined(self, later: Trajectory) -> Trajectory:
        """This and a run that went on from its last frame."""
        parts = {name: np.concatenate([getattr(self, name), getattr(later, name)[1:]]) for name in FIELDS}
        return dataclasses.replace(self, **parts)

    def save(self, path: str | os.PathLike) -> None:
        """Writes an .npz file with the cloth and every frame; it appears whole or not at all."""
        cloth = self.cloth
        yarns = np.array([(yarn.density, yarn.stretch, yarn.bend) for yarn in cloth.yarns])
        colors = np.array([yarn.color or (np.nan,) * 3 for yarn in cloth.yarns])
        numbers = {name: getattr(cloth, name) for name in CLOTH_NUMBERS}
        with whole_file(path) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(
                file,
                draft=cloth.weave.flipped,
                weave=cloth.weave.name,
                yarns=yarns,
                colors=colors,
                warp=cloth.warp,
                weft=cloth.weft,
                rest=cloth.position,
                step=self.step,
                **numbers,
                **{name: getattr(self, name) for name in FIELDS},
            )

    @classmethod
    def load(cls, path: str | os.PathLike) -> Trajectory:
        """Reads what ``save`` wrote; an InputError says what is wrong with the file."""
        try:
            with np.load(path) as data:
                yarns = [
                    Yarn(density=d, stretch=s, bend=b, color=None if np.isnan(color).any() else tuple(color.tolist()))
                    for (d, s, b), color in zip(data["yarns"].tolist(), data["colors"], strict=True)
                ]
                cloth = Cloth(
                    Weave(data["draft"], str(data["weave"])),
                    yarns=yarns,
                    warp=data["warp"].tolist(),
                    weft=data["weft"].tolist(),
                    pose=data["rest"],
                    **{name: float(data[name]) for name in CLOTH_NUMBERS},
                )
                result = cls(cloth, float(data["step"]), *(data[name] for name in FIELDS))
        except FileNotFoundError as error:
            raise InputError(f"{Path(path)}: there is no such file") from error
        except InputError as error:
            raise InputError(f"{Path(path)}: {error}") from error
        except Exception as error:  # zip, pickle and key errors of a foreign or truncated file
            raise InputError(f"{Path(path)}: not a recording of warp_yarn ({error})") from error
        for name in FIELDS:
            shape = (len(result), cloth.nodes, getattr(result, name).shape[-1])
            finite_array(f"{Path(path)}: {name}", getattr(result, name), shape)
        return result
