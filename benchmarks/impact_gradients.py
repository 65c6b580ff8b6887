"""A loss scanned through an impact, beside its gradient: where gradients help, and where they mislead.

    python benchmarks/impact_gradients.py [--points 31] [--step 1e-3 5e-4]

A cloth of 5 × 5 of the paper's yarns is thrown by forces on its corners and lands, turning, on a floor 30 mm below. The
loss is the squared distance of its centre from a place on the floor, where it arrives just above it, or after 0.2 s,
with the floor between. Scanned is a line of forces, up to 2 % to both sides of a throw by chance.

A row has, of the scan: how often the loss turns, its total variation over its range (1: it only falls or rises), and
the gradient at several places beside the mean slope. Writes benchmarks/results/impact_gradients.csv and
docs/impact_gradients.png. Needs the extras torch and bench.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
from common import RESULTS, environment, print_table, write_csv
from matplotlib.figure import Figure
from plots import COLORS, PICTURES, save

import warp_yarn as wy
import warp_yarn.torch as wt
from warp_yarn.envs import box, throws

DURATION = 0.2
"""Of a throw [s]."""
RANGE = 0.02
"""How far the scan goes to both sides, of the norm of what is scanned."""
TOWARD = 0.5
"""Added to the start by chance along x, so that the throw goes towards the box as much as upward."""
LOSSES: dict[str, float | None] = {"at arrival": None, "after the impact, μ = 0": 0.0, "after the impact, μ = 0.3": 0.3}
"""What is scanned, and the floor's friction."""


class Scan:
    """A loss along a line of throws.

    Args:
        loss: of LOSSES.
        integrator, step: of the throw.
        seed: of throw and line.
    """

    def __init__(self, loss: str, integrator: str, step: float, seed: int):
        self.friction = LOSSES[loss]
        cloth = box.cloth()
        pushed, steps = round(box.PUSHED * box.STEP / step), round(DURATION / step)
        forces = {node: np.zeros((pushed, 3)) for node in cloth.corners()}
        up = np.array([0.0, 0.0, 1.0])
        floor = wy.Plane(point=box.BOTTOM * up, normal=up, friction=self.friction or 0.0)
        scene = wy.Scene(cloth, forces=forces, obstacles=[] if self.friction is None else [floor])
        frames = None if self.friction is None else [steps]
        self.rollout = wt.Rollout(scene, steps, frames=frames, step=step, integrator=integrator)
        self.each = pushed // box.PUSHED
        self.middle = throws.Forces(seed).inner.detach()
        self.middle[..., 0] += TOWARD
        chance = torch.Generator().manual_seed(seed + 1000)
        line = torch.randn(self.middle.shape, generator=chance, dtype=torch.float64)
        self.line = line / line.norm() * self.middle.norm()
        self.target = torch.as_tensor(box.target())

    def loss(self, at: torch.Tensor) -> torch.Tensor:
        """The loss at a place of the line, in units of the squared distance of the target."""
        forces = box.FORCE * torch.tanh(self.middle + at * self.line)
        path = self.rollout(forces=forces.repeat_interleave(self.each, dim=0)).position.mean(dim=1)
        centre = box.arrival(path) if self.friction is None else path[-1]
        return ((centre - self.target) / self.target.norm()).square().sum()

    def gradient(self, at: float) -> float:
        """Its derivative along the line."""
        place = torch.tensor(at, dtype=torch.float64, requires_grad=True)
        self.loss(place).backward()
        return float(place.grad)


def scanned(
    loss: str, integrator: str, step: float, seed: int, points: int
) -> tuple[np.ndarray, np.ndarray, list[tuple[float, float]]]:
    """The places, the losses there, and the gradient at every fifth of them."""
    scan = Scan(loss, integrator, step, seed)
    places = np.linspace(-RANGE, RANGE, points)
    with torch.no_grad():
        losses = np.array([float(scan.loss(torch.tensor(at))) for at in places])
    return places, losses, [(at, scan.gradient(at)) for at in places[:: max(points // 8, 1)]]


def row(
    names: dict[str, Any], places: np.ndarray, losses: np.ndarray, gradients: Sequence[tuple[float, float]]
) -> dict[str, Any]:
    """What the scan shows."""
    changes = np.diff(losses)
    slope = float(np.polyfit(places, losses, 1)[0])
    found = np.array([gradient for _, gradient in gradients])
    return {
        **names,
        "turns": int((np.diff(np.sign(changes)) != 0).sum()),
        "variation over range": float(np.abs(changes).sum() / np.ptp(losses)),
        "mean slope": slope,
        "gradient, least": float(found.min()),
        "gradient, median": float(np.median(found)),
        "gradient, largest": float(found.max()),
        "of the slope's sign": f"{int((np.sign(found) == math.copysign(1.0, slope)).sum())} of {len(found)}",
    }


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=31, help="of a scan (%(default)s)")
    parser.add_argument("--step", type=float, nargs="+", default=[1e-3, 5e-4], help="[s] (1e-3 5e-4)")
    parser.add_argument("--integrator", nargs="+", default=["implicit-euler", "sdirk2"], help="(both)")
    parser.add_argument("--seed", type=int, default=0, help="of throw and line (%(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS / "impact_gradients.csv", help="CSV file (%(default)s)")
    parser.add_argument("--plot", type=Path, default=PICTURES / "impact_gradients.png", help="PNG file (%(default)s)")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    torch.set_num_threads(1)
    cases = [(integrator, step) for integrator in options.integrator for step in options.step]
    figure = Figure(figsize=(3.4 * len(cases), 2.6 * len(LOSSES)), layout="constrained")
    panels = figure.subplots(len(LOSSES), len(cases), sharex=True, squeeze=False)
    rows = []
    for k, loss in enumerate(LOSSES):
        for (integrator, step), axes in zip(cases, panels[k], strict=True):
            places, losses, gradients = scanned(loss, integrator, step, options.seed, options.points)
            rows.append(
                row({"loss": loss, "integrator": integrator, "step [ms]": 1e3 * step}, places, losses, gradients)
            )
            print(rows[-1], flush=True)
            draw(axes, places, losses, gradients)
            if k == 0:
                axes.set_title(f"{integrator}, {1e3 * step:g} ms", fontsize="medium")
        panels[k, 0].set_ylabel(f"loss {loss}", fontsize="small")
    for axes in panels[-1]:
        axes.set_xlabel("along the line of forces [%]", fontsize="small")
    save(figure, options.plot)
    print_table(rows)
    write_csv(options.output, rows, environment("torch"))
    print("written:", options.output, options.plot)


def draw(axes: Any, places: np.ndarray, losses: np.ndarray, gradients: Sequence[tuple[float, float]]) -> None:
    """A scan, and the gradients as pieces of tangents, no higher than the panel."""
    axes.plot(100 * places, losses, ".-", color=COLORS[0], markersize=3, linewidth=0.8)
    low, high = losses.min(), losses.max()
    room = 0.15 * (high - low)
    half = 0.06 * (places[-1] - places[0])
    for at, gradient in gradients:
        middle = np.interp(at, places, losses)
        reach = min(half, 0.5 * (high - low) / max(abs(gradient), 1e-300))
        ends = np.array([-reach, reach])
        axes.plot(100 * (at + ends), middle + gradient * ends, color=COLORS[1], linewidth=2.0)
    axes.set_ylim(low - room, high + room)
    axes.grid(alpha=0.3)
    axes.tick_params(labelsize="small")


if __name__ == "__main__":
    main()
