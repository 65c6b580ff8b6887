"""Cloths of any sett, yarns of their own sizes, crimp, numbers of crossings: whole runs, gradients, learning, files.

Forces and matrices of such a cloth are held to the oracle in ``kernels/``, as the case "general" of every term.
"""

import dataclasses
import math
import pickle

import numpy as np
import pytest
import torch
import warp_yarn.learn as wl
from cases import GENERAL, cloth
from inputs import EXACT, WIND, jittered, scaled
from internals import numbers
from reference import Oracle, tensor

import warp_yarn as wy
import warp_yarn.torch as wt
from warp_yarn.device import defaults

YARN = wy.Yarn(density=2.0e-3, stretch=5.0e5, bend=1.4e-4)
PLAIN = wy.Weave.plain(rows=5, columns=6)
SMALL = {"yarns": [YARN], "radius": 2e-4, "pose": "flat"}


def hung(c: wy.Cloth, **options: object) -> wy.Scene:
    return wy.Scene(c, **{"wind": WIND, "pins": c.corners("top"), **options})


# -- what a cloth is -------------------------------------------------------------------------------------------------


def test_spacing_of_warp_yarns_is_between_rows() -> None:
    """Warp yarn j runs through row j, along u: the distance of warp yarns is the length of weft segments, along v."""
    c = wy.Cloth(PLAIN, **SMALL, spacing=([1e-3, 2e-3, 3e-3, 4e-3], 0.5e-3))
    x = c.position.reshape(5, 6, 3)
    assert np.diff(x[:, 0, 1]) == pytest.approx([1e-3, 2e-3, 3e-3, 4e-3])
    assert np.diff(x[0, :, 0]) == pytest.approx([0.5e-3] * 5)
    assert np.array_equal(c.euler, x.reshape(-1, 3)[:, :2])
    assert np.array_equal(c.replace(pose="upright").position[:, 2], 1e-2 - c.euler[:, 1])
    assert (c.shortest_spacing, c.longest_spacing) == pytest.approx((0.5e-3, 4e-3))


def test_crimped_yarns_are_longer() -> None:
    """(u, v) are lengths of yarn, positions distances; the mass is that of the yarns."""
    c = wy.Cloth(PLAIN, **SMALL, spacing=(1e-3, 2e-3), crimp=([0.0, 0.1, 0.2, 0.3, 0.4], 0.05))
    u, v = c.euler.reshape(5, 6, 2)[..., 0], c.euler.reshape(5, 6, 2)[..., 1]
    assert u[:, -1] == pytest.approx(1e-2 * np.array([1.0, 1.1, 1.2, 1.3, 1.4]))
    assert v[-1] == pytest.approx([4e-3 * 1.05] * 6)
    mass = YARN.density * (1e-2 * 6.0 + 6 * 4e-3 * 1.05)
    assert c.mass == pytest.approx(mass)
    simulator = wy.Simulator(wy.Scene(c, terms=["gravity"]))
    assert -simulator.forces()["gravity"][0][:, 2].sum() == pytest.approx(9.8 * mass)


@pytest.mark.parametrize(
    "options",
    [
        {"spacing": (1e-3, 1e-3)},
        {"spacing": ([1e-3] * 4, [1e-3] * 5)},
        {"crimp": (0.0, [0.0] * 6)},
        {"yarns": [dataclasses.replace(YARN, radius=3e-4)]},
        {"yarns": [dataclasses.replace(YARN, width=6e-4, thickness=6e-4)], "radius": 9.0},
    ],
    ids=str,
)
def test_numbers_that_are_all_the_same_are_one(options: dict) -> None:
    """And cost nothing: the kernels are those of a plain cloth."""
    c = wy.Cloth(PLAIN, **{"yarns": [YARN], "radius": 3e-4, **options})
    assert not c.general and c.spacing == 1e-3 and c.radius == 3e-4
    assert numbers(wy.Simulator(wy.Scene(c)), "spacing").shape == (1,)
    assert c.replace(pose="flat").radius == 3e-4


