"""What becomes of a segment's direction as the segment shrinks to a point: it fades out.

Bends and corners are angles between directions d/l, which jump where l passes 0, and whose forces grow as 1/l. So an
energy V(θ) of such an angle is

    s V(θ) + (1 − s) max V,   s = s(l₁) s(l₂),   s(l) = x³ (10 − 15 x + 6 x²) of x = l/(0.1 L), and 1 from 0.1 L on

twice differentiable, and flat enough at 0 that s/l and s/l² vanish too: every force is continuous there. It is the
largest energy that a collapsed segment has, not none: no angle draws a segment's ends together.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.variant import Variant

REACH = 0.1
"""Length of a segment, in spacings, under which its direction fades."""


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    scalar, vec3 = variant.scalar, variant.vec3

    @wp.func
    def smoothstep(x: scalar) -> scalar:
        """Rise from 0 at 0 to 1 at 1, with two derivatives of 0 at both."""
        return x * x * x * (scalar(10.0) - x * (scalar(15.0) - scalar(6.0) * x))

    @wp.func
    def presence(length: scalar, spacing: scalar) -> vec3:
        """Compute (s, s', s'') of a segment."""
        reach = spacing * scalar(wp.static(REACH))
        if length >= reach:
            return vec3(scalar(1.0), scalar(0.0), scalar(0.0))
        x = length / reach
        left = scalar(1.0) - x
        return vec3(
            smoothstep(x),
            scalar(30.0) * x * x * left * left / reach,
            scalar(60.0) * x * left * (left - x) / (reach * reach),
        )

    @wp.func
    def inverse_length(length: scalar, spacing: scalar) -> scalar:
        """Compute 1/l, and a finite number at l = 0, where s takes it away."""
        return scalar(1.0) / wp.max(length, spacing * scalar(wp.static(1.0e-6 * REACH)))

    return SimpleNamespace(smoothstep=smoothstep, presence=presence, inverse_length=inverse_length)
