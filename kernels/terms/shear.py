"""Shear of warp against weft, at the four corners of every crossing, with its lock (eq. 5).

    V = ½ k L (φ − π/2)²,   φ: the angle between x_p − x and x_r − x (p a warp neighbour, r a weft neighbour)
    k = S π R² (1 + F_n) · lock(φ),   F_n held constant in the derivative by position

    lock(φ) = ½ [(1 + γᶜ) + (1 − γᶜ) tanh( φ̄⁵ (φ − φ_l) / ((φ (φ − φ_l)(φ − φ̄))² + φ̄⁴ σ²) )]
    φ̄ = π/2,  φ_l = 2 arcsin(R/L),  γ = (√2 L − 2 L sin(φ/2))/R,  c = 3,  σ = 0.6

where the corner can jam (its crossing is flipped against both neighbours), and 1 elsewhere. The force is minus the
gradient of the whole energy, dk/dφ included. Beyond the right angle γ is negative, which would turn eq. 5's stiffness
negative near φ = π, so γ is taken as 0 there: γ³ stays twice differentiable. Where a neighbour is nearly at the place
of the crossing, V is between this and the energy at φ = 0 (``mollifier.py``).

Parameters: ``shear`` S [Pa]; ``spacing`` L and ``radius`` R [m].

In a general cloth S is of every crossing, R² half the width of the warp yarn times that of the weft yarn, L of a corner
the mean of those to its two neighbours, and φ_l = arcsin(b_p/L_p) + arcsin(b_r/L_r), b half the mean width of the two
parallel yarns at the crossing and at the neighbour; the L/R of γ is then 1/sin(φ_l/2), as where all are the same.

The matrix is the Gauss-Newton part, (V'/(φ − φ̄)) ∇φ ∇φᵀ, exact at the right angle; V'' in place of its factor where the
lock makes V'' larger, up to four times so; and of a shrinking segment the positive part of the curvature along it.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core import general
from ..core.indexing import index
from ..core.structs import structs
from ..core.variant import Term, TermParameter, Variant
from . import mollifier

OF_CURVATURE = 0.8
"""The part of V'' that the matrix has at least: little enough that V'/(φ − φ̄), which it is in ordinary motion, is more
within 25 degrees of the right angle."""
FLAT = {wp.float64: 1e-12, wp.float32: 1e-5}
"""Sine of an angle that cannot be told from a fold's: what t₁ cos φ − t₂ is there, is rounding."""
WIDE = 0.9
"""Cosine from which on an angle is taken from the sum and the difference of the directions, since an asin would lose
digits: these cost two square roots and an atan2, half as much again."""
LOCK_EXPONENT = 3
LOCK_SMOOTHNESS = 0.6


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    scalar, vec3 = variant.scalar, variant.vec3

    @wp.func
    def shear_lock(
        strain: scalar, sine: scalar, cosine: scalar, threshold: scalar, spacing_by_radius: scalar, second: int
    ) -> vec3:
        """Compute (lock, its first and, where second is not 0, its second derivative by φ) of eq. 5; sine and cosine of
        φ/2.

        ½ (1 − tanh z) = 1/(1 + exp 2z) =: part, of what is locked; z is from −5 to 14 whatever the angle.
        """
        zero = scalar(0.0)
        one = scalar(1.0)
        two = scalar(2.0)
        exponent = scalar(LOCK_EXPONENT)
        right4 = scalar(wp.static((0.5 * wp.PI) ** 4))
        right5 = scalar(wp.static((0.5 * wp.PI) ** 5))
        phi = strain + scalar(wp.static(0.5 * wp.PI))
        gamma = wp.max((scalar(wp.static(2.0**0.5)) - two * sine) * spacing_by_radius, zero)
        gamma_rate = -cosine * spacing_by_radius
        excess = gamma * gamma * gamma - one
        excess_rate = exponent * gamma * gamma * gamma_rate
        a = phi - threshold
        product = phi * a * strain
        product_rate = a * strain + phi * strain + phi * a
        by_below = one / (product * product + right4 * scalar(wp.static(LOCK_SMOOTHNESS**2)))
        below_rate = two * product * product_rate
        part = one / (one + wp.exp(two * right5 * a * by_below))
        z_rate = right5 * by_below * (one - a * below_rate * by_below)
        slope = part * (one - part)
        part_rate = -two * slope * z_rate
        lock = one + excess * part
        rate = excess_rate * part + excess * part_rate
        rate2 = zero
        if second != 0:
            gamma_rate2 = scalar(0.5) * sine * spacing_by_radius
            excess_rate2 = exponent * gamma * (two * gamma_rate * gamma_rate + gamma * gamma_rate2)
            below_rate2 = two * (product_rate * product_rate + product * two * (phi + a + strain))
            z_rate2 = -two * below_rate - a * below_rate2 + two * a * below_rate * below_rate * by_below
            z_rate2 *= right5 * by_below * by_below
            part_rate2 = -two * slope * (z_rate2 - two * (one - two * part) * z_rate * z_rate)
            rate2 = excess_rate2 * part + two * excess_rate * part_rate + excess * part_rate2
        return vec3(lock, rate, rate2)

    @wp.func
    def shear_angle(t1: vec3, t2: vec3) -> vec3:
        """Compute (φ − π/2, sin φ/2, cos φ/2) between two directions, exact to rounding at every angle."""
        half = scalar(0.5)
        across = wp.dot(t1, t2)
        if wp.abs(across) < scalar(WIDE):
            return vec3(
                -wp.asin(across),
                wp.sqrt(half * (scalar(1.0) - across)),
                wp.sqrt(half * (scalar(1.0) + across)),
            )
        sine = half * wp.length(t1 - t2)
        cosine = half * wp.length(t1 + t2)
        return vec3(scalar(2.0) * wp.atan2(sine, cosine) - scalar(wp.static(0.5 * wp.PI)), sine, cosine)

    @wp.func
    def shear_shut(threshold: scalar, spacing_by_radius: scalar) -> scalar:
        """Compute the lock at φ = 0."""
        strain = scalar(wp.static(-0.5 * wp.PI))
        return shear_lock(strain, scalar(0.0), scalar(1.0), threshold, spacing_by_radius, 0)[0]

    @wp.func
    def shear_unlocked(shear: scalar, warp: scalar, weft: scalar, spacing: scalar, load: scalar) -> scalar:
        """Compute k L of a corner that does not jam [N m]; warp and weft: half the widths of the two yarns."""
        pressed = scalar(1.0) + wp.max(load, scalar(0.0))
        return shear * scalar(wp.static(wp.PI)) * warp * weft * pressed * spacing

    @wp.func
    def shear_ratio(threshold: scalar) -> scalar:
        """Compute L/R of a corner that locks at an angle, 1/sin(φ_l/2)."""
        return scalar(1.0) / wp.sin(scalar(0.5) * threshold)

    return SimpleNamespace(
        lock=shear_lock, angle=shear_angle, shut=shear_shut, unlocked=shear_unlocked, ratio=shear_ratio
    )


