"""Gradients through impacts, friction and self-contact, by everything, against Richardson differences."""

import numpy as np
import pytest
import torch
from internals import near_room, set_near_room
from touching import GROUND, folded, lifted, paper

import warp_yarn as wy
import warp_yarn.torch as wt

STEPS = 80
EXACT = {"newton_tolerance": 1e-10, "tolerance": 1e-10}
"""What Newton's iteration leaves is noise of the differences."""
SIZES = {
    "obstacle_position": 1e-5,
    "obstacle_size": 1e-5,
    "obstacle_rotation": 1e-2,
    "position": 1e-5,
    "velocity": 1e-2,
    "euler_velocity": 1e-4,
}
"""Of a change of inputs, beside their own size: a fraction of the contact's range, and of a fall's speed."""


def check_derivatives(rollout: wt.Rollout, names: tuple[str, ...]) -> None:
    """Compares gradients of a random combination of last positions and velocities with differences along a random
    direction of each input, of which no input is at the border of its range."""
    random, nodes = np.random.default_rng(1), rollout.scene.cloth.nodes
    weights = [torch.tensor(random.standard_normal((nodes, 3))) for _ in range(2)]

    def loss(**inputs: torch.Tensor) -> torch.Tensor:
        last = rollout(**inputs).last
        return (last.position * weights[0]).sum() / 1e-3 + (last.velocity * weights[1]).sum() / 0.1

    leaves = {name: rollout.defaults[name.removeprefix("yarn_")].clone().requires_grad_() for name in names}
    value = loss(**leaves)
    parts = dict(rollout.simulator.split_steps), set(rollout.simulator.damped_steps)
    value.backward()
    wrong = {}
    for name in names:
        start = rollout.defaults[name.removeprefix("yarn_")]
        size = next((s for key, s in SIZES.items() if name.startswith(key)), float(start.abs().max()))
        direction = torch.tensor(random.standard_normal(tuple(start.shape)))
        if name.startswith("obstacle_rotation"):
            direction -= (direction * start).sum(-1, keepdim=True) * start
        if name == "obstacle_size":
            direction *= start > 0.0
        if name == "euler_velocity":
            direction *= torch.as_tensor(rollout.scene.cloth.topology.is_crossing)[:, None]
        if name == "anchor":
            size = 1e-8
        if not start.ndim:
            direction = torch.tensor(1.0, dtype=torch.float64)
        found = float((leaves[name].grad * direction * size).sum())

        def difference(h: float, name: str = name, start=start, direction=direction, size: float = size) -> float:
            ends = []
            for sign in (1.0, -1.0):
                value = start + sign * h * size * direction
                if name.startswith("obstacle_rotation"):
                    value = value / value.norm(dim=-1, keepdim=True)
                with torch.no_grad():
                    ends.append(float(loss(**{name: value})))
                if (rollout.simulator.split_steps, rollout.simulator.damped_steps) != parts:
                    # the loss jumps between; nearer by it need not
                    return np.inf
            return (ends[0] - ends[1]) / (2.0 * h)

        errors = []
        for h in (1e-3, 3e-4, 3e-5, 3e-6):
            expected = (4.0 * difference(h) - difference(2.0 * h)) / 3.0
            errors.append(abs(found - expected) / abs(expected))
            if errors[-1] < 1e-5:
                break
        print(f"{name}: {found:.6e}, {expected:.6e}, {errors}")
        # what does nothing would agree
        if min(errors) >= 1e-5 or abs(found) < 1e-8:
            wrong[name] = (found, expected, errors)
    assert not wrong


LAW = ("stiffness", "distance", "range", "slip_speed", "damping_speed")
OBSTACLE_LAW = tuple(f"contact_{name}" for name in LAW)
SELF_LAW = (*(f"self_contact_{name}" for name in LAW), "contact_friction")
STATE = ("position", "velocity", "euler_velocity")
FABRIC = ("yarn_density", "yarn_stretch", "yarn_bend", "shear", "friction", "gravity")


