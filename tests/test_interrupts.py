"""Whatever ends a call, and whenever: a simulator answers as one to which nothing happened."""

import contextlib
import copy
import pickle
import signal
import sys
import threading
import time
import types
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import warp as wp
from cases import quick
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from internals import fails_at_first, locks_taken, numbers, put

import warp_yarn as wy
from warp_yarn.integrators import INTEGRATORS
from warp_yarn.simulation.state import FIELDS

# of an exception raised in a __del__, which Python reports and drops
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")

STEPS = 6
CLOTH = wy.paper.cloth("plain", 4, 4)
TOP = CLOTH.corners("top")
PATH = CLOTH.position[TOP] + 1e-4 * np.sin(0.9 * np.arange(1, 21))[:, None, None]
PUSH = 1e-4 * np.cos(np.arange(60.0)).reshape(20, 3)
OPTIONS = {
    "sdirk2": {},
    "linear": {"integrator": "linear"},
    "short chunks": {"chunk": 2},
    "step_error": {"step_error": 0.2},
    "single": {"precision": "single"},
}


def scene(**options: object) -> wy.Scene:
    """Everything that changes from step to step."""
    given = {"pins": TOP, "pin_path": PATH, "forces": {9: PUSH}, "wind": wy.Wind(velocity=(0.0, 5.0, 0.0)), **options}
    return wy.Scene(CLOTH, **given)


def simulator(**options: object) -> wy.Simulator:
    return wy.Simulator(scene(), **options)


def same(a: wy.State | wy.Trajectory, b: wy.State | wy.Trajectory) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in FIELDS)


@pytest.fixture(autouse=True)
def _locks() -> Iterator[None]:
    """No lock is left taken, which the thread that did so would be the last to find out."""
    yield
    assert not locks_taken()


class _Stop(BaseException):
    """As KeyboardInterrupt, which a test must not take for that of whoever runs it."""


@contextlib.contextmanager
def interrupted_at(call: int) -> Iterator[list[int]]:
    """Raises at the so many-th call or return of a function: there Python looks for signals. Lists the calls seen."""
    seen = [0]

    def profile(frame: object, event: str, argument: object) -> None:
        if event in ("call", "c_return"):
            seen[0] += 1
            if seen[0] == call:
                sys.setprofile(None)
                raise _Stop

    sys.setprofile(profile)
    try:
        yield seen
    finally:
        sys.setprofile(None)


def check_goes_on(sim: wy.Simulator, whole: wy.Trajectory, start: int = 0) -> None:
    """State, steps done and frames agree with the run that nothing interrupted, and so does what follows."""
    done = sim.steps_done
    assert same(sim.state, whole[done])
    frames = sim.trajectory
    if frames is not None:
        assert len(frames) == done - start + 1
        assert np.array_equal(frames.position, whole.position[start : done + 1])
        assert np.array_equal(frames.velocity, whole.velocity[start : done + 1])
    assert not wp.get_device("cpu").is_capturing
    rest = sim.run(len(whole) - 1 - done)
    assert np.array_equal(rest.position, whole.position[done:])
    assert sim.trajectory is None and sim.steps_done == len(whole) - 1


@pytest.mark.parametrize("name", OPTIONS)
def test_a_run_is_interrupted_anywhere(name):
    whole = simulator(**OPTIONS[name]).run(STEPS)
    sim = simulator(**OPTIONS[name])
    sim.run(1)
    sim.reset()
    with interrupted_at(0) as seen:
        assert same(sim.run(STEPS), whole)
    # spread over the whole run, and every one near its ends, where what is kept is opened and closed
    places = {*range(1, 60), *np.linspace(60, seen[0] - 60, 60).astype(int), *range(seen[0] - 60, seen[0])}
    stopped = 0
    for place in sorted(places):
        sim.reset()
        try:
            with interrupted_at(int(place)):
                sim.run(STEPS)
        except _Stop:
            stopped += 1
        check_goes_on(sim, whole)
    assert stopped > 100


