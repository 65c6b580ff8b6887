"""That the benchmarks compare like with like. Nothing is timed here."""

import csv

import pytest
from scripts import load

solver = load("benchmarks/solver.py")


def test_ours_and_scipy_solve_the_same_system_to_the_same_tolerance():
    ours = solver.simulators(5)
    result = solver.compare(ours)
    assert set(result) == {"incomplete", "jacobi", "scipy"}
    # The tolerance is 1e-8 in the residual. The error is that times at most the condition number of the scaled matrix,
    # here some 1e3, and far less as a rule.
    for solution in result.values():
        assert solution["error"] < 1e-6
    # The same iterates, but for rounding: one may pass the tolerance an iteration before the other.
    assert abs(result["jacobi"]["iterations"] - result["scipy"]["iterations"]) <= 1
    assert result["jacobi"]["error"] == pytest.approx(result["scipy"]["error"], rel=0.5)
    assert result["incomplete"]["iterations"] < result["jacobi"]["iterations"] / 3


def test_a_row_reaches_the_csv_file_with_the_environment(tmp_path):
    row = solver.benchmark(3, repeats=1)
    path = tmp_path / "results" / "solver.csv"
    solver.write_csv(path, [row], solver.environment("scipy"))
    with open(path, newline="") as file:
        (read,) = csv.DictReader(file)
    assert read["size"] == "3 × 3"
    # 9 nodes of 3 unknowns, one crossing of 2
    assert read["unknowns"] == "29"
    assert float(read["scipy [ms]"]) > 0.0
    assert {"processor", "warp-lang", "scipy", "revision"} <= set(read)


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
    limits = [stability.explicit_limit(stretch) for stretch in (1.0, 100.0)]
    assert 1e-6 < limits[1] < limits[0] < 1e-3
    assert limits[0] / limits[1] == pytest.approx(10.0, rel=0.1)


def test_a_broken_run_says_what_broke_it(monkeypatch):
    def fail(*_):
        raise stability.wy.SimulationError(
            "step 1: Newton's iteration stopped", step=1, node=-1, term=None, trajectory=None
        )

    monkeypatch.setattr(stability, "end", fail)
    row = stability.judge(stability.Case(), "sdirk2", 6)
    assert (row["verdict"], row["cause"]) == ("broken", "Newton")


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
