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
from ..linear.pair_blocks import IMPACTS, TOUCHES

CYCLING = 12
"""Evaluations in a stage after which every third matrix takes f₁/|v| for f₁′: a flat landing may else go to and fro
between sticking and sliding for ever. (Always, Newton's iteration would creep.)"""


FAST = 0.02
"""Part of its range by which a contact's gap may change in a step of two stages: the second one's base is extrapolated
from the first, and gains up to half of an impact's energy beyond. At 0.05, what rebounds at 0.05 m/s gains 0.4 % of its
energy in a step of 1 ms, at 0.02 nothing that can be seen."""
STIFFNESS, DISTANCE, RANGE, SLIP_SPEED, DAMPING_SPEED = 0, 1, 2, 3, 4
"""Places of a law's numbers, which kernels pass on as a vector."""


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    scalar, vec3, mat33 = variant.scalar, variant.vec3, variant.mat33
    vec5 = wp.types.vector(5, scalar)

    @wp.func
    def barrier(x: scalar) -> vec3:
        """Compute b, b′ and b″ of 0 < x < 1."""
        left = scalar(1.0) - x
        log = wp.log(x)
        by_x = left / x
        return vec3(
            -left * left * log, left * (scalar(2.0) * log - by_x), by_x * (by_x + scalar(4.0)) - scalar(2.0) * log
        )

    @wp.func
    def law_of(
        stiffness: wp.array(dtype=scalar),
        distance: wp.array(dtype=scalar),
        reach: wp.array(dtype=scalar),
        slip_speed: wp.array(dtype=scalar),
        damping_speed: wp.array(dtype=scalar),
    ) -> vec5:
        """Gather a law's numbers."""
        return vec5(stiffness[0], distance[0], reach[0], slip_speed[0], damping_speed[0])

    @wp.func
    def contact_load(law: vec5, gap: scalar, rate: scalar) -> scalar:
        """Compute f_n."""
        reach = law[RANGE]
        slope = barrier((gap - law[DISTANCE]) / reach)[1] * law[STIFFNESS] * reach
        y = -rate / law[DAMPING_SPEED]
        return -slope * scalar(0.5) * (y + wp.sqrt(y * y + scalar(4.0)))

    @wp.func
    def contact_friction(law: vec5, speed: scalar) -> scalar:
        """Compute f₁/|v|."""
        slip = law[SLIP_SPEED]
        result = scalar(1.0) / wp.max(speed, slip)
        if speed < slip:
            result = (scalar(2.0) - speed / slip) / slip
        return result

    @wp.func
    def contact_force(law: vec5, friction: scalar, gap: scalar, n: vec3, v: vec3) -> vec3:
        """Compute the force of a contact on what has this gap, of a velocity v relative to the other side."""
        rate = wp.dot(n, v)
        load = contact_load(law, gap, rate)
        across = v - n * rate
        # of the square, which has a derivative where nothing moves
        square = wp.dot(across, across)
        by_speed = scalar(2.0) / law[SLIP_SPEED]
        if square > scalar(0.0):
            by_speed = contact_friction(law, wp.sqrt(square))
        return n * load - across * (friction * load * by_speed)

    @wp.func
    def contact_matrix(
        law: vec5, friction: scalar, gap: scalar, n: vec3, v: vec3, coefficients: vec3, evaluations: int
    ) -> mat33:
        """Compute its part of D and H, by their coefficients."""
        one = scalar(1.0)
        reach = law[RANGE]
        b = barrier((gap - law[DISTANCE]) / reach) * law[STIFFNESS]
        rate = wp.dot(n, v)
        y = -rate / law[DAMPING_SPEED]
        root = wp.sqrt(y * y + scalar(4.0))
        sigma = scalar(0.5) * (y + root)
        load = -b[1] * reach * sigma
        along = coefficients[2] * b[2] * sigma + coefficients[1] * load / (root * law[DAMPING_SPEED])
        across = v - n * rate
        speed = wp.length(across)
        by_speed = contact_friction(law, speed)
        held = coefficients[1] * friction * load
        result = wp.outer(n, n) * (along - held * by_speed) + wp.identity(n=3, dtype=scalar) * (held * by_speed)
        slip = law[SLIP_SPEED]
        secant = evaluations > wp.static(CYCLING) and evaluations % 3 == 0
        if speed > scalar(0.0) and not secant:
            falls = -by_speed
            if speed < slip:
                falls += scalar(2.0) * (one - speed / slip) / slip
            result += wp.outer(across, across) * (held * falls / (speed * speed))
        return result

    @wp.func
    def note_contact(law: vec5, n: vec3, v: vec3, change: vec3, step_size: scalar, touching: wp.array(dtype=int)):
        """Note that something touches, and whether its gap changes much in a step, at either end of the stage."""
        touching[wp.static(TOUCHES)] = 1
        rate = wp.dot(n, v)
        if step_size * wp.max(wp.abs(rate), wp.abs(rate + wp.dot(n, change))) > scalar(FAST) * law[RANGE]:
            touching[wp.static(IMPACTS)] = 1

    @wp.func
    def note_motion(touch: scalar, reach: scalar, moved: vec3, touching: wp.array(dtype=int)):
        """Note an impact of what touches, or did a step ago: by its gap, how far that moves in a step, and in one that
        begins later."""
        most = wp.max(wp.abs(moved[1]), wp.abs(moved[2]))
        if moved[0] - wp.max(moved[1], scalar(0.0)) < touch and most > scalar(FAST) * reach:
            touching[wp.static(IMPACTS)] = 1

    return SimpleNamespace(
        note_motion=note_motion,
        law_of=law_of,
        note=note_contact,
        barrier=barrier,
        load=contact_load,
        force=contact_force,
        matrix=contact_matrix,
    )
