"""scenes/throw.py at 4 × 4, and that the benchmarks of gradients measure what they say; in this process, untimed."""

import contextlib
import csv
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scripts import exit_code, load, samples

import warp_yarn as wy
import warp_yarn.torch as wt

throw = load("scenes/throw.py")
gradients = load("benchmarks/gradients.py")

STEPS = 8
SMALL = ["--size", "4", "--steps", str(STEPS), "--time", "0.008", "--target", "0.01", "0.002", "0.006"]


@pytest.fixture
def usd(tmp_path: Path) -> Path:
    return tmp_path / "new folder" / "throw.usdc"


@pytest.mark.parametrize("fabric", [*wy.fabrics.STUDIED, "denim"])
def test_a_learned_velocity_is_that_of_a_thrown_point(fabric, usd, capsys):
    result = throw.main([*SMALL, "--fabric", fabric, "--output", str(usd)])
    # The default of --within: the search ends there.
    assert result["distance [m]"] <= 1e-6
    # A gradient step, a step along it of the right length, and one against rounding.
    assert result["iterations"] <= 5
    assert np.diff(result["losses"]).max() < 0.0
    # A cloth that moves as one is a thrown point; 1e-6 m of 8e-3 s leave 1.2e-4 m/s.
    np.testing.assert_allclose(result["velocity [m/s]"], result["velocity of a thrown point [m/s]"], atol=1.3e-4)
    # One frame a step, and the first.
    assert samples(usd) == [STEPS + 1] * len(wy.fabrics.FABRICS[fabric]().yarns)
    assert usd.with_suffix(".png").stat().st_size > 0
    assert json.loads(usd.with_suffix(".json").read_text()) == result
    told = capsys.readouterr().out
    assert "mm from the target" in told
    assert "thrown point" in told


def test_forces_come_nearer_at_once(usd):
    result = throw.main([*SMALL, "--forces", "--iterations", "2", "--output", str(usd)])
    assert result["iterations"] == 2
    assert result["losses"][1] < result["losses"][0]
    assert np.shape(result["forces [N]"]) == (5, 4, 3)
    assert samples(usd) == [STEPS + 1] * 2


def test_forces_reach_the_target(usd):
    arguments = [*SMALL, "--forces", "--output", str(usd), "--checkpoint-every", "3"]
    # The default of --within; the cloth bends under the forces, so that it takes more iterations than a velocity.
    assert throw.main(arguments)["distance [m]"] <= 1e-6


@pytest.mark.parametrize("forces", [False, True])
def test_the_written_throw_is_the_best_one(forces):
    cloth = wy.Cloth(wy.WEAVES["plain"](rows=4, columns=4), yarns=[wy.paper.YARNS[1]], pose="flat")
    problem = throw.Throw(cloth, (0.01, 0.002, 0.006), 0.008, STEPS, forces=forces)
    found = throw.search(problem, 3, 1.0, 0.0)
    assert found.stop is None
    trajectory = problem.trajectory(found.best)
    centre = trajectory.position[-1].mean(axis=0) - cloth.position.mean(axis=0)
    # The same steps, so the same to rounding.
    assert np.linalg.norm(centre - problem.target) == pytest.approx(min(found.distances), abs=1e-12)


@pytest.mark.slow
def test_a_throw_that_cannot_be_simulated_is_taken_back_half_of_the_way(usd):
    # At a hundred times the optimizer's full step, the second throw tears the cloth.
    arguments = [*SMALL, "--forces", "--rate", "100", "--iterations", "12", "--output", str(usd)]
    result = throw.main(arguments)
    assert 0 < result["iterations"] < 12
    assert usd.exists()


