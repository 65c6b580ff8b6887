"""The adjoint of methods whose first stage is explicit (``kernels/stepping/esdirk_adjoint.py``)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..device import declarations
from ..device.energy_watch import AT_SLOPE
from .stage_adjoint import StageAdjoint
from .stage_solve import STATE

STARTS = tuple(f"start_{name}" for name in STATE)
SOLUTIONS = (("first_solution", "first_base"), ("second_solution", "second_base"))
"""w of the first two implicit stages, and what they start from."""


class ExplicitAdjoint(StageAdjoint):
    """Goes back over steps of such a method, the last stage first.

    Args:
        method, before, after: as of ``StageAdjoint``.
    """

    def __init__(self, method: Any, before: Callable[[], None], after: Callable[[int], None]):
        a = method.model.arrays
        a.make(declarations.EXPLICIT_ADJOINT)
        super().__init__(method, before, after)
        self._kept = [name for pair in SOLUTIONS for part in pair for name in (part, f"euler_{part}")]
        a.require_grad(*STARTS, *self._kept)

    def backward_step(self) -> None:
        """Goes back over the step that ends at the present frame."""
        a = self.model.arrays
        self._run(self._restore_start)
        self._run(self._restore_frame)
        found = bool(np.isnan(a["slope"].numpy()[0, 0]))
        if found:
            self._run(self._find_slope)
            self._run(self._restore_frame)
        self._run(self._restore_stages)
        for stage in (2, 1, 0):
            self._graphs.run(f"enter {stage}", lambda stage=stage: self._enter_stage(stage))
            self._solve()
            self._graphs.run(f"leave {stage}", lambda stage=stage: self._hand_on(stage))
        if found:
            self._run(self._enter_second_slope)
            self._solve()
            self._run(self._enter_first_slope)
            self._solve()
            self._run(self._leave_slope)
        self._run(self._finish)

    def _restore_start(self) -> None:
        """Goes back by a step, and restores its slope; the running adjoints go to the base."""
        model, a = self.model, self.model.arrays
        before, _ = self.around
        before()
        model.launch("count", 1, by=-1)
        model.launch("restore_slope", "nodes")
        model.copy(**{f"base_{name}_grad": f"{name}_grad" for name in STATE})
        a.zero_grad("solution", *STARTS, *self._kept)

    def _restore_frame(self) -> None:
        """Restores the state that the step started from, and where it led."""
        self.model.launch("restore_frame", "nodes")
        self.method.keep_start()

    def _find_slope(self) -> None:
        """Finds the slope that the step found."""
        self.model.copy(solution="velocity", euler_solution="euler_velocity")
        self.model.inputs.load()
        self.model.set_pin_velocity()
        self.method.find_slope()

    def _restore_stages(self) -> None:
        """Finds w of the first two implicit stages."""
        self.model.launch("restore_stages", "nodes")
        if self.model.scene.sliding:
            self.model.launch("restore_euler_stages", "nodes")

    def _enter_second_slope(self) -> None:
        """Enters the second of the stages that the slope was found by."""
        model, a = self.model, self.model.arrays
        _, after = self.around
        after(0)
        model.launch("restore_frame", "nodes")
        self._find_slope()
        self._enter()
        a.zero_grad("base_position", "base_euler", "base_velocity", "base_euler_velocity")
        a.zero("stage_adjoint", "euler_stage_adjoint")
        model.launch("slope_adjoint", "nodes", share=-1.0, is_whole=0)

    def _enter_first_slope(self) -> None:
        """Enters the first of them, which led to it."""
        model, a = self.model, self.model.arrays
        _, after = self.around
        after(0)
        model.launch("restore_frame", "nodes")
        self.method.enter_slope_stage()
        model.copy(solution="first_solution", euler_solution="euler_first_solution")
        self._enter()
        model.launch("carry_adjoint", "nodes", time=a["stage_size"], rate=a["unit"])
        model.launch("slope_adjoint", "nodes", share=2.0, is_whole=1)

    def _leave_slope(self) -> None:
        """Leaves it to where the step started."""
        a = self.model.arrays
        _, after = self.around
        # what is added to the base elsewhere is its own here
        given = {"position": "position", "euler": "euler", "increment": "velocity", "euler_increment": "euler_velocity"}
        added = {f"{name}_grad": a.find(f"base_{of}_grad") for name, of in given.items()}
        to = {f"base_{name}_grad": a.find(f"start_{name}_grad") for name in STATE}
        self.model.launch("add_stage_adjoint", "nodes", **added, **to)
        after(AT_SLOPE)

    def _enter_stage(self, stage: int) -> None:
        """Enters a stage, and w̄ of what it led to."""
        model, a = self.model, self.model.arrays
        if stage == 2:
            model.inputs.load(stage)
            self.method.enter_base(stage, start=None)
            self._enter_last()
            return
        _, after = self.around
        after(stage + 1)
        model.inputs.load(stage)
        solution, base = SOLUTIONS[stage]
        model.copy(solution=solution, euler_solution=f"euler_{solution}")
        self.method.enter_base(stage, start=None)
        self._enter()
        model.copy(stage_adjoint=f"{solution}_grad", euler_stage_adjoint=f"euler_{solution}_grad")
        a.zero_grad("base_position", "base_euler")
        model.copy(base_velocity_grad=f"{base}_grad", base_euler_velocity_grad=f"euler_{base}_grad")

    def _hand_on(self, stage: int) -> None:
        """Hands the adjoints of what a stage started from on to those before it, and to the step's start."""
        self.model.launch("hand_on", "nodes", stage=stage)
        self.model.launch("hand_euler_on", 2 * self.model.arrays["nodes"], stage=stage)

    def _hand_back(self) -> None:
        """Makes the adjoints of the step's start those of the base."""
        self.model.copy(**{f"base_{name}_grad": f"start_{name}_grad" for name in STATE})

    def _finish(self) -> None:
        self._hand_back()
        super()._finish()
