"""Motions that touch: nothing penetrates at any step and stage, energy does not rise, friction is Coulomb's."""

import functools
import itertools

import numpy as np
import pytest
from cases import quick
from internals import (
    look_after_stages,
    near_faces,
    near_obstacles,
    numbers,
    obstacles_begin_a_step,
    power_of_obstacles,
)
from scipy.spatial.transform import Rotation
from touching import GROUND, folded, gaps_of_pairs, lifted, paper, posed

import warp_yarn as wy

METHODS = ("implicit-euler", "sdirk2")
ACROSS, UP = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])


class Watch:
    """Looks at every stage of a simulator's steps, wherever Newton's iteration has ended in it.

    Attributes:
        least: the smallest part of D that a gap was above it, of obstacles and of pairs.
    """

    def __init__(self, simulator: wy.Simulator):
        self.simulator, self.least, self.touched = simulator, np.inf, 0
        self.distances = [
            float(numbers(simulator, f"{kind}_distance")[0]) if f"{kind}_distance" in simulator.arrays else np.nan
            for kind in ("contact", "self_contact")
        ]

    def look(self, touches: bool = False) -> None:
        self.touched += touches
        if self.simulator.scene.obstacles:
            self._add(near_obstacles(self.simulator).gap, self.distances[0])
        if any(obstacle.shape == "mesh" for obstacle in self.simulator.scene.obstacles):
            self._add(near_faces(self.simulator).gap, self.distances[0])
        if self.simulator.scene.self_contact:
            position = numbers(self.simulator, "position")
            self._add(gaps_of_pairs(self.simulator.scene.cloth, self.simulator, position), self.distances[1])

    def _add(self, gap: np.ndarray, distance: float) -> None:
        self.least = min(self.least, float(gap.min(initial=np.inf)) / distance - 1.0)


def crumpling(seed: int) -> tuple[wy.Scene, np.ndarray]:
    """A sheet that stands on its edge and falls in on itself."""
    cloth = paper(17, 7, pose="upright")
    random = np.random.default_rng(seed)
    position = cloth.position + UP * 1.5e-3
    position[:, 1] += 1e-4 * np.sin(400.0 * position[:, 2] + random.uniform(0.0, 6.0))
    cloth = cloth.replace(pose=position + 1e-5 * random.standard_normal(position.shape))
    return wy.Scene(cloth, obstacles=[GROUND], self_contact=True), np.array([0.0, 0.0, -1.0])


