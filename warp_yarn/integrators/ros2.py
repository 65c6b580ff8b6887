"""ROS2 of Verwer and others, a linearly implicit method of second order, and its adjoint."""

from __future__ import annotations

from collections.abc import Callable

import warp as wp

from ..device import declarations
from ..device.model import BETWEEN, MATRIX, Model
from ..kernels.stepping.ros2 import GAMMA
from .linear import LinearlyImplicitEuler
from .made import Made, Point, held


class ROS2(LinearlyImplicitEuler):
    """Two linear solves a step, each as that of eq. 2 with η = γ h, γ = 1 − 1/√2, in place of h.

        A₁ w₁ = η F₁ + (M₁ + η D₁) q̇,   A = M + η D + η² H
        q₂ = q + h w₁,   v₂ = q̇ + (w₁ − q̇)/γ
        A₂ w₂ = η F₂ + M₂ (v₂ − 4 w₁ + 2 q̇) + η D₂ (v₂ − 2 w₁)
        q⁺ = q + 3/2 h w₁ + 1/2 h w₂,   q̇⁺ = w₁ + (w₁ + w₂)/(2γ)

    For (q, q̇)' = f it is (1 − γhJ) k₁ = f, (1 − γhJ) k₂ = f(+ h k₁) − 2 k₁, + 3/2 h k₁ + 1/2 h k₂, where w are the
    positions' parts of k and J = [[0, 1], [−M⁻¹H, −M⁻¹D]]; the last line is shorter by 2γ² − 4γ + 1 = 0.

    Order 2, whatever H and D are: to that order their parts in w₁ and w₂ cancel. So they may lack what is not
    symmetric or not positive, and here the damping of wind as well, whose rate (2 ρ_w |v_n| + c_d over the cloth's mass
    an area) is 5/s for the paper's. They may also be those of another state; assembled anew at the second stage, as
    here, they make a fifth of the error that those of the first do at 0.5 ms of the paper's cloth.

    L-stable where H and D are exact, and weakly so elsewhere: what is stiff and has θ times the stiffness that H says
    is multiplied by 1 − 2θ/γ + θ²/(2γ²) a step, which grows beyond θ = 4γ = 1.17 (eq. 2: beyond 2). A cloth that
    buckles may gain many times its energy, and no error says so: the paper's of 9 × 9 did at steps of 0.5 to 2 ms from
    its first buckling (0.1 s) on, and at 0.25 ms after 0.46 s; at 0.125 ms it went on well for 0.6 s.

    M is never inverted alone. Where it is singular, in the sliding coordinates, a step is that of ROS2 for
    D q̇ = F(q), w₁ and w₂ being its k; q̇⁺ forgets q̇ there, and goes on from what D and F make of it.

    What is held has w₂ = −w₁: it arrives at q + h w₁, its target, with q̇⁺ = w₁.
    """

    name = "ros2"
    order = 2

    def __init__(self, model: Model):
        super().__init__(model)
        self._explicit = tuple(term.name for term in model.arrays.terms if term.explicit_in_ros2)
        model.arrays.make(declarations.STAGES)
        model.arrays.make(declarations.FIRST_STAGE)
        self.set_times(model.step_size, model.step_size)

    def set_times(self, step: float, remaining: float) -> None:
        """Sets h and the time in which hard pins reach their targets [s] (``Model.set_times``)."""
        self.model.set_times(step, remaining, GAMMA * step, (GAMMA, 1.0 - GAMMA))
        self.model.arrays.put("stage_size", GAMMA * step)

    def _step(self) -> None:
        model, a = self.model, self.model.arrays
        first = {"solution": a["first_solution"], "euler_solution": a["euler_first_solution"]}
        model.begin_step()
        model.inputs.load()
        self._assemble_first()
        model.copy(first_solution="velocity", euler_first_solution="euler_velocity")
        model.set_pin_velocity(solution=a["first_solution"])
        model.factorize()
        model.solve(**first)
        model.launch("enter_second_stage", "nodes", start=a["solution"], euler_start=a["euler_solution"])
        if model.scene.sliding:
            model.launch("check_order", "segments")
        model.inputs.load(1)
        self._assemble_second()
        model.factorize()
        model.solve()
        model.launch("leave_second_stage", "nodes")
        model.end_step()

    def _assemble_first(self) -> None:
        self.model.assemble(explicit=self._explicit, step_size=self.model.arrays["stage_size"])

    def _assemble_second(self) -> None:
        model, a = self.model, self.model.arrays
        mass = {"velocity": a["increment"], "euler_velocity": a["euler_increment"]}
        model.assemble(explicit=self._explicit, mass=mass, step_size=a["stage_size"])
        if a["anchor"] is not None:
            model.launch("second_stage_damping", "crossings")

    def made(self, before: Point, after: Point, step: float) -> list[Made]:
        """Finds both solves of a step that was made from its two ends, as the adjoint does. By 2γ² − 4γ + 1 = 0 the
        impulse of the step is the mean of theirs, each over η, times h."""
        size, v = GAMMA * step, before.velocity
        mean = (after.position - before.position) / step
        both = (after.velocity - mean) * (2.0 * GAMMA / (1.0 - GAMMA))
        fixed = held(self.model)
        both[fixed] = 0.0
        first = mean - 0.5 * both
        first[fixed] = after.velocity[fixed]
        second = v + (first - v) / GAMMA
        increment = second - 4.0 * first + 2.0 * v
        return [
            Made(0.5, size, before.position, v, first, None, size),
            Made(0.5, size, before.position + step * first, second, both - first, increment, size, first),
        ]

    def _assemble_stage(self, stage: int) -> None:
        if stage == 0:
            self._assemble_first()
        else:
            self._assemble_second()

    # -- adjoint -----------------------------------------------------------------------------------------------------

    def prepare_adjoint(self, before: Callable[[], None], after: Callable[[int], None]) -> None:
        """Makes room for the adjoints within a step, and records what the tape reverses."""
        a = self.model.arrays
        a.make(declarations.CARRIED_ADJOINT)
        a.require_grad(*BETWEEN, *MATRIX, "rhs", "euler_rhs", "increment", "euler_increment", "euler_first_solution")
        self.second_tape = wp.Tape()
        with self.second_tape:
            self._assemble_second()
        super().prepare_adjoint(before, after)

    def _record(self) -> None:
        self._assemble_first()
        self.model.set_pin_velocity()

    def _reverse(self) -> None:
        model, a = self.model, self.model.arrays
        model.inputs.load(1)
        model.launch("restore_both_stages", "nodes")
        model.launch("enter_second_stage", "nodes", start=None, euler_start=None)
        self._assemble_second()
        self._reverse_anchors()
        a.zero_grad("increment", "euler_increment", "euler_first_solution")
        model.launch("second_stage_adjoint", "nodes")
        self._solve()
        self.second_tape.backward()
        _, after = self._around
        after(1)

        model.launch("restore_frame", "nodes")
        model.inputs.load()
        self._assemble_first()
        a.zero_grad(*BETWEEN)
        model.launch("first_stage_adjoint", "nodes")
        # λ starts at 0, and w is that of the first stage
        a.zero_grad("rhs", "euler_rhs")
        model.copy(solution="first_solution", euler_solution="euler_first_solution")
        self._solve()
        self.tape.backward()
