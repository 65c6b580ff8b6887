"""Forces that a test reads: what pins give, by balances of momentum and energy, the strip test, and the work done."""

import dataclasses
import functools
import re
import warnings

import numpy as np
import pytest
from cases import quick
from internals import make_in_parts, room_for_near
from warp_yarn.kernels.core.status import GAINED, STALLED

import warp_yarn as wy
from warp_yarn.integrators import INTEGRATORS

METHODS = tuple(name for name in INTEGRATORS if name != "esdirk3")
GRAVITY = np.array([0.0, 0.0, -9.8])
EXACT = {"newton_tolerance": 1e-11, "tolerance": 1e-13}
"""Solves to rounding, so that what a balance lacks is no solver's."""


def momentum(cloth: wy.Cloth, state: wy.State) -> np.ndarray:
    """Of every segment its mass ρ Δs times the mean velocity of its ends: the mass matrix of physics.md, summed."""
    topology = cloth.topology
    direction = topology.yarn_direction[topology.segment_yarn]
    density = np.array([yarn.density for yarn in cloth.yarns])[cloth.material][topology.segment_yarn]
    a, b = topology.segment_nodes.T
    length = state.euler[b, direction] - state.euler[a, direction]
    return ((density * length)[:, None] * (state.velocity[a] + state.velocity[b]) / 2.0).sum(axis=0)


def weight(cloth: wy.Cloth) -> np.ndarray:
    """Density times length of all segments, times gravity."""
    topology = cloth.topology
    density = np.array([yarn.density for yarn in cloth.yarns])[cloth.material][topology.segment_yarn]
    a, b = topology.segment_nodes.T
    return (density * np.abs(cloth.euler[b] - cloth.euler[a]).max(axis=1)).sum() * GRAVITY


def moved(stiffness: float | None, *, sliding: bool = False, fabric=wy.paper.cloth, **options) -> wy.Scene:
    cloth = fabric(rows=5, columns=5)
    pins = cloth.corners("top")
    way = np.linspace(0.0, 1.0, 9)[1:, None, None] * np.array([0.3e-3, 0.5e-3, 1e-3])
    path = cloth.position[pins] + way
    return wy.Scene(cloth, pins=pins, pin_stiffness=stiffness, pin_path=path, sliding=sliding, **options)


@pytest.mark.parametrize("stiffness", [1e4, None], ids=["springs", "exact"])
@pytest.mark.parametrize("method", METHODS)
def test_reactions_close_the_balance_of_momentum_of_every_step(method, stiffness):
    scene = moved(stiffness)
    simulator = wy.Simulator(scene, integrator=method, **EXACT)
    trajectory = simulator.run(10)
    found = simulator.reactions(trajectory)
    p = np.array([momentum(scene.cloth, trajectory[k]) for k in range(11)])
    change = np.diff(p, axis=0) / simulator.step_size
    # springs of 1e4 N/m times the rounding of 0.01 m positions are 1e-14 N, stretch's are less, over ten nodes
    assert np.abs(change - weight(scene.cloth) - found.sum(axis=1)).max() < 1e-11
    # and that is far below what there is
    assert np.abs(found.sum(axis=1)).max() > 1e-3
    np.testing.assert_array_equal(simulator.reactions(), found[-1])


@pytest.mark.parametrize("method", quick(METHODS, "sdirk2", "linear"))
def test_a_cloth_that_slides_needs_no_other_pull(method):
    """Sliding hardly moves mass along: locked and sliding yarns of the paper pull alike."""
    forces = []
    for sliding in (False, True):
        simulator = wy.Simulator(moved(None, sliding=sliding), integrator=method, **EXACT)
        forces.append(simulator.reactions(simulator.run(8)))
    # friction's damping of 1000 N s/m lets them slide by some 1e-7 of a spacing
    np.testing.assert_allclose(forces[0], forces[1], atol=1e-5 * np.abs(forces[0]).max())


@pytest.mark.parametrize("method", quick(["linear", "implicit-euler", "sdirk2"], "sdirk2"))
def test_stiff_springs_and_exact_pins_agree(method):
    """Two ways that have no line in common: k (x_pin − x), and what is left of the equation of a node. (Methods that do
    not damp stiff springs swing on.)"""
    soft, stiff = (
        wy.Simulator(moved(None, wind=wy.Wind(velocity=(0, 3, 0))).replace(pin_stiffness=k), integrator=method, **EXACT)
        for k in (None, 1e7)
    )
    exact, springs = (simulator.reactions(simulator.run(8)) for simulator in (soft, stiff))
    # a spring gives way by 1e-10 m at 1e-3 N, of segments that take 1e-5 m for as much
    np.testing.assert_allclose(springs, exact, atol=5e-2 * np.abs(exact).max())