def define(variant: Variant) -> wp.Kernel:
    scalar, vec3, of_each = variant.scalar, variant.vec3, variant.general
    BlockMatrix = structs(variant).BlockMatrix
    f = functions(variant)
    shear_lock, shear_angle, shear_shut, shear_unlocked = f.lock, f.angle, f.shut, f.unlocked
    shear_ratio, half_width = f.ratio, general.functions(variant).half_width
    presence, inverse_length = mollifier.functions(variant).presence, mollifier.functions(variant).inverse_length

    @wp.func
    def shear_corner(
        t_p: vec3,
        t_r: vec3,
        by_p: scalar,
        by_r: scalar,
        s_p: vec3,
        s_r: vec3,
        k: scalar,
        jams: int,
        threshold: scalar,
        ratio: scalar,
        shut: scalar,
        matrix: int,
    ):
        """Compute (force on p, force on r, ∇φ at p, ∇φ at r, factor of ∇φ ∇φᵀ, and of t tᵀ of p and of r).

        s_p and s_r: (s, s', s'') of the two segments; shut: the lock at φ = 0, where one of them fades.
        """
        angle = shear_angle(t_p, t_r)
        strain = angle[0]
        held = scalar(1.0)
        energy = strain * strain
        curvature = scalar(1.0)
        if jams != 0:
            lock = shear_lock(strain, angle[1], angle[2], threshold, ratio, matrix)
            held = lock[0] + scalar(0.5) * lock[1] * strain
            energy *= lock[0]
            curvature = lock[0] + scalar(2.0) * strain * lock[1] + scalar(0.5) * strain * strain * lock[2]
        # ∇φ; where the corner is folded flat its direction is undefined, and becomes 0
        across = wp.dot(t_p, t_r)
        by_sine = scalar(1.0) / wp.max(scalar(2.0) * angle[1] * angle[2], scalar(wp.static(FLAT[scalar])))
        g_p = (t_p * across - t_r) * (by_sine * by_p)
        g_r = (t_r * across - t_p) * (by_sine * by_r)
        here = k * s_p[0] * s_r[0]
        moment = here * held * strain
        f_p = g_p * (-moment)
        f_r = g_r * (-moment)
        along_p = scalar(0.0)
        along_r = scalar(0.0)
        if s_p[0] * s_r[0] < scalar(1.0):
            largest = scalar(wp.static(0.25 * wp.PI * wp.PI))
            if jams != 0:
                largest *= shut
            gain = scalar(0.5) * k * (energy - largest)
            f_p -= t_p * (gain * s_p[1] * s_r[0])
            f_r -= t_r * (gain * s_r[1] * s_p[0])
            along_p = wp.max(gain * s_p[2] * s_r[0], scalar(0.0))
            along_r = wp.max(gain * s_r[2] * s_p[0], scalar(0.0))
        stiffness = here * wp.max(held, scalar(wp.static(OF_CURVATURE)) * curvature)
        return f_p, f_r, g_p, g_r, stiffness, along_p, along_r

    @variant.kernel("terms")
    def shear_term(
        # topology
        crossing_node: wp.array(dtype=int),
        crossing_neighbours: wp.array(dtype=wp.vec4i),
        corner_jams: wp.array(dtype=wp.vec4i),
        corner_blocks: wp.array(dtype=wp.vec4i),
        # parameters
        shear: wp.array(dtype=scalar),
        radius: wp.array(dtype=scalar),
        spacing: wp.array(dtype=scalar),
        lock_angle: wp.array(dtype=scalar),
        # state in
        position: wp.array(dtype=vec3),
        contact_load: wp.array(dtype=scalar),
        # forces out
        force: wp.array(dtype=vec3),
        # matrix out
        matrix: int,
        blocks: BlockMatrix,
    ):
        e = index(wp.tid())
        c = index(crossing_node[e])
        left = index(crossing_neighbours[e][0])
        right = index(crossing_neighbours[e][1])
        up = index(crossing_neighbours[e][2])
        down = index(crossing_neighbours[e][3])
        jams = corner_jams[e]
        # L of the segments to the four neighbours; of the four corners φ_l, L/R, and k L unlocked
        if wp.static(of_each):
            u_l = spacing[2 * left]
            u_r = spacing[2 * c]
            u_u = spacing[2 * up + 1]
            u_d = spacing[2 * c + 1]
            angle_lu = lock_angle[4 * e]
            angle_ld = lock_angle[4 * e + 1]
            angle_ru = lock_angle[4 * e + 2]
            angle_rd = lock_angle[4 * e + 3]
            ratio_lu = shear_ratio(angle_lu)
            ratio_ld = shear_ratio(angle_ld)
            ratio_ru = shear_ratio(angle_ru)
            ratio_rd = shear_ratio(angle_rd)
            warp_width = half_width(spacing, c, 0)
            weft_width = half_width(spacing, c, 1)
            unlocked = shear_unlocked(shear[c], warp_width, weft_width, scalar(0.5), contact_load[c])
            soft_lu = unlocked * (u_l + u_u)
            soft_ld = unlocked * (u_l + u_d)
            soft_ru = unlocked * (u_r + u_u)
            soft_rd = unlocked * (u_r + u_d)
        else:
            unit = spacing[0]
            u_l, u_r, u_u, u_d = unit, unit, unit, unit
            angle = lock_angle[0]
            angle_lu, angle_ld, angle_ru, angle_rd = angle, angle, angle, angle
            ratio = unit / radius[0]
            ratio_lu, ratio_ld, ratio_ru, ratio_rd = ratio, ratio, ratio, ratio
            soft = shear_unlocked(shear[0], radius[0], radius[0], unit, contact_load[c])
            soft_lu, soft_ld, soft_ru, soft_rd = soft, soft, soft, soft
        x = position[c]
        e_l = position[left] - x
        e_r = position[right] - x
        e_u = position[up] - x
        e_d = position[down] - x
        l_l = wp.length(e_l)
        l_r = wp.length(e_r)
        l_u = wp.length(e_u)
        l_d = wp.length(e_d)
        b_l = inverse_length(l_l, u_l)
        b_r = inverse_length(l_r, u_r)
        b_u = inverse_length(l_u, u_u)
        b_d = inverse_length(l_d, u_d)
        t_l = e_l * b_l
        t_r = e_r * b_r
        t_u = e_u * b_u
        t_d = e_d * b_d
        s_l = presence(l_l, u_l)
        s_r = presence(l_r, u_r)
        s_u = presence(l_u, u_u)
        s_d = presence(l_d, u_d)
        shut_lu = scalar(1.0)
        shut_ld, shut_ru, shut_rd = shut_lu, shut_lu, shut_lu
        if s_l[0] * s_r[0] * s_u[0] * s_d[0] < scalar(1.0):
            shut_lu = shear_shut(angle_lu, ratio_lu)
            if wp.static(of_each):
                shut_ld = shear_shut(angle_ld, ratio_ld)
                shut_ru = shear_shut(angle_ru, ratio_ru)
                shut_rd = shear_shut(angle_rd, ratio_rd)
            else:
                shut_ld, shut_ru, shut_rd = shut_lu, shut_lu, shut_lu
        f_lu, f_ul, g_lu, g_ul, k_lu, a_lu, a_ul = shear_corner(
            t_l, t_u, b_l, b_u, s_l, s_u, soft_lu, jams[0], angle_lu, ratio_lu, shut_lu, matrix
        )
        f_ld, f_dl, g_ld, g_dl, k_ld, a_ld, a_dl = shear_corner(
            t_l, t_d, b_l, b_d, s_l, s_d, soft_ld, jams[1], angle_ld, ratio_ld, shut_ld, matrix
        )
        f_ru, f_ur, g_ru, g_ur, k_ru, a_ru, a_ur = shear_corner(
            t_r, t_u, b_r, b_u, s_r, s_u, soft_ru, jams[2], angle_ru, ratio_ru, shut_ru, matrix
        )
        f_rd, f_dr, g_rd, g_dr, k_rd, a_rd, a_dr = shear_corner(
            t_r, t_d, b_r, b_d, s_r, s_d, soft_rd, jams[3], angle_rd, ratio_rd, shut_rd, matrix
        )
        f_l = f_lu + f_ld
        f_r = f_ru + f_rd
        f_u = f_ul + f_ur
        f_d = f_dl + f_dr
        wp.atomic_add(force, left, f_l)
        wp.atomic_add(force, right, f_r)
        wp.atomic_add(force, up, f_u)
        wp.atomic_add(force, down, f_d)
        wp.atomic_add(force, c, -(f_l + f_r + f_u + f_d))

        if matrix != 0:
            # between two neighbours of the crossing, and of each with itself
            h = blocks.coefficients[0][2]
            ul = wp.outer(g_ul, g_lu) * (h * k_lu)
            dl = wp.outer(g_dl, g_ld) * (h * k_ld)
            ur = wp.outer(g_ur, g_ru) * (h * k_ru)
            dr = wp.outer(g_dr, g_rd) * (h * k_rd)
            ll = (wp.outer(g_lu, g_lu) * k_lu + wp.outer(g_ld, g_ld) * k_ld + wp.outer(t_l, t_l) * (a_lu + a_ld)) * h
            rr = (wp.outer(g_ru, g_ru) * k_ru + wp.outer(g_rd, g_rd) * k_rd + wp.outer(t_r, t_r) * (a_ru + a_rd)) * h
            uu = (wp.outer(g_ul, g_ul) * k_lu + wp.outer(g_ur, g_ur) * k_ru + wp.outer(t_u, t_u) * (a_ul + a_ur)) * h
            dd = (wp.outer(g_dl, g_dl) * k_ld + wp.outer(g_dr, g_dr) * k_rd + wp.outer(t_d, t_d) * (a_dl + a_dr)) * h
            # the rows of a crossing and its neighbours add up to 0, for nothing depends on where they are together
            lc = -(ll + wp.transpose(ul + dl))
            rc = -(rr + wp.transpose(ur + dr))
            uc = -(uu + ul + ur)
            dc = -(dd + dl + dr)
            wp.atomic_add(blocks.diagonal_xx, left, ll)
            wp.atomic_add(blocks.diagonal_xx, right, rr)
            wp.atomic_add(blocks.diagonal_xx, up, uu)
            wp.atomic_add(blocks.diagonal_xx, down, dd)
            wp.atomic_add(blocks.diagonal_xx, c, -(lc + rc + uc + dc))
            wp.atomic_add(blocks.upper_xx, index(blocks.stencil * left), lc)
            wp.atomic_add(blocks.upper_xx, index(blocks.stencil * c), wp.transpose(rc))
            wp.atomic_add(blocks.upper_xx, index(blocks.stencil * up + 1), uc)
            wp.atomic_add(blocks.upper_xx, index(blocks.stencil * c + 1), wp.transpose(dc))
            slots = corner_blocks[e]
            wp.atomic_add(blocks.upper_xx, index(slots[0]), ul)
            wp.atomic_add(blocks.upper_xx, index(slots[1]), wp.transpose(dl))
            wp.atomic_add(blocks.upper_xx, index(slots[2]), ur)
            wp.atomic_add(blocks.upper_xx, index(slots[3]), wp.transpose(dr))

    return shear_term