def test_lock_angles() -> None:
    """Twintex TPEET22: tows 4.20 mm wide and 5.24 mm apart lock at a shear of 42.7° (textile.md), whatever their
    thickness; each direction by its own widths and distances."""
    tow = dataclasses.replace(YARN, width=4.20e-3, thickness=1.2e-3)
    c = wy.Cloth(PLAIN, yarns=[tow], spacing=5.24e-3)
    assert np.degrees(c.corner_lock) == pytest.approx(90.0 - 42.7, abs=0.1)
    thin = dataclasses.replace(tow, width=2.0e-3)
    c = wy.Cloth(PLAIN, yarns=[tow, thin], warp=[0] * 5, weft=[1] * 6, spacing=(5.24e-3, 3e-3))
    assert c.corner_lock == pytest.approx(math.asin(2.10 / 5.24) + math.asin(1.0 / 3.0))


REFUSED = {
    "three spacings": (dict(spacing=(1, 2, 3)), r"spacing = \(1, 2, 3\), must be a number, or two"),
    "gaps": (dict(spacing=([1e-3] * 3, 1e-3)), r"spacing\[0\] has 3 numbers, must be one, or 4"),
    "gap": (dict(spacing=(1e-3, [1e-3, 1e-3, -1e-3, 1e-3, 1e-3])), r"spacing\[1\]\[2\] = -0.001.*above 0"),
    "ragged": (dict(spacing=(1e-3, [[1e-3], [1e-3, 2e-3]])), r"spacing\[1\] must be an array of numbers"),
    "wide": (dict(spacing=([1e-3, 1e-3, 3e-4, 1e-3], 1e-3)), "warp yarns 2 and 3 are .* 0.0003 m apart"),
    "crimp": (dict(crimp=-0.1), r"crimp = -0.1.*at least 0"),
    "crimps": (dict(crimp=(0.0, [0.1] * 4)), r"crimp\[1\] has 4 numbers, must be one, or 6"),
    "pairs": (dict(shear=[[1.0, 2.0]]), r"shear has shape \(1, 2\), must be a number, \(1, 1\).*\(30,\): by node"),
    "pair": (dict(friction=[[-1.0]]), r"friction\[0, 0\] = -1.0.*at least 0"),
    "node": (dict(friction_stiffness=np.zeros(30)), r"friction_stiffness\[0\] = 0.0.*above 0"),
    "none": (dict(friction_damping=[]), r"friction_damping = \[\]"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_refused(what: str) -> None:
    options, message = REFUSED[what]
    with pytest.raises(wy.InputError, match=message):
        wy.Cloth(PLAIN, **SMALL, **options)


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ({"width": 1e-3}, "width = 0.001 and thickness = None, must both be given"),
        ({"thickness": 1e-3}, "width = None and thickness = 0.001, must both be given"),
        ({"radius": 1e-3, "width": 1e-3, "thickness": 1e-3}, "must be radius, or width and thickness"),
        ({"radius": 0.0}, r"radius = 0\.0.*above 0"),
        ({"width": 1e-3, "thickness": float("nan")}, "thickness = nan.*finite"),
    ],
)
def test_sizes_that_are_refused(sizes: dict, message: str) -> None:
    with pytest.raises(wy.InputError, match=message):
        dataclasses.replace(YARN, **sizes)


def test_a_registered_term_that_reads_one_number_is_refused() -> None:
    """It would read the first segment's."""
    from warp_yarn.kernels.terms import bending

    term = wy.Term("other_bending", "bends", bending.define, stencil=4, needs_contact=True, presses=True)
    wy.register_term(term)
    try:
        with pytest.raises(wy.InputError, match="'other_bending', which reads one 'radius' of the cloth"):
            wy.Simulator(wy.Scene(cloth("general"), terms=["stretch", "other_bending"]))
    finally:
        wy.unregister_term("other_bending")


