"""Learning from frames: the search, its ends, interrupts and checkpoints."""

import concurrent.futures
import copy
import dataclasses
import importlib
import multiprocessing
import pickle

import numpy as np
import pytest
from learning import BEND, COULOMB, DENSITY, FRAMES, SCENE, SHEAR, failing_where, motion, moved, problem_of, truth

import warp_yarn as wy
from warp_yarn.calibration.learn import PAPER, CalibrationProblem, Parameter, learn, with_values


@pytest.fixture(scope="module")
def data():
    """A cloth with hard friction."""
    return motion(with_values(SCENE, COULOMB))


def test_names_of_before_work_and_say_so(data):
    """Of the module, by both of its names, and of what came of it, which was pickled by them too."""
    import warp_yarn.learn

    for module in (warp_yarn.learn, importlib.import_module("warp_yarn.calibration.learn")):
        with pytest.warns(DeprecationWarning, match="learn.Task is CalibrationProblem now"):
            assert module.Task is CalibrationProblem
        with pytest.raises(AttributeError, match="no attribute 'Tusk'"):
            _ = module.Tusk
    result = learn(problem_of(data, [SHEAR]), iterations=0)
    with pytest.warns(DeprecationWarning, match=r"Result\.task is Result\.problem now"):
        assert result.task is result.problem


def test_shear_is_learned_from_the_middle_of_a_motion_with_paths():
    scene = moved(None)
    problem = problem_of(motion(scene, 24), [SHEAR], scene, first=8)
    result = learn(problem)
    assert result.values["shear"] == pytest.approx(1000.0, rel=1e-3)
    assert result.problem is problem and result.step_share < 1e-3


@pytest.mark.slow
def test_tasks_and_results_go_to_another_process_and_back(data):
    problem = problem_of(data)
    for made in (copy.deepcopy(problem), pickle.loads(pickle.dumps(problem))):
        assert made.loss(problem.start) == problem.loss(problem.start)
    here = learn(problem_of(data))
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(1, mp_context=context) as pool:
        there = pool.submit(learn, problem).result()
        assert there.values == here.values and there.uncertainty == here.uncertainty
        assert there.problem.loss(problem.start) == problem.loss(problem.start)
        # a model too stiff for its step
        broken = problem_of(data, [Parameter("bend[0]", 1.0, 1e12, 1e12)], max_iterations=1)
        with pytest.raises(wy.SimulationError) as caught:
            pool.submit(learn, broken).result()
        assert caught.value.step == 1 and caught.value.iterations == []
        with pytest.raises(wy.InputError, match="iterations = -1"):
            pool.submit(learn, problem, iterations=-1).result()


@pytest.mark.parametrize("error", [pytest.param(KeyboardInterrupt, marks=pytest.mark.slow), OSError])
def test_what_ends_learning_has_what_was_learned(data, tmp_path, monkeypatch, error):
    """The iterations until then, and a checkpoint to go on from."""
    uninterrupted = learn(problem_of(data))
    real, path = CalibrationProblem.residuals, tmp_path / "checkpoint.npz"
    runs = []

    def counted(self, values):
        runs.append(self.simulations)
        return real(self, values)

    with monkeypatch.context() as patch:
        patch.setattr(CalibrationProblem, "residuals", counted)
        learn(problem_of(data))
    # the first run, in the first Jacobian, before and after a step, in the last Jacobian
    for stop in [runs[k] + 1 for k in (0, 1, 3, 5, 6, -1)]:
        problem = problem_of(data)

        def residuals(self, values, stop=stop):
            if self.simulations == stop - 1:
                raise error
            return real(self, values)

        path.unlink(missing_ok=True)
        with monkeypatch.context() as patch, pytest.raises(error) as caught:
            patch.setattr(CalibrationProblem, "residuals", residuals)
            learn(problem, checkpoint=path)
        done = caught.value.iterations
        before = [i for i in uninterrupted.history if i.simulations < stop]
        assert [i.loss for i in done] == [i.loss for i in before]
        assert path.exists() == (stop > 1)
        # the same task, as it was left
        resumed = learn(problem, checkpoint=path)
        assert resumed.values == uninterrupted.values and resumed.uncertainty == uninterrupted.uncertainty


def test_the_papers_parameters_are_learned_from_eight_frames():
    scene = wy.paper.hung_cloth(rows=5, columns=5)
    problem = problem_of(motion(with_values(scene, COULOMB)), PAPER, scene=scene)
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
    problem = problem_of(noisy)
    result = learn(problem)
    assert result.ended == "converged"
    first = problem.loss_and_gradient(problem.start)[1] * (problem.high - problem.low)
    # CONVERGED_STEP of a standard deviation is some 1e-5 of a range
    assert np.abs(result.gradient).max() < 1e-3 * np.abs(first).max()


@pytest.mark.slow
def test_noise_scatters_values_as_the_uncertainties_say(data):
    rng = np.random.default_rng(1)
    problem = problem_of(data)
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
    problem = problem_of(data, [DENSITY, BEND, outside])
    result = learn(problem)
    assert result.values["shear"] == 900.0 and result.ended == "converged"
    # The loss would fall beyond the bound, and is at its minimum in the others.
    assert result.gradient[2] < 0.0
    assert np.abs(result.gradient[:2]).max() < 0.01 * -result.gradient[2]
    assert result.status["shear"].endswith("at its upper bound")
    assert "bound" not in result.status["density[0]"]


@pytest.mark.parametrize("worse", [False, True])
def test_a_trial_that_fails_or_is_worse_was_a_step_too_long(data, worse):
    problem = problem_of(data)
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
    problem = problem_of(data)
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
        return learn(problem_of(noisy, every=times), **options)

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
    assert resumed.problem.step == whole.problem.step
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
    learn(problem_of(data), checkpoint=path, iterations=2)
    kept = path.read_bytes()
    with pytest.raises(wy.InputError, match=r"checkpoint\.npz: of other parameters"):
        learn(problem_of(data, [DENSITY, BEND]), checkpoint=path)
    with pytest.raises(wy.InputError, match=r"checkpoint\.npz: of other parameters, ranges"):
        learn(problem_of(data, [DENSITY, BEND, dataclasses.replace(SHEAR, high=1300.0)]), checkpoint=path)
    with pytest.raises(wy.InputError, match=r"of other parameters, .*resolution"):
        learn(problem_of(data), checkpoint=path, resolution=1e-8)
    with pytest.raises(wy.InputError, match=r"checkpoint\.npz: of another problem: it has a loss of"):
        learn(problem_of(data, frames=FRAMES - 1), checkpoint=path)
    assert path.read_bytes() == kept
    path.write_bytes(kept[: len(kept) // 2])
    with pytest.raises(wy.InputError, match=r"checkpoint\.npz: not a checkpoint of learning .*remove it"):
        learn(problem_of(data), checkpoint=path)
