"""Every input that a run takes, in groups; scenes, states and runs to differentiate by them."""

from collections.abc import Callable

import numpy as np
import torch

import warp_yarn as wy
import warp_yarn.torch as wt

YARNS = [wy.Yarn(density=2.0e-3, stretch=5.0e5, bend=1.4e-4), wy.Yarn(density=2.5e-3, stretch=1.7e5, bend=1.1e-4)]
WIND = wy.Wind(velocity=(0.3, 5.0, -0.2))
EXACT = 1e-14
"""Solver tolerance where digits count: the solve then ends at rounding."""


def cloth(rows: int = 4, columns: int = 5, weave: str = "plain", **options: float) -> wy.Cloth:
    return wy.Cloth(wy.WEAVES[weave](rows=rows, columns=columns), yarns=YARNS, **options)


def jittered(cloth: wy.Cloth, sliding: bool = True, size: float = 1.0) -> dict[str, torch.Tensor]:
    """A state away from every kink: bent, sheared, stretched and slack, moving and sliding; size 1 is violent."""
    random = np.random.default_rng(3)
    crossing = (cloth.topology.is_crossing != 0)[:, None]
    nodes = cloth.nodes
    state = {
        "position": cloth.position + size * 1e-4 * random.standard_normal((nodes, 3)),
        "velocity": size * 0.05 * random.standard_normal((nodes, 3)),
    }
    if sliding:
        state["euler"] = cloth.euler + size * 5e-5 * crossing * random.standard_normal((nodes, 2))
        state["euler_velocity"] = size * 0.01 * crossing * random.standard_normal((nodes, 2))
        state["anchor"] = state["euler"] + size * 2e-8 * random.standard_normal((nodes, 2))
    return {name: torch.tensor(value) for name, value in state.items()}


def scaled(rollout: wt.Rollout, names: tuple[str, ...], fixed: dict[str, torch.Tensor]) -> tuple[Callable, list]:
    """A run as a function of inputs near 1, so that one difference step suits them all, and those inputs."""
    shapes = rollout.inputs
    start, scales = [], []
    for name in names:
        value = fixed.get(name)
        if value is None and name in ("density", "stretch", "bend"):
            value = torch.tensor([getattr(yarn, name) for yarn in rollout.scene.cloth.yarns], dtype=torch.float64)
        elif value is None and name in rollout.of_crossings:
            value = torch.tensor(np.array(getattr(rollout.scene.cloth, name)))
        elif value is None:
            value = rollout.defaults[name.removeprefix("yarn_").removeprefix("node_")]
        scale = {"euler": 1e-4, "anchor": 1e-7, "position": 1e-4, "velocity": 0.1, "euler_velocity": 0.01}.get(
            name, float(value.abs().max()) or 1.0
        )
        assert tuple(value.shape) == shapes[name]
        start.append((value / scale).detach().clone().requires_grad_())
        scales.append(scale)

    def function(*inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:
        given = {name: x * scale for name, x, scale in zip(names, inputs, scales, strict=True)}
        frames = rollout(**{**fixed, **given})
        scales_of_frames = (1e-4, 1e-4, 0.1, 0.01, 1e-4)
        return tuple(values / scale for values, scale in zip(frames, scales_of_frames, strict=True))

    return function, start


GROUPS = {
    "materials": ("density", "stretch", "bend"),
    "every yarn": ("yarn_density", "yarn_stretch", "yarn_bend"),
    "crossings": (
        "shear", "friction", "friction_stiffness", "friction_damping", "friction_sharpness", "parallel_stiffness",
    ),
    "surroundings": ("gravity", "wind_velocity", "wind_density", "wind_drag"),
    "forces": ("forces", "pin_stiffness", "pin_path"),
    # friction's anchors go with (u, v) here, as at the start of a run; alone, they are a group of their own
    "initial state": ("position", "euler", "velocity", "euler_velocity"),
    "anchors": ("anchor",),
}  # fmt: skip


def scene_for(group: str, steps: int, *, sliding: bool = True, stiffness: float | None = 100.0) -> wy.Scene:
    # Damping far under the paper's, so that friction decides how far yarns slide and its gradients are above rounding.
    fabric = cloth(friction_damping=0.1)
    random = np.random.default_rng(5)
    options = {}
    if group in ("forces", "exact pins"):
        pins = fabric.corners("top")
        options["pin_path"] = fabric.position[pins] + 1e-4 * random.standard_normal((steps, 2, 3))
        options["forces"] = {7: 1e-4 * random.standard_normal((max(steps - 1, 1), 3)), 12: 1e-4 * np.ones(3)}
    return wy.Scene(fabric, wind=WIND, pins=fabric.corners("top"), pin_stiffness=stiffness, sliding=sliding, **options)


def colliding(speed: float) -> tuple[wy.Scene, wy.State]:
    """Two crossings of a yarn that hardly resists sliding fly at each other, on a falling cloth."""
    fabric = cloth(4, 4, radius=2.4e-4, friction=0.0, friction_damping=1e-3)
    rates = np.zeros((fabric.nodes, 2))
    rates[5, 0], rates[6, 0] = speed, -speed
    return wy.Scene(fabric), wy.State(fabric.position, fabric.euler, np.zeros((fabric.nodes, 3)), rates)


def gradcheck(function: Callable, inputs: list[torch.Tensor]) -> bool:
    # On numbers near 1, a difference step of 1e-6 leaves some 1e-6 of rounding and (seen by varying it) of curvature.
    return torch.autograd.gradcheck(function, inputs, eps=1e-6, atol=1e-5, rtol=1e-5)
