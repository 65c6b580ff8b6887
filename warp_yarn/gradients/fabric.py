"""A rollout as an ``nn.Module`` whose parameters are bounded physical values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from ..description.scene import Scene
from ..errors import InputError, choice, real
from .inputs import allowed_range, real_tensor
from .rollout import Frames, Rollout


class Fabric(torch.nn.Module):
    """A rollout whose physical parameters are learned within ranges: ω = a·sigmoid(y) + b, as in the paper.

    A ``state_dict`` holds the ranges too. Loaded into a Fabric with other ranges it keeps the physical values, which
    must lie in these.

    Args:
        scene, steps, options: as of Rollout.
        learn: {input: (lowest, highest)}, in the input's unit, within the range that the input has; highest above
            lowest.
        initial: {input of learn: value} to start from, strictly inside the range; the scene's own value where it is
            left out.
    """

    def __init__(
        self,
        scene: Scene,
        steps: int,
        *,
        learn: Mapping[str, tuple[float, float]],
        initial: Mapping[str, Any] | None = None,
        **options: Any,
    ):
        super().__init__()
        self.rollout = Rollout(scene, steps, **options)
        shapes, initial = self.rollout.inputs, {} if initial is None else initial
        for name, value in (("learn", learn), ("initial", initial)):
            if not isinstance(value, Mapping):
                raise InputError(f"{name} = {value!r}, must be a dict by names of inputs")
        for name in initial:
            choice("a name in initial", name, learn)
        self.ranges = {}
        self.y = torch.nn.ParameterDict()
        for name, pair in learn.items():
            if name not in shapes:
                raise InputError(f"learn names {name!r}, must be among {', '.join(sorted(shapes))}")
            self.ranges[name] = _pair(name, pair)
            self.y[name] = torch.nn.Parameter(torch.zeros(shapes[name], dtype=self.rollout.dtype))
            self.set(name, initial.get(name, self._default(name)))

    def _default(self, name: str) -> torch.Tensor:
        """Looks up the scene's own value."""
        scene = self.rollout.scene
        if name in scene.registered and scene.registered[name].of == "yarn":
            return torch.tensor(scene.registered_value(name))
        if name in self.rollout.of_yarns:
            return torch.tensor([getattr(yarn, name) for yarn in scene.cloth.yarns], dtype=torch.float64)
        if name in self.rollout.of_crossings:
            return torch.tensor(getattr(scene.cloth, name), dtype=torch.float64)
        return self.rollout.defaults[name.removeprefix("yarn_").removeprefix("node_")]

    def value(self, name: str) -> torch.Tensor:
        """Computes a parameter in its physical unit; differentiable."""
        low, high = self.ranges[choice("name", name, self.ranges)]
        return low + (high - low) * torch.sigmoid(self.y[name])

    @property
    def values(self) -> dict[str, torch.Tensor]:
        """Every parameter in its physical unit; differentiable."""
        return {name: self.value(name) for name in self.ranges}

    @torch.no_grad()
    def set(self, name: str, value: Any) -> None:
        """Sets a parameter to a physical value strictly inside its range."""
        y = self.y[choice("name", name, self.ranges)]
        value = real_tensor(name, value).to(dtype=y.dtype, device=y.device)
        try:
            value = value.expand(y.shape)
        except RuntimeError as error:
            raise InputError(f"{name} has shape {tuple(value.shape)}, must be {tuple(y.shape)}") from error
        y.copy_(self._inverse(name, value))

    def _inverse(self, name: str, value: torch.Tensor) -> torch.Tensor:
        """Computes y of a physical value, or raises an InputError."""
        low, high = self.ranges[name]
        fraction = (value - low) / (high - low)
        if not bool(((fraction > 0.0) & (fraction < 1.0)).all()):
            raise InputError(f"{name} = {value}, must be strictly between {low:g} and {high:g}")
        return torch.logit(fraction)

    def forward(self, **inputs: Any) -> Frames:
        """Runs the scene with the present parameters, and any other inputs, as a Rollout does."""
        for name in inputs:
            if name in self.ranges:
                raise InputError(f"{name} is learned, so a call cannot be given it: use set")
        return self.rollout(**self.values, **inputs)

    # -- state_dict --------------------------------------------------------------------------------------------------

    def get_extra_state(self) -> dict[str, tuple[float, float]]:
        """Adds the ranges to the ``state_dict``."""
        return dict(self.ranges)

    def set_extra_state(self, state: Any) -> None:
        """Does nothing: the ranges stay, and y was taken to them."""

    @torch.no_grad()
    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *others: Any) -> None:
        """Takes y of other ranges to these."""
        saved = state_dict.get(f"{prefix}_extra_state")
        for name in self.ranges:
            key = f"{prefix}y.{name}"
            if key not in state_dict:
                continue
            if not isinstance(saved, Mapping) or name not in saved:
                raise InputError(f"state_dict has no range of {name!r}, without which its {key!r} means nothing")
            low, high = _pair(name, saved[name])
            if (low, high) != self.ranges[name]:
                value = low + (high - low) * torch.sigmoid(state_dict[key].to(self.rollout.dtype))
                state_dict[key] = self._inverse(name, value)
        super()._load_from_state_dict(state_dict, prefix, *others)


def _pair(name: str, pair: Any) -> tuple[float, float]:
    """Checks a range of an input, from lowest to highest, or raises an InputError."""
    try:
        low, high = pair
    except (TypeError, ValueError) as error:
        raise InputError(f"learn[{name!r}] = {pair!r}, must be two numbers, (lowest, highest)") from error
    # every value in between is allowed where the lowest is, or is just not
    least = next(iter(allowed_range(name).values()), None)
    low, high = real(f"learn[{name!r}][0]", low, least=least), real(f"learn[{name!r}][1]", high)
    if not low < high:
        raise InputError(f"learn[{name!r}] = ({low:g}, {high:g}), the second must be above the first")
    return low, high
