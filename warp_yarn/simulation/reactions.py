"""What pins give to the cloth, and the work that is done on it, in steps that were made.

Neither costs a step anything: the stages of a step are found again from the frames at its two ends, as the adjoint
does, and assembled once more. What is left of a stage's equation at an exact pin is its reaction.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np

from ..description.sanity import GRAVITY
from ..device.declarations import FRAMES
from ..device.energy_watch import MEMORY
from ..device.model import Model
from ..errors import InputError, WarpYarnWarning
from ..integrators.made import Made, Point
from .inspection import Visit, with_room
from .state import State, Trajectory
from .stepper import Stepper

GIVES_WAY = 0.01
"""Of the way that a pin was moved: from where on a spring that falls short by so much turns what a test reads."""
REMADE = 1e-4
"""Of the cloth's size: how far a step in parts that is made again may end from where it did."""
ROUGH, SLACK, FOREIGN = 3e-2, 0.2, 0.7
"""How much an iteration more may change of what pins give, and of the cloth's change of velocity, without a warning;
and of either at all. Of steps as they were made, with Newton's default tolerance, it was 2 % and 16 % at most in
ordinary motion but for 5 % where pins stop at once, and 57 % of what pins give from states that no step resolves. Of
steps in parts that are taken for one, or of another method, it was 2 % where yarns are soft, and all where they are
stiff."""
EPSILON = {"double": 1e-15, "single": 1e-7}
"""Of positions: their rounding, with room in double precision."""


@dataclasses.dataclass(frozen=True)
class Part:
    """A part of a step, or all of one.

    Args:
        method: that made it.
        size: of the step.
        left: part of the step that was left when it began.
        before, after: the states at its ends.
    """

    method: Any
    size: float
    left: float
    before: State
    after: State


