"""Motions of cloths whose yarns straighten at each other's expense."""

import warnings

import numpy as np
import pytest
from checks import matrix

import warp_yarn as wy
from warp_yarn.presets.named import NamedFabric


def cotton(crimp: float | None = None, weave: str = "plain", size: int = 6) -> wy.Cloth:
    """Of yarns as thick as they are crimped, or of another crimp, which pulls the cloth together or lets it out."""
    distance, diameter = 1.0 / 2300.0, 1.6e-4
    if crimp is None:
        crimp = float(np.sqrt(1.0 + 9.0 / 8.0 * (diameter / distance) ** 2) - 1.0)
    return wy.fabrics.cotton(rows=size, columns=size, weave=weave, pose="flat", crimp=crimp)


def momentum(sim: wy.Simulator, state: wy.State) -> np.ndarray:
    """Of all nodes, with what sliding yarns carry."""
    n = len(state.position)
    rates = np.concatenate([state.velocity.ravel(), state.euler_velocity.ravel()])
    mass = matrix(sim, state, mass=1.0)
    return (mass @ rates[: len(mass)])[: 3 * n].reshape(n, 3).sum(axis=0)


@pytest.mark.parametrize("sliding", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_at_rest_it_stays_at_rest(sliding: bool) -> None:
    c = cotton()
    frames = wy.Simulator(wy.Scene(c, gravity=None, sliding=sliding, crimp_interchange=True)).run(5)
    assert np.abs(frames.position[-1] - frames.position[0]).max() < 1e-12 * c.spacing * 1e3


@pytest.mark.slow
@pytest.mark.parametrize("sliding", [False, True])
@pytest.mark.parametrize("weave", ["plain", "twill"])
def test_thrown_it_keeps_its_momentum(weave: str, sliding: bool) -> None:
    """And gains no energy."""
    c = cotton(weave=weave)
    sim = wy.Simulator(wy.Scene(c, gravity=None, sliding=sliding, crimp_interchange=True), newton_tolerance=1e-6)
    state = sim.state
    turning = np.cross([20.0, 5.0, 8.0], state.position - state.position.mean(axis=0))
    state.velocity[:] = turning + np.array([0.3, 0.1, -0.2])
    sim.state = state
    before, energy = momentum(sim, sim.state), sum(sim.energy().values())
    sim.run(10)
    # what Newton's iteration leaves, in every step
    assert np.abs(momentum(sim, sim.state) - before).max() < 1e-6 * np.abs(before).max()
    assert sum(sim.energy().values()) < (1.0 + 1e-6) * energy


@pytest.mark.slow
def test_yarns_too_thick_for_their_crimp_draw_the_cloth_in() -> None:
    """And yarns that are longer than goes with their thickness let it out, to where h₁ + h₂ = d₁ + d₂ and nothing
    pulls: p = √(l² − β² h²)."""
    for crimp in (0.05, 0.09):
        c = cotton(crimp)
        scene = wy.Scene(c, gravity=None, sliding=False, crimp_interchange=True, terms=["crimp_interchange"])
        sim = wy.Simulator(scene, integrator="implicit-euler", step=1e-2)
        sim.run(40)
        middle = [c.node(2, 2), c.node(2, 3)]
        found = np.linalg.norm(np.diff(sim.state.position[middle], axis=0))
        expected = np.sqrt((c.spacing * (1.0 + crimp)) ** 2 - 9.0 / 8.0 * 1.6e-4**2)
        assert (found < c.spacing) == (crimp < 0.07)
        # crimp's own bending keeps some of it as woven, where the yarn is a thousand times softer across
        assert abs(found / expected - 1.0) < 0.005


@pytest.mark.parametrize("name", ["kevlar_s706", "denim"])
def test_eq_2_gains_no_energy_where_yarns_slide(name: str) -> None:
    """Of one matrix a step, which is not exact then: less than the exact one would gain some, thrown and spun."""
    c = getattr(wy.fabrics, name)(rows=6, columns=6, pose="flat").pressed()
    sim = wy.Simulator(wy.Scene(c, gravity=None, crimp_interchange=True), integrator="linear")
    state = sim.state
    state.velocity[:] = np.cross([20.0, 5.0, 8.0], state.position - state.position.mean(axis=0))
    sim.state = state
    energy = sum(sim.energy().values())
    sim.run(20)
    assert sum(sim.energy().values()) < energy


def test_eq_2_is_the_same_after_relaxing() -> None:
    """Which iterates, and leaves at what evaluation it was."""
    c = cotton()
    scene = wy.Scene(c, pins=c.corners("top"), crimp_interchange=True)
    sim, fresh = (wy.Simulator(scene, integrator="linear") for _ in range(2))
    for residual in (1e-5, 3e-6, 1e-6):
        sim.relax(residual=residual)
        fresh.state = sim.state
        assert sim.run(2) == fresh.run(2)


def test_ros2_is_refused_where_yarns_slide() -> None:
    scene = wy.Scene(cotton(), crimp_interchange=True)
    with pytest.raises(wy.InputError, match=r"integrator = 'ros2' with crimp_interchange and sliding.*sliding=False"):
        wy.Simulator(scene, integrator="ros2")
    wy.Simulator(scene.replace(sliding=False), integrator="ros2").run(2)


CRIMPED = [
    name for name, made in vars(wy.fabrics).items() if isinstance(made, NamedFabric) and made.crimp != (0.0, 0.0)
]


@pytest.mark.parametrize("name", CRIMPED)
def test_named_fabrics_that_are_pressed_stay_as_they_are_woven(name: str) -> None:
    """Their yarns are mostly thicker than they rise: as they are such a cloth draws in at once."""
    loose = getattr(wy.fabrics, name)(rows=6, columns=6, pose="flat")
    c = loose.pressed()
    assert c.mass == loose.mass
    np.testing.assert_allclose(c.stretch_stiffness, loose.stretch_stiffness, rtol=1e-14)
    np.testing.assert_allclose(c.halves[:, 0], loose.halves[:, 0], rtol=1e-14)
    rise = c.halves[:, 1] / loose.halves[:, 1]
    np.testing.assert_allclose(rise, rise[0], rtol=1e-12)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = wy.Scene(c, gravity=None, sliding=False, crimp_interchange=True)
    sim = wy.Simulator(scene, integrator="implicit-euler")
    # of the pull that a hundredth of strain takes
    size = 1e-2 * c.stretch_stiffness.max()
    assert np.abs(sim.forces()["crimp_interchange"][0]).max() < 1e-10 * size
    sim.run(3)
    assert np.abs(sim.state.position - c.position).max() < 1e-9 * c.shortest_spacing
    if 0.8 <= rise[0] <= 1.25:
        return
    with pytest.warns(
        wy.WarpYarnWarning, match=r"yarns of the cloth rise .* times their thicknesses.*cloth.pressed\(\)"
    ):
        pulled = wy.Simulator(scene.replace(cloth=loose)).forces()["crimp_interchange"][0]
    assert np.abs(pulled).max() > 1e-5 * size
    with pytest.warns(wy.WarpYarnWarning, match=r"yarns of cloths\[1\] rise"):
        wy.Scene([c, loose], crimp_interchange=True)


@pytest.mark.parametrize("name", ["denim", "silk_satin"])
def test_what_is_cut_is_pressed_alike(name: str) -> None:
    """Free ends, of whatever length, are no part of what their yarns rise over."""
    fabric = getattr(wy.fabrics, name)
    outline = wy.outline.disc(5.0 * max(fabric.spacing))
    c = wy.piece(fabric, outline, pose="flat").pressed()
    before = wy.piece(lambda **options: fabric(**options).pressed(), outline, pose="flat")
    np.testing.assert_allclose(c.halves, before.halves, rtol=1e-12)
    sim = wy.Simulator(wy.Scene(c, gravity=None, sliding=False, crimp_interchange=True))
    size = 1e-2 * c.stretch_stiffness.max()
    assert np.abs(sim.forces()["crimp_interchange"][0]).max() < 1e-10 * size


def test_pressed_needs_crimp() -> None:
    plain = wy.fabrics.cotton(rows=5, columns=5)
    with pytest.raises(wy.InputError, match="pressed: the cloth has no crimp, must be above 0"):
        plain.pressed()
    with pytest.raises(wy.InputError, match=r"crimp_interchange = True, but cloths\[1\] has no crimp"):
        wy.Scene([cotton(), plain], crimp_interchange=True)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["implicit-euler", "sdirk2", "implicit-midpoint", "linear"])
def test_methods_agree(method: str) -> None:
    """On a cloth that hangs and swings, at steps of 0.1 ms."""
    c = cotton()

    def end(method: str, step: float) -> np.ndarray:
        scene = wy.Scene(c, pins=c.corners("top"), sliding=False, crimp_interchange=True)
        return wy.Simulator(scene, integrator=method, step=step).run(round(5e-3 / step)).position[-1]

    finest = end("sdirk2", 2.5e-5)
    moved = np.abs(finest - c.position).max()
    assert np.abs(end(method, 1e-4) - finest).max() < 0.05 * moved
