"""The implicit midpoint rule."""

from .stage import StageMethod


class ImplicitMidpoint(StageMethod):
    """M(q̄)(q̇⁺ − q̇) = h F(q̄, w),   q̄ = q + h w/2,   w = (q̇ + q̇⁺)/2,   q⁺ = q + h w.

    Order 2. A-stable but not L-stable: it damps nothing. Stiff modes that a step does not resolve swing on from step to
    step, and the rates of sliding, which have damping but next to no inertia, alternate around theirs. Once yarns
    buckle, its stages may have no solution near by, and steps are split.
    """

    name = "implicit-midpoint"
    order = 2
    fraction = 0.5
    carried = 1.0
    stages = 1