def dropping(seed: int) -> tuple[wy.Scene, np.ndarray]:
    """A sheet that is thrown at a ball, a box and a mesh that lie on the ground."""
    cloth = lifted(paper(9, 9), 3.2e-3, 1e-4, seed)
    corners = np.array([(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    faces = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6), (0, 2, 6),
             (0, 6, 4), (1, 5, 7), (1, 7, 3)]  # fmt: skip
    obstacles = [
        GROUND,
        wy.Sphere(center=(6e-3, 6e-3, 1e-3), radius=1.2e-3),
        wy.Box(center=(1.5e-3, 2e-3, 0.5e-3), half_extents=(1.1e-3, 1.2e-3, 1e-3), rotation=(0.0, 0.0, 0.6, 0.8)),
        wy.TriangleMesh(1.3e-3 * corners, faces, position=(6e-3, 1.5e-3, 1e-3), rotation=(0.0, 0.6, 0.0, 0.8)),
        wy.Capsule(start=(0.0, 6e-3, 0.4e-3), end=(3e-3, 7e-3, 0.4e-3), radius=8e-4),
        wy.Cylinder(start=(4e-3, 4e-3, 0.0), end=(4e-3, 4e-3, 2e-3), radius=6e-4),
    ]
    return wy.Scene(cloth, obstacles=obstacles, self_contact=True), np.array([0.3, 0.0, -1.0])


def folding(seed: int) -> tuple[wy.Scene, np.ndarray]:
    """A folded strip that closes."""
    return wy.Scene(folded(seed=seed), obstacles=[GROUND], self_contact=True), np.zeros(3)


def driven(seed: int) -> tuple[wy.Scene, np.ndarray]:
    """A hung sheet that a ball is driven through, at 3 m/s."""
    cloth = lifted(paper(9, 9, pose="upright"), 0.0, 3e-5, seed)
    start, t = cloth.position.mean(axis=0) - 6e-3 * ACROSS, 1e-3 * np.arange(1, 13)[:, None]
    ball = wy.Sphere(center=start, radius=3e-3, path=start + 3.0 * t * ACROSS)
    return wy.Scene(cloth, pins=cloth.corners("top"), obstacles=[ball], self_contact=True), np.zeros(3)


def turning(seed: int) -> tuple[wy.Scene, np.ndarray]:
    """A hung sheet that a plate turns into, an eighth of a turn in 13 steps."""
    cloth = lifted(paper(9, 9, pose="upright"), 0.0, 3e-5, seed)
    at, t = cloth.position.mean(axis=0) + 4e-3 * ACROSS, 1e-3 * np.arange(1, 26)[:, None]
    turns = Rotation.from_rotvec(60.0 * t * np.array([1.0, 0.2, 0.0])).as_quat()
    path = np.hstack([np.tile(at, (len(t), 1)), turns])
    plate = wy.Box(center=at, half_extents=(3e-3, 5e-4, 4e-3), path=path)
    return wy.Scene(cloth, pins=cloth.corners("top"), obstacles=[plate], self_contact=True), np.zeros(3)


def stacking(seed: int) -> tuple[wy.Scene, np.ndarray]:
    """Two sheets that fall onto the ground, the upper one faster."""
    cloths = [lifted(paper(6, 6), 1.3e-3, 3e-5, seed), lifted(paper(5, 5), 4e-3, 3e-5, seed + 50)]
    return wy.Scene(cloths, obstacles=[GROUND], self_contact=True), np.array([0.1, 0.0, -0.5])


MOTIONS = {"crumple": (crumpling, 60), "drop": (dropping, 25), "fold": (folding, 60), "drive": (driven, 12),
    "turn": (turning, 25),
           "stack": (stacking, 40)}  # fmt: skip
RUNS = list(itertools.product(MOTIONS, METHODS, range(10)))
FIRST = [(name, METHODS[k % 2], 0) for k, name in enumerate(MOTIONS) if name not in ("crumple", "turn")]


@pytest.mark.parametrize("run", quick(RUNS, *FIRST), ids=lambda run: "-".join(map(str, run)))
def test_nothing_penetrates(run: tuple[str, str, int], monkeypatch: pytest.MonkeyPatch) -> None:
    name, method, seed = run
    make, steps = MOTIONS[name]
    scene, velocity = make(seed)
    simulator = wy.Simulator(scene, integrator=method)
    state = simulator.state
    state.velocity[:] += velocity
    simulator.state = state
    watch = Watch(simulator)
    if seed == 0:
        look_after_stages(simulator, watch.look, monkeypatch)
    for _ in range(steps):
        simulator.run(1)
        watch.look()
    assert seed or watch.touched > 5
    assert watch.least > 0.0


# -- what cannot be ----------------------------------------------------------------------------------------------------


def test_an_overlapping_start_is_refused() -> None:
    cloth = lifted(paper(5, 5), 4e-4)
    with pytest.raises(wy.InputError, match=r"node \d+ \(row \d, column \d\) is 0.0004 m from obstacles\[0\], a Plane"):
        wy.Simulator(wy.Scene(cloth, obstacles=[GROUND]), integrator="implicit-euler")
    cloths = [paper(5, 5), lifted(paper(5, 5), 1.2e-3)]
    with pytest.raises(wy.InputError, match=r"\(cloth 0, row .* is 0.0012 m from node \d+ \(cloth 1, row .* 0.0015 m"):
        wy.Simulator(wy.Scene(cloths, self_contact=True), integrator="implicit-euler")
    simulator = wy.Simulator(wy.Scene(lifted(paper(5, 5), 2e-3), obstacles=[GROUND]), integrator="sdirk2")
    state = simulator.state
    state.position[7, 2] = -1e-3
    with pytest.raises(wy.InputError, match=r"node 7 \(row 1, column 2\) is -0.001 m from obstacles\[0\]"):
        simulator.state = state
    assert simulator.run(2).position.shape[0] == 3


@pytest.mark.parametrize("down", [1e-4, 4e-3])
def test_what_is_held_is_not_led_into_an_obstacle(down: float) -> None:
    """In small steps, or in one to the other side of it."""
    cloth = lifted(paper(5, 5), 3e-3)
    rod = wy.Capsule(start=(-1e-2, 0.0, 0.0), end=(2e-2, 0.0, 0.0), radius=2e-4)
    pins, steps = [0, 4], int(8e-3 / down)
    path = cloth.position[pins] - down * np.arange(1, steps + 1)[:, None, None] * (0.0, 0.0, 1.0)
    scene = wy.Scene(cloth, gravity=None, pins=pins, pin_stiffness=None, pin_path=path, obstacles=[rod])
    simulator = wy.Simulator(scene, integrator="implicit-euler")
    with pytest.raises(wy.SimulationError, match=r"at node 0 \(row 0, column 0\).* m from obstacles\[0\], a Capsule"):
        simulator.run(steps)


@pytest.mark.parametrize("down", [1e-4, 4e-3])
def test_what_is_held_is_not_led_into_cloth(down: float) -> None:
    """A sheet whose border is held, and another one, held everywhere, that is pressed onto it or sent through it."""
    below, above = paper(7, 7), lifted(paper(5, 5), 4e-3)
    above = above.replace(pose=above.position + 1e-3 * (1.0 - UP))
    row, column = np.divmod(np.arange(49), 7)
    edge = np.flatnonzero((row % 6 == 0) | (column % 6 == 0))
    pins, steps = [*edge, *range(49, 74)], int(12e-3 / down)
    both = np.concatenate([below.position, above.position])
    path = np.tile(both[pins], (steps, 1, 1))
    path[:, len(edge) :, 2] -= down * np.arange(1, steps + 1)[:, None]
    scene = wy.Scene([below, above], gravity=None, pins=pins, pin_stiffness=None, pin_path=path, self_contact=True)
    simulator = wy.Simulator(scene, integrator="implicit-euler")
    match = r"at node \d+ \(cloth \d, row "
    if down < 1e-3:
        match += r".*is 0.001\d+ m from node \d+ \(cloth \d, row"
    with pytest.raises(wy.SimulationError, match=match) as error:
        simulator.run(steps)
    least = [gaps_of_pairs(scene.cloth, simulator, x).min() for x in error.value.trajectory.position]
    assert min(least) > 1.5e-3


# -- energy ------------------------------------------------------------------------------------------------------------


@functools.cache
def fabric(name: str) -> wy.Cloth:
    return paper(7, 7) if name == "paper" else getattr(wy.fabrics, name)(rows=7, columns=7)


RISES = {"implicit-euler": 1e-6, "sdirk2": 1e-3}
"""Of the energy, in a step."""
DROPS = list(itertools.product(("paper", "handkerchief", "cotton"), (0.05, 0.3, 1.0, 3.0), (1e-3, 2.5e-4), METHODS))


@pytest.mark.parametrize(
    "drop",
    quick(DROPS, *[("paper", v, 1e-3, m) for v in (0.05, 1.0) for m in METHODS]),
    ids=lambda d: "-".join(map(str, d)),
)
def test_energy_does_not_rise(drop: tuple[str, float, float, str]) -> None:
    """Of a tilted sheet that strikes a plane, and itself, where nothing does work on it."""
    name, speed, step, method = drop
    cloth = fabric(name)
    flat = np.hstack([cloth.euler, np.zeros((cloth.nodes, 1))]) @ Rotation.from_rotvec((0.0, 0.3, 0.0)).as_matrix().T
    flat[:, 2] += 2.05 * cloth.radius - flat[:, 2].min()
    scene = wy.Scene(cloth.replace(pose=flat), gravity=None, obstacles=[GROUND], self_contact=True)
    simulator = wy.Simulator(scene, integrator=method, step=step)
    state = simulator.state
    state.velocity[:, 2] = -speed
    simulator.state = state
    energy = [sum(simulator.energy().values())]
    for _ in range(40):
        simulator.run(1)
        energy.append(sum(simulator.energy().values()))
    assert simulator.state.position[:, 2].min() > cloth.radius
    assert min(energy) < 0.99 * energy[0]
    assert np.diff(energy).max() < RISES[method] * energy[0]


# -- friction ----------------------------------------------------------------------------------------------------------

MU, SLIP = 0.5, 1e-3
G = 9.8


def on_slope(ratio: float, **options) -> wy.Simulator:
    """A sheet at rest on a plane, gravity turned instead, tan θ = ratio · μ."""
    angle = np.arctan(ratio * MU)
    gravity = (G * np.sin(angle), 0.0, -G * np.cos(angle))
    cloth = lifted(paper(5, 5), 1e-3 * 0.95)
    ground = wy.Plane(point=(0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0), friction=MU)
    # damped, so that it soon does not bounce
    scene = wy.Scene(cloth, gravity=gravity, obstacles=[ground], contact=wy.Contact(damping_speed=0.05))
    return wy.Simulator(scene, **options)


@pytest.mark.parametrize(
    ("options", "within"), [({"newton_tolerance": 1e-6}, 0.01), ({}, 0.05)], ids=["tight", "default"]
)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("ratio", [0.5, pytest.param(0.9, marks=pytest.mark.slow)])
def test_what_sticks_creeps(ratio: float, method: str, options: dict, within: float) -> None:
    simulator = on_slope(ratio, integrator=method, **options)
    simulator.run(150)
    speed = simulator.state.velocity[:, 0]
    assert speed.mean() == pytest.approx(SLIP * (1.0 - np.sqrt(1.0 - ratio)), rel=within)


@pytest.mark.parametrize(
    ("options", "within"), [({"newton_tolerance": 1e-6}, 0.01), ({}, 0.05)], ids=["tight", "default"]
)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("ratio", [1.5, pytest.param(1.1, marks=pytest.mark.slow)])
def test_what_slides_follows_coulomb(ratio: float, method: str, options: dict, within: float) -> None:
    simulator = on_slope(ratio, integrator=method, **options)
    simulator.run(100)
    before = simulator.state.velocity[:, 0].mean()
    simulator.run(40)
    gained = simulator.state.velocity[:, 0].mean() - before
    angle = np.arctan(ratio * MU)
    assert gained / 40e-3 == pytest.approx(G * (np.sin(angle) - MU * np.cos(angle)), rel=within)


def test_rest_heights() -> None:
    """A sheet lies on a plane within its range, and another one on it; both come to rest."""
    scene, _ = stacking(0)
    simulator = wy.Simulator(scene.replace(contact=wy.Contact(damping_speed=0.05)), integrator="implicit-euler")
    simulator.run(150)
    state, below = simulator.state, scene.cloth.nodes_of(0)
    assert np.abs(state.velocity).max() < 1e-3
    lower, upper = state.position[below, 2], np.delete(state.position[:, 2], below)
    # nodes of the plain weave lie in one plane: R + 0.9 d̂ of light cloth on obstacles; layers 2–2.5 spacings apart
    assert lower.min() > 0.8e-3 and lower.max() < 1.05e-3
    near = np.linalg.norm(state.position[None, below] - state.position[36:, None], axis=2).min(axis=1)
    assert (near > 1.5e-3).all() and np.median(near) < 2.5e-3
    assert 1.2e-3 < np.median(upper) - np.median(lower) < 2.5e-3


# -- moving obstacles --------------------------------------------------------------------------------------------------


def test_velocity_of_an_obstacle_is_the_difference_of_its_pose() -> None:
    """Of a plate that turns and flies: what it carries along without slip has it. Power is force times velocity."""
    cloth = lifted(paper(4, 4), 0.9e-3)
    speed, spin = np.array([0.02, 0.01, 0.0]), np.array([0.0, 0.0, 8.0])
    t = 1e-3 * np.arange(1, 41)[:, None]
    path = np.hstack([t * speed, Rotation.from_rotvec(t * spin).as_quat()])
    plate = wy.Box(
        center=(0.0, 0.0, -1e-2), half_extents=(1e-1, 1e-1, 1e-2), friction=1.0, path=path - (0, 0, 1e-2, 0, 0, 0, 0)
    )
    contact = wy.Contact(slip_speed=1e-4)
    simulator = wy.Simulator(wy.Scene(cloth, obstacles=[plate], contact=contact), integrator="implicit-euler")
    state = simulator.state
    state.velocity[:] = speed + np.cross(spin, state.position)
    simulator.state = state
    simulator.run(30)
    obstacles_begin_a_step(simulator)
    position, spinning = numbers(simulator, "obstacle_position")[0], numbers(simulator, "obstacle_spin")[0]
    assert spinning == pytest.approx(spin, abs=1e-9)
    assert numbers(simulator, "obstacle_velocity")[0] == pytest.approx(speed, abs=1e-12)
    state = simulator.state
    carried = speed + np.cross(spin, state.position - position)
    assert np.abs(state.velocity - carried)[:, :2].max() < 5e-4
    # which puts it where the last step left it
    found = simulator.contacts()
    force = found.load[:, None] * found.normal + found.tangential
    place = numbers(simulator, "obstacle_position")[0]
    expected = (force * (speed + np.cross(spin, state.position - place))[found.node]).sum()
    assert power_of_obstacles(simulator) == pytest.approx(expected, rel=1e-9, abs=1e-18)


def test_nothing_of_contact_without_contact() -> None:
    """Arrays of contact are those alone that every kernel takes, and none has as many numbers as there are nodes."""
    simulator = wy.Simulator(wy.Scene(paper(5, 5)))
    words = ("obstacle", "near", "touch", "contact_s", "mesh", "face")
    kept = {name for name, a in simulator.arrays.items() if a is not None and any(word in name for word in words)}
    assert kept <= {"touching", "near_room", "touch_room", "face_room"}


def test_a_state_that_touches_is_reported() -> None:
    cloth = paper(4, 4)
    simulator = wy.Simulator(wy.Scene(lifted(cloth, 2e-3), obstacles=[GROUND], self_contact=True))
    position = cloth.position + 3e-3 * UP
    position[5, 2] = 7e-4
    velocity = np.zeros_like(position)
    velocity[5, 0] = 1.0
    found = simulator.contacts(posed(cloth, position, velocity))
    assert (len(found), found.node[0], found.other[0], found.obstacle[0]) == (1, 5, -1, 0)
    assert found.gap[0] == pytest.approx(7e-4, rel=1e-12) and found.normal[0] == pytest.approx((0.0, 0.0, 1.0))
    assert found.tangential[0] == pytest.approx((-0.3 * found.load[0], 0.0, 0.0))
    assert found.place[0] == pytest.approx((*position[5, :2], 0.0), abs=1e-15)
    assert simulator.state == wy.Simulator(simulator.scene).state
