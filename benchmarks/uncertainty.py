"""Whether what is learned errs by as much as learning says: z-scores, errors in standard deviations.

    python benchmarks/uncertainty.py [--seeds 20] [--size 5]

Density, stretch, bending and shear are learned from ten frames, 1 ms apart, of two fabrics that hang by two corners in
the paper's wind, with noise of 1 µm on their positions, which each seed makes anew. "paper" is the paper's plain cloth
of yarns 1 and 2, "handkerchief" light, stiff yarns. A flat cloth starts at rest; a saddle is bent without being at
rest, so that its yarns ring when it is let go, faster than a step of 1 ms resolves.

"same" data are made with the model's step: noise is all that they differ by, and z-scores have a spread of 1. "finer"
data are made with a step ten times finer: errors are then the step's, the same for all seeds, and no more than the
uncertainties have to cover them. "spread" is the root mean square of z, "largest" its largest size, "uncertainty" the
mean one in units of the range, of which 0.29 is all that the range itself says; "determined" in how many of the seeds.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
from common import RESULTS, environment, one_core, print_table, write_csv

import warp_yarn as wy
from warp_yarn.calibration.learn import CalibrationProblem, Parameter, learn, value_of
from warp_yarn.presets import paper

FABRICS = ("paper", "handkerchief")
POSES = ("flat", "saddle")
TRUTHS = {"same": 1, "finer": 10}
"""Steps of the data from frame to frame."""

STEP, FRAMES, NOISE = 1e-3, 10, 1e-6
SOLVED = {"newton_tolerance": 1e-10}
CURVED = 150.0
"""z/(x y) of a saddle [1/m]: 2 mm from the middle of a cloth its yarns rise by 0.3 for 1."""


def cloth_of(fabric: str, pose: str, size: int) -> wy.Cloth:
    """A cloth of size × size yarns."""
    if fabric == "paper":
        cloth = paper.cloth("plain", size, size)
    else:
        radius = 1e-3 / 3.0
        area = np.pi * radius**2
        yarn = wy.Yarn(density=5e-5, stretch=3.0 / area, bend=2e-8 / area)
        cloth = wy.Cloth(wy.Weave.plain(rows=size, columns=size), yarns=[yarn], radius=radius, shear=1000.0)
    x, y = (cloth.euler - cloth.euler.mean(axis=0)).T
    z = CURVED * x * y if pose == "saddle" else np.zeros_like(x)
    return wy.Cloth(
        cloth.weave, yarns=cloth.yarns, radius=cloth.radius, shear=cloth.shear, pose=np.stack([x, y, z], axis=1)
    )


def parameters_of(scene: wy.Scene) -> list[Parameter]:
    """What is learned, from starts that are some 20 % off, in ranges of which the truth is the middle or nearly."""
    ranges = {"density[0]": (0.5, 1.5, 1.2), "stretch[0]": (0.0, 2.0, 0.7), "bend[0]": (0.2, 2.0, 1.3)}
    ranges["shear"] = (0.0, 2.0, 0.7)
    return [Parameter(name, *(value_of(scene, name) * np.array(of))) for name, of in ranges.items()]


def scores(fabric: str, pose: str, truth: str, size: int, seeds: Sequence[int]) -> list[dict[str, Any]]:
    """A row for each parameter, over all seeds."""
    cloth = cloth_of(fabric, pose, size)
    scene = paper.hung(cloth)
    every = TRUTHS[truth]
    clean = wy.Simulator(scene, step=STEP / every, differentiable=True, **SOLVED).run(FRAMES * every)
    parameters = parameters_of(scene)
    z, uncertainty, determined = [], [], []
    for seed in seeds:
        noise = np.random.default_rng(seed).normal(size=clean.position.shape)
        noise[0] = 0.0  # the model starts there
        noisy = dataclasses.replace(clean, position=clean.position + NOISE * noise)
        result = learn(CalibrationProblem(scene, noisy, parameters, every=every, **SOLVED))
        of = [(result.values[p.name] - value_of(scene, p.name)) / result.uncertainty[p.name] for p in parameters]
        z.append(of)
        uncertainty.append([result.uncertainty[p.name] / (p.high - p.low) for p in parameters])
        determined.append([result.status[p.name] == "determined" for p in parameters])
    return [
        {
            "fabric": fabric,
            "pose": pose,
            "data": truth,
            "parameter": p.name,
            "mean": float(np.mean(z, axis=0)[k]),
            "spread": float(np.sqrt(np.mean(np.square(z), axis=0))[k]),
            "largest": float(np.abs(z).max(axis=0)[k]),
            "uncertainty": float(np.mean(uncertainty, axis=0)[k]),
            "determined": f"{int(np.sum(determined, axis=0)[k])} of {len(seeds)}",
        }
        for k, p in enumerate(parameters)
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20, help="how many (%(default)s)")
    parser.add_argument("--size", type=int, default=5, help="rows and columns (%(default)s)")
    parser.add_argument("--fabrics", nargs="+", choices=FABRICS, default=FABRICS, help="(all)")
    parser.add_argument("--poses", nargs="+", choices=POSES, default=POSES, help="(all)")
    parser.add_argument("--data", nargs="+", choices=tuple(TRUTHS), default=tuple(TRUTHS), help="(all)")
    parser.add_argument("--output", type=Path, default=RESULTS / "uncertainty.csv", help="CSV file (%(default)s)")
    options = parser.parse_args(arguments)
    one_core()
    torch.set_num_threads(1)
    wp.config.log_level = wp.LOG_WARNING
    rows = []
    for truth in options.data:
        for fabric in options.fabrics:
            for pose in options.poses:
                new = scores(fabric, pose, truth, options.size, range(options.seeds))
                print_table(new)
                rows += new
    for truth in options.data:
        of = [row for row in rows if row["data"] == truth]
        spread = np.sqrt(np.mean([row["spread"] ** 2 for row in of]))
        print(f"{truth}: spread {spread:.2f}, largest {max(row['largest'] for row in of):.2f}")
    about = environment("scipy", "torch")
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    write_csv(options.output, rows, about)
    print("written:", options.output)


if __name__ == "__main__":
    main()
