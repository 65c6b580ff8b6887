"""GMRES with a preconditioner that may differ from one product to the next. NumPy only."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def gmres(
    matvec: Callable[[np.ndarray], np.ndarray],
    preconditioner: Callable[[np.ndarray], np.ndarray],
    residual: np.ndarray,
    weight: np.ndarray,
    *,
    size: float,
    target: float,
    most: int,
    failed: Callable[[], bool] = lambda: False,
) -> tuple[np.ndarray | None, float]:
    """Find x that makes the weighted norm ‖W (residual − K x)‖ small.

    Args:
        matvec: K x. It is called with what the preconditioner gave last.
        preconditioner: an approximation of K⁻¹ times a vector.
        residual: b − K x₀, for x = 0 here.
        weight: W, a diagonal; 0 of what has no part in the norm.
        size: ‖W residual‖, above 0.
        target: the norm to end with.
        most: vectors that are kept, each of them one product.
        failed: whether the last product or preconditioner failed.

    Returns:
        x, None where the norm did not fall so far; and the norm.
    """
    basis, parts, columns = [weight * residual / size], [], []
    combination, first = np.zeros(0), size
    while size > target:
        if len(parts) == most or not np.isfinite(size) or failed():
            return None, size
        parts.append(preconditioner(basis[-1] / np.where(weight > 0.0, weight, 1.0)))
        image = weight * matvec(parts[-1])
        # modified Gram-Schmidt, twice: once loses what GMRES needs of orthogonality near the end
        column = np.zeros(len(basis))
        for _ in range(2):
            for k, vector in enumerate(basis):
                share = float(vector @ image)
                column[k] += share
                image -= share * vector
        norm = float(np.linalg.norm(image))
        if not np.isfinite(norm):
            return None, norm
        columns.append(np.append(column, norm))
        hessenberg = np.zeros((len(columns) + 1, len(columns)))
        for k, entries in enumerate(columns):
            hessenberg[: len(entries), k] = entries
        goal = np.zeros(len(columns) + 1)
        goal[0] = first
        combination = np.linalg.lstsq(hessenberg, goal, rcond=None)[0]
        size = float(np.linalg.norm(hessenberg @ combination - goal))
        if norm == 0.0:
            break
        basis.append(image / norm)
    return sum((c * part for c, part in zip(combination, parts, strict=True)), np.zeros_like(residual)), size
