"""A yarn is pulled out of a weave by its end, at constant speed: the force against the distance, and what friction did.

python scenes/pullout.py                                  plain, 7 × 7: out/pullout.png and out/pullout.csv
python scenes/pullout.py --size 9 --speed 0.005 --distance 4e-4 --png docs/pullout.png

The cloth lies flat between plates: all its nodes are held by springs but one end of the middle warp yarn, whose other
end is pulled. That yarn then slides through the crossings, which the crimp of the yarns presses together (eq. 3).
The chart has the force of eq. 4 as this project scales it, with the published scaling, and of exact Coulomb friction;
and beside it the force of weaves and densities. Needs the extra bench.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from common import command, file_ending, make_folders, optional, parse

import warp_yarn as wy
from warp_yarn.errors import integer, real
from warp_yarn.io.files import atomic_write
from warp_yarn.presets import paper

with optional("bench"):
    from matplotlib.figure import Figure

DAMPING = 1e-4
"""d_f [N s/m]: 1e-6 N at 1 cm/s, under a hundredth of what a crossing sticks with. The paper's 1000 would hide it."""
SPACINGS = (1.0e-3, 1.25e-3, 1.5e-3)
"""Densities of weave [m], of yarns with the paper's radius."""


@dataclasses.dataclass(frozen=True)
class Pull:
    """What was measured while a yarn was pulled, a row a step, the first at rest.

    Args:
        distance: of the pulled end [m].
        force: on it [N].
        contact: F_n of the yarn's crossings [steps + 1, crossings] (N).
        slid: how far the yarn has slid through each crossing [steps + 1, crossings] (m).
    """

    distance: np.ndarray
    force: np.ndarray
    contact: np.ndarray
    slid: np.ndarray

    @property
    def limit(self) -> np.ndarray:
        """Σ F_n of the yarn's crossings [steps + 1] (N); times μ it is what they can hold."""
        return self.contact.sum(axis=1)


def cloth(weave: str = "plain", size: int = 7, **options: Any) -> wy.Cloth:
    """A square of the paper's yarn 1, flat, whose sliding is hardly damped.

    The first weft yarn, which the tail would drag along, is without stiffness.
    """
    loose = dataclasses.replace(paper.YARNS[1], stretch=0.0, bend=0.0)
    yarns = {"yarns": [paper.YARNS[1], loose], "warp": [0] * size, "weft": [1] + [0] * (size - 1)}
    draft = wy.WEAVES[weave](rows=size, columns=size)
    return wy.Cloth(draft, **{**yarns, "pose": "flat", "friction_damping": DAMPING, **options})


def pull(
    cloth: wy.Cloth, *, speed: float, distance: float, step: float, row: int | None = None, **options: Any
) -> Pull:
    """Pulls the right end of a warp yarn.

    Args:
        row: the yarn; None: the middle one.
        options: of the Scene.
    """
    row = cloth.weave.rows // 2 if row is None else row
    tail, end = cloth.node(row, 0), cloth.node(row, -1)
    pins = [node for node in range(cloth.nodes) if node != tail]
    steps = integer("distance / (speed · step)", round(distance / (speed * step)), least=1)
    path = np.repeat(cloth.position[None, pins], steps, axis=0)
    path[:, pins.index(end), 0] += speed * step * np.arange(1, steps + 1)
    scene = wy.Scene(cloth, gravity=None, pins=pins, pin_path=path, pin_stiffness=None, **options)
    simulator = wy.Simulator(scene, step=step)
    crossings = [cloth.node(row, column) for column in range(1, cloth.weave.columns - 1)]
    force, contact, slid = [0.0], [simulator.contact()[1][crossings]], [np.zeros(len(crossings))]
    for _ in range(steps):
        simulator.run(1)
        state = simulator.state
        length = np.linalg.norm(state.position[end] - state.position[end - 1])
        force.append(
            float(cloth.stretch_stiffness[0]) * (length / (state.euler[end, 0] - state.euler[end - 1, 0]) - 1.0)
        )
        contact.append(simulator.contact()[1][crossings])
        slid.append(cloth.euler[crossings, 0] - state.euler[crossings, 0])
    return Pull(speed * step * np.arange(steps + 1), np.array(force), np.array(contact), np.array(slid))