def test_an_interrupted_search_writes_the_best_throw_so_far(usd, monkeypatch):
    calls = []

    def miss(self, y, real=throw.Throw.miss):
        calls.append(y)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return real(self, y)

    monkeypatch.setattr(throw.Throw, "miss", miss)
    assert exit_code(throw, [*SMALL, "--output", str(usd)]) == 130
    assert len(json.loads(usd.with_suffix(".json").read_text())["losses"]) == 2
    assert samples(usd) == [STEPS + 1] * 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--target", "0", "0", "0"], "target"),
        (["--target", "1", "2", "nan"], "target"),
        (["--time", "-1"], "--time"),
        (["--steps", "0"], "--steps"),
        (["--forces", "--steps", "5"], "--steps"),
        (["--iterations", "0"], "--iterations"),
        (["--rate", "0"], "--rate"),
        (["--within", "-1"], "--within"),
        (["--checkpoint-every", "0"], "checkpoint_every"),
        (["--size", "2"], "--size = 2"),
        (["--weave", "felt"], "felt"),
        (["--output", "throw.obj"], "throw.obj"),
        (["--plot", "throw.pdf"], "throw.pdf"),
    ],
)
def test_bad_arguments(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert exit_code(throw, arguments) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.rglob("throw.*"))


# -- benchmarks/gradients.py ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sliding", [True, False])
@pytest.mark.parametrize("every", [1, 4])
def test_what_is_kept_is_the_states_alone(sliding, every):
    case = gradients.Case(4, STEPS, every, sliding=sliding)
    state = 8 * (3 + 2 + 3 + 2 + 2 if sliding else 3 + 3) * 16
    assert gradients.state_bytes(case.rollout.scene) == state
    # Every state, the first and the last among them, or every fourth: 0 and 4.
    assert gradients.kept_bytes(case.call()) == state * (STEPS + 1 if every == 1 else STEPS // every)


@pytest.mark.slow
def test_a_row_of_the_cost_table(tmp_path):
    rows = gradients.cost(4, (1, 3), STEPS, repeats=1, few=2, many=4)
    methods = [(row["method"], row["checkpoint_every"]) for row in rows]
    assert methods == [("linear", 1), ("linear", 3), ("sdirk2", 1), ("sdirk2", 3)]
    assert all(row["backward [ms]"] > 0.0 and row["forward [ms]"] > 0.0 and row["ratio"] > 0.0 for row in rows)
    path = tmp_path / "cost.csv"
    gradients.write_csv(path, rows, gradients.environment("torch"))
    with open(path, newline="") as file:
        assert [row["size"] for row in csv.DictReader(file)] == ["4 × 4"] * 4


def test_the_times_of_forward_only_users_are_of_plain_simulators(monkeypatch):
    # In this process: a module that a test loaded by its path cannot be imported by another one.
    pool = SimpleNamespace(apply=lambda function, arguments: function(*arguments))
    context = SimpleNamespace(Pool=lambda count: contextlib.nullcontext(pool))
    monkeypatch.setattr(gradients.multiprocessing, "get_context", lambda kind: context)
    row = gradients.forward_only(4, steps=3, repeats=1)
    assert row["gradient arrays, plain"] == 0
    assert row["asked"] > 0
    assert gradients.gradient_arrays(gradients.simulator_apart(4)) == 0


def test_errors_fall_with_the_tolerance():
    loose, tight = gradients.error_table((1e-3, 1e-9), rows=4, columns=4, steps=5)
    for name in ("positions", *gradients.OF_THE_ERROR):
        assert tight[name] < 1e-3 * loose[name]
        # what a few steps make of a tolerance; seen in the whole table: at most 100 times it, at 50 steps
        assert tight[name] < 1e-6


def test_every_input_of_the_cost_table_has_a_gradient():
    case = gradients.Case(4, STEPS)
    case.forward()
    case.backward()
    # euler_velocity of a cloth at rest and the rest of them alike
    assert all(bool(torch.isfinite(value.grad).all()) for value in case.inputs.values())
    assert set(case.inputs) <= set(wt.Rollout(case.rollout.scene, 1).inputs)
