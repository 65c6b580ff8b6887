"""Files that learning goes on from: all that a ``LevenbergMarquardt`` knows, but what a run tells again."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..io.files import atomic_write
from .levenberg_marquardt import Iteration, LevenbergMarquardt

SAME_LOSS = 1e-6
"""How far a loss that is computed again may be off [1]: another processor may round otherwise."""

OF_ITERATIONS = tuple(field.name for field in dataclasses.fields(Iteration))


def identity(search: LevenbergMarquardt) -> dict[str, Any]:
    """Lists what a checkpoint must agree with."""
    problem = search.problem
    return {
        "names": np.array(problem.names),
        "low": problem.low,
        "high": problem.high,
        "start": problem.start,
        "resolution": np.array(search.resolution),
    }


def save(search: LevenbergMarquardt, path: Path) -> None:
    """Writes a checkpoint, whole or not at all."""
    history: dict[str, Any] = {field: np.array([getattr(i, field) for i in search.history]) for field in OF_ITERATIONS}
    known = np.zeros((0, len(search.y))) if search.jacobian is None else search.jacobian
    state: dict[str, Any] = {
        "y": search.y,
        "steps_per_frame": search.problem.steps_per_frame,
        "damping": search.damping,
        "scale": search.scale,
        "jacobian": known,
    }
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **identity(search), **state, **{f"history_{name}": rows for name, rows in history.items()})


def load(search: LevenbergMarquardt, path: Path) -> None:
    """Goes on from a checkpoint. Its loss, computed again, must be what it was: then the problem is the same.

    Raises:
        InputError: a file that is no checkpoint, or one of another problem.
    """
    try:
        with np.load(path) as data:
            same = all(np.array_equal(data[name], value) for name, value in identity(search).items())
            y, damping, scale, known = (data[name] for name in ("y", "damping", "scale", "jacobian"))
            steps_per_frame = int(data["steps_per_frame"])
            rows = zip(*(data[f"history_{name}"].tolist() for name in OF_ITERATIONS), strict=True)
            history = [Iteration(np.array(values), *rest) for values, *rest in rows]
            last = history[-1]
    except Exception as error:  # zip, pickle and key errors of a foreign or truncated file
        raise InputError(f"{path}: not a checkpoint of learning ({error}); remove it to begin anew") from error
    if not same:
        raise InputError(f"{path}: of other parameters, ranges, starts or resolution; remove it to begin anew")
    search.y, search.damping, search.scale, search.history = y, float(damping), scale, history
    search.jacobian = known if len(known) else None
    while search.problem.steps_per_frame < steps_per_frame:
        search.problem = search.problem.halved()
    search.residuals = search.problem.residuals(search.values)
    if not np.isclose(search.loss, last.loss, rtol=SAME_LOSS, atol=0.0):
        raise InputError(
            f"{path}: of another problem: it has a loss of {last.loss:.6e} m² where this one has {search.loss:.6e} m²; "
            "remove it to begin anew"
        )
    search.problem.simulations, search.problem.gradients = last.simulations, last.gradients
    search.began = time.perf_counter() - last.seconds
