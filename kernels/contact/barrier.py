"""The law of a contact, of a gap g with normal n = ∇g and relative velocity v: a barrier, damping and Coulomb friction.

    V   = κ d̂² b(x),   b = −(1 − x)² ln x,   x = (g − D)/d̂      0 < x < 1, and V = 0 beyond, with two derivatives
    f_n = −V′ σ(−ġ/v_d),   σ(y) = (y + √(y² + 4))/2                 load, with damping: never adhesive, σ(0) = 1
    F_t = −μ f_n f₁(|v_t|) v_t/|v_t|,   f₁ = 2y − y² (y = |v_t|/ε < 1), else 1

The barrier is that of Li and others (Incremental Potential Contact, 2020), in the gap. Load and friction are of the
same state, which the stage solves for: nothing lags a step or an iteration behind, as it does in most of the field, so
that the law has an adjoint and the order of the method (Larionov and others, 2022, say what lagging costs). Damping is
smooth, since clipped damping stalls Newton's iteration at 1e-8.

Parameters: ``contact_stiffness`` κ [N/m]; ``contact_distance`` D > 0 and ``contact_range`` d̂ [m]; friction μ of each
obstacle, and ``contact_friction`` of cloth on cloth; ``contact_slip_speed`` ε [m/s]; ``contact_damping_speed`` v_d
[m/s], infinite where there is no damping.

The matrix holds what is symmetric and positive semi-definite of −∂F: V″ σ n nᵀ in H, and in D −V′ σ′/v_d n nᵀ and
μ f_n (f₁/|v| (I − n nᵀ) + (f₁′ − f₁/|v|) t tᵀ). It leaves out the curvature of the gap, which is negative, and how
friction depends on the load, which is not symmetric.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.variant import Variant
from ..linear import pair_blocks

CYCLING = 12
"""Evaluations in a stage after which every third matrix takes f₁/|v| for f₁′: a flat landing may else go to and fro
between sticking and sliding for ever. (Always, Newton's iteration would creep.)"""


FAST = 0.05
"""Part of its range by which a contact's gap may change in a step of two stages: the second one's base is extrapolated
from the first, and gains up to half of an impact's energy beyond."""
TOUCHES, PAIRS_TOUCH, IMPACTS = 0, pair_blocks.PAIRS, 2
"""Places of ``touching``: whether anything touches, two nodes of the cloth, anything so fast; of the last state."""


@functools.cache
def structs(variant: Variant) -> SimpleNamespace:
    """The parameters that all contacts share."""
    scalar = variant.scalar

    @wp.struct
    class ContactLaw:
        stiffness: wp.array(dtype=scalar)
        distance: wp.array(dtype=scalar)
        range: wp.array(dtype=scalar)
        slip_speed: wp.array(dtype=scalar)
        damping_speed: wp.array(dtype=scalar)

    return SimpleNamespace(ContactLaw=ContactLaw)


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    scalar, vec3, mat33 = variant.scalar, variant.vec3, variant.mat33
    ContactLaw = structs(variant.forward).ContactLaw

    @wp.func
    def barrier(x: scalar) -> vec3:
        """b, b′ and b″ of 0 < x < 1."""
        left = scalar(1.0) - x
        log = wp.log(x)
        by_x = left / x
        return vec3(
            -left * left * log, left * (scalar(2.0) * log - by_x), by_x * (by_x + scalar(4.0)) - scalar(2.0) * log
        )

    @wp.func
    def contact_load(law: ContactLaw, gap: scalar, rate: scalar) -> scalar:
        """f_n."""
        reach = law.range[0]
        slope = barrier((gap - law.distance[0]) / reach)[1] * law.stiffness[0] * reach
        y = -rate / law.damping_speed[0]
        return -slope * scalar(0.5) * (y + wp.sqrt(y * y + scalar(4.0)))

    @wp.func
    def contact_friction(law: ContactLaw, speed: scalar) -> scalar:
        """f₁/|v|."""
        slip = law.slip_speed[0]
        result = scalar(1.0) / wp.max(speed, slip)
        if speed < slip:
            result = (scalar(2.0) - speed / slip) / slip
        return result

    @wp.func
    def contact_force(law: ContactLaw, friction: scalar, gap: scalar, n: vec3, v: vec3) -> vec3:
        """Force of a contact on what has this gap, of a velocity v relative to the other side."""
        rate = wp.dot(n, v)
        load = contact_load(law, gap, rate)
        across = v - n * rate
        # of the square, which has a derivative where nothing moves
        square = wp.dot(across, across)
        by_speed = scalar(2.0) / law.slip_speed[0]
        if square > scalar(0.0):
            by_speed = contact_friction(law, wp.sqrt(square))
        return n * load - across * (friction * load * by_speed)

    @wp.func
    def contact_matrix(
        law: ContactLaw, friction: scalar, gap: scalar, n: vec3, v: vec3, weights: vec3, evaluations: int
    ) -> mat33:
        """Part of D and H, by their weights."""
        one = scalar(1.0)
        reach = law.range[0]
        b = barrier((gap - law.distance[0]) / reach) * law.stiffness[0]
        rate = wp.dot(n, v)
        y = -rate / law.damping_speed[0]
        root = wp.sqrt(y * y + scalar(4.0))
        sigma = scalar(0.5) * (y + root)
        load = -b[1] * reach * sigma
        along = weights[2] * b[2] * sigma + weights[1] * load / (root * law.damping_speed[0])
        across = v - n * rate
        speed = wp.length(across)
        by_speed = contact_friction(law, speed)
        held = weights[1] * friction * load
        result = wp.outer(n, n) * (along - held * by_speed) + wp.identity(n=3, dtype=scalar) * (held * by_speed)
        slip = law.slip_speed[0]
        secant = evaluations > wp.static(CYCLING) and evaluations % 3 == 0
        if speed > scalar(0.0) and not secant:
            falls = -by_speed
            if speed < slip:
                falls += scalar(2.0) * (one - speed / slip) / slip
            result += wp.outer(across, across) * (held * falls / (speed * speed))
        return result

    @wp.func
    def note_contact(law: ContactLaw, n: vec3, v: vec3, change: vec3, step_size: scalar, touching: wp.array(dtype=int)):
        """Notes that something touches, and whether its gap changes much in a step, at either end of the stage."""
        touching[wp.static(TOUCHES)] = 1
        rate = wp.dot(n, v)
        if step_size * wp.max(wp.abs(rate), wp.abs(rate + wp.dot(n, change))) > scalar(FAST) * law.range[0]:
            touching[wp.static(IMPACTS)] = 1

    return SimpleNamespace(
        note=note_contact, barrier=barrier, load=contact_load, force=contact_force, matrix=contact_matrix
    )
