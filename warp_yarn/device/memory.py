"""What steps leave to those that come, beside the state: slopes, and what the watch over energy has written down."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .declarations import SLOPES

if TYPE_CHECKING:
    from .model import Model


def memory(model: Model) -> dict[str, np.ndarray]:
    """Copies all of it, by name."""
    return model.energy.memory() | slopes(model)


def go_on(model: Model, kept: dict[str, np.ndarray], steps_done: int) -> None:
    """Goes on from the present state by what another model's ``memory`` gave there after so many steps."""
    model.energy.go_on(kept, steps_done)
    put_slopes(model, kept)


def slopes(model: Model) -> dict[str, np.ndarray]:
    """Copies the slopes of the last step, of methods that keep them."""
    names = [name for name in SLOPES if model.arrays.get(name) is not None]
    return {name: model.arrays.values_of(name).copy() for name in names}


def put_slopes(model: Model, kept: dict[str, np.ndarray]) -> None:
    """Puts slopes in place that go with the present state, of those that there are."""
    for name in SLOPES:
        array = model.arrays.get(name)
        if array is not None and name in kept and kept[name].shape == array.numpy().shape:
            array.assign(kept[name].astype(array.numpy().dtype))


def record(model: Model) -> None:
    """Records the present state, and slopes beside it, as the present frame."""
    model.launch("record", "nodes")
    if "slopes" in model.arrays.conditions:
        model.launch("record_slope", "nodes")
