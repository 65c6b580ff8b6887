"""The simulator: runs a scene, keeps its frames, and lets one look into a state."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from ..description.sanity import warn_of_rounding
from ..description.scene import Scene
from ..device.exclusive import ALONE, compiling, refuse_recording
from ..device.memory import go_on, memory
from ..device.model import Model
from ..errors import InputError, choice, flag, integer
from ..integrators import INTEGRATORS
from ..kernels import parameters
from ..moved import renamed_attribute
from .alone import alone
from .checks import (
    LARGEST,
    check_contact,
    check_sliding_crimp,
    checked_chunk,
    checked_state,
    checked_step_error,
    warn_of_threads,
)
from .diagnosis import Failure
from .film import DECIDING, Filming, bar
from .frames import Frames
from .loads import Loads
from .pace import Pace, every_of
from .state import State, Trajectory
from .stepper import Stepper
from .substepping import Substepping

BESIDE_TERMS = (
    *("spacing", "radius", "pin_target", "pin_target_path", "applied_force", "applied_force_path"),
    *("gravity_path", "wind_velocity_path"),
    *("obstacle_position", "obstacle_rotation"),
)
"""Arrays that hold what a scene says beside the parameters of terms; the simulator's owner may change both."""


def _of_stepper(name: str) -> Any:
    """Makes the property by which a simulator has what its stepper has."""
    return property(
        lambda self: getattr(self.stepper, name),
        lambda self, value: setattr(self.stepper, name, value),
        doc=f"``{name}`` of the stepper.",
    )


