"""Inputs that change from step to step: moving pins and obstacles, applied forces (``kernels/stepping/frames.py``)."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .model import Model

PATHS = ("pin_target", "applied_force")
"""Inputs that may change from step to step."""


class Inputs:
    """The inputs of a model."""

    def __init__(self, model: Model):
        self.model = model

    def load(self, stage: int = 0) -> None:
        """Puts pins, obstacles and applied forces of a stage of this step in place, where they change."""
        a = self.model.arrays
        if "forces change" in a.conditions:
            path, values = a["applied_force_path"], a["applied_force"]
            self.model.launch("load_inputs", len(values), path=path, values=values)
        if "pins move" in a.conditions:
            arrays = {"start": a["pin_start"], "path": a["pin_target_path"], "motion": a["pin_motion"]}
            self.model.launch("move_along", "pins", stage=stage, values=a["pin_target"], **arrays)
        self.model.contact.load(stage)

    @property
    def move(self) -> bool:
        """Whether anything is elsewhere at another time of a step."""
        return "pins move" in self.model.arrays.conditions or self.model.contact.obstacles_move

    def scatter_gradient(self, name: str, stage: int) -> None:
        """Reverses ``load`` for one of ``PATHS``."""
        a = self.model.arrays
        gradients = {"values_grad": a[name].grad, "path_grad": a[f"{name}_path"].grad}
        if name == "applied_force":
            self.model.launch("scatter_gradient", len(a[name]), **gradients)
        else:
            self.model.launch("scatter_gradient_along", "pins", stage=stage, **gradients)
