"""Free fall, throws, spins and moving frames, by every integrator with its default tolerances.

A cloth that is free moves with its centre as a thrown point does, and its own motion is the same for one who moves or
is turned. Every method here makes constant acceleration without error in velocities, so that all that may be left is
what its tolerances leave: of the paper's cloth, and of light and stiff ones, which hold a solver by what a rigid motion
does not feel.
"""

import dataclasses
import functools

import numpy as np
import pytest

import warp_yarn as wy
from warp_yarn.integrators import INTEGRATORS
from warp_yarn.presets import fabrics

METHODS = tuple(INTEGRATORS)
G = 9.8
DIRECTIONS = ((0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (2.0 / 3.0, -2.0 / 3.0, 1.0 / 3.0))
STEPS, STEP = 12, 2e-3
ORDER = {"linear": 1, "implicit-euler": 1, "sdirk2": 2, "implicit-midpoint": 2, "ros2": 2, "esdirk3": 3}
norm = np.linalg.norm


def uneven(rows: int, columns: int, **options: object) -> wy.Cloth:
    """A handkerchief of uneven sett, thick and thin yarns and crimp."""
    thin = fabrics.handkerchief().yarns[0]
    thick = dataclasses.replace(thin, density=2.0 * thin.density, width=9e-4, thickness=4e-4)
    gaps = [1e-3 * (1.0 + np.random.default_rng(k).uniform(0.0, 1.5, n - 1)) for k, n in enumerate((rows, columns))]
    numbers = {"yarns": [thin, thick], "spacing": tuple(gaps), "crimp": (0.05, 0.1)}
    return fabrics.handkerchief(rows, columns, **numbers, **options)


CLOTHS = {**fabrics.STUDIED, "uneven": uneven}


@functools.cache
def flat(fabric: str, size: int) -> wy.Cloth:
    return CLOTHS[fabric](rows=size, columns=size, pose="flat")


def turning(axis, angle: float) -> np.ndarray:
    """Rotation about an axis."""
    x, y, z = np.asarray(axis) / norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def run(scene: wy.Scene, method: str, steps: int = STEPS, *, velocity=None, step: float = STEP, **options):
    """Frames of a scene at default settings; ``velocity`` of x: of every node at the start."""
    simulator = wy.Simulator(scene, step=step, integrator=method, **options)
    start = simulator.state
    if velocity is not None:
        start.velocity[:] = velocity(start.position)
        simulator.state = start
    return simulator.run(steps)


def falls_by(method: str, t: float, h: float) -> float:
    """How far a method says that a body has fallen: one of order 1 uses the velocity at the end of a step."""
    return 0.5 * G * (t * t + (t * h if ORDER[method] == 1 else 0.0))


def check_fall(trajectory: wy.Trajectory, method: str, direction, velocity) -> None:
    h, t = trajectory.step, trajectory.time[-1]
    gained = trajectory.velocity[-1] - velocity
    expected = G * t * np.asarray(direction)
    assert norm(gained - expected, axis=1).max() < 1e-4 * G * t
    moved = trajectory.position[-1] - trajectory.position[0] - t * np.asarray(velocity)
    expected = falls_by(method, t, h) * np.asarray(direction)
    # the tolerance of the velocities, for as long; and the rounding of positions near 1 m
    assert norm(moved - expected, axis=1).max() < 1e-4 * G * t * t + 1e-12


@pytest.mark.parametrize("fabric", CLOTHS)
@pytest.mark.parametrize("method", METHODS)
def test_a_free_cloth_falls_as_a_stone(method, fabric):
    for k, direction in enumerate(DIRECTIONS):
        scene = wy.Scene(flat(fabric, 5), gravity=G * np.array(direction), sliding=bool(k % 2))
        check_fall(run(scene, method), method, direction, 0.0)


@pytest.mark.parametrize("fabric", CLOTHS)
@pytest.mark.parametrize("method", METHODS)
def test_a_thrown_cloth_feels_gravity(method, fabric):
    velocity = 5.0 * turning((1.0, 2.0, 3.0), 1.0)[0]
    scene = wy.Scene(flat(fabric, 9 if method == "sdirk2" else 5))
    check_fall(run(scene, method, velocity=lambda x: velocity), method, (0.0, 0.0, -1.0), velocity)


SPIN = np.array([0.0, 0.0, 15.0])
"""About the cloth's normal, which stays [rad/s]; a third of a radian in all."""
LINEAR = ("linear", "ros2")
"""Methods that take a step's forces along a straight line: they stretch a turning yarn by (h SPIN)²/2 = 5e-4, and stiff
ones lose all of a spin by that."""


def spinning(x):
    return np.cross(SPIN, x - x.mean(axis=0)) + np.array([1.0, -2.0, 0.5])


def weights(cloth: wy.Cloth) -> np.ndarray:
    """Mass of every node over the cloth's [nodes, 1]: half of each segment's."""
    mass = np.zeros(cloth.nodes)
    topology = cloth.topology
    density = np.array([cloth.yarns[k].density for k in cloth.material])[topology.segment_yarn]
    lengths = cloth.segment_spacing * (1.0 + cloth.yarn_crimp[topology.segment_yarn])
    for end in topology.segment_nodes.T:
        np.add.at(mass, end, density * lengths)
    return (mass / mass.sum())[:, None]


@pytest.mark.parametrize("fabric", CLOTHS)
@pytest.mark.parametrize("method", METHODS)
def test_a_spinning_cloth_falls_as_a_stone_and_spins_on(method, fabric):
    cloth = flat(fabric, 5)
    trajectory = run(wy.Scene(cloth, sliding=False), method, velocity=spinning)
    w, t, h = weights(cloth), trajectory.time, trajectory.step
    centre = (w * trajectory.position).sum(axis=1)
    velocity = (w * trajectory.velocity).sum(axis=1)
    fall = np.array([0.0, 0.0, -G]) * t[:, None]
    # linear momentum is kept by every method, to the tolerance of the change of velocity: in a step 9.8 h by gravity,
    # and less by what keeps a spinning cloth together, SPIN² r h
    assert norm(velocity - velocity[0] - fall, axis=1).max() < 1e-4 * G * t[-1]
    far = centre - centre[0] - t[:, None] * velocity[0] - 0.5 * fall * t[:, None]
    # of order 1: a step's fall is that of its end velocity, or of those of its parts
    beyond = 0.5 * G * t * h * (ORDER[method] == 1)
    np.testing.assert_allclose(far[:, :2], 0.0, rtol=0.0, atol=1e-4 * G * t[-1] ** 2)
    assert (far[:, 2] < 1e-4 * G * t[-1] ** 2).all()
    assert (far[:, 2] > -beyond - 1e-4 * G * t[-1] ** 2).all()
    if method in LINEAR:
        return
    arm, moving = trajectory.position - centre[:, None], trajectory.velocity - velocity[:, None]
    spin = np.cross(arm, w * moving).sum(axis=1)
    # a step turns by h SPIN = 0.03: what a method may lose of a spin in each
    angle = h * norm(SPIN)
    # (the first slope of esdirk3, of stiff yarns that turn, is of second order alone)
    assert norm(spin[-1] - spin[0]) < len(t) * angle ** min(2, ORDER[method]) * norm(spin[0])
    # and it did turn: a diagonal by about as much as a stiff body does
    edge = trajectory.position[:, -1] - trajectory.position[:, 0]
    turned = turning(SPIN, norm(SPIN) * t[-1]) @ edge[0]
    assert norm(edge[-1] - turned) < (0.1 if ORDER[method] == 1 else 0.01) * norm(edge[0])


# -- frames -----------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Frame:
    """Someone who is turned, moves at a velocity, and has their origin somewhere."""

    turn: np.ndarray
    velocity: np.ndarray

    def scene(self, fabric: str, holds: str, steps: int, step: float, **options) -> tuple[wy.Scene, wy.State]:
        """A cloth that is hung up, or free, as this one sees it: small, smooth, and bent at the start."""
        plain = flat(fabric, 5)
        bump = 0.05 * plain.shortest_spacing * np.sin(np.arange(plain.nodes))
        pose = (plain.position + bump[:, None] * [0.0, 0.0, 1.0]) @ self.turn.T
        numbers = {name: getattr(plain, name) for name in NUMBERS}
        cloth = wy.Cloth(plain.weave, yarns=plain.yarns, pose=pose, **numbers)
        acts = {"gravity": self.turn @ [0.0, 0.0, -G]}
        # air that does not move is seen to move
        acts["wind"] = wy.Wind(velocity=tuple(self.turn @ [1.0, 2.0, -1.0] + self.velocity))
        if holds != "nothing":
            pins = cloth.corners("top")
            t = step * np.arange(1, steps + 1)[:, None, None]
            acts |= {"pins": pins, "pin_path": cloth.position[pins] + t * self.velocity}
            if holds == "exact pins":
                acts["pin_stiffness"] = None
        scene = wy.Scene(cloth, **acts, **options)
        still = np.zeros((cloth.nodes, 3))
        return scene, wy.State(cloth.position, cloth.euler, still + self.velocity, np.zeros((cloth.nodes, 2)))

    def inside(self, trajectory: wy.Trajectory) -> np.ndarray:
        """Positions as seen by the one at rest."""
        return (trajectory.position - trajectory.time[:, None, None] * self.velocity) @ self.turn


NUMBERS = (
    "spacing", "radius", "crimp", "shear", "friction", "friction_stiffness", "friction_damping", "parallel_stiffness",
)  # fmt: skip
UNDAMPED = ("implicit-midpoint", "ros2")
"""Methods that do not damp what 1 ms does not resolve of a handkerchief: it gains energy, and no two runs are alike."""
AT_REST = Frame(np.eye(3), np.zeros(3))
FRAMES = {
    "moving": Frame(np.eye(3), np.array([6.0, -8.0, 0.0])),
    "turned": Frame(turning((3.0, -1.0, 2.0), 2.0), np.zeros(3)),
    "both": Frame(turning((1.0, 1.0, -2.0), 1.0), np.array([-7.0, 1.0, 50.0**0.5])),
}


FRAMES_SEEN = 8
"""Steps of 1 ms."""


@functools.cache
def seen(frame: str, method: str, fabric: str, holds: str, sliding: bool) -> np.ndarray:
    who, steps, step = FRAMES.get(frame, AT_REST), FRAMES_SEEN, 1e-3
    scene, start = who.scene(fabric, holds, steps, step, sliding=sliding)
    simulator = wy.Simulator(scene, step=step, integrator=method)
    simulator.state = start
    return who.inside(simulator.run(steps))


def check_frame(frame: str, *what) -> None:
    expected, found = seen("at rest", *what), seen(frame, *what)
    motion = norm(expected - expected[0], axis=2).max()
    assert motion > 1e-5
    assert norm(found - expected, axis=2).max() < 1e-6 * motion


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("holds", ["nothing", "springs", "exact pins"])
@pytest.mark.parametrize("fabric", CLOTHS)
def test_motion_is_the_same_in_every_frame(fabric, holds, frame):
    check_frame(frame, "sdirk2", fabric, holds, False)


@pytest.mark.parametrize("method", METHODS)
def test_with_every_method_and_sliding(method):
    check_frame("both", method, "paper", "springs", True)
    if method not in UNDAMPED:
        check_frame("both", method, "handkerchief", "springs", True)


# -- carried by pins ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fabric", "method"), [(f, m) for f in CLOTHS for m in METHODS if f == "paper" or m not in UNDAMPED]
)
def test_pins_at_1_m_s_do_not_disturb_what_they_carry(fabric, method):
    """The inner motion of a cloth that springs carry is that of one which hangs still (issue 12, seen 5)."""
    still = seen("at rest", method, fabric, "springs", False)
    who = Frame(np.eye(3), np.array([0.6, 0.0, 0.8]))
    scene, start = who.scene(fabric, "springs", FRAMES_SEEN, 1e-3, sliding=False)
    simulator = wy.Simulator(scene, step=1e-3, integrator=method)
    simulator.state = start
    motion = norm(still - still[0], axis=2).max()
    # a path that is given from step to step is followed evenly within it, which is exact at a steady velocity
    assert norm(who.inside(simulator.run(FRAMES_SEEN)) - still, axis=2).max() < 1e-6 * motion


@pytest.mark.parametrize("sliding", [True, False])
def test_long_steps_of_a_light_cloth_fall_as_short_ones(sliding):
    """The solver starts where the cloth moves as one, so that its tolerance leaves nothing of the fall out."""
    cloth = wy.fabrics.handkerchief(rows=7, columns=8, pose="flat")
    velocity = wy.Simulator(wy.Scene(cloth, sliding=sliding), step=1 / 60).run(24).velocity[-1]
    assert np.abs(velocity - [0.0, 0.0, -9.8 * 24 / 60]).max() < 1e-6 * 9.8 * 24 / 60


@pytest.mark.parametrize("fabric", CLOTHS)
def test_a_stage_that_is_solved_at_once_says_nothing_of_the_next(fabric):
    """A stiff cloth that spins: its first stage is that of a body that moves as one, its second one is not."""
    simulator = wy.Simulator(wy.Scene(flat(fabric, 5), sliding=False), step=2e-3)
    state = simulator.state
    state.velocity[:] = spinning(state.position)
    simulator.state = state
    simulator.run(24)
    assert not simulator.split_steps