class Simulator(Loads, Filming):
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
            1), "implicit-euler" (order 1), "implicit-midpoint" (order 2, undamped), "ros2" (order 2, for short steps)
            or "esdirk3" (order 3, for real fabrics without contact); see ``warp_yarn/integrators``.
        device: a Warp device, such as "cpu" or "cuda:0".
        precision: "double" or "single".
        preconditioner: of the conjugate gradient, a file of ``kernels/linear`` each: "multilevel", "incomplete" or
            "jacobi" (the diagonal); None: "multilevel" where yarns are stiff for their mass and the step,
            k_s h²/(m L) > 2e4, or > 3 where they slide and friction's damping is less than 10 h k_s/L, else
            "incomplete". "multilevel" solves neighbouring yarns together where they hardly stretch at all.
        tolerance: of the conjugate gradient: √(r·P⁻¹r) relative to its start, which is the present velocities or 0,
            P the preconditioner; None: 1e-6, and 1e-8 where differentiable; in single precision 1e-4. In implicit
            stages it is that of the adjoint's solves alone.
        newton_tolerance: of an implicit stage: what is left of the velocities to find, relative to their change in the
            step (beside the mass centre's, of a cloth that nothing holds), as √ of kinetic energies
            (``docs/solver.md``); None: 2e-2, less where the step resolves the yarns' stretching, as its square, and
            where yarns are stiff, down to 2e-5, in single precision 2e-3; and 1e-8 where differentiable.
        max_iterations: of the conjugate gradient, from 1 to 2³¹ − 1; None: as many as there are degrees of freedom, and
            1000 at least.
        threads: processor cores for the linear solves of a cloth; they wait for each other by spinning, so no more than
            are free: a RuntimeWarning says where there are not so many. They pay on large cloths
            (``benchmarks/bandwidth.py``).
        step_error: how far any node may be put wrong in a part of a step, in the least spacing of yarns; each step is
            then made in as many parts as that takes, and ``step`` is the time from frame to frame. For "sdirk2", whose
            stages tell its error. None: steps are made at once.
        energy_watch: whether a step that gains energy from nowhere is made again, and ends the run where that does not
            help (``docs/solver.md``). False is for who wants a method as it is, such as the paper's eq. 2.
        chunk: steps whose frames the device keeps at a time; None: as many as take 16 MB, at most 64; 1 with a hook.
        differentiable: whether to compile reverse mode too, for gradients; ``warp_yarn.torch`` asks for it.
        hook: called with the simulator before each step, in whatever way it is run; it may read all and ``set_inputs``.

    Attributes:
        state: the present state, as a copy; set it to start from another one. ``steps_done`` stays as it is then.
        steps_done: steps since the beginning, by which moving pins and applied forces are looked up; set it where a
            state is one that was saved after so many steps.
        trajectory: the frames of the last run where an exception ended it and the state is the last of them, or None.
        split_steps: which of the steps since the beginning could not be made at once by the method, and their smallest
            part [s].
        damped_steps: those of them that gained energy, so that a method which damps made them, or parts of them.
        substepping: what makes steps in parts; counts those that it accepted and rejected.
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
        hook: Callable[[Simulator], None] | None = None,
    ):
        self._options = {
            "step": step, "integrator": integrator, "device": device, "precision": precision, "threads": threads,
            "preconditioner": preconditioner, "tolerance": tolerance, "newton_tolerance": newton_tolerance,
            "max_iterations": max_iterations, "step_error": step_error, "energy_watch": energy_watch, "chunk": chunk,
            "differentiable": differentiable, "hook": hook,
        }  # fmt: skip
        self.lock = threading.RLock()
        """Held while one thread uses the simulator; before ``exclusive.ALONE`` where both are."""
        with ALONE, compiling():
            self.stepper = _made(self, scene, **self._options)
            self.scene, self.model, self.integrator = scene, self.stepper.model, self.stepper.integrator
            self.arrays, self.substepping = self.model.arrays, self.stepper.substepping
            self.chunk, self.step_size = self.stepper.frames.chunk, self.model.step_size
            self.step_error = None if step_error is None else float(step_error)
            self._options["device"] = str(self.model.device)
            self.stepper.frames.options = {name: self._options[name] for name in DECIDING}
        self.check_clear()
        warn_of_threads(threads)
        if precision == "single":
            warn_of_rounding(scene.cloth)

    parts = renamed_attribute("parts", "substepping")

    def __reduce__(self) -> tuple[Any, ...]:
        """Makes copies and pickles simulators of the same scene and options, with the state and parameters of this."""
        with self.lock:
            names = [name for name in (*BESIDE_TERMS, *parameters()) if name in self.arrays]
            values = {name: self.arrays[name].numpy().copy() for name in names}
            steps = (self.steps_done, dict(self.split_steps), set(self.damped_steps))
            rest = (self.state, *steps, self.substepping.next_size, values, memory(self.model))
        return _rebuilt, (type(self), self.scene, self._options, *rest)

    @alone
    def reset(self) -> None:
        """Goes back to the beginning: at rest, before the first step."""
        self.stepper.begin_from(self.stepper.frames.rest(), 0)

    @property
    @alone
    def state(self) -> State:
        """The present state, as a copy; setting it checks shapes, finiteness and that crossings are in order."""
        return self.stepper.frames.state()

    @state.setter
    @alone
    def state(self, state: State) -> None:
        state = checked_state(state, self.scene)
        self.check_clear(state)
        self.stepper.begin_from(state)

    @property
    @alone
    def steps_done(self) -> int:
        """Steps since the beginning."""
        return self.stepper.steps_done

    @steps_done.setter
    @alone
    def steps_done(self, steps: int) -> None:
        self.stepper.count_from(integer("steps_done", steps, least=0, most=LARGEST))

    split_steps = _of_stepper("split_steps")
    damped_steps = _of_stepper("damped_steps")

    def run_chunk(self, steps: int) -> int:
        """Makes at most ``chunk`` steps, into the frames on the device; the state is frame 0.

        Returns:
            How many steps were made; fewer than asked for where one failed (``arrays["status"]`` says how).
        """
        integer("steps", steps, least=0, most=self.chunk)
        with self.lock:
            return self.stepper.make_chunk(steps)

    @alone
    def fail(self, k: int, trajectory: Trajectory) -> None:
        """Says what happened after the last good frame, at which the state is."""
        failure = Failure(self.model)
        with np.errstate(all="ignore"):
            forces, near = self.forces(), self.told_nearest(failure.node)
        raise failure.error(k, trajectory, forces, self.substepping, self.step_error, near)

    def run(
        self,
        steps: int | None = None,
        *,
        seconds: float | None = None,
        fps: float | None = None,
        progress: bool | None = False,
    ) -> Trajectory:
        """Makes steps and returns their frames, the present one first.

        Args:
            steps: how many, at least 0; or
            seconds: how long, at least 0: as many steps as it takes to get there.
            fps: frames in a second of simulated time, at most one a step; None: one a step. Frame k is at k / fps:
                where that is between two steps, on the straight line between their states.
            progress: whether to show a progress bar on stderr; None: where that is a terminal.

        Raises:
            InputError: an argument is out of its range, or more frames than the memory holds.
            SimulationError: where a step cannot be made; it has the frames before it, and the simulator stays at the
                last step. After this or another exception, Ctrl-C too, ``trajectory`` has them.
        """
        with self.lock:
            pace, done = Pace.of(self.step_size, steps, seconds, every_of(fps, self.step_size)), 0
            self._record(pace)
            with bar(pace.steps, progress) as shown:
                while done < pace.steps:
                    asked = min(self.chunk, pace.steps - done)
                    made = self.run_chunk(asked)
                    done += made
                    if shown is not None:
                        shown.set_description("simulating", refresh=False)
                        shown.update(made)
                    if made < asked:
                        self.fail(done + 1, self.trajectory)
            trajectory = self.trajectory
            self.stepper.frames.recording = None
        return trajectory


