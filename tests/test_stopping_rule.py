"""When Newton's iteration stops: what a stage leaves is within the tolerance, of stiff and soft cloth, free and held.

Both are seen at default settings, where yarns are let go strained: there stretching is taken away at once, and buckling
goes on.
"""

import dataclasses

import numpy as np
import pytest
from internals import newton_tolerance, numbers

import warp_yarn as wy
from warp_yarn.presets import fabrics

STAGED = ("implicit-euler", "implicit-midpoint", "sdirk2", "esdirk3")
norm = np.linalg.norm


def strained(fabric: str, stretch: float, size: int) -> wy.Cloth:
    """A flat cloth of yarns that resist stretching so many times as much."""
    cloth = fabrics.STUDIED[fabric](rows=size, columns=size, pose="flat")
    yarns = [dataclasses.replace(yarn, stretch=stretch * yarn.stretch) for yarn in cloth.yarns]
    return cloth.replace(yarns=yarns)


def jittered(simulator: wy.Simulator, strain: float, seed: int) -> wy.State:
    """The start, every node that is not held up to so many spacings off."""
    state, scene = simulator.state, simulator.scene
    off = strain * scene.cloth.spacing * np.random.default_rng(seed).uniform(-1.0, 1.0, state.position.shape)
    off[scene.pins] = 0.0
    state.position += off
    return state


def moved_within(simulator: wy.Simulator) -> np.ndarray:
    """Positions of 8 steps as seen by one who goes along with their mean."""
    position = simulator.run(8).position
    return position - position.mean(axis=1, keepdims=True)


def check_falls_as_it_floats(floats: np.ndarray, falls: np.ndarray) -> None:
    motion = norm(floats - floats[0], axis=2).max()
    assert motion > 1e-6
    # the linear solves differ by their tolerance, 1e-3 of what is left, and now and then an iteration by one step
    assert norm(falls - floats, axis=2).max() < 1e-3 * motion


@pytest.mark.parametrize("step", [2e-4, 1e-3, 4e-3])
@pytest.mark.parametrize("stretch", [0.1, 1.0, 10.0])
@pytest.mark.parametrize("fabric", fabrics.STUDIED)
def test_a_step_leaves_no_more_than_its_tolerance(fabric, stretch, step):
    """Of the change of velocity, seen by one who falls with what nothing holds."""
    cloth = strained(fabric, stretch, 6)
    for pins in ([], cloth.corners("top")):
        scene = wy.Scene(cloth, sliding=False, pins=pins)
        by_default = wy.Simulator(scene, step=step)
        tight = wy.Simulator(scene, step=step, newton_tolerance=1e-10, tolerance=1e-12)
        by_default.state = jittered(by_default, 0.02, 1)
        for _ in range(3):
            start = tight.state = by_default.state
            by_default.run(1)
            tight.run(1)
            change = tight.state.velocity - start.velocity
            if not pins:
                change -= change.mean(axis=0)
            left = by_default.state.velocity - tight.state.velocity
            # two stages have each their tolerance
            assert norm(left) <= 2.0 * newton_tolerance(by_default, step) * norm(change)


def test_a_step_that_goes_astray_feigns_no_contraction():
    """The one after a large stray step is small beside that, and no nearer to the end than the one before: this stage
    left 2.2 times its tolerance."""
    cloth = wy.paper.cloth(rows=6, columns=6, pose="flat")
    scene = wy.Scene(cloth, pins=cloth.corners("top"), pin_stiffness=None)
    seen = []
    for options in ({}, {"newton_tolerance": 1e-8, "tolerance": 1e-12}):
        simulator = wy.Simulator(scene, step=5e-4, **options)
        start = simulator.state = jittered(simulator, 0.5, 30)
        simulator.run(1)
        assert not simulator.split_steps
        seen.append(simulator.state.velocity - start.velocity)
    tolerance = newton_tolerance(wy.Simulator(scene, step=5e-4), 5e-4)
    assert norm(seen[0] - seen[1]) <= tolerance * norm(seen[1])


@pytest.mark.parametrize("sliding", [False, True])
@pytest.mark.parametrize("method", STAGED)
@pytest.mark.parametrize("fabric", fabrics.STUDIED)
def test_a_falling_cloth_moves_within_itself_as_one_that_floats(fabric, method, sliding):
    """Of the paper's cloth the fall hid all of its own motion from a rule that looked at the whole change of
    velocity."""
    seen = []
    for gravity in (0.0, 0.0, 0.0), (0.0, 0.0, -9.8):
        scene = wy.Scene(strained(fabric, 1.0, 5), sliding=sliding, gravity=gravity)
        simulator = wy.Simulator(scene, step=5e-3, integrator=method)
        simulator.state = jittered(simulator, 0.005, 1)
        seen.append(moved_within(simulator))
    check_falls_as_it_floats(*seen)


def test_cloths_that_touch_each_other_alone_move_as_ones_that_float():
    """What one does to the other moves no mass centre: two that are pressed together. By the whole change of velocity
    they were 0.4 of their motion off."""
    cloth = wy.paper.cloth(rows=5, columns=5, pose="flat")
    n, spacing = cloth.nodes, cloth.spacing
    alone = wy.Simulator(wy.Scene(cloth, self_contact=True))
    distance, reach = (float(numbers(alone, f"self_contact_{name}")[0]) for name in ("distance", "range"))
    above = cloth.replace(pose=cloth.position + np.array([0.2 * spacing, 0.1 * spacing, distance + 0.9 * reach]))
    press = {node: (0.0, 0.0, 2e-6 if node < n else -2e-6) for node in range(2 * n)}
    seen = []
    for gravity in None, (0.0, 0.0, -9.8):
        scene = wy.Scene([cloth, above], gravity=gravity, self_contact=True, forces=press)
        simulator = wy.Simulator(scene, step=5e-3, integrator="implicit-euler")
        state = jittered(simulator, 0.005, 1)
        state.velocity[n:, 2] = -0.01
        simulator.state = state
        seen.append(moved_within(simulator))
    check_falls_as_it_floats(*seen)