def define_energy(variant: Variant) -> wp.Kernel:
    scalar, vec3, of_each = variant.scalar, variant.vec3, variant.general
    f = functions(variant)
    shear_lock, shear_angle, shear_shut, shear_unlocked = f.lock, f.angle, f.shut, f.unlocked
    shear_ratio, own = f.ratio, general.functions(variant).own
    presence = mollifier.functions(variant).presence

    @variant.kernel("energy")
    def shear_energy(
        crossing_node: wp.array(dtype=int),
        crossing_neighbours: wp.array(dtype=wp.vec4i),
        corner_jams: wp.array(dtype=wp.vec4i),
        shear: wp.array(dtype=scalar),
        radius: wp.array(dtype=scalar),
        spacing: wp.array(dtype=scalar),
        lock_angle: wp.array(dtype=scalar),
        node_yarns: wp.array(dtype=int),
        position: wp.array(dtype=vec3),
        contact_load: wp.array(dtype=scalar),
        energy: wp.array(dtype=scalar),
    ):
        e = wp.tid()
        c = crossing_node[e]
        warp_width = radius[0]
        weft_width = radius[0]
        if wp.static(of_each):
            warp_width = radius[2 * node_yarns[2 * c]]
            weft_width = radius[2 * node_yarns[2 * c + 1]]
        for corner in range(4):
            p = crossing_neighbours[e][corner / 2]
            r = crossing_neighbours[e][2 + corner % 2]
            # the lower node of a segment has its L
            unit1 = spacing[own(2 * wp.min(p, c))]
            unit2 = spacing[own(2 * wp.min(r, c) + 1)]
            lock_at = lock_angle[own(4 * e + corner)]
            ratio = unit1 / warp_width
            if wp.static(of_each):
                ratio = shear_ratio(lock_at)
            unit = scalar(0.5) * (unit1 + unit2)
            k = shear_unlocked(shear[own(c)], warp_width, weft_width, unit, contact_load[c])
            e1 = position[p] - position[c]
            e2 = position[r] - position[c]
            fading = presence(wp.length(e1), unit1)[0] * presence(wp.length(e2), unit2)[0]
            angle = shear_angle(wp.normalize(e1), wp.normalize(e2))
            now = angle[0] * angle[0]
            largest = scalar(wp.static(0.25 * wp.PI * wp.PI))
            if corner_jams[e][corner] != 0:
                now *= shear_lock(angle[0], angle[1], angle[2], lock_at, ratio, 0)[0]
                largest *= shear_shut(lock_at, ratio)
            wp.atomic_add(energy, 0, scalar(0.5) * k * (now * fading + largest * (scalar(1.0) - fading)))

    return shear_energy


TERM = Term(
    name="shear",
    elements="crossings",
    define=define,
    energy=define_energy,
    parameters=(TermParameter("shear", "Pa", least=0.0, of="crossing"),),
    stencil=6,
    needs_contact=True,
)
