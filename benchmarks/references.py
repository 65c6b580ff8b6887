"""Converged motions: what errors of charts are measured against.

A motion is made by the second-order method at three halving steps and extrapolated: the powers p and p + 1 of the step
are taken out of the error. How far that is from the same by another method is how far the reference is to be trusted.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from motions import Motion, distance

import warp_yarn as wy
from warp_yarn.integrators import INTEGRATORS

TARGETS = (1e-2, 1e-3)
"""Errors of which the table says what reaching them takes."""

EXACT = {"tolerance": 1e-12, "newton_tolerance": 1e-9}
"""Of the runs that the reference is made of."""

REFERENCE = "sdirk2"


def end(simulator: wy.Simulator, steps: int) -> np.ndarray:
    """Runs so many steps, whose frames are kept in pieces, as the finest runs have many. Returns where they end."""
    while True:
        count = min(steps, 500)
        position = simulator.run(count).position[-1]
        steps -= count
        if steps == 0:
            return position


@dataclasses.dataclass(frozen=True)
class Reference:
    """Where a motion ends.

    Args:
        position: converged [nodes, 3] (m).
        moved: root mean square displacement from the beginning [m].
        check: the method that it was checked by.
        uncertainty: distance of the two methods' results, relative to what was moved.
    """

    position: np.ndarray
    moved: float
    check: str
    uncertainty: float

    @property
    def floor(self) -> float:
        """The smallest error that is told from the reference's own."""
        return 10.0 * self.uncertainty

    def error(self, position: np.ndarray) -> float:
        """Compares positions at the end with the converged ones, relative to what was moved."""
        return distance(position, self.position) / self.moved


def extrapolated(ends: Sequence[np.ndarray], order: int) -> np.ndarray:
    """Takes leading powers of the step out of results at halving steps, the coarsest first, in turn: the limit."""
    for power in itertools.count(order):
        if len(ends) == 1:
            return ends[0]
        factor = 2.0**power
        ends = [(factor * fine - coarse) / (factor - 1.0) for coarse, fine in itertools.pairwise(ends)]
    raise AssertionError


def converged(motion: Motion, size: int, method: str) -> np.ndarray:
    """Finds positions at the end, by one method alone; one of first order takes eight times the steps."""
    order = INTEGRATORS[method].order
    finest = motion.finest if order > 1 else motion.finest / 8.0
    ends = []
    for step in (4.0 * finest, 2.0 * finest, finest):
        simulator = motion.simulator(size, step=step, integrator=method, **EXACT)
        ends.append(end(simulator, motion.steps(step)))
    return extrapolated(ends, order)


def checks() -> list[str]:
    """Lists methods that may check the reference, the one of the highest order first."""
    others = [name for name in INTEGRATORS if name != REFERENCE]
    return sorted(others, key=lambda name: -INTEGRATORS[name].order)


def reference(motion: Motion, size: int) -> Reference:
    """Makes the converged motion by the reference method, and checks it by another: the first that is near enough for
    the targets, or else the nearest."""
    position = converged(motion, size, REFERENCE)
    moved = motion.moved(position, size)
    best = None
    for method in checks():
        try:
            found = Reference(position, moved, method, distance(position, converged(motion, size, method)) / moved)
        except wy.SimulationError as error:
            print(f"{method} cannot check the reference: {error}")
            continue
        if best is None or found.uncertainty < best.uncertainty:
            best = found
        if best.floor <= 0.5 * min(TARGETS):
            break
    if best is None:
        raise RuntimeError("no method but one makes this motion: there is no reference")
    return best
