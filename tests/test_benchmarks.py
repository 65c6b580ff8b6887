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