class Steps:
    """Looks into the steps of frames that a stepper's model made, or of the last step.

    Args:
        stepper: of the simulator.
        trajectory: the frames; None: the last step.

    Raises:
        InputError: no step was made since a state was set, or frames of another cloth or step, or not of every step.
    """

    def __init__(self, stepper: Stepper, trajectory: Trajectory | None):
        self.stepper, self.model = stepper, stepper.model
        scene = self.model.scene
        if self.model.zones is not None:
            raise InputError("contact.method is 'impact-zones', must be 'barrier': impact zones have no forces")
        if getattr(stepper.integrator, "made", None) is None:
            raise InputError(
                f"integrator = {stepper.integrator.name!r}, whose stages are not known from frames: must be another of "
                "the package's, or a StageMethod"
            )
        if trajectory is None:
            last = stepper.frames.last_step()
            if last is None:
                raise InputError(
                    "no step was made since the state was set, or an input that the last one had: run one, or give a "
                    "trajectory"
                )
            self.frames: Any = last
            self.start = stepper.steps_done - 1
        else:
            if not isinstance(trajectory, Trajectory):
                raise InputError(f"trajectory = {trajectory!r}, must be a Trajectory or None")
            if not trajectory.cloth.same_as(scene.cloth):
                raise InputError("trajectory.cloth is another one than that of the simulator")
            made = trajectory.scene
            if made is not None and not made.functions and not scene.functions and not made.same_as(scene):
                raise InputError("trajectory.scene is another one than that of the simulator: ask the one that made it")
            name = (trajectory.options or {}).get("integrator", stepper.integrator.name)
            if name != stepper.integrator.name:
                raise InputError(
                    f"trajectory was made by integrator = {name!r}, and this simulator's is "
                    f"{stepper.integrator.name!r}: ask one with that"
                )
            if self.model.inputs.hooked:
                raise InputError(
                    "trajectory with a hook, whose inputs are not known any more: ask for the last step, as in the hook"
                )
            if trajectory.every != 1 or trajectory.start != round(trajectory.start):
                raise InputError(
                    f"trajectory.every = {trajectory.every:g}, must be 1, with a frame of every step: run without fps, "
                    "and take no stride"
                )
            if trajectory.step != self.model.step_size:
                raise InputError(f"trajectory.step = {trajectory.step:g}, must be {self.model.step_size:g}")
            self.frames, self.start = trajectory, round(trajectory.start)
        self.only, self._warned = trajectory is None, False

    def __len__(self) -> int:
        return len(self.frames) - 1

    def shaped(self, values: np.ndarray) -> np.ndarray:
        """Gives what was found of each step; of the last step alone without an axis of steps."""
        return values[0] if self.only else values

    def visit(self, k: int, state: State) -> Visit:
        """Visits a state for as long as a block lasts, with the inputs of step k."""
        return Visit(self.stepper, state, row=self.start + k, begun=self.frames[k].position)

    def speed(self, part: Part, made: Made) -> float:
        """Gives the root mean square of how much a stage changes velocities of nodes, or their weight does [m/s]."""
        change = np.linalg.norm(made.solution[:, :3] - part.before.velocity) / np.sqrt(len(made.solution))
        return max(float(change), GRAVITY * part.size * self.model.step_size)

    def parts(self, k: int) -> list[Part]:
        """Finds the parts that step k was made in: one, where it was made at once; none, with a warning to the caller's
        caller, where those of before cannot be made again."""
        stepper, step = self.stepper, self.start + k + 1
        if stepper.substepping.allowed is None and step not in stepper.split_steps:
            return [Part(stepper.integrator, 1.0, 1.0, self.frames[k], self.frames[k + 1])]
        ways = [(False, 0.5), (True, 1.0)] if stepper.substepping.allowed is None else [(False, 1.0)]
        near = stepper.substepping.allowed or REMADE * float(np.ptp(self.frames[k].position, axis=0).max())
        for gained, size in ways[:: -1 if step in stepper.damped_steps else 1]:
            with self.visit(k, self.frames[k]):
                parts = remade(stepper, gained=gained, size=size)
            if parts and np.abs(parts[-1].after.position - self.frames[k + 1].position).max() <= near:
                return parts
        if not self._warned:
            self._warned = True
            warnings.warn(
                f"step {step} was made in parts, which cannot be made again: its forces are NaN",
                WarpYarnWarning,
                stacklevel=6,
            )
        return []

    def stages(self, k: int, parts: list[Part], *, ends: bool = False) -> Iterator[tuple[Part, int, Made]]:
        """Visits every stage of the parts of step k, with its inputs in place; or both ends of what was not assembled
        where it led."""
        h = self.model.step_size
        for part in parts:
            found = part.method.made(_point(part.before), _point(part.after), part.size * h)
            if ends and any(made.ahead for made in found):
                found = _ends(part, part.size * h)
            with self.visit(k, part.before):
                part.method.set_times(part.size * h, part.left * h)
                for stage, made in enumerate(found):
                    self._enter(stage, made)
                    yield part, stage, made

    def _enter(self, stage: int, made: Made) -> None:
        """Puts a stage and its inputs in place."""
        a = self.model.arrays
        place = (("position", "euler", made.position), ("velocity", "euler_velocity", made.velocity))
        given: Any = (*place, ("solution", "euler_solution", made.solution))
        if made.increment is not None:
            given = (*given, ("increment", "euler_increment", made.increment))
        if made.first is not None:
            given = (*given, ("first_solution", "euler_first_solution", made.first))
        for of_x, of_s, values in given:
            origin = a.origin if of_x == "position" else 0.0
            a[of_x].assign(values[:, :3] - origin)
            if a[of_s] is not None and (of_s != "euler" or self.model.scene.sliding):
                a[of_s].assign(values[:, 3:].ravel())
        self.model.inputs.load(stage)
        with_room(self.stepper, self.model.contact.find)


def _point(state: State) -> Point:
    return Point(
        np.column_stack([state.position, state.euler]), np.column_stack([state.velocity, state.euler_velocity])
    )


def remade(stepper: Stepper, *, gained: bool, size: float) -> list[Part]:
    """Makes a step in parts again, from the present state, and leaves no trace but that state.

    Args:
        gained: whether it gained energy when made at once.
        size: of the first part, in steps.

    Returns:
        Its parts; none where one cannot be made.
    """
    a, parts, frames = stepper.arrays, stepper.substepping, stepper.frames
    found: list[Part] = []
    at = [frames.state()]

    def look(method: Any, size: float, left: float) -> None:
        found.append(Part(method, size, left, at[-1], frames.state()))
        at.append(found[-1].after)

    frame, row = (int(value) for value in a["counters"].numpy())
    kept = {name: a[name].numpy().copy() for name in (*MEMORY, *FRAMES) if a.get(name) is not None}
    counts, watcher = parts.counts, parts.watcher
    stepper.model.energy.forget()
    a.put("status", 0, 0, 0)
    parts.next_size, parts.watcher = size, look
    try:
        made = parts.make(lambda: a.put("counters", frame, row), stepper.make_room, gained=gained)
    finally:
        parts.counts, parts.watcher = counts, watcher
        a.put("status", 0, 0, 0)
        for name, value in kept.items():
            a[name].assign(value)
    return found if made else []


