"""What tests know of the insides of the package, and only this file does: when they change, it is mended here."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
import pytest
import torch
import warp as wp
from warp_yarn.kernels.core.status import GAINED, STALLED

import warp_yarn as wy
from warp_yarn.calibration.problem import CalibrationProblem
from warp_yarn.device import exclusive, graphs
from warp_yarn.device.contact import Near
from warp_yarn.device.impact_zones import Projected
from warp_yarn.integrators.newton import Newton
from warp_yarn.simulation import ablation, checks
from warp_yarn.simulation.inspection import with_room
from warp_yarn.simulation.linear_system import read_system
from warp_yarn.view import render

# -- a simulator's arrays ---------------------------------------------------------------------------------------------


def numbers(simulator: wy.Simulator, name: str) -> np.ndarray | None:
    """A copy of an array that kernels use; None where the scene has none."""
    array = simulator.arrays[name]
    return None if array is None else array.numpy().copy()


def put(simulator: wy.Simulator, name: str, values: object) -> None:
    """Writes into an array that kernels use; one number goes everywhere."""
    array = simulator.arrays[name]
    array.assign(np.broadcast_to(np.asarray(values), array.numpy().shape))


def stiffness_at_evaluation(simulator: wy.Simulator, state: wy.State, evaluations: int) -> np.ndarray:
    """H of the matrix that Newton's iteration has after so many evaluations in a stage."""
    simulator.state = state
    simulator.arrays.put("evaluations", evaluations)
    simulator.arrays.put("coefficients", 0.0, 0.0, 1.0)
    simulator.model.assemble()
    return read_system(simulator.model).dense()


def has_any(simulator: wy.Simulator, *names: str) -> bool:
    """Whether the simulator knows any array of these names at all."""
    return bool(set(names) & set(simulator.arrays))


def add_array(simulator: wy.Simulator, name: str, array: str | None) -> None:
    """Gives a simulator another array: one of its own by its name, or a new one as it is declared."""
    arrays = simulator.arrays
    arrays[name] = arrays.new(name) if array is None else arrays[array]


def array_arguments(simulator: wy.Simulator, kernel: str) -> set[str]:
    """Names of the arrays that a kernel takes."""
    found = simulator.model.kernels[kernel].adj.args
    structs = [a.type for a in found if a.label in ("blocks", "work")]
    fields = {name for struct in structs for name, field in struct.vars.items() if isinstance(field.type, wp.array)}
    return {a.label for a in found if isinstance(a.type, wp.array)} | fields


def strips(simulator: wy.Simulator) -> int:
    """How many processor cores share a linear solve."""
    return simulator.model.threads.count


def solve(simulator: wy.Simulator, force: np.ndarray) -> np.ndarray:
    """Solves M v = h F, from v = 0, with the method's conjugate gradient; gives what is found of v."""
    simulator.system(simulator.state, weights=(1.0, 0.0, 0.0))
    put(simulator, "rhs", simulator.step_size * force)
    simulator.arrays.zero("euler_rhs", "solution", "euler_solution")
    simulator.model.factorize()
    with simulator.model.threads.at_hand():
        simulator.model.solve()
    return numbers(simulator, "solution")


def solve_beside(
    simulator: wy.Simulator, rhs: np.ndarray, euler_rhs: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None, bool]:
    """Solves (M + h² H − G) w = b at the present state with the method's conjugate gradient: w of positions and of
    (u, v), and whether yarns are compressed and that was positive definite."""
    simulator.system(weights=(1.0, 0.0, simulator.step_size**2))
    compression = simulator.integrator.newton.compression
    put(simulator, "rhs", rhs)
    if euler_rhs is not None and simulator.scene.sliding:
        put(simulator, "euler_rhs", euler_rhs.ravel())
    simulator.model.factorize()
    compression.find()

    def solve() -> None:
        simulator.arrays.zero("solution", "euler_solution")
        simulator.model.solve()

    with simulator.model.threads.at_hand():
        compression.solve(solve)
    along = numbers(simulator, "euler_solution")
    seen = bool(numbers(simulator, "compressed")[0])
    return numbers(simulator, "solution"), None if along is None else along.reshape(-1, 2), seen