@pytest.mark.parametrize("integrator", quick(INTEGRATORS, "linear"))
def test_the_first_step_is_interrupted_anywhere(integrator):
    """While its graph is captured: no capture stays open."""
    whole = simulator(integrator=integrator).run(2)
    with interrupted_at(0) as seen:
        simulator(integrator=integrator).run(2)
    for place in np.linspace(1, seen[0], 40).astype(int):
        sim = None
        with contextlib.suppress(_Stop), interrupted_at(int(place)):
            sim = simulator(integrator=integrator)
            sim.run(2)
        check_goes_on(simulator(integrator=integrator) if sim is None else sim, whole)


def test_steps_in_parts_are_interrupted_anywhere():
    def failing() -> wy.Simulator:
        sim = simulator()
        fails_at_first(sim, 3e-4)
        return sim

    sim = failing()
    whole, split = sim.run(3), dict(sim.split_steps)
    assert split
    sim.reset()
    assert sim.split_steps == {}
    with interrupted_at(0) as seen:
        sim.run(3)
    for place in np.linspace(1, seen[0], 80).astype(int):
        sim.reset()
        with contextlib.suppress(_Stop), interrupted_at(int(place)):
            sim.run(3)
        assert sim.steps_done or not sim.split_steps
        check_goes_on(sim, whole)
        assert sim.split_steps == split


@pytest.mark.slow
def test_damped_steps_are_interrupted_anywhere():
    """Steps that gain energy, which another method makes: in new simulators, where it is made too, and in one."""
    cloth = wy.paper.cloth(rows=7, columns=7, pose="flat")

    def started(sim: wy.Simulator) -> wy.Simulator:
        sim.reset()
        state = sim.state
        state.position[:] = cloth.position[0] + 1.3 * (cloth.position - cloth.position[0])
        sim.state = state
        return sim

    def make() -> wy.Simulator:
        return started(wy.Simulator(wy.Scene(cloth, pins=[0])))

    sim = make()
    with interrupted_at(0) as first:
        whole = sim.run(3)
    damped, split = set(sim.damped_steps), dict(sim.split_steps)
    counts = sim.substepping.counts
    assert damped and sim.substepping.damped
    with interrupted_at(0) as later:
        assert same(started(sim).run(3), whole)
    used = sim
    places = [(make, k) for k in np.linspace(1, first[0], 20).astype(int)]
    places += [(lambda: started(used), k) for k in np.linspace(1, later[0], 80).astype(int)]
    for begin, place in places:
        sim = begin()
        with contextlib.suppress(_Stop), interrupted_at(int(place)):
            sim.run(3)
        done = sim.steps_done  # settles what is half done
        assert all(k <= done for k in (*sim.damped_steps, *sim.split_steps))
        assert numbers(sim, "damps")[0] == 0
        check_goes_on(sim, whole)
        assert (sim.damped_steps, sim.split_steps) == (damped, split)
        assert sim.substepping.counts == counts
    other = pickle.loads(pickle.dumps(sim))
    assert (other.damped_steps, other.split_steps) == (damped, split)
    sim.reset()
    assert sim.damped_steps == set() and sim.substepping.damped == 0


@pytest.mark.slow
def test_a_team_is_interrupted_anywhere():
    """Its helpers end, and others take their place."""

    def helpers() -> int:
        # threads of Warp's and of locks, which Python counts for ever once it has seen them, are of another class
        return sum(type(thread) is threading.Thread for thread in threading.enumerate())

    before = helpers()
    wide = wy.paper.hung_cloth("plain", 3, 16)
    sim = wy.Simulator(wide, threads=2)
    whole = sim.run(3)
    sim.reset()
    with interrupted_at(0) as seen:
        sim.run(3)
    for place in np.linspace(1, seen[0], 30).astype(int):
        sim.reset()
        try:
            with interrupted_at(int(place)):
                sim.run(3)
        except _Stop:
            check_goes_on(sim, whole)
        assert helpers() < before + 20
    sim.reset()
    assert helpers() <= before + 1 and same(sim.run(3), whole)


