"""Policies that throw a cloth into a box: trained by the exact gradient through the simulator, and by PPO.

    python benchmarks/reinforcement.py [--methods analytic ppo] [--seeds 0 1 2 3 4] [--minutes 5]

Both learn on warp_yarn/ThrowIntoBox-v0, with starts and boxes at random; tests are the same 50 that neither saw.

    analytic    a network from what is seen at the start to the forces of all five steps, by Adam on the exact gradient
                of the distance at arrival, through a flight without table and box, which every throw has
    contact     the same, through the scene itself, table and box and friction
    ppo         stable-baselines3's, reward minus the same distance in the end; it sees every step

Networks have two hidden layers of 64 and tanh. A row is one test: how many episodes were simulated until then, wall and
processor time without tests; over the 50 the mean distance at arrival, and the share of throws that end in the box, at
rest. "failed" are episodes that had no gradient, and were left out. The CSV file is written after each test, so that
Ctrl-C loses nothing. Needs the extras rl, torch and bench.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
import warp as wp
from common import RESULTS, environment, print_table, write_csv

import warp_yarn as wy
from warp_yarn.envs import ThrowIntoBox, box

UNSEEN = 1_000_000
"""Seed of the first unseen episode; training draws from seeds below."""
HIDDEN = 64
BATCH = 8
"""Episodes of a step of Adam."""
RATE = 3e-3
NORM = 1.0
"""Largest norm of an episode's gradient: one throw that grazes a wall shall not decide a step."""
UP = 0.5
"""Share of the largest force that untrained networks ask for, upwards: what stays on the table tells nothing."""
EPISODES_OF_PPO = 64
"""Between two updates."""
STEPS, UPDATES = 5, 10
"""Of Adam, and of PPO, between two tests."""
NODES = 25


def features(seen: np.ndarray) -> np.ndarray:
    """Brings an observation of the environment to the order of 1, velocities too."""
    position, velocity = seen[: 3 * NODES] / 5e-3, seen[3 * NODES : 6 * NODES] / 0.5
    place = (seen[6 * NODES : 6 * NODES + 2] - np.array(box.PLACE)) / 10e-3
    return np.concatenate([position, velocity, place, seen[-1:]]).astype(np.float32)


class Clock:
    """Counts wall and processor time [s] while it is running."""

    def __init__(self) -> None:
        self.wall = self.processor = 0.0

    def __enter__(self) -> None:
        self._begun = time.perf_counter(), time.process_time()

    def __exit__(self, *_: object) -> None:
        self.wall += time.perf_counter() - self._begun[0]
        self.processor += time.process_time() - self._begun[1]


class Scaled(gymnasium.ObservationWrapper):
    """The environment as ``features`` of it."""

    def __init__(self, env: gymnasium.Env):
        super().__init__(env)
        shape = env.observation_space.shape
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float32)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        return features(observation)


def network() -> torch.nn.Sequential:
    """From features of a start to the actions of all steps."""
    last = torch.nn.Linear(HIDDEN, 12 * box.PUSHED)
    with torch.no_grad():
        last.weight *= 0.1
        last.bias[2::3] = float(np.arctanh(UP))
    layers = [torch.nn.Linear(6 * NODES + 3, HIDDEN), torch.nn.Tanh(), torch.nn.Linear(HIDDEN, HIDDEN), torch.nn.Tanh()]
    return torch.nn.Sequential(*layers, last, torch.nn.Tanh())


def test(act: Callable[[np.ndarray], np.ndarray], count: int) -> dict[str, float]:
    """Throws from unseen starts into unseen boxes.

    Args:
        act: from an observation to an action, or to those of the whole episode.
    """
    env, found = ThrowIntoBox(), []
    for k in range(count):
        seen, _ = env.reset(seed=UNSEEN + k)
        planned = np.reshape(act(seen), (-1, 12))
        for step in range(box.PUSHED):
            seen, _, _, _, info = env.step(planned[step] if len(planned) > 1 else act(seen))
            if "failed" in info:
                break
        found.append(info)
    distances = [info["distance"] for info in found]
    return {
        "distance [mm]": 1e3 * float(np.mean(distances)),
        "success": float(np.mean([info["is_success"] for info in found])),
    }


