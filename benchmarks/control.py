"""Throwing a cloth to a place: the published experiment, and the one that the paper describes, with a box.

    python benchmarks/control.py published       the published code's: 12 scalars by two optimizers, and the network
    python benchmarks/control.py box             figure 8: loss against simulated episodes and seconds, every method
    python benchmarks/control.py variants        what to learn from: which losses lead into the box, and which mislead

Each writes benchmarks/results/control_NAME.csv, and box docs/control.png. Needs the extras torch and
bench, and rl for PPO.
"""

from __future__ import annotations

import argparse
import csv
import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
from common import RESULTS, environment, print_table, write_csv
from matplotlib.figure import Figure
from plots import COLORS, MARKERS, PICTURES, save

import warp_yarn as wy
import warp_yarn.torch as wt
from warp_yarn.envs import box, throws

EPOCHS = 70
"""The paper's number."""

# -- as published -----------------------------------------------------------------------------------------------------

LIFTS = (1.61396e-3, 1.66182e-3, 1.04908e-3, 1.58723e-3, 0.81228e-3, 0.53757e-3)
DRAGS = (0.93096e-3, 0.96396e-3, 0.43926e-3, 1.78333e-3, 1.32253e-3, 1.72603e-3)
"""Where the published search starts: forces on every corner along z and y, in each of the first frames [N]."""
GOAL = (0.0, 57.45e-3, 9.31e-3)
"""Of the mean node, from where it starts [m]; it was not published, but is what GOAL_FORCE makes."""
GOAL_FORCE = 2e-3
"""Along y and z, in each of the first frames [N]."""
STRONGEST = 4e-3
"""Of the network's forces [N]."""
RATE, STEPS_AN_EPOCH = 1e-4, 12
"""Of gradient descent. The published loop over parameters has the optimizer's step within it, so that an epoch makes as
many steps as there are parameters, all with one gradient."""


class Published:
    """The published experiment: a free cloth without a table, a box or contact.

    Args:
        pushed: frames with forces. The published network has 1: ``if (s = force_stop_frame)`` assigns where it should
            compare.
        pose: the published network starts upright, though its goal was made from a flat start.
        steps: of 1 ms.
    """

    def __init__(self, pushed: int = len(LIFTS), pose: str = "flat", steps: int = 99):
        yarn = wy.Yarn(density=2e-3, stretch=5e4, bend=1e-5)
        numbers: dict[str, Any] = {"shear": 1000.0, "friction": 0.5, "friction_damping": 1000.0}
        cloth = wy.Cloth(wy.Weave.plain(rows=5, columns=5), yarns=[yarn], pose=pose, **numbers)
        forces = {node: np.zeros((1, 3)) for node in cloth.corners()}
        scene = wy.Scene(cloth, wind=wy.Wind(velocity=(0, 0, 0)), forces=forces)
        options: dict[str, Any] = {"step": 1e-3, "integrator": "linear", "energy_watch": False}
        self.pushed = pushed
        self.push = wt.Rollout(scene, 1, frames=[1], **options)
        self.fly = wt.Rollout(scene, steps - pushed, frames=[steps - pushed], **options)
        self.begin = wt.Frames(*(torch.as_tensor(x)[None] for x in state_arrays(self.push))).last
        self.centre = torch.as_tensor(cloth.position.mean(axis=0))
        self.goal = torch.tensor(GOAL, dtype=torch.float64)

    def reach(self, policy: Callable[[Any, int], torch.Tensor]) -> torch.Tensor:
        """How far the mean node goes [3] (m), under forces along y and z on all corners [2] (N)."""
        state = self.begin
        for step in range(self.pushed):
            force = torch.cat([torch.zeros(1, dtype=torch.float64), policy(state, step)])
            state = self.push(state=state, forces=force.expand(1, 4, 3)).last
        return self.fly(state=state, steps_done=1).position[0].mean(dim=0) - self.centre

    def loss(self, policy: Callable[[Any, int], torch.Tensor]) -> torch.Tensor:
        """The squared distance from the goal [m²]."""
        return (self.reach(policy) - self.goal).square().sum()


