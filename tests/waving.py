"""A trajectory to draw that no simulation made: a cloth that bends, turns and moves."""

from collections.abc import Sequence

import numpy as np

import warp_yarn as wy

RED, BLUE = (0.80, 0.20, 0.15), (0.15, 0.25, 0.75)


def waving(
    weave: str | wy.Weave = "plain",
    *,
    frames: int = 3,
    colors: Sequence[tuple[float, float, float] | None] = (RED, BLUE),
    **options: object,
) -> wy.Trajectory:
    """A cloth of 6 × 5 with radius 0.3 L, waves 0.6 L high passing over it while it turns about an oblique axis."""
    weave = wy.WEAVES[weave](rows=6, columns=5) if isinstance(weave, str) else weave
    yarns = [wy.Yarn(density=2e-3, stretch=5e5, bend=1.4e-4, color=color) for color in colors]
    cloth = wy.Cloth(weave, yarns=yarns, pose="flat", **{"radius": 3e-4, **options})
    x, y, _ = cloth.position.T / cloth.spacing
    position = []
    for frame in range(frames):
        height = 0.6 * np.sin(0.9 * x + 0.5 * y + 0.4 * frame)
        axis = 0.3 * frame * np.array([0.48, 0.6, 0.64])
        position.append(cloth.spacing * np.stack([x, y, height], axis=1) @ rotation(axis).T + [0.02, -0.01, 0.05])
    zero = np.zeros((frames, cloth.nodes, 3))
    euler = np.broadcast_to(cloth.euler, (frames, cloth.nodes, 2))
    return wy.Trajectory(cloth, 1e-3, np.array(position), euler, zero, zero[..., :2], euler)


def rotation(axis: np.ndarray) -> np.ndarray:
    """By |axis| radians about an axis."""
    angle = np.linalg.norm(axis)
    x, y, z = axis / max(angle, 1e-300)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
