"""A third-order method whose first stage is explicit, so that its stages are of second order: ESDIRK3(2)4L[2]SA."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from ..device import declarations
from ..device.energy_watch import AT_SLOPE, AT_START
from ..device.model import Model
from .explicit_adjoint import SOLUTIONS, ExplicitAdjoint
from .stage import StageMethod
from .stage_solve import STATE

GAMMA = 0.43586652150845899942
"""The root of γ³ − 3 γ² + 3/2 γ − 1/6 for which methods of three implicit stages are L-stable."""
MIDDLE = 0.6
"""Time of the second implicit stage, in steps."""
START, SLOPES = 3, (4, 5)
"""The places of the explicit stage among ``stage_shares``, and of the two stages that find its slope."""

OF_TOLERANCE = 0.1
"""Of the default tolerance of other methods, as its steps are so much less off: on the random scenes of
``benchmarks/defaults.py`` that costs a tenth, and errors of stiff cloth halve."""


@functools.cache
def tableau() -> tuple[float, ...]:
    """Computes a₁₀, a₂₀, a₂₁, b₀, b₁, b₂ of order 3, with stages of order 2."""
    first = 2.0 * GAMMA
    a_21 = MIDDLE * (MIDDLE - first) / (2.0 * first)
    b_1, b_2 = np.linalg.solve([[first, MIDDLE], [first**2, MIDDLE**2]], [1.0 / 2.0 - GAMMA, 1.0 / 3.0 - GAMMA])
    return GAMMA, MIDDLE - GAMMA - a_21, a_21, 1.0 - GAMMA - float(b_1 + b_2), float(b_1), float(b_2)


@functools.cache
def expectations() -> tuple[float, ...]:
    """Computes the shares of slopes before in that of the second implicit stage, on a line, and of the third, on a
    parabola: iterations start there, and take a tenth fewer than from the last slope."""
    times = np.array([0.0, 2.0 * GAMMA, MIDDLE])
    third = [np.prod((1.0 - np.delete(times, k)) / (times[k] - np.delete(times, k))) for k in range(3)]
    return MIDDLE / (2.0 * GAMMA), *map(float, third)


class ESDIRK3(StageMethod):
    """An explicit stage and three implicit ones of η = γ h, γ = 0.4359, the last of which ends the step.

        M(q_i)(w_i − v_i) = η F(q_i + η w_i, w_i),   q_i, v_i of ``kernels/stepping/esdirk.py``

    Order 3, with stages of order 2: where stiff yarns go unresolved it takes steps several times as long as those of
    "sdirk2", whose stages are of order 1, for the same error. L-stable and stiffly accurate as that.

    The slope of the explicit stage is that of the last stage of the step before, which no state tells: a run that goes
    on from a state, and not from the simulator or recording that it left, differs by what a first step is off. There
    two implicit stages find it: the forces of the state itself are no slope to go on with where its yarns are strained,
    as they would throw the next stage's base far off. Of wind, gravity and forces that jump from step to step, the part
    b₀ = 0.19 of a step acts in the next. Not with contact: what gives way at an impact has no slope to go on with.
    Kennedy and Carpenter, NASA/TM-2016-219173.
    """

    name = "esdirk3"
    order = 3
    fraction = GAMMA
    carried = 1.0 - GAMMA
    stages = 3
    fallback = "implicit-euler"
    made: Any = None  # its slopes are in no frame

    def __init__(self, model: Model):
        a = model.arrays
        a.conditions.add("slopes")
        if model.scene.sliding:
            a.conditions.add("slopes of sliding")
        for group in (declarations.SLOPES, declarations.FIRST_STAGE, declarations.EXPLICIT_STAGE):
            a.make(group)
        super().__init__(model)

    def set_times(self, step: float, remaining: float) -> None:
        """Sets h and the time in which hard pins reach their targets [s] (``Model.set_times``)."""
        model, a, stage = self.model, self.model.arrays, self.fraction * step
        model.set_times(step, remaining, stage, (2.0 * GAMMA, MIDDLE, 1.0), of_slope=GAMMA)
        *_, b_0, b_1, b_2 = tableau()
        a.put("tableau", *tableau(), *expectations())
        a.put("stage_shares", b_1, b_2, self.fraction, b_0, 2.0 * b_0, -b_0)
        a.put("newton_tolerance", model.newton_tolerance_at(step, OF_TOLERANCE))
        a.put("stage_size", stage)

    def _step(self) -> None:
        model, a = self.model, self.model.arrays
        self._begin()
        self.keep_start()
        model.launch("ask_for_slope", 1)
        wp.capture_if(a["asks_for_slope"], on_true=self.find_slope, on_false=self._add_work_of_slope)
        for stage in range(self.stages):
            if stage:
                model.inputs.load(stage)
                self.newton.ask_for_matrix()
            self.enter_base(stage, start=a["solution"])
            self.newton.solve(stage)
            model.energy.add_work(stage)
            if stage < len(SOLUTIONS):
                self._keep_solution(stage)
        self._end()

    def find_slope(self) -> None:
        """Finds the slope at the present state, where the pins' velocities are in the solution: of two implicit
        stages, one after the other, back from the first. They stay in the arrays of the first two solutions."""
        model = self.model
        self.enter_slope_stage()
        self.newton.solve(0)
        model.energy.add_work(SLOPES[0])
        self._keep_solution(0)
        model.launch("add_slope", "nodes", share=2.0, is_first=1)
        model.inputs.load()
        self.set_base()
        self.newton.solve(1)
        model.energy.add_work(SLOPES[1])
        self._keep_solution(1)
        model.launch("add_slope", "nodes", share=-1.0, is_first=0)

    def _keep_solution(self, stage: int) -> None:
        """Keeps w of one of the first two stages."""
        name = SOLUTIONS[stage][0]
        self.model.copy(**{name: "solution", f"euler_{name}": "euler_solution"})

    def _add_work_of_slope(self) -> None:
        """Adds the work of the explicit stage, at the step's start."""
        model = self.model
        if model.inputs.move:
            model.inputs.load(AT_START)
        model.energy.add_work(START)
        if model.inputs.move:
            model.inputs.load()

    def enter_slope_stage(self) -> None:
        """Starts a stage from the present state."""
        self.model.inputs.load(AT_SLOPE)
        self.set_base()

    def keep_start(self) -> None:
        """Keeps the state that the step starts from."""
        self.model.copy(**{f"start_{name}": name for name in STATE})

    def enter_base(self, stage: int, **start: Any) -> None:
        """Places what a stage starts from."""
        self.model.launch("enter_base", "nodes", stage=stage, **start)
        if self.model.scene.sliding:
            self.model.launch("enter_euler_base", "nodes", stage=stage)

    def prepare_adjoint(self, before: Callable[[], None], after: Callable[[int], None]) -> None:
        """Makes room for the adjoints within a step, and records what the tape reverses."""
        self._adjoint = ExplicitAdjoint(self, before, after)
        self.tape = self._adjoint.tape