# -- how it moves ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrator", ["linear", "sdirk2", "ros2"])
def test_the_same_numbers_everywhere_move_as_one_number_does(integrator: str) -> None:
    """As arrays, by the other kernels."""
    one = wy.Cloth(PLAIN, yarns=[YARN], radius=3e-4, friction_damping=0.1)
    every = one.replace(friction=np.full(30, one.friction))
    assert every.general and not one.general
    a, b = (wy.Simulator(hung(c), integrator=integrator).run(10) for c in (one, every))
    # L/R of the lock is once 1/sin(φ_l/2): rounding, which ten steps of 5 m/s wind make some more of
    assert np.abs(a.position - b.position).max() < 1e-13
    assert np.abs(a.euler - b.euler).max() < 1e-13
    gradients = []
    for c, name in ((one, "friction"), (every, "node_friction")):
        rollout = wt.Rollout(hung(c), 10, integrator=integrator, tolerance=EXACT)
        value = rollout.defaults["friction"].clone().requires_grad_()
        (rollout(**{name: value}).euler[-1] * 1e6).pow(2).sum().backward()
        gradients.append(float(value.grad.sum()))
    assert gradients[0] != 0.0 and gradients[1] == pytest.approx(gradients[0], rel=1e-8)


@pytest.mark.parametrize("sliding", [True, False])
def test_a_cloth_stays_as_it_is_woven(sliding: bool) -> None:
    """Its yarns are unstrained, crimped or not, and far enough apart: nothing moves by more than rounding."""
    yarns = [dataclasses.replace(YARN, width=3e-4, thickness=1e-4), dataclasses.replace(YARN, radius=1e-4)]
    spacing = ([1e-3, 0.8e-3, 1.3e-3, 0.9e-3], [1e-3, 0.7e-3, 1.1e-3, 1.4e-3, 0.9e-3])
    c = wy.Cloth(PLAIN, yarns=yarns, spacing=spacing, crimp=(0.1, [0.0, 0.02, 0.05, 0.0, 0.1, 0.03]), pose="flat")
    run = wy.Simulator(wy.Scene(c, gravity=None, sliding=sliding)).run(20)
    assert np.abs(run.position[-1] - c.position).max() < 1e-15
    assert np.abs(run.euler[-1] - c.euler).max() < 1e-15


