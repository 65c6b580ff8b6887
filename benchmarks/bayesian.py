"""Bayesian optimization as a baseline that learns parameters from runs alone, without gradients.

Expected improvement over a Gaussian process with a Matérn 5/2 kernel and a length scale for each parameter, as in the
method that the paper compares with (Snoek et al. 2012), by the package bayesian-optimization. The parameters are scaled
to their ranges. A process of the loss's logarithm came about as near in a few trials, and took several times longer.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
import tqdm

import warp_yarn as wy

RANDOM = 5
"""Runs with random parameters before the process is asked."""

PACKAGE = "bayesian-optimization"


def minimize(
    loss: Callable[[np.ndarray], float], low: np.ndarray, high: np.ndarray, runs: int, failed: float, seed: int = 0
) -> np.ndarray:
    """Searches a range for the values of the smallest loss.

    Args:
        loss: of values [parameters]; called so many times as there are runs.
        low, high: the range [parameters].
        failed: loss of values with which the model cannot be simulated.

    Returns:
        The best values found.
    """
    try:
        import bayes_opt
        from bayes_opt.acquisition import ExpectedImprovement
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.gaussian_process.kernels import Matern
    except ImportError as error:
        raise wy.InputError(f"this takes {PACKAGE}: pip install {PACKAGE}") from error
    names = [str(k) for k in range(len(low))]
    bar = tqdm.tqdm(total=runs, unit="run", desc="Bayesian optimization", disable=None, leave=False)

    def physical(point: dict[str, float]) -> np.ndarray:
        return low + (high - low) * np.array([point[name] for name in names])

    def score(**point: float) -> float:
        try:
            value = loss(physical(point))
        except wy.SimulationError:
            value = failed
        bar.update()
        return -value

    search = bayes_opt.BayesianOptimization(
        score,
        dict.fromkeys(names, (0.0, 1.0)),
        acquisition_function=ExpectedImprovement(xi=0.0),
        random_state=seed,
        verbose=0,
        allow_duplicate_points=True,
    )
    search.set_gp_params(kernel=Matern(nu=2.5, length_scale=np.ones(len(low))))
    with bar, warnings.catch_warnings():
        # A length scale at its bound: the loss does not depend on that parameter.
        warnings.simplefilter("ignore", ConvergenceWarning)
        search.maximize(init_points=min(RANDOM, runs), n_iter=max(0, runs - RANDOM))
    return physical(search.max["params"])
