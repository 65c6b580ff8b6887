"""Terms and methods from outside the package: what the examples define, and what may not be registered."""

import copy
import dataclasses
import functools
import math
import pickle
import runpy
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
import warp_yarn.learn as wl
from cases import joined, make_state
from internals import put
from scripts import imported
from warp_yarn.kernels import TERMS, in_order
from warp_yarn.kernels.core.indexing import ends, index
from warp_yarn.kernels.core.structs import structs

import warp_yarn as wy
import warp_yarn.torch as wt
from warp_yarn.integrators import INTEGRATORS
from warp_yarn.integrators.stage import StageMethod
from warp_yarn.simulation.ablation import ablate

C = 0.03
"""The drag's parameter [N s/m²]."""
DAMPED = wy.Yarn(density=2e-3, stretch=5e5, bend=1.4e-4)
OTHER = wy.Yarn(density=2.5e-3, stretch=1.7e5, bend=1.1e-4)
EXACT = 1e-14
"""Solver tolerance where digits count: the solve then ends at rounding."""
OWN_METHODS = tuple(INTEGRATORS)


@pytest.fixture(scope="module")
def drag() -> Iterator[ModuleType]:
    module = imported("examples/linear_drag.py")
    yield module
    wy.unregister_term("linear_drag")


@pytest.fixture(scope="module")
def tableau() -> Iterator[ModuleType]:
    module = imported("examples/butcher_tableau.py")
    yield module
    wy.unregister_integrator("sdirk2-far")


def fabric(**options: Any) -> wy.Cloth:
    return wy.Cloth(wy.Weave.plain(rows=4, columns=5), yarns=[DAMPED, OTHER], radius=4.8e-4, **options)


def hung(**options: Any) -> wy.Scene:
    c = fabric()
    return wy.Scene(c, pins=c.corners("top"), wind=wy.Wind(velocity=(0.3, 5.0, -0.2)), **options)


# -- a term ----------------------------------------------------------------------------------------------------------


def test_examples_are_short() -> None:
    """As the issue that asked for them says."""
    for file in (Path(__file__).parents[1] / "examples").glob("*.py"):
        assert 20 <= sum(bool(line.strip()) for line in file.read_text().splitlines()) <= 60


def test_linear_drag(drag: ModuleType, capsys: pytest.CaptureFixture) -> None:
    found = drag.main()
    assert "closed form" in capsys.readouterr().out
    # the step of 1 ms: (h/τ)² of it is 2.5e-3, and e^(−10) of that is left after 0.2 s
    assert found["velocity"] == pytest.approx(found["terminal"], rel=1e-6)
    # of second-order differences over 1e-3 of the parameter
    assert found["gradient"] == pytest.approx(found["difference"], rel=1e-6)


@pytest.mark.parametrize("sliding", [True, False], ids=["sliding", "locked"])
def test_force_and_matrix(drag: ModuleType, sliding: bool) -> None:
    """The force is −c Δs/2 ẋ on each end, its matrix minus the derivative by velocity, and there is no energy."""
    c = fabric()
    sim = wy.Simulator(wy.Scene(c, terms=["linear_drag"], parameters={"linear_drag": C}, sliding=sliding))
    state = make_state(c, "random", sliding)
    topology = c.topology
    direction = topology.yarn_direction[topology.segment_yarn]
    a, b = topology.segment_nodes.T
    half = 0.5 * C * (state.euler[b, direction] - state.euler[a, direction])
    of_node = np.zeros(c.nodes)
    np.add.at(of_node, a, half)
    np.add.at(of_node, b, half)
    force, along = sim.forces(state)["linear_drag"]
    # sums of four products
    assert force == pytest.approx(-of_node[:, None] * state.velocity, rel=1e-13)
    assert not along.any()
    assert sim.energy(state).keys() == {"mass"}
    damping = sim.system(state, weights=(0.0, 1.0, 0.0)).dense()
    for k in np.random.default_rng(1).choice(3 * c.nodes, 6, replace=False):
        moved = []
        for sign in (1.0, -1.0):
            velocity = state.velocity.copy()
            velocity.ravel()[k] += sign * 0.1
            moved.append(joined(*sim.forces(dataclasses.replace(state, velocity=velocity))["linear_drag"]))
        column = (moved[1] - moved[0])[: len(damping)] / 0.2
        # linear in the velocity: nothing but rounding
        assert np.abs(damping[:, k] - column).max() < 1e-12 * of_node.max()
    assert not sim.system(state, weights=(0.0, 0.0, 1.0)).dense().any()


