"""What a rollout can be given: every number of a scene and its state, by name, with the shape and the range it has."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
import warp as wp

from ..description.obstacles import unit_quaternion
from ..errors import InputError, real
from ..kernels import TERMS, own, parameters
from ..simulation.simulator import Simulator
from ..simulation.state import FIELDS, State

_OWN = [parameter for term in TERMS.values() if own(term) for parameter in term.parameters]
NUMBERS = tuple(p.name for p in _OWN if p.of in ("scene", "crossing") and p.size == 1)
VECTORS = tuple(p.name for p in _OWN if p.size == 3)
"""Names of inputs that are no yarn's, beside those of registered terms."""
ARRAY_OF_PATH = {"pin_path": "pin_target", "forces": "applied_force"}
"""Inputs that may change from step to step, and the arrays that hold a step's row of them."""
ROWS = ("gravity", "wind_velocity")
"""Others, which have the name of their arrays."""


class Inputs:
    """The inputs of a scene, as tensors of a simulator's precision and device.

    Args:
        simulator: of the scene.

    Attributes:
        dtype, device: of the tensors.
        of_yarns: names of the parameters that yarns have.
        of_crossings: names of those that crossings have, in a general cloth.
        defaults: the scene's own value of everything, the yarns' parameters by yarn, those of crossings by node.
        shapes: name and shape of everything that a call takes, the yarns' parameters by material too, and those of
            crossings as the cloth has them.
    """

    def __init__(self, simulator: Simulator):
        self.cloth = simulator.scene.cloth
        self.dtype = {"double": torch.float64, "single": torch.float32}[simulator.model.precision]
        self.device = wp.device_to_torch(simulator.model.device)
        arrays = simulator.arrays
        self._parameters = {name: p for name, p in parameters().items() if arrays.get(name) is not None}
        self.of_yarns = tuple(name for name, p in self._parameters.items() if p.of == "yarn")
        crossings = (name for name, p in self._parameters.items() if p.of == "crossing" and self.cloth.general)
        self.of_crossings = tuple(crossings)
        self.defaults = self._scene_values(simulator)
        self.shapes = {name: tuple(value.shape) for name, value in self.defaults.items()}
        for name in self.of_yarns:
            self.shapes[f"yarn_{name}"] = self.shapes[name]
            self.shapes[name] = (len(self.cloth.yarns),)
        for name in self.of_crossings:
            self.shapes[f"node_{name}"] = self.shapes[name]
            self.shapes[name] = np.shape(getattr(self.cloth, name))

    def _scene_values(self, simulator: Simulator) -> dict[str, torch.Tensor]:
        """Reads the scene's own values from the device."""
        arrays = simulator.arrays
        several = (*self.of_yarns, *self.of_crossings)
        shapes = {name: (-1,) if name in several or p.size == 3 else () for name, p in self._parameters.items()}
        values = {name: arrays[name].numpy().reshape(shape) for name, shape in shapes.items()}
        for name, array in ARRAY_OF_PATH.items():
            if f"{array}_path" in arrays:
                path = arrays[f"{array}_path"].numpy().reshape(-1, len(arrays[array]), 3)
                values[name] = path[:-1] if name == "forces" else path
            elif array in arrays:
                values[name] = arrays[array].numpy()
        values |= {name: arrays[f"{name}_path"].numpy() for name in ROWS if f"{name}_path" in arrays}
        values |= {name: arrays[name].numpy().reshape(shape) for name, shape in obstacle_shapes(simulator).items()}
        state = simulator.state
        values |= {name: getattr(state, name) for name in FIELDS}
        return {name: torch.tensor(value, dtype=self.dtype, device=self.device) for name, value in values.items()}

    def by_yarn(self, state: State | None, given: Mapping[str, Any]) -> dict[str, torch.Tensor]:
        """Checks what a call is given, and takes it to the names and shapes of ``defaults``; differentiable.

        Raises:
            InputError: an input that is given twice, or as of ``checked``.
        """
        inputs = dict(given)
        if state is not None and not isinstance(state, State):
            raise InputError(f"state = {state!r}, must be a State, such as frames.last")
        for name in FIELDS if state is not None else ():
            if name in inputs:
                raise InputError(f"state and {name} are both given, must be one of them")
            if getattr(state, name) is not None:
                inputs[name] = getattr(state, name)
        values = {name: self.checked(name, value) for name, value in inputs.items()}
        material = torch.tensor(self.cloth.material, device=self.device)
        for name in self.of_yarns:
            if name in values and f"yarn_{name}" in values:
                raise InputError(f"{name} and yarn_{name} are both given, must be one of them")
            if name in values:
                values[name] = values[name][material]
            elif f"yarn_{name}" in values:
                values[name] = values.pop(f"yarn_{name}")
        for name in self.of_crossings:
            if name in values and f"node_{name}" in values:
                raise InputError(f"{name} and node_{name} are both given, must be one of them")
            if name in values:
                values[name] = values[name].reshape(-1)[torch.as_tensor(self.cloth.entries(name), device=self.device)]
            elif f"node_{name}" in values:
                values[name] = values.pop(f"node_{name}")
        if "euler_velocity" in values:
            crossing = torch.as_tensor(self.cloth.topology.is_crossing != 0, device=self.device)
            values["euler_velocity"] = values["euler_velocity"] * crossing[:, None]
        if "euler" in values:
            values.setdefault("anchor", values["euler"])
        return values

    def checked(self, name: str, value: Any) -> torch.Tensor:
        """Makes a tensor of an input, a copy.

        Raises:
            InputError: an input that the scene does not have, of another shape, not real, not finite, or out of the
                range that Yarn, Cloth, Wind and Scene give.
        """
        if name not in self.shapes:
            raise InputError(
                f"{name!r} is no input of this scene, so it is fixed and has no gradient; "
                f"the inputs are {', '.join(sorted(self.shapes))}"
            )
        tensor = real_tensor(name, value).to(device=self.device, dtype=self.dtype)
        if self.shapes[name] == () and tensor.shape == (1,):
            tensor = tensor.reshape(())
        if tuple(tensor.shape) != self.shapes[name]:
            raise InputError(f"{name} has shape {tuple(tensor.shape)}, must be {self.shapes[name]}")
        if not bool(torch.isfinite(tensor).all()):
            raise InputError(f"{name} is not finite: {tensor.detach()}")
        if allowed_range(name):
            at = int(tensor.argmin())
            real(f"{name}[{at}]" if tensor.ndim else name, tensor.reshape(-1)[at].item(), **allowed_range(name))
        if "obstacle_rotation" in name:
            for k, q in enumerate(tensor.detach().reshape(-1, 4)):
                unit_quaternion(f"{name}[{k}]", q.numpy(force=True))
        # Whoever changes theirs in place before the backward pass shall not change this run's.
        return tensor.clone()