def through_the_simulator(seed: int, count: int, touches: str) -> Iterator[tuple[int, Clock, dict[str, float]]]:
    """Trains a network by the gradient; yields episodes, seconds and a test, again and again."""
    torch.manual_seed(seed)
    policy, env = network(), ThrowIntoBox()
    optimizer = torch.optim.Adam(policy.parameters(), lr=RATE)
    episodes, failed, clock = 0, 0, Clock()
    env.reset(seed=seed)

    def planned(seen: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return policy(torch.from_numpy(features(seen))).numpy().astype(np.float64)

    while True:
        yield episodes, clock, {**test(planned, count), "failed": failed}
        with clock:
            for _ in range(STEPS):
                optimizer.zero_grad()
                for _ in range(BATCH):
                    seen, _ = env.reset()
                    actions = policy(torch.from_numpy(features(seen)))
                    leaf = actions.detach().double().reshape(box.PUSHED, 12).requires_grad_()
                    episodes += 1
                    try:
                        (env.differentiable(leaf, touches=touches) ** 2).backward()
                    except (wy.SimulationError, wy.GradientError):
                        failed += 1
                        continue
                    gradient = leaf.grad / max(1.0, float(leaf.grad.norm()) / NORM)
                    actions.backward(gradient.reshape(-1).float() / BATCH)
                optimizer.step()


def by_ppo(seed: int, count: int) -> Iterator[tuple[int, Clock, dict[str, float]]]:
    """Trains stable-baselines3's PPO, as ``through_the_simulator``."""
    from stable_baselines3 import PPO

    env = Scaled(ThrowIntoBox())
    size = {"net_arch": [HIDDEN, HIDDEN]}
    steps = EPISODES_OF_PPO * box.PUSHED
    model = PPO("MlpPolicy", env, seed=seed, n_steps=steps, batch_size=64, gamma=1.0, policy_kwargs=size, device="cpu")
    with torch.no_grad():
        model.policy.action_net.bias[2::3] += UP
    episodes, clock = 0, Clock()

    def act(seen: np.ndarray) -> np.ndarray:
        return np.asarray(model.predict(features(seen), deterministic=True)[0], dtype=np.float64)

    while True:
        yield episodes, clock, {**test(act, count), "failed": 0}
        with clock:
            model.learn(UPDATES * steps, reset_num_timesteps=False)
        episodes += UPDATES * EPISODES_OF_PPO


METHODS: dict[str, Callable[[int, int], Iterator[tuple[int, Clock, dict[str, float]]]]] = {
    "analytic": lambda seed, count: through_the_simulator(seed, count, "nothing"),
    "contact": lambda seed, count: through_the_simulator(seed, count, "all"),
    "ppo": by_ppo,
}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", choices=METHODS, nargs="+", default=["analytic", "ppo"], help="(analytic ppo)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4], help="(0 1 2 3 4)")
    parser.add_argument("--minutes", type=float, default=5.0, help="of training a method and seed (%(default)g)")
    parser.add_argument("--episodes", type=int, default=10**9, help="at most, a method and seed (no limit)")
    parser.add_argument("--enough", type=float, default=2.0, help="share of successes to end at (never)")
    parser.add_argument("--unseen", type=int, default=50, help="throws of a test (%(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS / "reinforcement.csv", help="CSV file (%(default)s)")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    wp.config.log_level = wp.LOG_WARNING
    about = environment("gymnasium", "stable-baselines3", "torch")
    rows: list[dict[str, Any]] = []
    for seed in options.seeds:
        for method in options.methods:
            for episodes, clock, found in METHODS[method](seed, options.unseen):
                times = {"seconds": clock.wall, "processor seconds": clock.processor}
                rows.append({"method": method, "seed": seed, "episodes": episodes, **times, **found})
                print(", ".join(f"{name} {value:g}" if name != "method" else value for name, value in rows[-1].items()))
                write_csv(options.output, rows, about)
                ended = clock.wall > 60.0 * options.minutes or episodes >= options.episodes
                if ended or found["success"] >= options.enough:
                    break
    last = {(row["method"], row["seed"]): row for row in rows}
    print_table(list(last.values()))
    print("written:", options.output)


if __name__ == "__main__":
    main()
