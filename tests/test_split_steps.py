"""Gradients of steps that were made in parts: that of the chain of parts, whoever made them, pins and forces too."""

import copy

import numpy as np
import pytest
import torch
from inputs import GROUPS, cloth, colliding, jittered, scaled, scene_for
from internals import gain_in_a_part, make_in_parts, numbers, strips
from warp_yarn.kernels.core.status import GAINED, STALLED

import warp_yarn as wy
import warp_yarn.torch as wt
from warp_yarn.gradients.parts import pieces
from warp_yarn.integrators import INTEGRATORS

STEPS = 4
CASES = {**GROUPS, "exact pins": ("pin_path", "stretch", "position", "velocity", "forces")}
EXACT = {"tolerance": 1e-14, "newton_tolerance": 1e-13}
"""Iterations to rounding: what they leave is noise of the differences."""


HALVED = {1: (STALLED, 0.6), 2: (STALLED, 0.3)}
"""Two steps in a row, of two and four parts; the first and the last are made at once."""


def check_directional_derivatives(
    rollout: wt.Rollout,
    names: tuple[str, ...],
    fixed: dict[str, torch.Tensor],
    split: dict[int, float],
    damped: set[int],
) -> None:
    """Compares gradients of a random combination of all frames with differences along a random direction of each input;
    the parts of the steps are the same in all of the runs."""
    function, inputs = scaled(rollout, names, fixed)
    random = torch.Generator().manual_seed(1)
    weights = [torch.randn(out.shape, dtype=out.dtype, generator=random) for out in function(*inputs)]

    def loss(*values: torch.Tensor) -> torch.Tensor:
        result = sum((out * weight).sum() for out, weight in zip(function(*values), weights, strict=True))
        assert (rollout.simulator.split_steps, rollout.simulator.damped_steps) == (split, damped)
        return result

    gradients = torch.autograd.grad(loss(*inputs), inputs)
    for k, name in enumerate(names):
        direction = torch.randn(inputs[k].shape, dtype=inputs[k].dtype, generator=random)
        found = float((gradients[k] * direction).sum())

        def difference(h: float, k: int = k, direction: torch.Tensor = direction) -> float:
            with torch.no_grad():
                ends = [
                    float(loss(*(x + sign * h * direction if i == k else x for i, x in enumerate(inputs))))
                    for sign in (1.0, -1.0)
                ]
            return (ends[0] - ends[1]) / (2.0 * h)

        # Newton's iteration leaves numbers near 1 some 1e-11 uncertain, one linear solve a stage 1e-12, and there the
        # loss is more curved: up to 1.2e-6 is seen
        h = 3e-6 if rollout.simulator.integrator.name in ("linear", "ros2") else 1e-5
        expected = (4.0 * difference(h) - difference(2.0 * h)) / 3.0
        assert found == pytest.approx(expected, rel=1e-5, abs=2e-6), name


FEW = {("linear", "exact pins"), ("sdirk2", "forces"), ("sdirk2", "initial state"), ("ros2", "exact pins")}


@pytest.mark.parametrize(
    ("method", "group"),
    [
        (method, group) if (method, group) in FEW else pytest.param(method, group, marks=pytest.mark.slow)
        for method in INTEGRATORS
        for group in CASES
    ],
)
def test_directional_derivatives(method: str, group: str) -> None:
    scene = scene_for(group, STEPS, stiffness=None if group == "exact pins" else 100.0)
    # what ros2 does not resolve grows from step to step, and differences are those of a curve then
    step = 2.5e-4 if method == "ros2" else 1e-3
    rollout = wt.Rollout(scene, STEPS, step=step, integrator=method, checkpoint_every=3, **EXACT)
    make_in_parts(rollout.simulator, HALVED)
    fixed = jittered(scene.cloth, size=0.2)
    if group == "initial state":
        del fixed["anchor"]
    check_directional_derivatives(rollout, CASES[group], fixed, {2: 0.5 * step, 3: 0.25 * step}, set())


