"""Obstacles that are put elsewhere, in a simulator or in a rollout, are as those of a scene that has them there."""

import copy

import numpy as np
import pytest
import torch

import warp_yarn as wy
import warp_yarn.torch as wt

OPTIONS = {"step": 1e-3, "integrator": "implicit-euler"}
TURNED = np.array([0.0, np.sin(0.1), 0.0, np.cos(0.1)])


def scene(ball=(30e-3, 0.0, 0.0), slab=(30e-3, 0.0, 0.0), rotation=(0.0, 0.0, 0.0, 1.0)) -> wy.Scene:
    """A cloth that falls by 2 mm at most; the scene's own obstacles are to its side."""
    flat = wy.paper.cloth(rows=5, columns=5, pose="flat")
    cloth = flat.replace(pose=flat.position + np.array([0.0, 0.0, 2e-3]))
    obstacles = [
        wy.Sphere(center=ball, radius=2e-3),
        wy.Box(center=slab, half_extents=(4e-3, 4e-3, 1e-3), rotation=rotation),
    ]
    return wy.Scene(cloth, obstacles=obstacles)


BENEATH = ((2e-3, 2e-3, -2e-3), (2e-3, 2e-3, -5e-3))


def test_a_simulator_with_moved_obstacles_is_one_of_the_other_scene():
    """To the last bit, where cloth lands within the run; and what is moved away again is no more in the way."""
    moved, made = wy.Simulator(scene(), **OPTIONS), wy.Simulator(scene(*BENEATH, TURNED), **OPTIONS)
    falls = wy.Simulator(scene(), **OPTIONS).run(40).position
    moved.place_obstacles(BENEATH, [[0.0, 0.0, 0.0, 1.0], TURNED])
    lands = moved.run(40).position
    assert np.array_equal(lands, made.run(40).position)
    assert np.abs(lands - falls)[-1].max() > 1e-3
    moved.reset()
    moved.place_obstacles([(30e-3, 0.0, 0.0)] * 2)
    assert np.array_equal(moved.run(40).position, falls)


def test_a_copy_has_obstacles_where_they_were_put():
    moved = wy.Simulator(scene(), **OPTIONS)
    moved.place_obstacles(BENEATH)
    assert np.array_equal(copy.deepcopy(moved).run(40).position, moved.run(40).position)


def test_a_rollout_with_moved_obstacles_is_one_of_the_other_scene():
    """A stage begins from where its nodes are, and is not taken along by an obstacle that stands still elsewhere than
    the scene says."""
    place = torch.tensor(BENEATH, dtype=torch.float64, requires_grad=True)
    moved = wt.Rollout(scene(), 40, **OPTIONS)(obstacle_position=place)
    made = wt.Rollout(scene(*BENEATH), 40, **OPTIONS)()
    assert torch.equal(moved.position, made.position)
    # what is lifted by an obstacle goes with it
    moved.position[-1, :, 2].mean().backward()
    assert place.grad[:, 2].sum() > 0.1


def test_obstacles_are_refused_where_they_cannot_be():
    simulator = wy.Simulator(scene(), **OPTIONS)
    with pytest.raises(wy.InputError, match=r"obstacles\[0\], a Sphere"):
        simulator.place_obstacles([(2e-3, 2e-3, 0.0), (30e-3, 0.0, 0.0)])
    with pytest.raises(wy.InputError, match=r"position has shape \(1, 3\), must be \(2, 3\)"):
        simulator.place_obstacles([(2e-3, 2e-3, 0.0)])
    with pytest.raises(wy.InputError, match=r"rotation\[1\].*length 2"):
        simulator.place_obstacles([(2e-3, 2e-3, -9e-3)] * 2, [[0, 0, 0, 1], [0, 0, 0, 2]])
    assert np.array_equal(simulator.run(40).position, wy.Simulator(scene(), **OPTIONS).run(40).position)
    for other in (
        scene().replace(obstacles=[]),
        scene().replace(obstacles=[wy.Plane(point=(0, 0, -1), normal=(0, 0, 1), path=[(0, 0, -1)])]),
    ):
        with pytest.raises(wy.InputError, match="none of them a path"):
            wy.Simulator(other, **OPTIONS).place_obstacles([(0.0, 0.0, -1.0)])
