"""The simulator: runs a scene, keeps its frames, and lets one look into a state."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
import sys
import threading
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import tqdm
import warp as wp

from ..description.scene import Scene
from ..device.arrays import STATE_TYPES, YARN_PARAMETERS
from ..device.exclusive import ALONE, compiling, refuse_recording, uninterrupted
from ..device.model import Graphs, Model
from ..errors import InputError, SimulationError, choice, number, whole
from ..integrators import INTEGRATORS
from ..kernels.core import status
from .contacts import Contacts, contacts_of
from .linear_system import System, gather
from .state import CLOTH_NUMBERS, FIELDS, State, Trajectory
from .substepping import Parts

CHUNK_BYTES = 1 << 24
"""Room for frames on the device: enough that copying them out costs nothing, little enough for a large cloth."""

FRAME_BYTES = 13 * 8
"""Of a node's numbers in a frame."""

LARGEST = 2**31 - 1
"""Of what kernels count."""

LEDGER = ("bounds", "steps_to_audit", "audit_due", "alert", "outer_force")
"""Arrays of the watch over energy that one step leaves to the next."""


def _alone(method: Callable) -> Callable:
    """Lets a method launch and copy: one thread at a time, on a simulator that no exception has left half done."""

    @functools.wraps(method)
    def alone(self: Simulator, *arguments: Any, **options: Any) -> Any:
        with self.lock, ALONE, compiling():
            refuse_recording(self.model.device)
            self._settle()
            return method(self, *arguments, **options)

    return alone


PARAMETERS = (
    *YARN_PARAMETERS,
    *CLOTH_NUMBERS,
    "gravity",
    "wind_velocity",
    "wind_density",
    "wind_drag",
    "pin_stiffness",
    "pin_target",
    "pin_target_path",
    "applied_force",
    "applied_force_path",
)
"""Arrays that hold what a scene says, and that the simulator's owner may change."""


