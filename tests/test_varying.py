"""Inputs that vary: rows of steps, functions of time, gusts in space, and a hook before each step."""

import copy
import pickle
from fractions import Fraction

import numpy as np
import pytest
import torch
import warp as wp
from inputs import EXACT
from internals import halved

import warp_yarn as wy
import warp_yarn.torch as wt
from warp_yarn.calibration.problem import with_paths
from warp_yarn.integrators import INTEGRATORS

STEPS, STEP = 8, 1e-3
METHODS = tuple(INTEGRATORS)


def cloth() -> wy.Cloth:
    return wy.paper.cloth(rows=4, columns=4)


def scene(**options) -> wy.Scene:
    fabric = cloth()
    return wy.Scene(fabric, pins=fabric.corners("top"), **options)


def run(given: wy.Scene, steps: int = STEPS, **options) -> wy.Trajectory:
    return wy.Simulator(given, **options).run(steps)


def falling(time: float) -> tuple[float, float, float]:
    return (3.0 * np.sin(400.0 * time), 0.0, -9.8)


def blowing(time: float) -> tuple[float, float, float]:
    return (0.0, 5.0 * np.cos(300.0 * time), 1.0)


def pulling(time: float) -> tuple[float, float, float]:
    return (1e-4 * np.sin(200.0 * time), 0.0, 0.0)


def rows(function, steps: int = STEPS) -> np.ndarray:
    """What it says in the middle of each step."""
    return np.array([function((k + 0.5) * STEP) for k in range(steps)])


GIVEN = {
    "gravity": (lambda value: {"gravity": value}, falling),
    "wind": (lambda value: {"wind": wy.Wind(velocity=value)}, blowing),
    "forces": (lambda value: {"forces": {13: value, 15: (0.0, 0.0, 1e-5)}}, pulling),
}


@pytest.mark.parametrize("method", [name for name in METHODS if name != "esdirk3"])
@pytest.mark.parametrize("name", GIVEN)
def test_rows_are_steps_one_by_one(name, method):
    """A run whose input changes is the runs of one step each with an input that does not."""
    make, function = GIVEN[name]
    whole = run(scene(**make(rows(function))), integrator=method)
    state = None
    for k, value in enumerate(rows(function)):
        simulator = wy.Simulator(scene(**make(value)), integrator=method)
        if state is not None:
            simulator.state = state
        state = simulator.run(1)[-1]
        np.testing.assert_array_equal(state.position, whole.position[k + 1])
    still = run(scene(**make(rows(function)[0])), integrator=method)
    # as much as the sum of what differs does in 8 ms
    assert np.abs(still.position[-1] - state.position).max() > 1e-8


@pytest.mark.parametrize("name", ["gravity", "wind"])
def test_the_last_row_stays(name):
    make, function = GIVEN[name]
    values = rows(function)
    values[3:] = values[2]
    np.testing.assert_array_equal(run(scene(**make(values))).position, run(scene(**make(values[:3]))).position)


@pytest.mark.parametrize("method", ["sdirk2", "linear"])
@pytest.mark.parametrize("name", GIVEN)
def test_a_function_of_time_is_its_rows(name, method):
    make, function = GIVEN[name]
    by_function, by_rows = (
        wy.Simulator(scene(**make(value)), integrator=method) for value in (function, rows(function, STEPS + 2))
    )
    first, second = by_function.run(STEPS), by_rows.run(STEPS)
    np.testing.assert_array_equal(first.position, second.position)
    # it is looked up by steps_done, and goes on
    np.testing.assert_array_equal(by_function.run(2).position, by_rows.run(2).position)
    np.testing.assert_array_equal(by_function.reactions(first), by_rows.reactions(second))
    work = by_function.work(first), by_rows.work(second)
    assert work[0].keys() == work[1].keys()
    for kind in work[0]:
        np.testing.assert_array_equal(work[0][kind], work[1][kind])


def test_looking_back_leaves_functions_where_they_are():
    ways = []
    for look in (False, True):
        simulator = wy.Simulator(scene(gravity=falling, wind=wy.Wind(velocity=blowing)))
        trajectory = simulator.run(4)
        forces = simulator.forces()
        if look:
            simulator.reactions(trajectory)
            again = simulator.forces()
            for name in forces:
                np.testing.assert_array_equal(forces[name][0], again[name][0])
        ways.append(simulator.run(3))
    assert ways[0] == ways[1]


