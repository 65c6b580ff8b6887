"""What conjugate gradients do once a step has failed, which the host of a GPU hears of at the end of a chunk."""

import numpy as np
import pytest
from internals import numbers, put, solve
from warp_yarn.kernels.core.status import STALLED

import warp_yarn as wy


@pytest.mark.parametrize("sliding", [True, False], ids=["sliding", "locked"])
@pytest.mark.parametrize(
    ("preconditioner", "threads"),
    [("jacobi", 1), ("incomplete", 1), ("incomplete", 2), ("multilevel", 1), ("multilevel", 2)],
)
def test_nothing_is_solved_once_a_step_has_failed(preconditioner: str, threads: int, sliding: bool) -> None:
    fabric = wy.paper.cloth(rows=4, columns=18)
    scene = wy.Scene(fabric, pins=fabric.corners("top"), sliding=sliding)
    simulator = wy.Simulator(scene, preconditioner=preconditioner, threads=threads)
    force = np.random.default_rng(0).normal(size=(fabric.nodes, 3))
    solution = solve(simulator, force)
    assert np.isfinite(solution).all() and solution.any()
    report = {name: numbers(simulator, name) for name in ("iterations", "residual")}
    assert report["iterations"][0] > 2
    failed = [STALLED, 7, 1]
    put(simulator, "status", failed)
    assert not solve(simulator, 2.0 * force).any()
    # nor is what failed forgotten
    assert numbers(simulator, "status").tolist() == failed
    assert all(np.array_equal(numbers(simulator, name), report[name]) for name in report)
    put(simulator, "status", 0)
    assert np.array_equal(solve(simulator, force), solution)
