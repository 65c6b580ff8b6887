"""Learning from frames: the problem, the search, what it leaves open, and scenes/learn.py; eq. 2, at most 5 × 5."""

import concurrent.futures
import copy
import csv
import dataclasses
import json
import multiprocessing
import pickle
from fractions import Fraction

import h5py
import numpy as np
import pytest
import torch
from pxr import Usd, UsdGeom
from scripts import exit_code, load, samples

import warp_yarn as wy
from warp_yarn.calibration import learn as wl
from warp_yarn.calibration.learn import PAPER, Parameter, Task, learn, value_of, with_values
from warp_yarn.io.published import DATASETS, PROPERTIES
from warp_yarn.simulation.state import FIELDS

scene_script = load("scenes/learn.py")
optimizers = load("benchmarks/optimizers.py")
uncertainty = load("benchmarks/uncertainty.py")

SCENE = wy.paper.hung_cloth(rows=4, columns=4)
FRAMES = 8
SHEAR, BEND, DENSITY, FRICTION = (
    next(p for p in PAPER if p.name == name) for name in ("shear", "bend[0]", "density[0]", "friction")
)
COULOMB = {"friction_sharpness": 1e6}


def motion(scene=SCENE, frames=FRAMES, step=1e-3, **options):
    # differentiable: the kernels that learning uses, so that no others are compiled
    return wy.Simulator(scene, step=step, differentiable=True, **{"integrator": "linear", **options}).run(frames)


@pytest.fixture(scope="module")
def data():
    """A cloth with hard friction."""
    return motion(with_values(SCENE, COULOMB))


def task(target, parameters=(DENSITY, BEND, SHEAR), scene=SCENE, **options):
    return Task(scene, target, parameters, **{"integrator": "linear", **options})


def truth(of):
    return np.array([value_of(of.scene, name) for name in of.names])


# -- parameters -------------------------------------------------------------------------------------------------------


def test_every_value_that_can_be_learned_is_read_and_replaced():
    names = [
        name if count is None else f"{name}[{k}]"
        for name, count in wl.learnable(SCENE).items()
        for k in range(count or 1)
    ]
    assert {"density[1]", "friction_damping", "wind_velocity[2]", "gravity[0]", "pin_stiffness"} <= set(names)
    before = {name: value_of(SCENE, name) for name in names}
    values = {name: 0.25 + 0.5 * before[name] for name in names}
    changed = with_values(SCENE, values)
    assert {name: value_of(changed, name) for name in names} == values
    assert {name: value_of(SCENE, name) for name in names} == before
    assert np.array_equal(changed.pins, SCENE.pins) and changed.terms == SCENE.terms
    # one alone leaves the others
    one = with_values(SCENE, {"bend[1]": 1.0})
    assert {name: value_of(one, name) for name in names} == {**before, "bend[1]": 1.0}


REFUSED = {
    "range": (lambda: Parameter("shear", 2.0, 1.0, 1.5), r"shear: low = 2, must be below high = 1"),
    "start": (lambda: Parameter("shear", 0.0, 1.0, 1.5), r"shear: start = 1\.5, must be from 0 to 1"),
    "not a number": (lambda: Parameter("shear", float("nan"), 1.0, 0.5), r"shear: low = nan"),
    "unknown": (lambda: value_of(SCENE, "colour"), r"'colour', must be one that this scene has: density, "),
    "no index": (lambda: value_of(SCENE, "bend"), r"'bend', must have an index from 0 to 1"),
    "index": (lambda: value_of(SCENE, "bend[2]"), r"'bend\[2\]', must have an index from 0 to 1"),
    "one number": (lambda: value_of(SCENE, "shear[0]"), "shear is one number"),
    "syntax": (lambda: value_of(SCENE, "bend[-1]"), r"'bend\[-1\]', must be a name"),
    "no wind": (lambda: value_of(wy.Scene(SCENE.cloth), "wind_drag"), "'wind_drag', must be one that this scene has"),
    "value": (lambda: with_values(SCENE, {"density[0]": 0.0}), r"density = 0\.0, must be finite and above 0"),
    "no parameters": (lambda: task(motion(frames=1), []), "parameters is empty"),
    "twice": (lambda: task(motion(frames=1), [SHEAR, SHEAR]), "names 'shear' twice"),
    "range end": (lambda: task(motion(frames=1), [Parameter("density[0]", 0, 1, 0.5)]), r"density = 0\.0"),
    "frames": (lambda: task(motion(frames=3), frames=4), r"frames = 4.*target has 4 frames, which leaves 3"),
    "no frames": (lambda: task(motion(frames=3), first=3), r"first = 3.*leaves 0 to compare with"),
    "every": (lambda: task(motion(frames=3), frames=2, every=2), r"frames = 2, .*leaves 1 to compare with"),
    "step": (lambda: task(motion(frames=1), step=3e-4), r"step = 0\.0003 s.*whole number of times into the 0\.001 s"),
    "size": (lambda: task(motion(wy.paper.hung_cloth(rows=5, columns=4), 1)), "has 5 × 4 nodes, must have .* 4 × 4"),
    "shape": (
        lambda: task(dataclasses.replace(motion(frames=1), euler=np.zeros((2, 16, 3)))),
        "target.euler has shape",
    ),
    "NaN": (lambda: task(with_nan(motion(frames=2))), r"target\.position\[1, 3, 2\] is nan, must be finite"),
    "iterations": (lambda: learn(task(motion(frames=1)), iterations=-1), "iterations = -1"),
    "halvings": (lambda: learn(task(motion(frames=1)), halvings=-1), "halvings = -1"),
    "resolution": (lambda: learn(task(motion(frames=1)), resolution=0.0), r"resolution = 0\.0.*above 0"),
    "checkpoint": (lambda: learn(task(motion(frames=1)), checkpoint="a.json"), r"'a\.json', must end in \.npz"),
}


def with_nan(trajectory):
    trajectory.position[1, 3, 2] = np.nan
    return trajectory


@pytest.mark.parametrize("case", REFUSED)
def test_refused(case):
    call, message = REFUSED[case]
    with pytest.raises(wy.InputError, match=message):
        call()


