"""That the benchmarks compare like with like, and that the charts show what they say. Nothing is timed here."""

import csv
import dataclasses
import functools
import itertools
from typing import Any

import numpy as np
import pytest
from internals import add_array, array_arguments, halved, numbers, unneeded
from scripts import beside, exit_code, load

import warp_yarn as wy
from warp_yarn.simulation import ablation
from warp_yarn.simulation.ablation import ablate

solver = load("benchmarks/solver.py")
references = load("benchmarks/references.py")
work = load("benchmarks/work_precision.py")
equal = load("benchmarks/equal_error.py")
control = load("benchmarks/step_control.py")
sizes = load("benchmarks/sizes.py")
bandwidth = load("benchmarks/bandwidth.py")
terms = load("benchmarks/terms.py")
terms_scene = load("scenes/terms.py")
defaults = load("benchmarks/defaults.py")
iterations = load("benchmarks/iterations.py")
tensile = load("benchmarks/tensile_curve.py")
coarse = load("benchmarks/coarse.py")
motions = beside(work, "motions")


@pytest.fixture(autouse=True)
def on_all_cores(monkeypatch):
    """The tests' own process keeps its cores."""
    monkeypatch.setattr(bandwidth, "cores", lambda count: None)
    for module in (work, equal, control, sizes, terms):
        monkeypatch.setattr(module, "one_core", lambda: None)


def test_ours_and_scipy_solve_the_same_system_to_the_same_tolerance():
    ours = solver.simulators(5)
    result = solver.compare(ours)
    assert set(result) == {"default", "jacobi", "scipy"}
    # The tolerance is 1e-8 in the residual. The error is that times at most the condition number of the scaled matrix,
    # here some 1e3, and far less as a rule.
    for solution in result.values():
        assert solution["error"] < 1e-6
    # The same iterates, but for rounding: one may pass the tolerance an iteration before the other.
    assert abs(result["jacobi"]["iterations"] - result["scipy"]["iterations"]) <= 1
    assert result["jacobi"]["error"] == pytest.approx(result["scipy"]["error"], rel=0.5)
    assert result["default"]["iterations"] < result["jacobi"]["iterations"] / 3


def test_a_row_reaches_the_csv_file_with_the_environment(tmp_path):
    row = solver.benchmark(3, repeats=1, fabric="cotton")
    path = tmp_path / "results" / "solver.csv"
    solver.write_csv(path, [row], solver.environment("scipy"))
    with open(path, newline="") as file:
        (read,) = csv.DictReader(file)
    assert (read["fabric"], read["size"]) == ("cotton", "3 × 3")
    # 9 nodes of 3 unknowns, one crossing of 2
    assert read["unknowns"] == "29"
    assert float(read["scipy [ms]"]) > 0.0
    assert float(read["locked [ms]"]) > 0.0
    assert {"processor", "warp-lang", "scipy", "revision"} <= set(read)


# -- benchmarks/work_precision.py -------------------------------------------------------------------------------------


def timed(*seconds):
    return [work.Timing.of([s]) for s in seconds]


def curve_points(errors, seconds=None):
    """Points at halving steps, each costing twice as much."""
    seconds = seconds or [2.0**k for k in range(len(errors))]
    return [work.Point(2.0**-k, e, t, 0.0) for k, (e, t) in enumerate(zip(errors, timed(*seconds), strict=True))]


def test_extrapolation_takes_the_leading_powers_out():
    limit, rough = np.array([[1.0, 2.0, 3.0]]), np.array([[4.0, -5.0, 6.0]])
    for order in (1, 2):
        ends = [limit + rough * h**order + 7.0 * rough * h ** (order + 1) for h in (0.4, 0.2, 0.1)]
        np.testing.assert_allclose(references.extrapolated(ends, order), limit, rtol=1e-12)


def test_a_slope_is_fitted_to_what_is_charted():
    # of second order, but for an error above 1 %, and the last one
    points = curve_points([0.5, 0.008, 0.002, 0.0005, 0.0005])
    assert work.slope(points[:4], floor=0.0004) == pytest.approx(2.0)
    # a straight line through 3, 1, -1, -1, in powers of 2 above the last: 1.4 a step
    assert work.slope(points, floor=0.0004) == pytest.approx(1.4)
    # below the floor are all but two
    assert work.slope(points, floor=0.001) is None


def test_the_time_to_an_error_is_where_a_curve_stays_below_it():
    # 0.04 to 0.01 takes 1 to 2 s: 0.02 is half of the way in logarithms
    assert work.time_to(curve_points([0.04, 0.01]), 0.02) == (pytest.approx(2.0**0.5), False)
    # what was near by chance at the second step does not count
    assert work.time_to(curve_points([0.04, 0.01, 0.04, 0.01]), 0.02) == (pytest.approx(4.0 * 2.0**0.5), False)
    assert work.time_to(curve_points([0.01, 0.005]), 0.02) == (1.0, True)
    assert work.time_to(curve_points([0.04, 0.03]), 0.02) is None
    # a failed run is no point of the curve
    assert work.time_to(curve_points([None, 0.04, 0.01]), 0.02) == (pytest.approx(2.0 * 2.0**0.5), False)
    assert work.time_to([], 0.02) is None


@functools.cache
def short() -> Any:
    """The hung cloth for 5 ms: smooth, and every method is soon near."""
    return dataclasses.replace(motions.MOTIONS["hung"], duration=5e-3, finest=1e-3 / 128)


def test_steps_fit_into_the_motions():
    for motion in motions.MOTIONS.values():
        assert all(motion.steps(step) * step == pytest.approx(motion.duration) for step in work.STEPS)
    with pytest.raises(wy.InputError, match="whole times"):
        short().steps(3e-3)


