"""A cloth lies on a table and is thrown, by forces on its corners, into a box beside the table and lower.

This is the experiment that the paper describes in its section 4.2.2 (the code that it published has neither table nor
box). Its sizes are not published, so these are ours: a cloth of 4 × 4 mm of the paper's yarns 1 and 2, its middle above
the origin, on a table whose top is at z = 0; a box of 40 × 40 mm, walls 20 mm high, whose bottom is 30 mm below.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..description.cloth import Cloth
from ..description.obstacles import Box, Obstacle, Plane
from ..description.scene import Scene
from ..errors import InputError, choice, finite_array, real
from ..presets import paper

STEP = 1e-3
"""h [s]."""
INTEGRATOR = "implicit-euler"
"""Of both the throw and its gradient: what follows a landing is smooth with it, and with SDIRK2 it is not."""
PUSHED = 5
"""Steps, the first ones, in which forces act."""
STEPS = 300
"""Of an episode: until the cloth lies still."""
FORCE = 4e-3
"""Largest force on a corner along each axis [N]: all four give the cloth up to 0.9 m/s."""

SIDE = 5
"""Yarns of the cloth each way."""
TABLE = (20e-3, 30e-3)
"""Half of the table's length and width [m]."""
INNER = 40e-3
"""Inner length and width of the box [m]."""
WALL = 20e-3
"""Height of its walls [m]."""
THICKNESS = 2e-3
"""Of the walls [m]."""
BOTTOM = -30e-3
"""Height of its bottom, and of the floor that it stands on [m]."""
PLACE = (60e-3, 0.0)
"""Where the box's middle is, in x and y [m]."""
FRICTION = 0.3
"""μ of everything."""

LIES = 1.986
"""Height of a node at rest above what it lies on, over R."""
REST_STEPS = 20
"""So long, at an episode's end, a thrown cloth must be inside and at rest."""
REST_SPEED = 10e-3
"""What is slower than this is at rest [m/s]."""
TOUCHES = {"all": 6, "table": 2, "nothing": 0}
"""How many of the obstacles a scene has."""
ARRIVES = BOTTOM + 0.25 * WALL
"""Height at which a throw arrives: below, parts of the cloth may touch the bottom [m]."""

Z = np.array([0.0, 0.0, 1.0])


def cloth(shift: Any = (0.0, 0.0), turn: float = 0.0) -> Cloth:
    """Makes the cloth as it lies on the table.

    Args:
        shift: of its middle from the origin, in x and y [m].
        turn: about z [rad].
    """
    flat = paper.cloth(rows=SIDE, columns=SIDE, pose="flat")
    return flat.replace(pose=pose(flat, shift, turn))


def pose(flat: Cloth, shift: Any, turn: float) -> np.ndarray:
    """Places the nodes of a flat cloth on the table [nodes, 3]."""
    x, y = (flat.position - flat.position.mean(axis=0))[:, :2].T
    shift, turn = finite_array("shift", shift, (2,)), real("turn", turn)
    c, s = np.cos(turn), np.sin(turn)
    return np.stack([c * x - s * y + shift[0], s * x + c * y + shift[1], np.full_like(x, LIES * flat.radius)], axis=1)


def walls(place: Any = PLACE) -> np.ndarray:
    """Finds the middles of the box's walls [4, 3] (m).

    Raises:
        InputError: a place where the box would be in the table.
    """
    x, y = finite_array("place", place, (2,))
    half = 0.5 * INNER + THICKNESS
    if abs(x) < TABLE[0] + half and abs(y) < TABLE[1] + half:
        allowed = f"|x| at least {TABLE[0] + half:g}, or |y| at least {TABLE[1] + half:g}, beside the table"
        raise InputError(f"place = ({x:g}, {y:g}), must have {allowed}")
    out = 0.5 * (INNER + THICKNESS)
    z = BOTTOM + 0.5 * WALL
    return np.array([[x - out, y, z], [x + out, y, z], [x, y - out, z], [x, y + out, z]])