@pytest.mark.parametrize("call", ["state", "energy", "forces", "contact", "system", "reset", "deepcopy"])
def test_other_calls_are_interrupted_anywhere(call):
    """A state is the old one or the new one; what only looks leaves no trace."""
    sim = simulator()
    whole = sim.run(STEPS)
    other, start = whole[3], whole[0]

    def take(sim: wy.Simulator) -> None:
        if call == "state":
            sim.state = other
        elif call == "reset":
            sim.reset()
        elif call == "deepcopy":
            copy.deepcopy(sim)
        else:
            getattr(sim, call)(other)

    with interrupted_at(0) as seen:
        take(sim)
    for place in np.linspace(1, seen[0], 60).astype(int):
        sim.reset()
        sim.run(2)
        with contextlib.suppress(_Stop), interrupted_at(int(place)):
            take(sim)
        if call == "reset" and sim.steps_done == 0:
            assert same(sim.state, start)
        elif call == "state" and same(sim.state, other):
            assert sim.steps_done == 2
            sim.steps_done = 3
        else:
            assert sim.steps_done == 2
        check_goes_on(sim, whole)


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="needs timers of a Unix")
def test_ctrl_c_at_any_time():
    """Real signals, at real times, twice in a row."""
    sim = simulator(chunk=5)
    whole = sim.run(20)
    random, stopped = np.random.default_rng(0), 0
    length = np.inf
    for _ in range(5):  # the shortest: the machine may be at other things
        sim.reset()
        begin = time.perf_counter()
        sim.run(20)
        length = min(length, time.perf_counter() - begin)

    raised = []

    def stop(_: int, frame: types.FrameType | None) -> None:
        raised.append(1)
        if len(raised) < 2:
            # the second comes while the first is dealt with
            signal.setitimer(signal.ITIMER_REAL, random.uniform(1e-6, 2e-4))
        while frame is not None:
            if frame.f_code is wy.Simulator.run.__code__:
                raise _Stop
            frame = frame.f_back  # nothing is interrupted but the run: neither this test nor what it calls then

    before = signal.signal(signal.SIGALRM, stop)
    try:
        for _ in range(40):
            sim.reset()
            raised.clear()
            with contextlib.suppress(_Stop):
                signal.setitimer(signal.ITIMER_REAL, random.uniform(1e-5, length))
                sim.run(20)
            while len(raised) < 2:
                time.sleep(1e-5)
            stopped += sim.steps_done < 20
            check_goes_on(sim, whole)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    assert stopped > 10


@pytest.mark.parametrize("place", [20, 40, 60])
def test_an_interrupted_run_holds_no_other_thread_up(place):
    sim, found = simulator(), []
    with contextlib.suppress(_Stop), interrupted_at(place):
        sim.run(STEPS)
    thread = threading.Thread(target=lambda: found.append(simulator().run(2)))
    thread.start()
    thread.join(60.0)
    assert len(found) == 1


def test_frames_are_in_hand_after_any_exception(monkeypatch):
    sim = simulator(chunk=2)
    whole = sim.run(STEPS)
    sim.reset()
    advance, calls = sim.integrator.advance, []

    def out_of_memory() -> None:
        calls.append(1)
        if len(calls) == 4:
            raise MemoryError
        advance()

    monkeypatch.setattr(sim.integrator, "advance", out_of_memory)
    with pytest.raises(MemoryError):
        sim.run(STEPS)
    assert sim.steps_done == 3 and len(sim.trajectory) == 4
    check_goes_on(sim, whole)


def test_a_failed_step_leaves_its_trajectory_too():
    sim = simulator(step_error=1e-30)
    with pytest.raises(wy.SimulationError) as failure:
        sim.run(3)
    assert same(sim.trajectory, failure.value.trajectory)
    with pytest.raises(wy.SimulationError) as again:
        sim.run(3)
    assert str(again.value) == str(failure.value)


def test_another_state_begins_its_steps_in_parts_anew():
    sim = simulator(step=4e-3, step_error=1e-3)
    start, first = sim.state, sim.run(3)
    sim.state, sim.steps_done = start, 0
    assert same(sim.run(3), first)
    sim.reset()
    assert same(sim.run(3), first)


@pytest.mark.parametrize("how", ["pickle", "deepcopy"])
@pytest.mark.parametrize("name", OPTIONS)
def test_copies_go_on_as_the_simulator_does(how, name):
    sim = simulator(**OPTIONS[name])
    sim.run(2)
    put(sim, "wind_drag", 3.0)
    other = pickle.loads(pickle.dumps(sim)) if how == "pickle" else copy.deepcopy(sim)
    assert same(other.run(3), sim.run(3)) and other.steps_done == sim.steps_done


# -- random sequences -------------------------------------------------------------------------------------------------