# -- contact ----------------------------------------------------------------------------------------------------------


def upload(simulator: wy.Simulator, state: wy.State) -> None:
    """Puts a simulator into a state, unchecked."""
    simulator.stepper.frames.upload(state)


def near_obstacles(simulator: wy.Simulator) -> Near:
    """Every node and obstacle."""
    return simulator.model.contact.near_obstacles()


def near_faces(simulator: wy.Simulator) -> Near:
    """Every node and face of a mesh that are near each other."""
    return simulator.model.contact.near_faces()


def near_pairs(simulator: wy.Simulator) -> Near:
    """Every two samples that are near each other, with room for all of them."""
    with_room(simulator.stepper, simulator.model.contact.find)
    return simulator.model.contact.near_pairs()


def near_room(simulator: wy.Simulator) -> int:
    """Places of a node in the list of what is near."""
    return int(simulator.arrays["near_room"])


def set_near_room(simulator: wy.Simulator, room: int) -> None:
    """Leaves a sample so many places for what is near it."""
    simulator.model.contact.make_room(room)
    simulator.integrator.forget_graphs()
    simulator.stepper.substepping.forget_graphs()


def obstacles_begin_a_step(simulator: wy.Simulator) -> None:
    """Puts obstacles where they are at the first stage of the next step."""
    simulator.model.contact.load(0)


def power_of_obstacles(simulator: wy.Simulator) -> float:
    """The power of their forces on the present state, where they were put last."""
    simulator.arrays.zero("power")
    simulator.model.contact.find()
    simulator.model.contact.add_power()
    return float(numbers(simulator, "power")[0])


def launch_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Has launches that would be captured made from Python, with loops there."""
    monkeypatch.setattr(graphs.GraphCache, "run", lambda self, name, part: part())


def look_after_stages(simulator: wy.Simulator, look: Callable[[bool], None], monkeypatch: pytest.MonkeyPatch) -> None:
    """Calls a function at the end of every stage that was solved, with whether anything touches."""
    launch_one_by_one(monkeypatch)
    solve = Newton.solve

    def looked_at(newton: Newton, stage: int) -> None:
        solve(newton, stage)
        if not numbers(simulator, "status")[0]:
            touching = numbers(simulator, "touching")
            look(bool(touching[0]))
            put(simulator, "touching", touching)

    monkeypatch.setattr(Newton, "solve", looked_at)


# -- steps ------------------------------------------------------------------------------------------------------------


def newton_tolerance(simulator: wy.Simulator, step: float) -> float:
    return simulator.model.newton_tolerance_at(step)


def left_of_the_last_stage(simulator: wy.Simulator) -> float:
    """What another step of Newton's iteration would change, relative to the tolerance."""
    change = float(numbers(simulator, "change")[0])
    simulator.integrator.newton.evaluate(matrix=True)
    simulator.integrator.newton.solve_direction(1)
    slope = float(numbers(simulator, "directional_derivative")[0])
    return np.sqrt(slope) / change / newton_tolerance(simulator, simulator.step_size)


def watches_energy(simulator: wy.Simulator) -> bool:
    return simulator.model.energy.on


def fails_at_first(simulator: wy.Simulator, largest: float) -> None:
    """Makes a simulator fail in its first step, wherever it tries more of it at once than so much [s]."""
    advance, arrays = simulator.integrator.advance, simulator.arrays

    def attempt() -> None:
        if arrays["counters"].numpy()[1] == 0 and arrays["step_size"].numpy()[0] > largest:
            arrays["status"].assign(np.array([STALLED, -1, 0], dtype=np.int32))
        advance()

    simulator.integrator.advance = attempt


def force_a_gain(simulator: wy.Simulator) -> list[int]:
    """Says once of a whole step, in Python, that it gained energy."""
    advance, said = simulator.stepper._advance, []

    def gained(steps: int) -> int:
        if said:
            return advance(steps)
        said.append(1)
        put(simulator, "status", [GAINED, -1, 1])
        return 0

    simulator.stepper._advance = gained
    return said