@pytest.mark.parametrize("group", ["materials", "forces", pytest.param("exact pins", marks=pytest.mark.slow)])
def test_a_damped_step(group: str) -> None:
    """Implicit Euler makes all of a step that gains energy, and a half of another."""
    scene = scene_for(group, STEPS, stiffness=None if group == "exact pins" else 100.0)
    rollout = wt.Rollout(scene, STEPS, checkpoint_every=3, **EXACT)
    make_in_parts(rollout.simulator, {1: (GAINED, 0.6), 2: (STALLED, 0.6)})
    # of the first half of step 3
    gained = gain_in_a_part(rollout.simulator, 0.5, 1.0)
    check_directional_derivatives(rollout, CASES[group], jittered(scene.cloth, size=0.2), {2: 1e-3, 3: 5e-4}, {2, 3})
    assert gained


def gradients_of(
    rollout: wt.Rollout, inputs: dict[str, torch.Tensor], split: set[int], **options: int
) -> list[torch.Tensor]:
    """Gradients of every frame's positions by everything that is given, of a run in which these steps are split."""
    leaves = {name: value.clone().requires_grad_() for name, value in inputs.items()}
    position = rollout(**leaves, **options).position
    assert set(rollout.simulator.split_steps) == split
    (position / 1e-3).square().sum().backward()
    return [value.grad for value in leaves.values()]


@pytest.mark.parametrize("method", ["linear", "sdirk2"])
def test_parts_are_shorter_steps(method: str) -> None:
    """A step in four parts under forces that rest is four steps of a rollout with such steps, to the last bit: so is
    its gradient."""
    fabric = cloth(friction_damping=0.1)
    scene = wy.Scene(fabric, pins=fabric.corners("top"))
    inputs = {**jittered(fabric, size=0.2), "stretch": torch.tensor([5.0e5, 1.7e5], dtype=torch.float64)}
    whole = wt.Rollout(scene, 1, frames=[1], integrator=method, **EXACT, preconditioner="incomplete")
    make_in_parts(whole.simulator, {0: (STALLED, 0.3)})
    parts = wt.Rollout(scene, 4, frames=[4], step=2.5e-4, integrator=method, **EXACT, preconditioner="incomplete")
    for found, expected in zip(gradients_of(whole, inputs, {1}), gradients_of(parts, inputs, set()), strict=True):
        assert torch.equal(found, expected) and expected.abs().max() > 0.0


@pytest.mark.parametrize("every", [2, 3, 4, 9])
@pytest.mark.parametrize("split", [{0}, {1, 2}, {3}, {2, 5}, {0, 1, 2, 3, 4, 5, 6}])
def test_checkpoints_change_nothing(every: int, split: set[int]) -> None:
    """Wherever in the chunks such steps are: at their ends, in their midst, next to each other, all of them."""
    scene, gradients = scene_for("forces", 7), []
    for kept in (1, every):
        rollout = wt.Rollout(scene, 7, integrator="linear", checkpoint_every=kept)
        make_in_parts(rollout.simulator, {k + 5: (STALLED, 0.6) for k in split})
        inputs = jittered(scene.cloth, size=0.2)
        gradients.append(gradients_of(rollout, inputs, {k + 6 for k in split}, steps_done=5))
    for found, expected in zip(*reversed(gradients), strict=True):
        assert torch.equal(found, expected) and expected.abs().max() > 0.0


def test_a_run_is_cut_around_steps_in_parts() -> None:
    assert pieces(7, 3, {}) == [(0, 3), (3, 3), (6, 1)]
    of = dict.fromkeys((1, 2, 5, 7))
    assert pieces(7, 3, of) == [(0, 1), (1, 1), (2, 1), (3, 1), (4, 1), (5, 1), (6, 1)]
    assert pieces(9, 64, dict.fromkeys((4, 5))) == [(0, 3), (3, 1), (4, 1), (5, 4)]