def test_two_methods_agree_on_the_reference(monkeypatch):
    monkeypatch.setitem(motions.MOTIONS, "hung", short())
    found = references.reference(short(), 4)
    assert found.check in work.INTEGRATORS
    assert found.check != references.REFERENCE
    # seen: 9e-6; the errors below are 1000 times it
    assert found.uncertainty < 3e-5
    curve = work.Curve("hung", "linear", "double", None)
    monkeypatch.setattr(work, "STEPS", tuple(1e-3 / 2**k for k in range(5)))
    errors = [p.error for p in work.points(curve, 4, found, repeats=1, longest=60.0)]
    assert len(errors) == 5
    # first order; seen: 0.95 to 0.99
    assert np.log2(errors[-2] / errors[-1]) == pytest.approx(1.0, abs=0.1)
    # a curve ends before a run that would take too long
    assert len(work.points(curve, 4, found, repeats=1, longest=0.0)) == 1


def test_a_run_that_fails_is_a_point_with_a_reason(monkeypatch):
    # squares of such velocities are not finite
    monkeypatch.setitem(motions.MOTIONS, "hung", dataclasses.replace(short(), speed=(0.0, 0.0, 1e200)))
    curve = work.Curve("hung", "linear", "double", None)
    converged = references.Reference(np.zeros((16, 3)), 1.0, "none", 1e-5)
    failed = work.point(curve, 4, 1e-3, converged, repeats=1)
    assert failed.error is None
    assert "not finite" in failed.failure
    assert failed.timing.median > 0.0
    assert failed.columns(0.0)["error"] == "failed"
    fine = curve_points([0.04, 0.01])
    found = {curve: [*fine, failed]}
    (row,) = work.summary(found, floor=1e-3)
    assert row["failed"] == 1
    drawn = work.draw(found, {"hung": converged}, 4)
    assert any(line.get_marker() == "x" for line in drawn.axes[0].lines)


