"""Eq. 2 of the paper, linearly implicit Euler, and its adjoint."""

from __future__ import annotations

from collections.abc import Callable

import warp as wp

from ..device import declarations
from ..device.graphs import GraphCache
from ..device.model import BETWEEN, MATRIX, Model
from ..kernels.core.structs import ONCE
from .made import Made, Point, subtract_product


class LinearlyImplicitEuler:
    """(M + h² H + h D) q̇⁺ = h F + (M + h D) q̇,   q⁺ = q + h q̇⁺: one linear solve a step.

    Order 1. Damps stiff modes as implicit Euler does, H being the positive semi-definite part of the stiffness; what is
    not in H and D (wind by position, inertia, what friction owes to the contact force) is explicit. Impact zones come
    after it (``device/impact_zones.py``).
    """

    name = "linear"
    order = 1
    local_error = None
    fallback = None
    keeps_clear = False

    def __init__(self, model: Model):
        self.model = model
        self._graphs = GraphCache(model.device)
        model.arrays.put("evaluations", ONCE)

    def set_times(self, step: float, remaining: float) -> None:
        """Sets h and the time in which hard pins reach their targets [s] (``Model.set_times``)."""
        self.model.set_times(step, remaining, step)
        # what iterates, such as relax(), leaves another number there
        self.model.arrays.put("evaluations", ONCE)

    def advance(self) -> None:
        """Makes a step, and records it. Impact zones are the host's, between two graphs."""
        if self.model.zones is None:
            self._graphs.run("forward", self._step)
            return
        self.model.zones.begin()
        self._graphs.run("solve", self._solve_step)
        self.model.zones.apply()
        self._graphs.run("end", self.model.end_step)

    def _step(self) -> None:
        self._solve_step()
        self.model.end_step()

    def _solve_step(self) -> None:
        model = self.model
        model.begin_step()
        model.inputs.load()
        model.assemble()
        # The last velocity is the start: a step changes it little.
        model.copy(solution="velocity", euler_solution="euler_velocity")
        model.set_pin_velocity()
        model.factorize()
        model.solve()
        model.launch("advance", "nodes")

    def made(self, before: Point, after: Point, step: float) -> list[Made]:
        """Finds the one solve of a step that was made from its two ends."""
        return [Made(1.0, step, before.position, before.velocity, after.velocity, None, step)]

    def assemble_made(self, stage: int) -> None:
        """Assembles what is left of a solve that was made: b − A w, in place of the right-hand side."""
        self.model.arrays.put("evaluations", ONCE)
        self._assemble_stage(stage)
        subtract_product(self.model)

    def _assemble_stage(self, stage: int) -> None:
        self.model.assemble()

    # -- adjoint -----------------------------------------------------------------------------------------------------

    def prepare_adjoint(self, before: Callable[[], None], after: Callable[[int], None]) -> None:
        """Makes room for the adjoints within a step, and records what the tape reverses.

        Args:
            before, after: launch what a run has to do with adjoints before every step, and after every stage of it.
        """
        model, a = self.model, self.model.arrays
        a.make(declarations.ADJOINT)
        a.require_grad(*BETWEEN, *MATRIX, "rhs", "euler_rhs", "solution", "euler_next", "anchor_next")
        if model.scene.sliding:
            # s⁺ is the end of the step for friction's anchor too: one running adjoint
            a["euler_next"].grad = a["euler"].grad
        self.tape, self.anchor_tape = wp.Tape(), wp.Tape()
        with self.tape:
            self._record()
        with self.anchor_tape:
            model.update_anchor("euler_next", "anchor_next")
        self._around = before, after
        for name in ("backward", "restore", "reverse"):
            self._graphs.pop(name, None)

    def _record(self) -> None:
        self.model.assemble()
        self.model.set_pin_velocity()

    def backward_step(self) -> None:
        """Goes back over the step that ends at the present frame.

        Before, the gradients of the state's arrays hold the adjoint of the step's end; after, that of its beginning,
        and those of parameters have gained the step's part.
        """
        if self.model.zones is None:
            self._graphs.run("backward", self._backward_step)
            return
        self._graphs.run("restore", self._begin_backward)
        self.model.zones.reverse()
        self._graphs.run("reverse", self._end_backward)
        self.model.zones.end_reverse()

    def _backward_step(self) -> None:
        self._begin_backward()
        self._end_backward()

    def _begin_backward(self) -> None:
        before, _after = self._around
        before()
        self._restore()

    def _end_backward(self) -> None:
        _before, after = self._around
        self._reverse()
        after(0)

    def _reverse(self) -> None:
        self.model.assemble()
        self._reverse_anchors()
        self.model.launch("adjoint_right_hand_side", "nodes")
        self._solve()
        self.tape.backward()

    def _restore(self) -> None:
        """Restores the state that the step started from."""
        self.model.launch("count", 1, by=-1)
        self.model.launch("restore_frame", "nodes")
        self.model.inputs.load()

    def _reverse_anchors(self) -> None:
        """Takes friction's anchors back, first of all that the adjoints of an assembly gather."""
        a = self.model.arrays
        a.zero_grad(*BETWEEN)
        if a["anchor"] is not None:
            self.model.copy(anchor_next_grad="anchor_grad")
            a.zero_grad("anchor")
            self.anchor_tape.backward()

    def _solve(self) -> None:
        """Solves for λ, in the gradient of the right-hand side, and from it Ā and the adjoint of what is held."""
        model, a = self.model, self.model.arrays
        model.factorize()
        multiplier = {"solution": a["rhs"].grad, "euler_solution": a.find("euler_rhs_grad")}
        model.solve(rhs=a["adjoint_rhs"], euler_rhs=a["euler_adjoint_rhs"], **multiplier)
        if model.has_hard_pins:
            a.zero("q_x", "q_s")
            a.zero_grad("solution")
            model.launch("apply_matrix", 1, p_x=a["rhs"].grad, p_s=a.find("euler_rhs_grad"))
            model.launch("hard_pin_adjoint", "pins")
        model.launch("matrix_adjoint", "nodes")
