"""The simulator: runs a scene, keeps its frames, and lets one look into a state."""

from __future__ import annotations

from typing import Any

import numpy as np
import tqdm

from .arrays import STATE_TYPES
from .errors import InputError, SimulationError, choice, number, whole
from .integrators import INTEGRATORS
from .kernels import step
from .model import Model
from .parts import Parts
from .scene import Scene
from .state import FIELDS, State, Trajectory
from .system import System, gather

CHUNK_BYTES = 1 << 24
"""Room for frames on the device: enough that copying them out costs nothing, little enough for a large cloth."""


class Simulator:
    """Simulates a scene.

    Args:
        scene: the scene.
        step: h, time step [s], above 0.
        integrator: the method, by its name: "sdirk2" (order 2, strongly damped), "linear" (eq. 2 of the paper, order
            1), "implicit-euler" (order 1), "implicit-midpoint" (order 2, undamped) or "ros2" (order 2, for short
            steps); see ``warp_yarn/integrators``.
        device: a Warp device, such as "cpu" or "cuda:0".
        precision: "double" or "single".
        preconditioner: of the conjugate gradient: "multilevel" (``kernels/multilevel.py``), "incomplete"
            (``kernels/incomplete.py``) or "jacobi" (``kernels/solver.py``); None: "multilevel" where yarns are stiff for
            their mass and the step, k_s h²/(m L) > 2e4, or > 3 where they slide and friction's damping is less than
            10 h k_s/L, else "incomplete".
        tolerance: of the conjugate gradient: √(r·P⁻¹r) relative to its start, which is the present velocities or 0, P
            the preconditioner; None: 1e-6, and 1e-8 where differentiable; in single precision 1e-4. In implicit stages
            it is that of the adjoint's solves alone.
        newton_tolerance: of an implicit stage: what is left of the velocities to find, relative to their change in the
            step, as √ of kinetic energies (``decide`` in ``kernels/stage.py``); None: 1e-3 (less where the step resolves
            the yarns' stretching, as its square), and 1e-8 where differentiable.
        max_iterations: of the conjugate gradient; None: as many as there are degrees of freedom, and 1000 at least.
        threads: processor cores for the linear solves of a cloth; they wait for each other by spinning, so no more than
            are free. They pay on large cloths (``benchmarks/bandwidth.py``).
        step_error: how far any node may be put wrong in a part of a step, in spacings of the yarns; each step is then
            made in as many parts as that takes, and ``step`` is the time from frame to frame. For "sdirk2", whose
            stages tell its error. None: steps are made at once.
        chunk: steps whose frames the device keeps at a time; None: as many as take 16 MB, at most 64.
        differentiable: whether to compile reverse mode too, for gradients; ``warp_yarn.torch`` asks for it.

    Attributes:
        state: the present state; set it to start from another one.
        steps_done: steps since the beginning, by which moving pins and applied forces are looked up.
        split_steps: which of the steps since the beginning could not be made at once by the method, and their smallest
            part [s].
        damped_steps: those of them that gained energy, so that a method which damps made them, or parts of them.
        parts: what makes steps in parts; counts those that it made and rejected.
        arrays: the scene's arrays on the device, by the names that kernels use.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        step: float = 1e-3,
        integrator: str = "sdirk2",
        device: Any = "cpu",
        precision: str = "double",
        preconditioner: str | None = None,
        tolerance: float | None = None,
        newton_tolerance: float | None = None,
        max_iterations: int | None = None,
        threads: int = 1,
        step_error: float | None = None,
        chunk: int | None = None,
        differentiable: bool = False,
    ):
        method: Any = INTEGRATORS[choice("integrator", integrator, INTEGRATORS)]
        self.model = Model(
            scene,
            step=step,
            device=device,
            precision=precision,
            preconditioner=preconditioner,
            tolerance=tolerance,
            newton_tolerance=newton_tolerance,
            max_iterations=max_iterations,
            threads=threads,
            differentiable=differentiable,
        )
        self.scene, self.arrays, self.step_size = scene, self.model.arrays, self.model.step_size
        self.integrator = method(self.model)
        self.step_error = None if step_error is None else number("step_error", step_error, above=0.0)
        if step_error is not None:
            if differentiable:
                raise InputError("step_error with differentiable: gradients go back through whole steps; leave one out")
            if method.local_error is None:
                able = ", ".join(repr(name) for name, other in INTEGRATORS.items() if other.local_error is not None)
                raise InputError(f"step_error with integrator = {integrator!r}: only {able} estimates its error")
            self.integrator.estimate_errors()
        fallback = None if method.fallback is None else lambda: INTEGRATORS[method.fallback](self.model)
        allowed = self.step_error and self.step_error * scene.cloth.spacing
        self.parts = Parts(self.model, self.integrator, allowed, fallback)
        self.steps_done = 0
        self.split_steps: dict[int, float] = {}
        self.damped_steps: set[int] = set()
        fitting = min(64, max(1, CHUNK_BYTES // (13 * 8 * scene.cloth.nodes)))
        self.chunk = fitting if chunk is None else whole("chunk", chunk, least=1)
        self.arrays.add_frames(self.chunk + 1)
        # unchecked: the cloth was, and copies of large ones would be the most memory that a run takes
        self._upload(self._rest())

    # -- state -------------------------------------------------------------------------------------------------------

    def _rest(self) -> State:
        cloth = self.scene.cloth
        euler, still = cloth.euler, np.zeros((cloth.nodes, 3))
        return State(cloth.position, euler, still, still[:, :2], anchor=euler)

    @property
    def state(self) -> State:
        """The present state, as a copy; setting it checks shapes, finiteness and that crossings are in order."""
        nodes = self.scene.cloth.nodes
        values: dict[str, Any] = {}
        for name, width in STATE_TYPES.items():
            array = self.arrays[name]
            values[name] = None if array is None else array.numpy().reshape(nodes, width).astype(np.float64)
        values["position"] += self.arrays.origin
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
        self.model.forget_energy()

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
                if name == "position":
                    value = value - self.arrays.origin
                array.assign(value if array.dtype == self.arrays.variant.vec3 else value.ravel())

    # -- running -----------------------------------------------------------------------------------------------------

    def run_chunk(self, steps: int) -> int:
        """Makes at most ``chunk`` steps, into the frames on the device; the state is frame 0.

        Returns:
            How many steps were made; fewer than asked for where one failed (``arrays["status"]`` says how).
        """
        self._count(0)
        self.model.launch("record", "nodes")
        made = 0
        with self.model.team():
            while made < steps:
                if self.step_error is None:
                    made += self._advance(steps - made)
                if made < steps and not self._make_in_parts(made):
                    break
                made = min(made + 1, steps)
        self.steps_done += made
        return made

    def _count(self, frame: int) -> None:
        """Tells the device which frame of the chunk the present state is."""
        self.arrays.put("counters", frame, self.steps_done + frame)

    def _advance(self, steps: int) -> int:
        """Makes steps until one fails; how many were made."""
        status = self.arrays["status"].numpy() if self.model.device.is_cpu else np.zeros(1)
        first = int(self.arrays["counters"].numpy()[0])
        for _ in range(steps):
            self.integrator.advance()
            if status[0]:  # on the CPU the array itself; elsewhere looking would wait for every step
                break
        status = self.arrays["status"].numpy()
        return int(status[2]) - 1 - first if status[0] else steps

    def _make_in_parts(self, frame: int) -> bool:
        """Makes the step after a frame of the chunk in parts; where that fails too, ``status`` says what it was."""
        gained = False
        if self.step_error is None:
            # it could not be made at once
            self._upload(self._frame(frame))
            gained = self.parts.can_damp and self.arrays["status"].numpy()[0] == step.GAINED
            self.arrays.zero("status")
            self.parts.size = 1.0 if gained else 0.5
        damped = self.parts.damped
        smallest = self.parts.make(lambda: self._count(frame), gained=gained)
        self.integrator.set_times(self.step_size, self.step_size)
        if smallest:
            self._count(frame + 1)
            if self.step_error is None:
                self.split_steps[self.steps_done + frame + 1] = smallest * self.step_size
            if self.parts.damped > damped:
                self.damped_steps.add(self.steps_done + frame + 1)
        return smallest > 0.0

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
        """A trajectory that holds the present state in its first frame, and in all of what does not change."""
        start, values = self.state, {}
        for name in FIELDS:
            first = getattr(start, name)
            values[name] = np.empty((frames, *first.shape))
            values[name][: 1 if self.moves(name) else frames] = first
        return Trajectory(self.scene.cloth, self.step_size, **values)

    def _copy_frames(self, trajectory: Trajectory, at: int, count: int) -> None:
        """Copies the first frames of the chunk on the device to where they belong."""
        for name in FIELDS:
            if self.moves(name):
                kept = self.arrays[f"frame_{name}"].numpy().reshape(self.chunk + 1, self.scene.cloth.nodes, -1)
                getattr(trajectory, name)[at : at + count] = kept[:count]
        trajectory.position[at : at + count] += self.arrays.origin

    def _frame(self, k: int) -> State:
        """A frame of the chunk on the device."""
        return self.chunk_trajectory(k + 1)[k]

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
        where = f"step {k} (t = {k * self.step_size:g} s):"
        if node >= 0:
            where += f" at node {node} (row {node // columns}, column {node % columns})"
        smallest = self.parts.tried * self.step_size
        what = {
            step.NOT_FINITE: "a value is not finite",
            step.ORDER_LOST: "Δs to the next crossing of the yarn reached 0",
            step.NOT_CONVERGED: (
                f"the solver stopped after {iterations} iterations at a residual of {residual:.1e}, "
                f"above its tolerance of {self.model.tolerance:.1e}"
            ),
            step.STALLED: (
                f"Newton's iteration stopped at a residual of {residual:.1e}, "
                f"above its tolerance of {self.model.newton_tolerance_at(smallest):.1e}"
            ),
            step.GAINED: "the cloth gains energy that nothing gave it: take a shorter step or another integrator",
            step.INACCURATE: f"its error stays above step_error = {self.step_error}: allow more",
        }[code]
        raise SimulationError(
            f"{where} {what}. The largest term {'there ' if node >= 0 else ''}is {term!r}. "
            f"It was tried in parts as small as {smallest:.1e} s; "
            f"the {len(trajectory)} frames before are in this error's trajectory",
            step=k,
            node=node,
            term=term,
            trajectory=trajectory,
        )

    def _blame(self, state: State, node: int) -> str | None:
        """The term with the largest, or a not finite, force on a node; on all of them where node is -1."""
        size = {}
        with np.errstate(all="ignore"):
            forces = self.forces(state)
        for name, (force, euler_force) in forces.items():
            at = node if node >= 0 else slice(None)
            total = float(np.abs(force[at]).sum() + np.abs(euler_force[at]).sum())
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
            self.model.press()
            total = np.zeros(2 * nodes)
            for term in a.terms:
                if term.name == "mass":
                    continue
                a.zero("force", "euler_force", "friction_force_out")
                if term.name == "friction":
                    a["euler_force"].assign(total)
                self.model.launch(term.name, term.elements, matrix=0, press=0)
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
            self.model.press()
            load = self.arrays["contact_load"].numpy().astype(np.float64)
            return self.arrays["normal"].numpy().astype(np.float64), np.maximum(load, 0.0)

    def energy(self, state: State | None = None) -> dict[str, float]:
        """Energy of every term that has one [J], by name; ``mass`` is the kinetic energy."""
        a, result = self.arrays, {}
        with _Visit(self, state):
            self.model.press()
            energy = a.zeros(1, a.variant.scalar)
            for term in a.terms:
                if term.energy is not None:
                    energy.zero_()
                    self.model.launch(f"{term.name}_energy", term.elements, energy=energy)
                    result[term.name] = float(energy.numpy()[0])
        return result

    def system(self, state: State | None = None, weights: tuple[float, float, float] | None = None) -> System:
        """The linear system of the next step of eq. 2, to look into.

        Args:
            state: of the step's beginning; None: the present one.
            weights: factors of M, D and H in its matrix; None: 1, h and h².
        """
        h = self.step_size
        with _Visit(self, state):
            self.arrays.put("weights", *(weights or (1.0, h, h * h)))
            self.model.assemble()
            system = gather(self.model)
        self.integrator.set_times(h, h)
        return system


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
