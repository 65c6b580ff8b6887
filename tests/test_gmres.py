"""GMRES against direct solves."""

import numpy as np
import pytest

from warp_yarn.integrators.gmres import gmres

RANDOM = np.random.default_rng(3)
SIZE = 12
MATRIX = np.eye(SIZE) * 3.0 + RANDOM.normal(0.0, 1.0, (SIZE, SIZE))
RHS = RANDOM.normal(0.0, 1.0, SIZE)


@pytest.mark.parametrize("changing", [False, True], ids=["fixed", "changing"])
def test_solves_a_matrix_that_is_not_symmetric(changing):
    """With a preconditioner that may be another one at every product, in the norm that is asked for."""
    weight = RANDOM.uniform(0.5, 2.0, SIZE)
    calls = []

    def preconditioner(vector: np.ndarray) -> np.ndarray:
        calls.append(vector)
        return vector / (np.diag(MATRIX) * (1.0 + 0.1 * changing * len(calls)))

    start = float(np.linalg.norm(weight * RHS))
    solution, size = gmres(
        lambda x: MATRIX @ x, preconditioner, RHS, weight, size=start, target=1e-12 * start, most=SIZE + 1
    )
    np.testing.assert_allclose(solution, np.linalg.solve(MATRIX, RHS), rtol=0, atol=1e-10)
    # what it says is left is the norm of what is
    assert size <= 1e-12 * start
    assert np.linalg.norm(weight * (RHS - MATRIX @ solution)) <= 1e-11 * start
    assert len(calls) <= SIZE


def test_what_weighs_nothing_is_left_out():
    weight = np.ones(SIZE)
    weight[4:6] = 0.0
    solution, _ = gmres(
        lambda x: MATRIX @ x * weight, lambda x: x * weight, RHS, weight, size=10.0, target=1e-10, most=20
    )
    kept = weight > 0.0
    assert not solution[~kept].any()


def test_says_where_it_did_not_converge():
    def solve(**options: object) -> tuple[np.ndarray | None, float]:
        start = float(np.linalg.norm(RHS))
        return gmres(lambda x: MATRIX @ x, lambda x: x, RHS, np.ones(SIZE), size=start, target=1e-9 * start, **options)

    solution, size = solve(most=3)
    assert solution is None
    assert 1e-9 < size / np.linalg.norm(RHS) < 1.0
    assert solve(most=30, failed=lambda: True)[0] is None
    with np.errstate(invalid="ignore"):
        assert gmres(lambda x: x * np.inf, lambda x: x, RHS, np.ones(SIZE), size=1.0, target=0.1, most=30)[0] is None
