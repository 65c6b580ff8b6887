"""The adjoint of methods that are made of implicit stages (``kernels/stepping/stage_adjoint.py``)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import warp as wp

from ..device import declarations
from ..device.graphs import GraphCache
from ..device.model import BETWEEN
from .stage_solve import MOVED, ROUNDING, STATE, StageSolve

if TYPE_CHECKING:
    from .stage import StageMethod


class StageAdjoint:
    """Goes back over steps of a method: (−∂r/∂w)ᵀ λ = w̄ is solved to the linear tolerance, with the exact derivative.

    Args:
        method: the method.
        before, after: launch what a run has to do with adjoints before every step, and after every stage of it.

    Attributes:
        tape: what a stage's assembly reverses.
    """

    def __init__(self, method: StageMethod, before: Callable[[], None], after: Callable[[int], None]):
        self.method, self.model, self.around = method, method.model, (before, after)
        self._graphs = GraphCache(method.model.device)
        tolerance = max(method.model.tolerance, 10.0 * ROUNDING[method.model.precision])
        model, a = method.model, method.model.arrays
        for group in (
            declarations.ADJOINT,
            declarations.CARRIED_ADJOINT,
            declarations.FIRST_STAGE,
            declarations.STAGE_ADJOINT,
        ):
            a.make(group)
        a.put("adjoint_tolerance", tolerance)
        base = ("base_position", "base_euler", "base_velocity", "base_euler_velocity")
        a.require_grad(*BETWEEN, *MOVED, *base, "rhs", "euler_rhs", "solution", "euler_next", "anchor_next")
        if "slopes" in a.conditions:
            a.require_grad("slope", "euler_slope")
        if model.scene.sliding:
            a["euler_next"].grad = a["base_euler"].grad
        self.tape, self.anchor_tape, self.pin_tape = wp.Tape(), wp.Tape(), wp.Tape()
        with self.tape:
            method.newton.assemble(matrix=False)
        with self.anchor_tape:
            model.update_anchor("euler_next", "anchor_next")
        with self.pin_tape:
            model.set_pin_velocity(position=a["base_position"])
        self._stage = StageSolve(model, method.newton.compression, self.tape, tolerance)

    def _run(self, part: Callable[[], None]) -> None:
        """Launches a part of the step."""
        self._graphs.run(part.__name__, part)

    def backward_step(self) -> None:
        """Goes back over the step that ends at the present frame."""
        self._run(self._restore)
        self._run(self._enter_last)
        self._solve()
        if self.method.stages == 2:
            self._run(self._enter_first)
            self._solve()
        self._run(self._finish)

    def _restore(self) -> None:
        """Restores the step that ends at the present frame; the running adjoints go to the base."""
        model, a = self.model, self.model.arrays
        before, _ = self.around
        before()
        model.launch("count", 1, by=-1)
        model.launch("restore_frame", "nodes")
        model.inputs.load(self.method.stages - 1)
        self.method.set_base()
        if self.method.is_carried:
            model.launch("restore_carried_stage", "nodes")
        if self.method.stages == 2:
            model.launch("restore_first_stage", "nodes")
            first = {"solution": a["first_solution"], "euler_solution": a["euler_first_solution"]}
            model.launch("next_base", "nodes", start=None, **first)
        model.copy(**{f"base_{name}_grad": f"{name}_grad" for name in STATE})
        a.zero_grad("solution")

    def _enter_last(self) -> None:
        """Enters the stage that ended the step, and w̄ of the step's end."""
        model, a = self.model, self.model.arrays
        self._enter()
        if a["anchor"] is not None:
            model.copy(anchor_next_grad="anchor_grad")
            a.zero_grad("anchor", "rhs", "euler_rhs")
            self.anchor_tape.backward()
            self.tape.backward()
        if self.method.is_carried:
            model.launch("carry_adjoint", "nodes", time=a["carried_time"], rate=a["carried_rate"])
        else:
            model.launch("carry_adjoint", "nodes", time=a["stage_size"], rate=a["unit"])
        if "slopes" in a.conditions:
            model.launch("slope_adjoint", "nodes", share=1.0, is_whole=1)

    def _enter_first(self) -> None:
        """Enters the stage before it, and w̄ of what it carried to the next."""
        model, a = self.model, self.model.arrays
        _, after = self.around
        after(1)
        model.inputs.load()
        model.launch("restore_frame", "nodes")
        self.method.set_base()
        self.model.copy(solution="first_solution", euler_solution="euler_first_solution")
        self._enter()
        model.launch("carry_adjoint", "nodes", time=a["carried_time"], rate=a["carried_rate"])

    def _enter(self) -> None:
        self.model.arrays.zero_grad(*MOVED, *BETWEEN)
        # the matrix is that of a first evaluation, whatever was counted before
        self.model.arrays.zero("evaluations")
        self.model.launch("enter_stage", "nodes")
        self.method.newton.assemble(matrix=True)
        self.model.factorize()
        self.method.newton.compression.find()

    def _solve(self) -> None:
        """Solve for λ, and add its share of the adjoints of q₀ and v₀."""
        self._stage.solve()
        self._run(self._add_stage_adjoint)

    def _add_stage_adjoint(self) -> None:
        model, a = self.model, self.model.arrays
        if model.has_hard_pins:
            # what is held has no λ: its row of ρ is the adjoint of the velocity that holds it
            a.zero("q_x")
            model.launch("hard_pin_adjoint", "pins")
        model.launch("add_stage_adjoint", "nodes")

    def _finish(self) -> None:
        if self.model.has_hard_pins:
            self.pin_tape.backward()
        self.model.copy(**{f"{name}_grad": f"base_{name}_grad" for name in STATE})
        _, after = self.around
        after(0)
