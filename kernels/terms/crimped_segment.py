"""Energy of a crimped segment, and the height that its crossing has (``crimp_interchange.py`` has the equations)."""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.variant import Variant

ROUND = 9.0 / 8.0
"""β²."""
BUCKLING = 0.25
"""The most that a yarn carries in compression, in 12 k_b cos²θ₀/L₀²: a third of it is where h would have two values in
a segment that is squeezed to a third of its yarn's length."""
MOST_STEPS = 60
SETTLED = {wp.float64: 1e-13, wp.float32: 1e-5}
"""Part of d₁ + d₂ that the last step of Newton's iteration may change h by: the one after it squares that."""


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    scalar = variant.scalar
    vec2, vec3, vec4 = wp.types.vector(2, scalar), variant.vec3, variant.vec4

    @wp.func
    def crimp_length(p: scalar, h: scalar) -> scalar:
        """Compute ℓ, never 0."""
        return wp.sqrt(p * p + scalar(wp.static(ROUND)) * h * h + scalar(1.0e-30))

    @wp.func
    def crimp_offset(p: scalar, h: scalar, angle: scalar) -> scalar:
        """Compute r."""
        return scalar(wp.static(ROUND**0.5)) * h * wp.cos(angle) - p * wp.sin(angle)

    @wp.func
    def crimp_tension(strain: scalar, k: scalar, most: scalar) -> vec3:
        """Compute (∫T, T, T') of a strain: kₛ times it, and in compression never as much as ``most``."""
        if strain >= scalar(0.0):
            return vec3(scalar(0.5) * k * strain * strain, k * strain, k)
        y = -k * strain / most
        by = scalar(1.0) / (scalar(1.0) + y)
        return vec3(most * most / k * (y + wp.log(by)), k * strain * by, k * by * by)

    @wp.func
    def crimp_energy(p: scalar, h: scalar, rest: scalar, k: scalar, b: scalar, angle: scalar) -> scalar:
        """Compute V of a crimped segment."""
        cosine = wp.cos(angle)
        pull = crimp_tension(crimp_length(p, h) / rest - scalar(1.0), k, scalar(BUCKLING) * b * cosine * cosine)
        r = crimp_offset(p, h, angle)
        return rest * pull[0] + scalar(0.5) * b * r * r / rest

    @wp.func
    def crimp_slopes(p: scalar, h: scalar, rest: scalar, k: scalar, b: scalar, angle: scalar) -> vec3:
        """Compute the derivatives of V by p, h and Δs."""
        cosine = wp.cos(angle)
        length = crimp_length(p, h)
        pull = crimp_tension(length / rest - scalar(1.0), k, scalar(BUCKLING) * b * cosine * cosine)
        r = crimp_offset(p, h, angle) / rest
        return vec3(
            pull[1] * p / length - b * r * wp.sin(angle),
            pull[1] * scalar(wp.static(ROUND)) * h / length + b * r * scalar(wp.static(ROUND**0.5)) * cosine,
            pull[0] - pull[1] * length / rest - scalar(0.5) * b * r * r,
        )

    @wp.func
    def crimp_curvature(p: scalar, h: scalar, rest: scalar, k: scalar, b: scalar, angle: scalar):
        """Compute the second derivatives of V without what is negative: pp, ph, hh, pΔ, hΔ, ΔΔ; and what hh has to be
        added to be exact."""
        cosine = wp.cos(angle)
        length = crimp_length(p, h)
        pull = crimp_tension(length / rest - scalar(1.0), k, scalar(BUCKLING) * b * cosine * cosine)
        stiff = b / rest
        g_p = -wp.sin(angle)
        g_h = scalar(wp.static(ROUND**0.5)) * cosine
        r = crimp_offset(p, h, angle) / rest
        along = pull[2] / rest
        n_p = p / length
        n_h = scalar(wp.static(ROUND)) * h / length
        turned = scalar(wp.static(ROUND)) / (length * length * length)
        bent = wp.max(pull[1], scalar(0.0)) * turned
        pp = stiff * g_p * g_p + along * n_p * n_p + bent * h * h
        ph = stiff * g_p * g_h + along * n_p * n_h - bent * h * p
        hh = stiff * g_h * g_h + along * n_h * n_h + bent * p * p
        ratio = length / rest
        p_rest = -stiff * g_p * r - along * n_p * ratio
        h_rest = -stiff * g_h * r - along * n_h * ratio
        rest_rest = stiff * r * r + along * ratio * ratio
        return pp, ph, hh, p_rest, h_rest, rest_rest, wp.min(pull[1], scalar(0.0)) * turned * p * p

    @wp.func
    def straight_slopes(p: scalar, rest: scalar, k: scalar, angle: scalar) -> vec3:
        """Compute the derivatives of V of a straight segment, by p, h and Δs."""
        by_cosine = scalar(1.0) / wp.cos(angle)
        ratio = p * by_cosine / rest
        return vec3(
            k * (ratio - scalar(1.0)) * by_cosine,
            scalar(0.0),
            scalar(-0.5) * k * (ratio * ratio - scalar(1.0)),
        )

    @wp.func
    def height_slope(
        h: scalar, total: scalar, p: vec4, rest: vec4, parts: vec4, k: vec2, b: vec4, angle: vec2
    ) -> scalar:
        """Compute ∂W/∂h at a height."""
        result = scalar(0.0)
        for side in range(4):
            if parts[side] > scalar(0.0):
                if side < 2:
                    result += parts[side] * crimp_slopes(p[side], h, rest[side], k[0], b[side], angle[0])[1]
                else:
                    result -= parts[side] * crimp_slopes(p[side], total - h, rest[side], k[1], b[side], angle[1])[1]
        return result

    @wp.func
    def solve_height(total: scalar, p: vec4, rest: vec4, parts: vec4, k: vec2, b: vec4, angle: vec2) -> vec2:
        """Find the h that makes W least, and 1/W'' there; (½ total, 0) where no segment depends on it.

        Beyond what a yarn was set to, and beyond h₁ + h₂ of the other, W rises outwards: these are the bounds.
        """
        low = scalar(0.0)
        high = total
        most = scalar(0.0)
        for side in range(4):
            most = wp.max(most, parts[side])
            if parts[side] > scalar(0.0):
                if side < 2:
                    high = wp.max(high, p[side] * wp.tan(angle[0]) * scalar(wp.static(ROUND**-0.5)))
                else:
                    low = wp.min(low, total - p[side] * wp.tan(angle[1]) * scalar(wp.static(ROUND**-0.5)))
        h = scalar(0.5) * total
        if most == scalar(0.0):
            return vec2(h, scalar(0.0))
        by_curvature = scalar(0.0)
        for _step in range(int(MOST_STEPS)):
            slope = height_slope(h, total, p, rest, parts, k, b, angle)
            curvature = scalar(0.0)
            for side in range(4):
                if parts[side] > scalar(0.0):
                    mine = h
                    yarn = side / 2
                    if side > 1:
                        mine = total - h
                    _pp, _ph, hh, _pr, _hr, _rr, less = crimp_curvature(
                        p[side], mine, rest[side], k[yarn], b[side], angle[yarn]
                    )
                    curvature += parts[side] * wp.max(hh + less, scalar(0.1) * hh)
            by_curvature = scalar(1.0) / curvature
            if slope > scalar(0.0):
                high = h
            else:
                low = h
            after = h - slope * by_curvature
            if after <= low or after >= high:
                after = scalar(0.5) * (low + high)
            change = wp.abs(after - h)
            h = after
            if change <= scalar(wp.static(SETTLED[scalar])) * total:
                break
        return vec2(h, by_curvature)

    @wp.func_grad(solve_height)
    def adj_solve_height(total: scalar, p: vec4, rest: vec4, parts: vec4, k: vec2, b: vec4, angle: vec2, adj_ret: vec2):
        """Reverse it: as if it were a number, for crimp_height has the derivative."""
        wp.adjoint[total] += scalar(0.0)

    @wp.func
    def crimp_height(total: scalar, p: vec4, rest: vec4, parts: vec4, k: vec2, b: vec4, angle: vec2) -> scalar:
        """Find h. With the W'' of the solve held, the derivative of this one step is −(∂²W/∂h∂y)/W'' in all y."""
        solved = solve_height(total, p, rest, parts, k, b, angle)
        return solved[0] - solved[1] * height_slope(solved[0], total, p, rest, parts, k, b, angle)

    return SimpleNamespace(
        energy=crimp_energy,
        slopes=crimp_slopes,
        straight=straight_slopes,
        curvature=crimp_curvature,
        height=crimp_height,
    )