# -- gusts -------------------------------------------------------------------------------------------------------------


@wp.func
def waves(position: wp.vec3d, time: wp.float64):
    speed = wp.float64(4.0) * wp.sin(wp.float64(1000.0) * position[0] + wp.float64(500.0) * time)
    return wp.vec3d(wp.float64(0.0), speed, wp.float64(0.0))


def waves_on_the_host(position: np.ndarray, time: float) -> np.ndarray:
    result = np.zeros_like(position)
    result[:, 1] = 4.0 * np.sin(1000.0 * position[:, 0] + 500.0 * time)
    return result


@wp.func
def even(position: wp.vec3d, time: wp.float64):
    return wp.vec3d(wp.float64(0.0), wp.float64(5.0) * wp.cos(wp.float64(300.0) * time), wp.float64(1.0))


EVEN = {
    "device": even,
    "nodes": lambda position, time: np.tile(blowing(time), (len(position), 1)),
    "vector": lambda position, time: blowing(time),
}


@pytest.mark.parametrize("gusts", EVEN.values(), ids=EVEN)
def test_gusts_that_are_the_same_everywhere_are_a_wind(gusts):
    wind, gusty = (wy.Simulator(scene(wind=wy.Wind(velocity=value))) for value in (rows(blowing), gusts))
    first, second = wind.run(STEPS), gusty.run(STEPS)
    # the mean of three equal velocities is rounded
    np.testing.assert_allclose(second.position, first.position, atol=1e-15)
    np.testing.assert_allclose(gusty.reactions(second), wind.reactions(first), atol=1e-13)


def test_the_device_and_the_host_evaluate_the_same_places():
    """With one stage a step both look at its beginning."""
    device, host = (
        run(scene(wind=wy.Wind(velocity=gusts)), integrator="implicit-euler") for gusts in (waves, waves_on_the_host)
    )
    np.testing.assert_allclose(device.position, host.position, atol=1e-15)
    # sdirk2 evaluates them on the device where each stage begins: the cloth moves some 1e-5 m in a step of 1e-3/rad m
    device, host = (run(scene(wind=wy.Wind(velocity=gusts))) for gusts in (waves, waves_on_the_host))
    np.testing.assert_allclose(device.position, host.position, atol=1e-2 * np.ptp(device.position[:, -1, 1]))
    assert np.abs(device.position - host.position).max() > 0.0


def test_gusts_press_where_they_are():
    """The force of each triangle by the formula of physics.md, with the mean of its corners' gusts."""
    simulator = wy.Simulator(scene(wind=wy.Wind(velocity=waves_on_the_host)))
    simulator.run(1)
    state = simulator.state
    force, _ = simulator.forces()["wind"]
    air = waves_on_the_host(state.position, 0.5 * STEP)
    expected = np.zeros_like(force)
    for nodes in simulator.scene.cloth.topology.triangle_nodes:
        x = state.position[nodes]
        cross = np.cross(x[1] - x[0], x[2] - x[0])
        area, n = 0.5 * np.linalg.norm(cross), cross / np.linalg.norm(cross)
        relative = air[nodes].mean(axis=0) - state.velocity[nodes].mean(axis=0)
        v_n = n @ relative
        expected[nodes] += (2.0 * area * abs(v_n) * v_n * n + 0.5 * area * (relative - v_n * n)) / 3.0
    np.testing.assert_allclose(force, expected, atol=1e-12 * np.abs(expected).max())
    assert np.abs(expected[:, 1]).min() < 0.5 * np.abs(expected[:, 1]).max()


# -- a hook ------------------------------------------------------------------------------------------------------------


class Recorder:
    """A hook that writes down what it sees, and may set inputs."""

    def __init__(self, **inputs):
        self.inputs, self.seen = inputs, []

    def __call__(self, simulator: wy.Simulator) -> None:
        self.seen.append((simulator.steps_done, simulator.time, simulator.state.position.copy()))
        simulator.set_inputs(**{name: function(simulator.time + 0.5 * STEP) for name, function in self.inputs.items()})


