"""Stages of a step that was made, found again from its two ends: what forces that a step had are computed from."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..device.model import Model


class Point(NamedTuple):
    """A state's coordinates and their rates, x and (u, v) side by side: position [nodes, 5] (m), velocity [nodes, 5]
    (m/s)."""

    position: np.ndarray
    velocity: np.ndarray


class Made(NamedTuple):
    """A stage.

    Args:
        share: of its force in the impulse of the step, over h.
        size: η [s].
        position, velocity: where it was assembled [nodes, 5].
        solution: w [nodes, 5] (m/s).
        increment: velocities whose momentum the right-hand side has; None: those of the state.
        ahead: by which the linear system takes positions on, in s of w: 0 where it was assembled there already.
        first: w of the first stage, where its right-hand side has it; else None.
    """

    share: float
    size: float
    position: np.ndarray
    velocity: np.ndarray
    solution: np.ndarray
    increment: np.ndarray | None
    ahead: float
    first: np.ndarray | None = None

    @classmethod
    def implicit(cls, share: float, size: float, base: Point, solution: np.ndarray) -> Made:
        """Makes an implicit stage from its base: it was assembled where it led."""
        return cls(share, size, base.position + size * solution, solution, solution, base.velocity - solution, 0.0)


def held(model: Model) -> np.ndarray:
    """Finds which coordinates do not move by forces [nodes, 5]: x of exact pins."""
    result = np.zeros((model.scene.cloth.nodes, 5), dtype=bool)
    if model.has_hard_pins:
        result[model.scene.pins, :3] = True
    return result


def subtract_product(model: Model) -> None:
    """Takes A w, of the solution, off the right-hand side."""
    a = model.arrays
    a.zero("q_x", "q_s")
    model.launch("apply_matrix", 1, p_x=a["solution"], p_s=a["euler_solution"])
    for name, product in (("rhs", "q_x"), ("euler_rhs", "q_s")):
        if a[name] is not None:
            a[name].assign(a[name].numpy() - a[product].numpy())