def reactions(steps: Steps) -> np.ndarray:
    """Computes what pins give in each step: the impulse of the step over h [steps, pins, 3] (N)."""
    model = steps.model
    scene, a = model.scene, model.arrays
    result = np.zeros((len(steps), len(scene.pins), 3))
    springs = "pins" in scene.terms
    if not (springs or model.has_hard_pins):
        return result
    off, slack, rounded = np.zeros(len(steps)), np.zeros(len(steps)), rounding_force(model) / ROUGH
    for k in range(len(steps)):
        parts, more, speed = steps.parts(k), np.zeros_like(result[k]), 0.0
        if not parts:
            result[k] = np.nan
        for part, stage, made in steps.stages(k, parts):
            share = part.size * made.share
            if springs:
                at = (made.position + made.ahead * made.solution)[scene.pins, :3]
                stiffness = float(a["pin_stiffness"].numpy()[0])
                result[k] += share * stiffness * (a["pin_target"].numpy() + a.origin - at)
            if not springs or not steps.only:
                part.method.assemble_made(stage)
            if not springs:
                result[k] -= share * a["rhs"].numpy()[scene.pins] / made.size
            if not steps.only:
                left, change = _one_more(model, springs)
                more += share * (-stiffness * made.size if springs else 1.0 / made.size) * change
                speed = max(speed, steps.speed(part, made))
                slack[k] = max(slack[k], left / speed)
        if parts and not steps.only:
            least = model.arrays.node_mass() * speed / model.step_size
            off[k] = np.abs(more).max() / max(np.abs(result[k]).max(), least, rounded)
    _refuse_others(steps, off, slack)
    _warn_where_rounded(model, result)
    if springs:
        _warn_where_springs_give_way(steps, result)
    return result


def _one_more(model: Model, springs: bool) -> tuple[float, np.ndarray]:
    """Finds what one iteration more would change of a stage whose equation is assembled.

    Returns:
        The root mean square of the velocities of nodes, in the norm of the matrix [m/s]; and at pins [pins, 3] their
        velocity (m/s), or of exact ones the momentum that they give (kg m/s).
    """
    a = model.arrays
    a.zero("solution", "euler_solution", "q_x", "q_s")
    model.factorize()
    model.solve()
    a.put("status", 0, 0, 0)
    squares = 0.0
    for left, change in (("rhs", "solution"), ("euler_rhs", "euler_solution")):
        if a[left] is not None:
            squares += float((a[left].numpy() * a[change].numpy()).sum(dtype=np.float64))
    speed = np.sqrt(max(squares, 0.0) / (model.arrays.node_mass() * model.scene.cloth.nodes))
    if springs:
        return speed, a["solution"].numpy()[model.scene.pins].astype(np.float64)
    model.launch("apply_matrix", 1, p_x=a["solution"], p_s=a["euler_solution"])
    return speed, a["q_x"].numpy()[model.scene.pins].astype(np.float64)


def _refuse_others(steps: Steps, off: np.ndarray, slack: np.ndarray) -> None:
    """Refuses frames between which there are no steps of this simulator, and warns of those that may be others or are
    rough.

    Args:
        off, slack: what an iteration more changes of what pins give, and of the change of velocity, over these [steps].
    """
    wrong = np.flatnonzero(~((off <= ROUGH) & (slack <= SLACK)))
    if not len(wrong):
        return
    worst = np.fmax(off, slack)
    k, model = int(wrong[worst[wrong].argmax()]), steps.model
    told = (
        f"step {steps.start + k + 1} of the trajectory does not solve the equations of "
        f"{steps.stepper.integrator.name!r} at free nodes: what pins give is off by {100.0 * off[k]:.2g} %, the change "
        f"of velocity by {100.0 * slack[k]:.2g} %"
    )
    told += f"; so are {len(wrong)} of {len(steps)} steps" if len(wrong) > 1 else ""
    advice = (
        "the simulator that made it knows its steps in parts (simulator.split_steps), others do not; shorter steps are "
        "not made in parts, and a smaller newton_tolerance solves them better"
    )
    if model.precision == "single":
        # of stiff yarns rounding alone may be all that pins give, and who made them is not told by that
        advice += "; precision='double' knows them"
    if worst[k] <= FOREIGN or model.precision == "single":
        warnings.warn(f"{told}. Ask who made it: {advice}", WarpYarnWarning, stacklevel=5)
        return
    raise InputError(
        f"{told}. It is no step of this simulator, with its scene, inputs and step of {model.step_size:g} s. Ask who "
        f"made it: {advice}"
    )