@pytest.mark.parametrize("method", OWN_METHODS)
def test_every_method_has_its_order(drag: ModuleType, method: str) -> None:
    """A cloth falls as a stone would: v = g τ (1 − exp(−t/τ)). ROS2 is told of the damping, and keeps its order."""
    yarn = dataclasses.replace(DAMPED, stretch=100.0)
    c = wy.Cloth(wy.Weave.plain(rows=3, columns=4), yarns=[yarn], radius=2.4e-4, pose="flat")
    tau = DAMPED.density / C
    scene = wy.Scene(c, parameters={"linear_drag": C})
    errors = []
    for step in (4e-3, 2e-3, 1e-3):
        options = {"tolerance": EXACT, "newton_tolerance": 1e-12}
        v = wy.Simulator(scene, step=step, integrator=method, **options).run(round(0.064 / step)).velocity[-1]
        assert np.ptp(v, axis=0).max() < 1e-9
        errors.append(abs(v[0, 2] + 9.8 * tau * (1.0 - math.exp(-0.064 / tau))))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    # the next order's share is h/τ of it, 6 % at 4 ms
    assert orders == pytest.approx(INTEGRATORS[method].order, abs=0.06)


@pytest.mark.parametrize("method", OWN_METHODS)
def test_gradient_of_a_run(drag: ModuleType, method: str) -> None:
    """By the drag's parameter, on a cloth that hangs and slides in the wind, against central differences."""
    scene = hung(parameters={"linear_drag": C})
    rollout = wt.Rollout(scene, 8, frames=[8], integrator=method, tolerance=EXACT, newton_tolerance=1e-12)
    assert rollout.inputs["linear_drag"] == ()

    def loss(value: Any) -> torch.Tensor:
        frames = rollout(linear_drag=value)
        return 1e6 * frames.position.pow(2).sum() + frames.velocity.pow(2).sum()

    check_gradient(loss, rollout.defaults["linear_drag"])


def check_gradient(loss: Callable[[Any], torch.Tensor], value: torch.Tensor, size: float = 1e-6) -> None:
    x = value.clone().requires_grad_()
    loss(x).backward()
    assert bool((x.grad != 0.0).all())
    for k in range(x.numel()):
        direction = torch.zeros_like(value)
        direction.reshape(-1)[k] = max(abs(float(value.reshape(-1)[k])), 1e-3)

        def along(t: float, direction: torch.Tensor = direction) -> float:
            return float(loss(value + t * direction))

        # ten times as wide they step over a crossing that begins to press: 4e-5 off; 1e-9 were seen here
        near, far = along(1e-4) - along(-1e-4), along(2e-4) - along(-2e-4)
        difference = (8.0 * near - far) / 12e-4
        assert float((x.grad * direction).sum()) == pytest.approx(difference, rel=size)


@pytest.mark.parametrize("options", [{"precision": "single"}, {"preconditioner": "jacobi"}, {"step_error": 1e-3}])
def test_options_of_the_simulator(drag: ModuleType, options: dict[str, Any]) -> None:
    scene = hung(parameters={"linear_drag": C})
    expected, found = (wy.Simulator(scene, **o).run(10).position[-1] for o in ({"newton_tolerance": 1e-8}, options))
    moved = np.abs(expected - scene.cloth.position).max()
    # smaller steps leave less of the step's own error, 3e-3; single precision and the default tolerance under 1e-3
    assert np.abs(found - expected).max() < 5e-3 * moved
    without = wy.Simulator(hung(), newton_tolerance=1e-8).run(10).position[-1]
    assert np.abs(without - expected).max() > 2e-2 * moved


def test_ablation_sees_it(drag: ModuleType) -> None:
    scene = hung(parameters={"linear_drag": C}, sliding=False)
    found = ablate(scene, steps=20, repeats=1)
    changes = {change.name: change for change in found.changes}
    assert "linear_drag" in changes and not {"mass", "pins"} & changes.keys()
    with_it, without = (wy.Simulator(s).run(20).position for s in (scene, scene.replace(parameters=None)))
    moved = np.sqrt(((without - with_it) ** 2).sum(axis=2).mean() / ((with_it[0] - with_it) ** 2).sum(axis=2).mean())
    assert changes["linear_drag"].moved == pytest.approx(moved, rel=1e-9)
    assert moved > 1e-3


def test_what_scenes_have_it(drag: ModuleType) -> None:
    scene = hung(parameters={"linear_drag": C})
    assert scene.terms[-2:] == ("linear_drag", "friction")
    assert "linear_drag" not in hung().terms
    assert scene.parameters == {"linear_drag": C}
    assert scene.same_as(hung(parameters={"linear_drag": C}))
    assert not scene.same_as(hung(parameters={"linear_drag": 2.0 * C}))
    assert not scene.same_as(hung())
    locked = hung(terms=["gravity", "linear_drag"], parameters={"linear_drag": C})
    assert locked.terms == ("mass", "gravity", "linear_drag")
    # kept, though the term is left out
    assert scene.replace(terms=["gravity"]).parameters == {"linear_drag": C}


def test_scenes_without_it_are_as_before(drag: ModuleType) -> None:
    """0 of it and none of it are the same to the last bit, and the package's own modules got no kernel more."""
    before = {name: len(wp.get_module(name).kernels) for name in modules()}
    none, zero = (wy.Simulator(hung(**o)).run(5) for o in ({}, {"parameters": {"linear_drag": 0.0}}))
    assert none == zero
    assert before == {name: len(wp.get_module(name).kernels) for name in modules()}
    own = wp.get_module(wy.Variant(wp.float64, True, term="linear_drag").module("terms"))
    assert len(own.kernels) == 1


