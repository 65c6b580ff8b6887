"""What a simulator does where its options leave it open: tolerances, and the preconditioner.

NumPy only.
"""

from __future__ import annotations

import math

import numpy as np
import warp as wp

from ..description.scene import Scene

PRECONDITIONERS = ("multilevel", "incomplete", "jacobi")
PRECISIONS = {"double": wp.float64, "single": wp.float32}
TOLERANCES = {"double": 1e-6, "single": 1e-4}
"""Of linear solves: far under the error of eq. 2's step, 1e-2 of the motion."""
NEWTON_TOLERANCE = 2e-2
SLOW_MOTION = 1.2e3
"""k_s h²/(m L) from which on the motion that a step resolves is slow beside the yarns' stretching, and its error
smaller: so is the tolerance, in proportion, down to ``TIGHT`` of it. (As the root of it, it left more than the step's
own error on stiff cloth that has just buckled.)"""
TIGHT = {"double": 1e-3, "single": 1e-1}
STIFF = 2e4
"""k_s h²/(m L) from which on lines on many levels take less time than the incomplete factorization: where a stretch
wave runs over a hundred crossings in a step."""
STIFF_SLIDING = 3.0
"""The same where friction's damping does not hold the rates of sliding: the incomplete factorization takes their
diagonal for its pivots, and its sweeps grow from yarn to yarn. On 61 × 61 yarns it "converged" 100 % off from 20 on."""
HOLDING = 10.0
"""Times h k_s/L that friction's damping must have to hold the rates."""
BENT = 12.0
"""Times k_b/L³ that a yarn resists where crossings go up and down in turn: 6 of each of the two yarns."""
INEXTENSIBLE = 8e-6
"""What crossings have against going up and down in turn, mass and bending, over k_s/L: below, kinked yarns move in ways
that single lines do not know, and strips of two take less time."""
RESOLVED = 4.0
"""Of steps that do not resolve the yarns' vibrations: a stretch wave runs from a crossing to the next in less than the
``RESOLVED``-th part of a step. A tenth at most is then added to the error of the second-order methods. The error of
shorter steps falls with their square, and so does the tolerance in double precision."""
EXACT = 1e-8
"""Both tolerances of differentiable runs in double precision: gradients are right to no more digits than these."""


def preconditioner(scene: Scene, step: float) -> str:
    """Choose the preconditioner: where the incomplete factorization takes longer than lines, or does not work, lines.

    Args:
        scene: the scene.
        step: h [s].
    """
    cloth = scene.cloth
    if "seams" in scene.terms:
        # the incomplete factorization drops too much of what reaches across the cloth
        return "multilevel"
    if cloth.general:
        yarn = cloth.topology.segment_yarn
        stiffness = cloth.stretch_stiffness[cloth.material[yarn]] * (1.0 + cloth.yarn_crimp[yarn])
        stretch = step * float((stiffness / cloth.segment_spacing).max())
    else:
        stretch = step * cloth.stretch_stiffness.max() / cloth.spacing
    holds = "friction" in scene.terms and cloth.least_friction_damping > HOLDING * stretch
    stiffness = (stretch_rate(scene).max() * step) ** 2
    return "multilevel" if stiffness > (STIFF if holds or not scene.sliding else STIFF_SLIDING) else "incomplete"


def needs_strips(scene: Scene, step: float) -> bool:
    """Tell whether yarns stretch so much less than they bend and accelerate that lines take strips beside them.

    Args:
        scene: the scene.
        step: h [s].
    """
    material, spacing = _segments(scene)
    bend, stretch = np.array([(yarn.bend, yarn.stretch) for yarn in scene.cloth.yarns]).T
    # yarns that do not resist stretching have no bound of it
    with np.errstate(divide="ignore", invalid="ignore"):
        softness = (BENT * bend / stretch)[material] / spacing**2 + 1.0 / (stretch_rate(scene) * step) ** 2
    return bool(softness.min() < INEXTENSIBLE)


def tolerance(precision: str, *, exact: bool) -> float:
    """Choose the tolerance of linear solves."""
    return EXACT if exact else TOLERANCES[precision]


def max_iterations(scene: Scene) -> int:
    """Choose the most iterations of linear solves: as many as there are degrees of freedom, and 1000 at least."""
    return max(1000, scene.cloth.nodes * (5 if scene.sliding else 3))


def newton_tolerance(scene: Scene, precision: str, step: float) -> float:
    """Choose the tolerance of implicit stages: what follows the error of steps of this size [s]."""
    rate = stretch_rate(scene)
    fastest = float(rate.max())
    slow = min(1.0, SLOW_MOTION / (fastest * step) ** 2) if fastest > 0.0 else 1.0
    # steps of fewer seconds resolve the yarns' stretching
    resolving = math.inf if precision == "single" or not rate.any() else rate[rate > 0.0].min() / RESOLVED
    resolved = min(1.0, step * resolving) ** 2
    return max(EXACT, NEWTON_TOLERANCE * max(TIGHT[precision], slow) * resolved)


def stretch_rate(scene: Scene) -> np.ndarray:
    """Compute √(k_s/(m L)) of every material, in a general cloth of every segment, m the mass of a segment [1/s]."""
    material, spacing = _segments(scene)
    return np.sqrt(scene.cloth.stretch_stiffness / [yarn.density for yarn in scene.cloth.yarns])[material] / spacing


def _segments(scene: Scene) -> tuple[np.ndarray | slice, np.ndarray | float]:
    """Find the material and the distance [m] of every segment of a general cloth, else all materials and the one."""
    cloth = scene.cloth
    if cloth.general:
        return cloth.material[cloth.topology.segment_yarn], cloth.segment_spacing
    return slice(None), cloth.spacing
