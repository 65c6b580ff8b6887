"""Distance φ to an obstacle and its gradient, in the obstacle's own frame.

    plane z = 0            φ = z
    sphere r               φ = |x| − r
    capsule, along z       φ = |x − z-axis within ±l| − r
    cylinder, along z      φ = |max((ρ − r, |z| − l), 0)|, ρ² = x² + y²
    box, half extents h    φ = |max(|x| − h, 0)|
    triangle               φ = |x − its closest point|, on both sides

All are convex, so φ is a convex function, by which ``limits.py`` finds where a line first comes near.
Cloth stays outside of φ = D > 0, where edges are round and the gradient has no jump; inside, φ of cylinder and box is
that of the nearest face, as a place to complain of.

Parameters: ``obstacle_size`` of each obstacle, 3 numbers [m]: r; l and r; l and r; h.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.variant import Variant

PLANE, SPHERE, CAPSULE, CYLINDER, BOX, MESH = 0, 1, 2, 3, 4, 5
"""``obstacle_shape``."""


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    scalar, vec3 = variant.scalar, variant.vec3
    vec4 = variant.vec4

    @wp.func
    def closest_on_triangle(x: vec3, a: vec3, b: vec3, c: vec3) -> vec3:
        """Find the point of a triangle that is closest to x, by the region of its plane that x is over."""
        zero = scalar(0.0)
        ab = b - a
        ac = c - a
        ap = x - a
        d1 = wp.dot(ab, ap)
        d2 = wp.dot(ac, ap)
        if d1 <= zero and d2 <= zero:
            return a
        bp = x - b
        d3 = wp.dot(ab, bp)
        d4 = wp.dot(ac, bp)
        if d3 >= zero and d4 <= d3:
            return b
        vc = d1 * d4 - d3 * d2
        if vc <= zero and d1 >= zero and d3 <= zero:
            return a + ab * (d1 / (d1 - d3))
        cp = x - c
        d5 = wp.dot(ab, cp)
        d6 = wp.dot(ac, cp)
        if d6 >= zero and d5 <= d6:
            return c
        vb = d5 * d2 - d1 * d6
        if vb <= zero and d2 >= zero and d6 <= zero:
            return a + ac * (d2 / (d2 - d6))
        va = d3 * d6 - d5 * d4
        if va <= zero and d4 - d3 >= zero and d5 - d6 >= zero:
            return b + (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)))
        return a + ab * (vb / (va + vb + vc)) + ac * (vc / (va + vb + vc))

    @wp.func
    def outside(from_core: vec3, margin: scalar) -> vec4:
        """Compute φ of what is round by so much about a core, and its gradient, away from the core."""
        length = wp.length(from_core)
        n = wp.normalize(from_core)
        return vec4(n[0], n[1], n[2], length - margin)

    @wp.func
    def distance(shape: int, size: vec3, x: vec3) -> vec4:
        """Compute (∇φ, φ) at x. A mesh is infinitely far away: its triangles are looked at one by one."""
        zero = scalar(0.0)
        one = scalar(1.0)
        if shape == wp.static(PLANE):
            return vec4(zero, zero, one, x[2])
        if shape == wp.static(SPHERE):
            return outside(x, size[0])
        if shape == wp.static(CAPSULE):
            return outside(vec3(x[0], x[1], x[2] - wp.clamp(x[2], -size[0], size[0])), size[1])
        if shape == wp.static(MESH):
            return vec4(zero, zero, one, scalar(wp.static(float("inf"))))
        if shape == wp.static(CYLINDER):
            rho = wp.sqrt(x[0] * x[0] + x[1] * x[1])
            side = rho - size[1]
            end = wp.abs(x[2]) - size[0]
            up = wp.sign(x[2])
            if side <= zero or end <= zero:
                # over a face
                if side > end:
                    return vec4(x[0] / rho, x[1] / rho, zero, side)
                return vec4(zero, zero, up, end)
            beyond = side / rho
            return outside(vec3(x[0] * beyond, x[1] * beyond, end * up), zero)
        by = vec3(wp.abs(x[0]) - size[0], wp.abs(x[1]) - size[1], wp.abs(x[2]) - size[2])
        most = wp.max(by[0], wp.max(by[1], by[2]))
        if most > zero:
            return outside(
                vec3(
                    wp.max(by[0], zero) * wp.sign(x[0]),
                    wp.max(by[1], zero) * wp.sign(x[1]),
                    wp.max(by[2], zero) * wp.sign(x[2]),
                ),
                zero,
            )
        if by[0] == most:
            return vec4(wp.sign(x[0]), zero, zero, most)
        if by[1] == most:
            return vec4(zero, wp.sign(x[1]), zero, most)
        return vec4(zero, zero, wp.sign(x[2]), most)

    return SimpleNamespace(closest_on_triangle=closest_on_triangle, distance=distance)
