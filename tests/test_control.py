"""Throws to a place: the published experiment, throws into the box by the gradient, and what benchmarks say of them."""

import argparse
import csv
import itertools
import json

import numpy as np
import pytest
import torch
from scripts import beside, exit_code, load, samples

import warp_yarn as wy
import warp_yarn.torch as wt
from warp_yarn.envs import box, throws

control = load("benchmarks/control.py")
impact = load("benchmarks/impact_gradients.py")
throw = load("scenes/throw.py")


@pytest.fixture(scope="module")
def published():
    return control.Published()


@pytest.fixture(scope="module")
def flight():
    return throws.Throw()


# -- as published -----------------------------------------------------------------------------------------------------


def same(y, z):
    force = torch.tensor([y, z], dtype=torch.float64)
    return lambda state, step: force


def test_the_published_goal_is_made_again(published):
    reach = published.reach(same(control.GOAL_FORCE, control.GOAL_FORCE))
    # the bound: the goal itself is known to 5 µm
    assert float((reach - published.goal).abs().max()) < 0.05e-3


def test_a_run_in_parts_is_the_published_run_at_once(published):
    """By one rollout whose scene has the forces of all frames."""
    forces = np.stack([np.zeros(6), control.DRAGS, control.LIFTS], axis=1)
    scene = published.fly.scene
    scene = scene.replace(forces={node: forces for node in scene.cloth.corners()})
    rollout = wt.Rollout(scene, 99, frames=[99], step=1e-3, integrator="linear", energy_watch=False)
    at_once = rollout().position[0].mean(dim=0) - published.centre
    scalars = control.scalars().detach()
    torch.testing.assert_close(published.reach(lambda state, step: scalars[step]), at_once, rtol=0.0, atol=1e-15)


def test_l_bfgs_meets_the_published_goal(published):
    losses = control.lbfgs(published, 4)
    # squared metres: from 32 mm to under 1 µm in 4 evaluations, of at most 10
    assert losses[0] > 0.03**2 and losses[-1] < 1e-6**2


def test_gradient_descent_as_published_makes_a_step_for_each_parameter(published):
    """One gradient and 12 steps are one step that is 12 times as long."""
    forces = control.scalars()
    published.loss(lambda state, step: forces[step]).backward()
    moved = forces.detach() - 12 * control.RATE * forces.grad
    found = control.descend(published, control.STEPS_AN_EPOCH, 1)
    with torch.no_grad():
        expected = float(published.loss(lambda state, step: moved[step]))
    assert found[1] == pytest.approx(expected, rel=1e-9)
    assert found[1] < 0.5 * found[0]


def test_the_published_faults_put_the_goal_out_of_reach():
    """One frame of force instead of six and an upright start: the strongest force stays 51 mm and more away."""
    faulty = control.Published(pushed=1, pose="upright", steps=94)
    reaches = [faulty.reach(same(y, z)) for y, z in itertools.product((0.0, control.STRONGEST), repeat=2)]
    np.testing.assert_allclose(1e3 * reaches[-1], (0.0, 18.7, -24.9), atol=0.05)
    # an impulse moves the centre in proportion, so that nothing between is nearer than the nearest corner's reach
    assert min(float((reach - faulty.goal).norm()) for reach in reaches) > 51e-3


def test_the_published_network_learns(published):
    losses = control.network(published, 0, epochs=12)
    assert min(losses[1:]) < 0.2 * losses[0]


# -- the throw that is learned ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("more", [{}, {"at": 100, "touches": "all"}], ids=["arrival", "after an impact"])
def test_the_gradient_of_a_throw_is_that_of_differences(more):
    # that throw goes up from the table, and lands on it again at 91 ms
    task, policy = throws.Throw(**more), throws.Forces(0)
    task(policy)[0].backward()
    chance = torch.Generator().manual_seed(1)
    line = torch.randn(policy.inner.shape, generator=chance, dtype=torch.float64)
    values = []
    with torch.no_grad():
        for sign in (1.0, -1.0):
            policy.inner += sign * 1e-4 * line
            values.append(float(task(policy)[0]))
            policy.inner -= sign * 1e-4 * line
    difference = (values[0] - values[1]) / 2e-4
    # seen: 3e-8 in air, 5e-6 behind the landing, where the loss is curved
    assert float((policy.inner.grad * line).sum()) == pytest.approx(difference, rel=3e-5)


