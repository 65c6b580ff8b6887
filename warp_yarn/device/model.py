"""A scene on the device: its arrays and kernels, and the launches that fill forces, momentum and matrix and solve.

What a time step is made of, without saying how: that is for ``integrators``.
"""

from __future__ import annotations

import itertools
from typing import Any

import warp as wp

from ..description.levels import BLOCKS
from ..description.sanity import checked_step
from ..description.scene import Scene
from ..description.varying import has_gusts
from ..errors import InputError, brief, choice, integer, real
from ..kernels import TERMS, Term, Variant, build, own
from ..kernels.core.general import NUMBERS
from . import defaults, start
from .arrays import Arrays
from .contact import Contact
from .declarations import INPUTS
from .declared import arguments
from .defaults import PRECISIONS, PRECONDITIONERS
from .energy_watch import AT_END, EnergyWatch
from .impact_zones import ImpactZones
from .inputs import Inputs
from .memory import record
from .threads import SOLVED, Threads

MATRIX = (
    "diagonal_xx", "diagonal_xs", "diagonal_ss", "upper_xx", "upper_xs", "upper_sx", "upper_ss",
)  # fmt: skip
SUMS = ("force", "euler_force", "momentum", "euler_momentum")
BETWEEN = (
    *SUMS, "friction_force_out", "normal", "contact_load", "sample_position", "sample_velocity", "sample_force",
)  # fmt: skip
"""Arrays that an assembly passes through, whose adjoints start at 0."""