def modules() -> list[str]:
    return [wy.Variant(wp.float64, True).module(name) for name in ("terms", "energy", "stage", "step")]


def test_recordings_keep_its_parameters(drag: ModuleType, tmp_path: Path) -> None:
    scene = hung(parameters={"linear_drag": C})
    simulator = wy.Simulator(scene)
    trajectory = simulator.run(3)
    trajectory.save(tmp_path / "drag.npz")
    loaded = wy.Trajectory.load(tmp_path / "drag.npz")
    assert loaded.scene.same_as(scene)
    again = wy.Simulator(loaded.scene)
    again.state, again.steps_done = loaded[-1], loaded.steps_done
    assert again.run(3) == simulator.run(3)


def test_copies_keep_what_the_owner_set(drag: ModuleType) -> None:
    simulator = wy.Simulator(hung(parameters={"linear_drag": C}))
    put(simulator, "linear_drag", 10.0 * C)
    expected = wy.Simulator(hung(parameters={"linear_drag": 10.0 * C})).run(4)
    assert pickle.loads(pickle.dumps(simulator)).run(4).position == pytest.approx(expected.position, abs=0.0)
    assert copy.deepcopy(simulator).run(4).position == pytest.approx(expected.position, abs=0.0)
    rollout = pickle.loads(pickle.dumps(wt.Rollout(hung(parameters={"linear_drag": C}), 4)))
    assert float(rollout.defaults["linear_drag"]) == C


def test_it_can_be_learned(drag: ModuleType) -> None:
    scene = hung(parameters={"linear_drag": C})
    target = wy.Simulator(scene, newton_tolerance=1e-10).run(10)
    assert wl.value_of(scene, "linear_drag") == C
    model = hung(parameters={"linear_drag": 0.5 * C})
    task = wl.CalibrationProblem(model, target, [wl.Parameter("linear_drag", 0.0, 3.0 * C, 0.5 * C)], frames=6)
    # it began 50 % off; 5e-5 were seen, where the search stops
    assert wl.learn(task).values["linear_drag"] == pytest.approx(C, rel=1e-3)
    layer = wt.Fabric(scene, 4, learn={"linear_drag": (0.0, 1.0)})
    assert layer.value("linear_drag").item() == pytest.approx(C)


def test_values_are_checked(drag: ModuleType) -> None:
    for parameters, words in (
        ({"linear_drag": -1.0}, r"linear_drag = -1.0, must be finite and at least 0"),
        ({"linear_drag": float("nan")}, r"linear_drag = nan, must be finite and at least 0"),
        ({"linear_drag": [C]}, r"linear_drag = \[0.03\], must be a number"),
        ({"linear_drak": C}, r"'linear_drak', must be of a registered term: linear_drag"),
        ({"shear": C}, r"'shear', must be given to Yarn, Cloth, Wind or Scene"),
        ([C], r"parameters = \[0.03\], must be a dictionary"),
    ):
        with pytest.raises(wy.InputError, match=words):
            hung(parameters=parameters)
    with pytest.raises(wy.InputError, match=r"terms names 'linear_drag', but parameters has no 'linear_drag'"):
        hung(terms=["linear_drag"])
    with pytest.raises(wy.InputError, match=r"linear_drag = -1.0, must be finite and at least 0"):
        wt.Rollout(hung(parameters={"linear_drag": C}), 2)(linear_drag=-1.0)
    with pytest.raises(wy.InputError, match=r"'linear_drag' is no input of this scene"):
        wt.Rollout(hung(), 2)(linear_drag=C)


# -- one with an energy, of yarns and with a vector -------------------------------------------------------------------


def tether(variant: wy.Variant, sign: float = 1.0) -> wp.Kernel:
    """Springs to one point: −k Δs (x − c)/2 on each end of a segment."""
    scalar, vec3, BlockMatrix = variant.scalar, variant.vec3, structs(variant).BlockMatrix

    @variant.kernel("terms")
    def tether_term(
        segments: wp.array(dtype=wp.vec4i),
        tether: wp.array(dtype=scalar),
        tether_point: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        force: wp.array(dtype=vec3),
        euler_force: wp.array(dtype=scalar),
        matrix: int,
        blocks: BlockMatrix,
    ):
        e = index(wp.tid())
        _a, _b, sa, sb, yarn, _direction = ends(segments, e)
        half = scalar(wp.static(0.5 * sign)) * tether[yarn]
        stored = scalar(0.0)
        for end in range(2):
            i = index(segments[e][end])
            offset = position[i] - tether_point[0]
            stored += scalar(0.5) * half * wp.dot(offset, offset)
            k = half * (euler[sb] - euler[sa])
            wp.atomic_add(force, i, offset * (-k))
            if matrix != 0:
                wp.atomic_add(blocks.diagonal_xx, i, wp.identity(n=3, dtype=scalar) * (blocks.coefficients[0][2] * k))
        if wp.static(variant.sliding):
            wp.atomic_add(euler_force, sa, stored)
            wp.atomic_add(euler_force, sb, -stored)

    return tether_term


