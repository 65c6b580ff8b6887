"""The step of eq. 2 against a dense solve, closed forms, conservation and its order."""

import functools

import numpy as np
import pytest
from cases import CLOTHS, make_state, simulator

import warp_yarn as wy

YARNS = (wy.paper.YARNS[1], wy.paper.YARNS[2])
ROUNDING = 1e-12
"""Of some hundred steps in double precision, relative to the motion."""


def cloth(rows: int, columns: int, **options) -> wy.Cloth:
    """A cloth whose parallel yarns do not touch at rest, so that it is in equilibrium there."""
    return wy.Cloth(wy.Weave.plain(rows=rows, columns=columns), yarns=YARNS, radius=2.4e-4, **options)


@pytest.mark.parametrize("preconditioner", ["incomplete", "jacobi"])
@pytest.mark.parametrize("sliding", [True, False], ids=["sliding", "locked"])
@pytest.mark.parametrize("held", [True, False], ids=["exact pins", "springs"])
@pytest.mark.parametrize("name", CLOTHS)
def test_step_is_a_dense_solve(name: str, held: bool, sliding: bool, preconditioner: str) -> None:
    c = simulator(name, None).scene.cloth
    pins = c.corners("top")
    target = c.position[pins][None] + 1e-5
    scene = wy.Scene(
        c,
        wind=wy.Wind(velocity=(1, 5, 0)),
        pins=pins,
        pin_path=target,
        pin_stiffness=None if held else 1e4,
        sliding=sliding,
    )
    sim = wy.Simulator(scene, integrator="linear", tolerance=1e-14, preconditioner=preconditioner)
    state = make_state(c, "random", sliding)
    sim.state = state
    sim.arrays["pin_target"].assign(target[0])
    system = sim.system()
    matrix, free = system.dense(), system.free
    expected = np.concatenate([state.velocity.ravel(), state.euler_velocity.ravel()])[: len(free)]
    if held:
        expected.reshape(-1)[: 3 * c.nodes].reshape(-1, 3)[pins] = (target[0] - state.position[pins]) / sim.step_size
    known = system.rhs[free] - matrix[np.ix_(free, ~free)] @ expected[~free]
    expected[free] = np.linalg.solve(matrix[np.ix_(free, free)], known)

    after = sim.run(1)[1]
    found = np.concatenate([after.velocity.ravel(), after.euler_velocity.ravel()])[: len(free)]
    # what the issue asks for; conditioning leaves some 1e-13
    assert np.abs(found - expected).max() < 1e-10 * np.abs(expected).max()
    assert np.allclose(after.position, state.position + sim.step_size * after.velocity, rtol=0, atol=1e-18)
    if held:
        assert np.allclose(after.position[pins], target[0], rtol=0, atol=1e-15)


@pytest.mark.parametrize("sliding", [True, False], ids=["sliding", "locked"])
@pytest.mark.parametrize("pose", ["upright", "flat"])
def test_free_fall_is_the_closed_form_of_the_scheme(pose: str, sliding: bool) -> None:
    sim = wy.Simulator(wy.Scene(cloth(4, 6, pose=pose), sliding=sliding), integrator="linear", tolerance=1e-14)
    trajectory = sim.run(100)
    n = np.arange(101)[:, None]
    g, h = 9.8, sim.step_size
    assert np.allclose(trajectory.velocity[..., 2], -g * h * n, rtol=0, atol=ROUNDING)
    fallen = trajectory.position - trajectory.position[0]
    assert np.allclose(fallen[..., 2], -0.5 * g * h * h * n * (n + 1), rtol=0, atol=ROUNDING)
    assert np.abs(fallen[..., :2]).max() < ROUNDING
    assert np.abs(trajectory.euler - trajectory.euler[0]).max() < ROUNDING * sim.scene.cloth.spacing


