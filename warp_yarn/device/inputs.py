"""Inputs that change from step to step: moving pins and obstacles, applied forces, gravity and wind
(``kernels/stepping/frames.py``), and what functions say of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..description.varying import evaluated, kind_of
from ..errors import InputError
from ..kernels.stepping import gusts

if TYPE_CHECKING:
    from .model import Model

ROWS = ("applied_force", "gravity", "wind_velocity")
"""Inputs that have a row for each step, which holds for all of it."""
PATHS = ("pin_target", *ROWS)
"""Inputs that may change from step to step."""


class Inputs:
    """The inputs of a model.

    Attributes:
        functions: those that the host evaluates before each step, by name.
    """

    def __init__(self, model: Model, *, hooked: bool = False):
        self.model = model
        scene, a = model.scene, model.arrays
        self._rows = [name for name in ROWS if f"{name}_path" in a]
        self.functions = dict(scene.functions)
        self.gravity_varies = hooked or "gravity" in self.functions or "gravity" in self._rows
        """Whether its energy is not the cloth's own: it does work then."""
        self._gusts = None
        on_device = "gusts" in a.conditions and kind_of("wind velocity", self.functions["wind"]) == "device"
        if on_device and not a.variant.reverse:
            self._gusts = self._compiled(self.functions.pop("wind"))
        self.hooked = hooked
        """Whether a hook may set them before each step."""
        if self.hooked and a.variant.reverse:
            raise InputError("hook with differentiable: what it sets has no gradient; leave one out")
        if self.functions and a.variant.reverse:
            what = ", ".join(map(str, self.functions))
            raise InputError(f"{what}: functions have no gradient, must be numbers or rows [steps, 3] here")

    def _compiled(self, function: Any) -> wp.Kernel:
        """Makes the kernel of gusts, and compiles it where a function of other types can be told from other faults."""
        a = self.model.arrays
        try:
            kernel = gusts.define(a.variant, function)
            kernel.module.load(a.device)
        except (OSError, InputError):
            raise
        except Exception as error:
            of = {"double": ("wp.vec3d", "wp.float64"), "single": ("wp.vec3f", "wp.float32")}
            vector, scalar = of[self.model.precision]
            raise InputError(
                f"wind velocity is a wp.func that cannot be compiled, must be of (position: {vector}, time: {scalar}) "
                f"and return a {vector} in {self.model.precision} precision: {error}"
            ) from error
        return kernel

    def evaluate(self, step: int, position: np.ndarray) -> None:
        """Puts what functions say in the step after so many others in place, of positions at its beginning."""
        a = self.model.arrays
        time = (step + 0.5) * self.model.step_size
        for name, function in self.functions.items():
            if name == "gravity":
                a["gravity"].assign(evaluated("gravity", function, time, position)[None])
            elif name == "wind":
                array = "gust" if "gusts" in a.conditions else "wind_velocity"
                a[array].assign(evaluated("wind velocity", function, time, position).reshape(-1, 3))
            elif isinstance(name, int):
                self.put("applied_force", evaluated(f"forces[{name}]", function, time, position), node=name)

    def put(self, name: str, value: np.ndarray, *, first: int = 0, node: int | None = None) -> bool:
        """Puts an input in place, in its rows from one on where it has any.

        Args:
            name: of ``PATHS``.
            value: [entries, 3], or 3 numbers of one entry.
            first: the row.
            node: whose applied force it is; None: of all that there are.

        Returns:
            Whether steps before that row had what was put in place.
        """
        a = self.model.arrays
        array = a[f"{name}_path" if f"{name}_path" in a else name]
        values = array.numpy().reshape(-1, len(a[name]), 3).copy()
        entry = slice(None) if node is None else int(np.flatnonzero(self.model.scene.force_nodes == node)[0])
        values[min(first, len(values) - 1) :, entry] = value
        array.assign(values.reshape(-1, 3))
        return first >= len(values)

    def load(self, stage: int = 0) -> None:
        """Puts pins, obstacles and applied forces of a stage of this step in place, where they change."""
        a = self.model.arrays
        for name in self._rows:
            path, values = a[f"{name}_path"], a[name]
            self.model.launch("load_inputs", len(values), path=path, values=values)
        if self._gusts is not None:
            origin = a.variant.vec3(*a.origin)
            a.launch(self._gusts, "nodes", step_duration=self.model.step_size, origin=origin)
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
        if name in ROWS:
            self.model.launch("scatter_gradient", len(a[name]), **gradients)
        else:
            self.model.launch("scatter_gradient_along", "pins", stage=stage, **gradients)
