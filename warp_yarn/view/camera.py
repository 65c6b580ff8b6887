"""Where a picture is taken from."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np

from ..errors import InputError, finite_array, real

VIEW = (0.8, 1.0, 0.4)
ALLOWED = "3 numbers, the way from the cloth to the camera, such as (0, 0, 1) from the top, (1, 0, 0) from a side"
"""What a view may be."""
MARGIN = 1.08
"""Size of the picture over that of what is in it."""


@dataclasses.dataclass(frozen=True)
class Camera:
    """A place to look from, for pictures that shall go together.

    Args:
        position: where it is (m).
        target: where it looks at (m), elsewhere.
        up: what is up in the picture; where it looks along that, y is.
        lens: vertical angle of view [degrees], above 0 and below 120: narrow, so that near and far yarns look equally
            thick.
    """

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    lens: float = 24.0

    def __post_init__(self) -> None:
        for name in ("position", "target", "up"):
            object.__setattr__(self, name, tuple(finite_array(name, getattr(self, name), (3,)).tolist()))
        if self.position == self.target:
            raise InputError(f"target = {self.target}, must be elsewhere than the camera's position")
        if not any(self.up):
            raise InputError(f"up = {self.up}, must not be 0")
        object.__setattr__(self, "lens", real("lens", self.lens, above=0.0))
        if self.lens >= 120.0:
            raise InputError(f"lens = {self.lens:g}, must be below 120 degrees")

    @property
    def axes(self) -> np.ndarray:
        """Unit vectors to the right, up and toward the camera [3, 3]."""
        toward = np.subtract(self.position, self.target)
        return _axes(toward, self.up)

    @property
    def distance(self) -> float:
        """From what it looks at [m]."""
        return float(np.linalg.norm(np.subtract(self.position, self.target)))

    def seen(self, points: np.ndarray) -> np.ndarray:
        """Gives points [..., 3] (m) from what it looks at, to the right, up and toward it."""
        return (points - self.target) @ self.axes.T

    def world(self, seen: Sequence[float] | np.ndarray) -> np.ndarray:
        """Gives points that are so far to the right, up and toward it, in the cloth's coordinates."""
        return np.asarray(seen) @ self.axes + self.target

    @classmethod
    def framing(
        cls, frames: Iterable[np.ndarray], radius: float, aspect: float, view: Sequence[float], lens: float = 24.0
    ) -> Camera:
        """Looks along −view from as near as has all points of all frames [points, 3] (m) in the picture, with their
        yarns of a radius around them.

        Raises:
            InputError: a view that is none.
        """
        toward = checked_view("view", view)
        up = np.array([0.0, 0.0, 1.0])
        axes = _axes(toward, up)
        slope = np.tan(np.radians(0.5 * lens)) * np.array([aspect, 1.0])
        # what a point needs of distance, were it seen from over the origin, is linear on either side of it
        lines = np.array(
            [[s * MARGIN / slope[0], 0.0, 1.0] for s in (-1, 1)] + [[0.0, s * MARGIN / slope[1], 1.0] for s in (-1, 1)]
        )
        low, top, most = np.full(3, np.inf), np.full(3, -np.inf), np.full(4, -np.inf)
        for points in frames:
            seen = points @ axes.T
            low, top = np.minimum(low, seen.min(axis=0)), np.maximum(top, seen.max(axis=0))
            most = np.maximum(most, (seen @ lines.T).max(axis=0))
        centre = 0.5 * (low + top)
        needs = most - lines @ centre + MARGIN * radius / slope[[0, 0, 1, 1]]
        # no nearer than the yarns, were they one point
        distance = max(float(needs.max()), float(0.5 * (top - low)[2] + 4.0 * radius))
        target = centre @ axes
        return cls(tuple(target + distance * axes[2]), tuple(target), tuple(up), lens)


def checked_view(name: str, view: Sequence[float]) -> np.ndarray:
    """Gives a direction to look from [3], or an InputError."""
    try:
        toward = finite_array(name, view, (3,))
    except InputError as error:
        raise InputError(f"{error}: {ALLOWED}") from error
    if not toward.any():
        raise InputError(f"{name} = {tuple(view)}, must not be 0: {ALLOWED}")
    return toward


def _axes(toward: np.ndarray, up: Sequence[float] | np.ndarray) -> np.ndarray:
    toward = toward / np.linalg.norm(toward)
    right = np.cross(up, toward)
    if np.linalg.norm(right) <= 1e-6 * np.linalg.norm(up):
        # straight from above or below
        right = np.cross([0.0, 1.0, 0.0] if abs(toward[1]) < 0.9 else [1.0, 0.0, 0.0], toward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(toward, right), toward])