@pytest.mark.parametrize("weave", wy.WEAVES)
@pytest.mark.parametrize("sliding", [True, False], ids=["sliding", "locked"])
def test_cloth_at_rest_without_gravity_stays(weave: str, sliding: bool) -> None:
    c = wy.Cloth(wy.WEAVES[weave](rows=5, columns=6), yarns=YARNS, radius=2.4e-4)
    trajectory = wy.Simulator(wy.Scene(c, gravity=None, sliding=sliding)).run(100)
    # Grid points i L are not at equal distances in floating point: what is left are rounding errors of stretch.
    assert np.abs(trajectory.position - c.position).max() < 1e-15
    assert np.abs(trajectory.euler - c.euler).max() < 1e-15


def momentum(sim: wy.Simulator, state: wy.State) -> np.ndarray:
    """Σ (M q̇)_x, of the mass matrix at a state [3] (kg m/s)."""
    alone = wy.Scene(sim.scene.cloth, gravity=None, terms=[], sliding=sim.scene.sliding)
    mass = wy.Simulator(alone, integrator="linear").system(state).dense()
    rates = np.concatenate([state.velocity.ravel(), state.euler_velocity.ravel()])[: len(mass)]
    return (mass @ rates)[: state.velocity.size].reshape(-1, 3).sum(axis=0)


def drift(sliding: bool, step: float, steps: int) -> float:
    """Momentum gained in some steps without pins or gravity, over the sum of its nodes' magnitudes."""
    c = cloth(5, 5, friction_damping=0.1)
    scene = wy.Scene(c, gravity=None, sliding=sliding)
    sim = wy.Simulator(scene, step=step, integrator="linear", tolerance=1e-14)
    random = np.random.default_rng(2)
    sim.state = wy.State(c.position, c.euler, random.normal(0.0, 0.1, (c.nodes, 3)), np.zeros((c.nodes, 2)))
    before = sim.state
    after = sim.run(steps)[-1]
    size = np.abs(before.velocity).sum() * 2.0e-6
    return float(np.abs(momentum(sim, after) - momentum(sim, before)).max() / size)


def test_momentum_without_pins() -> None:
    # Locked, the mass matrix is constant and internal forces add up to 0.
    assert drift(False, 1e-3, 20) < ROUNDING
    # Sliding, the mass matrix changes within a step, which eq. 2 follows to first order: a step's error is of second
    # order at least, once the step is short beside the fastest sliding.
    coarse, fine = drift(True, 2e-6, 1), drift(True, 1e-6, 1)
    assert fine > 100.0 * ROUNDING  # there is something to see
    assert coarse / fine > 3.5


@functools.cache
def hung(step: float) -> np.ndarray:
    """Positions of the paper's 5 × 5 cloth after 25 ms."""
    scene = wy.paper.hung_cloth("plain", 5, 5, (1, 2))
    return wy.Simulator(scene, step=step, integrator="linear", tolerance=1e-12).run(round(0.025 / step)).position[-1]


def test_time_step_error_is_first_order_and_what_the_prototype_measured() -> None:
    start = wy.paper.hung_cloth("plain", 5, 5, (1, 2)).cloth.position
    finest = 1e-3 / 64
    # Two steps of a first-order method: their extrapolation is second order, 1e-4 at this step.
    reference = 2.0 * hung(finest / 2) - hung(finest)

    def size(x: np.ndarray) -> float:
        return float(np.sqrt((x**2).sum(axis=1).mean()))

    steps = 1e-3 / np.array([1.0, 2.0, 4.0, 8.0])
    errors = np.array([size(hung(step) - reference) for step in steps]) / size(reference - start)
    # physics.md: 11 %, 5.1 %, 2.3 %, 1.2 %, each within a fifth
    assert errors == pytest.approx([0.11, 0.051, 0.023, 0.012], rel=0.2)
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert slope == pytest.approx(1.0, abs=0.1)


def test_single_precision_follows_double() -> None:
    scene = wy.paper.hung_cloth("plain", 5, 5, (1, 2))
    double = wy.Simulator(scene).run(25).position
    single = wy.Simulator(scene, precision="single").run(25).position
    moved = np.abs(double[-1] - double[0]).max()
    # 24 bits of positions near 4 mm, whose differences make strains, and a solver tolerance of 1e-4
    assert np.abs(single - double).max() < 1e-2 * moved