# -- the problem ------------------------------------------------------------------------------------------------------


def test_the_model_starts_in_the_first_frame_and_meets_every_so_many_th_one():
    fine = motion(frames=14, step=2.5e-4)
    problem = task(fine, first=2, every=4, step=2.5e-4)
    assert (problem.step, problem.steps_per_frame, len(problem.positions)) == (2.5e-4, 4, 3)
    # friction's anchors and all: the same steps from the same state, to the last bit
    assert problem.loss(truth(problem)) == 0.0
    again = problem.trajectory(truth(problem), 2)
    assert again.step == 1e-3
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(again, name), getattr(fine, name)[2:11:4])


def test_the_loss_is_the_mean_square_of_distances(data):
    problem = task(data)
    values = problem.start
    offset = motion(problem.scene_with(values)).position[1:] - data.position[1:]
    expected = np.mean([np.linalg.norm(row) ** 2 for row in offset.reshape(-1, 3)])
    assert problem.loss(values) == pytest.approx(expected, rel=1e-12)
    assert (problem.simulations, problem.gradients) == (1, 0)


def test_gradient_and_jacobian_agree_with_differences_of_the_loss(data):
    # All but friction, which moves these positions by 3e-13 m: the solver leaves as much in a difference.
    problem = task(data, PAPER[:-1], tolerance=1e-13)
    values, width = problem.start, problem.high - problem.low
    loss, gradient = problem.loss_and_gradient(values)
    assert loss == pytest.approx(problem.loss(values), rel=1e-12)
    residuals = problem.residuals(values)
    jacobian = problem.jacobian(values, residuals)
    # central ones leave (1e-4)² of curvature, one-sided ones 1e-4
    differences = [problem.loss(values + d) - problem.loss(values - d) for d in np.diag(1e-4 * width)]
    scale = 2.0 * np.linalg.norm(jacobian, axis=0) * np.sqrt(loss)
    np.testing.assert_allclose(gradient * width / scale, np.array(differences) / 2e-4 / scale, atol=1e-7)
    np.testing.assert_allclose(2.0 * jacobian.T @ residuals / scale, gradient * width / scale, atol=1e-3)
    assert np.abs(gradient * width / scale).max() > 0.1  # or all of it could be 0
    # of the Jacobian, one shows what the solver leaves
    assert (problem.simulations, problem.gradients) == (1 + 1 + 1 + 8 + 14, 1)


def failing_where(problem, fails):
    """Makes a task's simulations fail at some values."""
    residuals, asked = problem.residuals, []

    def or_fail(values):
        asked.append(values)
        if fails(values):
            raise wy.SimulationError("too stiff", step=1, node=-1, term=None, trajectory=None)
        return residuals(values)

    problem.residuals = or_fail
    return asked


def test_differences_stay_in_the_ranges_and_turn_round_where_the_model_fails(data):
    problem = task(data)
    asked = failing_where(problem, lambda values: False)
    for values in (problem.low, problem.high, truth(problem)):
        problem.jacobian(values, problem.residuals(values))
    assert (asked >= problem.low).all() and (asked <= problem.high).all()
    values = truth(problem)
    residuals = problem.residuals(values)
    usual = problem.jacobian(values, residuals)
    failing_where(problem, lambda v: v[2] < values[2])  # 1000 of 1200: the usual difference goes down
    turned = problem.jacobian(values, residuals)
    np.testing.assert_array_equal(turned[:, :2], usual[:, :2])
    assert not np.array_equal(turned[:, 2], usual[:, 2])
    np.testing.assert_allclose(turned[:, 2], usual[:, 2], atol=1e-3 * np.abs(usual[:, 2]).max())
    failing_where(problem, lambda v: v[2] != values[2])
    with pytest.raises(wy.SimulationError, match="too stiff"):
        problem.jacobian(values, residuals)


def moved(stiffness, until=24):
    """5 × 5 of soft yarns, which a step resolves; corners that go to and fro, and a node that is pulled in turns."""
    yarns = [dataclasses.replace(yarn, stretch=1e-3 * yarn.stretch) for yarn in SCENE.cloth.yarns]
    cloth = wy.Cloth(wy.Weave.plain(rows=5, columns=5), yarns=yarns)
    pins = cloth.corners("top")
    k = np.arange(1, until + 1)[:, None]
    path = cloth.position[pins] + 2e-4 * np.sin(0.5 * k)[..., None] * [[1.0, 0.5, 0.0], [0.0, 1.0, 0.5]]
    forces = {22: 2e-5 * np.cos(0.7 * k) * [0.0, 1.0, 0.0], 12: [1e-5, 0.0, 0.0]}
    return wy.Scene(cloth, pins=pins, pin_stiffness=stiffness, pin_path=path, forces=forces)


@pytest.mark.parametrize("integrator", ["linear", "sdirk2"])
@pytest.mark.parametrize("stiffness", [None, 1e4])
def test_paths_begin_with_the_frame_that_learning_begins_with(stiffness, integrator):
    """Also where stages ask for the pins' places within a step."""
    scene, options = moved(stiffness), {"integrator": integrator, "newton_tolerance": 1e-10}
    data = motion(scene, 24, **options)
    for first, every in ((8, 1), (0, 1), (9, 3), (22, 1)):
        problem = task(data, [SHEAR], scene, first=first, every=every, step=1e-3, **options)
        # the same steps from the same state, to the last bit
        assert problem.loss(truth(problem)) == 0.0
        again = problem.trajectory(truth(problem))
        np.testing.assert_array_equal(again.position, data.position[first::every][: len(again)])
    # after the last row pins stay, and the force that ends is 0
    longer = motion(scene, 30, **options)
    problem = task(longer, [SHEAR], scene, first=20, **options)
    assert problem.loss(truth(problem)) == 0.0
    assert problem.trajectory(truth(problem), 12).position[:11] == pytest.approx(longer.position[20:], abs=0.0)