def obstacle_shapes(simulator: Simulator) -> dict[str, tuple[int, ...]]:
    """Lists the inputs that say where obstacles are and what they are like, with their shapes."""
    count = len(simulator.scene.obstacles)
    if not simulator.model.contact.obstacles:
        return {}
    shapes: dict[str, tuple[int, ...]] = {"obstacle_size": (count, 3), "obstacle_friction": (count,)}
    rest = (-1, count) if simulator.model.contact.obstacles_move else (count,)
    end = "_path" if simulator.model.contact.obstacles_move else ""
    return {**shapes, f"obstacle_position{end}": (*rest, 3), f"obstacle_rotation{end}": (*rest, 4)}


def array_of(name: str, value: torch.Tensor) -> str:
    """Names the array that holds an input: of one that changes from step to step, the rows of its path."""
    array = ARRAY_OF_PATH.get(name, name)
    has_rows = (name in ARRAY_OF_PATH and value.ndim == 3) or (name in ROWS and value.ndim == 2)
    return f"{array}_path" if has_rows else array


def allowed_range(name: str) -> dict[str, float]:
    """Says what ``number`` is to check of an input."""
    if name in ("obstacle_size", "obstacle_friction"):
        return {"least": 0.0}
    parameter = parameters().get(name.removeprefix("yarn_").removeprefix("node_"))
    return {} if parameter is None else parameter.range


def real_tensor(name: str, value: Any) -> torch.Tensor:
    """Makes a dense tensor of real numbers of a value, or raises an InputError."""
    if not isinstance(value, torch.Tensor):
        try:
            array = np.asarray(value)
        except (TypeError, ValueError, RuntimeError) as error:  # ragged, or a list of tensors that need a gradient
            raise InputError(f"{name} must be a tensor or an array of numbers ({error}), got {value!r}") from error
        if array.dtype.kind not in "fiub":
            raise InputError(f"{name} must be a tensor or an array of real numbers, got {value!r}")
        return torch.as_tensor(array.astype(np.float64))
    if value.is_complex() or value.layout != torch.strided:
        raise InputError(f"{name} is a tensor of {value.dtype}, {value.layout}: it must be one of real numbers, dense")
    return value


def refuse_transforms(*tensors: torch.Tensor | None) -> None:
    """Refuses what stands for other tensors, as transforms have them, and has no numbers of its own."""
    if torch.jit.is_tracing():  # which would keep this run's frames as constants
        raise InputError("a Rollout cannot be traced by torch.jit: torch runs none of its steps")
    transformed = torch._C._are_functorch_transforms_active()  # no public function says so
    try:
        for tensor in tensors:
            if tensor is not None:
                tensor.data_ptr()
    except RuntimeError:
        transformed = True
    if transformed:
        raise InputError(
            "a Rollout cannot be transformed by torch.func (vmap, grad, ...), nor its gradients batched: call it, and "
            "torch.autograd, one by one"
        )
