"""Scenes that everyone knows, at the size of a handkerchief's corner: does anything penetrate, and what does it cost?

    python benchmarks/contact_scenes.py [--scenes twist needles] [--fabric paper] [--seeds 1]

Of every scene the table has the smallest distance of samples from obstacles and from each other, over what it must stay
above, by formulas of this file; the frames at which it did not; the most energy that a step gained, of all there was,
where nothing drives the cloth; steps that were made in parts; Newton's iterations; wall time. Seeds above 0 start with
every node up to 1 % of the spacing elsewhere. The last frames are drawn side by side.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from common import RESULTS, environment, one_core, print_table, write_csv
from matplotlib import image
from matplotlib.figure import Figure
from plots import PICTURES, save
from scipy.spatial.transform import Rotation

import warp_yarn as wy
from warp_yarn.presets.fabrics import FABRICS

H = 1e-3
UP = np.array([0.0, 0.0, 1.0])
VIEW = (0.5, -1.0, 0.45)


@dataclasses.dataclass(frozen=True)
class Staged:
    """A scene, and how long it is played.

    Args:
        scene: of one cloth or several.
        steps: of 1 ms.
        driven: whether anything moves the cloth, so that it may gain energy.
        view: to the camera.
    """

    scene: wy.Scene
    steps: int
    driven: bool = False
    view: tuple[float, float, float] = VIEW


def sheet(fabric: str, rows: int, columns: int, height: float = 0.0, **options) -> wy.Cloth:
    """A flat cloth, its middle over the origin."""
    cloth = FABRICS[fabric](rows=rows, columns=columns, pose="flat", **options)
    return cloth.replace(pose=cloth.position - cloth.position.mean(axis=0) + height * UP)


def floor(friction: float = 0.3) -> wy.Plane:
    return wy.Plane(point=(0.0, 0.0, 0.0), normal=UP, friction=friction)


def drape(fabric: str, friction: float) -> Staged:
    """Over a sphere on the ground."""
    cloth = sheet(fabric, 17, 17)
    radius = 4.0 * cloth.spacing
    ball = wy.Sphere(center=radius * UP, radius=radius, friction=friction)
    cloth = sheet(fabric, 17, 17, 2.0 * radius + 2.5 * cloth.radius)
    law = wy.Contact(friction=friction)
    return Staged(wy.Scene(cloth, obstacles=[floor(friction), ball], self_contact=True, contact=law), 250)


def corner(fabric: str) -> Staged:
    """Over a cube that stands on one of its corners."""
    cloth = sheet(fabric, 17, 17)
    half = 4.0 * cloth.spacing
    turn = Rotation.align_vectors([UP], [np.ones(3) / np.sqrt(3.0)])[0]
    cube = wy.Box(center=np.sqrt(3.0) * half * UP, half_extents=(half,) * 3, rotation=turn.as_quat())
    cloth = sheet(fabric, 17, 17, 2.0 * np.sqrt(3.0) * half + 2.5 * cloth.radius)
    return Staged(wy.Scene(cloth, obstacles=[floor(), cube], self_contact=True), 250)


def ten(fabric: str) -> Staged:
    """Ten sheets, one above the other."""
    apart = 2.51 * sheet(fabric, 6, 6).spacing
    sheets = [sheet(fabric, 6, 6, 1.0 * apart + k * apart) for k in range(10)]
    return Staged(wy.Scene(sheets, obstacles=[floor()], self_contact=True), 250)


def twist(fabric: str) -> Staged:
    """A strip, one end of which is turned twice, and brought nearer as it shortens."""
    cloth = sheet(fabric, 7, 49)
    steps = 400
    ends = [cloth.node(row, column) for column in (0, 48) for row in range(7)]
    t = np.minimum(np.arange(1, steps + 1) / (0.9 * steps), 1.0)
    path = np.tile(cloth.position[ends], (steps, 1, 1))
    axis = np.array([1.0, 0.0, 0.0])
    for k, s in enumerate(t):
        turned = Rotation.from_rotvec(4.0 * np.pi * s * axis).apply(cloth.position[ends[7:]])
        path[k, 7:] = turned - axis * (17.0 * cloth.spacing * s**2)
    scene = wy.Scene(cloth, pins=ends, pin_path=path, self_contact=True, gravity=None)
    return Staged(scene, steps, driven=True)


def needles(fabric: str) -> Staged:
    """On five times five needles, thinner than its mesh: middles touch as well."""
    cloth = sheet(fabric, 17, 17)
    mesh = cloth.spacing
    law = wy.Contact(samples="nodes+mids", distance=0.3 * mesh, range=0.3 * mesh)
    foot = [(3.3 * mesh * i, 3.3 * mesh * j, 0.0) for i in range(-2, 3) for j in range(-2, 3)]
    bed = [wy.Capsule(start=p, end=p + 4.0 * mesh * UP, radius=0.15 * mesh, friction=0.3) for p in map(np.array, foot)]
    cloth = sheet(fabric, 17, 17, 5.0 * mesh)
    return Staged(wy.Scene(cloth, obstacles=[floor(), *bed], self_contact=True, contact=law), 150)


def funnel(fabric: str) -> Staged:
    """Pulled through a funnel by its middle."""
    cloth = sheet(fabric, 13, 13)
    mesh, sides = cloth.spacing, 32
    angle = 2.0 * np.pi * np.arange(sides) / sides
    ring = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    wide, narrow = 10.0 * mesh * ring, 3.2 * mesh * ring - 9.0 * mesh * UP
    neck = 3.2 * mesh * ring - 16.0 * mesh * UP
    vertices, k = np.concatenate([wide, narrow, neck]), np.arange(sides)
    after = (k + 1) % sides
    faces = []
    for level in (0, sides):
        faces += [*zip(level + k, level + after, level + sides + after, strict=True)]
        faces += [*zip(level + k, level + sides + after, level + sides + k, strict=True)]
    cone = wy.TriangleMesh(vertices, faces, friction=0.1)
    cloth = sheet(fabric, 13, 13, 0.0)
    cloth = cloth.replace(pose=cloth.position + 0.5 * mesh * UP)
    middle = [cloth.node(6, 6)]
    steps = 130
    path = cloth.position[middle] - 20.0 * mesh * np.linspace(1.0 / steps, 1.0, steps)[:, None, None] * UP
    # a wall without thickness shows what reaches beyond a node: a yarn that lies on top of another
    contact = wy.Contact(distance=2.0 * cloth.radius)
    scene = wy.Scene(cloth, obstacles=[cone], pins=middle, pin_path=path, self_contact=True, contact=contact)
    return Staged(scene, steps, driven=True, view=(0.5, -1.0, 0.9))


def rollers(fabric: str) -> Staged:
    """Drawn in between two rollers."""
    cloth = sheet(fabric, 25, 9)
    mesh, r = cloth.spacing, cloth.radius
    radius, steps = 5.0 * mesh, 60
    t = H * np.arange(1, steps + 1)
    upright = np.stack([0.0 * cloth.position[:, 1], cloth.position[:, 0], cloth.position[:, 1]], axis=1)
    cloth = cloth.replace(pose=upright + (10.0 * mesh) * UP)
    rolls = []
    for side in (-1.0, 1.0):
        at, half = np.array([side * (radius + 1.45 * r), 0.0, 0.0]), 7.0 * mesh * np.array([0.0, 1.0, 0.0])
        turns = Rotation.from_rotvec(side * -40.0 * t[:, None] * [0.0, 1.0, 0.0])
        roll = wy.Cylinder(start=at - half, end=at + half, radius=radius, friction=0.5)
        path = np.hstack([np.tile(at, (steps, 1)), (turns * Rotation.from_quat(roll.rotation)).as_quat()])
        rolls.append(roll.replace(path=path))
    return Staged(wy.Scene(cloth, obstacles=rolls, self_contact=True), steps, driven=True)


def pulled(fabric: str, acceleration: float, speed: float, steps: int) -> Staged:
    """A table cloth from under another cloth, by its edge."""
    cloth = sheet(fabric, 17, 17)
    mesh = cloth.spacing
    lower = sheet(fabric, 17, 17, 2.0 * cloth.radius * (1.0 + 1e-6))
    upper = sheet(fabric, 9, 9, 2.0 * cloth.radius + 2.5 * mesh)
    t, until = H * np.arange(1, steps + 1), speed / acceleration
    moved = np.where(t < until, 0.5 * acceleration * t**2, speed * (t - 0.5 * until))
    pins = [lower.node(16, column) for column in range(17)]
    path = lower.position[pins] + moved[:, None, None] * [0.0, 1.0, 0.0]
    scene = wy.Scene([lower, upper], obstacles=[floor()], pins=pins, pin_path=path, self_contact=True)
    return Staged(scene, steps, driven=True)


SCENES: dict[str, Callable[[str], Staged]] = {
    "drape, μ = 0": lambda fabric: drape(fabric, 0.0),
    "drape, μ = 0.4": lambda fabric: drape(fabric, 0.4),
    "corner": corner,
    "ten sheets": ten,
    "twist": twist,
    "needles": needles,
    "funnel": funnel,
    "rollers": rollers,
    "pulled fast": lambda fabric: pulled(fabric, 20.0, 1.0, 60),
    "pulled slowly": lambda fabric: pulled(fabric, 1.0, 0.05, 200),
}


# -- how near ---------------------------------------------------------------------------------------------------------


class Gaps:
    """Distances of samples, by formulas of their own."""

    def __init__(self, scene: wy.Scene):
        self.scene, cloth, law = scene, scene.cloth, scene.contact
        self.distance = law.distance or cloth.radius
        self.self_distance = law.self_distance or max(1.5 * cloth.spacing, 3.0 * cloth.radius)
        ends = cloth.topology.segment_nodes if law.samples == "nodes+mids" else np.zeros((0, 2), dtype=int)
        self._first, self._second = (np.concatenate([np.arange(cloth.nodes), ends[:, k]]) for k in range(2))
        rest = self.samples(cloth.rest_place)
        far = 0.5 * np.pi * (self.self_distance + (law.self_range or cloth.spacing))
        squares = (rest**2).sum(axis=1)
        self._far = np.triu(squares[:, None] + squares - 2.0 * rest @ rest.T >= far**2)

    def samples(self, values: np.ndarray) -> np.ndarray:
        return 0.5 * (values[self._first] + values[self._second])

    def of(self, position: np.ndarray, step: int) -> tuple[float, float]:
        """The smallest distances over what they must be above, of obstacles and of pairs."""
        x = self.samples(position)
        to_obstacle = min((self._to(obstacle, x, step) for obstacle in self.scene.obstacles), default=np.inf)
        squares = (x**2).sum(axis=1)
        apart = squares[:, None] + squares - 2.0 * x @ x.T
        p, q = np.unravel_index(np.where(self._far, apart, np.inf).argmin(), apart.shape)
        return to_obstacle / self.distance, float(np.linalg.norm(x[p] - x[q])) / self.self_distance

    def _to(self, obstacle: wy.Obstacle, x: np.ndarray, step: int) -> float:
        position, rotation = obstacle.position, obstacle.rotation
        if obstacle.path is not None and step > 0:
            row = obstacle.path[min(step, len(obstacle.path)) - 1]
            position, rotation = row[:3], row[3:]
        local = Rotation.from_quat(rotation).inv().apply(x - position)
        if isinstance(obstacle, wy.TriangleMesh):
            return to_triangles(local, obstacle.vertices[obstacle.faces])
        a, b, _ = obstacle.size
        norm = np.linalg.norm
        along = np.clip(local[:, 2:], -a, a) * UP
        flat = np.stack([norm(local[:, :2], axis=1) - b, np.abs(local[:, 2]) - a], axis=1)
        block = np.abs(local) - obstacle.size
        found = {
            "plane": local[:, 2],
            "sphere": norm(local, axis=1) - a,
            "capsule": norm(local - along, axis=1) - b,
            "cylinder": norm(np.maximum(flat, 0.0), axis=1) + np.minimum(flat.max(axis=1), 0.0),
            "box": norm(np.maximum(block, 0.0), axis=1) + np.minimum(block.max(axis=1), 0.0),
        }[obstacle.shape]
        return float(found.min())


def to_triangles(x: np.ndarray, corners: np.ndarray) -> float:
    """The smallest distance of places [places, 3] from triangles [triangles, 3, 3] (m)."""
    a, b, c = corners.swapaxes(0, 1)
    p, best = x[:, None], np.inf
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    inside = np.ones((len(x), len(corners)), dtype=bool)
    for start, end in ((a, b), (b, c), (c, a)):
        edge, out = end - start, p - start
        inside &= (np.cross(edge, out) * normal).sum(axis=2) >= 0.0
        t = np.clip((out * edge).sum(axis=2) / (edge**2).sum(axis=1), 0.0, 1.0)
        best = min(best, float(np.linalg.norm(out - t[..., None] * edge, axis=2).min()))
    over = np.abs(((p - a) * normal).sum(axis=2))
    return min(best, float(np.where(inside, over, np.inf).min()))


# -- runs -------------------------------------------------------------------------------------------------------------


def play(name: str, fabric: str, seed: int) -> tuple[dict[str, object], wy.Trajectory]:
    """Plays a scene; where a step cannot be made the row says so, and there are the frames before it."""
    staged = SCENES[name](fabric)
    scene = staged.scene
    simulator = wy.Simulator(scene, step=H, integrator="implicit-euler", chunk=1)
    if seed:
        state, random = simulator.state, np.random.default_rng(seed)
        state.position[:] += 0.01 * scene.cloth.spacing * random.uniform(-1.0, 1.0, state.position.shape)
        simulator.state = state
    gaps, near, iterations, energies, failed = Gaps(scene), [], [], [], ""
    seconds, last = 0.0, simulator.chunk_trajectory(1)
    for step in range(staged.steps + 1):
        near.append(gaps.of(simulator.state.position, step))
        if not staged.driven:
            energies.append(sum(simulator.energy().values()))
        if step < staged.steps:
            begin = time.perf_counter()
            try:
                last = simulator.run(1)
            except wy.SimulationError as error:
                failed = str(error).partition(":")[0]
                break
            seconds += time.perf_counter() - begin
            iterations.append(simulator.integrator.iterations)
    # loading kernels, and the first step's graph, are in it
    least, violations = np.min(near, axis=0), int((np.min(near, axis=1) <= 1.0).sum())
    scale = max(map(abs, energies), default=1.0)
    speed = np.linalg.norm(simulator.state.velocity, axis=1).max()
    row = {
        "scene": name,
        "seed": seed,
        "samples": len(gaps.samples(scene.cloth.position)),
        "steps": len(iterations),
        "gap [D]": float(least[0]),
        "apart [D]": float(least[1]),
        "violations": violations,
        "gained [1e-6]": 1e6 * max(0.0, float(np.diff(energies).max())) / scale if energies else np.nan,
        "in parts": len(simulator.split_steps),
        "iterations": float(np.mean(iterations)),
        "most": int(max(iterations)),
        "last speed [mm/s]": 1e3 * float(speed),
        "ms a step": 1e3 * seconds / len(iterations),
        "failed": failed or "no",
    }
    # the last step, which knows how far obstacles have moved
    return row, last


def montage(pictures: dict[str, Path], path: Path) -> None:
    """Draws the last frames side by side."""
    columns = 4
    rows = -(-len(pictures) // columns)
    figure = Figure(figsize=(3.2 * columns, 2.6 * rows), layout="constrained")
    for k, (name, file) in enumerate(pictures.items()):
        axes = figure.add_subplot(rows, columns, k + 1)
        axes.imshow(image.imread(file))
        axes.set_title(name, fontsize=9)
        axes.set_axis_off()
    save(figure, path)


def main(arguments: Sequence[str] | None = None) -> list[dict[str, object]]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES), metavar="NAME", help="(all)")
    parser.add_argument("--fabric", choices=FABRICS, default="paper", help="(%(default)s)")
    parser.add_argument("--seeds", type=int, default=1, help="starts of each scene (%(default)s)")
    parser.add_argument("--csv", type=Path, default=RESULTS / "contact_scenes.csv", help="(%(default)s)")
    parser.add_argument("--png", type=Path, default=PICTURES / "contact_scenes.png", help="(%(default)s)")
    options = parser.parse_args(arguments)
    one_core()
    rows: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory() as folder:
        pictures = {}
        for k, name in enumerate(options.scenes):
            for seed in range(options.seeds):
                row, trajectory = play(name, options.fabric, seed)
                rows.append(row)
                print_table(rows[-1:])
                if seed == 0:
                    pictures[name] = Path(folder) / f"{k}.png"
                    view = SCENES[name](options.fabric).view
                    wy.write_png(pictures[name], trajectory, size=(800, 640), view=view)
        montage(pictures, options.png)
    print_table(rows)
    write_csv(options.csv, rows, {"fabric": options.fabric, **environment()})
    return rows


if __name__ == "__main__":
    main()