@pytest.mark.parametrize("stiffness", [None, 1e4])
def test_the_same_paths_in_other_steps_leave_the_steps_error_alone(stiffness):
    scene, options = moved(stiffness), {"integrator": "sdirk2"}
    # what the scene means: pins that move linearly, forces of a row each
    start = scene.cloth.position[scene.pins]
    fine = motion(wl.with_paths(scene, start, 0, Fraction(1, 32), 24 * 32), 24 * 32, 1e-3 / 32, **options)
    data = dataclasses.replace(fine, step=1e-3, **{name: getattr(fine, name)[::32] for name in FIELDS})
    moves = np.linalg.norm(data.position[9:] - data.position[8], axis=2)

    def away(n):
        problem = task(data, [SHEAR], scene, first=8, step=1e-3 / n, **options)
        return np.sqrt(problem.loss(truth(problem)))

    distances = [away(n) for n in (1, 2, 4)]
    assert distances[0] < 0.05 * np.sqrt(np.mean(moves**2))
    # a half of the step has at most a half of its error: springs of moving pins are of order 1
    assert distances[1] < 0.55 * distances[0] and distances[2] < 0.55 * distances[1]
    # and the run with half the step, which tells learning the step's error, is the one with half the step
    problem = task(data, [SHEAR], scene, first=8, step=1e-3, **options)
    finer = problem.trajectory(truth(problem), refine=2)
    np.testing.assert_array_equal(finer.position, problem.halved().trajectory(truth(problem)).position)
    assert np.sqrt(np.mean((finer.position[1:] - data.position[9:]) ** 2) * 3.0) == pytest.approx(distances[1])


def test_paths_in_steps_of_another_length():
    scene = moved(None, until=6)
    start, path = scene.cloth.position[scene.pins], scene.pin_path
    force = scene.force_path[:, 0]

    def of(first, ratio, steps):
        result = wl.with_paths(scene, start, first, Fraction(ratio), steps)
        return result.pin_path, result.force_path[:, 0]

    pins, forces = of(0, "1/2", 14)
    np.testing.assert_allclose(pins[0], 0.5 * (start + path[0]), rtol=1e-14)
    np.testing.assert_array_equal(pins[1:12:2], path)
    np.testing.assert_array_equal(pins[12:], [path[-1], path[-1]])
    np.testing.assert_array_equal(forces, [*np.repeat(force[:6], 2, axis=0), *np.zeros((3, 3))])
    # steps of one and a half rows from row 2 on: 2 and half of 3, half of 3 and 4, 5 and half of none
    pins, forces = of(2, "3/2", 3)
    np.testing.assert_allclose(pins, [0.5 * (path[2] + path[3]), path[4], path[5]], rtol=1e-14)
    expected = [2.0 * force[2] + force[3], force[3] + 2.0 * force[4], 2.0 * force[5]]
    np.testing.assert_allclose(forces[:3], np.array(expected) / 3.0, atol=1e-18)
    # the other node's force never ends, and the scene is what it was
    assert (wl.with_paths(scene, start, 2, Fraction(1, 3), 60).force_path[:, 1] == [1e-5, 0.0, 0.0]).all()
    assert scene.pin_path is path and len(scene.force_path) == 7


def test_shear_is_learned_from_the_middle_of_a_motion_with_paths():
    scene = moved(None)
    problem = task(motion(scene, 24), [SHEAR], scene, first=8)
    result = learn(problem)
    assert result.values["shear"] == pytest.approx(1000.0, rel=1e-3)
    assert result.task is problem and result.step_share < 1e-3


@pytest.mark.slow
def test_tasks_and_results_go_to_another_process_and_back(data):
    problem = task(data)
    for made in (copy.deepcopy(problem), pickle.loads(pickle.dumps(problem))):
        assert made.loss(problem.start) == problem.loss(problem.start)
    here = learn(task(data))
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(1, mp_context=context) as pool:
        there = pool.submit(learn, problem).result()
        assert there.values == here.values and there.uncertainty == here.uncertainty
        assert there.task.loss(problem.start) == problem.loss(problem.start)
        # a model too stiff for its step
        broken = task(data, [Parameter("bend[0]", 1.0, 1e12, 1e12)], max_iterations=1)
        with pytest.raises(wy.SimulationError) as caught:
            pool.submit(learn, broken).result()
        assert caught.value.step == 1 and caught.value.iterations == []
        with pytest.raises(wy.InputError, match="iterations = -1"):
            pool.submit(learn, problem, iterations=-1).result()


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
def test_what_ends_learning_has_what_was_learned(data, tmp_path, monkeypatch, error):
    """The iterations until then, and a checkpoint to go on from."""
    uninterrupted = learn(task(data))
    real, path = Task.residuals, tmp_path / "checkpoint.npz"
    runs = []

    def counted(self, values):
        runs.append(self.simulations)
        return real(self, values)

    with monkeypatch.context() as patch:
        patch.setattr(Task, "residuals", counted)
        learn(task(data))
    # the first run, in the first Jacobian, before and after a step, in the last Jacobian
    for stop in [runs[k] + 1 for k in (0, 1, 3, 5, 6, -1)]:
        problem = task(data)

        def residuals(self, values, stop=stop):
            if self.simulations == stop - 1:
                raise error
            return real(self, values)

        path.unlink(missing_ok=True)
        with monkeypatch.context() as patch, pytest.raises(error) as caught:
            patch.setattr(Task, "residuals", residuals)
            learn(problem, checkpoint=path)
        done = caught.value.iterations
        before = [i for i in uninterrupted.history if i.simulations < stop]
        assert [i.loss for i in done] == [i.loss for i in before]
        assert path.exists() == (stop > 1)
        # the same task, as it was left
        resumed = learn(problem, checkpoint=path)
        assert resumed.values == uninterrupted.values and resumed.uncertainty == uninterrupted.uncertainty


# -- the search -------------------------------------------------------------------------------------------------------


