"""States in which lengths are 0 and directions undefined: forces, matrix and gradients stay finite, and push back."""

import dataclasses
import functools
from collections.abc import Callable

import numpy as np
import pytest
import torch
from cases import YARNS, scene
from checks import check_definite

import warp_yarn as wy
import warp_yarn.torch as wt

SIZE = 5


def pair(x: np.ndarray) -> None:
    """Two crossings of a yarn at one place."""
    x[2, 2] = x[2, 1]


def four(x: np.ndarray) -> None:
    """A crossing and all its neighbours at one place."""
    x[2, 1] = x[2, 3] = x[1, 2] = x[3, 2] = x[2, 2]


def yarn(x: np.ndarray) -> None:
    """A whole yarn at one place."""
    x[2] = x[2, 2]


def point(x: np.ndarray) -> None:
    """The whole cloth at one place."""
    x[:] = x[2, 2]


def line(x: np.ndarray) -> None:
    """All of it on a line: every corner of 0 or π."""
    x[..., 1:] = 0.0


def folded(x: np.ndarray) -> None:
    """Every warp yarn turns back onto itself: flat folds, and crossings whose warp neighbours are at one place."""
    x[:, 3] = x[:, 1]
    x[:, 4] = x[:, 0]


def shut(x: np.ndarray) -> None:
    """Sheared until weft runs along warp: corners of 0 and of π, everywhere."""
    rows = np.arange(SIZE)[:, None]
    x[..., 0] += x[0, 1, 0] * 1.0 * rows
    x[..., 1] = 0.0


def inside_out(x: np.ndarray) -> None:
    """The cells of one row turned over."""
    x[2], x[3] = x[3].copy(), x[2].copy()


STATES = {f.__name__: f for f in (pair, four, yarn, point, line, folded, shut, inside_out)}


def state(name: str, cloth: wy.Cloth) -> wy.State:
    x = cloth.position.reshape(SIZE, SIZE, 3).copy()
    STATES[name](x)
    still = np.zeros((cloth.nodes, 3))
    return wy.State(x.reshape(-1, 3), cloth.euler, still, still[:, :2])


@functools.cache
def simulator(precision: str) -> wy.Simulator:
    return wy.Simulator(scene("plain", None), precision=precision)


@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("name", STATES)
def test_finite(name: str, precision: str) -> None:
    """Forces, energies, contact and matrix."""
    sim = simulator(precision)
    at = state(name, sim.scene.cloth)
    for term, parts in sim.forces(at).items():
        assert all(np.isfinite(part).all() for part in parts), term
    assert np.isfinite(list(sim.energy(at).values())).all()
    assert all(np.isfinite(part).all() for part in sim.contact(at))
    system = sim.system(at)
    assert np.isfinite(system.rhs).all()
    a = system.dense()
    assert np.isfinite(a).all()
    if precision == "double":
        check_definite(a)


@pytest.mark.parametrize("name", STATES)
def test_gradient_is_finite(name: str) -> None:
    """Of a step of eq. 2, by the state and the materials."""
    rollout = degenerate_rollout()
    at = state(name, rollout.scene.cloth)
    inputs = {key: torch.tensor(getattr(at, key), requires_grad=True) for key in ("position", "euler", "velocity")}
    inputs |= {
        key: rollout.defaults[key.removeprefix("yarn_")].clone().requires_grad_()
        for key in ("yarn_stretch", "yarn_bend", "shear")
    }
    frames = rollout(**inputs)
    sum(part.square().sum() for part in frames).backward()
    for key, value in inputs.items():
        assert torch.isfinite(value.grad).all(), key


@functools.cache
def degenerate_rollout() -> wt.Rollout:
    return wt.Rollout(scene("plain", None), 1, integrator="linear")


# -- pushing back ----------------------------------------------------------------------------------------------------


