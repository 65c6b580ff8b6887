"""What one call of a Rollout or a Fabric leaves for the next: nothing but what is handed on."""

from __future__ import annotations

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
from test_gradients import WIND, cloth, gradcheck, jittered, scaled, scene_for

import warp_yarn as wy
import warp_yarn.torch as wt
from warp_yarn.integrators import INTEGRATORS
from warp_yarn.state import FIELDS

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


def random_inputs(rollout: wt.Rollout, random: np.random.Generator) -> dict[str, torch.Tensor]:
    """A few of the inputs, near the scene's own values."""
    names = [name for name in rollout.inputs if not name.startswith("yarn_")]
    start = {**rollout.defaults, **jittered(rollout.scene.cloth, size=0.3)}
    inputs = {}
    for name in random.choice(names, random.integers(1, 5), replace=False):
        if name in ("density", "stretch", "bend"):
            values = [getattr(yarn, name) for yarn in rollout.scene.cloth.yarns]
        else:
            values = start[name].numpy()
        inputs[str(name)] = torch.tensor(np.asarray(values) * random.uniform(0.99, 1.01))
    if "euler" in inputs:
        inputs["euler"] = start["euler"].clone()  # scaled, crossings would leave their yarns' ends
    return inputs


@dataclasses.dataclass
class Call:
    """A call, and which of its inputs a gradient is asked for."""

    inputs: dict[str, torch.Tensor]
    wanted: list[str]
    weights: tuple[torch.Tensor, ...]

    @classmethod
    def draw(cls, rollout: wt.Rollout, random: np.random.Generator) -> Call:
        inputs = random_inputs(rollout, random)
        wanted = [name for name in inputs if random.random() < 0.7]
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


def disturb(rollout: wt.Rollout, random: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Something that ends in an error, or that somebody does with the simulator within."""
    kind = random.integers(6)
    if kind == 0:
        with pytest.raises(wy.InputError):
            rollout(friction=-1.0, shear=3000.0, position=rollout.defaults["position"] + 1.0)
    elif kind == 1:
        with pytest.raises(wy.InputError, match="Δs"):  # found after the parameters were put in place
            rollout(shear=3000.0, gravity=torch.ones(3), euler=rollout.defaults["euler"].flip(0))
    elif kind == 2:
        velocity = torch.full(rollout.inputs["velocity"], 1e200, dtype=torch.float64)
        velocity[3] = -1e200
        with pytest.raises(wy.SimulationError):
            rollout(velocity=velocity, friction=torch.tensor(0.1, requires_grad=True))
    elif kind == 3:
        gravity = torch.zeros(3, requires_grad=True)
        frames = rollout(gravity=gravity)
        with pytest.raises(wy.GradientError):
            (frames.velocity[-1] * float("inf")).sum().backward()
    elif kind == 4:
        name = str(random.choice(["advance", "retreat", "set_times", "prepare_adjoint"]))
        left, real = [random.integers(4)], getattr(rollout.simulator.integrator, name)

        def interrupted(*arguments: Any) -> Any:
            left[0] -= 1
            if left[0] < 0:
                raise KeyboardInterrupt
            return real(*arguments)

        with monkeypatch.context() as patch:
            patch.setattr(rollout.simulator.integrator, name, interrupted)
            try:
                Call.draw(rollout, random).answer(rollout)
            except KeyboardInterrupt:
                pass
    else:
        rollout.simulator.energy()
        rollout.simulator.run(2)
        rollout.simulator.forces()


def check_sequence(rollout: wt.Rollout, fresh: Callable[[], wt.Rollout], seed: int, patch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(seed)
    pending = None
    for k in range(30):
        kind = random.random()
        if kind < 0.25:
            disturb(rollout, random, patch)
            continue
        call = Call.draw(rollout, random)
        steps_done = int(random.integers(3))
        expected = call.answer(fresh(), steps_done=steps_done)
        if kind < 0.35 and pending is None:  # its backward pass comes after other calls
            pending = call, call.begin(rollout, steps_done=steps_done), expected
        elif kind < 0.42:
            with torch.no_grad():
                assert same(list(call.begin(rollout, steps_done=steps_done)[0]), expected[:5]), (seed, k)
        else:
            assert same(call.answer(rollout, steps_done=steps_done), expected), (seed, k)
        if pending is not None and random.random() < 0.3:
            earlier, begun, expected = pending
            assert same(earlier.end(*begun), expected), (seed, k)
            pending = None


@pytest.mark.parametrize("method", INTEGRATORS)
def test_a_rollout_answers_as_a_fresh_one(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fresh() -> wt.Rollout:
        return wt.Rollout(scene(), STEPS, integrator=method, checkpoint_every=2)

    check_sequence(fresh(), fresh, 17, monkeypatch)