def test_pins_of_a_still_cloth_carry_its_weight():
    for fabric in wy.fabrics.FABRICS.values():
        cloth = fabric(rows=5, columns=5)
        simulator = wy.Simulator(wy.Scene(cloth, pins=cloth.corners("top"), pin_stiffness=None))
        simulator.relax()
        simulator.run(1)
        # a step from where forces are less than 1e-3 of a node's weight
        np.testing.assert_allclose(simulator.reactions().sum(axis=0), -weight(cloth), atol=1e-3 * -weight(cloth)[2])


@functools.cache
def released(stiffness: float | None) -> tuple[wy.Simulator, wy.Trajectory]:
    """A stretched cloth that is let go, whose first step is made in parts by the fallback."""
    cloth = wy.paper.cloth(rows=7, columns=7, pose="flat")
    simulator = wy.Simulator(wy.Scene(cloth, pins=[0], pin_stiffness=stiffness), newton_tolerance=1e-8)
    state = simulator.state
    state.position[:] = cloth.position[0] + 1.3 * (cloth.position - cloth.position[0])
    simulator.state = state
    return simulator, simulator.run(3)


@pytest.mark.parametrize("stiffness", [1e4, None])
def test_a_step_in_parts_has_the_impulse_of_its_parts(stiffness):
    simulator, trajectory = released(stiffness)
    assert simulator.split_steps and simulator.damped_steps
    before = simulator.state, simulator.substepping.counts, simulator.trajectory
    found = simulator.reactions(trajectory).sum(axis=1)
    assert before == (simulator.state, simulator.substepping.counts, simulator.trajectory)
    cloth = simulator.scene.cloth
    p = np.array([momentum(cloth, trajectory[k]) for k in range(4)])
    lack = np.diff(p, axis=0) / simulator.step_size - weight(cloth) - found
    # newton_tolerance leaves 1e-8 of each node's change, of 49 nodes; yarns slide 1e-6 of a segment, and mass with them
    assert np.abs(lack).max() < 1e-4 * np.abs(found).max()
    assert np.isfinite(found).all() and np.abs(found).max() > 1e-2


def test_steps_that_follow_their_error_too():
    cloth = wy.paper.cloth(rows=4, columns=4)
    scene = wy.Scene(cloth, pins=[0], pin_stiffness=None, sliding=False)
    simulator = wy.Simulator(scene, step=4e-3, step_error=1e-4, newton_tolerance=1e-8)
    trajectory = simulator.run(3)
    assert simulator.substepping.accepted > 6
    p = np.array([momentum(cloth, trajectory[k]) for k in range(4)])
    found = simulator.reactions(trajectory).sum(axis=1)
    # parts that are made again are others, each off by 1e-4 of a spacing
    np.testing.assert_allclose(np.diff(p, axis=0) / 4e-3 - weight(cloth), found, atol=1e-3 * np.abs(found).max())


def test_a_step_that_ends_elsewhere_is_not_known():
    simulator, trajectory = released(None)
    other = wy.Trajectory(trajectory.cloth, trajectory.step, *(getattr(trajectory, n)[:2].copy() for n in NAMES))
    other.position[1, 5] += 1e-3
    with pytest.warns(wy.WarpYarnWarning, match="step 1 was made in parts, which cannot be made again"):
        assert np.isnan(simulator.reactions(other)[0]).all()


NAMES = ("position", "euler", "velocity", "euler_velocity", "anchor")


# -- a strip test ------------------------------------------------------------------------------------------------------


def strip(stiffness: float | None) -> tuple[wy.Simulator, float]:
    """A strip of cotton that is pulled by 2 % of its length, and what that takes: k_s times the strain of each yarn."""
    cloth = wy.fabrics.cotton(rows=9, columns=4, pose="flat")
    ends = [cloth.node(row, i) for row in (0, -1) for i in range(4)]
    length = 8 * cloth.spacing
    path = np.repeat(cloth.position[ends][None], 10, axis=0)
    path[:, 4:, 1] += np.linspace(0.002, 0.02, 10)[:, None] * length
    scene = wy.Scene(cloth, gravity=None, pins=ends, pin_stiffness=stiffness, pin_path=path)
    simulator = wy.Simulator(scene)
    simulator.run(10)
    return simulator, 4 * 20.0 * 0.02


