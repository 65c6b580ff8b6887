"""Contact of warp and weft at a crossing (eq. 3).

    F_n = ReLU( ½ n·(Fₛᵘ + F_bᵘ − Fₛᵛ − F_bᵛ) )

n is the unit normal from warp to weft: the normal of the best-fit plane of the crossing and its four neighbours (the
eigenvector of the smallest eigenvalue of their covariance), signed along (x_right − x_left) × (x_down − x_up), and
reversed where the draft puts the other yarn on top. Border nodes have no normal, and so neither crimp nor contact.
Where warp and weft come to run along each other that sign jumps and the plane may be any through their line, so n fades
out over the last of the sine of the angle between them, σ = |n·(a × b)|/(|a||b|) of a = x_right − x_left and
b = x_down − x_up: its length is x³ (10 − 15 x + 6 x²) of x = σ/0.05, and 1 from there on.

Two arrays carry it to shear and friction: ``normal``, and ``contact_load``, the sum inside the ReLU, to which each term
that presses yarns together adds its part as it computes its force.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.indexing import index
from ..core.variant import Variant
from . import mollifier

FADING = 0.05
"""Sine of the angle between warp and weft under which a crossing's normal fades: 3 degrees, far beyond any lock."""

MOST_PASSES = 4
CONVERGED_TURN = {wp.float64: 1e-12, wp.float32: 1e-5}
"""Square of the sine by which a pass of the iteration may still turn a normal, its own error being the cube of that."""


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    scalar, vec3, mat33 = variant.scalar, variant.vec3, variant.mat33

    @wp.func
    def adjugate(m: mat33) -> mat33:
        """Compute the transposed cofactors: det(m) m⁻¹, defined for a singular m too."""
        c0 = vec3(m[0, 0], m[1, 0], m[2, 0])
        c1 = vec3(m[0, 1], m[1, 1], m[2, 1])
        c2 = vec3(m[0, 2], m[1, 2], m[2, 2])
        return wp.matrix_from_rows(wp.cross(c1, c2), wp.cross(c2, c0), wp.cross(c0, c1))

    @wp.func
    def least_eigenvalue(covariance: mat33) -> scalar:
        """Solve the characteristic cubic of a symmetric matrix by cosines."""
        third = scalar(wp.static(1.0 / 3.0))
        mean = wp.trace(covariance) * third
        deviator = covariance - wp.identity(n=3, dtype=scalar) * mean
        spread = wp.sqrt(wp.ddot(deviator, deviator) / scalar(6.0))
        if spread <= scalar(0.0):
            return mean
        cosine = wp.clamp(
            scalar(0.5) * wp.determinant(deviator) / (spread * spread * spread), scalar(-1.0), scalar(1.0)
        )
        angle = wp.acos(cosine) * third + scalar(wp.static(2.0 / 3.0 * wp.PI))
        return mean + scalar(2.0) * spread * wp.cos(angle)

    @wp.func
    def near_normal(c: mat33, guess: vec3) -> vec3:
        """Find the unit eigenvector of the smallest eigenvalue of a matrix of trace 1, from a guess of its direction; 0
        where that does not lead to it.

        Rayleigh quotient iteration converges cubically, though to whichever eigenvector is near: it is the
        smallest eigenvalue's where the gaps to both others are positive, and so their product and sum.
        """
        n = guess
        square = wp.dot(n, n)
        for _repeat in range(int(MOST_PASSES)):
            shift = wp.dot(n, c * n) / square
            m = adjugate(c - wp.identity(n=3, dtype=scalar) * shift)
            last, last_square = n, square
            n = m * last
            square = wp.dot(n, n)
            both, along = square * last_square, wp.dot(n, last)
            if both - along * along < scalar(wp.static(CONVERGED_TURN[scalar])) * both:
                if wp.trace(m) > scalar(0.0) and shift < scalar(wp.static(1.0 / 3.0)):
                    return wp.normalize(n)
                return vec3()
        return vec3()

    @wp.func
    def plane_normal(covariance: mat33, guess: vec3) -> vec3:
        """Find the unit eigenvector of the smallest eigenvalue, of either sign; 0 where the points lie on no plane.

        Where the guess is too far from it: adj(C − λI) is n nᵀ times the other two gaps, so its largest column is the
        eigenvector; a second pass with the Rayleigh quotient of the first takes away what the cosine and the cubic
        lost in digits.
        """
        scale = wp.trace(covariance)
        if scale <= scalar(0.0):
            return vec3()
        c = covariance * (scalar(1.0) / scale)
        near = near_normal(c, guess)
        if wp.dot(near, near) > scalar(0.0):
            return near
        shift = least_eigenvalue(c)
        n = vec3()
        for _repeat in range(2):
            m = adjugate(c - wp.identity(n=3, dtype=scalar) * shift)
            best = vec3(m[0, 0], m[1, 0], m[2, 0])
            for k in range(1, 3):
                column = vec3(m[0, k], m[1, k], m[2, k])
                if wp.dot(column, column) > wp.dot(best, best):
                    best = column
            n = wp.normalize(best)
            shift = wp.dot(n, c * n)
        return n

    @wp.func_grad(plane_normal)
    def adj_plane_normal(covariance: mat33, guess: vec3, adj_ret: vec3):
        """Reverse it: dn = −(C − λI)⁺ dC n. Through the eigenvalues themselves it would be singular at rest, where the
        other two are equal; only their distance to the smallest one matters."""
        scale = wp.trace(covariance)
        n = plane_normal(covariance, guess)
        if wp.dot(n, n) > scalar(0.0):
            c = covariance / scale
            shifted = c - wp.identity(n=3, dtype=scalar) * wp.dot(n, c * n) + wp.outer(n, n)
            tangential = adj_ret - n * wp.dot(n, adj_ret)
            y = wp.inverse(shifted) * tangential / (-scale)
            wp.adjoint[covariance] += (wp.outer(y, n) + wp.outer(n, y)) * scalar(0.5)

    return SimpleNamespace(plane_normal=plane_normal)