def test_energy_falls_when_nothing_drives() -> None:
    c = cloth(5, 5)
    sim = wy.Simulator(wy.Scene(c, gravity=None))
    sim.state = make_state(c, "random")
    energies = []
    for _ in range(30):
        energies.append(sum(sim.energy().values()))
        sim.run(1)
    energies = np.array(energies)
    # shear's energy holds F_n as a parameter, so its part may change by itself: a thousandth of the whole
    assert np.diff(energies).max() < 1e-3 * energies[0]
    assert energies[-1] < 0.1 * energies[0]


def test_a_term_that_is_left_out_has_no_arrays_and_does_nothing() -> None:
    c = cloth(5, 5)
    scene = wy.Scene(c, sliding=False, terms=["stretch", "gravity"])
    sim = wy.Simulator(scene)
    assert scene.terms == ("mass", "stretch", "gravity")
    absent = ("normal", "contact_load", "euler_force", "upper_xs", "anchor", "euler_velocity", "corner_jams")
    assert all(sim.arrays[name] is None for name in absent)
    assert sim.arrays["upper_xx"].size == 2 * c.nodes  # the next crossings of each yarn alone
    assert set(sim.forces()) == {"stretch", "gravity"}
    trajectory = sim.run(3)
    assert np.array_equal(trajectory.euler[-1], c.euler) and not trajectory.euler_velocity.any()


def test_forces_and_pins_vary_in_time() -> None:
    c = cloth(4, 4)
    push = np.zeros((3, 3))
    push[1] = (1e-4, 0.0, 0.0)
    forces = {5: push, 6: (0, 1e-4, 0)}
    sim = wy.Simulator(wy.Scene(c, gravity=None, terms=["applied", "stretch"], forces=forces), integrator="linear")
    trajectory = sim.run(5)
    along = trajectory.velocity[:, :, 0] @ np.ones(c.nodes)
    assert abs(along[1]) < 1e-15 and along[2] > 1e-4
    across = np.diff(trajectory.velocity[:, :, 1].sum(axis=1))
    assert (across > 0.0).all()  # the force that is given once does not end

    path = np.array([[[0.0, 0.0, z]] for z in (1e-4, 2e-4)]) + c.position[0]
    sim = wy.Simulator(wy.Scene(c, gravity=None, pins=[0], pin_path=path, pin_stiffness=None))
    trajectory = sim.run(4)
    expected = np.concatenate([c.position[:1], path[:, 0], path[1:, 0], path[1:, 0]])
    assert np.allclose(trajectory.position[:, 0], expected, rtol=0, atol=1e-15)


def test_a_run_goes_on_where_it_ended() -> None:
    scene = wy.paper.hung_cloth("plain", 5, 5, (1, 2))
    once = wy.Simulator(scene).run(80)
    sim = wy.Simulator(scene)
    twice = sim.run(30).joined(sim.run(50))
    for name in ("position", "euler", "velocity", "euler_velocity", "anchor"):
        assert np.array_equal(getattr(once, name), getattr(twice, name))
    assert sim.steps_done == 80 and twice.time[-1] == pytest.approx(0.08)


def test_recording_is_read_back(tmp_path) -> None:
    trajectory = wy.Simulator(wy.paper.hung_cloth("satin", 4, 5, (2, 3))).run(3)
    trajectory.save(tmp_path / "run.npz")
    back = wy.Trajectory.load(tmp_path / "run.npz")
    for name in ("position", "euler", "velocity", "euler_velocity", "anchor"):
        assert np.array_equal(getattr(back, name), getattr(trajectory, name))
    assert back.step == trajectory.step
    assert np.array_equal(back.cloth.weave.flipped, trajectory.cloth.weave.flipped)
    assert back.cloth.yarns == trajectory.cloth.yarns
    assert back.cloth.shear == trajectory.cloth.shear