def test_a_hook_comes_before_each_step_and_sees_its_state():
    hook = Recorder()
    simulator = wy.Simulator(scene(), hook=hook)
    trajectory = simulator.run(5)
    assert [seen[0] for seen in hook.seen] == [0, 1, 2, 3, 4]
    np.testing.assert_allclose([seen[1] for seen in hook.seen], STEP * np.arange(5))
    np.testing.assert_array_equal([seen[2] for seen in hook.seen], trajectory.position[:-1])
    np.testing.assert_array_equal(trajectory.position, run(scene(), 5).position)
    # in whatever way it is run: by chunks, too
    assert simulator.chunk == 1
    assert simulator.run_chunk(1) == 1
    assert len(hook.seen) == 6


def test_a_hook_is_not_skipped_where_steps_are_split():
    """Once a step, before its first part."""
    hook = Recorder()
    fabric = wy.paper.cloth(rows=7, columns=7, pose="flat")
    simulator = wy.Simulator(wy.Scene(fabric, gravity=None), hook=hook)
    state = simulator.state
    state.position[:] = 1.3 * state.position
    simulator.state = state
    simulator.run(3)
    assert simulator.split_steps
    assert [seen[0] for seen in hook.seen] == [0, 1, 2]


@pytest.mark.parametrize("method", ["sdirk2", "linear"])
def test_what_a_hook_sets_is_what_rows_say(method):
    given = scene(gravity=(0, 0, 0), wind=wy.Wind(velocity=(0, 0, 0)), forces={13: (0, 0, 0)})
    hook = Recorder(gravity=falling, wind=blowing, forces=lambda time: {13: pulling(time)})
    simulator = wy.Simulator(given, hook=hook, integrator=method)
    found = simulator.run(STEPS)
    by_rows = scene(gravity=rows(falling), wind=wy.Wind(velocity=rows(blowing)), forces={13: rows(pulling)})
    expected = run(by_rows, integrator=method)
    # (k + 0.5) h and k h + 0.5 h are rounded otherwise
    np.testing.assert_allclose(found.position, expected.position, atol=1e-14)


def test_a_hook_leads_pins_by_what_it_sees():
    """Pins follow the lowest node sideways: rows of pin_path that are written as the run comes to them."""
    fabric = cloth()
    pins = fabric.corners("top")
    path = np.repeat(fabric.position[pins][None], STEPS, axis=0)
    told = []

    def follow(simulator: wy.Simulator) -> None:
        state = simulator.state
        lowest = state.position[state.position[:, 2].argmin()]
        told.append(fabric.position[pins] + [0.0, 1e-4 * len(told) + 0.1 * lowest[1], 0.0])
        simulator.set_inputs(pins=told[-1])

    for stiffness in (None, 1e4):
        told.clear()
        given = wy.Scene(fabric, pins=pins, pin_stiffness=stiffness, pin_path=path, wind=wy.Wind(velocity=(0, 5, 0)))
        found = wy.Simulator(given, hook=follow).run(STEPS)
        expected = run(given.replace(pin_path=np.array(told)))
        np.testing.assert_array_equal(found.position, expected.position)
    simulator = wy.Simulator(given, hook=follow)
    simulator.run(STEPS)
    with pytest.raises(wy.InputError, match=r"pins cannot be set after 8 steps: scene\.pin_path has 8 rows"):
        simulator.run(1)
    # it stays at the last step that was made, and can go on
    assert simulator.steps_done == STEPS


def test_a_hook_reads_reactions_of_the_step_before():
    pulls = []

    def read(simulator: wy.Simulator) -> None:
        if simulator.steps_done:
            pulls.append(simulator.reactions())

    given = scene(pin_stiffness=None)
    hooked = wy.Simulator(given, hook=read)
    trajectory = hooked.run(5)
    plain = wy.Simulator(given)
    np.testing.assert_allclose(pulls, plain.reactions(plain.run(5))[:-1], atol=1e-15)
    with pytest.raises(wy.InputError, match="trajectory with a hook"):
        hooked.reactions(trajectory)


