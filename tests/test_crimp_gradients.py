"""Gradients through the heights that crimp interchange finds, and of runs with its forces."""

import functools

import numpy as np
import pytest
import torch
from crimped import cloth
from inputs import EXACT, gradcheck
from richardson import richardson

import warp_yarn as wy
import warp_yarn.torch as wt

OPTIONS = {"interchange": {"crimp_interchange": True}, "crimped": {"contact_force": "crimped"}}


@pytest.mark.slow
@pytest.mark.parametrize("sliding", [False, True])
@pytest.mark.parametrize("method", ["linear", "sdirk2"])
@pytest.mark.parametrize("option", OPTIONS)
def test_gradcheck(option: str, method: str, sliding: bool) -> None:
    """Of two steps by the yarns' stiffness and the state. The linear method differentiates the matrix too, with the
    derivative of the height there."""
    # damped more than the other cases: breaking away is too sharp for differences
    c = cloth("plain").replace(friction_damping=10.0)
    scene = wy.Scene(c, pins=c.corners("top"), pin_stiffness=100.0, sliding=sliding, **OPTIONS[option])
    rollout = wt.Rollout(scene, 2, frames=[2], integrator=method, tolerance=EXACT)
    rng = np.random.default_rng(3)
    inside = (c.topology.is_crossing != 0)[:, None]
    start = [
        (torch.tensor([yarn.stretch for yarn in c.yarns], dtype=torch.float64), 1e5),
        (torch.tensor([yarn.bend for yarn in c.yarns], dtype=torch.float64), 1e-4),
        (torch.tensor(c.position + 2e-5 * rng.standard_normal((c.nodes, 3))), 1e-4),
    ]
    names = ["stretch", "bend", "position"]
    if sliding:
        start.append((torch.tensor(c.euler + 1e-5 * inside * rng.standard_normal((c.nodes, 2))), 1e-4))
        names.append("euler")

    def function(*inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:
        scaled = {name: x * scale for name, x, (_, scale) in zip(names, inputs, start, strict=True)}
        frames = rollout(**scaled)
        return frames.position / 1e-4, frames.velocity / 0.1

    assert gradcheck(function, [(value / scale).requires_grad_() for value, scale in start])


DISTANCE, CRIMP, STRETCH, BEND = 0.5e-3, 0.05, 50.0, 1e-9


@functools.cache
def strip(force: float) -> wt.Rollout:
    """A strip of 5 × 7 nodes that is held at its left end, and pulled at every warp yarn of its right end, for so long
    that it comes to rest: ten steps of 10 ms of implicit Euler, which take its motion away."""
    radius = 0.5 * wy.crimp_height(DISTANCE, DISTANCE * (1.0 + CRIMP))
    area = np.pi * radius**2
    c = wy.Cloth(
        wy.Weave.plain(rows=5, columns=7),
        yarns=[wy.Yarn(density=2e-5, stretch=STRETCH / area, bend=BEND / area)],
        spacing=DISTANCE,
        radius=radius,
        crimp=CRIMP,
        pose="flat",
    )
    left, right = ([c.node(row, column) for row in range(5)] for column in (0, -1))
    forces = {node: (force, 0.0, 0.0) for node in right[1:-1]}
    scene = wy.Scene(
        c, gravity=None, pins=left, forces=forces, sliding=False, crimp_interchange=True,
        terms=["crimp_interchange", "pins", "applied"],
    )  # fmt: skip
    return wt.Rollout(scene, 10, frames=[10], integrator="implicit-euler", step=1e-2, newton_tolerance=1e-10)


def strain(rollout: wt.Rollout, stretch: torch.Tensor, bend: torch.Tensor) -> torch.Tensor:
    """Of the middle warp yarn, by kₛ [N] and k_b [N m²]."""
    c = rollout.scene.cloth
    area = np.pi * c.radius**2
    x = rollout(stretch=(stretch / area).reshape(1), bend=(bend / area).reshape(1)).position[-1]
    return (x[c.node(2, -1), 0] - x[c.node(2, 0), 0]) / (6 * DISTANCE) - 1.0


@pytest.mark.slow
@pytest.mark.parametrize("force", [0.01, 0.05, 0.3])
def test_tensile_curve(force: float) -> None:
    """Before the knee, at it, and beyond, by what bends the yarns and by what stretches them."""
    rollout = strip(force)
    values = {"stretch": STRETCH, "bend": BEND}
    inputs = {name: torch.tensor(value, dtype=torch.float64, requires_grad=True) for name, value in values.items()}
    result = strain(rollout, **inputs)
    result.backward()
    for name, value in values.items():

        def at(x: float, name: str = name) -> float:
            given = {other: torch.tensor(y, dtype=torch.float64) for other, y in values.items()}
            with torch.no_grad():
                return float(strain(rollout, **{**given, name: torch.tensor(x, dtype=torch.float64)}))

        expected, doubt = richardson(at, value, value)
        assert doubt < 1e-6 * abs(expected)
        assert abs(float(inputs[name].grad) - expected) < 1e-6 * abs(expected)
    # soft before the knee, where bending decides, and stiff beyond
    by_bend, by_stretch = (float(inputs[name].grad) * value for name, value in (("bend", BEND), ("stretch", STRETCH)))
    assert (abs(by_bend) > abs(by_stretch)) == (force < 0.1)