class Model:
    """A scene on the device.

    Args:
        scene, step, device, precision, preconditioner, tolerance, newton_tolerance, max_iterations, threads,
            differentiable: as of the Simulator; hooked: whether it has a hook.

    Attributes:
        arrays: by the names that kernels use.
        kernels: by name.
        inputs: those that change from step to step.
        contact: what the cloth touches by a barrier.
        zones: keep it apart otherwise; None: there are none.
        energy: the watch over it.
        threads: processor cores that share a linear solve.
        has_hard_pins: whether pins are exact.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        step: float,
        device: Any,
        precision: str,
        preconditioner: str | None,
        tolerance: float | None,
        newton_tolerance: float | None,
        max_iterations: int | None,
        threads: int,
        differentiable: bool,
        hooked: bool = False,
    ):
        if not isinstance(scene, Scene):
            raise InputError(f"scene = {brief(scene)}, must be a Scene")
        self.scene = scene
        self.step_size = checked_step(step)
        self.precision = choice("precision", precision, PRECISIONS)
        chosen = defaults.preconditioner(scene, self.step_size) if preconditioner is None else preconditioner
        self.preconditioner = choice("preconditioner", chosen, PRECONDITIONERS)
        exact = differentiable and precision == "double"
        if tolerance is None:
            tolerance = defaults.tolerance(precision, exact=exact)
        self.tolerance = real("tolerance", tolerance, above=0.0)
        given = defaults.EXACT if newton_tolerance is None and exact else newton_tolerance
        self._newton_tolerance = given if given is None else real("newton_tolerance", given, above=0.0)
        most = defaults.max_iterations(scene) if max_iterations is None else max_iterations
        self.max_iterations = integer("max_iterations", most, least=1)
        self.device = _checked_device(device)
        variant = Variant(PRECISIONS[precision], scene.sliding, differentiable, general=scene.cloth.general)
        self.kernels = _kernels(scene, variant)
        self.arrays = Arrays(scene, variant, self.device)
        _check_inputs(self)
        self.has_hard_pins = "hard pins" in self.arrays.conditions
        self.set_times(self.step_size, self.step_size, self.step_size)
        self.inputs = Inputs(self, hooked=hooked)
        self.contact = Contact(self)
        self.zones = ImpactZones(self) if scene.has_impact_zones else None
        self.energy = EnergyWatch(self)
        if self.preconditioner == "multilevel":
            self.arrays.add_levels(defaults.needs_strips(scene, self.step_size))
        self.threads = Threads(self, integer("threads", threads, least=1))
        self.arrays.put("tolerance", self.tolerance)

    def newton_tolerance_at(self, step: float, share: float = 1.0) -> float:
        """Give the tolerance that was asked for, or a share of what follows the error of steps of this size [s]."""
        given = self._newton_tolerance
        return share * defaults.newton_tolerance(self.scene, self.precision, step) if given is None else given

    def set_times(
        self, step: float, remaining: float, stage: float, times: tuple[float, ...] = (1.0,), of_slope: float = 1.0
    ) -> None:
        """Sets the times of the step that kernels make.

        Args:
            step: h [s].
            remaining: time in which exact pins reach their targets [s]; more than h in a part of a step.
            stage: of an implicit stage [s]: the matrix is M + stage · D + stage² · H.
            times: of the stages, in steps: pins with springs are taken to where they are then.
            of_slope: the same of the stage that finds a slope.
        """
        a = self.arrays
        begun = 1.0 - remaining / self.step_size
        # what holds exactly goes straight to the place at the end of the whole step
        after = [1.0 if self.has_hard_pins else begun + t * step / self.step_size for t in (of_slope, *times, 1.0)]
        a.put("stage_times", *after[1:], *[after[-1]] * (5 - len(after)), begun, after[0])
        a.put("step_size", step)
        a.put("remaining", remaining)
        a.put("coefficients", 1.0, stage, stage * stage)

    def launch(self, kernel: str, elements: str | int, **replaced: Any) -> None:
        """Launches a kernel by its name (see ``Arrays.launch``)."""
        self.arrays.launch(self.kernels[kernel], elements, **replaced)

    def launch_term(self, term: Term, **offered: Any) -> None:
        """Launch a term, with what its kernel has arguments for. Forces of contact are still to be scattered."""
        offered |= self.contact.samples.offered(matrix=bool(offered.get("matrix"))) if term.touches else {}
        self.launch(term.name, term.elements, **self.arrays.taken(self.kernels[term.name], **offered))

    def copy(self, **targets: str) -> None:
        """Copies arrays, target="source", those that the scene has; ``x_grad`` is the gradient of ``x``."""
        for target, source in targets.items():
            self.arrays.copy_into(self.arrays.find(target), self.arrays.find(source))

    def assemble(
        self,
        *,
        matrix: bool = True,
        mass: dict[str, wp.array] | None = None,
        explicit: tuple[str, ...] = (),
        **replaced: Any,
    ) -> None:
        """Fills forces, momentum, matrix and right-hand side from the state: the terms of the scene, in their order.

        Args:
            matrix: whether to fill the matrix.
            mass: arrays to take in place of the velocities for the momentum; D q̇ is then left out of it.
            explicit: terms to leave out of the matrix, and their D q̇ out of the momentum.
            replaced: arrays to take in place of others for the right-hand side.
        """
        a = self.arrays
        # Without its place in the momentum, D q̇ goes where the solver works.
        others = {} if mass is None else {"momentum": a["q_x"], "euler_momentum": a["q_s"]}
        a.zero(*SUMS)
        if matrix:
            a.zero(*MATRIX)
        _find_normals(self, matrix=matrix)
        for term in a.terms:
            arrays = (mass or {}) if term.name == "mass" else others
            filled = int(matrix and term.name not in explicit)
            self.launch_term(term, matrix=filled, add_contact_load=_presses(self, term), **arrays)
            if term is self.contact.last:
                self.contact.samples.scatter(matrix=matrix)
        self.launch("right_hand_side", "nodes", **replaced)

    def add_contact_load(self) -> None:
        """Fills contact normals and loads alone, where a term of the scene needs them."""
        a = self.arrays
        _find_normals(self, matrix=False)
        # the forces go where the solver works
        unused = {"force": a["q_x"], "euler_force": a["q_s"]}
        for term in a.terms:
            if term.presses and _presses(self, term):
                self.launch_term(term, matrix=0, add_contact_load=1, **unused)

    def set_pin_velocity(self, **replaced: Any) -> None:
        """Gives exact pins the velocity that brings them to their place."""
        if self.has_hard_pins:
            self.launch("set_pin_velocity", "pins", **replaced)

    def factorize(self) -> None:
        """Computes the preconditioner of the assembled matrix."""
        self.launch("precondition", "nodes")
        if self.preconditioner == "incomplete":
            self.launch("factorize", 1)
        elif self.preconditioner == "multilevel":
            _factorize_levels(self)

    def solve(self, **replaced: Any) -> None:
        """Launch the conjugate gradient on the factorized matrix, with other arrays in place of some of ``SOLVED``."""
        arrays = {name: replaced.get(name, self.arrays[name]) for name in SOLVED}
        if self.threads.count > 1:
            self.threads.solve(arrays)
        else:
            self.launch_solve(0, arrays)

    def launch_solve(self, thread: int, arrays: dict[str, Any]) -> None:
        """Launch the conjugate gradient of one of the threads that share it."""
        kernel = f"{self.preconditioner}_conjugate_gradient"
        options = {} if self.preconditioner == "jacobi" else {"thread": thread}
        self.launch(kernel, 1, most_iterations=self.max_iterations, **options, **arrays)

    def update_anchor(self, euler: str, anchor: str) -> None:
        """Moves friction's anchors to where the step leaves them, from and into the arrays of these names."""
        a = self.arrays
        if a["anchor"] is not None:
            self.launch("update_anchor", "crossings", euler_next=a[euler], anchor_next=a[anchor])

    def begin_step(self) -> None:
        """Look at the energy, if it is time to: what every method begins a step with."""
        self.energy.begin_step()

    def end_step(self, *, by_stages: bool = False) -> None:
        """Checks and moves on, and records the frame: what every method ends a step with, its end state in place.

        Args:
            by_stages: whether the method has added up the work of its stages (``energy.add_work``).
        """
        if self.scene.sliding:
            self.launch("check_order", "segments")
        if self.inputs.move:
            # pins are looked at where they are now, not where they were at the last stage's time
            self.inputs.load(AT_END)
        self.energy.end_step(by_stages=by_stages)
        self.update_anchor("euler", "anchor")
        self.launch("count", 1, by=1)
        record(self)