def test_a_strip_test_reads_what_the_yarns_carry():
    simulator, wanted = strip(None)
    pull = simulator.relax().reactions
    # yarns are straight, but for the crimp that crossings press into them, which the model leaves to bending
    assert pull[4:, 1].sum() == pytest.approx(wanted, rel=2e-3)
    assert pull[:4, 1].sum() == pytest.approx(-wanted, rel=2e-3)
    simulator.run(1)
    np.testing.assert_allclose(simulator.reactions(), pull, atol=1e-4 * wanted)


def test_soft_springs_read_too_little_and_say_so():
    simulator, wanted = strip(1e4)
    pull = simulator.relax().reactions[4:, 1].sum()
    # yarns of k_s/length between two springs
    yarn = 20.0 / (8 * simulator.scene.cloth.spacing)
    assert pull == pytest.approx(wanted / (1.0 + 2.0 * yarn / 1e4), rel=5e-3)
    assert pull < 0.5 * wanted
    simulator.run(1)
    with pytest.warns(wy.WarpYarnWarning, match=r"pins give way by .* m, .* % of the way .*pin_stiffness=None"):
        simulator.reactions()


@pytest.mark.filterwarnings("error")
def test_springs_that_hold_are_no_matter():
    simulator = wy.Simulator(moved(1e4))
    simulator.reactions(simulator.run(9))


# -- work --------------------------------------------------------------------------------------------------------------


def watched(simulator: wy.Simulator, steps: int) -> tuple[float, dict[str, float]]:
    """How much energy the steps bring, and the work of each that was done; pins and obstacles are where they are."""
    first, total = sum(simulator.energy().values()), {}
    for _ in range(steps):
        simulator.run(1)
        for name, value in simulator.work().items():
            total[name] = total.get(name, 0.0) + value
    return sum(simulator.energy().values()) - first, total


@pytest.mark.parametrize("stiffness", [1e4, None], ids=["springs", "exact"])
def test_work_is_what_the_energy_gains(stiffness):
    """The implicit midpoint rule dissipates nothing; its error of energy falls with the square of the step."""
    lacks = []
    for parts in (4, 8):
        scene = moved(stiffness)
        rows = np.concatenate([scene.cloth.position[scene.pins][None], scene.pin_path])
        scene = scene.replace(pin_path=_finer(rows, parts), forces={24: (0.0, 1e-3, 0.0)})
        simulator = wy.Simulator(scene, integrator="implicit-midpoint", step=1e-3 / parts, **EXACT)
        gain, work = watched(simulator, 12 * parts)
        assert set(work) == {"pins", "applied"}
        lacks.append(abs(gain - sum(work.values())) / sum(map(abs, work.values())))
    # a hundredth at steps of a tenth of a segment's period, and a quarter of that at half of them, with room
    assert lacks[0] < 2e-2
    assert lacks[1] < 0.5 * lacks[0]


def _finer(rows: np.ndarray, parts: int) -> np.ndarray:
    """Rows between rows."""
    share = np.arange(1, parts + 1)[None, :, None, None] / parts
    return (rows[:-1, None] + (rows[1:] - rows[:-1])[:, None] * share).reshape(-1, *rows.shape[1:])


@pytest.mark.parametrize("method", quick(METHODS, "sdirk2", "linear"))
def test_an_applied_force_does_its_work(method):
    """A constant force along the way of its node; the sum telescopes where a method goes by the velocity that it
    ends with."""
    cloth = wy.paper.cloth(rows=4, columns=4)
    force = np.array([0.0, 2e-4, 1e-4])
    scene = wy.Scene(cloth, pins=cloth.corners("top"), forces={15: force}, wind=wy.Wind(velocity=(0, 3, 0)))
    simulator = wy.Simulator(scene, integrator=method)
    trajectory = simulator.run(20)
    work = simulator.work(trajectory)
    wanted = float(force @ (trajectory.position[-1, 15] - trajectory.position[0, 15]))
    assert work["applied"].sum() == pytest.approx(wanted, rel=1e-9)
    assert work["wind"].sum() > 0.0
    assert work["pins"].shape == (20,) and not work["pins"].any()
    last = simulator.work()
    assert last == {name: values[-1] for name, values in work.items()}


