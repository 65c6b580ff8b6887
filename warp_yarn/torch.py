"""Runs of a scene as differentiable torch operations: the names that users write. Needs the extra ``torch``."""

from .gradients.fabric import Fabric
from .gradients.rollout import Frames, Rollout

__all__ = ["Fabric", "Frames", "Rollout"]