def tether_energy(variant: wy.Variant) -> wp.Kernel:
    scalar, vec3 = variant.scalar, variant.vec3

    @variant.kernel("energy")
    def tether_energy(
        segments: wp.array(dtype=wp.vec4i),
        tether: wp.array(dtype=scalar),
        tether_point: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        energy: wp.array(dtype=scalar),
    ):
        e = index(wp.tid())
        _a, _b, sa, sb, yarn, _direction = ends(segments, e)
        k = scalar(0.25) * tether[yarn] * (euler[sb] - euler[sa])
        for end in range(2):
            offset = position[segments[e][end]] - tether_point[0]
            wp.atomic_add(energy, 0, k * wp.dot(offset, offset))

    return tether_energy


TETHER = wy.Term(
    "tether",
    "segments",
    tether,
    tether_energy,
    parameters=(
        wy.TermParameter("tether", "N/m²", above=0.0, of="yarn"),
        wy.TermParameter("tether_point", "m", default=(0.0, 0.0, 0.0), size=3),
    ),
    energy_watched_as="elastic_energy",
)
POINT = (1e-3, -5e-3, 2e-3)


@pytest.fixture
def tethered() -> Iterator[wy.Scene]:
    # later than simulators of the variant
    wy.Simulator(hung()).run(1)
    wy.register_term(TETHER)
    yield hung(parameters={"tether": [200.0, 300.0], "tether_point": POINT})
    wy.unregister_term("tether")


def test_energy_of_a_term(tethered: wy.Scene) -> None:
    """By the closed form, with a parameter of the yarns; its force is minus the gradient, its matrix the derivative."""
    c = tethered.cloth
    sim = wy.Simulator(tethered)
    state = make_state(c, "random")
    topology = c.topology
    k = np.array([200.0, 300.0])[c.material[topology.segment_yarn]]
    direction = topology.yarn_direction[topology.segment_yarn]
    a, b = topology.segment_nodes.T

    def energy(state: wy.State) -> float:
        square = ((state.position - POINT) ** 2).sum(axis=1)
        rest = state.euler[b, direction] - state.euler[a, direction]
        return float((0.25 * k * rest * (square[a] + square[b])).sum())

    assert sim.energy(state)["tether"] == pytest.approx(energy(state), rel=1e-13)
    force, along = sim.forces(state)["tether"]
    stiffness = sim.system(state, weights=(0.0, 0.0, 1.0)).dense()
    rest = wy.Simulator(tethered.replace(terms=[name for name in tethered.terms if name != "tether"]))
    stiffness -= rest.system(state, weights=(0.0, 0.0, 1.0)).dense()
    rng = np.random.default_rng(2)
    for _ in range(3):
        dx, ds = rng.normal(size=(c.nodes, 3)), rng.normal(size=(c.nodes, 2)) * (topology.is_crossing != 0)[:, None]

        def moved(t: float, dx: np.ndarray = dx, ds: np.ndarray = ds) -> wy.State:
            return dataclasses.replace(state, position=state.position + t * dx, euler=state.euler + t * ds)

        # cubic in the state: central differences of fourth order leave rounding alone
        near, far = (energy(moved(t)) - energy(moved(-t)) for t in (1e-5, 2e-5))
        size = np.abs(force * dx).sum() + np.abs(along * ds).sum()
        assert abs((8.0 * near - far) / 12e-5 + (force * dx).sum() + (along * ds).sum()) < 1e-9 * size
        ends = [sim.forces(moved(t, ds=0.0 * ds))["tether"][0] for t in (1e-5, -1e-5)]
        slope = (ends[1] - ends[0]).ravel() / 2e-5
        n = 3 * c.nodes
        assert np.abs(stiffness[:n, :n] @ dx.ravel() - slope).max() < 1e-9 * np.abs(slope).max()


@pytest.mark.parametrize("method", ["sdirk2", "ros2"])
def test_gradient_by_yarns_and_a_vector(tethered: wy.Scene, method: str) -> None:
    # a longer step buckles the cloth and is split
    options = {"step": 0.5e-3, "tolerance": EXACT, "newton_tolerance": 1e-12}
    rollout = wt.Rollout(tethered, 6, frames=[6], integrator=method, **options)
    assert {rollout.inputs[name] for name in ("tether", "yarn_tether", "tether_point")} == {(2,), (9,), (3,)}

    def loss(name: str, value: Any) -> torch.Tensor:
        return 1e6 * rollout(**{name: value}).position.pow(2).sum()

    check_gradient(functools.partial(loss, "tether"), torch.tensor([200.0, 300.0], dtype=torch.float64))
    check_gradient(functools.partial(loss, "tether_point"), rollout.defaults["tether_point"])
    by_yarn = rollout.defaults["yarn_tether".removeprefix("yarn_")]
    assert torch.equal(by_yarn, torch.tensor([200.0, 300.0], dtype=torch.float64)[tethered.cloth.material])
    assert torch.equal(rollout(yarn_tether=by_yarn).position, rollout().position)