@pytest.mark.parametrize("wrong", ["run", "state"])
def test_a_hook_may_not_move_the_simulator(wrong):
    acted = []

    def act(simulator: wy.Simulator) -> None:
        if simulator.steps_done == 2 and not acted:
            acted.append(True)
            if wrong == "run":
                simulator.run(1)
            else:
                simulator.state = simulator.state

    simulator = wy.Simulator(scene(), hook=act)
    with pytest.raises(wy.InputError, match="a hook made steps or set the state"):
        simulator.run(4)


def test_an_exception_of_a_hook_leaves_the_last_step():
    class Stop(Exception):
        pass

    def stop(simulator: wy.Simulator) -> None:
        if simulator.steps_done == 3:
            raise Stop

    simulator = wy.Simulator(scene(), hook=stop)
    with pytest.raises(Stop):
        simulator.run(5)
    assert simulator.steps_done == 3
    assert len(simulator.trajectory) == 4


def test_hooks_go_with_copies():
    simulator = wy.Simulator(scene(gravity=falling), hook=_lighter)
    simulator.run(2)
    others = copy.copy(simulator), pickle.loads(pickle.dumps(simulator))
    expected = simulator.run(3)
    for other in others:
        assert other.run(3) == expected


def _lighter(simulator: wy.Simulator) -> None:
    pass


def test_inputs_between_runs():
    simulator = wy.Simulator(scene())
    simulator.run(3)
    state = simulator.state
    simulator.set_inputs(gravity=(0.0, 5.0, 0.0))
    found = simulator.run(3)
    other = wy.Simulator(scene(gravity=(0.0, 5.0, 0.0)))
    other.state = state
    np.testing.assert_array_equal(found.position, other.run(3).position)
    assert not simulator.split_steps
    # and a copy has it
    np.testing.assert_array_equal(copy.copy(simulator).run(2).position, simulator.run(2).position)


def test_what_is_set_once_stays():
    """In every row from the next step on, and in none before."""
    fabric = cloth()
    pins = fabric.corners("top")
    place = fabric.position[pins] + np.array([0.0, 1e-4, 0.0])
    path = np.repeat(fabric.position[pins][None], 6, axis=0)
    given = wy.Scene(
        fabric, pins=pins, pin_path=path, gravity=rows(falling, 6), wind=wy.Wind(velocity=rows(blowing, 6)),
        forces={13: rows(pulling, 6)},
    )  # fmt: skip
    simulator = wy.Simulator(given)
    first = simulator.run(2)
    values = np.array([0.0, 2.0, -3.0])
    simulator.set_inputs(gravity=values, wind=values, forces={13: 1e-5 * values}, pins=place)
    second = simulator.run(4)

    def changed(before: np.ndarray, value: np.ndarray) -> np.ndarray:
        return np.concatenate([before[:2], np.broadcast_to(value, (4, *before.shape[1:]))])

    expected = given.replace(
        pin_path=changed(path, place), gravity=changed(rows(falling, 6), values),
        wind=wy.Wind(velocity=changed(rows(blowing, 6), values)), forces={13: changed(rows(pulling, 6), 1e-5 * values)},
    )  # fmt: skip
    np.testing.assert_array_equal(np.concatenate([first.position, second.position[1:]]), run(expected, 6).position)


def test_a_jump_of_gravity_is_no_gain_of_energy():
    """From a tenth of gravity to ten times as much against it, and back, at every step."""
    values = np.tile([[0.0, 0.0, -1.0], [0.0, 0.0, 90.0]], (10, 1))
    simulator = wy.Simulator(scene(gravity=values, sliding=False))
    simulator.run(20)
    assert not simulator.damped_steps


