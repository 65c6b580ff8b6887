"""What the scenes of touching share: their options and files, how a cloth is laid out, and a look at every frame that
nothing came nearer than it may, by formulas of its own."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from common import (
    Run,
    add_length,
    add_pictures,
    add_recording,
    add_weave,
    check_pictures,
    checked_counts,
    draw,
    file_ending,
    make_folders,
    number_above,
    resumed,
    settle_length,
    simulate,
    woven_cloth,
)

import warp_yarn as wy
from warp_yarn.io.usd import ENDINGS
from warp_yarn.presets import paper
from warp_yarn.presets.fabrics import FABRICS
from warp_yarn.view.geometry import Placed, placed

INTEGRATORS = ("implicit-euler", "sdirk2")
"""Methods whose steps end where their last stage is, and so outside of everything."""


def parser(text: str | None, name: str, *, rows: int, columns: int, steps: int) -> argparse.ArgumentParser:
    """The options of them all."""
    result = argparse.ArgumentParser(
        description=text, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    add = result.add_argument
    add("--fabric", choices=FABRICS, default="paper", help="(%(default)s)")
    add("--rows", type=int, default=rows, help="number of warp yarns (%(default)s)")
    add("--columns", type=int, default=columns, help="number of weft yarns (%(default)s)")
    add_weave(result)
    add("--friction", type=float, default=0.3, metavar="MU", help="of all that touches (%(default)s)")
    add("--integrator", choices=INTEGRATORS, default="implicit-euler", help="(%(default)s)")
    add_length(result, steps)
    add("--step", type=float, default=paper.STEP, metavar="SECONDS", help="time step (%(default)g)")
    add("--seed", type=int, help="starts with every node up to 1 %% of the spacing elsewhere, by chance")
    add("--locked", action="store_true", help="yarns do not slide along each other")
    output = Path(f"out/{name}.usdc")
    add("--output", type=file_ending(*ENDINGS), default=output, metavar="USD", help="(%(default)s)")
    add("--tubes", action="store_true", help="yarns as meshes, for programs that do not draw curves")
    add_pictures(result)
    add_recording(result)
    return result


def add_positive(parser: argparse.ArgumentParser, name: str, value: float, text: str) -> None:
    """An option that is a number above 0."""
    parser.add_argument(
        name, type=number_above(name, 0.0), default=value, metavar="NUMBER", help=f"{text} (%(default)g)"
    )


def parsed(of: argparse.ArgumentParser, arguments: Sequence[str] | None) -> argparse.Namespace:
    """The options, once it is known that all files can be written; ``simulator`` is what --resume asks for."""
    options = of.parse_args(arguments)
    options.simulator = resumed(options, arguments)
    settle_length(options, options.step if options.simulator is None else options.simulator.step_size)
    make_folders([options.output, options.png, options.mp4, options.record])
    check_pictures(options)
    return options


def flat(options: argparse.Namespace) -> wy.Cloth:
    """The cloth of the options, flat, its middle in the origin."""
    checked_counts(options, "rows", "columns")
    cloth = woven_cloth(options.fabric, options, options.rows, options.columns, pose="flat")
    return cloth.replace(pose=cloth.position - cloth.position.mean(axis=0))


def raised(cloth: wy.Cloth, height: float) -> wy.Cloth:
    """The cloth over something of a height [m], at which nothing touches by default, but almost: D + d̂ above it."""
    return cloth.replace(pose=cloth.position + np.array([0.0, 0.0, height + rest(cloth)]))


def rest(cloth: wy.Cloth) -> float:
    """D + d̂ of the default, and a trifle [m]."""
    return 2.0 * cloth.half_thickness * (1.0 + 1e-6)


def scene(cloth: wy.Cloth, options: argparse.Namespace, *others: wy.Cloth, **more: object) -> wy.Scene:
    """A scene of cloths that may touch themselves and each other."""
    contact = wy.Contact(friction=options.friction)
    if options.seed is not None:
        aside = np.random.default_rng(options.seed).uniform(-0.01, 0.01, cloth.position.shape)
        cloth = cloth.replace(pose=cloth.position + cloth.shortest_spacing * aside)
    return wy.Scene([cloth, *others], sliding=not options.locked, self_contact=True, contact=contact, **more)


def simulator(scene: wy.Scene, options: argparse.Namespace) -> wy.Simulator:
    return wy.Simulator(scene, step=options.step, integrator=options.integrator)


def run(scene: wy.Scene, options: argparse.Namespace) -> Run:
    """Makes the steps, and writes them."""
    return simulate(simulator(scene, options), options, [options.output, options.record])


def go_on(options: argparse.Namespace) -> wy.Trajectory:
    """Makes the steps after those of the recording that --resume names, and ends as ``finish``."""
    files = [options.output, options.record]
    return finish(simulate(options.simulator, options, files, after=options.resume), options)


def finish(run: Run, options: argparse.Namespace, *told: str) -> wy.Trajectory:
    """Draws pictures, tells, and looks at every frame.

    Raises:
        SimulationError: what ended the run early, or something came nearer than it may.
    """
    trajectory = run.trajectory
    draw(run, options, size=(960, 720))
    cloth = trajectory.cloth
    for weave in [each.weave for each in (cloth.cloths if isinstance(cloth, wy.Cloths) else [cloth])]:
        print(f"{weave.rows} × {weave.columns} yarns, {weave.name}")
    print(f"{len(trajectory)} frames, in {run.seconds:.2g} s")
    print(f"largest speed at the end: {1e3 * np.linalg.norm(trajectory.velocity[-1], axis=1).max():.3g} mm/s")
    for line in told:
        print(line)
    look(trajectory)
    files = [options.output, options.record, options.png, options.mp4]
    print("written:", ", ".join(str(file) for file in files if file is not None))
    run.end()
    return trajectory


# -- that nothing comes nearer than it may ----------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Clearance:
    """Distances at every frame [frames] (m), and what they must be above; infinite where there is nothing near.

    Args:
        gap: the smallest of a node and an obstacle.
        apart: the smallest of two nodes that may touch.
        distance, self_distance: D of either.
    """

    gap: np.ndarray
    apart: np.ndarray
    distance: float
    self_distance: float


def look(trajectory: wy.Trajectory) -> None:
    """Tells how near things came.

    Raises:
        SimulationError: nearer than they may.
    """
    found = clearance(trajectory)
    pairs = (("an obstacle", found.gap, found.distance), ("each other", found.apart, found.self_distance))
    for what, near, least in pairs:
        if not np.isfinite(near).any():
            continue
        print(f"nodes came as near as {1e3 * near.min():.4f} mm to {what}, and may to {1e3 * least:.4f} mm")
        if near.min() <= least:
            frame = int(near.argmin())
            message = f"frame {frame}: nodes are {near[frame]:g} m from {what}, must be above {least:g} m"
            raise wy.SimulationError(message, step=frame, node=-1, term=None, trajectory=trajectory)


def clearance(trajectory: wy.Trajectory) -> Clearance:
    """Looks at every frame."""
    cloth, frames = trajectory.cloth, len(trajectory)
    law = wy.Contact() if trajectory.scene is None else trajectory.scene.contact
    distance = law.distance or cloth.half_thickness
    self_distance = law.self_distance or max(1.5 * cloth.longest_spacing, 3.0 * cloth.half_thickness)
    reach = self_distance + (law.self_range or cloth.longest_spacing)
    gap, apart = np.full(frames, np.inf), np.full(frames, np.inf)
    for each in placed(trajectory):
        for frame in range(frames):
            local = each.local(trajectory.position[frame], frame)
            gap[frame] = min(gap[frame], distances(each, local).min())
    if trajectory.scene is not None and trajectory.scene.self_contact:
        place = cloth.rest_place
        along = np.linalg.norm(place[:, None] - place[None], axis=2)
        p, q = np.nonzero(np.triu(along >= 0.5 * np.pi * reach))
        for frame in range(frames if len(p) else 0):
            x = trajectory.position[frame]
            apart[frame] = np.sqrt((((x[p] - x[q]) ** 2).sum(axis=1)).min())
    return Clearance(gap, apart, distance, self_distance)


def distances(each: Placed, x: np.ndarray) -> np.ndarray:
    """Of places in an obstacle's own frame [places, 3] (m)."""
    obstacle = each.obstacle
    norm = np.linalg.norm
    if obstacle.shape == "plane":
        return x[:, 2]
    if obstacle.shape == "sphere":
        return norm(x, axis=1) - obstacle.size[0]
    if obstacle.shape == "box":
        by = np.abs(x) - obstacle.size
        return np.where(by.max(axis=1) > 0.0, norm(np.maximum(by, 0.0), axis=1), by.max(axis=1))
    if isinstance(obstacle, wy.TriangleMesh):
        return to_triangles(x, obstacle.vertices[obstacle.faces])
    half, radius, _ = obstacle.size
    if obstacle.shape == "capsule":
        return norm(x - np.clip(x[:, 2:], -half, half) * [0.0, 0.0, 1.0], axis=1) - radius
    by = np.stack([norm(x[:, :2], axis=1) - radius, np.abs(x[:, 2]) - half], axis=1)
    return np.where(by.max(axis=1) > 0.0, norm(np.maximum(by, 0.0), axis=1), by.max(axis=1))


def to_triangles(x: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Distance of places to the nearest of triangles [triangles, 3, 3] (m)."""
    middle = corners.mean(axis=1)
    size = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
    to_middle = np.linalg.norm(x[:, None] - middle[None], axis=2)
    # farther than all of another triangle is: not the nearest
    i, k = np.nonzero(to_middle - size <= to_middle.min(axis=1, keepdims=True))
    a, b, c = corners[k].swapaxes(0, 1)
    p = x[i]
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    over = np.abs(((p - a) * normal).sum(axis=1))
    inside = np.ones(len(p), dtype=bool)
    near = np.full(len(p), np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        edge, out = end - start, p - start
        inside &= (np.cross(edge, out) * normal).sum(axis=1) >= 0.0
        t = np.clip((out * edge).sum(axis=1) / (edge * edge).sum(axis=1), 0.0, 1.0)
        near = np.minimum(near, np.linalg.norm(out - t[:, None] * edge, axis=1))
    result = np.full(len(x), np.inf)
    np.minimum.at(result, i, np.where(inside, over, near))
    return result