def coulomb(cloth: wy.Cloth, contact: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """The force that exact Coulomb friction asks for, at rest at every distance [rows] (N).

    Crossings stand still and hold the yarn by springs of k_f, up to μ F_n: the return map. Between them the yarn
    stretches, V = kₛ (l − Δs)²/(2 Δs); its free tail has no tension.

    Args:
        contact: F_n of its crossings at every distance [rows, crossings] (N).
    """
    ks = float(cloth.stretch_stiffness[0])
    length, k = cloth.spacing, cloth.friction_stiffness
    crossings = contact.shape[1]
    rest = length * np.arange(1, crossings + 2)
    s, anchor = rest[:-1].copy(), rest[:-1].copy()
    result = []
    for moved, load in zip(distance, contact, strict=True):
        limit = cloth.friction * load
        lengths = np.full(crossings, length)
        lengths[-1] += moved
        for _ in range(100):
            gaps = np.diff(np.append(s, rest[-1]))
            ratio = lengths / gaps
            # on every crossing from the segment to its right, and from the one to its left; none from the tail
            drive = -0.5 * ks * (ratio**2 - 1.0)
            drive[1:] += 0.5 * ks * (ratio[:-1] ** 2 - 1.0)
            trial = -k * (s - anchor)
            residual = drive + np.clip(trial, -limit, limit)
            if np.abs(residual).max() < 1e-12 * ks:
                break
            slope = ks * ratio**2 / gaps
            matrix = np.diag(slope + np.where(np.abs(trial) < limit, k, 0.0))
            matrix[1:, 1:] += np.diag(slope[:-1])
            matrix -= np.diag(slope[:-1], 1) + np.diag(slope[:-1], -1)
            s = s + np.linalg.solve(matrix, residual)
        else:
            raise RuntimeError(f"the return map did not converge at {moved:g} m")
        anchor = s - np.clip(s - anchor, -limit / k, limit / k)
        result.append(ks * (lengths[-1] / (rest[-1] - s[-1]) - 1.0))
    return np.array(result)


def parser() -> argparse.ArgumentParser:
    result = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    add = result.add_argument
    add("--size", type=int, default=7, metavar="N", help="rows and columns, at least 4 (%(default)s)")
    add("--speed", type=float, default=1e-3, help="of the pulled end, m/s (%(default)g)")
    add("--distance", type=float, default=1e-4, help="that it is pulled, m (%(default)g)")
    add("--step", type=float, default=1e-3, help="time step, s (%(default)g)")
    add("--png", type=file_ending(".png"), default=Path("out/pullout.png"), metavar="FILE", help="(%(default)s)")
    add("--csv", type=file_ending(".csv"), default=Path("out/pullout.csv"), metavar="FILE", help="(%(default)s)")
    return result


def main(arguments: Sequence[str] | None = None) -> dict[str, Pull]:
    """Pulls, draws, and tells what was measured.

    Raises:
        InputError: an option that cannot be used.
        SimulationError: a step that could not be made.
    """
    options = parse(parser(), arguments)
    make_folders([options.png, options.csv])
    size = integer("--size", options.size, least=4)
    motion = {name: real(f"--{name}", getattr(options, name), above=0.0) for name in ("speed", "distance", "step")}
    plain = cloth("plain", size)
    pulls = {
        f"eq. 4, dimensionless, steps of {1e3 * motion['step']:g} ms": pull(plain, **motion),
        f"the same, steps of {1e2 * motion['step']:g} ms": pull(plain, **{**motion, "step": 0.1 * motion["step"]}),
        "eq. 4 with the published scaling": pull(plain, **motion, published_scaling=True),
    }
    first = next(iter(pulls.values()))
    exact = coulomb(plain, first.contact, first.distance)
    # all of a width of (size − 1) mm, so that closer weaves have more crossings
    width = (size - 1) * SPACINGS[0]
    table = []
    for weave in wy.WEAVES:
        for spacing in SPACINGS:
            fabric = cloth(weave, round(width / spacing) + 1, spacing=spacing)
            table.append((weave, spacing, float(pull(fabric, **motion).force.max())))
    write_chart(options.png, pulls, first.distance, exact, table)
    write_numbers(options.csv, pulls, first.distance, exact)
    print(f"breaks away at {1e3 * first.force.max():.4f} mN, slips at {1e3 * first.force[-1]:.4f} mN;", end=" ")
    print(
        f"exact Coulomb friction: {1e3 * exact.max():.4f} mN, Σ μ F_n: {1e3 * plain.friction * first.limit[0]:.4f} mN"
    )
    for weave, spacing, force in table:
        print(f"{weave:>6}, {1e-3 / spacing:.2f} yarns a mm: {1e3 * force:.4f} mN")
    print("written:", options.png, options.csv)
    return pulls


def write_chart(
    path: Path, pulls: dict[str, Pull], distance: np.ndarray, exact: np.ndarray, table: list[tuple[str, float, float]]
) -> None:
    figure = Figure(figsize=(11.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.6, 1.0])
    for (name, found), style in zip(pulls.items(), ("-", ":", "--"), strict=True):
        left.plot(1e6 * found.distance, 1e3 * found.force, style, label=name)
    left.plot(1e6 * distance, 1e3 * exact, "k", linewidth=0.8, label="exact Coulomb friction")
    left.set(xlabel="distance pulled (µm)", ylabel="force (mN)", title="A yarn pulled through a plain weave")
    left.legend()
    for weave in wy.WEAVES:
        points = [(1e-3 / spacing, 1e3 * force) for name, spacing, force in table if name == weave]
        right.plot(*zip(*points, strict=True), "o-", label=weave)
    right.set(xlabel="yarns a mm", ylabel="largest force (mN)", title="Weaves of one width", ylim=(0.0, None))
    right.legend()
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=130, format="png")


def write_numbers(path: Path, pulls: dict[str, Pull], distance: np.ndarray, exact: np.ndarray) -> None:
    rows = [(name, *row) for name, found in pulls.items() for row in zip(found.distance, found.force, strict=True)]
    rows += [("exact Coulomb friction", *row) for row in zip(distance, exact, strict=True)]
    with atomic_write(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["law", "distance [m]", "force [N]"])
        writer.writerows(rows)


if __name__ == "__main__":
    sys.exit(command(main))