def test_learned_and_recorded_by_index(tethered: wy.Scene, tmp_path: Path) -> None:
    counts = wl.learnable(tethered)
    assert (counts["tether"], counts["tether_point"]) == (2, 3)
    assert wl.value_of(tethered, "tether[1]") == 300.0 and wl.value_of(tethered, "tether_point[2]") == 2e-3
    changed = wl.with_values(tethered, {"tether[0]": 250.0, "tether_point[1]": 1e-3, "shear": 900.0})
    assert changed.parameters == {"tether": (250.0, 300.0), "tether_point": (1e-3, 1e-3, 2e-3)}
    assert changed.cloth.shear == 900.0
    wy.Simulator(changed).run(1).save(tmp_path / "a.npz")
    assert wy.Trajectory.load(tmp_path / "a.npz").scene.same_as(changed)
    layer = wt.Fabric(tethered, 2, learn={"tether": (1.0, 500.0)})
    assert layer.value("tether").tolist() == pytest.approx([200.0, 300.0])
    # one number stands for all materials; the point has its default
    one = hung(parameters={"tether": 250.0})
    assert one.registered_value("tether").tolist() == [250.0, 250.0]
    assert one.registered_value("tether_point").tolist() == [0.0, 0.0, 0.0]
    for value in ([1.0], [1.0, 2.0, 3.0], [1.0, 0.0], "1", None):
        with pytest.raises(wy.InputError, match="tether"):
            hung(parameters={"tether": value})


def test_another_term_of_the_name(tethered: wy.Scene) -> None:
    """As one that is edited in a notebook: simulators of the first go on as they were, new ones have the second."""
    first, expected = wy.Simulator(tethered), wy.Simulator(tethered).run(6)
    assert first.run(3) == expected.cut(4)
    wy.unregister_term("tether")
    wy.register_term(dataclasses.replace(TETHER, define=functools.partial(tether, sign=-1.0)))
    second = wy.Simulator(tethered)
    pull, push = first.forces(expected[3])["tether"][0], second.forces(expected[3])["tether"][0]
    assert np.abs(pull + push).max() < 1e-13 * np.abs(pull).max()
    assert (first.forces(expected[3])["tether"][0] == pull).all()
    assert first.run(3).position == pytest.approx(expected.position[3:], abs=0.0)


def test_what_names_a_term_that_is_gone(tmp_path: Path) -> None:
    wy.register_term(TETHER)
    scene = hung(parameters={"tether": 250.0})
    kept = pickle.dumps(scene)
    wy.Simulator(scene).run(1).save(tmp_path / "a.npz")
    wy.unregister_term("tether")
    for use in (lambda: wy.Simulator(scene), lambda: wy.Simulator(pickle.loads(kept)), scene.replace):
        with pytest.raises(wy.InputError, match="tether"):
            use()
    with pytest.raises(wy.InputError, match=r"a\.npz: .*tether"):
        wy.Trajectory.load(tmp_path / "a.npz")
    with pytest.raises(wy.InputError, match="'tether', must be one of"):
        wy.unregister_term("tether")


# -- what may not be registered --------------------------------------------------------------------------------------


def reading(name: str, dtype: Any = None) -> Callable[[wy.Variant], wp.Kernel]:
    """A term's ``define`` whose kernel has an argument of this name."""

    def define(variant: wy.Variant) -> wp.Kernel:
        def kernel(force): ...

        kernel.__annotations__ = {"force": wp.array(dtype=variant.vec3)}
        source = f"def kernel({name}: wp.array(dtype=dtype), force: wp.array(dtype=vec3)):\n    i = wp.tid()\n"
        space = {"wp": wp, "dtype": dtype or variant.scalar, "vec3": variant.vec3}
        exec(source, space)
        return wp.Kernel(space["kernel"], module=wp.get_module(variant.module("terms")), source=source)

    return define


def writing(what: str) -> Callable[[wy.Variant], wp.Kernel]:
    """A term's ``define`` whose kernel uses the matrix: a damping, or what is above the diagonal."""

    def define(variant: wy.Variant) -> wp.Kernel:
        scalar, mat33, BlockMatrix = variant.scalar, variant.mat33, structs(variant).BlockMatrix

        @wp.func
        def factor(to: BlockMatrix) -> scalar:
            return to.coefficients[0][1]

        @wp.func
        def twice(to: BlockMatrix) -> scalar:
            return scalar(2.0) * factor(to)

        @wp.func
        def couple(to: BlockMatrix, k: int):
            to.upper_xx[k] = mat33(scalar(0.0))

        @variant.kernel("terms")
        def damping_kernel(blocks: BlockMatrix):
            blocks.diagonal_xx[0] = mat33(blocks.coefficients[0][1])

        @variant.kernel("terms")
        def all_factors_kernel(blocks: BlockMatrix):
            factors = blocks.coefficients[0]
            blocks.diagonal_xx[0] = mat33(factors[1])

        @variant.kernel("terms")
        def damping_by_a_function_kernel(blocks: BlockMatrix):
            blocks.diagonal_xx[0] = mat33(twice(blocks))

        @variant.kernel("terms")
        def upper_kernel(blocks: BlockMatrix):
            blocks.upper_xx[0] = mat33(blocks.coefficients[0][2])

        @variant.kernel("terms")
        def upper_by_a_function_kernel(blocks: BlockMatrix):
            couple(blocks, 0)

        return locals()[f"{what}_kernel"]

    return define


