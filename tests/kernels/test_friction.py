"""Friction of warp against weft, along each of the two yarns of a crossing."""

import dataclasses
import functools

import numpy as np
import pytest
import torch
from cases import BENT, YARNS, Case, cases
from checks import ROUNDING, TermChecks, check_definite, error, matrix
from reference import Tensor

import warp_yarn as wy


class TestFriction(TermChecks):
    """With terms that press the yarns together, and others that push them along."""

    term = "friction"
    terms = ("inertia", "stretch", "bending", "gravity", "parallel", "friction")
    cases = (
        *cases(states=BENT, sliding=(True,)),
        *(dataclasses.replace(case, published_scaling=True) for case in cases(states=("random",), sliding=(True,))),
    )
    moves_with = "xsvwa"
    step = 1e-9
    """It breaks away over some 1e-6 m."""
    tolerance_of_differences = 1e-8
    """1e-16/1e-6 for rounding, a part of a force that turns into its opposite within 1 % of itself."""

    def least(self, case: Case) -> float:
        """Its damping, at 1 m/s."""
        return np.max(case.cloth.friction_damping)

    def expected_matrix(self, case: Case) -> Tensor:
        """−∂F/∂δ."""
        o = self.oracle(case)

        def force(anchor: Tensor) -> Tensor:
            return o.force("friction", case.q, case.v, anchor)

        by_anchor = torch.diagonal(torch.func.jacrev(force)(case.anchor)[3 * case.cloth.nodes :])
        return torch.diag(torch.cat([torch.zeros(3 * case.cloth.nodes), by_anchor]))

    def test_damping(self, case: Case) -> None:
        damping = self.oracle(case).of_nodes("friction_damping").repeat_interleave(2)
        expected = np.diag(self.oracle(case).slides * damping)
        a = self.matrix(case, "damping")
        n = 3 * case.cloth.nodes
        assert not a[:n].any()
        assert error(a[n:, n:], expected) < ROUNDING


# -- one crossing ----------------------------------------------------------------------------------------------------

SPACING = 1e-3
K_F, MU = 1000.0, 0.5


@functools.cache
def saddle(flipped: int = 0) -> tuple[wy.Simulator, wy.State, float]:
    """A taut saddle of 3 × 3 nodes: its warp yarn pulls the crossing up and its weft yarn down, so that they press
    where the warp is below, and part where it is flipped. With the friction's limit μF_n."""
    weave = wy.Weave([[0, 0, 0], [0, flipped, 0], [0, 0, 0]])
    cloth = wy.Cloth(weave, yarns=YARNS[:1], pose="flat", friction=MU, friction_stiffness=K_F, friction_damping=0.0)
    sim = wy.Simulator(wy.Scene(cloth, terms=["stretch", "bending", "friction"]))
    state = sim.state
    state.position[:, :2] *= 1.2
    state.position[[3, 5], 2] = 0.1 * SPACING
    state.position[[1, 7], 2] = -0.1 * SPACING
    return sim, state, MU * float(sim.contact(state)[1][4])


def slid(state: wy.State, direction: int, distance: float) -> wy.State:
    """The state with its crossing and its anchor elsewhere along a yarn, so that the stretch of the yarn pushes."""
    euler = state.euler.copy()
    euler[4, direction] += distance
    return dataclasses.replace(state, euler=euler, anchor=None)


def friction_at(sim: wy.Simulator, state: wy.State, delta: float, direction: int) -> float:
    """The force along a direction, of a crossing that has slid by delta from its anchor."""
    anchor = state.euler.copy()
    anchor[4, direction] -= delta
    return float(sim.forces(dataclasses.replace(state, anchor=anchor))["friction"][1][4, direction])


@pytest.mark.parametrize("direction", [0, 1])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_sticks_far_under_the_limit(sign: float, direction: int) -> None:
    """Nothing pushes along the yarn, and the spring holds by 1 % of the limit: −k_f δ."""
    sim, state, limit = saddle()
    assert limit > 1e-3
    delta = sign * 0.01 * limit / K_F
    # K(1) = tanh(10) is short of 1 by 4e-9, which brings in that much of the slip law: K(0.01)μF_n = 10 k_f δ
    assert friction_at(sim, state, delta, direction) == pytest.approx(-K_F * delta, rel=1e-7)


