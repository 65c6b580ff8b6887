"""Threads: whatever they do at the same time, each gets what it would get alone, to the last bit."""

import asyncio
import os
import subprocess
import sys
import threading
from collections.abc import Callable

import joblib
import numpy as np
import pytest
import warp as wp

import warp_yarn as wy
from warp_yarn.simulation.state import FIELDS
from warp_yarn.view.geometry import contact_normals

STEPS = 3
SPEEDS = (1.0, 2.0, 3.0, 4.0)


def scene(speed: float = 5.0, **options: object) -> wy.Scene:
    return wy.paper.hung_cloth("plain", 4, 4, wind=wy.Wind(velocity=(0.0, speed, 0.0)), **options)


def simulated(speed: float) -> wy.Trajectory:
    """Made, captured and run in the calling thread."""
    return wy.Simulator(scene(speed)).run(STEPS)


@pytest.fixture(scope="module")
def alone() -> list[wy.Trajectory]:
    return [simulated(speed) for speed in SPEEDS]


def same(a: wy.Trajectory, b: wy.Trajectory) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in FIELDS)


def together(*functions: Callable) -> list:
    """What functions return, each in a thread of its own, all begun at once."""
    results, barrier = [None] * len(functions), threading.Barrier(len(functions))

    def call(k: int) -> None:
        barrier.wait()
        try:
            results[k] = functions[k]()
        except BaseException as error:
            results[k] = error

    threads = [threading.Thread(target=call, args=(k,)) for k in range(len(functions))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120.0)
    assert not any(thread.is_alive() for thread in threads)
    for result in results:
        if isinstance(result, BaseException):
            raise result
    return results


def test_threads_of_joblib(alone):
    for _ in range(3):
        found = joblib.Parallel(n_jobs=4, backend="threading")(joblib.delayed(simulated)(v) for v in SPEEDS)
        assert all(same(a, b) for a, b in zip(alone, found, strict=True))


def test_threads_of_asyncio(alone):
    async def all_of_them() -> list[wy.Trajectory]:
        return await asyncio.gather(*(asyncio.to_thread(simulated, speed) for speed in SPEEDS))

    assert all(same(a, b) for a, b in zip(alone, asyncio.run(all_of_them()), strict=True))


def test_what_one_thread_captures_takes_nothing_of_what_others_do(alone):
    """Simulators are made and captured while others take energies, forces and states, draw, and copy."""
    sim = wy.Simulator(scene())
    sim.run(2)
    state, energy = sim.state, sim.energy()
    forces, normals = sim.forces(), contact_normals(sim.scene.cloth, state.position[None])
    done = threading.Event()

    def captures() -> list[wy.Trajectory]:
        try:
            return [simulated(speed) for speed in SPEEDS]
        finally:
            done.set()

    def looks() -> int:
        count = 0
        while not done.is_set() or not count:
            assert sim.energy() == energy and sim.energy(state) == energy
            found = sim.forces()
            assert all(np.array_equal(found[name][k], forces[name][k]) for name in forces for k in range(2))
            count += 1
        return count

    def draws() -> int:
        count = 0
        while not done.is_set() or not count:
            assert np.array_equal(contact_normals(sim.scene.cloth, state.position[None]), normals)
            count += 1
        return count

    def replays() -> wy.Trajectory:
        own = wy.Simulator(scene(SPEEDS[0]))
        found = own.run(STEPS)
        while not done.is_set():
            own.reset()
            assert same(own.run(STEPS), found)
        return found

    found, _, _, replayed = together(captures, looks, draws, replays)
    assert all(same(a, b) for a, b in zip(alone, found, strict=True))
    assert same(replayed, alone[0])


def test_threads_that_share_a_simulator_take_turns():
    whole = wy.Simulator(scene()).run(8)
    sim = wy.Simulator(scene())
    parts = together(*[lambda: sim.run(2)] * 4)
    parts.sort(key=lambda part: np.flatnonzero((whole.position == part.position[0]).all(axis=(1, 2)))[0])
    for k, part in enumerate(parts):
        assert np.array_equal(part.position, whole.position[2 * k : 2 * k + 3])
    assert sim.steps_done == 8


def test_steps_in_parts_and_their_captures(alone):
    """The copies that steps in parts put by are captured when they are first needed, in the midst of a run."""

    def controlled() -> wy.Trajectory:
        return wy.Simulator(scene(), step=4e-3, step_error=1e-3).run(2)

    expected = controlled()
    found = together(controlled, lambda: simulated(SPEEDS[0]), controlled, lambda: simulated(SPEEDS[1]))
    assert same(found[0], expected) and same(found[2], expected)
    assert same(found[1], alone[0]) and same(found[3], alone[1])


def test_teams_in_threads():
    wide = wy.paper.hung_cloth("plain", 3, 16)

    def teamed() -> wy.Trajectory:
        return wy.Simulator(wide, threads=2).run(2)

    expected = teamed()
    assert all(same(expected, found) for found in together(teamed, teamed))


@wp.kernel
def nothing(values: wp.array(dtype=float)):
    values[0] = 1.0


@pytest.mark.parametrize("call", ["run", "energy", "forces", "Simulator", "state", "reset"])
def test_inside_recordings_of_others_it_is_refused(call):
    """And these go on as if nothing had been."""
    sim, values = wy.Simulator(scene()), wp.zeros(1, dtype=float, device="cpu")
    sim.run(1)
    calls = {
        "run": lambda: sim.run(1),
        "Simulator": lambda: wy.Simulator(scene()),
        "state": lambda: sim.state,
        "reset": lambda: sim.reset(),
    }
    attempt = calls.get(call, lambda: getattr(sim, call)())
    with wp.Tape() as tape:
        wp.launch(nothing, dim=1, inputs=[values], device="cpu")
        with pytest.raises(wy.InputError, match=r"a wp\.Tape is open"):
            attempt()
    assert len(tape.launches) == 1
    values.zero_()
    with wp.ScopedCapture(device="cpu") as capture:
        wp.launch(nothing, dim=1, inputs=[values], device="cpu")
        with pytest.raises(wy.InputError, match="a graph capture of Warp is open"):
            attempt()
    wp.capture_launch(capture.graph)
    assert values.numpy()[0] == 1.0
    assert len(sim.run(1)) == 2 and sim.steps_done == 2


def test_more_threads_than_cores_warn():
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    with pytest.warns(RuntimeWarning, match=rf"threads = {cores + 1}, but there are {cores} processor cores"):
        wy.Simulator(scene(), threads=cores + 1)


@pytest.mark.slow
def test_threads_that_draw_at_once(tmp_path):
    """In a process of its own, where nothing has loaded what draws."""
    code = (
        "import sys, threading, warp_yarn as wy\n"
        "trajectory = wy.Simulator(wy.Scene(wy.paper.cloth(rows=3, columns=3))).run(0)\n"
        "failed = []\n"
        "def draw(k):\n"
        "    try: wy.write_png(f'{sys.argv[1]}/{k}.png', trajectory, size=(64, 48))\n"
        "    except BaseException as error: failed.append(error)\n"
        "threads = [threading.Thread(target=draw, args=(k,)) for k in range(4)]\n"
        "for thread in threads: thread.start()\n"
        "for thread in threads: thread.join()\n"
        "sys.exit(str(failed) if failed else 0)\n"
    )
    pytest.importorskip("imageio")
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert len(list(tmp_path.glob("*.png"))) == 4
