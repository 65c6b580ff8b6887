"""Steps in parts that follow the error: its estimate, the bound on it, and what does not go with it."""

import numpy as np
import pytest
from inputs import cloth
from internals import errors_of_accepted_parts, fails_at_first

import warp_yarn as wy
from warp_yarn.integrators import INTEGRATORS
from warp_yarn.integrators.sdirk2 import SDIRK2

EXACT = {"newton_tolerance": 1e-9}


def hung(step: float, **options: object) -> wy.Simulator:
    """The paper's 5 × 5 cloth, which swings after 10 ms."""
    return wy.Simulator(wy.paper.hung_cloth("plain", 5, 5, (1, 2)), step=step, **options)


@pytest.fixture(scope="module")
def swinging() -> wy.State:
    return hung(1e-4).run(100)[-1]


def farthest(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a - b, axis=1).max())


def test_the_local_error_is_that_of_the_stability_function() -> None:
    """c of R(z) = e^z − c z³ + …, by which a linear motion goes on: R = (1 + (1 − 2γ) z)/(1 − γ z)²."""
    gamma, z = SDIRK2.fraction, 1e-3
    of_step = (1.0 + (1.0 - 2.0 * gamma) * z) / (1.0 - gamma * z) ** 2
    # the next term is of the size of z
    assert (of_step - np.exp(z)) / z**3 == pytest.approx(SDIRK2.local_error, rel=5e-3)


@pytest.mark.parametrize("step", [1e-3, 5e-4, 1.25e-4])
def test_the_estimate_is_the_error_of_the_step(swinging: wy.State, step: float) -> None:
    """Against 64 steps in place of it. Where yarns' vibrations are not resolved, it tells the error's size only."""
    simulator = hung(step, step_error=1e9, **EXACT)
    simulator.state = swinging
    once = simulator.run(1).position[-1]
    fine = hung(step / 64, **EXACT)
    fine.state = swinging
    error = farthest(once, fine.run(64).position[-1])
    assert simulator.substepping.error() == pytest.approx(error, rel=0.2 if step < 2e-4 else 1.0)
    assert simulator.substepping.error() > 0.5 * error


def test_parts_keep_to_the_allowed_error(swinging: wy.State) -> None:
    """And what they lead to comes nearer to the converged motion, faster than in proportion to ε^½."""
    fine = hung(2e-5)
    fine.state = swinging
    converged = fine.run(250).position[-1]
    errors = []
    for allowed in (1e-2, 1e-3, 1e-4):
        simulator = hung(5e-3, step_error=allowed)
        simulator.state = swinging
        accepted = errors_of_accepted_parts(simulator)
        errors.append(farthest(simulator.run(1).position[-1], converged))
        assert len(accepted) == simulator.substepping.accepted > 1
        # nor are they far smaller than they need be
        assert 0.2 * allowed < max(accepted) / simulator.scene.cloth.spacing <= allowed
        assert simulator.split_steps == {}
    assert errors[1] < 10**-0.5 * errors[0] and errors[2] < 10**-0.5 * errors[1]


def test_parts_add_up_to_the_step() -> None:
    """A cloth in free fall has no third derivative, so parts grow to whole steps; exact pins reach their places."""
    fabric = cloth(4, 4)
    # springs of friction that are not strained at rest move by 1e-10 m
    simulator = wy.Simulator(wy.Scene(fabric, sliding=False), step=4e-3, step_error=1e-6, **EXACT)
    simulator.substepping.next_size = 0.1
    fallen = simulator.run(3).position[-1] - fabric.position
    # SDIRK2 is exact for a parabola
    assert fallen[:, 2] == pytest.approx(np.full(fabric.nodes, -0.5 * 9.8 * 0.012**2), rel=1e-6)
    assert simulator.substepping.next_size == pytest.approx(2.0)
    target = fabric.position[[0]][None] + (0.0, 0.0, 2e-4)
    scene = wy.Scene(fabric, gravity=None, pins=[0], pin_path=target, pin_stiffness=None)
    simulator = wy.Simulator(scene, step_error=1e-4)
    after = simulator.run(1)[1]
    assert simulator.substepping.accepted > 1
    assert after.position[0] == pytest.approx(target[0, 0], abs=1e-15)


def test_parts_that_cannot_be_made_are_halved() -> None:
    simulator = wy.Simulator(wy.Scene(cloth(4, 4), wind=wy.Wind(velocity=(0.0, 5.0, 0.0))), step_error=1e9)
    fails_at_first(simulator, 3e-4)
    assert len(simulator.run(1)) == 2
    assert simulator.substepping.last_size <= 0.3 and simulator.substepping.rejected >= 2


def test_an_error_that_no_part_keeps_to_ends_the_run() -> None:
    simulator = hung(1e-3, step_error=1e-30)
    with pytest.raises(
        wy.SimulationError, match=r"step 1 .* its error stays above step_error = 1e-30: allow more"
    ) as end:
        simulator.run(2)
    assert len(end.value.trajectory) == 1 and simulator.steps_done == 0


@pytest.mark.parametrize("method", [name for name in INTEGRATORS if name != "sdirk2"])
def test_methods_without_an_estimate_are_refused(method: str) -> None:
    with pytest.raises(wy.InputError, match=rf"step_error with integrator = '{method}': only 'sdirk2' estimates"):
        wy.Simulator(wy.Scene(cloth(4, 4)), integrator=method, step_error=1e-3)


def test_unusable_bounds_are_refused() -> None:
    with pytest.raises(wy.InputError, match=r"step_error = 0, must be finite and above 0"):
        wy.Simulator(wy.Scene(cloth(4, 4)), step_error=0)
    with pytest.raises(wy.InputError, match=r"step_error with differentiable: gradients go back through whole steps"):
        wy.Simulator(wy.Scene(cloth(4, 4)), step_error=1e-3, differentiable=True)
