"""The two-stage, second-order SDIRK method of Alexander."""

from .stage import StageMethod


class SDIRK2(StageMethod):
    """Two implicit stages of η = γ h, γ = 1 − 1/√2, the second of which ends the step.

        M(q₁)(w₁ − q̇) = η F(q₁, w₁),   q₁ = q + η w₁
        M(q⁺)(q̇⁺ − v₀) = η F(q⁺, q̇⁺),   q⁺ = q + (h − η) w₁ + η q̇⁺,   v₀ = q̇ + (h − η)(w₁ − q̇)/η

    Order 2; less where stiff springs go unresolved. L-stable and stiffly accurate: unresolved stiff modes and the stiff
    damping of sliding, whose mass is singular, vanish within a step as with implicit Euler, at a fraction of its error.
    """

    name = "sdirk2"
    order = 2
    fraction = 1.0 - 0.5**0.5
    carried = 0.5**0.5
    stages = 2
    fallback = "implicit-euler"
    local_error = 3.0 * fraction**2 - 2.0 * fraction**3 - 1.0 / 6.0
