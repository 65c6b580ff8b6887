"""The simulator: eq. 2, assembled and solved on the device, captured once and replayed."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import tqdm
import warp as wp

from .arrays import STATE_TYPES, Arrays
from .errors import InputError, SimulationError, choice, number, whole
from .kernels import Variant, build, step
from .scene import Scene
from .state import FIELDS, State, Trajectory

MATRIX = (
    "diagonal_xx", "diagonal_xs", "diagonal_ss", "upper_xx", "upper_xs", "upper_sx", "upper_ss",
)  # fmt: skip
SUMS = ("force", "euler_force", "momentum", "euler_momentum")
PRECONDITIONERS = ("incomplete", "jacobi")
PATHS = ("pin_target", "applied_force")
"""Inputs that may change from step to step."""
CHUNK_BYTES = 1 << 24
"""Room for frames on the device: enough that copying them out costs nothing, little enough for a large cloth."""
PRECISIONS = {"double": wp.float64, "single": wp.float32}


class Simulator:
    """Simulates a scene by eq. 2 of the paper: one linear solve a step, first order in the step.

    Args:
        scene: the scene.
        step: h, time step [s], above 0.
        device: a Warp device, such as "cpu" or "cuda:0".
        precision: "double" or "single".
        tolerance: of the conjugate gradient: √(r·P⁻¹r) relative to √(b·P⁻¹b), P the matrix' diagonal.
        max_iterations: of the conjugate gradient; None: as many as there are degrees of freedom, and 1000 at least.

        chunk: steps whose frames the device keeps at a time; None: as many as take 16 MB, at most 64.

    Attributes:
        state: the present state; set it to start from another one.
        steps_done: steps since the beginning, by which moving pins and applied forces are looked up.
        arrays: the scene's arrays on the device, by the names that kernels use.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        step: float = 1e-3,
        device: Any = "cpu",
        precision: str = "double",
        preconditioner: str = "incomplete",
        tolerance: float | None = None,
        max_iterations: int | None = None,
        chunk: int | None = None,
    ):
        if not isinstance(scene, Scene):
            raise InputError(f"scene = {scene!r}, must be a Scene")
        self.scene = scene
        self.step_size = number("step", step, above=0.0)
        self.precision = choice("precision", precision, PRECISIONS)
        self.preconditioner = choice("preconditioner", preconditioner, PRECONDITIONERS)
        default = {"double": 1e-8, "single": 1e-4}[precision]
        self.tolerance = default if tolerance is None else number("tolerance", tolerance, above=0.0)
        degrees = scene.cloth.nodes * (5 if scene.sliding else 3)
        self.max_iterations = (
            max(1000, degrees) if max_iterations is None else whole("max_iterations", max_iterations, least=1)
        )
        try:
            self.device = wp.get_device(device)
        except Exception as error:
            names = ", ".join(str(d) for d in wp.get_devices())
            raise InputError(f"device = {device!r}, must be one of {names}") from error
        variant = Variant(PRECISIONS[precision], scene.sliding)
        self.kernels = build(variant)
        self.arrays = Arrays(scene, variant, self.device)
        h = self.step_size
        self.arrays["weights"].assign(np.array([[1.0, h, h * h]]))
        self.arrays["step_size"].assign(np.array([h]))
        self.held = len(scene.pins) > 0 and scene.pin_stiffness is None
        self._graph: Any = None
        self.steps_done = 0
        self.chunk = min(64, max(1, CHUNK_BYTES // (13 * 8 * scene.cloth.nodes)))
        if chunk is not None:
            self.chunk = whole("chunk", chunk, least=1)
        self.arrays.add_frames(self.chunk + 1)
        self.state = self._rest()

    # -- state -------------------------------------------------------------------------------------------------------

    def _rest(self) -> State:
        cloth = self.scene.cloth
        return State(cloth.position, cloth.euler, np.zeros((cloth.nodes, 3)), np.zeros((cloth.nodes, 2)))

    @property
    def state(self) -> State:
        """The present state, as a copy; setting it checks shapes, finiteness and that crossings are in order."""
        nodes = self.scene.cloth.nodes
        values = {}
        for name, width in STATE_TYPES.items():
            array = self.arrays[name]
            values[name] = None if array is None else array.numpy().reshape(nodes, width).astype(np.float64)
        if values["euler_velocity"] is None:
            values["euler_velocity"] = np.zeros((nodes, 2))
        if values["anchor"] is None:
            values["anchor"] = values["euler"].copy()
        return State(**values)

    @state.setter
    def state(self, state: State) -> None:
        state = state.checked(self.scene.cloth.nodes)
        self._check_order(state)
        self._upload(state)

    def _check_order(self, state: State) -> None:
        topology = self.scene.cloth.topology
        direction = topology.yarn_direction[topology.segment_yarn]
        a, b = topology.segment_nodes.T
        rest = state.euler[b, direction] - state.euler[a, direction]
        if rest.min() <= 0.0:
            k = int(rest.argmin())
            raise InputError(
                f"state.euler: Δs = {rest[k]:g} between nodes {a[k]} and {b[k]} of yarn {topology.segment_yarn[k]}, "
                "must be above 0: crossings keep their order along a yarn"
            )
        if not self.scene.sliding and np.abs(state.euler_velocity).max() > 0.0:
            raise InputError("state.euler_velocity is not 0, but yarns of this scene do not slide (sliding=False)")
        border = topology.is_crossing == 0
        if np.abs(state.euler_velocity[border]).max() > 0.0:
            raise InputError("state.euler_velocity is not 0 on the border, where nodes have no Eulerian coordinate")

    def _upload(self, state: State) -> None:
        for name in FIELDS:
            array = self.arrays[name]
            if array is not None:
                value = np.asarray(getattr(state, name))
                array.assign(value if array.dtype == self.arrays.variant.vec3 else value.ravel())

    # -- one step ----------------------------------------------------------------------------------------------------

    def assemble(self, *, matrix: bool = True) -> None:
        """Launches what fills forces, momentum and matrix from the state: the terms of the scene, in their order."""
        a, flag = self.arrays, int(matrix)
        a.zero(*SUMS)
        if matrix:
            a.zero(*MATRIX)
        self._contact()
        for term in a.terms:
            a.launch(self.kernels[term.name], term.elements, matrix=flag)
        a.launch(self.kernels["right_hand_side"], "nodes")

    def _contact(self) -> None:
        a = self.arrays
        if a.contact:
            a.zero("contact_load")
            a.launch(self.kernels["contact_normal"], "crossings")
            for term in a.terms:
                if term.contact_load is not None:
                    a.launch(self.kernels[f"{term.name}_contact_load"], term.elements)

    def prescribe(self) -> None:
        """Gives exact pins the velocity that brings them to their place."""
        if self.held:
            self.arrays.launch(self.kernels["prescribe"], "pins")

    def solve(self, **replaced: Any) -> None:
        """Launches the conjugate gradient on the assembled system, with other vectors where they are given."""
        a = self.arrays
        a.launch(self.kernels["precondition"], "nodes")
        if self.preconditioner == "incomplete":
            a.launch(self.kernels["factorize"], 1)
        a.launch(
            self.kernels[f"{self.preconditioner}_conjugate_gradient"],
            1,
            tolerance=self.tolerance,
            most_iterations=self.max_iterations,
            **replaced,
        )

    def _step(self) -> None:
        a = self.arrays
        self.take_inputs()
        self.assemble()
        # The last velocity is the start: a step changes it little.
        wp.copy(a["solution"], a["velocity"])
        if self.scene.sliding:
            wp.copy(a["euler_solution"], a["euler_velocity"])
        self.prescribe()
        self.solve()
        a.launch(self.kernels["advance"], "nodes")
        if self.scene.sliding:
            a.launch(self.kernels["check_order"], "segments")
        if a["anchor"] is not None:
            self.drag_anchor("euler", "anchor")

    def drag_anchor(self, euler: str, anchor: str) -> None:
        """Moves friction's anchors to where the step leaves them, from and into the arrays of these names."""
        a = self.arrays
        a.launch(self.kernels["drag_anchor"], "crossings", euler_next=a[euler], anchor_next=a[anchor])

    def take_inputs(self) -> None:
        """Puts this step's pins and applied forces in place, where they change."""
        for name in PATHS:
            if f"{name}_path" in self.arrays:
                path, values = self.arrays[f"{name}_path"], self.arrays[name]
                self.arrays.launch(self.kernels["take"], len(values), path=path, values=values)

    def _capture_step(self) -> Any:
        """One step and its record as a graph: replayed, its twenty launches cost microseconds."""
        with wp.ScopedCapture(device=self.device, force_module_load=False) as capture:
            self._step()
            self.arrays.launch(self.kernels["count"], 1, by=1)
            self.arrays.launch(self.kernels["record"], "nodes")
        return capture.graph

    def run_chunk(self, steps: int) -> int:
        """Makes at most ``chunk`` steps, into the frames on the device; the state is frame 0.

        Returns:
            How many steps were made; fewer than asked for where one failed (``arrays["status"]`` says how).
        """
        if self._graph is None:
            self._graph = self._capture_step()
        self.arrays["counters"].assign(np.array([0, self.steps_done], dtype=np.int32))
        self.arrays.launch(self.kernels["record"], "nodes")
        status = self.arrays["status"].numpy() if self.device.is_cpu else np.zeros(1)
        for _ in range(steps):
            wp.capture_launch(self._graph)
            if status[0]:  # on the CPU the array itself; elsewhere looking would wait for every step
                break
        status = self.arrays["status"].numpy()
        made = int(status[2]) - 1 if status[0] else steps
        self.steps_done += made
        return made

    # -- running -----------------------------------------------------------------------------------------------------

    def run(self, steps: int, *, progress: bool = False) -> Trajectory:
        """Makes steps and returns every frame, the present one first.

        Raises:
            SimulationError: where a step cannot be made; it has the frames before it, and the simulator stays at the
                last of them.
        """
        steps = whole("steps", steps, least=0)
        trajectory = self._room(steps + 1)
        done = 0
        with tqdm.tqdm(total=steps, disable=not progress, unit="step", leave=False) as bar:
            while done < steps:
                asked = min(self.chunk, steps - done)
                made = self.run_chunk(asked)
                self._copy_frames(trajectory, done, made + 1)
                done += made
                bar.update(made)
                if made < asked:
                    self.fail(done + 1, trajectory.cut(done + 1))
        return trajectory

    def _room(self, frames: int) -> Trajectory:
        """A trajectory whose frames all hold the present state."""
        start = self.state
        repeated = {name: np.repeat(getattr(start, name)[None], frames, axis=0) for name in FIELDS}
        return Trajectory(self.scene.cloth, self.step_size, **repeated)

    def _copy_frames(self, trajectory: Trajectory, at: int, count: int) -> None:
        """Copies the first frames of the chunk on the device to where they belong."""
        for name in FIELDS:
            if self.moves(name):
                kept = self.arrays[f"frame_{name}"].numpy().reshape(self.chunk + 1, self.scene.cloth.nodes, -1)
                getattr(trajectory, name)[at : at + count] = kept[:count]

    def chunk_trajectory(self, frames: int) -> Trajectory:
        """The first frames of the chunk that the device holds."""
        trajectory = self._room(frames)
        self._copy_frames(trajectory, 0, frames)
        return trajectory

    def moves(self, name: str) -> bool:
        """Whether this part of the state changes in this scene."""
        return self.arrays[name] is not None and (name != "euler" or self.scene.sliding)

    def fail(self, k: int, trajectory: Trajectory) -> None:
        """Goes back to the last good frame and says what happened after it."""
        code, node = (int(value) for value in self.arrays["status"].numpy()[:2])
        residual = float(self.arrays["residual"].numpy()[0])
        iterations = int(self.arrays["iterations"].numpy()[0])
        self.arrays.zero("status")
        last = trajectory[-1]
        self._upload(last)
        term = self._blame(last, node)
        columns = self.scene.cloth.weave.columns
        where = (
            f"step {k} (t = {k * self.step_size:g} s): at node {node} (row {node // columns}, column {node % columns})"
        )
        what = {
            step.NOT_FINITE: "a value is not finite",
            step.ORDER_LOST: "Δs to the next crossing of the yarn reached 0",
            step.NOT_CONVERGED: (
                f"the solver stopped after {iterations} iterations at a residual of {residual:.1e}, "
                f"above its tolerance of {self.tolerance:.1e}"
            ),
        }[code]
        raise SimulationError(
            f"{where} {what}. The largest term there is {term!r}. Try a smaller step than {self.step_size:g} s; "
            f"the {len(trajectory)} frames before are in this error's trajectory",
            step=k,
            node=node,
            term=term,
            trajectory=trajectory,
        )

    def _blame(self, state: State, node: int) -> str | None:
        """The term with the largest, or a not finite, force on a node."""
        size = {}
        for name, (force, euler_force) in self.forces(state).items():
            total = float(np.abs(force[node]).sum() + np.abs(euler_force[node]).sum())
            size[name] = total if np.isfinite(total) else np.inf
        return max(size, key=lambda name: size[name], default=None)

    # -- to look into ------------------------------------------------------------------------------------------------

    def forces(self, state: State | None = None) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Force of every term of the scene on a state (None: the present one), by name.

        Returns:
            {term: (x_forces [nodes, 3] in N, s_forces [nodes, 2] in N)}.
        """
        a, nodes, result = self.arrays, self.scene.cloth.nodes, {}
        crossing = np.repeat(self.scene.cloth.topology.is_crossing != 0, 2)
        with _Visit(self, state):
            self._contact()
            total = np.zeros(2 * nodes)
            for term in a.terms:
                if term.name == "mass":
                    continue
                a.zero("force", "euler_force", "friction_force_out")
                if term.name == "friction":
                    a["euler_force"].assign(total)
                a.launch(self.kernels[term.name], term.elements, matrix=0)
                out = "friction_force_out" if term.name == "friction" else "euler_force"
                along = np.zeros(2 * nodes)
                if a[out] is not None:
                    # the border has no Eulerian coordinate: what a segment puts there moves nothing
                    along = np.where(crossing, a[out].numpy(), 0.0)
                total += along
                result[term.name] = (a["force"].numpy().astype(np.float64), along.reshape(nodes, 2).copy())
        return result

    def contact(self, state: State | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Contact normal, from warp to weft [nodes, 3], and contact force F_n [nodes] (N), eq. 3; 0 on the border."""
        if not self.arrays.contact:
            raise InputError("this scene has no contact: neither 'shear' nor 'friction' is among its terms")
        with _Visit(self, state):
            self._contact()
            load = self.arrays["contact_load"].numpy().astype(np.float64)
            return self.arrays["normal"].numpy().astype(np.float64), np.maximum(load, 0.0)

    def energy(self, state: State | None = None) -> dict[str, float]:
        """Energy of every term that has one [J], by name; ``mass`` is the kinetic energy."""
        a, result = self.arrays, {}
        with _Visit(self, state):
            self._contact()
            energy = a.zeros(1, a.variant.scalar)
            for term in a.terms:
                if term.energy is not None:
                    energy.zero_()
                    a.launch(self.kernels[f"{term.name}_energy"], term.elements, energy=energy)
                    result[term.name] = float(energy.numpy()[0])
        return result

    def system(self, state: State | None = None) -> System:
        """The linear system of the next step, to look into: eq. 2 as it is solved."""
        a, nodes, stencil = self.arrays, self.scene.cloth.nodes, self.arrays.stencil
        with _Visit(self, state):
            self.assemble()
            values = {name: a[name].numpy().copy() for name in (*MATRIX, "rhs", "euler_rhs") if a[name] is not None}
        x = np.arange(3 * nodes).reshape(nodes, 3)
        s = 3 * nodes + np.arange(2 * nodes).reshape(nodes, 2)
        rows, columns, entries = [], [], []

        def add(i: np.ndarray, j: np.ndarray, value: np.ndarray, mirror: bool = True) -> None:
            pairs = [(i[:, :, None], j[:, None, :], value)]
            if mirror:
                pairs.append((j[:, :, None], i[:, None, :], value.swapaxes(1, 2)))
            for row, column, entry in pairs:
                row, column, entry = np.broadcast_arrays(row, column, entry)
                rows.append(row.ravel())
                columns.append(column.ravel())
                entries.append(entry.ravel())

        neighbour = self.arrays["neighbour"].numpy().reshape(nodes, stencil)
        add(x, x, values["diagonal_xx"], mirror=False)
        node, slot = np.nonzero(neighbour >= 0)
        other = neighbour[node, slot]
        add(x[node], x[other], values["upper_xx"].reshape(nodes, stencil, 3, 3)[node, slot])
        if self.scene.sliding:
            for d in range(2):
                add(x, s[:, [d]], values["diagonal_xs"].reshape(nodes, 2, 3)[:, d, :, None])
                add(s[:, [d]], s[:, [d]], values["diagonal_ss"].reshape(nodes, 2)[:, d, None, None], mirror=False)
            near = slot < 4
            node, slot, other = node[near], slot[near], other[near]
            d = slot % 2
            mine, its = s[node, d][:, None], s[other, d][:, None]
            add(x[node], its, values["upper_xs"].reshape(nodes, 4, 3)[node, slot][:, :, None])
            add(mine, x[other], values["upper_sx"].reshape(nodes, 4, 3)[node, slot][:, None, :])
            add(mine, its, values["upper_ss"].reshape(nodes, 4)[node, slot][:, None, None])
        topology = self.scene.cloth.topology
        free = [np.repeat(a["is_free"].numpy() != 0, 3)]
        rhs = [values["rhs"].ravel()]
        if self.scene.sliding:
            free.append(np.repeat(topology.is_crossing != 0, 2))
            rhs.append(values["euler_rhs"])
        return System(
            np.concatenate(rows),
            np.concatenate(columns),
            np.concatenate(entries),
            np.concatenate(rhs),
            np.concatenate(free),
        )


@dataclasses.dataclass(frozen=True)
class System:
    """A symmetric linear system: entries of its matrix, right-hand side, and which unknowns are free to move.

    Unknown 3 i + k is velocity k of node i; behind them, with sliding, unknown 3 nodes + 2 i + d its rate along d.
    """

    rows: np.ndarray
    columns: np.ndarray
    entries: np.ndarray
    rhs: np.ndarray
    free: np.ndarray

    def dense(self) -> np.ndarray:
        """The matrix, as a dense array."""
        result = np.zeros((len(self.rhs), len(self.rhs)))
        np.add.at(result, (self.rows, self.columns), self.entries)
        return result


class _Visit:
    """Another state for as long as a block lasts; the arrays that a step works with are free for it."""

    def __init__(self, simulator: Simulator, state: State | None):
        self.simulator = simulator
        self.visited = None if state is None else state.checked(simulator.scene.cloth.nodes)

    def __enter__(self) -> None:
        if self.visited is not None:
            self.home = self.simulator.state
            self.simulator._check_order(self.visited)
            self.simulator._upload(self.visited)

    def __exit__(self, *_: object) -> None:
        if self.visited is not None:
            self.simulator._upload(self.home)