def test_a_cloth_of_two_setts_stretches_by_its_yarns() -> None:
    """Pulled along u by F, a cloth gets longer by F l / Σ k_s (1 + crimp) of its warp yarns, each with its section."""
    yarns = [dataclasses.replace(YARN, width=6e-4, thickness=2e-4), dataclasses.replace(YARN, radius=2e-4)]
    c = wy.Cloth(PLAIN, yarns=yarns, spacing=(0.8e-3, [1e-3, 2e-3, 1e-3, 1.5e-3, 1e-3]), crimp=(0.1, 0.0), pose="flat")
    x = c.position.copy()
    strain = 1e-6
    x[:, 0] *= 1.0 + strain
    simulator = wy.Simulator(wy.Scene(c, terms=["stretch"]))
    state = dataclasses.replace(simulator.state, position=x)
    pulled = simulator.forces(state)["stretch"][0].reshape(5, 6, 3)[:, 0, 0]
    sections = np.pi * np.array([3e-4 * 1e-4 if j % 2 == 0 else 4e-8 for j in range(5)])
    # kₛ (1 + c)(|w| (1 + c) − 1) = kₛ (1 + c) · strain
    assert pulled == pytest.approx(5e5 * sections * 1.1 * strain, rel=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_random_numbers(seed: int) -> None:
    """Forces are the oracle's, whatever the numbers are, and a run ends well or in an error of ours."""
    random = np.random.default_rng(seed)
    rows, columns, kinds = (int(n) for n in random.integers((3, 3, 1), (6, 7, 4)))
    gaps = [10.0 ** random.uniform(-3.5, -2.5, n - 1) for n in (rows, columns)]
    room = min(gap.min() for gap in gaps)
    yarns = [
        wy.Yarn(
            density=10.0 ** random.uniform(-5, -3),
            stretch=10.0 ** random.uniform(4, 8),
            bend=10.0 ** random.uniform(-5, -3),
            width=room * random.uniform(0.1, 1.0),
            thickness=room * random.uniform(0.05, 1.0),
        )
        for _ in range(kinds)
    ]
    c = wy.Cloth(
        wy.Weave(random.integers(0, 2, (rows, columns))),
        yarns=yarns,
        spacing=tuple(gaps),
        crimp=tuple(random.uniform(0.0, 0.2, n) for n in (rows, columns)),
        shear=random.uniform(10.0, 1e5, (kinds, kinds)),
        friction=random.uniform(0.0, 1.0, rows * columns),
        pose="flat",
    )
    scene = hung(c)
    simulator, oracle = wy.Simulator(scene), Oracle(scene)
    state = simulator.state
    state.position += 0.1 * room * random.uniform(-1.0, 1.0, state.position.shape)
    inside = (c.topology.is_crossing != 0)[:, None]
    state.euler += 0.1 * room * random.uniform(-1.0, 1.0, state.euler.shape) * inside
    q = tensor(np.concatenate([state.position.ravel(), state.euler.ravel()]))
    still = torch.zeros_like(q)
    for term, (x, s) in simulator.forces(state).items():
        expected = oracle.force(term, q, still, tensor(state.anchor.ravel())).numpy()
        found = np.concatenate([x.ravel(), s.ravel()])
        # of sums of some tens of numbers, and of a normal whose gap is some 1e-2
        assert np.abs(found - expected).max() <= 1e-11 * max(np.abs(expected).max(), 1e-12), term
    simulator.state = state
    try:
        run = simulator.run(20)
    except wy.SimulationError as error:
        run = error.trajectory
    assert np.isfinite(run.position).all() and np.isfinite(run.euler).all()


def test_several_cloths_of_different_numbers_move_as_they_do_alone() -> None:
    one = wy.Cloth(PLAIN, yarns=[YARN], friction_damping=0.1)
    other = dict(GENERAL)
    other["pose"] = wy.Cloth(PLAIN, **{**GENERAL, "pose": "flat"}).position + np.array([0.0, 0.0, 0.1])
    two = wy.Cloth(PLAIN, **other)
    both = wy.Cloths([one, two])
    assert both.general
    options = {"tolerance": 1e-12, "newton_tolerance": 1e-10, "preconditioner": "incomplete"}
    together = wy.Simulator(wy.Scene(both, wind=WIND), **options).run(5)
    for k, c in enumerate((one, two)):
        alone = wy.Simulator(wy.Scene(c, wind=WIND), **options).run(5)
        assert np.abs(together.position[:, both.nodes_of(k)] - alone.position).max() < 1e-11
        assert np.abs(together.euler[:, both.nodes_of(k)] - alone.euler).max() < 1e-11


def test_the_choice_of_a_preconditioner_goes_by_the_stiffest_segment() -> None:
    """k_s h²/(m L): of one short gap among long ones."""
    soft = wy.Cloth(PLAIN, **SMALL, spacing=(1e-2, 1e-2 * np.linspace(1.0, 1.1, 5)), friction_damping=0.0)
    step = 1.7 * 1e-2 / math.sqrt(YARN.stretch * np.pi * 4e-8 / YARN.density)
    assert defaults.preconditioner(wy.Scene(soft), step) == "incomplete"
    short = soft.replace(spacing=(1e-2, [1e-2, 1e-3, 1e-2, 1e-2, 1e-2]))
    assert defaults.preconditioner(wy.Scene(short), step) == "multilevel"


def test_contact_goes_by_the_thickest_yarn_and_the_longest_gap() -> None:
    """So that no yarn of another layer finds a hole to pass through."""
    scene = wy.Scene(cloth("general"), obstacles=[wy.Plane(point=(0, 0, -1), normal=(0, 0, 1))], self_contact=True)
    arrays = wy.Simulator(scene).arrays
    of = {name: float(arrays[name].numpy()[0]) for name in arrays if name.endswith(("contact_distance", "range"))}
    assert of["contact_distance"] == of["contact_range"] == 3.2e-4
    assert of["self_contact_distance"] == pytest.approx(1.5 * 1.4e-3)
    assert of["self_contact_range"] == pytest.approx(1.4e-3)


# -- gradients and learning ------------------------------------------------------------------------------------------

INPUTS = (
    "yarn_density", "yarn_stretch", "yarn_bend", "shear", "node_friction", "friction_stiffness",
    "node_friction_damping", "parallel_stiffness", "wind_velocity", "position", "euler", "velocity", "euler_velocity",
)  # fmt: skip


@pytest.mark.parametrize("integrator", ["linear", "sdirk2", "ros2"])
def test_gradients(integrator: str) -> None:
    """Along a random direction of every input, of a random combination of all that the last frame holds."""
    c = cloth("general")
    # iterations to rounding: what they leave is noise of the differences
    rollout = wt.Rollout(hung(c), 2, frames=[2], integrator=integrator, tolerance=EXACT, newton_tolerance=1e-13)
    state = jittered(c, size=0.2)
    del state["anchor"]
    function, inputs = scaled(rollout, INPUTS, state)
    random = torch.Generator().manual_seed(1)
    weights = [torch.randn(out.shape, dtype=out.dtype, generator=random) for out in function(*inputs)]

    def loss(*values: torch.Tensor) -> torch.Tensor:
        return sum((out * weight).sum() for out, weight in zip(function(*values), weights, strict=True))

    gradients = torch.autograd.grad(loss(*inputs), inputs)
    for k, name in enumerate(INPUTS):
        direction = torch.randn(inputs[k].shape, dtype=torch.float64, generator=random)

        def along(h: float, k: int = k, direction: torch.Tensor = direction) -> float:
            moved = [value.detach() + h * direction if j == k else value.detach() for j, value in enumerate(inputs)]
            with torch.no_grad():
                return float(loss(*moved))

        h = 3e-6
        expected = (8.0 * (along(h) - along(-h)) - along(2.0 * h) + along(-2.0 * h)) / (12.0 * h)
        found = float((gradients[k] * direction).sum())
        # 400 numbers near 1 that iterations leave 1e-12 uncertain, √400 · 1e-12 over 3e-6
        assert found == pytest.approx(expected, rel=1e-5, abs=7e-6), name


def test_shapes_of_inputs() -> None:
    rollout = wt.Rollout(hung(cloth("general")), 1)
    shapes = {"shear": (3, 3), "friction": (30,), "node_shear": (30,), "density": (3,), "yarn_density": (11,)}
    assert {name: rollout.inputs[name] for name in shapes} == shapes
    with pytest.raises(wy.InputError, match="shear and node_shear are both given"):
        rollout(shear=np.ones((3, 3)), node_shear=np.ones(30))
    with pytest.raises(wy.InputError, match=r"node_friction\[3\] = -1"):
        rollout(node_friction=np.where(np.arange(30) == 3, -1.0, 1.0))
    with pytest.raises(wy.InputError, match="'node_shear' is no input"):
        wt.Rollout(hung(cloth("plain")), 1)(node_shear=np.ones(25))


def test_a_fabric_learns_pairs() -> None:
    fabric = wt.Fabric(hung(cloth("general")), 2, learn={"shear": (1.0, 2000.0), "node_friction": (0.0, 1.0)})
    assert fabric.value("shear").detach().numpy() == pytest.approx(np.array(GENERAL["shear"]))
    assert fabric.value("node_friction").detach().numpy() == pytest.approx(GENERAL["friction"])
    (fabric().position[-1] * 1e3).square().sum().backward()
    assert torch.isfinite(fabric.y["shear"].grad).all() and fabric.y["shear"].grad.abs().max() > 0.0


def test_calibration_names_pairs_and_nodes() -> None:
    """By their places in the flattened array; what is not learned stays."""
    scene = hung(cloth("general"))
    counts = wl.learnable(scene)
    assert (counts["shear"], counts["friction"], counts["parallel_stiffness"]) == (9, 30, None)
    assert wl.value_of(scene, "shear[5]") == 300.0
    changed = wl.with_values(scene, {"shear[5]": 310.0, "stretch[1]": 2e5})
    assert changed.cloth.shear[1, 2] == 310.0 and changed.cloth.shear[1, 1] == 1200.0
    assert changed.cloth.yarns[1].stretch == 2e5 and changed.cloth.yarns[1].radius == 2.7e-4
    assert np.array_equal(changed.cloth.euler, scene.cloth.euler)
    with pytest.raises(wy.InputError, match=r"'shear', must have an index from 0 to 8"):
        wl.value_of(scene, "shear")
    target = wy.Simulator(scene).run(4)
    parameters = [wl.Parameter("shear[5]", 100.0, 500.0, 400.0), wl.Parameter("friction[8]", 0.1, 0.9, 0.5)]
    problem = wl.CalibrationProblem(scene, target, parameters)
    loss, gradient = problem.loss_and_gradient(problem.start)
    assert loss > 0.0 and gradient.shape == (2,)
    h = np.array([0.01, 0.0])
    slope = (problem.loss(problem.start + h) - problem.loss(problem.start - h)) / (2.0 * h[0])
    assert gradient[0] == pytest.approx(slope, rel=1e-4)


# -- files and pictures ----------------------------------------------------------------------------------------------


def test_recordings(tmp_path) -> None:
    scene = hung(cloth("general"))
    run = wy.Simulator(scene).run(2)
    run.save(tmp_path / "run.npz")
    read = wy.Trajectory.load(tmp_path / "run.npz")
    assert read == run and read.scene.same_as(scene)
    assert read.cloth.yarns[:2] == tuple(dataclasses.replace(yarn) for yarn in scene.cloth.yarns[:2])
    assert pickle.loads(pickle.dumps(wy.Simulator(scene))).scene.same_as(scene)
    other = scene.cloth.replace(crimp=0.0)
    assert not other.same_as(scene.cloth)


def test_yarns_are_drawn_at_their_sizes() -> None:
    """A warp yarn passes under by half its own thickness, a weft yarn over by its own; its section is its own too."""
    from warp_yarn.view.yarns import Weaving

    c = cloth("general")
    weaving = Weaving(c)
    assert [part.half[0, 1] for part in weaving.strands] == pytest.approx([1.7e-4, 2.7e-4, 3.2e-4])
    for part in weaving.strands:
        np.testing.assert_array_equal(part.half, c.halves[part.yarn])
        height = np.abs(part.points(*weaving.look(c.position))[:, 2])
        # less of free ends alone
        assert height.max() == pytest.approx(part.half[0, 1])
        np.testing.assert_allclose(height[part.places < c.nodes], part.half[0, 1], rtol=1e-12)
        assert height[part.places >= c.nodes].max() < 0.9 * part.half[0, 1]


def test_crimped_yarns_are_drawn_as_far_apart_as_they_are() -> None:
    """Crimp makes the arcs along yarns longer, and nothing of what is drawn other than it is without."""
    from warp_yarn.view.yarns import Tubes, Weaving

    crimped = cloth("general").replace(crimp=(0.3, 0.1))
    plain, long = (Weaving(c, selvedge=True) for c in (crimped.replace(crimp=0.0), crimped))
    for one, other in zip(plain.look(crimped.position), long.look(crimped.position), strict=True):
        np.testing.assert_array_equal(one, other)
    for one, other in zip(Weaving(crimped.replace(crimp=0.0)).strands, Weaving(crimped).strands, strict=True):
        crimp = np.repeat(other.crimp, other.counts)
        np.testing.assert_allclose(other.arc, (1.0 + crimp) * one.arc, rtol=1e-12)
        np.testing.assert_allclose(*(Tubes.around(each, samples=4).half for each in (one, other)), rtol=1e-6)
