"""What can be learned, and the least-squares problem of it: its runs, their loss, gradient and Jacobian."""

import dataclasses
from fractions import Fraction

import numpy as np
import pytest
from learning import COULOMB, SCENE, SHEAR, failing_where, motion, moved, problem_of, truth

import warp_yarn as wy
from warp_yarn.calibration.learn import PAPER, Parameter, learn, value_of, with_values
from warp_yarn.calibration.parameters import learnable
from warp_yarn.calibration.problem import with_paths
from warp_yarn.simulation.state import FIELDS


@pytest.fixture(scope="module")
def data():
    """A cloth with hard friction."""
    return motion(with_values(SCENE, COULOMB))


# -- parameters -------------------------------------------------------------------------------------------------------


def test_every_value_that_can_be_learned_is_read_and_replaced():
    names = [
        name if count is None else f"{name}[{k}]" for name, count in learnable(SCENE).items() for k in range(count or 1)
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
    "no parameters": (lambda: problem_of(motion(frames=1), []), "parameters is empty"),
    "twice": (lambda: problem_of(motion(frames=1), [SHEAR, SHEAR]), "names 'shear' twice"),
    "range end": (lambda: problem_of(motion(frames=1), [Parameter("density[0]", 0, 1, 0.5)]), r"density = 0\.0"),
    "frames": (lambda: problem_of(motion(frames=3), frames=4), r"frames = 4.*target has 4 frames, which leaves 3"),
    "no frames": (lambda: problem_of(motion(frames=3), first=3), r"first = 3.*leaves 0 to compare with"),
    "every": (lambda: problem_of(motion(frames=3), frames=2, every=2), r"frames = 2, .*leaves 1 to compare with"),
    "step": (
        lambda: problem_of(motion(frames=1), step=3e-4),
        r"step = 0\.0003 s.*whole number of times into the 0\.001 s",
    ),
    "size": (
        lambda: problem_of(motion(wy.paper.hung_cloth(rows=5, columns=4), 1)),
        "has 5 × 4 nodes, must have .* 4 × 4",
    ),
    "shape": (
        lambda: problem_of(dataclasses.replace(motion(frames=1), euler=np.zeros((2, 16, 3)))),
        "target.euler has shape",
    ),
    "NaN": (lambda: problem_of(with_nan(motion(frames=2))), r"target\.position\[1, 3, 2\] is nan, must be finite"),
    "iterations": (lambda: learn(problem_of(motion(frames=1)), iterations=-1), "iterations = -1"),
    "halvings": (lambda: learn(problem_of(motion(frames=1)), halvings=-1), "halvings = -1"),
    "resolution": (lambda: learn(problem_of(motion(frames=1)), resolution=0.0), r"resolution = 0\.0.*above 0"),
    "checkpoint": (lambda: learn(problem_of(motion(frames=1)), checkpoint="a.json"), r"'a\.json', must end in \.npz"),
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
    problem = problem_of(fine, first=2, every=4, step=2.5e-4)
    assert (problem.step, problem.steps_per_frame, len(problem.positions)) == (2.5e-4, 4, 3)
    # friction's anchors and all: the same steps from the same state, to the last bit
    assert problem.loss(truth(problem)) == 0.0
    again = problem.trajectory(truth(problem), 2)
    assert again.step == 1e-3
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(again, name), getattr(fine, name)[2:11:4])


def test_the_loss_is_the_mean_square_of_distances(data):
    problem = problem_of(data)
    values = problem.start
    offset = motion(problem.scene_with(values)).position[1:] - data.position[1:]
    expected = np.mean([np.linalg.norm(row) ** 2 for row in offset.reshape(-1, 3)])
    assert problem.loss(values) == pytest.approx(expected, rel=1e-12)
    assert (problem.simulations, problem.gradients) == (1, 0)


def test_gradient_and_jacobian_agree_with_differences_of_the_loss(data):
    # All but friction, which moves these positions by 3e-13 m: the solver leaves as much in a difference.
    problem = problem_of(data, PAPER[:-1], tolerance=1e-13)
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


def test_differences_stay_in_the_ranges_and_turn_round_where_the_model_fails(data):
    problem = problem_of(data)
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


@pytest.mark.parametrize("integrator", ["linear", "sdirk2"])
@pytest.mark.parametrize("stiffness", [None, 1e4])
def test_paths_begin_with_the_frame_that_learning_begins_with(stiffness, integrator):
    """Also where stages ask for the pins' places within a step."""
    scene, options = moved(stiffness), {"integrator": integrator, "newton_tolerance": 1e-10}
    data = motion(scene, 24, **options)
    for first, every in ((8, 1), (0, 1), (9, 3), (22, 1)):
        problem = problem_of(data, [SHEAR], scene, first=first, every=every, step=1e-3, **options)
        # the same steps from the same state, to the last bit
        assert problem.loss(truth(problem)) == 0.0
        again = problem.trajectory(truth(problem))
        np.testing.assert_array_equal(again.position, data.position[first::every][: len(again)])
    # after the last row pins stay, and the force that ends is 0
    longer = motion(scene, 30, **options)
    problem = problem_of(longer, [SHEAR], scene, first=20, **options)
    assert problem.loss(truth(problem)) == 0.0
    assert problem.trajectory(truth(problem), 12).position[:11] == pytest.approx(longer.position[20:], abs=0.0)


@pytest.mark.parametrize("stiffness", [None, 1e4])
def test_the_same_paths_in_other_steps_leave_the_steps_error_alone(stiffness):
    scene, options = moved(stiffness), {"integrator": "sdirk2"}
    # what the scene means: pins that move linearly, forces of a row each
    start = scene.cloth.position[scene.pins]
    fine = motion(with_paths(scene, start, 0, Fraction(1, 32), 24 * 32), 24 * 32, 1e-3 / 32, **options)
    data = dataclasses.replace(fine, step=1e-3, **{name: getattr(fine, name)[::32] for name in FIELDS})
    moves = np.linalg.norm(data.position[9:] - data.position[8], axis=2)

    def away(n):
        problem = problem_of(data, [SHEAR], scene, first=8, step=1e-3 / n, **options)
        return np.sqrt(problem.loss(truth(problem)))

    distances = [away(n) for n in (1, 2, 4)]
    assert distances[0] < 0.05 * np.sqrt(np.mean(moves**2))
    # a half of the step has at most a half of its error: springs of moving pins are of order 1
    assert distances[1] < 0.55 * distances[0] and distances[2] < 0.55 * distances[1]
    # and the run with half the step, which tells learning the step's error, is the one with half the step
    problem = problem_of(data, [SHEAR], scene, first=8, step=1e-3, **options)
    finer = problem.trajectory(truth(problem), refine=2)
    np.testing.assert_array_equal(finer.position, problem.halved().trajectory(truth(problem)).position)
    assert np.sqrt(np.mean((finer.position[1:] - data.position[9:]) ** 2) * 3.0) == pytest.approx(distances[1])


def test_paths_in_steps_of_another_length():
    scene = moved(None, until=6)
    start, path = scene.cloth.position[scene.pins], scene.pin_path
    force = scene.force_path[:, 0]

    def of(first, ratio, steps):
        result = with_paths(scene, start, first, Fraction(ratio), steps)
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
    assert (with_paths(scene, start, 2, Fraction(1, 3), 60).force_path[:, 1] == [1e-5, 0.0, 0.0]).all()
    assert scene.pin_path is path and len(scene.force_path) == 7