class Simulator:
    """Simulates a scene.

    Threads may share one, and simulators may run in several threads: each call is as if it were alone. After an
    exception, Ctrl-C too, a simulator is at the last step that was finished, ``trajectory`` has the frames until there,
    and it can go on.

    A simulator answers by its state, ``steps_done`` and parameters, whatever was asked of it before; with
    ``step_error`` also by the size that the last part of a step had, which a new state resets.

    Args:
        scene: the scene.
        step: h, time step [s], above 0.
        integrator: the method, by its name: "sdirk2" (order 2, strongly damped), "linear" (eq. 2 of the paper, order
            1), "implicit-euler" (order 1), "implicit-midpoint" (order 2, undamped) or "ros2" (order 2, for short
            steps); see ``warp_yarn/integrators``.
        device: a Warp device, such as "cpu" or "cuda:0".
        precision: "double" or "single".
        preconditioner: of the conjugate gradient, a file of ``kernels/linear`` each: "multilevel", "incomplete" or
            "jacobi" (the diagonal); None: "multilevel" where yarns are stiff for their mass and the step,
            k_s h²/(m L) > 2e4, or > 3 where they slide and friction's damping is less than 10 h k_s/L, else
            "incomplete".
        tolerance: of the conjugate gradient: √(r·P⁻¹r) relative to its start, which is the present velocities or 0,
            P the preconditioner; None: 1e-6, and 1e-8 where differentiable; in single precision 1e-4. In implicit
            stages it is that of the adjoint's solves alone.
        newton_tolerance: of an implicit stage: what is left of the velocities to find, relative to their change in the
            step, as √ of kinetic energies (``docs/solver.md``); None: 2e-2, less where the step resolves the yarns'
            stretching, as its square, and where yarns are stiff, down to 2e-4; and 1e-8 where differentiable.
        max_iterations: of the conjugate gradient, from 1 to 2³¹ − 1; None: as many as there are degrees of freedom, and
            1000 at least.
        threads: processor cores for the linear solves of a cloth; they wait for each other by spinning, so no more than
            are free: a RuntimeWarning says where there are not so many. They pay on large cloths
            (``benchmarks/bandwidth.py``).
        step_error: how far any node may be put wrong in a part of a step, in spacings of the yarns; each step is then
            made in as many parts as that takes, and ``step`` is the time from frame to frame. For "sdirk2", whose
            stages tell its error. None: steps are made at once.
        energy_watch: whether a step that gains energy from nowhere is made again, and ends the run where that does not
            help (``docs/solver.md``). False is for who wants a method as it is, such as the paper's eq. 2.
        chunk: steps whose frames the device keeps at a time; None: as many as take 16 MB, at most 64.
        differentiable: whether to compile reverse mode too, for gradients; ``warp_yarn.torch`` asks for it.

    Attributes:
        state: the present state, as a copy; set it to start from another one. ``steps_done`` stays as it is then.
        steps_done: steps since the beginning, by which moving pins and applied forces are looked up; set it where a
            state is one that was saved after so many steps.
        trajectory: the frames of the last run, where an exception ended it, as long as the state is the last of them;
            else None.
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
        energy_watch: bool = True,
        chunk: int | None = None,
        differentiable: bool = False,
    ):
        method: Any = INTEGRATORS[choice("integrator", integrator, INTEGRATORS)]
        if max_iterations is not None:
            whole("max_iterations", max_iterations, least=1, most=LARGEST)
        self.step_error = None if step_error is None else number("step_error", step_error, above=0.0)
        if step_error is not None:
            if differentiable:
                raise InputError("step_error with differentiable: gradients go back through whole steps; leave one out")
            if method.local_error is None:
                able = ", ".join(repr(name) for name, other in INTEGRATORS.items() if other.local_error is not None)
                raise InputError(f"step_error with integrator = {integrator!r}: only {able} estimates its error")
        if isinstance(scene, Scene) and (scene.obstacles or scene.self_contact) and not method.keeps_clear:
            able = ", ".join(repr(name) for name, other in INTEGRATORS.items() if other.keeps_clear)
            raise InputError(
                f"integrator = {integrator!r} with contact: a step may end inside something; must be one of {able}"
            )
        self._options = {
            "step": step,
            "integrator": integrator,
            "precision": precision,
            "preconditioner": preconditioner,
            "tolerance": tolerance,
            "newton_tolerance": newton_tolerance,
            "max_iterations": max_iterations,
            "threads": threads,
            "step_error": step_error,
            "energy_watch": energy_watch,
            "chunk": chunk,
            "differentiable": differentiable,
        }
        self.lock = threading.RLock()
        """Held while one thread uses the simulator; before ``exclusive.ALONE`` where both are."""
        with ALONE, compiling():
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
            self.model.watches = self.model.watches and bool(energy_watch)
            refuse_recording(self.model.device)
            self._options["device"] = str(self.model.device)
            self.scene, self.arrays, self.step_size = scene, self.model.arrays, self.model.step_size
            self.integrator = method(self.model)
            if step_error is not None:
                self.integrator.estimate_errors()
            fallback = None if method.fallback is None else lambda: INTEGRATORS[method.fallback](self.model)
            allowed = self.step_error and self.step_error * scene.cloth.spacing
            self.parts = Parts(self.model, self.integrator, allowed, fallback)
            self.chunk = _checked_chunk(chunk, scene.cloth.nodes)
            self.arrays.add_frames(self.chunk + 1)
            self._graphs = Graphs(self.model.device)
            self._steps_done = 0
            self.split_steps: dict[int, float] = {}
            self.damped_steps: set[int] = set()
            self._chunk: int | None = None
            """Steps done when the chunk began that is being made, and None where none is: frames on the device."""
            self._step_in_parts: _StepInParts | None = None
            self._team = contextlib.ExitStack()
            """Ends the helpers of a chunk."""
            self._owed: Callable[[], None] | None = None
            """Puts the device into the state that it ought to have; None: it has it."""
            self._recording: _Recording | None = None
            # unchecked: the cloth was, and copies of large ones would be the most memory that a run takes
            self._upload(self._rest())
            self._check_clear()
        cores = _cores()
        if threads > cores:
            warnings.warn(
                f"threads = {threads}, but there are {cores} processor cores at hand: they will wait for each other",
                RuntimeWarning,
                stacklevel=2,
            )

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and pickles are simulators of the same scene and options, with the state and parameters of this."""
        with self.lock:
            values = {name: self.arrays[name].numpy().copy() for name in PARAMETERS if name in self.arrays}
            steps = (self.steps_done, dict(self.split_steps), set(self.damped_steps))
            rest = (self.state, *steps, self.parts.size, values)
        return _rebuilt, (type(self), self.scene, self._options, *rest)

    # -- state -------------------------------------------------------------------------------------------------------

    def _rest(self) -> State:
        cloth = self.scene.cloth
        euler, still = cloth.euler, np.zeros((cloth.nodes, 3))
        return State(cloth.position, euler, still, still[:, :2], anchor=euler)

    @_alone
    def reset(self) -> None:
        """Goes back to the beginning: at rest, before the first linear."""
        self._begin_from(self._rest(), 0)

    @property
    @_alone
    def state(self) -> State:
        """The present state, as a copy; setting it checks shapes, finiteness and that crossings are in order."""
        return self._state()

    @state.setter
    @_alone
    def state(self, state: State) -> None:
        state = _checked(state, self.scene.cloth.nodes)
        self._check_order(state)
        self._check_clear(state)
        self._begin_from(state)

    def _state(self) -> State:
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

    @property
    @_alone
    def steps_done(self) -> int:
        """Steps since the beginning."""
        return self._steps_done

    @steps_done.setter
    @_alone
    def steps_done(self, steps: int) -> None:
        steps = whole("steps_done", steps, least=0, most=LARGEST)
        if self._recording is not None:
            self._recording.open = False
        # pins may be elsewhere then, which is no gain of energy
        self._owed = self.model.forget_energy
        self._pay()
        self._steps_done = steps

    @property
    @_alone
    def trajectory(self) -> Trajectory | None:
        """The frames of the last run where an exception ended it, the one that it started from first; None where none
        did, or where the state is no longer the last of them."""
        recording = self._recording
        if recording is None or not recording.open or recording.last != self._steps_done:
            return None
        return recording.trajectory.cut(recording.filled)

    # -- after exceptions --------------------------------------------------------------------------------------------

    def _begin_from(self, state: State, steps_done: int | None = None) -> None:
        """Takes another state in, or, after an exception, before anything else."""
        if self._recording is not None:
            self._recording.open = False

        def begin() -> None:
            self._upload(state)
            self.model.forget_energy()
            self.parts.size = 1.0
            if steps_done is not None:
                self._steps_done, self.split_steps, self.damped_steps = steps_done, {}, set()
                self.parts.reset()

        self._owed = begin
        self._pay()

    def _pay(self) -> None:
        if self._owed is not None:
            self._owed()
            self._owed = None

    def _settle(self) -> None:
        """Finishes or takes back what an exception left half done. It may come again meanwhile: then this begins
        anew."""
        self._end_team()
        if self._chunk is not None:
            self._close_chunk(self._chunk, self._frames_made())
        self._pay()

    def _frames_made(self) -> int:
        """How many steps of the chunk are whole."""
        if self._step_in_parts is not None:
            return self._step_in_parts.frame
        failed = int(self.arrays["status"].numpy()[2])
        return failed - 1 if failed else int(self.arrays["counters"].numpy()[0])

    def _close_chunk(self, base: int, made: int) -> None:
        """Ends a chunk after so many whole steps, and keeps its frames if a run asks for them."""
        parted = self._step_in_parts
        if parted is not None:
            self.parts.size, self.parts.made, self.parts.rejected, self.parts.damped = parted.parts
            self.split_steps.pop(base + parted.frame + 1, None)
            self.damped_steps.discard(base + parted.frame + 1)
            with ALONE:
                self.arrays.put("damps", 0)
                for name, value in parted.ledger.items():
                    self.arrays[name].assign(value)
        self.integrator.set_times(self.step_size, self.step_size)
        self._restore(made)
        self._keep_frames(base, made)
        self._steps_done = base + made
        self._chunk = self._step_in_parts = None

    def _restore(self, frame: int) -> None:
        """Puts the state of a frame of the chunk in place."""
        with ALONE:
            for name in FIELDS:
                if self.moves(name):
                    count = self.arrays[name].shape[0]
                    wp.copy(self.arrays[name], self.arrays[f"frame_{name}"], src_offset=frame * count, count=count)

    def _keep_frames(self, base: int, made: int) -> None:
        recording = self._recording
        if recording is not None and recording.open and base == recording.last:
            at = base - recording.first
            if at + made < len(recording.trajectory):
                self._copy_frames(recording.trajectory, at, made + 1)
                recording.filled = at + made + 1

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

    def _check_clear(self, state: State | None = None) -> None:
        """Refuses a state where cloth is nearer to an obstacle, or to itself, than it may come."""
        if self.scene.self_contact:
            with _Visit(self, state):
                pairs = self.model.report_pairs()
            least = float(self.arrays["self_contact_distance"].numpy()[0])
            if len(pairs.gap) and not pairs.gap.min() > least:
                k = int(pairs.gap.argmin())
                places = [self.scene.cloth.place(node) for node in (pairs.node[k], pairs.other[k])]
                raise InputError(
                    f"nodes {pairs.node[k]} and {pairs.other[k]} ({places[0]} and {places[1]}) are "
                    f"{pairs.gap[k]:.3g} m apart: must be above the contact's self_distance, {least:.3g} m"
                )
        if not self.scene.obstacles:
            return
        with _Visit(self, state):
            near = self.model.report_obstacles()
        least = float(self.arrays["contact_distance"].numpy()[0])
        if not near.gap.min() > least:
            at = int(near.gap.argmin())
            node, k = near.node[at], near.obstacle[at]
            raise InputError(
                f"node {node} ({self.scene.cloth.place(node)}) is {near.gap[at]:.3g} m from obstacles[{k}], a "
                f"{type(self.scene.obstacles[k]).__name__}: must be above the contact's distance, {least:.3g} m"
            )

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
        with self.lock:
            try:
                with ALONE, compiling():
                    refuse_recording(self.model.device)
                    self._settle()
                    if self.model.strips > 1:
                        uninterrupted(lambda: self._team.enter_context(self.model.team()))
                return self._make_chunk(steps)
            finally:
                self._end_team()

    def _make_chunk(self, steps: int) -> int:
        base = self._steps_done
        if base + steps > LARGEST:
            raise InputError(f"steps = {steps} after {base}, must end at step {LARGEST} at most")
        self.arrays.put("status", 0, 0, 0)
        self._count(0)
        self._graphs.run("record", lambda: self.model.launch("record", "nodes"))
        self._chunk = base
        made = 0
        while made < steps:
            if self.step_error is None:
                made += self._advance(steps - made)
            if made < steps and not self._make_in_parts(made):
                self._close_chunk(base, made)
                return made
            made = min(made + 1, steps)
        self._keep_frames(base, made)
        self._steps_done = base + made
        self._chunk = None
        return made

    def _end_team(self) -> None:
        if self.model.strips > 1:
            uninterrupted(self._team.close)

    def _count(self, frame: int) -> None:
        """Tells the device which frame of the chunk the present state is."""
        self.arrays.put("counters", frame, self._steps_done + frame)

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

    def _make_room(self) -> None:
        """Makes room for twice as many nodes near each: what was captured has the arrays of before."""
        with ALONE:
            self.arrays.make_near_room(2 * self.arrays["near_room"])
        self.integrator.forget_graphs()
        self.parts.forget_graphs()

    def _make_in_parts(self, frame: int) -> bool:
        """Makes the step after a frame of the chunk in parts; where that fails too, ``status`` says what it was."""
        ledger = {name: self.arrays[name].numpy().copy() for name in LEDGER if name in self.arrays}
        parts = self.parts
        self._step_in_parts = _StepInParts(frame, (parts.size, parts.made, parts.rejected, parts.damped), ledger)
        gained, damped = False, parts.damped
        while int(self.arrays["status"].numpy()[0]) == status.CROWDED:
            self._make_room()
            self._restore(frame)
            self.arrays.put("status", 0, 0, 0)
            self._count(frame)
            self.integrator.advance()
            if not self.arrays["status"].numpy()[0]:
                self._step_in_parts = None
                return True
        if self.step_error is None:
            # it could not be made at once
            gained = parts.can_damp and int(self.arrays["status"].numpy()[0]) in (status.GAINED, status.IMPACT)
            self._restore(frame)
            self.arrays.put("status", 0, 0, 0)
            parts.size = 1.0 if gained else 0.5
        smallest = parts.make(lambda: self._count(frame), gained=gained)
        self.integrator.set_times(self.step_size, self.step_size)
        if not smallest:
            return False
        self._count(frame + 1)
        if self.step_error is None:
            self.split_steps[self._steps_done + frame + 1] = smallest * self.step_size
        if parts.damped > damped:
            self.damped_steps.add(self._steps_done + frame + 1)
        self._step_in_parts = None
        return True

    def run(self, steps: int, *, progress: bool | None = False) -> Trajectory:
        """Makes steps and returns every frame, the present one first.

        Args:
            steps: how many, at least 0.
            progress: whether to show a progress bar on stderr; None: where that is a terminal.

        Raises:
            InputError: more steps than the memory holds frames of.
            SimulationError: where a step cannot be made; it has the frames before it, and the simulator stays at the
                last of them. After this or another exception, Ctrl-C too, ``trajectory`` has them.
        """
        steps = whole("steps", steps, least=0)
        with self.lock:
            trajectory, done = self._begin_recording(steps), 0
            with _bar(steps, progress) as bar:
                while done < steps:
                    asked = min(self.chunk, steps - done)
                    made = self.run_chunk(asked)
                    done += made
                    if bar is not None:
                        bar.set_description("simulating", refresh=False)
                        bar.update(made)
                    if made < asked:
                        self.fail(done + 1, trajectory.cut(done + 1))
            self._recording = None
        return trajectory

    @_alone
    def _begin_recording(self, steps: int) -> Trajectory:
        try:
            trajectory = self._room(steps + 1, self._steps_done)
        except (MemoryError, ValueError) as error:
            size = (steps + 1) * FRAME_BYTES * self.scene.cloth.nodes / 2**30
            raise InputError(f"steps = {steps}, whose frames take {size:.3g} GiB, more than there is") from error
        self._recording = _Recording(trajectory, self._steps_done)
        return trajectory

    def _room(self, frames: int, start: int) -> Trajectory:
        """A trajectory that holds the present state in its first frame, and in all of what does not change."""
        present, values = self._state(), {}
        for name in FIELDS:
            first = getattr(present, name)
            values[name] = np.empty((frames, *first.shape))
            values[name][: 1 if self.moves(name) else frames] = first
        return Trajectory(self.scene.cloth, self.step_size, **values, scene=self.scene, start=start)

    def _copy_frames(self, trajectory: Trajectory, at: int, count: int) -> None:
        """Copies the first frames of the chunk on the device to where they belong."""
        for name in FIELDS:
            if self.moves(name):
                kept = self.arrays[f"frame_{name}"].numpy().reshape(self.chunk + 1, self.scene.cloth.nodes, -1)
                origin = self.arrays.origin if name == "position" else 0.0
                getattr(trajectory, name)[at : at + count] = kept[:count] + origin

    @_alone
    def chunk_trajectory(self, frames: int) -> Trajectory:
        """The first frames of the chunk that the device holds."""
        trajectory = self._room(frames, self._steps_done - frames + 1)
        self._copy_frames(trajectory, 0, frames)
        return trajectory

    def moves(self, name: str) -> bool:
        """Whether this part of the state changes in this scene."""
        return self.arrays[name] is not None and (name != "euler" or self.scene.sliding)

    @_alone
    def fail(self, k: int, trajectory: Trajectory) -> None:
        """Says what happened after the last good frame, at which the state is."""
        code, node = (int(value) for value in self.arrays["status"].numpy()[:2])
        residual = float(self.arrays["residual"].numpy()[0])
        iterations = int(self.arrays["iterations"].numpy()[0])
        self.arrays.put("status", 0, 0, 0)
        term = self._blame(node)
        where = f"step {k} (t = {k * self.step_size:g} s):"
        if node >= 0:
            where += f" at node {node} ({self.scene.cloth.place(node)})"
        smallest = self.parts.tried * self.step_size
        what = {
            status.NOT_FINITE: "a value is not finite",
            status.ORDER_LOST: "Δs to the next crossing of the yarn reached 0",
            status.NOT_CONVERGED: (
                f"the solver stopped after {iterations} iterations at a residual of {residual:.1e}, "
                f"above its tolerance of {self.model.tolerance:.1e}"
            ),
            status.STALLED: (
                f"Newton's iteration stopped at a residual of {residual:.1e}, "
                f"above its tolerance of {self.model.newton_tolerance_at(smallest):.1e}"
            ),
            status.GAINED: "the cloth gains energy that nothing gave it: take a shorter step or another integrator",
            status.OVERLAPPING: "it is pressed into an obstacle that leaves it no way out",
            status.CROWDED: "more of it comes together than there is room for",
            status.IMPACT: "something strikes it",
            status.INACCURATE: f"its error stays above step_error = {self.step_error}: allow more",
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

    def _blame(self, node: int) -> str | None:
        """The term with the largest, or a not finite, force on a node; on all of them where node is -1."""
        size = {}
        with np.errstate(all="ignore"):
            forces = self.forces()
        for name, (force, euler_force) in forces.items():
            at = node if node >= 0 else slice(None)
            total = float(np.abs(force[at]).sum() + np.abs(euler_force[at]).sum())
            size[name] = total if np.isfinite(total) else np.inf
        return max(size, key=lambda name: size[name], default=None)

    # -- to look into ------------------------------------------------------------------------------------------------

    @_alone
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

    @_alone
    def contact(self, state: State | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Contact normal, from warp to weft [nodes, 3], and contact force F_n [nodes] (N), eq. 3; 0 on the border."""
        if not self.arrays.contact:
            raise InputError("this scene has no contact: neither 'shear' nor 'friction' is among its terms")
        with _Visit(self, state):
            self.model.press()
            load = self.arrays["contact_load"].numpy().astype(np.float64)
            return self.arrays["normal"].numpy().astype(np.float64), np.maximum(load, 0.0)

    @_alone
    def contacts(self, state: State | None = None) -> Contacts:
        """Where nodes touch obstacles and each other (None: in the present state)."""
        found = []
        with _Visit(self, state):
            position = self.arrays["position"].numpy() + self.arrays.origin
            if self.scene.obstacles:
                found.append(self.model.report_obstacles())
            if self.scene.self_contact:
                found.append(self.model.report_pairs())
        return contacts_of(found, position)

    @_alone
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
                    name = "contact" if term.touches else term.name
                    result[name] = result.get(name, 0.0) + float(energy.numpy()[0])
        return result

    @_alone
    def system(self, state: State | None = None, weights: tuple[float, float, float] | None = None) -> System:
        """The linear system of the next step of eq. 2, to look into.

        Args:
            state: of the step's beginning; None: the present one.
            weights: factors of M, D and H in its matrix; None: 1, h and h².
        """
        h = self.step_size
        with _Visit(self, state, ahead=True):
            self.arrays.put("weights", *(weights or (1.0, h, h * h)))
            self.model.assemble()
            return gather(self.model)


class _Visit:
    """Another state for as long as a block lasts; the arrays that a step works with are free for it.

    Pins and applied forces are those of the last step, or, if asked for, of the next one.
    """

    def __init__(self, simulator: Simulator, state: State | None, *, ahead: bool = False):
        self.simulator = simulator
        self.ahead = ahead
        self.row = simulator._steps_done if ahead else max(0, simulator._steps_done - 1)
        self.visited = None if state is None else _checked(state, simulator.scene.cloth.nodes)

    def __enter__(self) -> None:
        simulator, home = self.simulator, {}
        if self.visited is not None:
            simulator._check_order(self.visited)
            home = {name: simulator.arrays[name].numpy().copy() for name in FIELDS if simulator.moves(name)}

        def go_home() -> None:
            for name, value in home.items():
                simulator.arrays[name].assign(value)
            simulator.integrator.set_times(simulator.step_size, simulator.step_size)

        simulator._owed = go_home
        simulator.arrays.put("counters", 0, self.row)
        # before the first step, pins are where they start
        simulator.arrays.put("stage_times", *[float(self.ahead or simulator._steps_done > 0)] * 4)
        simulator.model.take_inputs()
        if self.visited is not None:
            simulator._upload(self.visited)

    def __exit__(self, *_: object) -> None:
        self.simulator._pay()


@dataclasses.dataclass
class _Recording:
    """The frames of a run in the making.

    Args:
        first: steps done at frame 0.
        filled: frames that are there.
        open: whether the state is still what the last of them led to.
    """

    trajectory: Trajectory
    first: int
    filled: int = 1
    open: bool = True

    @property
    def last(self) -> int:
        """Steps done at its last frame."""
        return self.first + self.filled - 1


@dataclasses.dataclass(frozen=True)
class _StepInParts:
    """A step that is being made in parts.

    Args:
        frame: of the chunk, that it starts from.
        parts: size, made, rejected and damped of the parts before it.
        ledger: what the watch over energy had written down by then.
    """

    frame: int
    parts: tuple[float, int, int, int]
    ledger: dict[str, np.ndarray]


def _rebuilt(
    kind: type[Simulator],
    scene: Scene,
    options: dict[str, Any],
    state: State,
    steps_done: int,
    split_steps: dict[int, float],
    damped_steps: set[int],
    size: float,
    values: dict[str, np.ndarray],
) -> Simulator:
    """A simulator as another was when it was copied or pickled."""
    result = kind(scene, **options)
    with ALONE:
        for name, value in values.items():
            result.arrays[name].assign(value)
        result._upload(state)
    result._steps_done, result.split_steps, result.damped_steps = steps_done, split_steps, damped_steps
    result.parts.size = size
    return result


def _checked(state: Any, nodes: int) -> State:
    if not isinstance(state, State):
        raise InputError(f"state = {state!r}, must be a State")
    return state.checked(nodes)


def _checked_chunk(chunk: int | None, nodes: int) -> int:
    """Steps to a chunk: kernels count its nodes in 31 bits, and its frames have to be in memory."""
    if chunk is None:
        return min(64, max(1, CHUNK_BYTES // (FRAME_BYTES * nodes)))
    most = LARGEST // (2 * nodes) - 1
    with contextlib.suppress(AttributeError, ValueError, OSError):  # Windows does not tell
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        most = min(most, memory // (FRAME_BYTES * nodes) - 1)
    return whole("chunk", chunk, least=1, most=max(most, 1))


def _cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _bar(steps: int, progress: bool | None) -> contextlib.AbstractContextManager[tqdm.tqdm | None]:
    """A progress bar where one is wanted. Elsewhere there is none at all: tqdm's lock does not survive Ctrl-C."""
    if progress is None:
        progress = sys.stderr is not None and sys.stderr.isatty()
    return tqdm.tqdm(total=steps, unit="step", leave=False, desc="starting") if progress else contextlib.nullcontext()