def obstacle_position(place: Any = PLACE) -> np.ndarray:
    """Finds where the obstacles of ``scene`` are, an input of its rollouts [6, 3] (m)."""
    return np.concatenate([[[0.0, 0.0, 0.5 * BOTTOM], [0.0, 0.0, BOTTOM]], walls(place)])


def obstacles(place: Any = PLACE, friction: float = FRICTION) -> list[Obstacle]:
    """Makes the table, the floor, which is the box's bottom too, and the box's walls."""
    table = Box(center=(0, 0, 0.5 * BOTTOM), half_extents=(*TABLE, -0.5 * BOTTOM), friction=friction)
    floor = Plane(point=BOTTOM * Z, normal=Z, friction=friction)
    long, short, high = 0.5 * INNER + THICKNESS, 0.5 * THICKNESS, 0.5 * WALL
    sizes = [(short, long, high)] * 2 + [(long, short, high)] * 2
    pairs = zip(walls(place), sizes, strict=True)
    return [table, floor, *(Box(center=middle, half_extents=half, friction=friction) for middle, half in pairs)]


def scene(
    cloth: Cloth, forces: Any = None, *, place: Any = PLACE, friction: float = FRICTION, touches: str = "all"
) -> Scene:
    """Makes the scene.

    Args:
        cloth: as it lies on the table.
        forces: on its corners, in the order of ``cloth.corners()``, [steps, 4, 3] (N); None: ``PUSHED`` steps of 0.
        place: the box's middle, in x and y [m].
        friction: of table, floor and walls, at least 0.
        touches: "all"; "table", the table and the floor alone; "nothing", with which every throw falls and so has a
            gradient that points into the box.
    """
    forces = np.zeros((PUSHED, 4, 3)) if forces is None else finite_array("forces", forces, (None, 4, 3))
    count = TOUCHES[choice("touches", touches, TOUCHES)]
    return Scene(
        cloth,
        forces={node: forces[:, k] for k, node in enumerate(cloth.corners())},
        obstacles=obstacles(place, friction)[:count],
    )


def target(place: Any = PLACE) -> np.ndarray:
    """Finds the middle of the box's bottom [3] (m)."""
    return np.array([*finite_array("place", place, (2,)), BOTTOM])


def inside(position: np.ndarray, place: Any = PLACE) -> np.ndarray:
    """Tells in which frames every node is between the walls and below their top, [..., nodes, 3] to [...]."""
    off = np.abs(position[..., :2] - np.asarray(place)).max(axis=-1) < 0.5 * INNER
    return (off & (position[..., 2] < BOTTOM + WALL)).all(axis=-1)


def at_rest(velocity: np.ndarray) -> np.ndarray:
    """Tells in which frames every node is slower than ``REST_SPEED``, [..., nodes, 3] to [...]."""
    return (np.linalg.norm(velocity, axis=-1) < REST_SPEED).all(axis=-1)


def success(position: np.ndarray, velocity: np.ndarray, place: Any = PLACE) -> bool:
    """Tells whether a throw ends inside the box: every node, and at rest, in the last ``REST_STEPS`` frames.

    Args:
        position, velocity: frames [frames, nodes, 3].
    """
    last = slice(-REST_STEPS, None)
    return bool((inside(position[last], place) & at_rest(velocity[last])).all())


def arrival(centre: Any) -> Any:
    """Finds where a path first falls through the height ``ARRIVES``, between two frames [3] (m).

    It is a differentiable function of the path, when the throw arrives included; a path that stays above gives its
    end.

    Args:
        centre: of the cloth's nodes, an array or a tensor [frames, 3] (m).
    """
    heights = getattr(centre, "detach", lambda: centre)()[:, 2].tolist()
    below = [k for k in range(1, len(heights)) if heights[k] < ARRIVES <= heights[k - 1]]
    if not below:
        return centre[-1]
    one, other = centre[below[0] - 1], centre[below[0]]
    return one + (other - one) * ((ARRIVES - one[2]) / (other[2] - one[2]))