def make_in_parts(simulator: wy.Simulator, steps: dict[int, tuple[int, float]]) -> None:
    """Makes a simulator's method fail.

    Args:
        steps: since the beginning, from 0 on: with which status, and wherever more of it is tried than this [steps].
    """
    advance, arrays = simulator.integrator.advance, simulator.arrays

    def attempt() -> None:
        code, largest = steps.get(int(arrays["counters"].numpy()[1]), (0, np.inf))
        if arrays["step_size"].numpy()[0] > largest * simulator.step_size:
            arrays["status"].assign(np.array([code, -1, 0], dtype=np.int32))
        advance()

    simulator.integrator.advance = attempt


def gain_in_a_part(simulator: wy.Simulator, size: float, left: float) -> list[float]:
    """Says of every part of this size, with so much of its step left [steps], that it gained energy, but of the
    fallback's; gives a list of them."""
    substepping, gained = simulator.substepping, []
    attempt = substepping._try

    def made(method: object, count: Callable[[], None], make_room: Callable[[], None], *part: float) -> bool:
        good = attempt(method, count, make_room, *part)
        if method is simulator.integrator and part == (size, left):
            put(simulator, "status", [GAINED, -1, 0])
            gained.append(size)
            return False
        return good

    substepping._try = made
    return gained


def errors_of_accepted_parts(simulator: wy.Simulator) -> list[float]:
    """A list that fills with the error [m] of every part of a step that is accepted from now on."""
    substepping, errors = simulator.substepping, []
    accepts = substepping._accepts

    def looked_at(size: float) -> bool:
        good = accepts(size)
        if good:
            errors.append(substepping.error())
        return good

    substepping._accepts = looked_at
    return errors


def a_step_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets simulators that are made from now on keep one step on the device."""
    monkeypatch.setattr(checks, "CHUNK_BYTES", 0)


# -- calibration ------------------------------------------------------------------------------------------------------


def add_noise(monkeypatch: pytest.MonkeyPatch, size: float) -> None:
    """Adds noise to the positions of every run of a calibration, another one in every run."""
    random, run = np.random.default_rng(0), CalibrationProblem._run

    def noisy(*arguments: object) -> torch.Tensor:
        found = run(*arguments)
        return found + size * torch.as_tensor(random.normal(size=found.shape))

    monkeypatch.setattr(CalibrationProblem, "_run", noisy)


# -- locks ------------------------------------------------------------------------------------------------------------


def locks_taken() -> list[object]:
    """Locks that no other thread can take."""
    taken = []

    def take() -> None:
        for lock in (exclusive.ALONE, exclusive._registering, *exclusive._replaying):
            if lock.acquire(timeout=2.0):
                lock.release()
            else:
                taken.append(lock)

    thread = threading.Thread(target=take)
    thread.start()
    thread.join()
    return taken


# -- what things are made of ------------------------------------------------------------------------------------------


def made_of(thing: wy.Scene | wy.Cloth) -> dict[str, object]:
    """The arguments of a scene or a cloth."""
    return thing._arguments


def options_of(simulator: wy.Simulator) -> dict[str, object]:
    """All that a simulator was made with beside its scene."""
    return simulator._options


# -- parts of public functions that are worth a test of their own -----------------------------------------------------

halved: Callable = ablation._halved
unneeded: Callable = ablation._unneeded
picture_times: Callable = render._times
Picture = render._Picture


def resolved_with_its_adjoint(
    simulator: wy.Simulator, start: np.ndarray, end: np.ndarray, inverse_mass: np.ndarray, adjoint: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[list[int]]]:
    """What impact zones do to a way: where it ends, adjoints of its start and end by one of the move, and how many
    impacts are active in each zone of each round."""
    zones = simulator.model.zones
    found, rounds = zones.resolve(start, end, inverse_mass)
    active = [[len(zone.multipliers) for zone in one.zones] for one in rounds]
    made = Projected(rounds, start, inverse_mass, np.zeros(0), found - end, 1.0)
    to_start, to_end, _ = zones.taken_back(made, adjoint)
    return found, to_start, to_end, active


def room_for_near(simulator: wy.Simulator) -> int:
    """Places of each node in the list of what is near."""
    return simulator.arrays["near_room"]