def _find_normals(model: Model, *, matrix: bool) -> None:
    """Fills contact normals, where a term of the scene needs them, for terms to add to the loads."""
    if model.arrays.contact:
        _find_crossings(model)
    model.contact.find(matrix=matrix)


def _find_crossings(model: Model) -> None:
    """Fills the normals of crossings, and sets their loads to 0, or to those at crimped positions."""
    model.arrays.zero("contact_load")
    model.launch("contact_normal", "crossings")
    if model.scene.contact_force == "crimped":
        for name in ("stretch", "bending"):
            if name in model.scene.terms:
                model.launch(f"crimped_{name}_load", "bends")


def _presses(model: Model, term: Term) -> int:
    """Tells whether a term is to add to the contact loads: stretch and bending are not where these are taken at crimped
    positions, nor is bending beside crimp interchange, which has what bends the yarns there."""
    crimped = model.scene.contact_force == "crimped" and term.name in ("stretch", "bending")
    interchanged = model.scene.crimp_interchange and term.name == "bending"
    return int(model.arrays.contact and not crimped and not interchanged)


def _checked_device(device: Any) -> Any:
    """Finds a device of Warp."""
    try:
        return start.device(device)
    except Exception as error:
        names = ", ".join(str(d) for d in wp.get_devices())
        raise InputError(f"device = {device!r}, must be one of {names}") from error


def _kernels(scene: Scene, variant: Variant) -> dict[str, wp.Kernel]:
    """Builds the kernels of a scene's terms, of which one may have been registered when the scene was made."""
    for name in scene.terms:
        choice("scene.terms", name, TERMS)
    kernels = build(variant, scene.terms)
    if has_gusts(scene.functions):
        gusty = {name.removeprefix("gusty_"): name for name in kernels if name.startswith("gusty_")}
        kernels = kernels | {name: kernels[other] for name, other in gusty.items()}
    return kernels


def _check_inputs(model: Model) -> None:
    """Refuses a term that takes what acts on other cloths, and not on this one, or one number of what has several."""
    for term in model.arrays.terms:
        for name in (term.name, f"{term.name}_energy"):
            taken = arguments(model.kernels[name]) if name in model.kernels else set()
            for lacking in sorted(taken & set(INPUTS) - set(model.arrays)):
                raise InputError(f"scene.terms has {term.name!r}, which takes {lacking!r}: the scene has none")
            for read in sorted(taken & NUMBERS) if model.arrays.variant.general and not own(term) else ():
                raise InputError(
                    f"scene.terms has {term.name!r}, which reads one {read!r} of the cloth: this one has several"
                )


def _factorize_levels(model: Model) -> None:
    """Factorizes lines and coarse levels, from the cloth up."""
    starts = model.arrays.level_start
    for first, end in itertools.pairwise(starts):
        model.launch("coarsen", BLOCKS * (end - first), first=first)
    for direction, name in enumerate(("warp_lines", "weft_lines")):
        model.launch("factorize_lines", name, along=direction)
        model.launch("factorize_coarse_lines", f"coarse_{name}", along=direction)
    if model.arrays.dims["strips"]:
        model.launch("factorize_strips", "strips")
    if len(starts) > 1:
        first, end = starts[-2:]
        model.launch("factorize_coarsest", 1, first=first, count=end - first)