def state_arrays(rollout: wt.Rollout) -> list[np.ndarray]:
    state = rollout.simulator.state
    return [getattr(state, name).copy() for name in wt.Frames._fields]


def scalars() -> torch.Tensor:
    """The published start: forces along y and z by frame [6, 2] (N)."""
    return torch.tensor(list(zip(DRAGS, LIFTS, strict=True)), dtype=torch.float64, requires_grad=True)


def descend(task: Published, steps: int, epochs: int = EPOCHS) -> list[float]:
    """Gradient descent on the scalars, so many steps with each gradient: losses [m²], one an epoch, and the last."""
    forces, losses = scalars(), []
    optimizer = torch.optim.SGD([forces], lr=RATE)
    for _ in range(epochs):
        optimizer.zero_grad()
        loss = task.loss(lambda _, step: forces[step])
        loss.backward()
        losses.append(loss.item())
        for _ in range(steps):
            optimizer.step()
    with torch.no_grad():
        return [*losses, task.loss(lambda _, step: forces[step]).item()]


def lbfgs(task: Published, evaluations: int = 10) -> list[float]:
    """L-BFGS on the scalars, in mN, and the loss in units of the goal's distance: losses [m²], one an evaluation."""
    forces = scalars().detach().mul_(1e3).requires_grad_()
    optimizer = torch.optim.LBFGS([forces], max_iter=1, tolerance_grad=0.0, tolerance_change=0.0)
    losses: list[float] = []

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        loss = task.loss(lambda _, step: 1e-3 * forces[step])
        scaled = loss / task.goal.square().sum()
        scaled.backward()
        losses.append(loss.item())
        return scaled

    for _ in range(evaluations):
        optimizer.step(closure)
    return losses


def network(task: Published, seed: int, epochs: int = EPOCHS, rate: float = 0.01) -> list[float]:
    """The network, its faults mended, by Adam: losses [m²], one an epoch."""
    layers, losses = throws.layers(seed, 2), []
    optimizer = torch.optim.Adam(layers.parameters(), lr=rate)
    for _ in range(epochs):
        optimizer.zero_grad()
        loss = task.loss(lambda state, _: STRONGEST * torch.sigmoid(layers(throws.seen(state))))
        loss.backward()
        losses.append(loss.item())
        optimizer.step()
    return losses