def taking_a_solvers_work(variant: wy.Variant) -> wp.Kernel:
    SolverWork = structs(variant).SolverWork

    @variant.kernel("terms")
    def kernel(blocks: SolverWork):
        blocks.sums[0] = variant.scalar(0.0)

    return kernel


PARAMETER = wy.TermParameter("tether", "N/m")
BAD = {
    "no term": (lambda: "tether", "must be a Term"),
    "own name": ({"name": "gravity"}, "'gravity' is taken"),
    "a kernel's name": ({"name": "audit"}, "'audit' is taken"),
    "an energy's name": ({"name": "gravity_energy"}, "'gravity_energy' is taken"),
    "sliding": ({"name": "sliding"}, "'sliding' is taken"),
    "no name": ({"name": "my term"}, "small letters"),
    "elements": ({"elements": "edges"}, "elements = 'edges', must be one of nodes"),
    "stencil": ({"stencil": 3}, "stencil = 3, must be one of 0, 2, 4, 6"),
    "energy": ({"energy_watched_as": "heat"}, "'heat', must be one of"),
    "reads forces": ({"reads_forces": True}, "friction alone"),
    "a list": ({"parameters": [PARAMETER]}, "must be tuples"),
    "a list as default": (
        {"parameters": (dataclasses.replace(PARAMETER, size=3, default=[0.0] * 3),)},
        "must be tuples",
    ),
    "parameter": ({"parameters": ("tether",)}, "must be a TermParameter"),
    "its name": ({"parameters": (wy.TermParameter("stiffness", ""),)}, "must be 'tether' or begin with 'tether_'"),
    "an array's name": ({"parameters": (wy.TermParameter("shear", ""),)}, "'shear' is taken"),
    "a work array's name": ({"parameters": (wy.TermParameter("rhs", ""),)}, "'rhs' is taken"),
    "a gradient's name": ({"parameters": (wy.TermParameter("tether_grad", ""),)}, "nor end with '_grad'"),
    "twice": ({"parameters": (PARAMETER, PARAMETER)}, "names one twice"),
    "of": ({"parameters": (dataclasses.replace(PARAMETER, of="node"),)}, "of = 'node', must be one of scene, yarn"),
    "size": ({"parameters": (dataclasses.replace(PARAMETER, size=2),)}, "size = 2"),
    "range of a vector": ({"parameters": (dataclasses.replace(PARAMETER, size=3, least=0.0),)}, "without a range"),
    "default": (
        {"parameters": (dataclasses.replace(PARAMETER, least=0.0, default=-1.0),)},
        "the default of tether = -1",
    ),
    "no kernel": ({"define": lambda variant: None, "energy": None}, "must be a kernel"),
    "unknown argument": ({"define": reading("velocities"), "energy": None}, "'velocities', must be one of"),
    "another's argument": ({"define": reading("path"), "energy": None}, "'path', must be one of"),
    "friction's": ({"define": reading("anchor"), "energy": None}, "'anchor', must be one of"),
    "blocks": ({"define": reading("upper_xx"), "energy": None}, "stencil = 0, must be at least 2"),
    "blocks in a struct": ({"define": writing("upper"), "energy": None}, "stencil = 0, must be at least 2"),
    "blocks by a function": ({"define": writing("upper_by_a_function"), "energy": None}, "must be at least 2"),
    "a damping": ({"define": writing("damping"), "energy": None}, "explicit_in_ros2=True"),
    "all factors": ({"define": writing("all_factors"), "energy": None}, "explicit_in_ros2=True"),
    "a damping by a function": ({"define": writing("damping_by_a_function"), "energy": None}, "explicit_in_ros2=True"),
    "another struct": ({"define": taking_a_solvers_work, "energy": None}, "must be one of .* or blocks: BlockMatrix"),
    "blocks of triangles": ({"define": reading("triangle_blocks"), "energy": None, "stencil": 4}, "at least 6"),
    "normal": ({"define": reading("normal"), "energy": None}, "needs_contact=True"),
    "load": ({"define": reading("contact_load"), "energy": None}, "needs_contact=True or presses=True"),
}


@pytest.mark.parametrize("case", BAD)
def test_terms_that_are_refused(case: str) -> None:
    changes, words = BAD[case]
    before = dict(TERMS)
    with pytest.raises(wy.InputError, match=words):
        wy.register_term(changes() if callable(changes) else dataclasses.replace(TETHER, **changes))
    assert before == TERMS


def test_a_damping_that_ros2_is_not_told_of(drag: ModuleType) -> None:
    """Its second solve would have D in its matrix alone, and converge to another motion."""
    c = wy.TermParameter("linear_drag_2", "N s/m²")
    term = dataclasses.replace(TERMS["linear_drag"], name="linear_drag_2", parameters=(c,), explicit_in_ros2=False)
    with pytest.raises(wy.InputError, match="explicit_in_ros2=True"):
        wy.register_term(term)
    with pytest.raises(wy.InputError, match="'linear_drag' is taken"):
        wy.register_term(TERMS["linear_drag"])