def define_normal(variant: Variant) -> wp.Kernel:
    scalar, vec3 = variant.scalar, variant.vec3
    plane_normal = functions(variant).plane_normal
    smoothstep = mollifier.functions(variant).smoothstep

    # a module of its own: drawing a recording needs this kernel alone, and not the minute that all terms compile
    @variant.kernel("contact")
    def contact_normal(
        crossing_node: wp.array(dtype=int),
        crossing_neighbours: wp.array(dtype=wp.vec4i),
        flipped: wp.array(dtype=int),
        position: wp.array(dtype=vec3),
        normal: wp.array(dtype=vec3),
    ):
        e = index(wp.tid())
        i = index(crossing_node[e])
        neighbours = crossing_neighbours[e]
        # Differences to the crossing, not positions: far from the origin their products would lose every digit.
        left = position[index(neighbours[0])] - position[i]
        right = position[index(neighbours[1])] - position[i]
        up = position[index(neighbours[2])] - position[i]
        down = position[index(neighbours[3])] - position[i]
        total = left + right + up + down
        covariance = wp.outer(left, left) + wp.outer(right, right) + wp.outer(up, up) + wp.outer(down, down)
        covariance -= wp.outer(total, total) * scalar(0.2)
        across = right - left
        along = down - up
        outward = wp.cross(across, along)
        n = plane_normal(covariance, outward)
        side = wp.dot(n, outward)
        full = scalar(FADING) * wp.length(across) * wp.length(along)
        if wp.abs(side) <= full:
            x = scalar(0.0)
            if full > scalar(0.0):
                x = wp.abs(side) / full
            n *= smoothstep(x)
        if (side < scalar(0.0)) != (flipped[i] != 0):
            n = -n
        normal[i] = n

    return contact_normal
