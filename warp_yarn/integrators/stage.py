"""What implicit methods share: a stage, solved by Newton's iteration (``kernels/nonlinear``), and its adjoint."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp

from ..device.model import BETWEEN, Graphs, Model
from ..kernels.core.status import STALLED

STATE = ("position", "euler", "velocity", "euler_velocity")
MOVED = (*STATE, "increment", "euler_increment")
"""Arrays of the stage that w moves."""

INNER_TOLERANCE = 1e-2
"""Of the linear solves within Newton's iteration: A is not the exact derivative, so that more digits of its solution
would not come nearer to the stage's."""
INNER_TOLERANCE_FREE = 1e-3
"""The same of a cloth that nothing holds: what is left of its momentum adds up from step to step."""
MOST_PARTS = 100
"""Of GMRES, each kept as a vector."""


class StageMethod:
    """A method whose step is one or two implicit stages of size η = fraction · h.

    The first stage starts from the present state (q, q̇). What it leads to is carried by t = carried · h, to
    q + t w₁ and q̇ + t (w₁ − q̇)/η: there a second stage starts, or the step ends if there is none. Where carried is 0
    the stage itself ends the step, and so does a second stage.

    Newton's iteration ends with the step that leaves less than newton_tolerance of the change of velocity, by what the
    steps before it left: looking at where it led would only confirm it (``decide`` in ``kernels/nonlinear/newton.py``,
    ``docs/solver.md``). Along δ it takes a full step unless that overshoots: r·δ is minus the slope of the energy that
    a stage minimizes, where there is one, and must not turn to more than 0.9 of itself with the other sign, or else ‖r‖
    must fall. (That it always falls is too much to ask of yarns that buckle.) Nor may crossings change their order.
    """

    name: str
    order: int
    fraction: float
    carried: float
    stages: int
    keeps_clear = True
    """Whether contact can be modelled: a step ends with a stage, of which none penetrates."""
    fallback: str | None = None
    """The method that makes a step again that gained energy."""
    local_error: float | None = None
    """c of the error c h³ d³q/dt³ of a step, where its stages tell the third derivative."""

    def __init__(self, model: Model):
        self.model = model
        a = model.arrays
        vec3, scalar, n = a.variant.vec3, a.variant.scalar, a["nodes"]
        sliding = model.scene.sliding
        vectors = ("base_position", "base_velocity", "increment", "direction", "solution_before")
        rates = ("base_euler_velocity", "euler_increment", "euler_direction", "euler_solution_before")
        numbers = (
            "size", "slope", "contraction", "kinetic", "last_norm", "change", "first_change",
            "stage_size", "carried_time", "carried_rate", "newton_tolerance",
        )  # fmt: skip
        counts = ("tries", "steps", "continues", "finishes", "solves", "refreshes", "crosses", "newton_iterations")
        for names, count, dtype in (
            (vectors, n, vec3),
            (rates, 2 * n if sliding else 0, scalar),
            (("base_euler",), 2 * n, scalar),
            (("node_mass",), n, scalar),
            (numbers, 1, scalar),
            (counts, 1, wp.int32),
        ):
            for name in names:
                # two methods may work on one model, one after the other
                if name not in a:
                    a[name] = a.zeros(count, dtype) if count else None
        for name, value in (
            ("unit", 1.0),
            ("step_length", 1.0),
            ("shortest", 1e30),
            ("inner_tolerance", INNER_TOLERANCE if len(model.scene.pins) else INNER_TOLERANCE_FREE),
        ):
            a.setdefault(name, a.numbers(value))
        self.set_times(model.step_size, model.step_size)
        self._graphs = Graphs(model.device)

    def set_times(self, step: float, remaining: float) -> None:
        """As of Model.set_times."""
        a, stage = self.model.arrays, self.fraction * step
        self.model.set_times(step, remaining, stage, (self.fraction, self.fraction + self.carried)[: self.stages])
        a.put("newton_tolerance", self.model.newton_tolerance_at(step))
        a.put("stage_size", stage)
        a.put("carried_time", self.carried * step)
        a.put("carried_rate", self.carried / self.fraction)

    # -- graphs ------------------------------------------------------------------------------------------------------

    def _run(self, part: Callable[[], None]) -> None:
        """Launches a part of the step."""
        self._graphs.run(part.__name__, part)

    def forget_graphs(self) -> None:
        """Captures anew, after arrays have changed their place."""
        self._graphs.clear()
        if hasattr(self, "_around"):
            self.prepare_adjoint(*self._around)

    # -- forward -----------------------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Makes a step, and records it: one captured graph, whose loops end on the device."""
        self._run(self._step)

    def _step(self) -> None:
        model = self.model
        estimates = "predicted" in model.arrays
        self._begin()
        for stage in range(self.stages):
            if stage:
                model.take_inputs(stage)
                model.launch("ask_for_matrix", "segments")
                model.launch("next_base", "nodes", start=model.arrays["solution"])
                if estimates:
                    model.copy(predicted="solution")
            self._newton(stage)
            self._refuse_impact()
            model.add_work(self._shares[stage])
        if estimates:
            model.launch("estimate_error", 1)
        if self._is_carried:
            model.launch("next_base", "nodes", start=None)
            self.model.copy(
                position="base_position",
                euler="base_euler",
                velocity="base_velocity",
                euler_velocity="base_euler_velocity",
            )
        model.end_step(by_stages=True)

    @property
    def _shares(self) -> tuple[float, ...]:
        """Of each stage's slope in what a step makes."""
        return (1.0,) if self.stages == 1 else (self.carried, self.fraction)

    def estimate_errors(self) -> None:
        """Makes steps leave an estimate of their error in ``step_error`` [m]: c h³ (a₂ − a₁)/(t₂ − t₁), of the
        accelerations at both stages' times. The second stage starts from the first's gain of velocity, η a₁, so it is
        in proportion to what Newton's iteration adds to that."""
        a = self.model.arrays
        a["predicted"] = a.zeros(a["nodes"], a.variant.vec3)
        a["step_error"] = a.zeros(1, a.variant.scalar)
        a["missing"] = a.numbers(self.local_error / (self.fraction * self.carried))

    @property
    def _is_carried(self) -> bool:
        """Whether what the only stage leads to is carried to the step's end."""
        return self.stages == 1 and self.carried > 0.0

    @property
    def iterations(self) -> int:
        """Newton iterations of the last step."""
        return int(self.model.arrays["newton_iterations"].numpy()[0])

    def _begin(self) -> None:
        """The stage starts from the present state, at the present velocity."""
        model = self.model
        model.open_step()
        model.begin_work()
        model.take_inputs()
        model.arrays.zero("newton_iterations", "node_mass")
        model.launch("lump_mass", "segments")
        model.copy(solution="velocity", euler_solution="euler_velocity")
        model.prescribe()
        self._set_base()

    def _set_base(self) -> None:
        self.model.copy(
            base_position="position",
            base_euler="euler",
            base_velocity="velocity",
            base_euler_velocity="euler_velocity",
        )

    def _evaluate(self, *, matrix: bool) -> None:
        """The residual at w, and the matrix if asked for."""
        self.model.launch("enter_stage", "nodes")
        self._assemble(matrix=matrix)
        if matrix:
            self.model.factorize()

    def _assemble(self, *, matrix: bool) -> None:
        a = self.model.arrays
        mass = {"velocity": a["increment"], "euler_velocity": a["euler_increment"]}
        self.model.assemble(matrix=matrix, mass=mass, step_size=a["stage_size"])

    def _newton(self, stage: int) -> None:
        """Solves a stage. Its matrix is that of its start until convergence is slow: another state's differs less
        from it than it differs from the exact derivative. A second stage does with the first's where yarns hardly
        turn."""
        a = self.model.arrays
        a.zero("tries", "steps", "direction", "euler_direction")
        if self.model.scene.sliding:
            a.zero("crosses")
            self.model.launch("look_ahead", "segments")
            wp.capture_if(a["crosses"], on_true=lambda: a.zero("euler_solution"))
        self.model.keep_clear()
        if stage == 0:
            self._evaluate(matrix=True)
            # where it starts with one already, the rest need not be made
            self._refuse_impact()
        else:
            self._evaluate_as_asked()
        self._judge()
        wp.capture_while(a["continues"], lambda: self._iterate(stage))

    def _refuse_impact(self) -> None:
        if self.model.touches and self.model.watches and self.fallback is not None:
            self.model.launch("refuse_impact", 1)

    def _evaluate_as_asked(self) -> None:
        wp.capture_if(
            self.model.arrays["refreshes"],
            on_true=lambda: self._evaluate(matrix=True),
            on_false=lambda: self._evaluate(matrix=False),
        )

    def _judge(self) -> None:
        if self.model.scene.sliding:
            self.model.launch("shortest_segment", "segments")
        self.model.launch("judge", 1)
        if self.model.touches:
            self.model.launch("ask_where_touching", 1)

    def _iterate(self, stage: int) -> None:
        a = self.model.arrays
        a.zero("finishes")
        wp.capture_if(a["solves"], on_true=lambda: self._solve_direction(stage))
        self.model.launch("correct", "nodes")
        wp.capture_if(a["finishes"], on_true=self._finish_stage, on_false=self._look)

    def _finish_stage(self) -> None:
        """Ends with the last step, without a look at where it led."""
        self.model.launch("enter_stage", "nodes")
        self.model.arrays.zero("continues")

    def _look(self) -> None:
        self._evaluate_as_asked()
        self._judge()

    def _solve_direction(self, stage: int) -> None:
        """δ, from A δ = r."""
        a = self.model.arrays
        a.zero("direction", "euler_direction")
        if not len(self.model.scene.pins):
            self.model.launch("start_rigid", 1)
        self.model.copy(solution_before="solution", euler_solution_before="euler_solution")
        self.model.solve(tolerance=a["inner_tolerance"], solution=a["direction"], euler_solution=a["euler_direction"])
        self.model.launch("search", 1)
        if self.model.scene.sliding:
            self.model.launch("keep_order", "segments")
        self.model.limit_step()
        self.model.launch("decide", 1, stage=stage)

    @property
    def _rounding(self) -> float:
        return 1e-16 if self.model.precision == "double" else 1e-7

    @property
    def _adjoint_tolerance(self) -> float:
        return max(self.model.tolerance, 10.0 * self._rounding)

    def _stall(self, residual: float) -> None:
        a = self.model.arrays
        a.put("residual", residual)
        a.put("status", STALLED, -1, 0)

    # -- adjoint -----------------------------------------------------------------------------------------------------

    def prepare_adjoint(self, before: Callable[[], None], after: Callable[[int], None]) -> None:
        """As of LinearlyImplicitEuler."""
        model, a = self.model, self.model.arrays
        vec3, scalar, n, sliding = a.variant.vec3, a.variant.scalar, a["nodes"], model.scene.sliding
        if "seed" not in a:
            model.add_adjoint_arrays()
            for name in ("stage_adjoint", "zero", "first_solution"):
                a[name] = a.zeros(n, vec3)
                a[f"euler_{name}"] = a.zeros(2 * n, scalar) if sliding else None
            a["first_size"] = a.zeros(1, scalar)
            a["adjoint_tolerance"] = a.numbers(self._adjoint_tolerance)
        base = ("base_position", "base_euler", "base_velocity", "base_euler_velocity")
        a.require_grad(*BETWEEN, *MOVED, *base, "rhs", "euler_rhs", "solution", "euler_next", "anchor_next")
        if sliding:
            a["euler_next"].grad = a["base_euler"].grad
        self.tape, self.anchor_tape, self.held_tape = wp.Tape(), wp.Tape(), wp.Tape()
        with self.tape:
            self._assemble(matrix=False)
        with self.anchor_tape:
            model.drag_anchor("euler_next", "anchor_next")
        with self.held_tape:
            model.prescribe(position=a["base_position"])
        self._around = before, after
        self._added = self._arrays_added_to()
        for name in self._graphs.keys() - {"_step"}:
            del self._graphs[name]

    def retreat(self) -> None:
        """As of LinearlyImplicitEuler; (−∂r/∂w)ᵀ λ = w̄ is solved to the linear tolerance, with the exact derivative."""
        self._run(self._recall)
        self._run(self._enter_last)
        self._solve_adjoint()
        if self.stages == 2:
            self._run(self._enter_first)
            self._solve_adjoint()
        self._run(self._finish)

    def _recall(self) -> None:
        """The step that ends at the present frame; the running adjoints go to the base."""
        model, a = self.model, self.model.arrays
        before, _ = self._around
        before()
        model.launch("count", 1, by=-1)
        model.launch("recall", "nodes")
        model.take_inputs(self.stages - 1)
        self._set_base()
        if self._is_carried:
            model.launch("recall_carried_stage", "nodes")
        if self.stages == 2:
            model.launch("recall_first_stage", "nodes")
            first = {"solution": a["first_solution"], "euler_solution": a["euler_first_solution"]}
            model.launch("next_base", "nodes", start=None, **first)
        model.copy(**{f"base_{name}_grad": f"{name}_grad" for name in STATE})
        a.zero_grad("solution")

    def _enter_last(self) -> None:
        """The stage that ended the step, and w̄ of the step's end."""
        model, a = self.model, self.model.arrays
        self._enter()
        if a["anchor"] is not None:
            model.copy(anchor_next_grad="anchor_grad")
            a.zero_grad("anchor", "rhs", "euler_rhs")
            self.anchor_tape.backward()
            self.tape.backward()
        if self._is_carried:
            model.launch("carry_adjoint", "nodes", time=a["carried_time"], rate=a["carried_rate"])
        else:
            model.launch("carry_adjoint", "nodes", time=a["stage_size"], rate=a["unit"])

    def _enter_first(self) -> None:
        """The stage before it, and w̄ of what it carried to the next."""
        model, a = self.model, self.model.arrays
        _, after = self._around
        after(1)
        model.take_inputs()
        model.launch("recall", "nodes")
        self._set_base()
        self.model.copy(solution="first_solution", euler_solution="euler_first_solution")
        self._enter()
        model.launch("carry_adjoint", "nodes", time=a["carried_time"], rate=a["carried_rate"])

    def _enter(self) -> None:
        self.model.arrays.zero_grad(*MOVED, *BETWEEN)
        self.model.launch("enter_stage", "nodes")
        self._assemble(matrix=True)
        self.model.factorize()

    def _solve_adjoint(self) -> None:
        """λ of (−∂r/∂w)ᵀ λ = ρ₀: reverse mode with all of it, and its share of the adjoints of q₀ and v₀."""
        a = self.model.arrays
        self._run(self._descend)
        size, first = (float(a[name].numpy()[0]) for name in ("size", "first_size"))
        if not size <= self._adjoint_tolerance * first and not a["status"].numpy()[0]:
            self._minimize(size, first)
        self._run(self._absorb)

    def _descend(self) -> None:
        """Parts of λ, each A⁻¹ ρ of what the parts before it left, as long as they more than halve ρ.

        Reverse mode adds to what it has added for the parts before: in the end it has run for all of λ.
        """
        a = self.model.arrays
        a.zero("tries")
        self._gather()
        self.model.launch("judge_adjoint", 1)
        wp.capture_while(a["continues"], self._descend_once)

    def _descend_once(self) -> None:
        self._solve_part()
        self._reverse()
        self._gather()
        self.model.launch("judge_adjoint", 1)

    def _minimize(self, left: float, first: float) -> None:
        """What is left of λ, from a ρ of this size, by GMRES with the preconditioner A; ``first`` was that of ρ₀.

        Where yarns slide fast, A alone need not contract.
        """
        a = self.model.arrays
        rho = self._vector("seed")
        # Products with the derivative run all of reverse mode: what it adds to is put back, and added to at the end.
        kept = {name: a[name].grad.numpy().copy() for name in self._added}
        weight = np.sqrt(self._vector("inverse_x", "inverse_s"))
        basis, parts, columns = [], [], []
        combination, size = np.zeros(0), left
        while size > self._adjoint_tolerance * first:
            if len(parts) == MOST_PARTS or not np.isfinite(size) or a["status"].numpy()[0]:
                self._stall(size / first)
                return
            if not basis:
                basis.append(weight * rho / left)
            self._set_vector("seed", basis[-1] / np.where(weight > 0.0, weight, 1.0))
            self._run(self._solve_part)
            parts.append(self._vector("rhs", gradient=True))
            self._run(self._product)
            image = -weight * self._vector("seed")
            # modified Gram-Schmidt, twice: once loses what GMRES needs of orthogonality near the end
            column = np.zeros(len(basis))
            for _ in range(2):
                for k, vector in enumerate(basis):
                    share = float(vector @ image)
                    column[k] += share
                    image -= share * vector
            norm = float(np.linalg.norm(image))
            columns.append(np.append(column, norm))
            hessenberg = np.zeros((len(columns) + 1, len(columns)))
            for k, entries in enumerate(columns):
                hessenberg[: len(entries), k] = entries
            target = np.zeros(len(columns) + 1)
            target[0] = left
            combination = np.linalg.lstsq(hessenberg, target, rcond=None)[0]
            size = float(np.linalg.norm(hessenberg @ combination - target))
            if norm == 0.0:
                break
            basis.append(image / norm)
        for name, values in kept.items():
            a[name].grad.assign(values)
        total = sum((c * part for c, part in zip(combination, parts, strict=True)), np.zeros_like(rho))
        self._set_vector("rhs", total, gradient=True)
        self._run(self._reverse)
        self._run(self._gather)

    def _vector(self, *names: str, gradient: bool = False) -> np.ndarray:
        """An array of the positions and its companion of (u, v), as one vector; named by the first, or by both."""
        total = []
        for name in names if len(names) == 2 else (names[0], f"euler_{names[0]}"):
            array = self.model.arrays[name]
            if array is not None:
                total.append((array.grad if gradient else array).numpy().astype(np.float64).ravel())
        return np.concatenate(total)

    def _set_vector(self, name: str, values: np.ndarray, *, gradient: bool = False) -> None:
        at = 0
        for part in (name, f"euler_{name}"):
            array = self.model.arrays[part]
            if array is not None:
                target = array.grad if gradient else array
                count = target.numpy().size
                target.assign(values[at : at + count].reshape(target.numpy().shape))
                at += count

    def _arrays_added_to(self) -> tuple[str, ...]:
        """Arrays whose gradients reverse mode adds to: the stage's own, friction's anchors and the parameters."""
        between = {*BETWEEN, "rhs", "euler_rhs"}
        arrays = (array for launch in self.tape.launches for array in launch[3] if isinstance(array, wp.array))
        pointers = {array.ptr for array in arrays if array.grad is not None}
        a = self.model.arrays
        return tuple(
            name
            for name, array in a.items()
            if isinstance(array, wp.array) and array.grad is not None and array.ptr in pointers and name not in between
        )

    def _gather(self) -> None:
        """ρ = w̄ + (∂r/∂w)ᵀ λ, of what reverse mode has gathered."""
        self.model.launch("stage_adjoint_residual", "nodes")

    def _solve_part(self) -> None:
        a = self.model.arrays
        a.zero_grad("rhs", "euler_rhs")
        part = {"solution": a["rhs"].grad, "euler_solution": a.find("euler_rhs_grad")}
        self.model.solve(tolerance=a["inner_tolerance"], rhs=a["seed"], euler_rhs=a["euler_seed"], **part)

    def _product(self) -> None:
        """(∂r/∂w)ᵀ of the part in the gradient of the right-hand side."""
        a = self.model.arrays
        a.zero_grad(*MOVED)
        self._reverse()
        zero = {"stage_adjoint": a["zero"], "euler_stage_adjoint": a["euler_zero"]}
        self.model.launch("stage_adjoint_residual", "nodes", **zero)

    def _reverse(self) -> None:
        self.model.arrays.zero_grad(*BETWEEN)
        self.tape.backward()

    def _absorb(self) -> None:
        model, a = self.model, self.model.arrays
        if model.held:
            # what is held has no λ: its row of ρ is the adjoint of the velocity that holds it
            a.zero("q_x")
            model.launch("held_adjoint", "pins")
        model.launch("absorb_stage", "nodes")

    def _finish(self) -> None:
        if self.model.held:
            self.held_tape.backward()
        self.model.copy(**{f"{name}_grad": f"base_{name}_grad" for name in STATE})
        _, after = self._around
        after(0)