@pytest.mark.parametrize("direction", [0, 1])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_slides_far_over_the_limit(sign: float, direction: int) -> None:
    """The crossing is pushed along by a multiple of the limit, and the spring by ten times it: −μF_n sign δ."""
    sim, state, _ = saddle()
    pushed = slid(state, direction, sign * 0.2 * SPACING)
    limit = MU * sim.contact(pushed)[1][4]
    push = sim.forces(pushed)["stretch"][1][4, direction]
    assert abs(push) > 3.0 * limit > 1e-3
    # K(3) and K(10) are 1 to rounding
    assert friction_at(sim, pushed, sign * 10.0 * limit / K_F, direction) == pytest.approx(-sign * limit, rel=1e-13)


def test_published_scaling_does_neither() -> None:
    """With p = 10 and arguments in SI units both tanh are nearly 0: a spring of half the stiffness."""
    sim, state, limit = saddle()
    published = wy.Simulator(
        wy.Scene(sim.scene.cloth, terms=["stretch", "bending", "friction"], published_scaling=True)
    )
    delta = 0.01 * limit / K_F
    # K(μF_n) = tanh(10 μF_n) of the other half
    rest = np.tanh(10.0 * limit)
    assert 0.01 < rest < 0.5
    assert friction_at(published, state, delta, 0) == pytest.approx(-0.5 * K_F * delta * (1.0 + rest), rel=1e-2)


@pytest.mark.parametrize("direction", [0, 1])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("reach", [1.5, 10.0, 1e3])
def test_holds_by_no_more_than_the_limit(reach: float, sign: float, direction: int) -> None:
    """However far a step has moved the yarn, and whether anything pushes it or not."""
    sim, state, limit = saddle()
    assert friction_at(sim, state, sign * reach * limit / K_F, direction) == pytest.approx(-sign * limit, rel=1e-12)
    pushed = slid(state, direction, sign * 0.2 * SPACING)
    limit = MU * sim.contact(pushed)[1][4]
    assert friction_at(sim, pushed, sign * reach * limit / K_F, direction) == pytest.approx(-sign * limit, rel=1e-12)


@pytest.mark.parametrize("delta", [0.0, 1e-14, 1e-10, 1e-6])
def test_slack_crossing_slides_freely(delta: float) -> None:
    """F_n = 0: no force, whether anything pushes or not; finite derivatives."""
    sim, state, limit = saddle(flipped=1)
    pushed = slid(state, 0, 0.2 * SPACING)
    assert limit == 0.0 == sim.contact(pushed)[1][4]
    assert friction_at(sim, pushed, delta, 0) == 0.0 == friction_at(sim, state, delta, 0)
    for each in (state, pushed):
        check_definite(matrix(sim, each, stiffness=1.0))


@pytest.mark.parametrize("slid", [-3.0, -0.5, 0.0, 0.999, 1.001, 10.0])
def test_anchor_is_held_or_dragged(slid: float) -> None:
    """Afterwards k_f |δ| is what it was under μF_n, and μF_n beyond."""
    sim, state, limit = saddle()
    sim.contact(state)
    reach = limit / K_F
    before = state.euler.copy()
    after = before.copy()
    after[4] += slid * reach
    arrays = {
        name: type(sim.arrays["anchor"])(values.ravel(), dtype=sim.arrays["anchor"].dtype)
        for name, values in (("anchor", before), ("euler_next", after), ("anchor_next", before))
    }
    sim.model.launch("update_anchor", "crossings", **arrays)
    delta = after - arrays["anchor_next"].numpy().reshape(9, 2)
    expected = np.zeros((9, 2))
    expected[4] = np.clip(slid, -1.0, 1.0) * reach
    # differences of coordinates of 1e-3 m
    assert error(delta, expected, least=1e-3) < 1e-15