def test_a_throw_depends_on_its_policy_alone(flight):
    policy = throws.Forces(1)
    with torch.no_grad():
        first, forces = flight(policy)
        flight(throws.Forces(2))
        again, _ = flight(policy)
    assert float(first) == float(again)
    assert tuple(forces.shape) == (box.PUSHED, 4, 3)


def test_a_throw_in_parts_is_a_throw_at_once(flight):
    policy = throws.Forces(0)
    with torch.no_grad():
        loss, forces = flight(policy)
    scene = box.scene(box.cloth(), forces.numpy(), touches="nothing")
    trajectory = wy.Simulator(scene, step=box.STEP, integrator=box.INTEGRATOR, newton_tolerance=1e-8, tolerance=1e-8)
    path = trajectory.run(throws.FLIGHT).position.mean(axis=1)
    off = (box.arrival(path) - box.target()) / np.linalg.norm(box.target())
    # both to the tolerance of their steps
    assert float(loss) == pytest.approx(float(off @ off), rel=1e-6)


@pytest.mark.parametrize("kind", throws.RATES)
def test_forces_are_bounded_and_repeat(kind, flight):
    one, other = kind(3), kind(3)
    # as strong as a search may ask for
    with torch.no_grad():
        for parameter in one.parameters():
            parameter *= 50.0
    forces = one(flight.start, 0)
    assert tuple(forces.shape) == (4, 3) and float(forces.detach().abs().max()) <= box.FORCE
    torch.testing.assert_close(other(flight.start, 0), kind(3)(flight.start, 0), rtol=0.0, atol=0.0)
    assert not torch.equal(other(flight.start, 0), kind(4)(flight.start, 0))
    # upward on the whole, where learning begins
    assert float(other(flight.start, 0).detach()[:, 2].mean()) > 0.2 * box.FORCE


@pytest.mark.parametrize(("kind", "seed", "epochs"), [(throws.Forces, 4, 8), (throws.Network, 0, 6)])
def test_a_few_epochs_throw_into_the_box(kind, seed, epochs, flight):
    found = []
    for epoch in throws.learn(flight, kind(seed), epochs):
        found.append(epoch)
        if epoch.success:
            break
    assert found[-1].success
    assert found[-1].miss < 0.5 * box.INNER < found[0].miss
    assert not found[0].success
    assert np.abs(found[-1].forces).max() <= box.FORCE
    # by a simulator of its own, and the rule written out: each node between the walls, and slower than 10 mm/s
    trajectory = throws.true_throw(found[-1].forces)
    last = trajectory.position[-1]
    assert (np.abs(last[:, 0] - 60e-3) < 20e-3).all() and (np.abs(last[:, 1]) < 20e-3).all()
    assert (last[:, 2] < -10e-3).all() and (last[:, 2] > -30e-3).all()
    assert np.linalg.norm(trajectory.velocity[-1], axis=1).max() < 10e-3


def test_what_lies_on_the_table_is_no_success():
    miss, success = throws.judge(np.zeros((box.PUSHED, 4, 3)))
    assert not success and miss == pytest.approx(60e-3, abs=1e-6)