@pytest.mark.slow
def test_chart_1_from_the_command(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(motions.MOTIONS, "hung", short())
    monkeypatch.setattr(work, "STEPS", (1e-3, 5e-4, 2.5e-4))
    output, plot = tmp_path / "wp.csv", tmp_path / "wp.png"
    work.main(["--size", "3", "--motions", "hung", "--repeats", "1", "--output", str(output), "--plot", str(plot)])
    with open(output, newline="") as file:
        rows = list(csv.DictReader(file))
    curves = sum(map(len, work.CURVES.values())) * len(work.INTEGRATORS)
    assert len({(row["method"], row["precision"], row["tolerance"]) for row in rows}) == curves
    assert {row["check"] for row in rows} <= set(work.INTEGRATORS)
    assert plot.read_bytes().startswith(b"\x89PNG")
    with open(tmp_path / "wp_summary.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == curves
    assert "of that from" in capsys.readouterr().out


# -- benchmarks/motions.py --------------------------------------------------------------------------------------------

MOTIONS = ("hung", "snap", "pull", "throw", "drop", "strip", "carried")
EXACT = {"tolerance": 1e-12, "newton_tolerance": 1e-9}
"""Tolerances near rounding."""
norm = np.linalg.norm


def test_the_motions_are_these():
    assert tuple(motions.MOTIONS) == MOTIONS


@pytest.mark.parametrize("fabric", [None, *wy.fabrics.STUDIED, "denim"])
@pytest.mark.parametrize("name", MOTIONS)
def test_a_motion_is_made_of_any_fabric(name, fabric):
    motion = motions.find(name, fabric)
    assert motion.fabric == fabric or fabric is None
    simulator = motion.simulator(5, step=1e-3, **EXACT)
    assert simulator.scene.cloth.yarns == wy.fabrics.FABRICS[motion.fabric]().yarns
    assert motion.about(5) == {"fabric": motion.fabric, "size": "5 × 5"}
    position = references.end(simulator, 2)
    moved = position - motion.cloth(5).position - 2e-3 * np.array(motion.speed)
    # 2 ms of gravity and wind, or of spinning at 37 rad/s 3 mm from the centre: some 2e-4 m
    assert 1e-9 < np.abs(moved).max() < 3e-3


def test_a_throw_flies_as_a_free_body_does():
    """Its centre of mass on a parabola, its angular momentum about it that of the beginning."""
    motion, h = motions.find("throw"), 5e-4
    simulator = motion.simulator(5, step=h, **EXACT)
    trajectory = simulator.run(20)
    t = h * np.arange(21)[:, None]
    ends = np.array([0.5, 1.0, 1.0, 1.0, 0.5])
    # a segment's mass, half at each of its ends: two yarns cross at a node inside, and an edge has half of each
    weight = (ends[:, None] + ends[None, :]).ravel()[:, None]
    centre, momentum = ((weight * x).sum(axis=1) / weight.sum() for x in (trajectory.position, trajectory.velocity))
    # rounding and the tolerances; at constant acceleration a second-order method is exact
    np.testing.assert_allclose(momentum, motion.speed + t * [0.0, 0.0, -9.8], rtol=0, atol=1e-6)
    np.testing.assert_allclose(centre, centre[0] + t * motion.speed - 4.9 * t**2 * [0, 0, 1], rtol=0, atol=1e-8)
    about = trajectory.position - centre[:, None], trajectory.velocity - momentum[:, None]
    angular = (weight * np.cross(*about)).sum(axis=1)
    # but for lumping, which is not the model's mass matrix, and for the step
    assert norm(angular - angular[0], axis=1).max() < 0.01 * norm(angular[0])
    # it has turned by 0.37 radians of the 37 a second: the far corners by a third of their distance
    turned = trajectory.position[-1, 0] - trajectory.position[-1, -1]
    cosine = turned @ (trajectory.position[0, 0] - trajectory.position[0, -1]) / norm(turned) ** 2
    assert 0.1 < np.arccos(cosine) < 0.5


def test_a_carried_cloth_moves_as_one_that_is_not():
    """Seen from the hand, which moves on evenly within every step."""
    still, carried = motions.find("drop"), motions.find("carried")
    ends = [motion.simulator(5, step=1e-3, **EXACT).run(10).position for motion in (still, carried)]
    rows = np.arange(11)[:, None, None] * 1e-3 * np.array(carried.speed)
    fallen = np.abs(ends[0] - ends[0][0]).max()
    assert fallen > 1e-4
    # the tolerances are relative to velocities, here a hundred times those of the inner motion
    np.testing.assert_allclose(ends[1] - rows, ends[0], rtol=0, atol=1e-3 * fallen)
    assert carried.moved(ends[1][-1] + 0.04 * np.array(carried.speed), 5) == pytest.approx(
        still.moved(ends[0][-1], 5), rel=1e-3
    )


def test_a_clamped_strip_bends_down_from_its_clamp():
    motion = motions.find("strip")
    assert motion.about(9) == {"fabric": "cotton", "size": "5 × 9"}
    moved = motion.simulator(9, step=1e-3, **EXACT).run(3).position - motion.cloth(9).position
    down = -moved[-1, :, 2].reshape(5, 9)
    assert not moved[:, np.concatenate([9 * np.arange(5), 9 * np.arange(5) + 1])].any()
    assert (np.diff(down[2, 1:]) > 0.0).all()
    # less than it would fall
    assert down.max() < 4.9 * 3e-3**2


def test_a_carried_cloth_has_the_path_of_half_the_step():
    motion = motions.find("carried")
    half = halved(motion.scene(4, 1e-3), None)
    np.testing.assert_allclose(half.pin_path, motion.scene(4, 5e-4).pin_path, rtol=0, atol=1e-15)
    moved = motion.simulator(4, step=1e-3).state
    moved.position += 1.0
    assert (halved(motion.scene(4, 1e-3), moved).pin_path[0] > half.pin_path[0]).all()


# -- benchmarks/equal_error.py ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("order, target", [(1, 1e-2), (2, 1e-3), (1, 1.0)])
def test_the_largest_step_that_reaches_an_error_is_found(monkeypatch, order, target):
    monkeypatch.setattr(equal, "error", lambda motion, size, method, steps, converged: (2.0 / steps) ** order)
    motion = motions.MOTIONS["hung"]
    found, never = equal.steps_to(motion, 5, "linear", (target, 1e-9), None)
    # 3 % more steps than needed at most, or one; 25 ms begin with 2 steps
    needed = max(2.0, 2.0 / target ** (1.0 / order))
    assert needed <= found <= max(1.031 * needed, needed + 1.0)
    assert never is None


def test_methods_are_timed_beside_each_other():
    motion = motions.MOTIONS["hung"]
    seconds = equal.side_by_side(motion, 3, {"linear": 50, "sdirk2": 5}, repeats=2)
    assert [len(times) for times in seconds.values()] == [2, 2]
    assert min(map(min, seconds.values())) > 0.0


def test_equal_error_from_the_command(monkeypatch, tmp_path):
    monkeypatch.setattr(equal, "reference", lambda motion, size: None)
    # the last method never gets there
    last = list(equal.INTEGRATORS)[-1]
    monkeypatch.setattr(equal, "steps_to", lambda motion, size, method, *_: [64, None] if method == last else [64, 128])
    output = tmp_path / "e.csv"
    chosen = ["--motions", "hung", "strip", "--sizes", "3", "4", "--fabric", "paper"]
    equal.main([*chosen, "--repeats", "1", "--output", str(output)])
    with open(output, newline="") as file:
        rows = list(csv.DictReader(file))
    kinds = [("hung", "3 × 3"), ("hung", "4 × 4"), ("strip", "5 × 3"), ("strip", "5 × 4")]
    assert list(dict.fromkeys((row["motion"], row["size"]) for row in rows)) == kinds
    assert len(rows) == len(kinds) * len(equal.TARGETS) * len(equal.INTEGRATORS)
    assert {row["fabric"] for row in rows} == {"paper"}
    assert {row["method"] for row in rows if row["of eq. 2's"] == ""} == {last}


# -- benchmarks/step_control.py ---------------------------------------------------------------------------------------


def test_parts_are_compared_with_even_steps_of_their_error(monkeypatch):
    motion = motions.MOTIONS["hung"]
    position = control.end(motion.simulator(3, step=2.5e-4), 100)
    moved = motion.moved(position, 3)
    monkeypatch.setattr(control, "reference", lambda motion, size: references.Reference(position, moved, "", 0.0))
    monkeypatch.setattr(control, "COUNTS", (5, 80))
    monkeypatch.setattr(control, "STEP_ERRORS", (1e-2, 1e-3))
    # even steps take a second each
    monkeypatch.setattr(control, "turns", lambda runs, repeats: [[5.0], [80.0], [20.0], [20.0]])
    even, finer, loose, tight = control.rows(motion, "hung", 3, 1)
    assert (even["steps"], finer["steps"], even["step error"], loose["step error"]) == (5, 80, "even", 1e-2)
    assert 5 < loose["steps"] < tight["steps"] < 80
    assert even["error"] > loose["error"] > tight["error"] > finer["error"]
    for row in (loose, tight):
        share = np.log(even["error"] / row["error"]) / np.log(even["error"] / finer["error"])
        assert row["of even's"] == pytest.approx(20.0 / (5.0 * 16.0**share))


def test_step_control_from_the_command(monkeypatch, tmp_path):
    monkeypatch.setitem(motions.MOTIONS, "hung", short())
    monkeypatch.setattr(control, "COUNTS", (5, 20))
    monkeypatch.setattr(control, "STEP_ERRORS", (1e-2,))
    end = references.end(short().simulator(3, step=1e-4), 50)
    monkeypatch.setattr(control, "reference", lambda motion, size: references.Reference(end, 1e-4, "", 0.0))
    output = tmp_path / "c.csv"
    control.main(["--size", "3", "--motions", "hung", "--fabric", "paper", "--repeats", "1", "--output", str(output)])
    with open(output, newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["step error"] for row in rows] == ["even", "even", "0.01"]
    assert {(row["fabric"], row["size"]) for row in rows} == {("paper", "3 × 3")}


# -- benchmarks/sizes.py ----------------------------------------------------------------------------------------------


def test_array_bytes_counts_each_memory_once():
    simulator = wy.Simulator(wy.paper.hung_cloth(rows=5, columns=5))
    counted = sizes.array_bytes(simulator)
    add_array(simulator, "predicted", "position")
    assert sizes.array_bytes(simulator) == counted
    add_array(simulator, "predicted", None)
    assert sizes.array_bytes(simulator) == counted + 25 * 24


@pytest.mark.slow
def test_chart_2_from_the_command(monkeypatch, tmp_path, capsys):
    # in this process: its memory says nothing
    monkeypatch.setattr(sizes, "apart", sizes.measured)
    monkeypatch.setattr(sizes, "LARGE", 3)
    output, plot = tmp_path / "s.csv", tmp_path / "s.png"
    sizes.main(
        ["--sizes", "3", "5", "--steps", "1", "--fabric", "cotton", "--output", str(output), "--plot", str(plot)]
    )
    with open(output, newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["size"], row["sliding"]) for row in rows] == [
        ("3 × 3", "True"), ("5 × 5", "True"), ("3 × 3", "False"), ("5 × 5", "False"),
    ]  # fmt: skip
    assert all(float(row["step [ms]"]) > 0.0 and float(row["iterations"]) > 0.0 for row in rows)
    assert {row["fabric"] for row in rows} == {"cotton"}
    assert float(rows[0]["relative to 3 × 3"]) == 1.0
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert "slope of time over crossings" in capsys.readouterr().out


def test_the_slope_of_sizes_is_that_of_time_over_crossings():
    rows = [{"crossings": n * n, "step [ms]": 0.1 * n**3, "failure": ""} for n in (10, 50, 100, 200)]
    rows[0]["step [ms]"] = 1e3  # small: no part in it
    rows.append({"crossings": 9e4, "step [ms]": "", "failure": "step 1"})
    assert sizes.slope(rows) == pytest.approx(1.5)
    assert sizes.slope(rows[:2]) is None


def test_a_size_that_fails_is_a_row_with_a_reason(monkeypatch):
    def apart(size, *arguments):
        fine = {"seconds": [1.0], "iterations": 3.0, "made": 0.1, "peak": 2000, "arrays": 1000}
        return {"failure": "step 1: torn"} if size == 7 else fine

    monkeypatch.setattr(sizes, "apart", apart)
    rows = sizes.benchmark((7, 5), True, "linear", "paper", 1)
    assert [row["failure"] for row in rows] == ["step 1: torn", ""]
    assert set(rows[0]) == set(rows[1])
    assert rows[1]["arrays per crossing [kB]"] == pytest.approx(1.0 / 25)


# -- benchmarks/bandwidth.py ------------------------------------------------------------------------------------------


def test_two_preconditioners_have_passes():
    assert set(bandwidth.PASSES) == {"incomplete", "jacobi"}


@pytest.mark.parametrize("preconditioner", ["incomplete", "jacobi"])
def test_the_passes_have_every_array_of_the_iteration(preconditioner):
    simulator = wy.Simulator(wy.paper.hung_cloth(rows=3, columns=3), preconditioner=preconditioner)
    arrays = array_arguments(simulator, f"{preconditioner}_conjugate_gradient")
    # what only the beginning reads, and what the end reports
    once = {"rhs", "euler_rhs", "tolerance", "iterations", "residual", "status"}
    # where several threads meet
    once |= {"signals", "sums"}
    # what compressed yarns take from a stage's matrix
    once |= {"compressed", "indefinite", "compression", "before"}
    # what the terms read alone, and the diagonal's conjugate gradient has no use for
    once |= {"coefficients", "evaluations"} | ({"t_x", "t_s"} if preconditioner == "jacobi" else set())
    counted = {name for read, written in bandwidth.PASSES[preconditioner] for name in f"{read} {written}".split()}
    assert counted == arrays - once


def test_bytes_of_an_iteration_without_sliding():
    # a node's: blocks 72, vectors 24, six neighbours, half an E⁻¹
    neighbours, blocks, vector, block, inverse = 6 * 4, 6 * 72, 24, 72, 6 * 8
    expected = {
        "incomplete": (neighbours + blocks + block + inverse + (2 + 3) * vector)
        + (neighbours + blocks + inverse + (4 + 3) * vector),
        "jacobi": (neighbours + blocks + block + 3 * vector) + 2 * vector + (5 + 3) * vector + 4 * vector,
    }
    for preconditioner, each in expected.items():
        scene = wy.paper.hung_cloth(rows=4, columns=6, sliding=False)
        simulator = wy.Simulator(scene, preconditioner=preconditioner)
        assert bandwidth.iteration_bytes(simulator) == 24 * each


def test_a_solve_makes_the_iterations_that_it_is_asked_for():
    solver = bandwidth.Solver(9, True, "incomplete", 1)
    assert solver.solve(bandwidth.LONG) > 0.0
    assert int(numbers(solver.simulator, "iterations")[0]) == bandwidth.LONG
    assert not numbers(solver.simulator, "status").any()
    # past the attainable accuracy it stops, and then there is nothing to divide by
    with pytest.raises(RuntimeError, match="nothing can be told"):
        solver.solve(1000)


@pytest.mark.slow
def test_chart_3_from_the_command(monkeypatch, tmp_path):
    monkeypatch.setattr(bandwidth, "ELEMENTS", 3000)
    output, plot = tmp_path / "b.csv", tmp_path / "b.png"
    bandwidth.main(["--sizes", "9", "--repeats", "1", "--output", str(output), "--plot", str(plot)])
    with open(output, newline="") as file:
        rows = list(csv.DictReader(file))
    assert {(row["preconditioner"], row["threads"]) for row in rows} >= {("incomplete", "1"), ("jacobi", "1")}
    assert all(float(row["triad [GB/s]"]) > 0.0 for row in rows)
    assert plot.read_bytes().startswith(b"\x89PNG")


def test_the_triad_moves_what_it_says():
    triad = bandwidth.Triad(2, elements=600)
    assert triad.run() > 0.0
    assert triad.bytes == 4 * 8 * 600
    # twice: once at the beginning; a += b + 2 c of ones
    for part in triad.parts:
        np.testing.assert_array_equal(part[2].numpy(), np.full((100, 3), 7.0))


# -- warp_yarn/simulation/ablation.py, scenes/terms.py, benchmarks/terms.py ----


def moved_by_hand(scene, changed, steps, step):
    """As Change.moved says, from two plain runs."""
    a, b = (wy.Simulator(s, step=step).run(steps).position for s in (scene, changed))
    return np.sqrt(((a - b) ** 2).sum(axis=-1).mean() / ((a - a[0]) ** 2).sum(axis=-1).mean())


def test_each_thing_left_out_is_the_scene_without_it():
    scene = wy.paper.hung_cloth(rows=4, columns=4)
    found = ablate(scene, steps=4, step=1e-3, repeats=1)
    changes = {change.name: change for change in found.changes}
    assert set(changes) == {*scene.terms, "sliding"} - {"mass", "pins"}
    without_wind = wy.Scene(scene.cloth, pins=scene.pins)
    assert changes["wind"].moved == pytest.approx(moved_by_hand(scene, without_wind, 4, 1e-3), rel=1e-9)
    locked = wy.paper.hung_cloth(rows=4, columns=4, sliding=False)
    assert changes["sliding"].moved == pytest.approx(moved_by_hand(scene, locked, 4, 1e-3), rel=1e-9)
    half = wy.Simulator(scene, step=5e-4).run(8).position[::2]
    whole = wy.Simulator(scene, step=1e-3).run(4).position
    error = np.sqrt(((whole - half) ** 2).sum(axis=-1).mean() / ((whole - whole[0]) ** 2).sum(axis=-1).mean())
    assert found.step_error == pytest.approx(error, rel=1e-9)
    assert all(changes[name].moved < found.step_error for name in found.unneeded)
    assert found.seconds > 0.0


def test_a_term_that_cannot_be_left_out_has_the_reason(monkeypatch):
    scene = wy.paper.hung_cloth(rows=4, columns=4)

    class Frictional(wy.Simulator):
        def run(self, steps):
            trajectory = super().run(steps)
            if "friction" in self.scene.terms or not self.scene.sliding:
                return trajectory
            raise wy.SimulationError("step 2: torn. Try", step=2, node=-1, term=None, trajectory=trajectory.cut(2))

    monkeypatch.setattr(ablation, "Simulator", Frictional)
    changes = {change.name: change for change in ablate(scene, steps=3, repeats=1).changes}
    assert changes["friction"].moved is None
    assert str(changes["friction"]) == "friction cannot be left out: step 2: torn"
    assert changes["sliding"].moved is not None


def test_half_the_step_keeps_paths_in_time():
    cloth = wy.paper.cloth(rows=4, columns=4)
    pins = cloth.corners("top")
    path = cloth.position[pins] + np.linspace(0.0, 1e-3, 5)[1:, None, None]
    force = np.linspace(1e-4, 3e-4, 3)[:, None] * [[0.0, 1.0, 0.0]]
    scene = wy.Scene(cloth, pins=pins, pin_path=path, forces={cloth.node(3, 1): force})
    half = halved(scene, None)
    whole, fine = wy.Simulator(scene, step=1e-5), wy.Simulator(half, step=5e-6)
    # a force that holds a step of the whole holds two of the half; pins are half-way in the first of them
    before = cloth.position[pins]
    for k in range(6):
        whole.run(1)
        target, force = numbers(whole, "pin_target"), numbers(whole, "applied_force")
        for place in (0.5 * (before + target), target):
            fine.run(1)
            np.testing.assert_allclose(numbers(fine, "pin_target"), place, rtol=0, atol=1e-17)
            np.testing.assert_array_equal(numbers(fine, "applied_force"), force)
        before = target
        np.testing.assert_allclose(target, path[min(k, 3)], rtol=0, atol=1e-17)


def test_a_still_cloth_has_nothing_to_be_relative_to():
    cloth = wy.paper.cloth(rows=3, columns=3)
    with pytest.raises(wy.InputError, match="does not move"):
        ablate(wy.Scene(cloth, gravity=None), steps=1, repeats=1)


def test_what_the_lines_say():
    sliding = ablation.Change("sliding", 2e-4, 0.55, 0.01)
    bending = ablation.Change("bending", 0.0123, -0.05, 0.01)
    friction = ablation.Change("friction", 0.5, -7.0, 0.1)
    assert str(sliding) == "sliding moves the cloth by 0.02 % and costs 55 % of the step"
    assert str(bending) == "bending moves the cloth by 1.2 % and costs nothing"
    assert str(friction) == "friction moves the cloth by 50 %, and without it a step takes 8.0 times as long"
    found = ablation.Ablation(1e-3, 1e-3, (sliding, bending), ("sliding",), None)
    assert found.lines()[-1] == "at this step the scene does not need: sliding"
    torn = ablation.Change("sliding, wind", None, None, 0.0, "step 3: torn. Try a smaller step")
    found = ablation.Ablation(1e-3, 1e-3, (sliding,), ("sliding", "wind"), torn)
    assert found.lines()[-1].endswith("but it needs one of them: step 3: torn")


def test_what_sliding_leaves_out_is_named_once():
    changes = [ablation.Change(name, 1e-9, 0.1, 0.0) for name in ("friction", "parallel", "bending", "sliding")]
    assert unneeded(changes, 1e-3) == ("bending", "sliding")
    assert unneeded(changes[:3], 1e-3) == ("friction", "parallel", "bending")


def test_the_command_takes_a_scene_from_a_file(tmp_path, capsys):
    file = tmp_path / "mine.py"
    file.write_text(
        "import warp_yarn as wy\n"
        "cloth = wy.paper.cloth('twill', rows=4, columns=5)\n"
        "scene = wy.Scene(cloth, pins=cloth.corners('top'), sliding=False)\n"
    )
    found = terms_scene.main([str(file), "--steps", "3", "--repeats", "1"])
    assert [change.name for change in found.changes] == ["stretch", "bending", "gravity", "shear"]
    told = capsys.readouterr().out
    assert "4 × 5 yarns, 3 steps of 0.5 ms" in told
    assert "gravity moves the cloth by 100 %" in told


def test_the_command_takes_a_fabric_by_name(capsys):
    found = terms_scene.main(["--fabric", "cotton", "--size", "4", "--steps", "2", "--repeats", "1"])
    assert {"stretch", "wind", "sliding"} <= {change.name for change in found.changes}
    scene, _ = terms_scene.chosen(terms_scene.parser().parse_args(["--fabric", "cotton", "--size", "4"]))
    assert scene.cloth.yarns == wy.fabrics.cotton().yarns
    assert "4 × 4 yarns, 2 steps" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["nowhere.py"], "nowhere.py: there is no such file"),
        (["empty.py"], "must set `scene`"),
        (["empty.py", "--size", "5"], "--size"),
        (["empty.py", "--fabric", "paper"], "--fabric"),
        (["--fabric", "felt"], "--fabric"),
        (["--steps", "0"], "--steps = 0"),
        (["--repeats", "0"], "--repeats = 0"),
        (["--step", "0"], "step = 0"),
        (["--size", "2"], "--size = 2, must be a whole number, at least 3"),
        (["--integrator", "magic"], "--integrator"),
    ],
)
def test_wrong_arguments_of_the_command(arguments, named, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty.py").write_text("")
    assert exit_code(terms_scene, arguments) == 2
    assert named in capsys.readouterr().err


@pytest.mark.slow
def test_chart_4_from_the_command(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(motions.MOTIONS, "hung", short())
    output, plot = tmp_path / "t.csv", tmp_path / "t.png"
    terms.main(["--size", "3", "--motions", "hung", "--repeats", "1", "--output", str(output), "--plot", str(plot)])
    with open(output, newline="") as file:
        rows = {row["left out"]: row for row in csv.DictReader(file)}
    assert {"stretch", "shear", "wind", "sliding"} <= set(rows)
    assert rows["wind"]["needed"] == "yes"
    assert float(rows["wind"]["moved"]) > 0.1
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert "wind moves the cloth by" in capsys.readouterr().out


# -- stability -------------------------------------------------------------------------------------------------------

stability, long_run = load("benchmarks/stability.py"), load("benchmarks/long_run.py")


def test_the_default_region_of_the_map_is_not_broken():
    """Of the paper's materials, at every step up to 1/30 s: those that take long are left to the command."""
    for count in stability.COUNTS[3:]:
        row = stability.judge(stability.Case(), "sdirk2", count)
        assert row["verdict"] != "broken", row["message"]
    assert row["step [s]"] == pytest.approx(1.0 / 30.0)
    assert stability.judge(stability.Case(), "sdirk2", 66)["verdict"] == "accurate"
    assert stability.judge(stability.Case(), "linear", 20)["verdict"] == "stable, damped"


def test_an_explicit_method_ends_where_the_map_says():
    """The stiffest mode: a hundred times the modulus is a tenth of the step."""
    cases = [stability.Case(), stability.Case(stretch=100.0), stability.Case(density=0.01)]
    limits = [stability.explicit_limit(case) for case in cases]
    assert 1e-6 < limits[1] < limits[0] < 1e-3
    assert limits[0] / limits[1] == pytest.approx(10.0, rel=0.1)
    # ω² is of a stiffness over a mass
    assert limits[0] / limits[2] == pytest.approx(10.0, rel=1e-9)


def test_how_stiff_a_case_is():
    step = 1e-3
    cotton = stability.Case(fabric="cotton")
    # k_s 20 N, ρ 2e-5 kg/m, L 1/2300 m
    assert cotton.stiffness(step) == pytest.approx(20.0 * step**2 / (2e-5 / 2300.0**2))
    assert stability.Case(fabric="cotton", density=0.1, stretch=3.0).stiffness(step) == pytest.approx(
        30.0 * cotton.stiffness(step)
    )
    # each of the charts' fabrics at 1 ms, and no run beyond
    for name in wy.fabrics.STUDIED:
        case = stability.Case(fabric=name)
        assert 66 in case.counts()
        assert all(case.stiffness(stability.DURATION / count) <= stability.STIFFEST for count in case.counts())
    assert stability.Case().counts() == stability.COUNTS
    assert len(cotton.counts()) < len(stability.COUNTS)


def test_a_light_cloth_is_blown_farther():
    heavy, light = stability.Case().farthest(), stability.Case(density=0.01).farthest()
    fall = 0.5 * 9.8 * stability.DURATION**2
    assert fall < heavy < light
    # the wind's share of it
    assert (light - fall) / (heavy - fall) == pytest.approx(100.0)


def test_the_map_from_the_command(tmp_path, monkeypatch):
    monkeypatch.setattr(stability, "one_core", lambda: None)
    monkeypatch.setattr(stability, "COUNTS", (66, 20, 6, 2))
    monkeypatch.setattr(stability, "FINEST", 66)
    monkeypatch.setattr(stability, "STRETCH", (1.0, 10.0))
    monkeypatch.setattr(
        stability, "OTHERS", (stability.Case(), stability.Case(size=3), stability.Case(fabric="cotton"))
    )
    monkeypatch.setattr(stability, "INTEGRATORS", {"linear": stability.INTEGRATORS["linear"]})
    output, png = tmp_path / "s.csv", tmp_path / "s.png"
    chosen = ["--fabric", "handkerchief", "--densities", "1", "0.5"]
    stability.main(["--quick", *chosen, "--output", str(output), "--png", str(png)])
    with open(output, newline="") as file:
        rows = list(csv.DictReader(file))
    # one step of 1/90 s is left, and cotton has 6e8 there
    assert {(row["fabric"], row["size"], row["density"], row["stretch"]) for row in rows} == {
        ("handkerchief", "5", "1.0", "1.0"), ("handkerchief", "5", "0.5", "1.0"),
        ("handkerchief", "3", "1.0", "1.0"),
    }  # fmt: skip
    assert all(1e5 < float(row["k_s h²/(m L)"]) < stability.STIFFEST for row in rows)
    assert png.read_bytes().startswith(b"\x89PNG")


def test_a_broken_run_says_what_broke_it(monkeypatch):
    def fail(*_):
        raise stability.wy.SimulationError(
            "step 1: Newton's iteration stopped", step=1, node=-1, term=None, trajectory=None
        )

    monkeypatch.setattr(stability, "end", fail)
    row = stability.judge(stability.Case(), "sdirk2", 6)
    assert (row["verdict"], row["cause"]) == ("broken", "Newton")


@pytest.mark.slow
def test_the_map_is_drawn(tmp_path):
    maps, others = (stability.Case(),), (stability.Case(size=3),)
    rows = stability.benchmark(maps, others, (6, 2))
    assert len(rows) == 4 * len(stability.INTEGRATORS)
    stability.draw(tmp_path / "map.png", rows, maps, others)
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")


def test_a_long_run_calms_down_and_its_faults_are_seen():
    rows = long_run.run(3, 200)
    assert long_run.faults(rows) == []
    assert rows[-1]["wind"] == 0.0 < rows[0]["wind"]
    grown = [{**row, "energy [J]": k * 1e-9, "memory [MB]": float(k)} for k, row in enumerate(rows)]
    assert [fault.split()[0] for fault in long_run.faults(grown)] == ["energy", "memory"]
    assert "not finite" in long_run.faults([{**rows[0], "finite": False}])[0]


# -- benchmarks/defaults.py --------------------------------------------------------------------------------------------


def test_a_random_scene_is_known_by_its_number():
    cases = [defaults.Case.of(number) for number in range(60)]
    assert cases == [defaults.Case.of(number) for number in range(60)]
    assert {case.kind for case in cases} == set(defaults.KINDS)
    assert {(case.kind, case.fabric) for case in cases} == set(itertools.product(defaults.KINDS, wy.fabrics.STUDIED))
    assert {case.weave for case in cases} == set(wy.WEAVES)
    assert {case.sliding for case in cases} == {case.exact for case in cases} == {False, True}
    assert min(case.stretch for case in cases) < 0.1
    assert max(case.stretch for case in cases) > 1e3
    assert min(case.step for case in cases) < 2e-4
    assert max(case.step for case in cases) > 1.0 / 30.0


@pytest.mark.parametrize("exact", [False, True])
def test_work_of_pins_and_wind_is_counted(exact):
    """Of a converged motion nothing is left beside energy and work but what the method damps; carried, and in wind."""
    found = {
        "kind": "carried", "fabric": "paper", "rows": 4, "columns": 4, "stretch": 1.0, "step": 1e-4, "steps": 8,
        "sliding": False, "exact": exact, "wind": (3.0, 4.0, 0.0), "speed": (1.0, 2.0, -0.5), "strain": 0.0,
    }  # fmt: skip
    case = dataclasses.replace(defaults.Case.of(3), **found)
    run = defaults.Run.of(case, integrator="implicit-midpoint", **defaults.TIGHT)
    total, _, work = defaults.energies(case, run.simulator, run.frames)
    gained = total - total[0]
    # of gravity, and of air that takes the cloth along
    assert np.abs(work).max() > 0.5 * np.abs(gained).max() > 1e-9
    # the quadrature over a step, of order 4, and friction of none
    np.testing.assert_allclose(gained, work, rtol=0.0, atol=0.02 * np.abs(work).max())


def test_a_row_of_the_defaults_from_the_command(tmp_path):
    path = tmp_path / "defaults.csv"
    defaults.main(["--scenes", "2", "--first", "2", "--output", str(path)])
    with open(path, newline="") as file:
        hung, carried = csv.DictReader(file)
    assert (hung["kind"], carried["kind"]) == ("hung", "carried")
    for row in (hung, carried):
        assert not row["failure"]
        assert float(row["ratio"]) < 0.2
        assert float(row["gain"]) < 0.01


def test_a_scene_that_fails_says_so(monkeypatch):
    def fail(*_):
        raise wy.SimulationError("step 1: no", step=1, node=-1, term=None, trajectory=None)

    monkeypatch.setattr(defaults.wy.Simulator, "run", fail)
    row = defaults.compare(defaults.Case.of(2))
    assert row["failure"] == row["tight failure"] == row["fine failure"] == "step 1: no"
    assert row["ratio"] == row["gain"] == ""


# -- benchmarks/iterations.py ------------------------------------------------------------------------------------------


def test_iterations_are_those_of_the_residual_asked_for():
    cloth = iterations.cloth_of("handkerchief", 5)
    scene = wy.Scene(cloth, pins=cloth.corners("top"), sliding=False)
    state = iterations.jittered(cloth, 0.15, False)
    found = {name: iterations.count(scene, state, 1e-3, name, 1000) for name in iterations.PRECONDITIONERS}
    for preconditioner, counts in found.items():
        options = {"preconditioner": preconditioner, "tolerance": 1e-6, "energy_watch": False}
        simulator = wy.Simulator(scene, step=1e-3, integrator="linear", **options)
        simulator.state = state
        simulator.run(1)
        assert counts["to r"] == int(numbers(simulator, "iterations")[0])
        # b has the momentum that the start has too
        assert 0 < counts["to b"] <= counts["to r"] + 20
    assert iterations.count(scene, state, 1e-3, "multilevel", 3) == {"to r": "> 3", "to b": "> 3"}


def test_the_tables_of_iterations_from_the_command(tmp_path, monkeypatch):
    monkeypatch.setattr(iterations, "STRETCHES", (1.0, 100.0))
    monkeypatch.setattr(iterations, "JITTERS", (0.02,))
    monkeypatch.setattr(iterations, "STAGES", (3e-4,))
    path = tmp_path / "iterations.csv"
    iterations.main(["--sizes", "5", "--size", "5", "--output", str(path)])
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["table"] for row in rows] == ["hung"] * 4 + ["stretch"] * 2 + ["jittered"] * 6
    assert all(0 < int(row["multilevel, stage, to r"]) < 60 for row in rows)


# -- benchmarks/tensile_curve.py --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_tensile_curve_has_leaf_and_kandil_s_slope_and_then_the_yarns_own():
    cloth = tensile.strip(5, 9, (0.05, 0.05))
    strains = (0.0, 1e-4, 0.07, 0.07 + 1e-4)
    # long beside the clamps, which keep the ends from drawing in
    free = tensile.curve(cloth, strains, interchange=True, clamped=False)
    rest, small, large, more = (row["force per width [N/m]"] for row in free)
    assert abs(rest) < 1e-6
    assert tensile.leaf_kandil((0.05, 0.05)) == pytest.approx(1784.6, rel=1e-3)
    assert 0.9 < small / 1e-4 / tensile.leaf_kandil((0.05, 0.05)) < 2.0
    own = tensile.STRETCH / tensile.DISTANCE
    assert 0.7 * own < (more - large) / 1e-4 < own
    assert free[2]["strain across"] < -0.05
    held = tensile.curve(cloth, strains[:2], interchange=True, clamped=True)
    straight = tensile.curve(cloth, strains[:2], interchange=False, clamped=False)
    assert small < held[1]["force per width [N/m]"] < straight[1]["force per width [N/m]"]
    # as stretch has it, from the start
    assert straight[1]["force per width [N/m]"] / 1e-4 == pytest.approx(1.05 * own, rel=1e-3)
    figure = tensile.draw([{"kind": kind, **row} for kind in tensile.KINDS for row in free], (0.05, 0.05))
    assert len(figure.axes) == 2


# -- benchmarks/coarse.py ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_coarse_cloths_come_near_the_fine_one():
    rows = coarse.compare("handkerchief", 49, (4, 2, 1), steps=60)
    assert [row["nodes"] for row in rows] == [169, 625, 2401]
    for name in ("drape", "period"):
        errors = [abs(row[f"{name} error"]) for row in rows]
        assert errors[0] > errors[1] > errors[2] == 0.0
    # a strip longer by half a coarse distance at the clamp: the square of its length
    free = 40.0
    assert rows[1]["period error"] == pytest.approx(((free + 1.0) / (free + 0.5)) ** 2 - 1.0, rel=0.15)
    for row in rows:
        assert abs(row["shear error"]) < 2e-4
        assert abs(row["tension error"]) < 1e-9
    assert rows[0]["times faster"] > 3.0
    assert len(coarse.draw(rows).axes) == 2