def published(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Rows of the published experiment."""
    task = Published()
    runs: list[tuple[str, Any]] = [
        ("gradient descent, as published", lambda: descend(task, STEPS_AN_EPOCH, options.epochs)),
        ("gradient descent, a step an epoch", lambda: descend(task, 1, options.epochs)),
        ("L-BFGS", lambda: lbfgs(task)),
    ]
    for seed in range(options.seeds):
        runs.append((f"network, seed {seed}", lambda seed=seed: network(task, seed, options.epochs)))
    rows = []
    for name, run in runs:
        begin = time.perf_counter()
        losses = run()
        rows.append(
            {
                "method": name,
                "evaluations": len(losses),
                "first [mm]": 1e3 * math.sqrt(losses[0]),
                "last [mm]": 1e3 * math.sqrt(losses[-1]),
                "nearest [mm]": 1e3 * math.sqrt(min(losses)),
                "seconds": time.perf_counter() - begin,
            }
        )
    return rows


# -- the box ----------------------------------------------------------------------------------------------------------


def gradient(kind: type[torch.nn.Module], seed: int, epochs: int) -> Iterator[tuple[int, float, float, bool]]:
    """Learning by gradients: episodes and seconds so far, the miss in the true scene [m], and whether it succeeded.

    Both the throw that is learned from and the one that is judged count as an episode.
    """
    throw = throws.Throw()
    for number, epoch in enumerate(throws.learn(throw, kind(seed), epochs), 1):
        yield 2 * number, epoch.seconds, epoch.miss, epoch.success


def random_search(seed: int, episodes: int) -> Iterator[tuple[int, float, float, bool]]:
    """Forces by chance from where ``throws.Forces`` starts: the best so far of the true scene."""
    chance, begin, best = np.random.default_rng(seed), time.perf_counter(), (math.inf, False)
    mean = start_mean()
    for episode in range(1, episodes + 1):
        found = throws.judge(bounded(mean + chance.normal(0.0, 2.0 * throws.SPREAD, mean.size)))
        best = min(best, found, key=lambda pair: (not pair[1], pair[0] if math.isfinite(pair[0]) else math.inf))
        yield episode, time.perf_counter() - begin, *best


def evolution(seed: int, episodes: int) -> Iterator[tuple[int, float, float, bool]]:
    """CMA-ES (Hansen 2016, with his constants) on the miss in the true scene: the best of each generation."""
    chance, begin, mean = np.random.default_rng(seed), time.perf_counter(), start_mean()
    n = mean.size
    count = 4 + int(3 * math.log(n))
    weights = np.maximum(math.log((count + 1) / 2) - np.log(np.arange(1, count + 1)), 0.0)
    weights /= weights.sum()
    most = 1.0 / (weights**2).sum()
    cs, cc = (most + 2) / (n + most + 5), (4 + most / n) / (n + 4 + 2 * most / n)
    c1 = 2 / ((n + 1.3) ** 2 + most)
    cm = min(1 - c1, 2 * (most - 2 + 1 / most) / ((n + 2) ** 2 + most))
    damping = 1 + 2 * max(0.0, math.sqrt((most - 1) / (n + 1)) - 1) + cs
    expected = math.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n**2))
    size, covariance, ps, pc = throws.SPREAD, np.eye(n), np.zeros(n), np.zeros(n)
    for generation in range(1, episodes // count + 1):
        values, vectors = np.linalg.eigh(covariance)
        root = np.sqrt(np.maximum(values, 1e-20))
        steps = (chance.normal(size=(count, n)) * root) @ vectors.T
        found = [throws.judge(bounded(mean + size * step)) for step in steps]
        order = np.argsort([miss if math.isfinite(miss) else math.inf for miss, _ in found])
        mean_step = weights @ steps[order]
        mean = mean + size * mean_step
        ps = (1 - cs) * ps + math.sqrt(cs * (2 - cs) * most) * vectors @ ((vectors.T @ mean_step) / root)
        follows = np.linalg.norm(ps) / math.sqrt(1 - (1 - cs) ** (2 * generation)) < (1.4 + 2 / (n + 1)) * expected
        pc = (1 - cc) * pc + follows * math.sqrt(cc * (2 - cc) * most) * mean_step
        rank = (weights[:, None] * steps[order]).T @ steps[order]
        lost = (1 - follows) * c1 * cc * (2 - cc)
        covariance = (1 - c1 - cm + lost) * covariance + c1 * np.outer(pc, pc) + cm * rank
        size *= math.exp(cs / damping * (np.linalg.norm(ps) / expected - 1))
        miss, success = found[order[0]]
        yield generation * count, time.perf_counter() - begin, miss, success


def start_mean() -> np.ndarray:
    """The mean of where ``throws.Forces`` starts [60]."""
    mean = np.zeros((box.PUSHED, 4, 3))
    mean[..., 2] = throws.LIFT
    return mean.ravel()


def bounded(inner: np.ndarray) -> np.ndarray:
    """Forces of the numbers within ``throws.Forces`` [PUSHED, 4, 3] (N)."""
    return box.FORCE * np.tanh(inner).reshape(box.PUSHED, 4, 3)


def ppo(seed: int, episodes: int) -> Iterator[tuple[int, float, float, bool]]:
    """PPO of stable-baselines3 on the environment of this scene, reward minus the miss: the mean action's throw."""
    from reinforcement import EPISODES_OF_PPO, HIDDEN, Scaled
    from stable_baselines3 import PPO

    from warp_yarn.envs import ThrowIntoBox

    env, test = (Scaled(ThrowIntoBox(random=False)) for _ in range(2))
    steps = EPISODES_OF_PPO * box.PUSHED
    size = {"net_arch": [HIDDEN, HIDDEN]}
    model = PPO("MlpPolicy", env, seed=seed, n_steps=steps, batch_size=64, gamma=1.0, policy_kwargs=size, device="cpu")
    with torch.no_grad():  # the other methods' start
        model.policy.action_net.bias.view(4, 3)[:, 2] += math.tanh(throws.LIFT)
    begin = time.perf_counter()
    for done in range(EPISODES_OF_PPO, episodes + 1, EPISODES_OF_PPO):
        model.learn(steps, reset_num_timesteps=False)
        seen, info = test.reset()[0], {}
        for _ in range(box.PUSHED):
            seen, _, _, _, info = test.step(model.predict(seen, deterministic=True)[0])
        miss, success = info["distance"], info["is_success"]
        yield done, time.perf_counter() - begin, miss, success


METHODS: dict[str, Callable[[int, argparse.Namespace], Iterator[tuple[int, float, float, bool]]]] = {
    "free forces": lambda seed, options: gradient(throws.Forces, seed, options.epochs),
    "network": lambda seed, options: gradient(throws.Network, seed, options.epochs),
    "CMA-ES": lambda seed, options: evolution(seed, options.episodes),
    "random search": lambda seed, options: random_search(seed, options.episodes),
    "PPO": lambda seed, options: ppo(seed, options.episodes),
}


def into_box(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Rows of every method, seed and point of its curve; those of methods that are not asked for stay as they were."""
    rows = [row for row in read(options.output) if row["method"] not in options.methods]
    for name in options.methods:
        for seed in range(options.seeds):
            successes: list[dict[str, Any]] = []
            for episodes, seconds, miss, success in METHODS[name](seed, options):
                row = {"method": name, "seed": seed, "episodes": episodes, "seconds": seconds}
                rows.append({**row, "miss [mm]": 1e3 * miss, "success": int(success)})
                successes += [rows[-1]] * bool(success)
                if len(successes) == LASTING:
                    break
            at = "none" if not successes else "after {episodes} episodes, {seconds:.1f} s".format(**successes[0])
            print(f"{name}, seed {seed}: first success {at}", flush=True)
    return rows


LASTING = 3
"""Successes at which a curve ends."""


def read(path: Path) -> list[dict[str, Any]]:
    """The rows of such a file, if there is one."""
    if not path.exists():
        return []
    kinds = {"method": str, "seed": int, "episodes": int, "seconds": float, "miss [mm]": float, "success": int}
    with open(path, newline="") as file:
        return [{name: kind(row[name]) for name, kind in kinds.items()} for row in csv.DictReader(file)]


def figure_8(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Loss against episodes and seconds: median of the seeds, spread, and where each first succeeds."""
    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    for axes, along in zip(figure.subplots(1, 2, sharey=True), ("episodes", "seconds"), strict=True):
        for name, color, marker in zip(METHODS, COLORS, MARKERS, strict=False):
            mine = [row for row in rows if row["method"] == name]
            curves = [[row for row in mine if row["seed"] == seed] for seed in sorted({row["seed"] for row in mine})]
            if not curves:
                continue
            grid = np.geomspace(min(row[along] for row in mine), max(row[along] for row in mine), 80)
            y = np.array([held(curve, along, grid) for curve in curves])
            firsts = [next((row for row in curve if row["success"]), None) for curve in curves]
            done = [row for row in firsts if row is not None]
            label = f"{name}: {len(done)} of {len(curves)} seeds"
            axes.plot(grid, np.nanmedian(y, axis=0), color=color, label=label, linewidth=1.6)
            axes.fill_between(grid, np.nanmin(y, axis=0), np.nanmax(y, axis=0), color=color, alpha=0.15, linewidth=0)
            axes.plot([row[along] for row in done], [row["miss [mm]"] for row in done], marker, color=color, alpha=0.8)
        axes.set_xscale("log")
        axes.set_xlabel({"episodes": "simulated episodes", "seconds": "seconds"}[along])
        axes.grid(alpha=0.3)
        axes.axhline(1e3 * 0.5 * box.INNER, color="0.4", linewidth=1.0, linestyle=":")
    left = figure.axes[0]
    left.set_ylabel("how far from the box's middle the throw arrives [mm]")
    left.set_ylim(0.0, 100.0)
    left.legend(title="median and range of the seeds;\nmarks: first success of each", fontsize="small")
    save(figure, path)


def held(curve: Sequence[dict[str, Any]], along: str, grid: np.ndarray) -> np.ndarray:
    """A curve at places of a grid: as it was last."""
    at = np.searchsorted([row[along] for row in curve], grid, side="right") - 1
    return np.array([row["miss [mm]"] for row in curve])[np.maximum(at, 0)]


# -- what to learn from -----------------------------------------------------------------------------------------------

VARIANTS: dict[str, dict[str, Any]] = {
    "at arrival, nothing touches": {},
    "at arrival, table": {"touches": "table"},
    "at arrival, all": {"touches": "all"},
    "at 145 ms, nothing touches": {"at": 145},
    "at 145 ms, table": {"at": 145, "touches": "table"},
    "at arrival, nothing touches, SDIRK2": {"integrator": "sdirk2"},
    "at the end, all": {"at": box.STEPS, "touches": "all"},
    "at the end, all, no friction": {"at": box.STEPS, "touches": "all", "friction": 0.0},
    "at the end, all, SDIRK2": {"at": box.STEPS, "touches": "all", "integrator": "sdirk2"},
}

UNBOUNDED = 1e100
"""A bound that no gradient's norm comes near."""


def variants(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Rows of every variant, with and without an upward start and a bound of the gradient's norm; free forces, until
    they first succeed."""
    rows = []
    for name, more in VARIANTS.items():
        throw = throws.Throw(**more)
        cases = [(throws.LIFT, throws.BOUND), (0.0, throws.BOUND)]
        if name == "at the end, all":
            cases.append((throws.LIFT, UNBOUNDED))
        for lift, bound in cases:
            firsts, norms, failed, begin = [], [], 0, time.perf_counter()
            count = 0
            for seed in range(options.seeds):
                first = math.inf
                for number, epoch in enumerate(
                    throws.learn(throw, throws.Forces(seed, lift), options.epochs, bound=bound), 1
                ):
                    count += 1
                    failed += int(math.isnan(epoch.loss))
                    norms.append(epoch.gradient)
                    if epoch.success:
                        first = number
                        break
                firsts.append(first)
            done = sorted(first for first in firsts if math.isfinite(first))
            rows.append(
                {
                    "loss": name,
                    "start": "upward" if lift else "by chance",
                    "norm bounded": "yes" if bound < UNBOUNDED else "no",
                    "succeed": f"{len(done)} of {options.seeds}",
                    "epochs": " ".join(map(str, done)),
                    "gradient, median": float(np.nanmedian(norms)),
                    "gradient, largest": float(np.nanmax(norms)),
                    "failed": failed,
                    "seconds an epoch": (time.perf_counter() - begin) / count,
                }
            )
            print(rows[-1], flush=True)
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("published", "box", "variants"))
    parser.add_argument("--seeds", type=int, default=5, help="(%(default)s)")
    parser.add_argument("--epochs", type=int, default=EPOCHS, help="of each method that has gradients (%(default)s)")
    parser.add_argument("--episodes", type=int, default=512, help="of each that has none (%(default)s)")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="of box (all)")
    parser.add_argument("--output", type=Path, help="CSV file (benchmarks/results/control_WHAT.csv)")
    parser.add_argument("--plot", type=Path, default=PICTURES / "control.png", help="of box (docs/control.png)")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    torch.set_num_threads(1)
    options.output = options.output or RESULTS / f"control_{options.what}.csv"
    rows = {"published": published, "box": into_box, "variants": variants}[options.what](options)
    write_csv(options.output, rows, environment("torch"))
    if options.what == "box":
        figure_8(rows, options.plot)
    else:
        print_table(rows)
    print("written:", options.output)


if __name__ == "__main__":
    main()
