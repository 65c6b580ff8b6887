"""What one call of a Rollout or a Fabric leaves for the next: nothing but what is handed on."""

from __future__ import annotations

import concurrent.futures
import contextlib
import copy
import dataclasses
import functools
import io
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from cases import quick
from inputs import WIND, cloth, gradcheck, jittered, scene_for

import warp_yarn as wy
import warp_yarn.torch as wt
from warp_yarn.integrators import INTEGRATORS
from warp_yarn.simulation.state import FIELDS

STEPS = 3


@functools.cache
def scene(steps: int = STEPS) -> wy.Scene:
    """Everything that changes from step to step, and friction that slides far enough to be seen."""
    fabric = cloth(4, 4, friction_damping=0.1)
    random = np.random.default_rng(5)
    pins = fabric.corners("top")
    path = fabric.position[pins] + 1e-4 * random.standard_normal((steps, 2, 3))
    forces = {7: 1e-4 * random.standard_normal((max(steps - 1, 1), 3)), 12: 1e-4 * np.ones(3)}
    return wy.Scene(fabric, wind=WIND, pins=pins, pin_stiffness=100.0, pin_path=path, forces=forces)


ASKED = (("forces",), ("wind_velocity",), ("pin_path", "stretch"), ("pin_stiffness",), ("position", "anchor"), ())
"""What gradients are asked for: few, so that each comes again after others."""


def value_near(rollout: wt.Rollout, name: str, random: np.random.Generator) -> torch.Tensor:
    """One of the inputs, near the scene's own value."""
    start = {**rollout.defaults, **jittered(rollout.scene.cloth, size=0.3)}
    if name == "euler":
        return start[name].clone()  # scaled, crossings would leave their yarns' ends
    if name in ("density", "stretch", "bend"):
        start[name] = torch.tensor([getattr(yarn, name) for yarn in rollout.scene.cloth.yarns], dtype=torch.float64)
    return start[name] * random.uniform(0.99, 1.01)


@dataclasses.dataclass
class Call:
    """A call, and which of its inputs a gradient is asked for."""

    inputs: dict[str, torch.Tensor]
    wanted: tuple[str, ...]
    weights: tuple[torch.Tensor, ...]

    @classmethod
    def draw(cls, rollout: wt.Rollout, random: np.random.Generator) -> Call:
        wanted = ASKED[random.integers(len(ASKED))]
        names = [name for name in rollout.inputs if not name.startswith("yarn_")]
        others = random.choice(names, random.integers(4), replace=False)
        inputs = {str(name): value_near(rollout, name, random) for name in (*wanted, *others)}
        size = (len(rollout.frames), rollout.scene.cloth.nodes)
        weights = tuple(torch.tensor(random.standard_normal((*size, width))) for width in (3, 2, 3, 2, 2))
        return cls(inputs, wanted, weights)

    def begin(self, function: Callable[..., wt.Frames], **extra: Any) -> tuple[wt.Frames, dict[str, torch.Tensor]]:
        given = {name: value.clone().requires_grad_(name in self.wanted) for name, value in self.inputs.items()}
        return function(**given, **extra), given

    def end(self, frames: wt.Frames, given: dict[str, torch.Tensor]) -> list[torch.Tensor]:
        """All that a call gives: its frames and its gradients."""
        leaves = [given[name] for name in self.wanted]
        loss = sum((w * x).sum() for w, x in zip(self.weights, frames, strict=True))
        gradients = torch.autograd.grad(loss, leaves) if leaves else ()
        return [*(x.detach() for x in frames), *gradients]

    def answer(self, function: Callable[..., wt.Frames], **extra: Any) -> list[torch.Tensor]:
        return self.end(*self.begin(function, **extra))


def same(found: list[torch.Tensor], expected: list[torch.Tensor]) -> bool:
    return len(found) == len(expected) and all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


def fails(rollout: wt.Rollout) -> None:
    velocity = torch.full(rollout.inputs["velocity"], 1e200, dtype=torch.float64)
    velocity[3] = -1e200
    rollout(velocity=velocity, friction=torch.tensor(0.1))


