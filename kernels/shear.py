"""Shear of warp against weft, at the four corners of every crossing, with its lock (eq. 5).

    V = ½ k L (φ − π/2)²,   φ: the angle between x_p − x and x_r − x (p a warp neighbour, r a weft neighbour)
    k = S π R² (1 + F_n) · lock(φ),   F_n held constant in the derivative by position

    lock(φ) = ½ [(1 + γᶜ) + (1 − γᶜ) tanh( φ̄⁵ (φ − φ_l) / ((φ (φ − φ_l)(φ − φ̄))² + φ̄⁴ σ²) )]
    φ̄ = π/2,  φ_l = 2 arcsin(R/L),  γ = (√2 L − 2 L sin(φ/2))/R,  c = 3,  σ = 0.6

where the corner can jam (its crossing is flipped against both neighbours), and 1 elsewhere. The force is minus the
gradient of the whole energy, dk/dφ included. Beyond the right angle γ is negative, which would turn eq. 5's stiffness
negative near φ = π, so γ is taken as 0 there: γ³ stays twice differentiable. Where a neighbour is nearly at the place
of the crossing, V is between this and the energy at φ = 0 (``vanishing.py``).

Parameters: ``shear`` S [Pa]; ``spacing`` L and ``radius`` R [m].

The matrix is the Gauss-Newton part, (V'/(φ − φ̄)) ∇φ ∇φᵀ, exact at the right angle; V'' in place of its factor where the
lock makes V'' larger, up to four times so; and of a shrinking segment the positive part of the curvature along it.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import vanishing
from .variant import Term, Variant

OF_CURVATURE = 0.8
"""The part of V'' that the matrix has at least: little enough that V'/(φ − φ̄), which it is in ordinary motion, is more
within 25 degrees of the right angle."""
LOCK_EXPONENT = 3
LOCK_SMOOTHNESS = 0.6


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    scalar, vec3 = variant.scalar, variant.vec3

    @wp.func
    def shear_lock(phi: scalar, radius: scalar, spacing: scalar) -> vec3:
        """(lock, its first and second derivative by φ) of eq. 5."""
        one = scalar(1.0)
        right = scalar(wp.static(0.5 * wp.PI))
        sigma = scalar(LOCK_SMOOTHNESS)
        threshold = scalar(2.0) * wp.asin(radius / spacing)
        half = scalar(0.5) * phi
        sine = wp.sin(half)
        gamma = wp.max((wp.sqrt(scalar(2.0)) - scalar(2.0) * sine) * spacing / radius, scalar(0.0))
        gamma_rate = -wp.cos(half) * spacing / radius
        gamma_rate2 = scalar(0.5) * sine * spacing / radius
        two = scalar(2.0)
        boost = gamma * gamma * gamma
        boost_rate = scalar(LOCK_EXPONENT) * gamma * gamma * gamma_rate
        boost_rate2 = scalar(LOCK_EXPONENT) * gamma * (two * gamma_rate * gamma_rate + gamma * gamma_rate2)
        a = phi - threshold
        b = phi - right
        product = phi * a * b
        product_rate = a * b + phi * b + phi * a
        product_rate2 = two * (phi + a + b)
        right2 = right * right
        right4 = right2 * right2
        below = product * product + right4 * sigma * sigma
        below_rate = two * product * product_rate
        below_rate2 = two * (product_rate * product_rate + product * product_rate2)
        z = right4 * right * a / below
        z_rate = right4 * right * (below - a * below_rate) / (below * below)
        z_rate2 = right4 * right * (-two * below_rate - a * below_rate2 + two * a * below_rate * below_rate / below)
        z_rate2 /= below * below
        s = wp.tanh(z)
        lock = scalar(0.5) * ((one + boost) + (one - boost) * s)
        s_rate = (one - s * s) * z_rate
        s_rate2 = (one - s * s) * (z_rate2 - two * s * z_rate * z_rate)
        rate = scalar(0.5) * (boost_rate * (one - s) + (one - boost) * s_rate)
        rate2 = scalar(0.5) * (boost_rate2 * (one - s) - two * boost_rate * s_rate + (one - boost) * s_rate2)
        return vec3(lock, rate, rate2)

    @wp.func
    def shear_angle(e1: vec3, e2: vec3) -> scalar:
        return wp.atan2(wp.length(wp.cross(e1, e2)), wp.dot(e1, e2))

    return SimpleNamespace(lock=shear_lock, angle=shear_angle)


def define(variant: Variant) -> wp.Kernel:
    scalar, vec3, mat33 = variant.scalar, variant.vec3, variant.mat33
    shear_lock, shear_angle = functions(variant).lock, functions(variant).angle
    presence, inverse_length = vanishing.functions(variant).presence, vanishing.functions(variant).inverse_length

    @variant.kernel("terms")
    def shear_term(
        # topology
        corner_nodes: wp.array(dtype=wp.vec3i),
        corner_jams: wp.array(dtype=int),
        corner_blocks: wp.array(dtype=wp.vec3i),
        # parameters
        shear: wp.array(dtype=scalar),
        radius: wp.array(dtype=scalar),
        spacing: wp.array(dtype=scalar),
        # state in
        position: wp.array(dtype=vec3),
        contact_load: wp.array(dtype=scalar),
        # forces out
        force: wp.array(dtype=vec3),
        # matrix out
        matrix: int,
        weights: wp.array(dtype=vec3),
        diagonal_xx: wp.array(dtype=mat33),
        upper_xx: wp.array(dtype=mat33),
    ):
        e = wp.tid()
        p = corner_nodes[e][0]
        c = corner_nodes[e][1]
        r = corner_nodes[e][2]
        e1 = position[p] - position[c]
        e2 = position[r] - position[c]
        t1 = wp.normalize(e1)
        t2 = wp.normalize(e2)
        phi = shear_angle(e1, e2)
        strain = phi - scalar(wp.static(0.5 * wp.PI))
        pressed = scalar(1.0) + wp.max(contact_load[c], scalar(0.0))
        k = shear[0] * scalar(wp.static(wp.PI)) * radius[0] * radius[0] * pressed * spacing[0]
        s_p = presence(wp.length(e1), spacing[0])
        s_r = presence(wp.length(e2), spacing[0])
        gain = scalar(0.0)
        if s_p[0] * s_r[0] < scalar(1.0):
            now = strain * strain
            shut = scalar(wp.static(0.25 * wp.PI * wp.PI))
            if corner_jams[e] != 0:
                now *= shear_lock(phi, radius[0], spacing[0])[0]
                shut *= shear_lock(scalar(0.0), radius[0], spacing[0])[0]
            gain = scalar(0.5) * k * (now - shut)
        curvature = k
        if corner_jams[e] != 0:
            lock = shear_lock(phi, radius[0], spacing[0])
            curvature *= lock[0] + scalar(2.0) * strain * lock[1] + scalar(0.5) * strain * strain * lock[2]
            k *= lock[0] + scalar(0.5) * lock[1] * strain
        # ∇φ; where the corner is folded flat its direction is undefined, and normalize gives 0
        across = wp.dot(t1, t2)
        g_p = wp.normalize(t1 * across - t2) * inverse_length(wp.length(e1), spacing[0])
        g_r = wp.normalize(t2 * across - t1) * inverse_length(wp.length(e2), spacing[0])
        g_c = -(g_p + g_r)
        k *= s_p[0] * s_r[0]
        curvature *= s_p[0] * s_r[0]
        moment = k * strain
        f_p = g_p * moment + t1 * (gain * s_p[1] * s_r[0])
        f_r = g_r * moment + t2 * (gain * s_r[1] * s_p[0])
        wp.atomic_add(force, p, -f_p)
        wp.atomic_add(force, r, -f_r)
        wp.atomic_add(force, c, f_p + f_r)

        if matrix != 0:
            stiffness = weights[0][2] * wp.max(k, scalar(wp.static(OF_CURVATURE)) * curvature)
            wp.atomic_add(diagonal_xx, p, wp.outer(g_p, g_p) * stiffness)
            wp.atomic_add(diagonal_xx, r, wp.outer(g_r, g_r) * stiffness)
            wp.atomic_add(diagonal_xx, c, wp.outer(g_c, g_c) * stiffness)
            # a block stands in the row of its lower node
            blocks = corner_blocks[e]
            g_c *= stiffness
            if p < c:
                wp.atomic_add(upper_xx, blocks[0], wp.outer(g_p, g_c))
            else:
                wp.atomic_add(upper_xx, blocks[0], wp.outer(g_c, g_p))
            if r < c:
                wp.atomic_add(upper_xx, blocks[1], wp.outer(g_r, g_c))
            else:
                wp.atomic_add(upper_xx, blocks[1], wp.outer(g_c, g_r))
            if p < r:
                wp.atomic_add(upper_xx, blocks[2], wp.outer(g_p, g_r) * stiffness)
            else:
                wp.atomic_add(upper_xx, blocks[2], wp.outer(g_r, g_p) * stiffness)
            if s_p[2] < scalar(0.0):
                along = wp.outer(t1, t1) * (weights[0][2] * gain * s_p[2] * s_r[0])
                wp.atomic_add(diagonal_xx, p, along)
                wp.atomic_add(diagonal_xx, c, along)
                wp.atomic_add(upper_xx, blocks[0], -along)
            if s_r[2] < scalar(0.0):
                along = wp.outer(t2, t2) * (weights[0][2] * gain * s_r[2] * s_p[0])
                wp.atomic_add(diagonal_xx, r, along)
                wp.atomic_add(diagonal_xx, c, along)
                wp.atomic_add(upper_xx, blocks[1], -along)

    return shear_term


def define_energy(variant: Variant) -> wp.Kernel:
    scalar, vec3 = variant.scalar, variant.vec3
    shear_lock, shear_angle = functions(variant).lock, functions(variant).angle
    presence = vanishing.functions(variant).presence

    @variant.kernel("energy")
    def shear_energy(
        corner_nodes: wp.array(dtype=wp.vec3i),
        corner_jams: wp.array(dtype=int),
        shear: wp.array(dtype=scalar),
        radius: wp.array(dtype=scalar),
        spacing: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        contact_load: wp.array(dtype=scalar),
        energy: wp.array(dtype=scalar),
    ):
        e = wp.tid()
        c = corner_nodes[e][1]
        e1 = position[corner_nodes[e][0]] - position[c]
        e2 = position[corner_nodes[e][2]] - position[c]
        fading = presence(wp.length(e1), spacing[0])[0] * presence(wp.length(e2), spacing[0])[0]
        phi = shear_angle(e1, e2)
        strain = phi - scalar(wp.static(0.5 * wp.PI))
        pressed = scalar(1.0) + wp.max(contact_load[c], scalar(0.0))
        k = shear[0] * scalar(wp.static(wp.PI)) * radius[0] * radius[0] * pressed * spacing[0]
        largest = k * scalar(wp.static(0.25 * wp.PI * wp.PI))
        if corner_jams[e] != 0:
            k *= shear_lock(phi, radius[0], spacing[0])[0]
            largest *= shear_lock(scalar(0.0), radius[0], spacing[0])[0]
        faded = k * strain * strain * fading + largest * (scalar(1.0) - fading)
        wp.atomic_add(energy, 0, scalar(0.5) * faded)

    return shear_energy


TERM = Term(name="shear", elements="corners", define=define, energy=define_energy, stencil=6, needs_contact=True)