@functools.cache
def three(term: str) -> wy.Simulator:
    """3 × 3 nodes, one crossing that can jam; of the yarns the middle warp yarn alone is stiff."""
    weave = wy.Weave([[0, 0, 0], [0, 1, 0], [0, 0, 0]])
    yarns = [YARNS[0], dataclasses.replace(YARNS[0], stretch=0.0, bend=0.0)]
    cloth = wy.Cloth(weave, yarns=yarns, warp=[1, 0, 1], weft=[1, 1, 1], pose="flat")
    return wy.Simulator(wy.Scene(cloth, terms=[term]))


def moved(term: str, place: Callable[[np.ndarray, float], None]) -> tuple[wy.Simulator, wy.State]:
    sim = three(term)
    at = sim.state
    x = at.position.reshape(3, 3, 3)
    place(x, sim.scene.cloth.spacing)
    return sim, dataclasses.replace(at, position=x.reshape(-1, 3))


@pytest.mark.parametrize("length", [1e-1, 1e-2, 1e-4, 1e-8, 1e-12])
def test_a_collapsed_segment_is_pushed_apart(length: float) -> None:
    """By kₛ (1 − l/L), to the last."""

    def place(x: np.ndarray, spacing: float) -> None:
        # a coordinate of 0 keeps full precision
        x[1, :, 0] = [-spacing, 0.0, length * spacing]

    sim, at = moved("stretch", place)
    force, _ = sim.forces(at)["stretch"]
    stiffness = YARNS[0].stretch * np.pi * sim.scene.cloth.radius**2
    assert force[5, 0] == pytest.approx(stiffness * (1.0 - length), rel=1e-12)


@pytest.mark.parametrize("term", ["bending", "shear"])
@pytest.mark.parametrize("turn", [0.3, 1.5, 3.0])
def test_directions_fade_out(term: str, turn: float) -> None:
    """Where a segment collapses its ends are never drawn together, and the force on them goes to 0 with the square of
    its length, so that there is no jump where they pass each other."""
    sizes = []
    lengths = (0.1, 0.05, 1e-2, 1e-4, 1e-6)
    for length in lengths:

        def place(x: np.ndarray, spacing: float, length: float = length) -> None:
            x -= x[1, 1]
            x[1, 2] = length * spacing * np.array([np.cos(turn), np.sin(turn), 0.0])

        sim, at = moved(term, place)
        force, _ = sim.forces(at)[term]
        sizes.append(np.linalg.norm(force[5]))
        assert force[5] @ [np.cos(turn), np.sin(turn), 0.0] >= -1e-12 * sizes[-1]
    # s/l and s' are 10 x² and 30 x² to within 2 x of themselves
    ratio = np.array(sizes[3:]) / np.array(lengths[3:]) ** 2
    assert ratio[1] == pytest.approx(ratio[0], rel=1e-2)


@pytest.mark.parametrize("phi", [1e-1, 1e-3, 1e-6, np.pi - 1e-6, np.pi - 1e-3])
def test_a_corner_sheared_flat_opens(phi: float) -> None:
    """With a force towards the right angle that does not give way as it shuts."""

    def place(angle: float) -> tuple[wy.Simulator, wy.State]:
        def corner(x: np.ndarray, spacing: float) -> None:
            x[1, 1] = 0.0
            x[1, [0, 2]] = [spacing, 0.0, 0.0]
            x[[0, 2], 1] = [spacing * np.cos(angle), spacing * np.sin(angle), 0.0]

        return moved("shear", corner)

    def opening(angle: float) -> float:
        sim, at = place(angle)
        return float(sim.forces(at)["shear"][0][1] @ [-np.sin(angle), np.cos(angle), 0.0])

    nearer = 0.5 * (phi + (0.0 if phi < 1.5 else np.pi))
    sign = 1.0 if phi < 1.5 else -1.0
    # at 0 and π its slope is 0 at most: eq. 5's lock is there at its highest
    assert sign * opening(nearer) > 0.999 * sign * opening(phi) > 0.0