def rounding_force(model: Model) -> float:
    """Estimates what rounding of positions makes of stretch's force on a node [N]."""
    cloth = model.scene.cloth
    extent = np.abs(cloth.position - model.arrays.origin).max()
    a, b = cloth.topology.segment_nodes.T
    shortest = np.abs(cloth.euler[b] - cloth.euler[a]).max(axis=1).min()
    return float(EPSILON[model.precision] * extent * cloth.stretch_stiffness.max() / shortest)


def _warn_where_rounded(model: Model, forces: np.ndarray) -> None:
    """Warns where rounding in single precision is much of what pins give."""
    off, most = rounding_force(model), float(np.nanmax(np.abs(forces), initial=0.0))
    if model.precision == "single" and 0.0 < most < off / GIVES_WAY:
        warnings.warn(
            f"reactions of at most {most:.2g} N: positions in single precision are rounded by what makes some "
            f"{off:.2g} N of a node's forces; precision='double' knows them",
            WarpYarnWarning,
            stacklevel=5,
        )


def _warn_where_springs_give_way(steps: Steps, forces: np.ndarray) -> None:
    """Warns where springs keep pins from where they were moved, so that the cloth is strained less than was asked."""
    scene = steps.model.scene
    if scene.pin_path is None or scene.pin_stiffness is None or not len(forces):
        return
    # all of it: at the beginning of a path any force is much beside the way
    way = np.linalg.norm(scene.pin_path - scene.cloth.position[scene.pins], axis=2).max()
    short = float(np.nanmax(np.linalg.norm(forces[-1], axis=1), initial=0.0)) / scene.pin_stiffness
    if short > GIVES_WAY * way:
        warnings.warn(
            f"pins give way by {short:.2g} m, {100.0 * short / way if way else np.inf:.2g} % of the way that they are "
            f"moved: pin_stiffness = {scene.pin_stiffness:g} N/m is soft for this cloth, and what it reads is too "
            "little; make the scene with pin_stiffness=None, which holds exactly",
            WarpYarnWarning,
            stacklevel=5,
        )


def work(steps: Steps) -> dict[str, np.ndarray]:
    """Computes the work that was done from outside in each step [steps] (J), by who did it."""
    model, h = steps.model, steps.model.step_size
    names = model.energy.workers
    result = {name: np.zeros(len(steps)) for name in names}
    for k in range(len(steps)):
        parts = steps.parts(k) if names else []
        if names and not parts:
            for name in names:
                result[name][k] = np.nan
        for part, _, made in steps.stages(k, parts, ends=True):
            for name in names:
                result[name][k] += part.size * h * made.share * model.energy.power_of(name)
    if model.scene.pin_path is not None:
        result["pins"] = np.einsum("kpi,kpi->k", reactions(steps), _pin_motion(steps))
    elif len(model.scene.pins):
        result["pins"] = np.zeros(len(steps))
    return result


def _ends(part: Part, duration: float) -> list[Made]:
    """Gives both ends of a part, to look at powers along the way between them where its stages are not where it
    led."""
    before, after = _point(part.before), _point(part.after)
    way = (after.position - before.position) / duration
    return [Made(0.5, duration, *end, way, None, 0.0) for end in (before, after)]


def _pin_motion(steps: Steps) -> np.ndarray:
    """Finds how far pins go in each step [steps, pins, 3] (m)."""
    scene, a = steps.model.scene, steps.model.arrays
    result = np.zeros((len(steps), len(scene.pins), 3))
    path = a["pin_target_path"].numpy().reshape(-1, *result.shape[1:])
    places = np.concatenate([a["pin_start"].numpy()[None], path])
    for k in range(len(steps)):
        row = steps.start + k
        result[k] = places[min(row + 1, len(path))] - places[min(row, len(path))]
    return result
