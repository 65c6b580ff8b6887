"""The return of a throw as a function of its actions, with its exact gradient. Needs the extra ``torch``."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from ..errors import InputError
from ..gradients.rollout import Rollout
from . import box

PART = 25
"""Steps of a part of a throw, after each of which it may have arrived."""


class Throws:
    """Throws of a scene of the task, as functions of tensors.

    Args:
        scene: as ``box.scene`` makes it.
        options: of the Rollout.
    """

    def __init__(self, scene: Any, **options: Any):
        self.rollout = Rollout(scene, PART, **options)

    def returned(self, actions: Any, start: Any, place: np.ndarray) -> torch.Tensor:
        """Computes the return of a throw, without dimensions.

        Args:
            actions: shares of the largest forces, a tensor [box.PUSHED, 12]; they are clipped to −1 to 1.
            start: the state that it starts from.
            place: of the box, x and y [m].

        Raises:
            InputError: actions of another shape, or that are not finite.
        """
        actions = torch.as_tensor(actions)
        if tuple(actions.shape) != (box.PUSHED, 12) or not bool(torch.isfinite(actions).all()):
            raise InputError(f"actions of shape {tuple(actions.shape)}, must be finite and of shape ({box.PUSHED}, 12)")
        forces = box.FORCE * actions.to(self.rollout.dtype).clamp(-1.0, 1.0).reshape(box.PUSHED, 4, 3)
        inputs: dict[str, Any] = {"forces": forces}
        if self.rollout.scene.obstacles:
            inputs["obstacle_position"] = box.obstacle_position(place)[: len(self.rollout.scene.obstacles)]
        state, paths = start, []
        for done in range(0, box.STEPS, PART):
            frames = self.rollout(state=state, steps_done=done, **inputs)
            paths.append(frames.position.mean(dim=1)[1 if paths else 0 :])
            state = frames.last
            if bool((paths[-1][:, 2] < box.ARRIVES).any()):
                break
        miss = box.arrival(torch.cat(paths))[:2] - torch.as_tensor(place)
        return -miss.norm() / (0.5 * box.INNER)