# -- what is refused ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: scene(gravity=np.zeros((0, 3))), "gravity has no step, must have at least one"),
        (lambda: scene(gravity=np.zeros((4, 2))), r"gravity has shape \(4, 2\), must be \(any, 3\)"),
        (lambda: scene(gravity=[[1.0, 2.0, 3.0], [1.0]]), "gravity must be 3 numbers, or steps × 3"),
        (lambda: scene(gravity=[[0.0, 0.0, np.nan]]), r"gravity\[0, 2\] is nan"),
        (lambda: scene(gravity=waves_on_the_host), "gravity is a function of place, must be one of time"),
        (lambda: scene(gravity=lambda: 0), r"gravity takes 0 arguments, must be of \(time\)"),
        (lambda: wy.Wind(velocity=lambda a, b, c: 0), r"wind velocity takes 3 arguments"),
        (lambda: wy.Wind(velocity=np.zeros((2, 2))), r"wind velocity has shape \(2, 2\)"),
        (lambda: scene(forces={3: waves}), r"forces\[3\] is a function of place"),
        (lambda: run(scene(gravity=lambda time: (0, 0))), r"gravity\(0.0005\) has shape \(2,\), must be \(3\)"),
        (lambda: run(scene(gravity=lambda time: (0, 0, np.inf))), r"gravity\(0.0005\)\[2\] is inf"),
        (lambda: run(scene(wind=wy.Wind(velocity=lambda x, t: x[1:]))), r"wind velocity.* has shape \(15, 3\)"),
        (lambda: wy.Simulator(scene(), hook=3), "hook = 3, must be a function"),
        (lambda: wy.Simulator(scene(), hook=print, chunk=4), "chunk = 4, must be 1 or None with a hook"),
        (lambda: wt.Rollout(scene(gravity=falling), 2), "gravity: functions have no gradient"),
        (lambda: wt.Rollout(scene(wind=wy.Wind(velocity=waves)), 2), "wind: functions have no gradient"),
        (lambda: wt.Rollout(scene(), 2, hook=print), "hook with differentiable"),
        (lambda: wy.Simulator(scene(gravity=None)).set_inputs(gravity=(0, 0, 1)), "the scene has none"),
        (lambda: wy.Simulator(scene()).set_inputs(wind=(0, 0, 1)), "wind cannot be set: the scene has none"),
        (lambda: wy.Simulator(scene()).set_inputs(pins=np.zeros((2, 3))), "pin_path has 0 rows"),
        (lambda: wy.Simulator(scene()).set_inputs(forces={3: (0, 0, 1)}), "forces names node 3, must be one that"),
        (lambda: wy.Simulator(scene()).set_inputs(forces=3), "forces = 3, must be a dictionary"),
        (lambda: wy.Simulator(scene(gravity=falling)).set_inputs(gravity=(0, 0, 1)), "gives it by a function"),
        (lambda: wy.Simulator(scene()).set_inputs(gravity=(0, 0)), r"gravity has shape \(2,\)"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_refused(make, message):
    with pytest.raises(wy.InputError, match=message):
        make()


def test_rows_in_steps_of_another_length():
    """Learning's: means over the model's step, of two and a half rows; ablation's: each row twice."""
    values = rows(falling, 4)
    given = scene(gravity=values, wind=wy.Wind(velocity=values))
    longer = with_paths(given, given.cloth.position[given.pins], 0, Fraction(5, 2), 2)
    means = [(values[0] + values[1] + 0.5 * values[2]) / 2.5, (0.5 * values[2] + 2.0 * values[3]) / 2.5]
    np.testing.assert_allclose(longer.gravity, means, rtol=1e-14)
    np.testing.assert_allclose(longer.wind.velocity, means, rtol=1e-14)
    for half in (halved(given, None), halved(scene(forces={3: falling}, wind=wy.Wind(velocity=falling)), None)):
        if half.functions:
            assert half.functions == {"wind": falling, 3: falling}
        else:
            np.testing.assert_array_equal(half.gravity, np.repeat(values, 2, axis=0))
            np.testing.assert_array_equal(half.wind.velocity, np.repeat(values, 2, axis=0))


# -- recordings --------------------------------------------------------------------------------------------------------


def test_rows_are_recorded(tmp_path):
    given = scene(gravity=rows(falling), wind=wy.Wind(velocity=rows(blowing), drag=0.3))
    path = tmp_path / "run.npz"
    trajectory = run(given, 3)
    trajectory.save(path)
    loaded = wy.Trajectory.load(path)
    assert loaded.scene.same_as(given)
    assert not loaded.scene.same_as(given.replace(gravity=rows(falling)[::-1]))
    simulator = wy.Simulator(loaded.scene)
    simulator.state, simulator.steps_done = loaded[-1], loaded.steps_done
    np.testing.assert_array_equal(simulator.run(2).position, run(given, 5).position[3:])


def test_functions_are_not_recorded_and_that_is_said(tmp_path):
    path = tmp_path / "run.npz"
    trajectory = run(scene(gravity=falling), 2)
    with pytest.warns(wy.WarpYarnWarning, match=r"run.npz is written without its scene: functions \(gravity\)"):
        trajectory.save(path)
    assert wy.Trajectory.load(path).scene is None
    assert wy.Trajectory.load(path) == trajectory


@pytest.mark.parametrize("name", ["run.npz", "run.h5"])
def test_films_of_functions_are_written_without_their_scene(tmp_path, name):
    path = tmp_path / name
    simulator = wy.Simulator(scene(wind=wy.Wind(velocity=blowing)))
    with pytest.warns(wy.WarpYarnWarning, match=rf"{name} is written without its scene: functions \(wind\)") as told:
        simulator.record(path, tmp_path / "run.usdc", steps=2)
    assert len(told) == 1 and told[0].filename == __file__
    loaded = wy.Trajectory.load(path)
    assert loaded.scene is None and loaded == run(simulator.scene, 2)
    with pytest.raises(wy.InputError, match="has no scene"):
        simulator.record(tmp_path / "more.npz", steps=1, after=path)
    with pytest.raises(wy.InputError, match="has no scene to go on with"):
        wy.Simulator.resumed(path)
    # what is in memory has it
    assert wy.Simulator.resumed(run(simulator.scene, 2)).run(1)[1] == run(simulator.scene, 3)[3]


def test_recordings_of_a_run_with_a_hook_go_on_without_it(tmp_path):
    """A hook is no option that a file holds; who goes on gives it again."""
    path, options = tmp_path / "run.npz", {"hook": lambda simulator: simulator.set_inputs(gravity=(1.0, 0.0, 0.0))}
    simulator = wy.Simulator(scene(), **options)
    simulator.record(path, steps=2)
    whole = run(scene(), 4, **options)
    assert "hook" not in wy.Trajectory.load(path).options
    assert wy.Simulator.resumed(path, **options).run(2) == whole[2:]
    assert wy.Simulator.resumed(path).run(2) != whole[2:]


# -- gradients ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_gradients_of_rows(method):
    """Against differences: of each number of gravity in 3 rows and of wind in 2, the last of which stay for 5 steps."""
    random = np.random.default_rng(0)
    given = scene(gravity=5.0 * random.normal(size=(3, 3)), wind=wy.Wind(velocity=5.0 * random.normal(size=(2, 3))))
    rollout = wt.Rollout(given, 5, integrator=method, tolerance=EXACT, newton_tolerance=1e-12)
    assert rollout.inputs["gravity"] == (3, 3) and rollout.inputs["wind_velocity"] == (2, 3)
    weights = torch.tensor(random.normal(size=(6, 16, 3)))

    def loss(gravity: torch.Tensor, wind: torch.Tensor) -> torch.Tensor:
        return 1e6 * (rollout(gravity=gravity, wind_velocity=wind).position * weights).sum()

    inputs = [rollout.defaults[name].requires_grad_() for name in ("gravity", "wind_velocity")]
    loss(*inputs).backward()
    for k, each in enumerate(inputs):
        for entry in np.ndindex(*each.shape):
            ends = []
            for sign in (1.0, -1.0):
                changed = [value.detach().clone() for value in inputs]
                changed[k][entry] += 1e-3 * sign
                with torch.no_grad():
                    ends.append(loss(*changed).item())
            wanted = (ends[0] - ends[1]) / 2e-3
            # positions of 3e-3 m are rounded by 1e-18 m, times 1e6 and 300 numbers over 2e-3; and curvature of wind
            assert each.grad[entry].item() == pytest.approx(wanted, rel=1e-5, abs=1e-5 * float(each.grad.abs().max()))
    assert all(bool((value.grad.abs() > 0.0).all()) for value in inputs)


# -- with contact, cloths of several numbers, single precision ---------------------------------------------------------


@wp.func
def gusts_of_doubles(position: wp.vec3d, time: wp.float64):
    return wp.vec3d(wp.float64(0.0), wp.sin(wp.float64(200.0) * position[0] + time), wp.float64(0.0))


@wp.func
def gusts_of_singles(position: wp.vec3f, time: wp.float32):
    return wp.vec3f(0.0, wp.sin(200.0 * position[0] + time), 0.0)


def gusts_of_arrays(position: np.ndarray, time: float) -> np.ndarray:
    return np.sin(200.0 * position[:, :1] + time) * [0.0, 1.0, 0.0]


@pytest.mark.parametrize("precision", ["double", "single"])
def test_gusts_on_the_device_are_of_the_precision(precision):
    functions = {"double": gusts_of_doubles, "single": gusts_of_singles}
    cloth = wy.fabrics.glass_7628(rows=5, columns=5)
    ends = []
    for function in (gusts_of_arrays, functions.pop(precision)):
        scene = wy.Scene(cloth, pins=cloth.corners("top"), wind=wy.Wind(velocity=function))
        simulator = wy.Simulator(scene, precision=precision)
        simulator.run(5)
        ends.append(simulator.state.position)
    # of 3e-5 m that it falls: the solver's tolerances; single precision rounds the pull of glass, by 1e-6 to 3e-6 here
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-8 if precision == "double" else 5e-6)
    (other,) = functions.values()
    wanted = "vec3d" if precision == "double" else "vec3f"
    with pytest.raises(wy.InputError, match=rf"wp\.func that cannot be compiled, .*wp\.{wanted}.* in {precision} prec"):
        wy.Simulator(scene.replace(wind=wy.Wind(velocity=other)), precision=precision)


