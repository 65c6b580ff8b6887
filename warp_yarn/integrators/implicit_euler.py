"""Fully implicit Euler."""

from .stage import StageMethod


class ImplicitEuler(StageMethod):
    """M(q⁺)(q̇⁺ − q̇) = h F(q⁺, q̇⁺),   q⁺ = q + h q̇⁺.

    Order 1. L-stable: stiff modes vanish within a step, and with them the stiff damping of sliding. The surest method,
    and the most damped.
    """

    name = "implicit-euler"
    order = 1
    fraction = 1.0
    carried = 0.0
    stages = 1