def test_an_obstacle_that_is_moved_does_work():
    """It lifts a cloth that lies on it: gravity's energy, and what moves."""
    cloth = wy.fabrics.handkerchief(rows=4, columns=4, pose="flat")
    path = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (60, 1))
    start = -2.0 * cloth.radius
    path[:, 2] = start + 1e-3 * np.linspace(0.0, 1.0, 61)[1:] ** 2
    plane = wy.Plane(point=(0, 0, start), normal=(0, 0, 1), path=path)
    simulator = wy.Simulator(wy.Scene(cloth, obstacles=[plane]), integrator="sdirk2")
    gain, work = watched(simulator, 60)
    assert set(work) == {"contact"} and gain > 0.0
    # what the barrier's normal damping takes
    assert gain == pytest.approx(work["contact"], rel=0.1)


# -- what cannot be asked ----------------------------------------------------------------------------------------------


def test_no_step_has_no_reaction():
    simulator = wy.Simulator(moved(None))
    with pytest.raises(wy.InputError, match="no step was made since the state was set"):
        simulator.reactions()
    simulator.run(1)
    simulator.reactions()
    simulator.state = simulator.state
    with pytest.raises(wy.InputError, match="no step was made"):
        simulator.work()
    simulator.run(2)
    simulator.steps_done = 0
    with pytest.raises(wy.InputError, match="no step was made"):
        simulator.reactions()


def test_frames_of_another_run_are_refused():
    simulator = wy.Simulator(moved(None))
    trajectory = simulator.run(2)
    with pytest.raises(wy.InputError, match=r"trajectory = 3, must be a Trajectory"):
        simulator.reactions(3)
    with pytest.raises(wy.InputError, match=r"trajectory.step = 0.001, must be 0.002"):
        wy.Simulator(moved(None), step=2e-3).reactions(trajectory)
    with pytest.raises(wy.InputError, match=r"trajectory\.cloth is another one"):
        wy.Simulator(moved(None, fabric=wy.fabrics.cotton)).reactions(trajectory)


def test_frames_that_are_not_those_of_steps_are_refused():
    """Between frames that skip steps, or lie between two, there is no step to look into."""
    trajectory = wy.Simulator(moved(None)).run(6)
    simulator = wy.Simulator(moved(None))
    film = simulator.run(6, fps=400.0)
    for frames, every in ((trajectory[::2], "2"), (film, "2.5")):
        with pytest.raises(wy.InputError, match=rf"trajectory\.every = {every}, must be 1"):
            simulator.reactions(frames)
        with pytest.raises(wy.InputError, match=rf"trajectory\.every = {every}, must be 1"):
            simulator.work(frames)
    np.testing.assert_array_equal(simulator.reactions(trajectory[2:5]), simulator.reactions(trajectory)[2:4])


FABRICS = {"paper": wy.paper.cloth, "handkerchief": wy.fabrics.handkerchief, "cotton": wy.fabrics.cotton}
PARTED = {"split": STALLED, "damped": GAINED}


@pytest.mark.parametrize("method", ["linear", "implicit-euler", "sdirk2"])
@pytest.mark.parametrize("fabric", FABRICS)
@pytest.mark.parametrize("how", PARTED)
@pytest.mark.parametrize("stiffness", [1e4, None], ids=["springs", "exact"])
def test_steps_in_parts_are_not_taken_for_one(stiffness, how, fabric, method):
    """What the simulator knows that made them, none other does; it is told what may be wrong, or is right."""
    if how == "damped" and INTEGRATORS[method].fallback is None:
        pytest.skip("makes no step again")
    scene = moved(stiffness, fabric=FABRICS[fabric])
    maker, other = (wy.Simulator(scene, integrator=method) for _ in range(2))
    make_in_parts(maker, {3: (PARTED[how], 0.6)})
    trajectory = maker.run(6)
    assert 4 in maker.split_steps and bool(maker.damped_steps) == (how == "damped")
    right = maker.reactions(trajectory)
    found, doubt = doubted(other, trajectory)
    if how == "damped" or (stiffness is None and fabric != "paper"):
        assert found is None
    elif not doubt:
        # soft yarns' steps come out much the same in parts and at once; an iteration more is not all of the way
        off = np.abs(found - right).max(axis=(1, 2)) / np.abs(right).max(axis=(1, 2))
        assert fabric == "paper" and off.max() < 0.06