def drop(**options) -> wy.Scene:
    """A sheet that falls onto a box, a ball and a mesh."""
    cloth = lifted(paper(5, 5), 1.2e-3, 3e-5)
    vertices = np.array([(-1.0, -1.0, -0.1), (6.0, -1.0, -0.1), (2.0, 6.0, -0.3)]) * 1e-3
    obstacles = [
        wy.Box(center=(1e-3, 1e-3, -4e-3), half_extents=(1.2e-3, 1.7e-3, 4e-3)),
        wy.Sphere(center=(3.2e-3, 3.1e-3, -2e-3), radius=2e-3, friction=0.5),
        wy.TriangleMesh(vertices, [[0, 1, 2]], friction=0.1),
    ]
    return wy.Scene(cloth, obstacles=obstacles, **options)


def push() -> wy.Scene:
    """A hung sheet, and a turning box that is pushed against it along a path."""
    cloth = lifted(paper(5, 5, pose="upright"), 0.0, 2e-5)
    t = np.arange(1, STEPS + 1)[:, None] * 1e-3
    turn = np.hstack([0.0 * t, 0.0 * t, np.sin(5.0 * t), np.cos(5.0 * t)])
    start = cloth.position.mean(axis=0) + np.array([0.0, -2.3e-3, 0.0])
    path = np.hstack([start + t * (0.02, 0.05, 0.0), turn])
    box = wy.Box(center=start, half_extents=(1e-3, 1e-3, 1e-3), friction=0.4, path=path)
    return wy.Scene(cloth, pins=cloth.corners("top"), obstacles=[box])


METHODS = ("implicit-euler", "sdirk2")
SLOWER = ["implicit-euler", pytest.param("sdirk2", marks=pytest.mark.slow)]


@pytest.mark.parametrize("method", METHODS)
def test_impact_and_friction_by_obstacles(method: str) -> None:
    """By the law, and by what obstacles are and where they are."""
    names = (*OBSTACLE_LAW, "obstacle_size", "obstacle_friction", "obstacle_position", "obstacle_rotation")
    check_derivatives(wt.Rollout(drop(), STEPS, integrator=method, **EXACT), names)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_impact_and_friction_by_cloth(method: str) -> None:
    """By how it starts, and what it is of."""
    check_derivatives(wt.Rollout(drop(), STEPS, integrator=method, **EXACT), (*STATE, *FABRIC))


@pytest.mark.parametrize("method", SLOWER)
def test_moving_obstacles(method: str) -> None:
    names = ("obstacle_position_path", "obstacle_rotation_path", "obstacle_size", "contact_stiffness", "velocity")
    check_derivatives(wt.Rollout(push(), STEPS, integrator=method, **EXACT), names)


SOME = ("self_contact_stiffness", "self_contact_distance", "contact_friction", "velocity")
ALL = (*SELF_LAW, "contact_stiffness", *STATE, *FABRIC)


@pytest.mark.parametrize(
    ("method", "names"), [("implicit-euler", SOME), *(pytest.param(m, ALL, marks=pytest.mark.slow) for m in METHODS)]
)
def test_self_contact(method: str, names: tuple[str, ...]) -> None:
    """Of a strip folded over itself, by the law and by all else, sliding and checkpoints included."""
    scene = wy.Scene(folded(), obstacles=[GROUND], self_contact=True)
    rollout = wt.Rollout(scene, STEPS, integrator=method, checkpoint_every=16, **EXACT)
    check_derivatives(rollout, names)


@pytest.mark.parametrize("samples", ["nodes", "nodes+mids"])
def test_room_grows_on_the_way_back(samples: str) -> None:
    """Where a list is made that the run did not make: the bits are those of enough room."""
    scene = wy.Scene(folded(), obstacles=[GROUND], self_contact=True, contact=wy.Contact(samples=samples))
    rollout, results = wt.Rollout(scene, 30, integrator="implicit-euler"), []
    for room in (64, 1):
        velocity = rollout.defaults["velocity"].clone().requires_grad_()
        stiffness = rollout.defaults["self_contact_stiffness"].clone().requires_grad_()
        position = rollout(velocity=velocity, self_contact_stiffness=stiffness).last.position
        set_near_room(rollout.simulator, room)
        (position * torch.linspace(-1.0, 1.0, position.numel(), dtype=torch.float64).view_as(position)).sum().backward()
        assert near_room(rollout.simulator) > 1
        results.append((velocity.grad, stiffness.grad))
    assert all(torch.equal(*both) for both in zip(*results, strict=True))


