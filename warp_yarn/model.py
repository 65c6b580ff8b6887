"""A scene on the device: its arrays and kernels, and the launches that fill forces, momentum and matrix and solve.

What a time step is made of, without saying how: that is for ``integrators``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from .arrays import Arrays
from .errors import InputError, choice, number, whole
from .kernels import Variant, build
from .scene import Scene

MATRIX = (
    "diagonal_xx", "diagonal_xs", "diagonal_ss", "upper_xx", "upper_xs", "upper_sx", "upper_ss",
)  # fmt: skip
SUMS = ("force", "euler_force", "momentum", "euler_momentum")
BETWEEN = (*SUMS, "friction_force_out", "normal", "contact_load")
"""Arrays that an assembly passes through, whose adjoints start at 0."""
PATHS = ("pin_target", "applied_force")
"""Inputs that may change from step to step."""
PRECONDITIONERS = ("incomplete", "jacobi")
PRECISIONS = {"double": wp.float64, "single": wp.float32}
TOLERANCES = {"double": 1e-8, "single": 1e-4}
NEWTON = {"double": 1e-6, "single": 1e-4}


class Model:
    """A scene on the device.

    Args:
        scene, step, device, precision, preconditioner, tolerance, newton_tolerance, max_iterations,
            differentiable: as of the Simulator.

    Attributes:
        arrays: by the names that kernels use.
        kernels: by name.
        held: whether pins are exact.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        step: float,
        device: Any,
        precision: str,
        preconditioner: str,
        tolerance: float | None,
        newton_tolerance: float | None,
        max_iterations: int | None,
        differentiable: bool,
    ):
        if not isinstance(scene, Scene):
            raise InputError(f"scene = {scene!r}, must be a Scene")
        self.scene = scene
        self.step_size = number("step", step, above=0.0)
        self.precision = choice("precision", precision, PRECISIONS)
        self.preconditioner = choice("preconditioner", preconditioner, PRECONDITIONERS)
        self.tolerance = TOLERANCES[precision] if tolerance is None else number("tolerance", tolerance, above=0.0)
        self.newton_tolerance = number(
            "newton_tolerance", NEWTON[precision] if newton_tolerance is None else newton_tolerance, above=0.0
        )
        degrees = scene.cloth.nodes * (5 if scene.sliding else 3)
        most = max(1000, degrees) if max_iterations is None else max_iterations
        self.max_iterations = whole("max_iterations", most, least=1)
        try:
            self.device = wp.get_device(device)
        except Exception as error:
            names = ", ".join(str(d) for d in wp.get_devices())
            raise InputError(f"device = {device!r}, must be one of {names}") from error
        variant = Variant(PRECISIONS[precision], scene.sliding, differentiable)
        self.kernels = build(variant)
        self.arrays = Arrays(scene, variant, self.device)
        self.arrays["step_size"].assign(np.array([self.step_size]))
        self.set_weights(1.0, self.step_size, self.step_size**2)
        self.held = len(scene.pins) > 0 and scene.pin_stiffness is None

    def set_weights(self, mass: float, damping: float, stiffness: float) -> None:
        """The factors of M, D and H in the matrix: 1, h and h² for eq. 2."""
        self.arrays["weights"].assign(np.array([[mass, damping, stiffness]]))

    def launch(self, kernel: str, elements: str | int, **replaced: Any) -> None:
        """Launches a kernel by its name (see ``Arrays.launch``)."""
        self.arrays.launch(self.kernels[kernel], elements, **replaced)

    def assemble(self, *, matrix: bool = True, mass: dict[str, wp.array] | None = None, **replaced: Any) -> None:
        """Fills forces, momentum, matrix and right-hand side from the state: the terms of the scene, in their order.

        Args:
            matrix: whether to fill the matrix.
            mass: arrays to take in place of the velocities for the momentum; D q̇ is then left out of it.
            replaced: arrays to take in place of others for the right-hand side.
        """
        a = self.arrays
        # Without its place in the momentum, D q̇ goes where the solver works.
        others = {} if mass is None else {"momentum": a["q_x"], "euler_momentum": a["q_s"]}
        a.zero(*SUMS)
        if matrix:
            a.zero(*MATRIX)
        self.press()
        for term in a.terms:
            arrays = (mass or {}) if term.name == "mass" else others
            self.launch(term.name, term.elements, matrix=int(matrix), **arrays)
        self.launch("right_hand_side", "nodes", **replaced)

    def press(self) -> None:
        """Fills contact normals and loads, where a term of the scene needs them."""
        a = self.arrays
        if a.contact:
            a.zero("contact_load")
            self.launch("contact_normal", "crossings")
            for term in a.terms:
                if term.contact_load is not None:
                    self.launch(f"{term.name}_contact_load", term.elements)

    def prescribe(self, **replaced: Any) -> None:
        """Gives exact pins the velocity that brings them to their place."""
        if self.held:
            self.launch("prescribe", "pins", **replaced)

    def solve(self, **replaced: Any) -> None:
        """The conjugate gradient on the assembled matrix, with other vectors or numbers where they are given."""
        self.launch("precondition", "nodes")
        if self.preconditioner == "incomplete":
            self.launch("factorize", 1)
        numbers = {"tolerance": self.tolerance, "most_iterations": self.max_iterations}
        self.launch(f"{self.preconditioner}_conjugate_gradient", 1, **{**numbers, **replaced})

    def drag_anchor(self, euler: str, anchor: str) -> None:
        """Moves friction's anchors to where the step leaves them, from and into the arrays of these names."""
        a = self.arrays
        if a["anchor"] is not None:
            self.launch("drag_anchor", "crossings", euler_next=a[euler], anchor_next=a[anchor])

    def end_step(self) -> None:
        """What every method ends a step with, its end state in place: checks and moves on, and records the frame."""
        if self.scene.sliding:
            self.launch("check_order", "segments")
        self.drag_anchor("euler", "anchor")
        self.launch("count", 1, by=1)
        self.launch("record", "nodes")

    def add_adjoint_arrays(self) -> None:
        """Room for the right-hand side of the adjoint solve, and for (u, v) and the anchors at the end of a step."""
        a, n = self.arrays, self.arrays["nodes"]
        a["seed"] = a.zeros(n, a.variant.vec3)
        for name in ("euler_seed", "euler_next"):
            a[name] = a.zeros(2 * n, a.variant.scalar) if self.scene.sliding else None
        a["anchor_next"] = None if a["anchor"] is None else a.zeros(2 * n, a.variant.scalar)

    def take_inputs(self) -> None:
        """Puts this step's pins and applied forces in place, where they change."""
        for name in PATHS:
            if f"{name}_path" in self.arrays:
                path, values = self.arrays[f"{name}_path"], self.arrays[name]
                self.launch("take", len(values), path=path, values=values)
