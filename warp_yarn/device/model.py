"""A scene on the device: its arrays and kernels, and the launches that fill forces, momentum and matrix and solve.

What a time step is made of, without saying how: that is for ``integrators``.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from ..description.cloths import Cloths
from ..description.levels import BLOCKS
from ..description.scene import Scene
from ..errors import InputError, choice, number, whole
from ..kernels import Term, Variant, build
from ..kernels.stepping.energy_watch import BLOW_UP, GAIN, STILL
from . import exclusive
from .arrays import Arrays

MATRIX = (
    "diagonal_xx", "diagonal_xs", "diagonal_ss", "upper_xx", "upper_xs", "upper_sx", "upper_ss",
)  # fmt: skip
SUMS = ("force", "euler_force", "momentum", "euler_momentum")
BETWEEN = (*SUMS, "friction_force_out", "normal", "contact_load")
"""Arrays that an assembly passes through, whose adjoints start at 0."""
AT_END, AT_START = 2, 3
"""The places of a step's end and start among ``stage_times``, behind those of two stages."""
PATHS = ("pin_target", "applied_force")
"""Inputs that may change from step to step."""
CHEAP_ENERGIES = {
    "mass": "energy", "stretch": "elastic_energy", "pins": "elastic_energy", "gravity": "height_energy",
}  # fmt: skip
"""Terms whose energy is looked at in every step, and the array that it goes to."""
OUTER_FORCES = ("wind", "applied")
"""Terms that do work on the cloth and have no energy."""
NARROWEST_STRIP = 8
"""Columns; the sweeps need 3 at least, and fewer than these do not pay."""
SOLVED = ("rhs", "euler_rhs", "tolerance", "solution", "euler_solution")
"""What differs from one linear solve to another."""
PRECONDITIONERS = ("multilevel", "incomplete", "jacobi")
PRECISIONS = {"double": wp.float64, "single": wp.float32}
TOLERANCES = {"double": 1e-6, "single": 1e-4}
"""Of linear solves: far under the error of eq. 2's step, 1e-2 of the motion."""
NEWTON_TOLERANCE = 2e-2
SLOW = 1e3
"""k_s h²/(m L) from which on the motion that a step resolves is slow beside the yarns' stretching, and its error
smaller, as the root of it: so is the tolerance, down to ``TIGHT`` of it."""
TIGHT = {"double": 1e-2, "single": 1e-1}
STIFF = 2e4
"""k_s h²/(m L) from which on lines on many levels take less time than the incomplete factorization: where a stretch
wave runs over a hundred crossings in a step."""
STIFF_SLIDING = 3.0
"""The same where friction's damping does not hold the rates of sliding: the incomplete factorization takes their
diagonal for its pivots, and its sweeps grow from yarn to yarn. On 61 × 61 yarns it "converged" 100 % off from 20 on."""
HOLDING = 10.0
"""Times h k_s/L that friction's damping must have to hold the rates."""
RESOLVED = 4.0
"""Of steps that do not resolve the yarns' vibrations: a stretch wave runs from a crossing to the next in less than the
``RESOLVED``-th part of a step. A tenth at most is then added to the error of the second-order methods. The error of
shorter steps falls with their square, and so does the tolerance in double precision."""
EXACT = 1e-8
"""Both tolerances of differentiable runs in double precision: gradients are right to no more digits than these."""


class Graphs(dict[str, Any]):
    """Launches by name, captured at their first call and replayed from then on: twenty of them cost microseconds."""

    def __init__(self, device: Any):
        super().__init__()
        self.device = device

    def run(self, name: str, part: Callable[[], None]) -> None:
        """Launches what a function launches; the function is called the first time alone."""
        if name not in self:
            self[name] = exclusive.capture(self.device, part)
        exclusive.replay(self[name])


class Near(NamedTuple):
    """What is near each other: a node with another one, or with an obstacle, the other of which is -1 then."""

    node: np.ndarray
    other: np.ndarray
    obstacle: np.ndarray
    gap: np.ndarray
    normal: np.ndarray
    force: np.ndarray