def test_annotations_that_warp_cannot_read(tmp_path: Path) -> None:
    source = """from __future__ import annotations
import warp as wp
def define(variant):
    vec3 = variant.vec3
    @variant.kernel("terms")
    def late_term(force: wp.array(dtype=vec3)):
        wp.atomic_add(force, wp.tid(), force[0])
    return late_term
"""
    (tmp_path / "late.py").write_text(source)
    with pytest.raises(wy.InputError, match="must not have 'from __future__ import annotations'"):
        wy.register_term(wy.Term("late", "nodes", runpy.run_path(str(tmp_path / "late.py"))["define"]))


def test_a_term_reads_what_the_scene_lacks() -> None:
    wy.register_term(wy.Term("windy", "nodes", reading("wind_density")))
    try:
        with pytest.raises(wy.InputError, match="'windy', which takes 'wind_density'"):
            wy.Simulator(wy.Scene(fabric(), terms=["windy"]))
    finally:
        wy.unregister_term("windy")


@pytest.mark.parametrize("works", [True, False])
def test_work_without_an_energy(works: bool) -> None:
    """A term that pushes a free cloth: the watch over energy takes it for a gain unless the term says that it works."""

    def define(variant: wy.Variant) -> wp.Kernel:
        scalar, vec3 = variant.scalar, variant.vec3

        @variant.kernel("terms")
        def push_term(push: wp.array(dtype=scalar), force: wp.array(dtype=vec3)):
            wp.atomic_add(force, wp.tid(), vec3(scalar(0.0), scalar(0.0), push[0]))

        return push_term

    push = wy.TermParameter("push", "N", default=1e-4)
    wy.register_term(wy.Term("push", "nodes", define, parameters=(push,), works=works))
    try:
        c = fabric(pose="flat")
        # named, with the default
        scene = wy.Scene(c, gravity=None, terms=[*wy.Scene(c, gravity=None).terms, "push"])
        simulator = wy.Simulator(scene)
        if works:
            lengths = np.array([4] * 4 + [3] * 5)
            mass = sum(c.yarns[k].density * n for k, n in zip(c.material, lengths, strict=True)) * c.spacing
            rise = simulator.run(20).position[-1] - c.position
            segments = c.topology.segment_nodes
            of_node = np.zeros(c.nodes)
            for end in range(2):
                shares = [c.yarns[c.material[k]].density for k in c.topology.segment_yarn]
                np.add.at(of_node, segments[:, end], 0.5 * c.spacing * np.array(shares))
            # the centre of mass, by F t²/2m; sliding moves mass along yarns by less than this
            assert of_node @ rise[:, 2] / mass == pytest.approx(20e-4 * 0.02**2 / (2.0 * mass), rel=1e-3)
            assert not simulator.damped_steps and not simulator.split_steps
        else:
            with pytest.raises(wy.SimulationError, match="gains energy"):
                simulator.run(20)
    finally:
        wy.unregister_term("push")


def test_what_presses_stands_before_the_contact() -> None:
    wy.register_term(dataclasses.replace(TETHER, presses=True))
    try:
        names = list(in_order())
        assert names.index("tether") == names.index("shear") - 1
    finally:
        wy.unregister_term("tether")


def test_own_terms_and_methods_stay() -> None:
    with pytest.raises(wy.InputError, match="'gravity', must be one of"):
        wy.unregister_term("gravity")
    with pytest.raises(wy.InputError, match="'sdirk2', must be one of"):
        wy.unregister_integrator("sdirk2")


# -- a method --------------------------------------------------------------------------------------------------------


def test_butcher_tableau(tableau: ModuleType, capsys: pytest.CaptureFixture) -> None:
    errors = tableau.main()
    assert "orders" in capsys.readouterr().out
    for name, found in errors.items():
        # successive halvings; the reference's own error is 1e-3 of the finest of "sdirk2"
        assert np.log2(np.divide(found[:-1], found[1:])) == pytest.approx(INTEGRATORS[name].order, abs=0.05)
    # z³ of their stability functions less that of exp: −1.37 and 0.0404
    constant = [3.0 * g**2 - 2.0 * g**3 - 1.0 / 6.0 for g in (1.0 + 0.5**0.5, 1.0 - 0.5**0.5)]
    ratio = errors["sdirk2-far"][-1] / errors["sdirk2"][-1]
    assert ratio == pytest.approx(abs(constant[0] / constant[1]), rel=0.1)


def test_known_tableaus_are_the_methods_of_the_package() -> None:
    """To the last bit."""
    g = 1.0 - 0.5**0.5
    for name, a, b in (
        ("sdirk2", [[g, 0.0], [1.0 - g, g]], [1.0 - g, g]),
        ("implicit-midpoint", [[0.5]], [1.0]),
        ("implicit-euler", [[1.0]], [1.0]),
    ):
        method, own = wy.sdirk("again", a, b), INTEGRATORS[name]
        assert method.order == own.order and method.local_error == pytest.approx(own.local_error)
        wy.register_integrator(method)
        try:
            assert wy.Simulator(hung(), integrator="again").run(8) == wy.Simulator(hung(), integrator=name).run(8)
        finally:
            wy.unregister_integrator("again")