def test_the_papers_parameters_are_learned_from_eight_frames():
    scene = wy.paper.hung_cloth(rows=5, columns=5)
    problem = task(motion(with_values(scene, COULOMB)), PAPER, scene=scene)
    result = learn(problem)
    assert list(result.values) == [p.name for p in PAPER]
    true = dict(zip(result.values, truth(problem), strict=True))
    for name in list(true)[:-1]:
        assert result.status[name] == "determined"
        # The issue asks for 1 %; 1 nm, the resolution at which learning ends, makes 0.05 % of stretch[1] here.
        assert result.values[name] == pytest.approx(true[name], rel=1e-3)
        assert abs(result.values[name] - true[name]) < 3.0 * result.uncertainty[name]
    # Friction moves these positions by 1e-11 m.
    assert result.status["friction"] == "not determined"
    assert result.values["friction"] == pytest.approx(0.7, abs=0.01)
    assert result.uncertainty["friction"] == pytest.approx(1.0 / np.sqrt(12.0), rel=1e-3)
    assert result.loss <= 1e-18 and result.ended == "as near to the data as their resolution"
    assert result.loss == pytest.approx(problem.loss(np.array(list(result.values.values()))), rel=1e-12)
    # Differences at the start alone, and for the uncertainties: Broyden's updates do for what is between.
    steps = [i.simulations for i in result.history]
    # Beside the eight, one shows what the solver leaves, and two look for what friction does.
    jacobian = len(PAPER) + 1 + 2
    assert steps == [1, *range(jacobian + 2, jacobian + len(steps) + 1)]
    # The step's error counts as two, the gradient as one, and one looks from each of the seven how far the loss rises.
    assert (result.simulations, result.gradients) == (steps[-1] + jacobian + 7 + 2 + 1, 1)
    assert len(steps) <= 8  # 7; without the updates it takes 11
    assert np.diff([i.loss for i in result.history]).max() < 0.0


def test_a_minimum_inside_the_ranges_has_no_gradient(data):
    rng = np.random.default_rng(0)
    noisy = dataclasses.replace(data, position=data.position + 1e-6 * rng.normal(size=data.position.shape))
    problem = task(noisy)
    result = learn(problem)
    assert result.ended == "converged"
    first = problem.loss_and_gradient(problem.start)[1] * (problem.high - problem.low)
    # ENOUGH of a standard deviation is some 1e-5 of a range
    assert np.abs(result.gradient).max() < 1e-3 * np.abs(first).max()


@pytest.mark.slow
def test_noise_scatters_values_as_the_uncertainties_say(data):
    rng = np.random.default_rng(1)
    problem = task(data)
    clean, errors = problem.positions, []
    for _ in range(12):
        problem.positions = clean + 1e-6 * rng.normal(size=clean.shape)
        result = learn(problem)
        deviation = np.array([result.uncertainty[name] for name in problem.names])
        error = (np.array(list(result.values.values())) - truth(problem)) / deviation
        # what a chi-squared of 3 is the sum of
        errors.append(error @ np.linalg.solve(result.correlation, error))
        assert set(result.status.values()) == {"determined"}
    # The mean of 36 squares of standard normal numbers: 1 ± 0.24; four of those.
    assert sum(errors) / 36 == pytest.approx(1.0, abs=0.95)
    assert sum(errors) / 36 > 0.25


def test_a_truth_outside_the_range_ends_on_its_bound(data):
    outside = dataclasses.replace(SHEAR, high=900.0)
    problem = task(data, [DENSITY, BEND, outside])
    result = learn(problem)
    assert result.values["shear"] == 900.0 and result.ended == "converged"
    # The loss would fall beyond the bound, and is at its minimum in the others.
    assert result.gradient[2] < 0.0
    assert np.abs(result.gradient[:2]).max() < 0.01 * -result.gradient[2]
    assert result.status["shear"].endswith("at its upper bound")
    assert "bound" not in result.status["density[0]"]


@pytest.mark.parametrize("worse", [False, True])
def test_a_trial_that_fails_or_is_worse_was_a_step_too_long(data, worse):
    problem = task(data)
    # The start, four runs of the Jacobian, and the first trial.
    asked = failing_where(problem, lambda values: len(asked) == 6 and not worse)
    if worse:
        right = problem.residuals
        problem.residuals = lambda values: right(values) * (10.0 if len(asked) == 6 else 1.0)
    result = learn(problem)
    first, second = (np.linalg.norm((v - problem.start) / (problem.high - problem.low)) for v in asked[5:7])
    assert 0.0 < second < first
    np.testing.assert_allclose(result.history[1].values, asked[6])
    np.testing.assert_allclose(list(result.values.values()), truth(problem), rtol=1e-3)


def test_a_start_that_cannot_be_simulated_raises(data):
    problem = task(data)
    failing_where(problem, lambda values: True)
    with pytest.raises(wy.SimulationError, match="too stiff"):
        learn(problem)


@pytest.mark.slow
@pytest.mark.parametrize(("after", "times"), [(1, 1), (3, 1), (5, 4)])
def test_a_resumed_run_ends_where_an_uninterrupted_one_ends(tmp_path, after, times):
    rng = np.random.default_rng(0)
    fine = motion(with_values(SCENE, COULOMB), frames=FRAMES * times, step=1e-3 / times)
    noisy = dataclasses.replace(fine, position=fine.position + 1e-7 * rng.normal(size=fine.position.shape))

    def of(**options):
        return learn(task(noisy, every=times), **options)

    whole = of()
    # with a step that was halved before it is interrupted
    assert len(whole.history) > after + 1 and (whole.history[after].step < 1e-3) == (times > 1)
    path = tmp_path / "checkpoint.npz"
    seen = []

    def interrupt(iteration):
        seen.append(iteration)
        if len(seen) > after:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        of(checkpoint=path, watch=interrupt)
    resumed = of(checkpoint=path)
    assert resumed.task.step == whole.task.step
    for name in ("values", "uncertainty", "step_error", "status", "loss", "simulations", "gradients", "ended"):
        assert getattr(resumed, name) == getattr(whole, name)
    np.testing.assert_array_equal(resumed.correlation, whole.correlation)
    for name in ("values", "loss", "step", "simulations", "gradients"):
        np.testing.assert_array_equal(*([getattr(i, name) for i in r.history] for r in (resumed, whole)))
    assert sorted(file.name for file in tmp_path.iterdir()) == ["checkpoint.npz"]
    # Once more: it is there already.
    again = of(checkpoint=path)
    assert (again.values, again.simulations) == (whole.values, whole.simulations)


