"""Gusts: the velocity of the air at every node, by a function that was written for the device."""

from typing import Any

import warp as wp

from ..core.indexing import index
from ..core.variant import Variant


def define(variant: Variant, function: Any) -> wp.Kernel:
    """Define the kernel that evaluates a ``wp.func`` of a position and the time, in a module of its own."""
    scalar, vec3 = variant.scalar, variant.vec3

    @wp.kernel(module="unique", enable_backward=False)
    def sample_gusts(
        counters: wp.array(dtype=int),
        step_duration: scalar,
        origin: vec3,
        position: wp.array(dtype=vec3),
        gust: wp.array(dtype=vec3),
    ):
        """Evaluate it at the nodes, in the middle of the present step."""
        i = index(wp.tid())
        gust[i] = function(position[i] + origin, (scalar(counters[1]) + scalar(0.5)) * step_duration)

    return sample_gusts