def _made(
    simulator: Simulator,
    scene: Scene,
    *,
    integrator: str,
    step_error: float | None,
    energy_watch: bool,
    chunk: int | None,
    differentiable: bool,
    hook: Any,
    max_iterations: int | None,
    **options: Any,
) -> Stepper:
    """Makes what makes the steps of a scene at rest, by options of the Simulator."""
    method: Any = INTEGRATORS[choice("integrator", integrator, INTEGRATORS)]
    if max_iterations is not None:
        integer("max_iterations", max_iterations, least=1, most=LARGEST)
    energy_watch, differentiable = flag("energy_watch", energy_watch), flag("differentiable", differentiable)
    step_error = checked_step_error(step_error, integrator, differentiable)
    check_contact(scene, integrator)
    check_sliding_crimp(scene, integrator)
    if hook is not None and not callable(hook):
        raise InputError(f"hook = {hook!r}, must be a function of the simulator, or None")
    hooked = hook is not None
    model = Model(scene, max_iterations=max_iterations, differentiable=differentiable, hooked=hooked, **options)
    model.energy.on = model.energy.on and energy_watch
    model.contact.damps_impacts = energy_watch
    refuse_recording(model.device)
    at_once = method(model)
    if step_error is not None:
        at_once.estimate_errors()
    fallback = None if method.fallback is None else lambda: INTEGRATORS[method.fallback](model)
    substepping = Substepping(model, at_once, step_error and step_error * scene.cloth.shortest_spacing, fallback)
    frames = Frames(model, checked_chunk(chunk, scene.cloth.nodes, one=hooked or bool(model.inputs.functions)))
    # unchecked: the cloth was, and copies of large ones would be the most memory that a run takes
    frames.upload(frames.rest())
    stepper = Stepper(model, at_once, substepping, frames)
    stepper.before_step = None if hook is None else lambda: hook(simulator)
    return stepper


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
    watched: dict[str, np.ndarray],
) -> Simulator:
    """Makes a simulator as another was when it was copied or pickled."""
    result = kind(scene, **options)
    with ALONE:
        for name, value in values.items():
            result.arrays[name].assign(value)
        result.stepper.frames.upload(state)
        go_on(result.model, watched, steps_done)
    stepper = result.stepper
    stepper.steps_done, stepper.split_steps, stepper.damped_steps = steps_done, split_steps, damped_steps
    stepper.substepping.next_size = size
    return result