def test_a_checkpoint_of_something_else_is_refused(data, tmp_path):
    path = tmp_path / "checkpoint.npz"
    learn(task(data), checkpoint=path, iterations=2)
    kept = path.read_bytes()
    with pytest.raises(wy.InputError, match=r"checkpoint\.npz: of other parameters"):
        learn(task(data, [DENSITY, BEND]), checkpoint=path)
    with pytest.raises(wy.InputError, match=r"checkpoint\.npz: of other parameters, ranges"):
        learn(task(data, [DENSITY, BEND, dataclasses.replace(SHEAR, high=1300.0)]), checkpoint=path)
    with pytest.raises(wy.InputError, match=r"of other parameters, .*resolution"):
        learn(task(data), checkpoint=path, resolution=1e-8)
    with pytest.raises(wy.InputError, match=r"checkpoint\.npz: of another task: it has a loss of"):
        learn(task(data, frames=FRAMES - 1), checkpoint=path)
    assert path.read_bytes() == kept
    path.write_bytes(kept[: len(kept) // 2])
    with pytest.raises(wy.InputError, match=r"checkpoint\.npz: not a checkpoint of learning .*remove it"):
        learn(task(data), checkpoint=path)


# -- uncertainties ----------------------------------------------------------------------------------------------------


def test_what_the_data_do_not_see_keeps_the_variance_of_its_range():
    rng = np.random.default_rng(2)
    seen = rng.normal(size=200)
    jacobian = np.stack([seen, np.zeros(200), seen, rng.normal(size=200)], axis=1)
    covariance = wl.uncertainties(jacobian, 1e-4)
    deviation = np.sqrt(np.diag(covariance))
    # 0 and 2 cannot be told apart: their sum is known, their difference is what it was.
    assert deviation[1] == pytest.approx(1.0 / np.sqrt(12.0), rel=1e-12)
    assert covariance[0, 2] / covariance[0, 0] == pytest.approx(-1.0, abs=1e-3)
    assert deviation[0] == pytest.approx(np.sqrt(0.5) / np.sqrt(12.0), rel=1e-3)
    # 3 is known as well as least squares of it alone, and a little worse for what it has in common with the others
    assert deviation[3] == pytest.approx(1e-2 / np.linalg.norm(jacobian[:, 3]), rel=0.05)


def test_noise_counts_as_many_residuals_and_a_smooth_misfit_as_few():
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(40, 30, 30, 3))
    # a correlation of neighbours is known to 1/√108 000
    assert wl.independent(noise) == pytest.approx(noise.size, rel=0.02)
    assert wl.independent(np.ones((10, 5, 5, 3))) == 3.0
    assert wl.independent(np.zeros((10, 5, 5, 3))) == 750.0
    smooth = noise.copy()
    for k in range(1, 40):
        smooth[k] = 0.8 * smooth[k - 1] + 0.6 * noise[k]
    # n numbers with a correlation of ρ^|i − j| have a λ of nearly (1 + ρ)/(1 − ρ). Along the other axes noise looks
    # less like noise then, since samples are alike: that is the safe side, and not far on it.
    some = noise.size * 0.2 / 1.8
    assert 0.5 * some < wl.independent(smooth) < 1.15 * some
    assert wl.residual_variance(smooth, 8, 1e-9) == pytest.approx((smooth**2).sum() / wl.independent(smooth), rel=1e-3)
    # Neighbours that differ are no more independent than those that are alike.
    alternating = smooth * (-1.0) ** np.arange(40)[:, None, None, None]
    assert wl.independent(alternating) == pytest.approx(wl.independent(smooth))
    assert wl.residual_variance(1e-12 * smooth, 8, 1e-3) == 1e-6


@pytest.mark.parametrize("times", [1, 8])
def test_the_steps_part_of_the_values_is_found_where_the_data_are_without_it(times):
    target = motion(frames=5 * times, step=2.5e-4 / times)
    problem = task(target, [dataclasses.replace(DENSITY, high=4e-3)], every=times)
    result = learn(problem, halvings=0)
    error = result.values["density[0]"] - value_of(SCENE, "density[0]")
    assert result.task is problem
    if times == 1:
        assert result.step_share < 1e-6 and abs(error) < 1e-6
        assert abs(result.step_error["density[0]"]) < 1e-3 * abs(error)
        return
    # Eq. 2's error is proportional to the step: the data have an eighth of it.
    assert result.step_share == pytest.approx(7 / 8, abs=0.05)
    # To first order; what is left is the product of two small errors.
    assert error > 0.1 * value_of(SCENE, "density[0]")
    assert result.uncertainty["density[0]"] > result.step_error["density[0]"]
    assert result.step_error["density[0]"] == pytest.approx(error, rel=0.15)
    assert result.corrected["density[0]"] == pytest.approx(value_of(SCENE, "density[0]"), rel=0.02)


def test_the_step_is_halved_to_that_of_the_data_and_no_further():
    scene = wy.paper.hung_cloth(rows=5, columns=5)
    parameters = [*PAPER[:2], *PAPER[4:7]]
    for times in (1, 4):
        fine = motion(scene, frames=5 * times, step=1e-3 / times)
        problem = task(fine, parameters, scene=scene, every=times)
        result = learn(problem)
        assert result.task.step == pytest.approx(1e-3 / times)
        steps = [i.step for i in result.history]
        assert steps[0] == problem.step == pytest.approx(1e-3) and steps[-1] == result.task.step
        assert np.diff([i.loss for i in result.history]).max() < 0.0
        # 1 nm, at which learning ends
        for name in problem.names:
            assert result.values[name] == pytest.approx(value_of(scene, name), rel=1e-3)
        if times == 4:
            # A run counts as so many as it has steps.
            before, after = (next(i for i in result.history if i.step == pytest.approx(h)) for h in (1e-3, 5e-4))
            assert before.simulations == 1 and after.simulations > result.history[1].simulations
            assert result.gradients == 4
    once = learn(task(fine, parameters, scene=scene, every=4), halvings=1)
    assert once.task.step == pytest.approx(5e-4)


@pytest.mark.slow
def test_noise_halves_no_step(data):
    """Eq. 2's step has an error of many percent of these values, and the data have it: a shorter step would not do."""
    rng = np.random.default_rng(1)
    for _ in range(4):
        noisy = dataclasses.replace(data, position=data.position + 1e-6 * rng.normal(size=data.position.shape))
        problem = task(noisy)
        assert learn(problem).task is problem


def test_a_gradient_that_fails_does_not_lose_what_was_learned(data, monkeypatch):
    def fail(self, values):
        raise wy.GradientError("in parts", step=1, term=None)

    monkeypatch.setattr(Task, "loss_and_gradient", fail)
    result = learn(task(data, [SHEAR]))
    assert np.isnan(result.gradient).all() and result.values["shear"] == pytest.approx(1000.0, rel=1e-3)


def test_a_step_that_cannot_be_halved_leaves_its_part_unknown(data, monkeypatch):
    def fail(self, values, frames=None, *, refine=1):
        raise wy.SimulationError("too stiff", step=1, node=-1, term=None, trajectory=None)

    monkeypatch.setattr(Task, "trajectory", fail)
    result = learn(task(data, [SHEAR]))
    assert (result.step_error["shear"], result.step_share) == (0.0, 0.0)
    assert result.values["shear"] == pytest.approx(1000.0, rel=1e-3)


# -- benchmarks/uncertainty.py: real yarns, and yarns that ring -------------------------------------------------------


@pytest.mark.parametrize(
    ("fabric", "pose", "of", "seeds"),
    [("paper", "saddle", ("same", "finer"), 3), ("handkerchief", "flat", ("same",), 2)],
)
@pytest.mark.slow
def test_uncertainties_hold_where_yarns_ring_and_where_they_hardly_tell(fabric, pose, of, seeds):
    """Before: 170 standard deviations off with the ringing saddle's finer data, 40 with the handkerchief."""
    for truth in of:
        rows = uncertainty.scores(fabric, pose, truth, 5, range(seeds))
        # 12 values at most; 3 standard deviations are what 1 of 370 normal ones exceeds
        assert max(row["largest"] for row in rows) < 3.0
        if (truth, pose) == ("same", "saddle"):
            # noise is all there is, and the answer is as sharp as the data
            assert all(row["determined"] == "3 of 3" and row["uncertainty"] < 1e-3 for row in rows)
            # the mean of 12 squares of standard normal numbers, correlated: 1 ± 0.5
            assert 0.2 < np.mean([row["spread"] ** 2 for row in rows]) < 3.0


def test_scores_reach_the_csv_file(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(uncertainty, "one_core", lambda: None)
    output = tmp_path / "uncertainty.csv"
    only = ["--seeds", "1", "--size", "4", "--fabrics", "paper", "--poses", "flat", "--data", "same"]
    uncertainty.main([*only, "--output", str(output)])
    with open(output, newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["parameter"] for row in rows] == ["density[0]", "stretch[0]", "bend[0]", "shear"]
    assert "same: spread" in capsys.readouterr().out


def test_differences_are_taken_above_what_the_solver_leaves(monkeypatch):
    cloth = uncertainty.cloth_of("handkerchief", "saddle", 5)
    scene = wy.paper.hung(cloth)
    target = motion(scene, 6, integrator="sdirk2", newton_tolerance=1e-10)
    parameters = uncertainty.parameters_of(scene)

    def apart(jacobian):
        return (np.linalg.norm(jacobian - exact, axis=0) / np.linalg.norm(exact, axis=0)).max()

    exact = Task(scene, target, parameters)
    values = truth(exact)
    exact = exact.jacobian(values, exact.residuals(values))
    # three times what a plain difference makes of the parameter that does the least, another one in every run
    random, run = np.random.default_rng(0), Task._run
    noise = 3.0 * wl.DIFFERENCE * np.linalg.norm(exact, axis=0).min() / np.sqrt(len(exact))
    monkeypatch.setattr(
        Task, "_run", lambda *a: run(*a) + noise * torch.as_tensor(random.normal(size=target.position[1:].shape))
    )
    loose = Task(scene, target, parameters)
    residuals = loose.residuals(values)
    plain = [loose._difference(values, residuals, wl.DIFFERENCE, -row) for row in np.eye(4)]
    assert apart(-np.stack(plain, axis=1)) > 1.0  # noise, and no sign of it
    # two that agree to a quarter
    assert apart(loose.jacobian(values, residuals)) < 0.3


# -- scenes/learn.py --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Ten frames of 5 × 5, two more than are learned from below."""
    path = tmp_path_factory.mktemp("recording") / "motion.npz"
    motion(wy.paper.hung_cloth(rows=5, columns=5), 10).save(path)
    return path


LEARNED = ("density[0]", "bend[0]", "shear")
SMALL = ["--frames", "8", "--integrator", "linear", "--parameters", *LEARNED]


def test_the_command_learns_writes_and_tells(recording, tmp_path, capsys):
    usd = tmp_path / "new folder" / "learn.usdc"
    result = scene_script.main([str(recording), *SMALL, "--output", str(usd)])
    assert json.loads(usd.with_suffix(".json").read_text(encoding="utf-8")) == result
    assert list(result["parameters"]) == list(LEARNED)
    for name, of in result["parameters"].items():
        assert of["value"] == pytest.approx(of["in the file"], rel=1e-3)
        assert of["start"] == next(p.start for p in PAPER if p.name == name) == result["paths"][name][0]
        assert result["paths"][name][-1] == of["value"]
        assert abs(of["value"] - of["in the file"]) < 3.0 * of["uncertainty"] and of["status"] == "determined"
    assert (result["frames"], result["step [s]"], result["integrator"]) == (8, 1e-3, "linear")
    assert np.diff(result["losses [m²]"]).max() < 0.0
    assert usd.with_suffix(".png").stat().st_size > 0
    told = capsys.readouterr().out
    assert all(name in told for name in LEARNED)
    assert "simulations" in told and "shorter step" not in told


@pytest.mark.slow
def test_the_animation_has_data_and_model_next_to_each_other(recording, tmp_path):
    usd = tmp_path / "learn.usda"
    arguments = [str(recording), *SMALL, "--first", "2", "--every", "2", "--frames", "2", "--output", str(usd)]
    scene_script.main([*arguments, "--step", "1e-3", "--slowdown", "10"])
    # Frames 2, 4, ..., 10, of two materials twice
    assert samples(usd) == [5] * 4
    stage = Usd.Stage.Open(str(usd))
    assert (stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (4.0, pytest.approx(1.0 / (2e-3 * 10.0)))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0 and UsdGeom.GetStageUpAxis(stage) == "Z"
    assert stage.GetDefaultPrim().GetPath() == "/comparison"
    points = {
        name: UsdGeom.PointBased(stage.GetPrimAtPath(f"/comparison/{name}/yarn_0")).GetPointsAttr().Get(4.0)
        for name in ("data", "model")
    }
    # It has learned: single precision of USD, and 1 nm, at which learning ends
    np.testing.assert_allclose(points["model"], points["data"], atol=1e-7)
    boxes = UsdGeom.BBoxCache(4.0, ["default"])
    data, model = (
        boxes.ComputeWorldBound(stage.GetPrimAtPath(f"/comparison/{name}")).ComputeAlignedRange()
        for name in ("data", "model")
    )
    assert model.GetMin()[0] > data.GetMax()[0] + 1e-3
    assert model.GetMin()[2] == pytest.approx(data.GetMin()[2], abs=1e-7)


def test_a_model_that_fails_later_is_written_as_far_as_it_goes(recording, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(scene_script, "plot", lambda *of: None)
    usd = tmp_path / "learn.usdc"

    def fail(self, values, frames=None, *, refine=1):
        made = motion(self.scene, 9, step=self.step)
        raise wy.SimulationError("too stiff", step=10, node=-1, term=None, trajectory=made)

    monkeypatch.setattr(Task, "trajectory", fail)
    arguments = [str(recording), *SMALL, "--frames", "4", "--step", "5e-4", "--output", str(usd)]
    assert exit_code(scene_script, arguments) == 1
    assert "too stiff" in capsys.readouterr().err
    # Ten states of half a millisecond are five frames.
    assert samples(usd) == [5] * 4
    assert list(json.loads(usd.with_suffix(".json").read_text(encoding="utf-8"))["parameters"]) == list(LEARNED)


def test_other_parameters_and_ranges(recording, tmp_path):
    usd = tmp_path / "learn.usdc"
    names = ["--parameters", "wind_drag", "stretch[1]", "--range", "wind_drag", "0", "2"]
    starts = ["--start", "stretch[1]", "1.6e5", "--iterations", "0", "--frames", "2", "--integrator", "linear"]
    of = scene_script.main([str(recording), *names, *starts, "--output", str(usd)])["parameters"]
    assert (of["wind_drag"]["range"], of["wind_drag"]["start"]) == ([0.0, 2.0], 1.0)
    assert (of["stretch[1]"]["range"], of["stretch[1]"]["start"]) == ([0.0, 3e5], 1.6e5)
    assert of["wind_drag"]["in the file"] == 0.5


@pytest.mark.slow
def test_an_interrupted_command_is_resumed(recording, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(scene_script, "plot", lambda *of: None)  # tested elsewhere, and slow
    usd = tmp_path / "learn.usdc"
    arguments = [str(recording), *SMALL, "--output", str(usd)]
    whole = scene_script.main(arguments)
    usd.with_suffix(".checkpoint.npz").unlink()
    calls = []

    def residuals(self, values, real=Task.residuals):
        calls.append(values)
        if len(calls) == 8:
            raise KeyboardInterrupt
        return real(self, values)

    with monkeypatch.context() as patch:
        patch.setattr(Task, "residuals", residuals)
        assert exit_code(scene_script, arguments) == 130
    assert "--resume goes on from" in capsys.readouterr().err
    resumed = scene_script.main([*arguments, "--resume"])
    assert {**resumed, "seconds": 0} == {**whole, "seconds": 0}
    # Without it, all over again: the same way, from the start
    assert {**scene_script.main(arguments), "seconds": 0} == {**whole, "seconds": 0}


def published_file(path, trajectory):
    """A recording of the paper's fabric as an HDF5 file of its structure."""
    cloth = trajectory.cloth
    values = dict.fromkeys(PROPERTIES, 0.0)
    for k, yarn in enumerate(cloth.yarns, start=1):
        values |= {f"Yarn{k}_rho": yarn.density, f"Yarn{k}_Y": yarn.stretch, f"Yarn{k}_B": yarn.bend}
    values |= {"Gravity": 9.8, "R": cloth.radius, "L": cloth.spacing, "S": cloth.shear, "mu": cloth.friction}
    values |= {"kc": 1.0, "kf": 1e3, "df": 1e3, "handle_stiff": 1e4}
    values |= {"wind_velocity_y": 5.0, "wind_density": 2.0, "wind_drag": 0.5}
    size = {"width": float(cloth.weave.columns), "length": float(cloth.weave.rows)}
    with h5py.File(path, "w") as file:
        for name, record in (("Size", size), ("Physical properties", values)):
            file[f"Properties/{name}"] = np.array([tuple(record.values())], [(key, "<f8") for key in record])
        for field, (group, kind, _) in DATASETS.items():
            for node, rows in enumerate(getattr(trajectory, field).swapaxes(0, 1)):
                j, i = divmod(node, cloth.weave.columns)
                file[f"Steps/{group}/Node {i} {j}/{kind}"] = rows


@pytest.mark.slow
def test_a_published_file_is_learned_from_its_frame_1(tmp_path):
    path = tmp_path / "published.h5"
    scene = wy.paper.hung_cloth(rows=4, columns=5, published_scaling=True)
    published_file(path, motion(scene, 9))
    result = scene_script.main([str(path), *SMALL, "--output", str(tmp_path / "learn.usdc")])
    for of in result["parameters"].values():
        assert of["value"] == pytest.approx(of["in the file"], rel=1e-3)
    # Frames 1 to 9
    assert samples(tmp_path / "learn.usdc") == [9] * 4


def altered(path, tmp_path, **arrays):
    """A copy of a recording with other arrays."""
    with np.load(path) as data:
        result = tmp_path / "altered.npz"
        np.savez(result, **{**data, **{name: change(data[name]) for name, change in arrays.items()}})
    return result


def truncated(path, tmp_path):
    result = tmp_path / f"truncated{path.suffix}"
    result.write_bytes(path.read_bytes()[:2000])
    return result


def foreign_npz(path, tmp_path):
    np.savez(tmp_path / "foreign.npz", weights=np.zeros(3))
    return tmp_path / "foreign.npz"


def foreign_h5(path, tmp_path):
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["weights"] = np.zeros(3)
    return tmp_path / "foreign.h5"


def truncated_h5(path, tmp_path):
    published_file(tmp_path / "whole.h5", wy.Trajectory.load(path))
    return truncated(tmp_path / "whole.h5", tmp_path)


def nan_h5(path, tmp_path):
    published_file(tmp_path / "nan.h5", wy.Trajectory.load(path))
    with h5py.File(tmp_path / "nan.h5", "a") as file:
        file["Steps/Position/Node 2 1/LPOS"][3] = np.nan
    return tmp_path / "nan.h5"


def short_h5(path, tmp_path):
    published_file(tmp_path / "short.h5", wy.Trajectory.load(path).cut(6))
    return tmp_path / "short.h5"


def with_nan_at(frame):
    def change(array):
        array[frame] = np.nan
        return array

    return change


CORRUPT = {
    "truncated": (truncated, r"truncated.npz: not a recording of warp_yarn"),
    "foreign": (foreign_npz, r"foreign.npz: not a recording of warp_yarn"),
    "another size": (lambda *of: altered(*of, position=lambda x: x[:, :24]), "position has shape (11, 24, 3), must be"),
    "NaN": (lambda *of: altered(*of, position=with_nan_at(7)), "position[7, 0, 0] is nan, must be finite"),
    "fewer frames": (lambda *of: altered(*of, **dict.fromkeys(FIELDS, lambda x: x[:5])), "target has 5 frames"),
    "missing": (lambda path, folder: folder / "none.npz", "none.npz: there is no such file"),
    "truncated HDF5": (truncated_h5, "truncated.h5: not a whole HDF5 file"),
    "foreign HDF5": (foreign_h5, "foreign.h5: has no dataset 'Properties/Size'"),
    "NaN in HDF5": (nan_h5, "Node 2 1/LPOS[3, 0] is nan, must be finite"),
    "fewer frames in HDF5": (short_h5, "target has 6 frames, which leaves 4 to compare with"),
}


@pytest.mark.parametrize("defect", CORRUPT)
def test_corrupt_frames_end_in_one_line_that_says_what_is_wrong(recording, tmp_path, defect, capsys):
    damage, message = CORRUPT[defect]
    path = damage(recording, tmp_path)
    assert exit_code(scene_script, [str(path), *SMALL, "--output", str(tmp_path / "learn.usdc")]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.startswith("error: ") and said.count("\n") == 1
    assert not list(tmp_path.glob("learn.*"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--frames", "0"], "frames = 0"),
        (["--frames", "11"], "frames = 11"),
        (["--first", "-1"], "first = -1"),
        (["--every", "0"], "every = 0"),
        (["--step", "3e-4"], "step = 0.0003 s"),
        (["--integrator", "leapfrog"], "leapfrog"),
        (["--iterations", "-1"], "iterations = -1"),
        (["--resolution", "0"], "resolution = 0"),
        (["--halvings", "-1"], "halvings = -1"),
        (["--parameters", "wool"], "'wool'"),
        (["--parameters", "wind_drag"], "--range wind_drag LOW HIGH"),
        (
            ["--parameters", "shear", "--range", "bend[0]", "0", "1"],
            "--range bend[0]: not among what is learned, shear",
        ),
        (["--range", "shear", "0", "wide"], "--range shear = 'wide'"),
        (["--range", "shear", "2", "1"], "shear: low = 2"),
        (["--start", "shear", "2000"], "shear: start = 2000"),
        (["--resume"], "there is no"),
        (["--output", "learn.obj"], "learn.obj"),
        (["--plot", "learn.pdf"], "learn.pdf"),
    ],
)
def test_bad_arguments(recording, arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert exit_code(scene_script, [str(recording), *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.rglob("learn.*"))


def test_wind_does_not_go_with_a_published_file(recording, tmp_path, capsys):
    path = short_h5(recording, tmp_path)
    assert exit_code(scene_script, [str(path), "--wind", "0", "1", "0", "--output", str(tmp_path / "learn.usdc")]) == 2
    assert "--wind does not go with" in capsys.readouterr().err


# -- benchmarks/optimizers.py -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_every_method_has_a_row_of_what_it_took(monkeypatch, tmp_path):
    monkeypatch.setattr(optimizers, "RATES", {"Adam": (0.1,), "gradient descent": (0.1,)})
    monkeypatch.setattr(optimizers, "PAPER", (DENSITY, SHEAR))
    monkeypatch.setattr(optimizers, "one_core", lambda: None)
    output = tmp_path / "optimizers.csv"
    optimizers.main(["--sizes", "4", "--frames", "4", "--runs", "12", "--output", str(output)])
    with open(output, newline="") as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    assert list(rows) == list(optimizers.METHODS)
    assert float(rows["ours"]["nearest"]) < 0.01 and 0 < int(rows["ours"]["runs to 1 %"]) <= 12
    # Twelve steps are few for these: the table must not say that they arrived.
    assert rows["gradient descent"]["runs to 1 %"] == "" and int(rows["gradient descent"]["of runs"]) == 12
