"""That policies learn by what they are said to: small cases of benchmarks/reinforcement.py."""

import csv

import numpy as np
import pytest
from scripts import load

from warp_yarn.envs import ThrowIntoBox, box

reinforcement = load("benchmarks/reinforcement.py")


def rows(tmp_path, *arguments):
    path = tmp_path / "reinforcement.csv"
    reinforcement.main([*arguments, "--output", str(path)])
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["analytic", "contact", "ppo"])
def test_a_method_goes_on_from_test_to_test(method, tmp_path, monkeypatch):
    """Episodes add up, and the policy that is tested is another one after learning."""
    for name in ("STEPS", "UPDATES"):
        monkeypatch.setattr(reinforcement, name, 1)
    monkeypatch.setattr(reinforcement, "BATCH", 2)
    monkeypatch.setattr(reinforcement, "EPISODES_OF_PPO", 2)
    found = rows(tmp_path, "--methods", method, "--seeds", "3", "--episodes", "4", "--unseen", "2")
    assert [(row["method"], row["seed"], row["episodes"]) for row in found] == [
        (method, "3", episodes) for episodes in ("0", "2", "4")
    ]
    assert len({row["distance [mm]"] for row in found}) == 3
    assert float(found[2]["processor seconds"]) > float(found[1]["processor seconds"]) > 0.0
    assert all(row["failed"] == "0" for row in found)


@pytest.mark.slow
def test_a_policy_learns_through_the_simulator(tmp_path):
    """From the whole way to under a half of it in 40 episodes (measured: 58.5 to 29.6 mm)."""
    found = rows(tmp_path, "--methods", "analytic", "--seeds", "0", "--episodes", "40", "--unseen", "10")
    first, last = (float(row["distance [mm]"]) for row in found)
    assert first > 50.0
    assert last < 0.6 * first


def test_unseen_throws_are_the_same_for_all_and_judged_by_the_environment():
    """A policy that throws as it is told, whatever it sees: one that throws into the middle meets some of them."""
    forward = np.tile([0.5, 0.0, 0.6], (box.PUSHED, 4)).ravel()
    both = [reinforcement.test(lambda seen: forward, 4) for _ in range(2)]
    assert both[0] == both[1]
    assert reinforcement.test(lambda seen: forward[:12], 4) == both[0]
    env, distances = ThrowIntoBox(), []
    for k in range(4):
        env.reset(seed=reinforcement.UNSEEN + k)
        distances.append([env.step(action)[4].get("distance") for action in forward.reshape(box.PUSHED, 12)][-1])
    assert both[0]["distance [mm]"] == pytest.approx(1e3 * np.mean(distances))
    assert 0.0 < both[0]["success"] <= 1.0
    assert reinforcement.test(lambda seen: 0.0 * forward, 4)["success"] == 0.0


def test_features_are_of_the_order_of_one():
    env = ThrowIntoBox()
    env.reset(seed=0)
    seen = [reinforcement.features(env.step(env.action_space.sample())[0]) for _ in range(4)]
    assert 0.3 < np.abs(seen).max() < 10.0
    assert all(value.shape == env.observation_space.shape and value.dtype == np.float32 for value in seen)