def test_a_throw_that_fails_is_taken_back():
    calls = []

    class Torn(throws.Throw):
        def __init__(self):
            self.place = box.PLACE

        def __call__(self, policy):
            calls.append(policy.inner.detach().clone())
            if len(calls) == 1:
                raise wy.SimulationError("torn", step=1, node=0, term=None, trajectory=None)
            return policy.inner.square().sum(), torch.zeros((box.PUSHED, 4, 3))

    first, second = throws.learn(Torn(), throws.Forces(0), 2, judged=lambda forces, place: (0.01, True))
    assert np.isnan(first.loss) and not first.success
    assert second.success and second.miss == 0.01
    torch.testing.assert_close(calls[1], throws.RETREAT * calls[0], rtol=1e-15, atol=0.0)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: throws.Throw(at=5), "at = 5"),
        (lambda: throws.Throw(touches="walls"), "touches = 'walls'"),
        (lambda: throws.Throw(friction=-1.0), "friction = -1"),
        (lambda: throws.Throw(step=5e-4), "step = 0.0005"),
        (lambda: next(throws.learn(None, throws.Forces(0), 0)), "epochs = 0"),
        (lambda: next(throws.learn(None, throws.Forces(0), 1, rate=0.0)), "rate = 0"),
        (lambda: next(throws.learn(None, throws.Forces(0), 1, bound=0.0)), "bound = 0"),
    ],
)
def test_bad_arguments_of_throws(make, name):
    with pytest.raises(wy.InputError, match=name):
        make()


# -- scenes/throw.py --box --------------------------------------------------------------------------------------------

into_box = beside(throw, "into_box")


@pytest.fixture
def usd(tmp_path):
    return tmp_path / "new folder" / "box.usdc"


def test_the_scene_learns_and_writes(usd, capsys):
    result = throw.main(["--box", "--seed", "4", "--epochs", "8", "--output", str(usd)])
    assert result["success"] and result["epochs"] < 8
    assert json.loads(usd.with_suffix(".json").read_text()) == result
    miss, success = throws.judge(np.array(result["forces [N]"]))
    assert success and miss == result["arrives from the middle [m]"]
    # two yarns, then the obstacles, which stand still
    assert samples(usd)[:2] == [box.STEPS + 1] * 2
    assert usd.with_suffix(".png").stat().st_size > 0
    told = capsys.readouterr().out
    assert "epoch 1: loss" in told and "in the box, at rest" in told


def test_ctrl_c_writes_the_best_throw_so_far(usd, monkeypatch):
    def learn(*_):
        for miss in (0.05, 0.03, 0.04):
            yield throws.Epoch(1.0, 1.0, np.full((box.PUSHED, 4, 3), miss * 1e-3), miss, False, 1.0)
        raise KeyboardInterrupt

    monkeypatch.setattr(throws, "learn", learn)
    assert exit_code(throw, ["--box", "--output", str(usd)]) == 130
    result = json.loads(usd.with_suffix(".json").read_text())
    assert (result["epochs"], result["arrives from the middle [m]"], result["success"]) == (3, 0.03, False)