@pytest.mark.parametrize("gamma", [0.5, 0.75, 1.2])
@pytest.mark.parametrize("stages", [1, 2])
def test_order_by_the_tableau(gamma: float, stages: int) -> None:
    """Against what the method does to a falling cloth with drag-free gravity: exact from order 2 on."""
    two = ([[gamma, 0.0], [1.0 - gamma, gamma]], [1.0 - gamma, gamma])
    method = wy.sdirk("tried", *(([[gamma]], [1.0]) if stages == 1 else two))
    wy.register_integrator(method)
    try:
        c = wy.Cloth(wy.Weave.plain(rows=3, columns=3), yarns=[DAMPED], radius=2.4e-4, pose="flat")
        sim = wy.Simulator(wy.Scene(c), integrator="tried", newton_tolerance=1e-12)
        fallen = sim.run(16).position[-1, :, 2] - c.position[:, 2]
    finally:
        wy.unregister_integrator("tried")
    # n steps: h² g (n²/2 + n (b·c − 1/2)), of the tableau's nodes c
    b_c = gamma if stages == 1 else gamma * (2.0 - gamma)
    assert fallen == pytest.approx(-9.8e-6 * (128.0 + 16.0 * (b_c - 0.5)), rel=1e-9)
    assert method.order == (2 if abs(b_c - 0.5) < 1e-12 else 1)


@pytest.mark.parametrize("name", ["sdirk2-far", "theta"])
def test_gradient_of_a_registered_method(tableau: ModuleType, name: str) -> None:
    if name == "theta":
        wy.register_integrator(wy.sdirk("theta", [[0.6]], [1.0]))
    try:
        options = {"step": 0.5e-3, "tolerance": EXACT, "newton_tolerance": 1e-12}
        rollout = wt.Rollout(hung(), 6, frames=[6], integrator=name, **options)

        def loss(value: Any) -> torch.Tensor:
            return 1e6 * rollout(wind_velocity=value).position.pow(2).sum()

        check_gradient(loss, torch.tensor([0.3, 5.0, -0.2], dtype=torch.float64))
    finally:
        if name == "theta":
            wy.unregister_integrator("theta")


@pytest.mark.parametrize(
    ("a", "b", "words"),
    [
        ([[0.0]], [1.0], "A-stable is 0.5 to inf"),
        ([[0.4]], [1.0], "A-stable is 0.5 to inf"),
        ([[0.2, 0.0], [0.8, 0.2]], [0.8, 0.2], "A-stable is 0.292893 to 1.70711"),
        ([[0.5, 0.0], [0.5, 0.6]], [0.5, 0.5], "diagonal differ"),
        ([[0.5, 0.1], [0.5, 0.5]], [0.5, 0.5], "above its diagonal"),
        (
            [[0.7886751345948129, 0.0], [-0.5773502691896257, 0.7886751345948129]],
            [0.5, 0.5],
            "stiffly accurate is b = a",
        ),
        ([[1.0, 0.0], [0.0, 1.0]], [0.0, 1.0], "has no part"),
        ([[0.5]], [0.9], "must add up to 1"),
        (np.zeros((3, 3)), [0.2, 0.3, 0.5], "3 stages"),
        ([[0.5]], [0.5, 0.5], "must be \\(2, 2\\)"),
        ([[float("nan")]], [1.0], "must be finite"),
        ("abc", [1.0], "a must be an array of numbers"),
    ],
)
def test_tableaus_that_are_refused(a: Any, b: Any, words: str) -> None:
    with pytest.raises(wy.InputError, match=words):
        wy.sdirk("tried", a, b)


def test_methods_that_are_refused() -> None:
    def made(**values: Any) -> type:
        return type(
            "Made", (StageMethod,), {"name": "made", "order": 1, "fraction": 1.0, "carried": 0.0, "stages": 1, **values}
        )

    for method, words in (
        ("sdirk2", "must be a class"),
        (object, "object has no 'name'"),
        (type("Nameless", (StageMethod,), {}), "has no 'name'"),
        (made(name="sdirk2"), "'sdirk2', must be another one"),
        (made(name=3), "method.name = 3"),
        (made(fallback="none"), "fallback = 'none', must be one of"),
        (made(stages=3), "stages = 3, must be a whole number, from 1 to 2"),
        (made(fraction=0.5), "cover 0.5 of a step, must cover 1"),
        (made(stages=2, fraction=0.5, carried=0.4), "cover 0.9 of a step, must cover 1"),
    ):
        with pytest.raises(wy.InputError, match=words):
            wy.register_integrator(method)
    assert tuple(INTEGRATORS) == OWN_METHODS or set(INTEGRATORS) - set(OWN_METHODS) == {"sdirk2-far"}