def doubted(simulator: wy.Simulator, trajectory: wy.Trajectory) -> tuple[np.ndarray | None, str]:
    """Reactions, None where they are refused, and what is said against them."""
    told = r"step \d of the trajectory does not solve .* Ask who made it: .*simulator\.split_steps"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            found = simulator.reactions(trajectory)
        except wy.InputError as error:
            assert re.match(told, str(error)) and "no step of this simulator" in str(error)
            return None, str(error)
    assert all(re.match(told, str(warning.message)) for warning in caught)
    return found, str(caught[0].message) if caught else ""


@pytest.mark.parametrize("fabric", FABRICS)
@pytest.mark.parametrize("method", ["linear", "implicit-euler", "sdirk2"])
def test_frames_of_another_method_step_or_wind_are_refused(method, fabric):
    scene = moved(None, fabric=FABRICS[fabric], wind=wy.Wind(velocity=(0, 5, 0)))
    trajectory = wy.Simulator(scene, integrator=method).run(6)
    windy = scene.replace(wind=wy.Wind(velocity=(0, 15, 0)))
    others = {name: wy.Simulator(scene, integrator=name) for name in ("linear", "implicit-euler", "sdirk2")}
    others["shorter"] = wy.Simulator(scene, integrator=method, step=5e-4)
    others["wind"] = wy.Simulator(windy, integrator=method)
    assert np.isfinite(others.pop(method).reactions(trajectory)).all()
    # a recording of an older warp_yarn does not say what made it; its equations do
    bare = dataclasses.replace(trajectory, options=None, scene=None)
    for name, simulator in others.items():
        what = {"shorter": r"trajectory\.step", "wind": r"trajectory\.scene is another"}.get(name, "made by integrator")
        with pytest.raises(wy.InputError, match=what):
            simulator.reactions(trajectory)
        frames = dataclasses.replace(bare, step=5e-4) if name == "shorter" else bare
        found, doubt = doubted(simulator, frames)
        assert doubt
        # methods of order 1 are near to each other on soft yarns
        assert found is None or fabric == "paper"


@pytest.mark.parametrize("chunk", [1, 4])
def test_reactions_as_frames_come(chunk):
    """The last step is that before the frame, or the one that it lies in."""
    expected = wy.Simulator(moved(None)).run(6)
    expected = wy.Simulator(moved(None)).reactions(expected)
    for fps, steps in ((None, range(7)), (500.0, range(0, 7, 2)), (400.0, (0, 3, 5))):
        simulator = wy.Simulator(moved(None), chunk=chunk)
        frames = simulator.frames(6, fps=fps)
        next(frames)
        with pytest.raises(wy.InputError, match="no step was made"):
            simulator.reactions()
        found = [(simulator.steps_done, simulator.reactions(), simulator.work()["pins"]) for _ in frames]
        assert [step for step, _, _ in found] == list(steps[1:])
        for step, forces, work in found:
            np.testing.assert_array_equal(forces, expected[step - 1])
            assert np.isfinite(work)


def test_impact_zones_have_no_forces():
    cloth = wy.paper.cloth(rows=4, columns=4)
    plane = wy.Plane(point=(0, 0, -1.0), normal=(0, 0, 1), friction=0.0)
    contact = wy.Contact(method="impact-zones")
    scene = wy.Scene(cloth, pins=[0], obstacles=[plane], contact=contact)
    simulator = wy.Simulator(scene, integrator="linear")
    simulator.run(1)
    for ask in (simulator.reactions, simulator.work, simulator.relax):
        with pytest.raises(wy.InputError, match="impact zones have no forces"):
            ask()


def test_looking_leaves_no_trace():
    ways = []
    for look in (False, True):
        simulator = wy.Simulator(moved(None, wind=wy.Wind(velocity=(0, 3, 0))))
        for _ in range(4):
            simulator.run(2)
            if look:
                simulator.reactions()
                simulator.work()
        ways.append(simulator.state)
    assert ways[0] == ways[1]


def test_no_pin_no_reaction():
    simulator = wy.Simulator(wy.Scene(wy.paper.cloth(rows=4, columns=4)))
    assert simulator.reactions(simulator.run(2)).shape == (2, 0, 3)
    assert simulator.work() == {}


# -- cloths of several numbers, contact, single precision --------------------------------------------------------------