@pytest.mark.parametrize("every", [1, 2])
def test_crossings_that_fly_at_each_other(every: int) -> None:
    """A step that really could not be made at once, in a run that goes on; at the steps around it differences agree."""
    scene, state = colliding(7.0)
    rollout = wt.Rollout(scene, 3, checkpoint_every=every, **EXACT)
    moving = {"euler_velocity": torch.as_tensor(state.euler_velocity), "steps_done": 5}

    def loss(density: torch.Tensor) -> torch.Tensor:
        return (rollout(density=density, **moving).euler[1:] / 1e-4).square().sum()

    density = torch.tensor([2.0e-3, 2.5e-3], dtype=torch.float64, requires_grad=True)
    value = loss(density)
    split = dict(rollout.simulator.split_steps)
    assert 6 in split
    value.backward()
    direction = torch.tensor([1e-9, -2e-9], dtype=torch.float64)
    ends = []
    for sign in (1.0, -1.0):
        with torch.no_grad():
            ends.append(float(loss(density + sign * direction)))
        assert rollout.simulator.split_steps == split
    # seen: 2e-9; where the direction is ten times as long, the parts change, and the loss jumps
    assert float(density.grad @ direction) == pytest.approx((ends[0] - ends[1]) / 2.0, rel=1e-7)


def test_a_second_backward_pass_and_a_copy_give_the_same() -> None:
    scene = scene_for("forces", STEPS)
    rollout = wt.Rollout(scene, STEPS, integrator="linear")
    make_in_parts(rollout.simulator, HALVED)
    shear = torch.tensor(900.0, dtype=torch.float64, requires_grad=True)
    fixed = jittered(scene.cloth, size=0.2)
    loss = (rollout(shear=shear, **fixed).position / 1e-3).square().sum()
    # another run in between, of one that asks for other inputs, and one without a gradient
    first = torch.autograd.grad(loss, shear, retain_graph=True)[0]
    gradients_of(rollout, fixed, {2, 3})
    with torch.no_grad():
        rollout(shear=950.0, **fixed)
    assert torch.equal(torch.autograd.grad(loss, shear)[0], first) and first != 0.0
    assert rollout.simulator.substepping.watcher is None
    other = copy.deepcopy(rollout)
    make_in_parts(other.simulator, HALVED)
    again = (other(shear=shear, **fixed).position / 1e-3).square().sum()
    assert torch.equal(torch.autograd.grad(again, shear)[0], first)


@pytest.mark.slow
def test_two_cores_take_parts_back_as_one_does() -> None:
    fabric, gradients = cloth(4, 18), []
    scene = wy.Scene(fabric, pins=fabric.corners("top"))
    for threads in (1, 2):
        rollout = wt.Rollout(scene, STEPS, checkpoint_every=3, threads=threads, **EXACT)
        make_in_parts(rollout.simulator, {1: (GAINED, 0.6), 2: (STALLED, 0.6)})
        gradients.append(gradients_of(rollout, jittered(fabric, size=0.2), {2, 3}))
    assert strips(rollout.simulator) == 2
    for found, expected in zip(*reversed(gradients), strict=True):
        # the same operations on every node; sums over nodes are added in another order
        assert (found - expected).abs().max() < 1e-9 * expected.abs().max()


def test_steps_that_are_made_again_are_not_watched_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """What they may gain depends on what was there before them, which a run from their middle does not know."""
    rollout = wt.Rollout(scene_for("plain", STEPS), STEPS, checkpoint_every=2)
    shear = torch.tensor(900.0, dtype=torch.float64, requires_grad=True)
    loss = (rollout(shear=shear).position / 1e-3).square().sum()
    run_chunk, bounds = rollout.simulator.run_chunk, []

    def looked_at(steps: int) -> int:
        bounds.append(tuple(numbers(rollout.simulator, name)[0] for name in ("bounds", "audit_due")))
        return run_chunk(steps)

    monkeypatch.setattr(rollout.simulator, "run_chunk", looked_at)
    loss.backward()
    assert bounds == [(np.inf, 0)] * 2


def test_a_step_that_cannot_be_made_again_says_so() -> None:
    """As on a device that does not add in the same order each time."""
    rollout = wt.Rollout(scene_for("plain", STEPS), STEPS, integrator="linear", checkpoint_every=2)
    shear = torch.tensor(900.0, dtype=torch.float64, requires_grad=True)
    loss = (rollout(shear=shear).position / 1e-3).square().sum()
    make_in_parts(rollout.simulator, {3: (STALLED, 0.6)})
    with pytest.raises(wy.GradientError, match="step 4 was made at once, and could not be made so again") as error:
        loss.backward()
    assert error.value.step == 4
