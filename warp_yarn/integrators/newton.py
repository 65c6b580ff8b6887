"""Newton's iteration on an implicit stage: the host's side of ``kernels/nonlinear``."""

from __future__ import annotations

import warp as wp

from ..device import declarations
from ..device.model import Model
from ..kernels.nonlinear.newton import NOTHING, OBSTACLES, PINS
from .compression import Compression

INNER_TOLERANCE = 1e-2
"""Of the linear solves within Newton's iteration: A is not the exact derivative, so that more digits of its solution
would not come nearer to the stage's."""
INNER_TOLERANCE_FREE = 1e-3
"""The same of a cloth that nothing holds: what is left of its momentum adds up from step to step."""


class Newton:
    """Solves the stages of a model, one after the other.

    The iteration ends with the step that leaves less than newton_tolerance of the change of velocity, by what the steps
    before it left: looking at where it led would only confirm it (``check_convergence`` in
    ``kernels/nonlinear/newton.py``, ``docs/solver.md``). Along δ it takes a full step unless that overshoots: r·δ is
    minus the slope of the energy that a stage minimizes, where there is one, and must not turn to more than 0.9 of
    itself with the other sign, or else ‖r‖ must fall. (That it always falls is too much to ask of yarns that buckle.)
    Nor may crossings change their order.
    """

    def __init__(self, model: Model, *, has_fallback: bool):
        self.model, self.has_fallback = model, has_fallback
        scene = model.scene
        self._held_by = PINS if len(scene.pins) else OBSTACLES if scene.obstacles else NOTHING
        a = model.arrays
        a.make(declarations.STAGES)
        self.compression = Compression(model)
        if "base_position" not in a:  # two methods may work on one model, one after the other
            a.make(declarations.NEWTON_WORKSPACE)
            a.put("unit", 1.0)
            a.put("step_length", 1.0)
            a.put("shortest", 1e30)
            a.put("inner_tolerance", INNER_TOLERANCE if self._held_by == PINS else INNER_TOLERANCE_FREE)

    def evaluate(self, *, matrix: bool) -> None:
        """Computes the residual at w, and the matrix if asked for."""
        self.model.launch("enter_stage", "nodes")
        self.assemble(matrix=matrix)
        if matrix:
            self.model.factorize()

    def assemble(self, *, matrix: bool) -> None:
        a = self.model.arrays
        mass = {"velocity": a["increment"], "euler_velocity": a["euler_increment"]}
        self.model.assemble(matrix=matrix, mass=mass, step_size=a["stage_size"])

    def solve(self, stage: int) -> None:
        """Solves a stage. Its first two steps have the matrix of its start, and a later stage may begin with the one
        before's (``ask_for_matrix``)."""
        a = self.model.arrays
        a.zero("evaluations", "steps", "direction", "euler_direction", "asks_for_compression")
        self.compression.forget()
        if self.model.scene.sliding:
            a.zero("order_would_be_lost")
            self.model.launch("check_initial_guess", "segments")
            wp.capture_if(a["order_would_be_lost"], on_true=lambda: a.zero("euler_solution"))
        self.model.contact.keep_clear()
        if stage == 0:
            self.evaluate(matrix=True)
            # where it starts with one already, the rest need not be made
            self.refuse_impact()
        else:
            self._evaluate_as_asked()
        self._control()
        wp.capture_while(a["iterate"], lambda: self._iterate(stage))

    def ask_for_matrix(self) -> None:
        """Asks for a matrix of the next stage's own where yarns turn in a step, or are stiff, so that any turn makes
        another one, and the stage before took more than one step of the iteration."""
        if self.model.preconditioner != "multilevel":
            self.model.arrays.zero("rebuild_matrix")
        self.model.launch("ask_for_matrix", "segments")

    def refuse_impact(self) -> None:
        """Leave an impact to the fallback of a method that has one."""
        if self.has_fallback:
            self.model.contact.refuse_impact()

    def _evaluate_as_asked(self) -> None:
        wp.capture_if(
            self.model.arrays["rebuild_matrix"],
            on_true=lambda: self.evaluate(matrix=True),
            on_false=lambda: self.evaluate(matrix=False),
        )

    def _control(self) -> None:
        if self.model.scene.sliding:
            self.model.launch("shortest_segment", "segments")
        self.model.launch("control_newton", 1)
        self.model.contact.ask_for_matrix()

    def _iterate(self, stage: int) -> None:
        a = self.model.arrays
        a.zero("take_unchecked_step")
        wp.capture_if(a["new_direction"], on_true=lambda: self.solve_direction(stage))
        self.model.launch("apply_step", "nodes")
        wp.capture_if(a["take_unchecked_step"], on_true=self._finish_stage, on_false=self._check)

    def _finish_stage(self) -> None:
        """Ends with the last step, without a look at where it led."""
        self.model.launch("enter_stage", "nodes")
        self.model.arrays.zero("iterate")

    def _check(self) -> None:
        self._evaluate_as_asked()
        self._control()

    def solve_direction(self, stage: int) -> None:
        """Solves for δ, from A δ = r, or from (A − G) δ = r after the first."""
        a = self.model.arrays
        self.model.copy(solution_before="solution", euler_solution_before="euler_solution")
        wp.capture_if(a["asks_for_compression"], on_true=self.compression.find)
        self.compression.solve(self._solve_linear)
        self.compression.forget()
        a.zero("asks_for_compression")
        self.model.launch("begin_line_search", 1, held_by=self._held_by)
        if self.model.scene.sliding:
            self.model.launch("limit_step_length", "segments")
        self.model.contact.limit_step()
        self.model.launch("check_convergence", 1, stage=stage)

    def _solve_linear(self) -> None:
        a = self.model.arrays
        a.zero("direction", "euler_direction")
        if self._held_by != PINS:
            self.model.launch("start_rigid", 1, held_by=self._held_by)
        self.model.solve(tolerance=a["inner_tolerance"], solution=a["direction"], euler_solution=a["euler_direction"])