def uneven(rows: int = 5, columns: int = 5, pose: str = "flat") -> wy.Cloth:
    """Yarns of two sizes, unequal distances, crimp, and crossings by pairs of materials."""
    yarns = [
        wy.Yarn(density=4e-5, stretch=2e8, bend=1e-3, width=3e-4, thickness=1.5e-4),
        wy.Yarn(density=2e-5, stretch=1e8, bend=2e-3, radius=1e-4),
    ]
    spacing = np.linspace(4e-4, 6e-4, rows - 1), np.linspace(7e-4, 4e-4, columns - 1)
    return wy.Cloth(
        wy.Weave.plain(rows=rows, columns=columns), yarns=yarns, warp=[0] * rows, weft=[1] * columns, spacing=spacing,
        crimp=(0.05, 0.1), shear=[[1e3, 500.0], [800.0, 300.0]], friction=0.3, pose=pose,
    )  # fmt: skip


def lack(cloth: wy.Cloth, trajectory: wy.Trajectory, outer: np.ndarray) -> np.ndarray:
    """What the change of momentum lacks of outer forces [steps, 3]."""
    p = np.array([momentum(cloth, state) for state in map(trajectory.__getitem__, range(len(trajectory)))])
    return np.diff(p, axis=0) / trajectory.step - outer


@pytest.mark.parametrize("crimp", [{}, {"crimp_interchange": True}, {"contact_force": "crimped"}], ids=str)
@pytest.mark.parametrize("method", quick(METHODS[:3], "sdirk2"))
def test_uneven_cloths_close_the_balance_too(method, crimp):
    scene = moved(None, fabric=uneven, gravity=np.repeat([[0.0, 0.0, -9.8], [1.0, 2.0, -5.0]], 4, axis=0), **crimp)
    simulator = wy.Simulator(scene, integrator=method, **EXACT)
    trajectory = simulator.run(6)
    found = simulator.reactions(trajectory).sum(axis=1)
    outer = weight(scene.cloth)[2] / GRAVITY[2] * scene.gravity[:6] + found
    # as of a plain one
    assert np.abs(lack(scene.cloth, trajectory, outer)).max() < 1e-11
    assert np.abs(found).max() > 1e-5
    bound = 1e-10 * np.abs(found).max()
    np.testing.assert_allclose(simulator.reactions(), simulator.reactions(trajectory)[-1], atol=bound)


@pytest.mark.parametrize("fabric", [wy.fabrics.handkerchief, uneven], ids=["plain", "uneven"])
def test_what_touches_is_in_the_balance(fabric):
    """A pinned cloth on the ground and another on it: obstacles give to the cloths, and these to each other."""
    cloth = fabric(rows=5, columns=5, pose="flat")
    apart = max(1.5 * cloth.longest_spacing, 3.0 * cloth.half_thickness)
    other = cloth.replace(pose=cloth.position + np.array([0.0, 0.0, 1.2 * apart]))
    ground = wy.Plane(point=(0, 0, -1.5 * cloth.half_thickness), normal=(0, 0, 1), friction=0.5)
    scene = wy.Scene(
        [cloth, other], obstacles=[ground], self_contact=True, sliding=False, pins=[0, 4], pin_stiffness=None,
        gravity=(3.0, 0.0, -40.0),
    )  # fmt: skip
    # its one stage ends where the step does, so the forces there are those of the step
    simulator = wy.Simulator(scene, integrator="implicit-euler", **EXACT)
    rest, touching = [], []
    for _ in range(12):
        trajectory = simulator.run(1)
        given = simulator.forces()
        touching.append(np.abs(given["self_contact"][0]).max())
        outer = 2.0 * weight(cloth)[2] / GRAVITY[2] * scene.gravity + simulator.reactions().sum(axis=0)
        rest.append(lack(scene.cloth, trajectory, outer + given["obstacles"][0].sum(axis=0)))
    # rounding of 1e-2 N, over fifty nodes
    assert np.abs(rest).max() < 1e-13
    assert np.abs(simulator.reactions().sum(axis=0)).max() > 1e-3 and max(touching) > 1e-6