@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("fabric", [wy.fabrics.handkerchief, wy.fabrics.glass_7628], ids=["plain", "general"])
def test_ways_to_vary_agree_where_cloth_touches(fabric, precision):
    """Rows, a function of the middle of each step, and a hook say the same of a cloth on the ground."""
    cloth = fabric(rows=4, columns=5, pose="flat")
    ground = wy.Plane(point=(0, 0, -1.5 * cloth.half_thickness), normal=(0, 0, 1))
    upper = cloth.replace(pose=cloth.position + np.array([0.0, 0.0, 1.3 * max(1.5 * cloth.longest_spacing, 1e-3)]))
    scene = wy.Scene([cloth, upper], obstacles=[ground], self_contact=True, gravity=(0.0, 0.0, 0.0))

    def weight(time):
        return np.array([0.0, 2.0, -9.8]) * (1.0 + 500.0 * time)

    rows = np.array([weight((k + 0.5) * 1e-3) for k in range(10)])
    ways = {
        "rows": ({"gravity": rows}, None),
        "function": ({"gravity": weight}, None),
        "hook": ({}, lambda simulator: simulator.set_inputs(gravity=weight((simulator.steps_done + 0.5) * 1e-3))),
    }
    ends = {}
    for name, (changes, hook) in ways.items():
        simulator = wy.Simulator(scene.replace(**changes), hook=hook, precision=precision)
        forces = []
        for _ in range(10):
            simulator.run(1)
            forces.append(np.abs(simulator.forces()["obstacles"][0]).max())
        assert max(forces) > 0.0
        ends[name] = simulator.state.position
    for name in ("function", "hook"):
        np.testing.assert_allclose(ends[name], ends["rows"], rtol=0.0, atol=1e-12 if precision == "double" else 1e-8)


def test_a_hook_may_place_obstacles():
    """A ground that it lifts carries the cloth along."""
    cloth = wy.fabrics.handkerchief(rows=4, columns=4, pose="flat")
    start = -2.0 * cloth.radius
    ground = wy.Plane(point=(0, 0, start), normal=(0, 0, 1))

    def lift(simulator: wy.Simulator) -> None:
        simulator.place_obstacles([[0.0, 0.0, start + 1e-5 * simulator.steps_done]])

    simulator = wy.Simulator(wy.Scene(cloth, obstacles=[ground]), hook=lift)
    simulator.run(40)
    height = simulator.state.position[:, 2] - (start + 1e-5 * 39)
    assert height.min() > cloth.radius and height.max() < 3.0 * cloth.radius
