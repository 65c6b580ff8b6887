"""What data leave open of values that were learned from them: statistics of residuals and their Jacobian.

Only NumPy: no run is made here. What runs tell beyond it is the matter of ``probing``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

UNIFORM_DEVIATION = 1.0 / np.sqrt(12.0)
"""Standard deviation of a uniform distribution over a range [ranges]."""

DETERMINED_DEVIATION = 0.5 * UNIFORM_DEVIATION
"""Standard deviation below which the data determine a parameter [ranges]: half of what the range alone says."""


@dataclasses.dataclass(frozen=True)
class Uncertainty:
    """What the data leave open of the values of p parameters, in ranges, and how far the time step puts them wrong.

    Args:
        covariance: of the values, as far as the residuals tell [p, p].
        of_data: standard deviations without the known part of the step's error [p].
        deviation: standard deviations, all of the step's error included [p].
        without_step: what they would be without the part of the residuals that the step explains [p].
        step_error: the part of the values that is due to the step [p].
        share: of the step's error that the data are without, from 0 to 1.
        unexplained: part of the step's error that is of unknown shape, from 0 to 1.
        moved: by how much that changes the model [m].
        variance: of a residual, with the unknown part of the step's error [m²].
    """

    covariance: np.ndarray
    of_data: np.ndarray
    deviation: np.ndarray
    without_step: np.ndarray
    step_error: np.ndarray
    share: float
    unexplained: float
    moved: float
    variance: float


def estimate(
    jacobian: np.ndarray,
    residuals: np.ndarray,
    missed: np.ndarray,
    resolution: float,
    *,
    others: Sequence[tuple[float, np.ndarray]] = (),
    least: np.ndarray | float = 0.0,
) -> Uncertainty:
    """Estimates what the data leave open.

    Args:
        jacobian: of the residuals with respect to p parameters in units of their ranges [n, p] (m).
        residuals: [frames, rows, columns, 3] (m), n numbers.
        missed: what the residuals would gain with a step of 0, likewise.
        resolution: of the data [m].
        others: of values that were tried, how much greater their loss is [m²], and how far they are away [p] (ranges).
        least: standard deviations of the data that are known otherwise, at the least [p] (ranges).
    """
    shape, flat = residuals.shape, residuals.ravel()
    parameters = jacobian.shape[1]
    shift, rest, share = step_errors(jacobian, flat, missed.ravel(), resolution)
    left = flat + share * rest
    # Of all that is left, not of what the step does not explain: where the step is too long for its error to be one
    # of first order, that would be too sure.
    of_residuals = residual_variance(residuals, parameters, resolution)
    unexplained = unexplained_part(rest.reshape(shape), left.reshape(shape))
    moved = unexplained * float(np.linalg.norm(missed))
    of_step = moved**2 / independent(missed)
    covariance = uncertainties(jacobian, of_residuals + of_step)
    of_data = np.sqrt(np.diag(covariance))
    # a motion that differs by no more than the step's error may be the true one
    for rise, away in others:
        if rise <= moved**2:
            of_data = np.maximum(of_data, away)
    of_data = np.minimum(np.maximum(of_data, least), UNIFORM_DEVIATION)
    determined = of_data < DETERMINED_DEVIATION
    # noise makes a share where there is none
    spread = min(1.0, float(np.sqrt(of_residuals / max(rest @ rest, np.finfo(float).tiny))))
    without_step = uncertainties(jacobian, residual_variance(left.reshape(shape), parameters, resolution))
    return Uncertainty(
        covariance=covariance,
        of_data=of_data,
        deviation=np.hypot(of_data, np.where(determined, np.hypot(share, spread) * shift, 0.0)),
        without_step=np.sqrt(np.diag(without_step)),
        step_error=np.where(determined, share * shift, 0.0),
        share=share,
        unexplained=unexplained,
        moved=moved,
        variance=of_residuals + of_step,
    )


def uncertainties(jacobian: np.ndarray, variance: float) -> np.ndarray:
    """Computes what least squares leaves open: the covariance (JᵀJ/s² + 12)⁻¹ of p parameters in their ranges [p, p].

    JᵀJ is the Gauss-Newton Hessian. 12 is the range's part: a uniform distribution over it has the variance 1/12, which
    a parameter keeps that the data do not see.

    Args:
        jacobian: J, of the residuals with respect to the p parameters [residuals, p] (m).
        variance: s², of a residual that counts as one of so many as there are (``residual_variance``) [m²].
    """
    return np.linalg.inv(jacobian.T @ jacobian / variance + 12.0 * np.eye(jacobian.shape[1]))


def residual_variance(residuals: np.ndarray, parameters: int, resolution: float) -> float:
    """Estimates s² = max(|r|²/(n' (1 − p/n)), resolution²) of n residuals r [frames, rows, columns, 3] (m) [m²].

    p parameters were learned. n' counts independent residuals (``independent``): data that differ from the model by
    noise have as many as numbers, data that differ by what the model cannot do have few. Of what they differ by, the
    parameters have taken p/n away.
    """
    left = max(1.0 - parameters / residuals.size, 1.0 / residuals.size)
    return max(float((residuals**2).sum()) / (independent(residuals) * left), resolution**2)


def step_errors(
    jacobian: np.ndarray, residuals: np.ndarray, missed: np.ndarray, resolution: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Estimates what a model's time step puts into values that were learned with it, to first order.

    Let e be what the residuals would gain with a step of 0. As far as the data are without the step's error, least
    squares has put A e into the values, A = (JᵀJ + 12 resolution²)⁻¹ Jᵀ, and could not put e − J A e, whose opposite
    then stands in the residuals. How much of it does is taken for how much of e the data are without: its share.

    Args:
        jacobian: J [residuals, p] (m), of p parameters in units of their ranges.
        residuals: [residuals] (m).
        missed: e [residuals] (m).
        resolution: of the data [m].

    Returns:
        A e [p], in ranges; e − J A e [residuals] (m); and the share, from 0 to 1.
    """
    square = jacobian.T @ jacobian + 12.0 * resolution**2 * np.eye(jacobian.shape[1])
    shift = np.linalg.solve(square, jacobian.T @ missed)
    rest = missed - jacobian @ shift
    share = np.clip(-(residuals @ rest) / max(rest @ rest, np.finfo(float).tiny), 0.0, 1.0)
    return shift, rest, float(share)


def unexplained_part(rest: np.ndarray, left: np.ndarray) -> float:
    """Estimates how much of the step's error, from 0 to 1, the values may have taken in without its being known how.

    ``step_errors`` goes by the shape of e, which is that of the error only where the step resolves the motion. A
    pattern in what that leaves of the residuals may be the step's error in another shape: as much of it as the pattern
    is of the part of e that the values could not take in. Noise has no pattern.

    Args:
        rest: e − J A e [frames, rows, columns, 3] (m).
        left: the residuals without what the step explains, likewise.
    """
    pattern = np.linalg.norm(left) * np.sqrt(max(0.0, 1.0 - independent(left) / left.size))
    return float(min(1.0, pattern / max(np.linalg.norm(rest), np.finfo(float).tiny)))


def independent(residuals: np.ndarray) -> float:
    """Counts how many of these residuals [frames, rows, columns, 3] are independent, at the least.

    What is learned is a weighted sum of residuals, and the variance of one whose weights have the norm 1 is at most the
    largest eigenvalue λ of their correlation, which is 1 where they are independent. So n along an axis count as n/λ,
    with the correlation along it as the other axes show it: as 1 where all are alike, and as 1 or 2 where they
    oscillate, though neighbours differ then. In N samples of noise λ is some (1 + √(n/N))² (Marchenko and Pastur), in
    one case of a thousand it is more than that and 3.27 of its widths (Johnstone, "On the distribution of the largest
    eigenvalue in principal components analysis", 2001): what is below counts as 1. N counts samples that may be alike
    too, which errs to the safe side.
    """
    result = float(residuals.shape[3])
    for axis in range(3):
        n = residuals.shape[axis]
        along = np.moveaxis(residuals, axis, 0).reshape(n, -1)
        covariance = along @ along.T
        mean = np.trace(covariance) / n
        largest = np.linalg.eigvalsh(covariance)[-1]
        size = np.sqrt(along.shape[1]) + np.sqrt(n)
        width = size * (1.0 / np.sqrt(along.shape[1]) + 1.0 / np.sqrt(n)) ** (1.0 / 3.0)
        of_noise = (size**2 + 3.27 * width) / along.shape[1]
        result *= n * mean / largest if largest > of_noise * mean else n
    return result