MIDS = wy.Contact(samples="nodes+mids")
SMALL = ("friction", "yarn_stretch")
OF_MIDS = tuple(name for name in ALL if name not in SMALL)
"""Friction and stretch of the yarns do a thousandth of the others, as little as kinks and what Newton's iteration
leaves do to differences."""


@pytest.mark.parametrize(
    ("method", "names"),
    [
        ("implicit-euler", ("self_contact_stiffness", "obstacle_friction", "velocity")),
        *(pytest.param(m, (*OF_MIDS, "obstacle_friction"), marks=pytest.mark.slow) for m in METHODS),
    ],
)
def test_middles_that_touch(method: str, names: tuple[str, ...]) -> None:
    scene = wy.Scene(folded(), obstacles=[GROUND], self_contact=True, contact=MIDS)
    check_derivatives(wt.Rollout(scene, STEPS // 2, integrator=method, **EXACT), names)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_middles_on_obstacles(method: str) -> None:
    """A mesh among them."""
    names = (*OBSTACLE_LAW, "obstacle_size", "obstacle_position", "obstacle_rotation", *STATE, *FABRIC)
    names = tuple(name for name in names if name not in SMALL)
    check_derivatives(wt.Rollout(drop().replace(contact=MIDS), STEPS, integrator=method, **EXACT), names)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_self_contact_of_locked_yarns(method: str) -> None:
    scene = wy.Scene(folded(), obstacles=[GROUND], self_contact=True, sliding=False)
    names = (*SELF_LAW, "position", "velocity", "yarn_density", "yarn_stretch", "yarn_bend")
    check_derivatives(wt.Rollout(scene, STEPS, integrator=method, **EXACT), names)


@pytest.mark.slow
def test_cloths_that_touch() -> None:
    cloths = [lifted(paper(5, 5), 1.2e-3, 3e-5), lifted(paper(4, 4), 3.6e-3, 3e-5)]
    scene = wy.Scene(cloths, obstacles=[GROUND], self_contact=True)
    rollout = wt.Rollout(scene, STEPS, integrator="implicit-euler", **EXACT)
    check_derivatives(rollout, (*SELF_LAW, "position", "velocity", "yarn_density"))


def test_an_input_is_as_good_as_a_scene() -> None:
    """Obstacles far from where the scene has them, and a law of longer reach, by inputs: the same bits as of a scene
    that has them."""
    cloth, ball = folded(), wy.Sphere(center=(4e-3, 2e-3, -3e-3), radius=3e-3)
    far = ball.replace(center=(4e-3, 2e-3, -40e-3))
    short = wy.Contact(self_distance=1e-3, self_range=3e-4, stiffness=2.0)
    long = wy.Contact(self_distance=1.5e-3, self_range=1.2e-3, stiffness=2.0)
    scene = wy.Scene(cloth, obstacles=[far, GROUND], self_contact=True, contact=short)
    other = wt.Rollout(scene, 30, integrator="implicit-euler")
    other()
    inputs = {"self_contact_distance": 1.5e-3, "self_contact_range": 1.2e-3}
    inputs["obstacle_position"] = np.array([(4e-3, 2e-3, -3e-3), (0.0, 0.0, 0.0)])
    found = other(**inputs).position
    same = wt.Rollout(scene.replace(obstacles=[ball, GROUND], contact=long), 30, integrator="implicit-euler")
    # lists of another grid add up in another order, which a contact's stiffness makes more of
    assert (found - same().position).abs().max() < 1e-10 * 1e-3