def test_moments_of_a_throw_are_one_frame():
    trajectory = throws.true_throw(np.zeros((box.PUSHED, 4, 3)))
    shown = into_box.moments(trajectory)
    assert shown.position.shape == (1, len(into_box.SHOWN) * 25, 3)
    np.testing.assert_array_equal(shown.position[0, -25:], trajectory.position[-1])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--size", "9"], "--size"),
        (["--epochs", "0"], "--epochs"),
        (["--seed", "-1"], "--seed"),
        (["--learn", "luck"], "luck"),
        (["--output", "box.obj"], "box.obj"),
        (["--png", "box.jpg"], "box.jpg"),
    ],
)
def test_bad_arguments_of_the_scene(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert exit_code(throw, ["--box", *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.rglob("box.*"))


# -- the benchmarks ---------------------------------------------------------------------------------------------------


def test_evolution_finds_the_least_of_a_bowl(monkeypatch):
    """A stretched quadratic in 60 numbers, whose least is known: CMA-ES nears it, random search does not."""
    stretch = np.geomspace(1.0, 10.0, 60)
    place = np.linspace(-0.5, 0.5, 60)
    monkeypatch.setattr(control, "bounded", lambda inner: inner)
    monkeypatch.setattr(throws, "judge", lambda inner: (float(stretch @ (inner - place) ** 2), False))
    evolved = [miss for _, _, miss, _ in control.evolution(0, 16 * 100)]
    # on spheres it gains a factor of e in about 6 n evaluations: here e^4.4 = 80, less for the stretch
    assert evolved[-1] < 0.05 * evolved[0]
    sought = [miss for _, _, miss, _ in control.random_search(0, 16 * 100)]
    assert (np.diff(sought) <= 0.0).all() and sought[-1] > 10.0 * evolved[-1]


def test_rows_of_the_box_end_at_the_third_success_and_others_stay(tmp_path, monkeypatch):
    def curve(seed, options):
        for k in range(1, 9):
            yield 2 * k, 0.1 * k, 0.06 / k, k > 3 + seed

    monkeypatch.setitem(control.METHODS, "CMA-ES", curve)
    output, plot = tmp_path / "box.csv", tmp_path / "box.png"
    with open(output, "w", newline="") as file:
        names = ["method", "seed", "episodes", "seconds", "miss [mm]", "success"]
        rows = csv.writer(file)
        rows.writerows([names, ["PPO", 0, 64, 1.0, 50.0, 0], ["CMA-ES", 0, 1, 1.0, 50.0, 0]])
    control.main(["box", "--methods", "CMA-ES", "--seeds", "2", "--output", str(output), "--plot", str(plot)])
    rows = control.read(output)
    assert [row["method"] for row in rows] == ["PPO"] + ["CMA-ES"] * (6 + 7)
    assert [row["success"] for row in rows[1:7]] == [0, 0, 0, 1, 1, 1]
    assert plot.stat().st_size > 0


def test_a_curve_is_held_between_its_points():
    curve = [{"episodes": n, "miss [mm]": float(m)} for n, m in ((2, 9), (4, 5), (8, 1))]
    np.testing.assert_array_equal(
        control.held(curve, "episodes", np.array([1, 2, 3, 4, 7, 8, 99])), [9, 9, 9, 5, 5, 1, 1]
    )


def test_a_row_of_the_variants(monkeypatch):
    monkeypatch.setattr(control, "VARIANTS", {"at arrival, nothing touches": {}})

    def learn(task, policy, epochs, *, bound):
        for k in range(epochs):
            yield throws.Epoch(1.0, 2.0 + k, np.zeros((box.PUSHED, 4, 3)), 0.01, k == 2, 0.1)

    monkeypatch.setattr(throws, "learn", learn)
    upward, chance = control.variants(argparse.Namespace(seeds=2, epochs=5))
    assert (upward["start"], chance["start"]) == ("upward", "by chance")
    assert (upward["succeed"], upward["epochs"], upward["gradient, largest"]) == ("2 of 2", "3 3", 4.0)


def test_a_scan_counts_turns_and_variation():
    places = np.linspace(-1.0, 1.0, 401)
    # up and down by 2 π: 4 turns; the slope's sign by half of the gradients
    row = impact.row({}, places, np.sin(2 * np.pi * places), [(at, np.cos(at)) for at in (0.0, 3.0)])
    assert row["turns"] == 4
    assert row["variation over range"] == pytest.approx(4.0, rel=1e-3)
    assert row["of the slope's sign"] == "1 of 2"
    assert impact.row({}, places, 3.0 * places, [(0.0, 3.0)])["mean slope"] == pytest.approx(3.0)


@pytest.mark.parametrize("loss", ["at arrival", "after the impact, μ = 0"])
def test_the_gradient_of_a_scan_is_its_slope(loss, monkeypatch):
    monkeypatch.setattr(impact, "DURATION", 0.15)
    scan = impact.Scan(loss, "implicit-euler", 1e-3, 0)
    with torch.no_grad():
        ends = [float(scan.loss(torch.tensor(at))) for at in (-1e-5, 1e-5)]
    # of a step of 1e-5 in steps that are solved to 1e-8: 1e-3 behind an impact
    assert scan.gradient(0.0) == pytest.approx((ends[1] - ends[0]) / 2e-5, rel=1e-3)