CALLS = (
    st.tuples(st.just("run"), st.integers(0, 4)),
    st.tuples(st.just("interrupted"), st.integers(1, 600)),
    st.tuples(st.just("state"), st.integers(0, 2)),
    st.tuples(st.just("steps_done"), st.integers(0, 12)),
    st.tuples(st.just("reset"), st.none()),
    st.tuples(st.just("forces"), st.sampled_from([None, 0, 1, 2])),
    st.tuples(st.just("energy"), st.sampled_from([None, 0, 1, 2])),
    st.tuples(st.just("contact"), st.sampled_from([None, 0, 1, 2])),
    st.tuples(st.just("system"), st.sampled_from([None, 0, 1, 2])),
    st.tuples(st.just("error"), st.sampled_from(["steps", "state", "order", "failure", "chunk"])),
)


class Pair:
    """A simulator that is asked one thing after another, and one that is put where it is each time."""

    def __init__(self, **options: object):
        self.asked, self.fresh = simulator(**options), simulator(**options)
        self.states = simulator(**options).run(40)
        self.controlled = "step_error" in options

    def place(self) -> wy.Simulator:
        """The fresh one, where the other is."""
        fresh, asked = self.fresh, self.asked
        fresh.reset()
        fresh.state, fresh.steps_done = asked.state, asked.steps_done
        fresh.substepping.next_size = asked.substepping.next_size
        return fresh

    def state(self, k: int | None) -> wy.State | None:
        return None if k is None else self.states[20 * k]

    def call(self, name: str, argument: object) -> None:
        asked = self.asked
        if name == "state":
            asked.state = self.state(argument)
        elif name == "steps_done":
            asked.steps_done = argument
        elif name == "reset":
            asked.reset()
        elif name == "error":
            self.fail(argument)
        elif name == "interrupted":
            fresh, before = self.place(), asked.steps_done
            with contextlib.suppress(_Stop), interrupted_at(argument):
                asked.run(5)
            made = asked.steps_done - before
            expected = fresh.run(made)
            assert same(asked.state, expected[-1])
            frames = asked.trajectory
            if frames is not None:
                assert len(frames) > made
                assert np.array_equal(frames.position[-made - 1 :], expected.position)
        elif name == "run":
            expected = self.place().run(argument)
            assert same(asked.run(argument), expected)
        else:
            expected = getattr(self.place(), name)(self.state(argument))
            check_equal(getattr(asked, name)(self.state(argument)), expected)

    def fail(self, how: str) -> None:
        asked = self.asked
        if how == "failure":
            velocity = asked.state.velocity
            velocity[6] = 1e200
            before = asked.state
            asked.state = wy.State(before.position, before.euler, velocity, before.euler_velocity, before.anchor)
            with pytest.raises(wy.SimulationError):
                asked.run(3)
            asked.state = before
            return
        bad = asked.state
        if how == "state":
            bad.position[3] = np.nan
        bad.euler[5], bad.euler[6] = bad.euler[6].copy(), bad.euler[5].copy()
        calls: dict[str, Callable] = {
            "steps": lambda: asked.run(-1),
            "state": lambda: asked.energy(bad),
            "order": lambda: asked.forces(bad),
            "chunk": lambda: asked.run("two"),
        }
        with pytest.raises(wy.InputError):
            calls[how]()


def check_equal(found: object, expected: object) -> None:
    """Bit by bit."""
    if isinstance(expected, dict):
        assert found.keys() == expected.keys()
        for name, value in expected.items():
            check_equal(found[name], value)
    elif isinstance(expected, tuple):
        for a, b in zip(found, expected, strict=True):
            check_equal(a, b)
    elif hasattr(expected, "__dataclass_fields__"):
        check_equal(vars(found), vars(expected))
    else:
        assert np.array_equal(found, expected)


@pytest.fixture(scope="module", params=quick(["sdirk2", "linear", "short chunks", "step_error"], "short chunks"))
def pair(request) -> Pair:
    return Pair(**OPTIONS[request.param])


@settings(max_examples=12, derandomize=True, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(calls=st.lists(st.one_of(*CALLS), min_size=30, max_size=30))
def test_random_sequences_of_calls(pair, calls):
    """Also from one sequence to the next: the simulators stay."""
    for name, argument in calls:
        pair.call(name, argument)