class Model:
    """A scene on the device.

    Args:
        scene, step, device, precision, preconditioner, tolerance, newton_tolerance, max_iterations, threads,
            differentiable: as of the Simulator.

    Attributes:
        arrays: by the names that kernels use.
        kernels: by name.
        strips: of the cloth, one a processor core that a linear solve takes.
        held: whether pins are exact.
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
    ):
        if not isinstance(scene, Scene):
            raise InputError(f"scene = {scene!r}, must be a Scene")
        self.scene = scene
        self.step_size = number("step", step, above=0.0)
        self.precision = choice("precision", precision, PRECISIONS)
        if preconditioner is None:
            preconditioner = "multilevel" if self._needs_levels() else "incomplete"
        self.preconditioner = choice("preconditioner", preconditioner, PRECONDITIONERS)
        if scene.self_contact and preconditioner == "jacobi":
            raise InputError("preconditioner = 'jacobi' with self_contact: must be 'multilevel' or 'incomplete'")
        exact = differentiable and precision == "double"
        default = EXACT if exact else TOLERANCES[precision]
        self.tolerance = number("tolerance", default if tolerance is None else tolerance, above=0.0)
        if newton_tolerance is None and exact:
            newton_tolerance = EXACT
        self._resolving = self._resolving_rate()
        self._newton_tolerance = None
        if newton_tolerance is not None:
            self._newton_tolerance = number("newton_tolerance", newton_tolerance, above=0.0)
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
        self.held = len(scene.pins) > 0 and scene.pin_stiffness is None
        self.arrays = Arrays(scene, variant, self.device)
        self.set_times(self.step_size, self.step_size, self.step_size)
        self._add_ledger()
        self.arrays["tolerance"] = self.arrays.numbers(self.tolerance)
        if self.preconditioner == "multilevel":
            self.arrays.add_levels()
        self._form_team(whole("threads", threads, least=1))

    def _needs_levels(self) -> bool:
        """Whether the incomplete factorization takes longer than lines on many levels, or does not work."""
        cloth, h = self.scene.cloth, self.step_size
        stretch = h * cloth.stretch_stiffness.max() / cloth.spacing
        held = "friction" in self.scene.terms and cloth.friction_damping > HOLDING * stretch
        stiffness = (self._stretch_rate().max() * h) ** 2
        return stiffness > (STIFF if held or not self.scene.sliding else STIFF_SLIDING)

    def newton_tolerance_at(self, step: float) -> float:
        """As given, or what follows the error of steps of this size."""
        if self._newton_tolerance is not None:
            return self._newton_tolerance
        fastest = float(self._stretch_rate().max())
        slow = min(1.0, math.sqrt(SLOW) / (fastest * step)) if fastest > 0.0 else 1.0
        resolved = min(1.0, step * self._resolving) ** 2
        return max(EXACT, NEWTON_TOLERANCE * max(TIGHT[self.precision], slow) * resolved)

    def _resolving_rate(self) -> float:
        """Of steps that begin to resolve the yarns' stretching [1/s]."""
        rate = self._stretch_rate()
        if self.precision == "single" or not rate.any():
            return math.inf
        return rate[rate > 0.0].min() / RESOLVED

    def _stretch_rate(self) -> np.ndarray:
        """√(k_s/(m L)) of every material, m the mass of a segment [1/s]."""
        cloth = self.scene.cloth
        return np.sqrt(cloth.stretch_stiffness / [yarn.density for yarn in cloth.yarns]) / cloth.spacing

    def _form_team(self, threads: int) -> None:
        """Strips of the cloth for so many processor cores (``kernels/linear/threads.py``)."""
        a = self.arrays
        if threads > 1 and not (self.device.is_cpu and self.preconditioner != "jacobi"):
            raise InputError(
                f"threads = {threads}, must be 1 on {self.device} with the {self.preconditioner!r} preconditioner: "
                "only the CPU's 'incomplete' and 'multilevel' ones share their work"
            )
        cloth = self.scene.cloth
        if threads > 1 and isinstance(cloth, Cloths):
            raise InputError(f"threads = {threads} with several cloths, must be 1: strips are of one")
        # the sweeps of one thread go from node to node, whatever a row is
        columns = cloth.nodes if isinstance(cloth, Cloths) else cloth.weave.columns
        self.strips = max(1, min(threads, columns // NARROWEST_STRIP))
        a["columns"] = columns
        a["sums"] = a.zeros(5 * self.strips, a.variant.scalar)
        a["team"] = a.zeros(16 + 16 * self.strips, wp.int32)
        self._team_of(1)
        if self.strips > 1:
            for name in SOLVED:
                a[f"team_{name}"] = None if a[name] is None else a.zeros(a[name].shape[0], a[name].dtype)

    def _team_of(self, strips: int) -> None:
        """Begins to count anew, for so many strips."""
        team = self.arrays["team"]
        team.assign(np.where(np.arange(len(team)) == 3, strips, 0).astype(np.int32))

    def set_times(self, step: float, remaining: float, stage: float, times: tuple[float, ...] = (1.0,)) -> None:
        """The step that kernels make.

        Args:
            step: h [s].
            remaining: time in which exact pins reach their targets [s]; more than h in a part of a step.
            stage: of an implicit stage [s]: the matrix is M + stage · D + stage² · H.
            times: of the stages, in steps: pins with springs are taken to where they are then.
        """
        a = self.arrays
        begun = 1.0 - remaining / self.step_size
        # what holds exactly goes straight to the place at the end of the whole step
        reached = [1.0 if self.held else begun + time * step / self.step_size for time in (*times, 1.0)]
        a.put("stage_times", *reached, *[reached[-1]] * (3 - len(reached)), begun)
        a.put("step_size", step)
        a.put("remaining", remaining)
        a.put("weights", 1.0, stage, stage * stage)

    def launch(self, kernel: str, elements: str | int, **replaced: Any) -> None:
        """Launches a kernel by its name (see ``Arrays.launch``)."""
        self.arrays.launch(self.kernels[kernel], elements, **replaced)

    def copy(self, **targets: str) -> None:
        """Copies arrays, target="source", those that the scene has; ``x_grad`` is the gradient of ``x``."""
        for target, source in targets.items():
            self.copy_array(self.arrays.find(target), self.arrays.find(source))

    def copy_array(self, target: wp.array | None, source: wp.array | None) -> None:
        """By a kernel: wp.copy copies gradients too, and keeps a copy for itself where it is captured on the CPU."""
        if target is not None:
            kernel = "copy_vectors" if target.dtype == self.arrays.variant.vec3 else "copy_numbers"
            self.launch(kernel, target.shape[0], source=source, target=target)

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
        self._find_normals()
        for term in a.terms:
            arrays = (mass or {}) if term.name == "mass" else others
            filled = int(matrix and term.name not in explicit)
            self.launch(term.name, term.elements, matrix=filled, press=int(a.contact), **arrays)
        self.launch("right_hand_side", "nodes", **replaced)

    def _find_normals(self) -> None:
        """Fills contact normals, where a term of the scene needs them, for terms to add to the loads."""
        if self.arrays.contact:
            self.arrays.zero("contact_load")
            self.launch("contact_normal", "crossings")
        self._find_contacts()

    def _find_contacts(self) -> None:
        """Looks for what obstacles' contact needs to know of the present positions."""
        if self.touches:
            self.arrays.zero("touching")
        if self.scene.obstacles and any(self.arrays.meshes):
            self.launch("find_faces", "node_obstacles")
        if self.scene.self_contact:
            self._keep_list(moves=False)

    @property
    def touches(self) -> bool:
        """Whether the scene has contact at all."""
        return bool(self.scene.obstacles) or self.scene.self_contact

    def _keep_list(self, *, moves: bool) -> None:
        """Makes a new list of what is near where nodes have moved too far for the last, or would by a step."""
        self.launch("measure_stray", "nodes", moves=int(moves))
        wp.capture_if(self.arrays["outdated"], on_true=self._list_near)

    def _list_near(self) -> None:
        a = self.arrays
        a.grid.build(a["position"], float(a["near_reach"].numpy()[0]))
        self.launch("list_near", "nodes", grid=a.grid.id)

    def keep_clear(self) -> None:
        """Lets a stage's iteration start where nothing penetrates."""
        if self.scene.obstacles:
            self.launch("start_outside", "nodes")
        if self.scene.self_contact:
            self.launch("aim", "nodes")
            self._limit_to_pairs()
            self.launch("start_apart", "nodes")
            self.launch("check_apart", "nodes")

    def limit_step(self) -> None:
        """Shortens a step of the iteration so that nothing penetrates."""
        if self.scene.obstacles:
            self.launch("limit_to_obstacles", "node_obstacles")
        if self.scene.self_contact:
            self._limit_to_pairs()

    def _limit_to_pairs(self) -> None:
        self._keep_list(moves=True)
        self.launch("limit_to_list", "nodes")
        self.launch("limit_to_pairs", "nodes")

    def report_obstacles(self) -> Near:
        """Every node and obstacle, and their force."""
        nodes, several = self.scene.cloth.nodes, len(self.scene.obstacles)
        self._find_contacts()
        gaps, forces = self._reported("report_contacts", "node_obstacles", nodes * several)
        node, obstacle = np.divmod(np.arange(nodes * several), several)
        return Near(node, np.full_like(node, -1), obstacle, gaps[:, 3], gaps[:, :3], forces)

    def report_pairs(self) -> Near:
        """Every two nodes that are near each other, and their force."""
        a, nodes = self.arrays, self.scene.cloth.nodes
        self._find_contacts()
        room = a["near_room"]
        gaps, forces = self._reported("report_pairs", "nodes", nodes * room)
        node, slot = np.divmod(np.arange(nodes * room), room)
        other = a["near"].numpy()
        kept = (slot < a["near_count"].numpy()[node]) & (node < other)
        node, other = node[kept], other[kept]
        return Near(node, other, np.full_like(node, -1), gaps[kept, 3], gaps[kept, :3], forces[kept])

    def _reported(self, kernel: str, elements: str, count: int) -> tuple[np.ndarray, np.ndarray]:
        a = self.arrays
        gaps = a.zeros(count, wp.types.vector(4, a.variant.scalar))
        forces = a.zeros(count, a.variant.vec3)
        self.launch(kernel, elements, gaps=gaps, contact_forces=forces)
        return gaps.numpy(), forces.numpy()

    def press(self) -> None:
        """Fills contact normals and loads alone, where a term of the scene needs them."""
        a = self.arrays
        self._find_normals()
        for term in a.terms:
            if a.contact and term.presses:
                # the forces go where the solver works
                unused = {"force": a["q_x"], "euler_force": a["q_s"]}
                self.launch(term.name, term.elements, matrix=0, press=1, **unused)

    def prescribe(self, **replaced: Any) -> None:
        """Gives exact pins the velocity that brings them to their place."""
        if self.held:
            self.launch("prescribe", "pins", **replaced)

    def factorize(self) -> None:
        """The preconditioner of the assembled matrix."""
        self.launch("precondition", "nodes")
        if self.preconditioner == "incomplete":
            self.launch("factorize", 1)
        if self.preconditioner == "multilevel":
            self._factorize_levels()

    def _factorize_levels(self) -> None:
        starts = self.arrays.level_start
        for first, end in itertools.pairwise(starts):
            self.launch("coarsen", BLOCKS * (end - first), first=first)
        for direction, name in enumerate(("warp_lines", "weft_lines")):
            self.launch("factorize_lines", name, direction=direction)
            self.launch("factorize_coarse_lines", f"coarse_{name}", direction=direction)
        if len(starts) > 1:
            first, end = starts[-2:]
            self.launch("factorize_coarsest", 1, first=first, count=end - first)

    def solve(self, **replaced: Any) -> None:
        """The conjugate gradient on the factorized matrix, with other arrays in place of some of ``SOLVED``."""
        a = self.arrays
        arrays = {name: replaced.get(name, a[name]) for name in SOLVED}
        kernel = f"{self.preconditioner}_conjugate_gradient"
        if self.strips == 1:
            self.launch(kernel, 1, strip=0, most_iterations=self.max_iterations, **arrays)
            return
        # helpers were launched with arrays of their own
        for name, array in arrays.items():
            self.copy_array(a[f"team_{name}"], array)
        self._launch_solve(0)
        for name in ("solution", "euler_solution"):
            self.copy_array(arrays[name], a[f"team_{name}"])

    def _launch_solve(self, strip: int) -> None:
        arrays = {name: self.arrays[f"team_{name}"] for name in SOLVED}
        kernel = f"{self.preconditioner}_conjugate_gradient"
        self.launch(kernel, 1, strip=strip, most_iterations=self.max_iterations, **arrays)

    @contextlib.contextmanager
    def team(self) -> Iterator[None]:
        """Keeps the other processor cores at hand for linear solves, for as long as a block lasts."""
        if self.strips == 1:
            yield
            return
        self._team_of(self.strips)
        team = self.arrays["team"].numpy()  # on the CPU the array itself
        helpers = []
        try:
            for strip in range(1, self.strips):
                helpers.append(threading.Thread(target=self._launch_solve, args=(strip,), daemon=True))
                helpers[-1].start()
                while team[4] != strip and helpers[-1].is_alive():
                    time.sleep(1e-5)
            yield
        finally:
            team[2] = 1
            for helper in helpers:
                helper.join()
            self._team_of(1)

    def drag_anchor(self, euler: str, anchor: str) -> None:
        """Moves friction's anchors to where the step leaves them, from and into the arrays of these names."""
        a = self.arrays
        if a["anchor"] is not None:
            self.launch("drag_anchor", "crossings", euler_next=a[euler], anchor_next=a[anchor])

    def end_step(self, *, by_stages: bool = False) -> None:
        """What every method ends a step with, its end state in place: checks and moves on, and records the frame.

        Args:
            by_stages: whether the method has added up the work of its stages (``add_work``).
        """
        if self.scene.sliding:
            self.launch("check_order", "segments")
        if "pin_motion" in self.arrays:
            # pins are looked at where they are now, not where they were at the last stage's time
            self.take_inputs(AT_END)
        if self.watches:
            self._close_step(by_stages)
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

    def take_inputs(self, stage: int = 0) -> None:
        """Puts pins and applied forces of a stage of this step in place, where they change."""
        a = self.arrays
        if "applied_force_path" in a:
            path, values = a["applied_force_path"], a["applied_force"]
            self.launch("take", len(values), path=path, values=values)
        if "pin_target_path" in a:
            arrays = {"start": a["pin_start"], "path": a["pin_target_path"], "motion": a["pin_motion"]}
            self.launch("move_along", "pins", stage=stage, values=a["pin_target"], **arrays)
        if self.obstacles_move:
            # where they were when the positions were made that a stage starts from
            self.place_obstacles(stage - 1 if stage == 1 else AT_START)
            self.copy(obstacle_position_before="obstacle_position")
            self.launch(
                "copy_rotations",
                "obstacles",
                source=a["obstacle_rotation"],
                target=a["obstacle_rotation_before"],
            )
            self.place_obstacles(stage)

    @property
    def obstacles_move(self) -> bool:
        """Whether any obstacle has a path."""
        return "obstacle_position_path" in self.arrays

    def place_obstacles(self, stage: int) -> None:
        """Puts obstacles to where they are at the time of a stage."""
        self.launch("place_obstacles", "obstacles", stage=stage, step_duration=self.step_size)

    def give_inputs(self, name: str, stage: int) -> None:
        """Adjoint of ``take_inputs`` for one of ``PATHS``."""
        a = self.arrays
        gradients = {"values_grad": a[name].grad, "path_grad": a[f"{name}_path"].grad}
        if name == "applied_force":
            self.launch("give", len(a[name]), **gradients)
        else:
            self.launch("give_back_along", "pins", stage=stage, **gradients)

    # -- energy ------------------------------------------------------------------------------------------------------

    def _add_ledger(self) -> None:
        """Room for the watch over energy (``kernels/stepping/energy_watch.py``)."""
        a = self.arrays
        # the reaction of pins that are moved exactly is nowhere at hand
        self.watches = not (self.held and self.scene.pin_path is not None)
        counts = {"energy": 1, "elastic_energy": 1, "height_energy": 1, "power": 2, "stage_work": 1, "bounds": 7}
        for name, count in counts.items():
            a[name] = a.zeros(count, a.variant.scalar)
        for name in ("steps_to_audit", "audit_due", "alert", "looks_closely", "damps"):
            a[name] = a.zeros(1, wp.int32)
        mass = a.node_mass() * a["nodes"]
        a["still_energy"] = a.numbers(0.5 * mass * STILL**2)
        if self._outer:
            a["outer_force"] = a.zeros(a["nodes"], a.variant.vec3)
        a["gain"] = a.numbers(BLOW_UP if a.variant.reverse else GAIN)
        self.forget_energy()

    def forget_energy(self) -> None:
        """Begins to watch anew, from the present state on."""
        for name, value in (("audit_due", 1), ("alert", 0)):
            self.arrays.put(name, value)
        self.arrays.put("bounds", 0.0, 0.0, 0.0, -math.inf, 0.0, 0.0, 0.0)

    def trust_energy(self) -> None:
        """Lets all steps pass, until ``forget_energy``: steps that are made again, from the middle of a run, were
        watched the first time."""
        a = self.arrays
        a.put("bounds", math.inf, math.inf, 0.0, 0.0, 0.0, 0.0, 0.0)
        a.put("audit_due", 0)
        a.put("steps_to_audit", np.iinfo(np.int32).max)

    def open_step(self) -> None:
        """What every method begins a step with: it looks at the energy, if it is time to."""
        if self.watches:
            wp.capture_if(self.arrays["audit_due"], on_true=self._audit)

    def _audit(self) -> None:
        if "pin_motion" in self.arrays:
            self.take_inputs(AT_START)
        self.press()
        self.arrays.zero("energy", "elastic_energy", "height_energy")
        self._add_energies(cheap=True)
        self._add_energies(cheap=False)
        if self._outer:
            self._add_outer_forces("outer_force")
        self.launch("audit", 1)

    def _add_energies(self, *, cheap: bool) -> None:
        """Energy of the cheap terms, or of the others."""
        for term in self.arrays.terms:
            if term.energy is not None and (term.name in CHEAP_ENERGIES) == cheap:
                energy = self.arrays[CHEAP_ENERGIES.get(term.name, "energy")]
                self.launch(f"{term.name}_energy", term.elements, energy=energy)

    def begin_work(self) -> None:
        """Begins to add up the work done in a step."""
        self.arrays.zero("stage_work")

    def add_work(self, share: float) -> None:
        """Adds the work that is done at the present state in a share of the step."""
        if self.watches:
            self._add_powers()
            self.launch("add_work", 1, share=share)

    @property
    def _outer(self) -> list[Term]:
        """Terms that do work on the cloth and have no energy."""
        return [term for term in self.arrays.terms if term.name in OUTER_FORCES]

    def _add_outer_forces(self, target: str) -> None:
        """Fills an array with outer forces at the present state."""
        a = self.arrays
        a.zero(target)
        for term in self._outer:
            self.launch(term.name, term.elements, matrix=0, press=0, force=a[target])

    def _add_powers(self) -> None:
        """The power of outer forces and of moving pins at the present state."""
        a = self.arrays
        a.zero("power")
        if self._outer:
            # the forces go where the solver works
            self._add_outer_forces("q_x")
            self.launch("add_power", "nodes", force=a["q_x"])
        if "pin_motion" in a and any(term.name == "pins" for term in a.terms):
            self.launch("add_pin_power", "pins", step_duration=self.step_size)
        if self.obstacles_move:
            self.launch("add_obstacle_power", "node_obstacles")

    def _close_step(self, by_stages: bool) -> None:
        """Compares the energy at the end of a step with the work done in it."""
        a = self.arrays
        a.zero("energy", "elastic_energy", "height_energy")
        self._add_energies(cheap=True)
        self.launch("suspect", 1)
        wp.capture_if(a["looks_closely"], on_true=lambda: self._add_energies(cheap=False))
        self._add_powers()
        self.launch("close_step", 1, by_stages=int(by_stages))
        if self._outer:
            self.launch("keep_outer_force", "nodes", force=a["q_x"])