def interrupt(rollout: wt.Rollout, random: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C in a run, one that fails or its backward pass: before or after one of what they consist of."""
    simulator = rollout.simulator
    places = [(simulator, name) for name in ("run_chunk", "fail")]
    places += [(simulator.integrator, name) for name in ("advance", "backward_step", "set_times", "prepare_adjoint")]
    owner, name = places[random.integers(len(places))]
    left, before, real = [random.integers(4)], random.random() < 0.5, getattr(owner, name)

    def interrupted(*arguments: Any) -> Any:
        left[0] -= 1
        if left[0] < 0 and before:
            raise KeyboardInterrupt
        result = real(*arguments)
        if left[0] < 0:
            raise KeyboardInterrupt
        return result

    with monkeypatch.context() as patch, contextlib.suppress(KeyboardInterrupt, wy.SimulationError):
        patch.setattr(owner, name, interrupted)
        if random.random() < 0.5:
            fails(rollout)
        else:
            Call.draw(rollout, random).answer(rollout)


def disturb(rollout: wt.Rollout, random: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Something that ends in an error, or that somebody does with the simulator within."""
    kind = random.integers(8)
    if kind == 0:
        with pytest.raises(wy.InputError):
            rollout(friction=-1.0, shear=3000.0, position=rollout.defaults["position"] + 1.0)
    elif kind == 1:
        with pytest.raises(wy.InputError, match="Δs"):  # found after the parameters were put in place
            rollout(shear=3000.0, gravity=torch.ones(3), euler=rollout.defaults["euler"].flip(0))
    elif kind == 2:
        with pytest.raises(wy.SimulationError):
            fails(rollout)
    elif kind == 3:
        gravity = torch.zeros(3, requires_grad=True)
        frames = rollout(gravity=gravity)
        with pytest.raises(wy.GradientError):
            (frames.velocity[-1] * float("inf")).sum().backward()
    elif kind == 4:
        with contextlib.suppress(wy.SimulationError):  # where a run that failed left it
            rollout.simulator.energy()
            rollout.simulator.run(2)
            rollout.simulator.forces()
    else:
        interrupt(rollout, random, monkeypatch)


def check_sequence(rollout: wt.Rollout, fresh: Callable[[], wt.Rollout], seed: int, patch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(seed)
    pending = None
    for k in range(30):
        kind = random.random()
        if kind < 0.4:
            disturb(rollout, random, patch)
            continue
        call = Call.draw(rollout, random)
        steps_done = int(random.integers(3))
        expected = call.answer(fresh(), steps_done=steps_done)
        if kind < 0.5 and pending is None:  # its backward pass comes after other calls
            pending = call, call.begin(rollout, steps_done=steps_done), expected
        elif kind < 0.57:
            with torch.no_grad():
                assert same(list(call.begin(rollout, steps_done=steps_done)[0]), expected[:5]), (seed, k)
        else:
            assert same(call.answer(rollout, steps_done=steps_done), expected), (seed, k)
        if pending is not None and random.random() < 0.3:
            earlier, begun, expected = pending
            assert same(earlier.end(*begun), expected), (seed, k)
            pending = None


# Sequences that are interrupted where a run, a step in parts or a failure would leave something behind.
@pytest.mark.parametrize(("seed", "every"), [(5, 2), pytest.param(11, 1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("method", quick(INTEGRATORS, "linear"))
def test_a_rollout_answers_as_a_fresh_one(method: str, seed: int, every: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def fresh() -> wt.Rollout:
        return wt.Rollout(scene(), STEPS, integrator=method, checkpoint_every=every)

    check_sequence(fresh(), fresh, seed, monkeypatch)


@pytest.mark.parametrize(
    ("first", "then"),
    [("forces", "wind_velocity"), ("pin_path", "pin_stiffness"), ("pin_path", "position"), ("stretch", "forces")],
)
def test_a_gradient_is_the_same_after_another_one(first: str, then: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fabric = wy.paper.cloth(rows=5, columns=5)
    pins = fabric.corners("top")
    path = np.repeat(fabric.position[pins][None], 10, axis=0)
    rollout = wt.Rollout(
        wy.Scene(fabric, wind=WIND, pins=pins, pin_path=path, forces={12: np.zeros((10, 3))}), 10, step=1e-3
    )

    def gradient(name: str) -> torch.Tensor:
        value = (torch.tensor([5e5, 1.7e5]) if name == "stretch" else rollout.defaults[name]).requires_grad_()
        rollout(**{name: value}).position.square().sum().backward()
        return value.grad

    before = gradient(first)
    assert gradient(then).abs().max() > 0.0 and before.abs().max() > 0.0
    assert torch.equal(gradient(first), before)

    # nor where the other one was interrupted as it began
    def interrupted(*arguments: Any) -> None:
        prepare(*arguments)
        raise KeyboardInterrupt

    prepare = rollout.simulator.integrator.prepare_adjoint
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(rollout.simulator.integrator, "prepare_adjoint", interrupted)
        gradient(then)
    assert torch.equal(gradient(first), before)


@pytest.mark.parametrize("shared", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_rollouts_in_threads_answer_as_alone(shared: bool) -> None:
    """One that they share, or one for each call, made by its thread, which captures all of its graphs there."""
    rollout, random = wt.Rollout(scene(), STEPS), np.random.default_rng(3)
    calls = [Call.draw(rollout, random) for _ in range(12)]
    expected = [call.answer(rollout) for call in calls]
    with concurrent.futures.ThreadPoolExecutor(3) as pool:
        found = list(pool.map(lambda call: call.answer(rollout if shared else wt.Rollout(scene(), STEPS)), calls))
    assert all(same(a, b) for a, b in zip(found, expected, strict=True))


LEARN = {"stretch": (1e4, 1e6), "friction": (0.0, 2.0), "forces": (-1e-3, 1e-3)}


@pytest.mark.slow
def test_a_fabric_answers_as_a_fresh_one(monkeypatch: pytest.MonkeyPatch) -> None:
    def fresh() -> wt.Fabric:
        return wt.Fabric(scene(), STEPS, learn=LEARN)

    fabric, random = fresh(), np.random.default_rng(11)
    optimizer = torch.optim.SGD(fabric.parameters(), lr=0.1)
    for k in range(30):
        kind = random.integers(8)
        if kind == 0:
            fabric.set("stretch", random.uniform(2e5, 6e5, 2))
        elif kind == 1:
            with pytest.raises(wy.InputError):
                fabric.set("friction", [3.0, -1.0, float("nan")][random.integers(3)])
        elif kind == 2:
            with pytest.raises(wy.InputError):
                fabric(wind_drag=-1.0)
        elif kind == 3:
            disturb(fabric.rollout, random, monkeypatch)
        elif kind == 4:
            fabric = [copy.deepcopy, lambda f: pickle.loads(pickle.dumps(f)), saved_and_loaded][random.integers(3)](
                fabric
            )
            optimizer = torch.optim.SGD(fabric.parameters(), lr=0.1)
        else:
            inputs = {"wind_velocity": torch.tensor(random.standard_normal(3), requires_grad=True)}
            if random.random() < 0.5:
                inputs["position"] = value_near(fabric.rollout, "position", random)
            answers = []
            other = fresh()
            other.load_state_dict(fabric.state_dict())
            for asked in (fabric, other):
                asked.requires_grad_(bool(kind != 5))  # at times of the wind alone
                asked.zero_grad()
                inputs["wind_velocity"].grad = None
                frames = asked(**inputs)
                (frames.position[-1].square().sum() / 1e-6).backward()
                gradients = [p.grad for p in asked.parameters() if p.grad is not None]
                answers.append([*(x.detach() for x in frames), inputs["wind_velocity"].grad, *gradients])
            assert len(answers[0]) == (6 if kind == 5 else 9)
            assert same(*answers), k
            optimizer.step()


# -- going on where a run ended ---------------------------------------------------------------------------------------

EXACT = {"tolerance": 1e-14, "newton_tolerance": 1e-13}


def in_parts(rollout: wt.Rollout, parts: int, **inputs: torch.Tensor) -> wt.Frames:
    """A run in parts, each from the state that the one before ended in."""
    state = {name: inputs.pop(name) for name in FIELDS if name in inputs}
    frames = [rollout(**state, **inputs)]
    for k in range(1, parts):
        frames.append(rollout(state=frames[-1].last, steps_done=k * rollout.steps, **inputs))
    joined = zip(*(part if k == 0 else [x[1:] for x in part] for k, part in enumerate(frames)), strict=True)
    return wt.Frames(*(torch.cat(fields) for fields in joined))


@pytest.mark.parametrize("every", [1, 2])
@pytest.mark.parametrize("method", quick([name for name in INTEGRATORS if name != "esdirk3"], "linear", "sdirk2"))
def test_a_run_in_parts_is_the_same_as_at_once(method: str, every: int) -> None:
    options = {"integrator": method, "checkpoint_every": every, **EXACT}
    whole, part = wt.Rollout(scene(6), 6, **options), wt.Rollout(scene(6), 2, **options)
    names = ("stretch", "friction", "forces", "pin_path", "wind_velocity")
    start = {name: value_near(whole, name, np.random.default_rng(0)) for name in names}
    start |= jittered(whole.scene.cloth, size=0.2)
    answers = []
    for run in (whole, functools.partial(in_parts, part, 3)):
        given = {name: value.clone().requires_grad_() for name, value in start.items()}
        frames = run(**given)
        weights = [torch.tensor(np.random.default_rng(1).standard_normal(x.shape)) for x in frames]
        loss = sum((w * x).sum() for w, x in zip(weights, frames, strict=True))
        answers.append(([x.detach() for x in frames], torch.autograd.grad(loss, list(given.values()))))
    (frames, gradients), (frames_of_parts, gradients_of_parts) = answers
    assert same(frames, frames_of_parts)
    for name, a, b in zip(start, gradients, gradients_of_parts, strict=True):
        # sums in another order, and every adjoint solve to 1e-14
        assert torch.allclose(a, b, rtol=1e-9, atol=1e-11 * float(a.abs().max())), name
        assert float(a.abs().max()) > 0.0, name


def test_anchors_make_the_difference() -> None:
    """What friction's springs are strained by after a run in parts is what it is at once; without the anchors it is
    what the last part strained them by."""
    fabric = wy.paper.cloth(rows=5, columns=5)
    one = wy.Scene(fabric, wind=wy.Wind(velocity=(0.0, 5.0, 0.0)), pins=fabric.corners("top"))
    rollout = wt.Rollout(one, 10, frames=[10])

    def strain(state: wy.State) -> torch.Tensor:
        return state.euler - state.anchor

    with torch.no_grad():
        expected = strain(wt.Rollout(one, 30, frames=[30])().last)
        with_anchors = without = rollout().last
        for k in (1, 2):
            with_anchors = rollout(state=with_anchors, steps_done=10 * k).last
            without = rollout(state=dataclasses.replace(without, anchor=None)).last
    assert torch.equal(strain(with_anchors), expected)
    assert float((strain(without) - expected).abs().max()) > 0.1 * float(expected.abs().max())


@pytest.mark.parametrize("sliding", [True, False])
@pytest.mark.parametrize("terms", [None, ("stretch", "bending", "shear", "wind", "pins", "applied")])
def test_a_rollout_goes_on_where_a_simulator_is(sliding: bool, terms: tuple[str, ...] | None) -> None:
    full = scene(6)
    moved = {"pin_path": full.pin_path, "forces": {7: full.force_path[:-1, 0], 12: full.force_path[0, 1]}}
    one = wy.Scene(full.cloth, wind=WIND, pins=full.pins, pin_stiffness=100.0, sliding=sliding, terms=terms, **moved)
    simulator = wy.Simulator(one, **EXACT)
    simulator.run(2)
    frames = wt.Rollout(one, 4, **EXACT)(state=simulator.state, steps_done=simulator.steps_done)
    expected = simulator.run(4)
    for name, values in zip(FIELDS, frames, strict=True):
        assert np.array_equal(values.numpy(), getattr(expected, name)), name
    # and back
    simulator.state = wy.State(*(x.numpy() for x in vars(frames.last).values()))
    assert np.array_equal(simulator.run(1).position[0], expected.position[-1])


def test_gradient_of_a_closed_loop() -> None:
    """A policy that pulls by where the cloth is: its gain acts through every state that is handed on."""
    rollout = wt.Rollout(scene_for("forces", 2), 2, frames=[2], **EXACT)
    start, rest = jittered(rollout.scene.cloth, size=0.2), torch.tensor(rollout.scene.cloth.position)

    def function(gain: torch.Tensor) -> torch.Tensor:
        frames = rollout(**start)
        for k in (1, 2):
            pull = gain[k - 1] * (rest - frames.position[-1])[[7, 12]]
            forces = pull.expand(rollout.inputs["forces"])
            frames = rollout(state=frames.last, steps_done=2 * k, forces=forces)
        return (frames.position[-1] - rest) / 1e-4

    assert gradcheck(function, [torch.tensor([0.5, 2.0], dtype=torch.float64, requires_grad=True)])


@pytest.mark.parametrize("options", [{"sliding": False}, {"terms": ("stretch", "bending", "shear")}])
def test_what_a_scene_does_not_have_is_repeated_and_so_is_its_gradient(options: dict[str, Any]) -> None:
    one = wy.Scene(cloth(4, 4), gravity=None, **options)
    rollout = wt.Rollout(one, 3, frames=[0, 2, 3])
    anchor = (rollout.defaults["anchor"] + 1e-5).requires_grad_()
    rates = rollout.defaults["euler_velocity"].requires_grad_()
    frames = rollout(anchor=anchor, euler_velocity=rates)
    assert torch.equal(frames.anchor, anchor.detach().expand(3, -1, -1))
    weights = torch.tensor([1.0, 10.0, 100.0], dtype=torch.float64)[:, None, None]
    loss = (weights * frames.anchor).sum() + (weights * frames.euler_velocity).sum()
    of_anchor, of_rates = torch.autograd.grad(loss, [anchor, rates])
    assert torch.equal(of_anchor, torch.full_like(anchor, 111.0))
    if not one.sliding:
        crossing = torch.tensor(one.cloth.topology.is_crossing)[:, None]
        assert torch.equal(of_rates, 111.0 * crossing * torch.ones_like(rates))


# -- what is the caller's, and copies ---------------------------------------------------------------------------------


@pytest.mark.parametrize("every", [1, 2])
def test_what_is_changed_in_place_before_backward_turns_no_gradient(every: int) -> None:
    rollout = wt.Rollout(scene(), STEPS, checkpoint_every=every)

    def gradients(change: bool) -> list[torch.Tensor]:
        array = jittered(rollout.scene.cloth, size=0.2)["position"].numpy()
        position = torch.from_numpy(array).requires_grad_()
        velocity = rollout.defaults["velocity"].numpy()
        shear = torch.tensor(900.0, dtype=torch.float64, requires_grad=True)
        frames = rollout(position=position, velocity=velocity, shear=shear)
        loss = (frames.position[-1] * 1e3).square().sum()
        if change:
            for values in frames:
                values.detach().numpy()[:] = 7.0
            array[:] = 7.0
            velocity[:] = 7.0
            shear.data.fill_(7.0)
            for value in rollout.defaults.values():
                value.fill_(7.0)
        return list(torch.autograd.grad(loss, [position, shear]))

    expected = gradients(False)
    # torch can notice none of these changes
    assert same(gradients(True), expected)
    frames = rollout()
    kept = [x.clone() for x in frames]
    rollout(shear=2000.0)
    assert same(list(frames), kept)


def saved_and_loaded(value: Any) -> Any:
    buffer = io.BytesIO()
    torch.save(value, buffer)
    buffer.seek(0)
    return torch.load(buffer, weights_only=False)


COPIES = [copy.copy, copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x)), saved_and_loaded]


@pytest.mark.parametrize("made", COPIES)
def test_copies_of_a_rollout_answer_as_it_does(made: Callable) -> None:
    rollout = wt.Rollout(
        scene(), 4, frames=[1, 4], checkpoint_every=2, integrator="linear", step=5e-4, device=wp.get_device("cpu")
    )
    call = Call.draw(rollout, np.random.default_rng(2))
    call = dataclasses.replace(call, wanted=tuple(call.inputs))
    expected = call.answer(rollout)
    other = made(rollout)
    assert same(call.answer(other), expected) and same(call.answer(rollout), expected)
    assert other.simulator is not rollout.simulator and other.inputs == rollout.inputs
    assert (other.steps, list(other.frames), other.simulator.step_size) == (4, [1, 4], 5e-4)


@pytest.mark.parametrize("made", COPIES[1:])
def test_copies_of_a_fabric_learn_on_their_own(made: Callable) -> None:
    fabric = wt.Fabric(scene(), STEPS, learn=LEARN, initial={"friction": 0.7})
    fabric().position[-1].sum().backward()
    other = made(fabric)
    assert other.ranges == fabric.ranges
    before = fabric().position.detach()
    assert torch.equal(other().position, before)
    other.set("stretch", 9e5)
    assert torch.equal(fabric().position, before) and not torch.equal(other().position, before)


def test_an_averaged_fabric() -> None:
    fabric = wt.Fabric(scene(), STEPS, learn=LEARN)
    averaged = torch.optim.swa_utils.AveragedModel(fabric)
    for friction in (0.4, 0.8):
        fabric.set("friction", friction)
        averaged.update_parameters(fabric)
    y = averaged.module.y["friction"].item()
    assert y == pytest.approx(0.5 * (np.log(0.4 / 1.6) + np.log(0.8 / 1.2)), rel=1e-12)
    friction = torch.tensor(2.0 / (1.0 + np.exp(-y)))
    assert torch.allclose(averaged().position, fabric.rollout(friction=friction).position, rtol=0.0, atol=1e-15)
