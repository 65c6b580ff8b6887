"""The adjoint solve of an implicit stage, (−∂r/∂w)ᵀ λ = w̄, with the exact derivative by reverse mode."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp

from ..device.declared import arrays_of
from ..device.graphs import GraphCache
from ..device.model import BETWEEN, Model
from ..kernels.core.status import STALLED
from .compression import Compression
from .gmres import gmres

STATE = ("position", "euler", "velocity", "euler_velocity")
MOVED = (*STATE, "increment", "euler_increment")
"""Arrays of the stage that w moves."""
MOST_PARTS = 100
"""Of GMRES, each kept as a vector."""
ROUNDING = {"double": 1e-16, "single": 1e-7}


class StageSolve:
    """Solves for λ, which stands in the gradient of the right-hand side, to the linear tolerance.

    Args:
        model: the model.
        compression: what compressed yarns take from its matrix.
        tape: what the stage's assembly reverses.
        tolerance: of ‖ρ‖, relative to its start.
    """

    def __init__(self, model: Model, compression: Compression, tape: wp.Tape, tolerance: float):
        self.model, self._compression, self.tape, self._tolerance = model, compression, tape, tolerance
        self._graphs = GraphCache(model.device)
        self._added = self._arrays_added_to()

    def _run(self, part: Callable[[], None]) -> None:
        """Launches a part of the solve."""
        self._graphs.run(part.__name__, part)

    def solve(self) -> None:
        """Solves for λ of (−∂r/∂w)ᵀ λ = ρ₀; reverse mode has then run with all of it."""
        a = self.model.arrays
        self._run(self._descend)
        size, first = (float(a[name].numpy()[0]) for name in ("residual_norm", "first_residual_norm"))
        if not size <= self._tolerance * first and not a["status"].numpy()[0]:
            self._minimize(size, first)

    def _descend(self) -> None:
        """Adds up parts of λ, each A⁻¹ ρ of what the parts before it left, as long as they more than halve ρ.

        Reverse mode adds to what it has added for the parts before: in the end it has run for all of λ.
        """
        a = self.model.arrays
        a.zero("evaluations")
        self._residual()
        self.model.launch("control_adjoint", 1)
        wp.capture_while(a["iterate"], self._descend_once)

    def _descend_once(self) -> None:
        self._solve_part()
        self._reverse()
        self._residual()
        self.model.launch("control_adjoint", 1)

    def _minimize(self, left: float, first: float) -> None:
        """Find what is left of λ, from a ρ of this size, by GMRES with the preconditioner A; ``first`` was that of ρ₀.

        Where yarns slide fast, A alone need not contract.
        """
        a = self.model.arrays
        # Products with the derivative run all of reverse mode: what it adds to is put back, and added to at the end.
        kept = {name: a[name].grad.numpy().copy() for name in self._added}

        def preconditioner(vector: np.ndarray) -> np.ndarray:
            self._set_vector("adjoint_rhs", vector)
            self._run(self._solve_part)
            return self._vector("rhs", gradient=True)

        def matvec(_: np.ndarray) -> np.ndarray:
            self._run(self._product)
            return -self._vector("adjoint_rhs")

        total, size = gmres(
            matvec,
            preconditioner,
            self._vector("adjoint_rhs"),
            np.sqrt(self._vector("inverse_x", "inverse_s")),
            size=left,
            target=self._tolerance * first,
            most=MOST_PARTS,
            failed=lambda: bool(a["status"].numpy()[0]),
        )
        if total is None:
            a.put("residual", size / first)
            if not a["status"].numpy()[0]:
                a.put("status", STALLED, -1, 0)
            return
        for name, values in kept.items():
            a[name].grad.assign(values)
        self._set_vector("rhs", total, gradient=True)
        self._run(self._reverse)
        self._run(self._residual)

    def _vector(self, *names: str, gradient: bool = False) -> np.ndarray:
        """Joins an array of the positions and its companion of (u, v), as one vector; named by the first, or by
        both."""
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
        """Finds the arrays whose gradients reverse mode adds to: the stage's own, friction's anchors and the
        parameters."""
        between = {*BETWEEN, "rhs", "euler_rhs"}
        arrays = (array for launch in self.tape.launches for array in arrays_of(launch))
        pointers = {array.ptr for array in arrays if array.grad is not None}
        a = self.model.arrays
        return tuple(
            name
            for name, array in a.items()
            if isinstance(array, wp.array) and array.grad is not None and array.ptr in pointers and name not in between
        )

    def _residual(self) -> None:
        """Gathers ρ = w̄ + (∂r/∂w)ᵀ λ, of what reverse mode has gathered."""
        self.model.launch("stage_adjoint_residual", "nodes")

    def _solve_part(self) -> None:
        self._compression.solve(self._solve_linear)

    def _solve_linear(self) -> None:
        a = self.model.arrays
        a.zero_grad("rhs", "euler_rhs")
        part = {"solution": a["rhs"].grad, "euler_solution": a.find("euler_rhs_grad")}
        self.model.solve(tolerance=a["inner_tolerance"], rhs=a["adjoint_rhs"], euler_rhs=a["euler_adjoint_rhs"], **part)

    def _product(self) -> None:
        """Computes (∂r/∂w)ᵀ of the part in the gradient of the right-hand side."""
        a = self.model.arrays
        a.zero_grad(*MOVED)
        self._reverse()
        zero = {"stage_adjoint": a["zero"], "euler_stage_adjoint": a["euler_zero"]}
        self.model.launch("stage_adjoint_residual", "nodes", **zero)

    def _reverse(self) -> None:
        self.model.arrays.zero_grad(*BETWEEN)
        self.tape.backward()