def test_reactions_in_single_precision_are_near_or_say_so():
    found = {}
    for precision in ("double", "single"):
        simulator = wy.Simulator(moved(None, fabric=wy.paper.cloth), precision=precision)
        found[precision] = simulator.reactions(simulator.run(6))
    # of 8e-3 N, of which rounding makes 1e-5 N in positions and as much in the solve
    np.testing.assert_allclose(found["single"], found["double"], atol=5e-3 * np.abs(found["double"]).max())
    simulator = wy.Simulator(wy.Scene(uneven(), pins=[0], pin_stiffness=None), precision="single")
    simulator.run(2)
    with pytest.warns(wy.WarpYarnWarning, match=r"single precision are rounded .* precision='double'"):
        simulator.reactions()


def test_frames_in_single_precision_are_told_to_be_rough_and_not_refused():
    """Rounding may be all that stiff yarns give: its own frames do not solve its equations."""
    simulator = wy.Simulator(moved(None, fabric=wy.fabrics.cotton), precision="single", integrator="implicit-euler")
    trajectory = simulator.run(8)
    with pytest.warns(wy.WarpYarnWarning, match=r"step \d of the trajectory does not solve .* precision='double'"):
        assert np.isfinite(simulator.reactions(trajectory)).all()


@pytest.mark.parametrize("ask", ["reactions", "forces", "energy", "system"])
def test_what_is_near_has_room_in_frames_that_no_step_came_to(ask, monkeypatch):
    """A simulator whose cloths were apart is asked of frames where they touch."""
    monkeypatch.setattr("warp_yarn.device.contact.NEAR_ROOM", 1)
    cloth = wy.fabrics.handkerchief(rows=4, columns=4, pose="flat")
    apart = max(1.5 * cloth.spacing, 3.0 * cloth.radius)
    other = cloth.replace(pose=cloth.position + np.array([0.0, 0.0, 3.0 * apart]))
    scene = wy.Scene([cloth, other], self_contact=True, gravity=None, pins=[0], pin_stiffness=None)
    # with no step in parts, of which the other one would not know
    first = wy.Simulator(scene, integrator="implicit-euler")
    state = first.state
    state.position[16:, 2] -= 1.5 * apart
    first.state = state
    trajectory = first.run(1)
    assert not first.split_steps
    other_one = wy.Simulator(scene, integrator="implicit-euler")
    room = room_for_near(other_one)
    of = trajectory if ask == "reactions" else trajectory[-1]
    here, there = (getattr(simulator, ask)(of) for simulator in (first, other_one))
    assert room_for_near(other_one) > room
    other_one.run(1)
    if ask == "reactions":
        assert np.abs(here).max() > 0.0
        np.testing.assert_allclose(there, here, rtol=1e-9)
    elif ask == "forces":
        assert np.abs(here["self_contact"][0]).max() > 0.0
        # sums over pairs in another order
        np.testing.assert_allclose(there["self_contact"][0], here["self_contact"][0], rtol=1e-9, atol=1e-15)
    elif ask == "energy":
        assert here["contact"] > 0.0 and there["contact"] == pytest.approx(here["contact"], rel=1e-12)
    else:
        np.testing.assert_allclose(there.rhs, here.rhs, rtol=1e-9, atol=1e-18)


def test_a_step_of_other_inputs_is_not_looked_into():
    """What the last step had is not in place any more."""
    cloth = wy.paper.cloth(rows=4, columns=4)
    ground = wy.Plane(point=(0, 0, -1.0), normal=(0, 0, 1))
    scene = wy.Scene(cloth, pins=cloth.corners("bottom"), pin_stiffness=None, obstacles=[ground])
    simulator = wy.Simulator(scene)
    for change in (
        lambda: simulator.set_inputs(gravity=(0.0, 0.0, -1.0)),
        lambda: simulator.place_obstacles([[0.0, 0.0, -1.2 * cloth.radius]]),
    ):
        simulator.run(1)
        before = simulator.reactions()
        change()
        for ask in (simulator.reactions, simulator.work):
            with pytest.raises(wy.InputError, match=r"no step was made since .* an input that the last one had"):
                ask()
        simulator.run(1)
        assert np.abs(simulator.reactions() - before).max() > 0.0
    with pytest.raises(wy.InputError):
        simulator.place_obstacles([[0.0, 0.0, 0.0]])
    simulator.reactions()
    # a row that no step has had is no change of it
    simulator = wy.Simulator(scene.replace(gravity=np.tile(GRAVITY, (5, 1))))
    simulator.run(2)
    before = simulator.reactions()
    simulator.set_inputs(gravity=(0.0, 0.0, 0.0))
    np.testing.assert_array_equal(simulator.reactions(), before)
