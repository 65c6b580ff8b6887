"""Mass and inertia of a yarn segment (eq. 1).

    T = ρ Δs/6 (A·A + A·B + B·B),   A = ẋ_a − w ṡ_a,   B = ẋ_b − w ṡ_b,   w = (x_b − x_a)/Δs

the kinetic energy of material whose velocity ẋ − w ṡ is linear along the segment. Its second derivative in q̇ is the
mass matrix M = ρΔs/6 [[2K, K], [K, 2K]] with K = [[I, −w], [−wᵀ, w·w]], and M q̇ the momentum.

Parameters: ``density`` ρ of each yarn [kg/m].

Three terms stand here: ``mass`` (M and M q̇, always needed), ``inertia`` (∂T/∂q) and ``mass_rate`` (−Ṁ q̇). The last
two vanish where yarns do not slide. Their derivatives are not symmetric, and are left out of the matrix.
"""

import warp as wp

from ..core.indexing import ends, index
from ..core.structs import structs
from ..core.variant import Term, TermParameter, Variant


def define_mass(variant: Variant) -> wp.Kernel:
    scalar, vec3, sliding = variant.scalar, variant.vec3, variant.sliding
    BlockMatrix = structs(variant).BlockMatrix

    @variant.kernel("terms")
    def mass_term(
        # topology
        segments: wp.array(dtype=wp.vec4i),
        # parameters
        density: wp.array(dtype=scalar),
        # state in
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        velocity: wp.array(dtype=vec3),
        euler_velocity: wp.array(dtype=scalar),
        # momentum out
        momentum: wp.array(dtype=vec3),
        euler_momentum: wp.array(dtype=scalar),
        # matrix out
        matrix: int,
        blocks: BlockMatrix,
    ):
        a, b, sa, sb, yarn, direction = ends(segments, index(wp.tid()))
        rest = euler[sb] - euler[sa]
        m = density[yarn] * rest * scalar(wp.static(1.0 / 6.0)) * blocks.coefficients[0][0]
        two = scalar(2.0)
        va = velocity[a]
        vb = velocity[b]
        if wp.static(sliding):
            w = (position[b] - position[a]) / rest
            va -= w * euler_velocity[sa]
            vb -= w * euler_velocity[sb]
            pa = m * (two * va + vb)
            pb = m * (va + two * vb)
            wp.atomic_add(momentum, a, pa)
            wp.atomic_add(momentum, b, pb)
            wp.atomic_add(euler_momentum, sa, -wp.dot(w, pa))
            wp.atomic_add(euler_momentum, sb, -wp.dot(w, pb))
        else:
            wp.atomic_add(momentum, a, m * (two * va + vb))
            wp.atomic_add(momentum, b, m * (va + two * vb))

        if matrix != 0:
            xx = wp.identity(n=3, dtype=scalar) * m
            wp.atomic_add(blocks.diagonal_xx, a, two * xx)
            wp.atomic_add(blocks.diagonal_xx, b, two * xx)
            wp.atomic_add(blocks.upper_xx, index(blocks.stencil * a + direction), xx)
            if wp.static(sliding):
                w = (position[b] - position[a]) / rest
                xs = w * (-m)
                ss = m * wp.dot(w, w)
                wp.atomic_add(blocks.diagonal_xs, sa, two * xs)
                wp.atomic_add(blocks.diagonal_xs, sb, two * xs)
                wp.atomic_add(blocks.diagonal_ss, sa, two * ss)
                wp.atomic_add(blocks.diagonal_ss, sb, two * ss)
                wp.atomic_add(blocks.upper_xs, 4 * a + direction, xs)
                wp.atomic_add(blocks.upper_sx, 4 * a + direction, xs)
                wp.atomic_add(blocks.upper_ss, 4 * a + direction, ss)

    return mass_term


def define_inertia(variant: Variant) -> wp.Kernel:
    scalar, vec3 = variant.scalar, variant.vec3

    @variant.kernel("terms")
    def inertia_term(
        segments: wp.array(dtype=wp.vec4i),
        density: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        velocity: wp.array(dtype=vec3),
        euler_velocity: wp.array(dtype=scalar),
        force: wp.array(dtype=vec3),
        euler_force: wp.array(dtype=scalar),
    ):
        """Add ∂T/∂q."""
        a, b, sa, sb, yarn, _direction = ends(segments, index(wp.tid()))
        rest = euler[sb] - euler[sa]
        w = (position[b] - position[a]) / rest
        va = velocity[a] - w * euler_velocity[sa]
        vb = velocity[b] - w * euler_velocity[sb]
        m = density[yarn] * rest * scalar(wp.static(1.0 / 6.0))
        two = scalar(2.0)
        by_w = ((two * va + vb) * euler_velocity[sa] + (va + two * vb) * euler_velocity[sb]) * (-m)
        by_x = by_w / rest
        by_s = m * (wp.dot(va, va) + wp.dot(va, vb) + wp.dot(vb, vb)) / rest - wp.dot(by_x, w)
        wp.atomic_add(force, b, by_x)
        wp.atomic_add(force, a, -by_x)
        wp.atomic_add(euler_force, sb, by_s)
        wp.atomic_add(euler_force, sa, -by_s)

    return inertia_term


def define_mass_rate(variant: Variant) -> wp.Kernel:
    scalar, vec3 = variant.scalar, variant.vec3

    @variant.kernel("terms")
    def mass_rate_term(
        segments: wp.array(dtype=wp.vec4i),
        density: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        velocity: wp.array(dtype=vec3),
        euler_velocity: wp.array(dtype=scalar),
        force: wp.array(dtype=vec3),
        euler_force: wp.array(dtype=scalar),
    ):
        """Add −Ṁ q̇: minus the rate of the momentum M q̇ when q moves and q̇ is held."""
        a, b, sa, sb, yarn, _direction = ends(segments, index(wp.tid()))
        rest = euler[sb] - euler[sa]
        w = (position[b] - position[a]) / rest
        va = velocity[a] - w * euler_velocity[sa]
        vb = velocity[b] - w * euler_velocity[sb]
        rest_rate = euler_velocity[sb] - euler_velocity[sa]
        w_rate = (velocity[b] - velocity[a] - w * rest_rate) / rest
        va_rate = w_rate * (-euler_velocity[sa])
        vb_rate = w_rate * (-euler_velocity[sb])
        two = scalar(2.0)
        m_rate = density[yarn] * rest_rate * scalar(wp.static(1.0 / 6.0))
        m = density[yarn] * rest * scalar(wp.static(1.0 / 6.0))
        pa = m * (two * va + vb)
        pb = m * (va + two * vb)
        pa_rate = m_rate * (two * va + vb) + m * (two * va_rate + vb_rate)
        pb_rate = m_rate * (va + two * vb) + m * (va_rate + two * vb_rate)
        wp.atomic_add(force, a, -pa_rate)
        wp.atomic_add(force, b, -pb_rate)
        wp.atomic_add(euler_force, sa, wp.dot(w_rate, pa) + wp.dot(w, pa_rate))
        wp.atomic_add(euler_force, sb, wp.dot(w_rate, pb) + wp.dot(w, pb_rate))

    return mass_rate_term


def define_energy(variant: Variant) -> wp.Kernel:
    scalar, vec3, sliding = variant.scalar, variant.vec3, variant.sliding

    @variant.kernel("energy")
    def kinetic_energy(
        segments: wp.array(dtype=wp.vec4i),
        density: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        velocity: wp.array(dtype=vec3),
        euler_velocity: wp.array(dtype=scalar),
        energy: wp.array(dtype=scalar),
    ):
        a, b, sa, sb, yarn, _direction = ends(segments, index(wp.tid()))
        rest = euler[sb] - euler[sa]
        va = velocity[a]
        vb = velocity[b]
        if wp.static(sliding):
            w = (position[b] - position[a]) / rest
            va -= w * euler_velocity[sa]
            vb -= w * euler_velocity[sb]
        m = density[yarn] * rest * scalar(wp.static(1.0 / 6.0))
        wp.atomic_add(energy, 0, m * (wp.dot(va, va) + wp.dot(va, vb) + wp.dot(vb, vb)))

    return kinetic_energy


MASS = Term(
    name="mass",
    elements="segments",
    define=define_mass,
    energy=define_energy,
    parameters=(TermParameter("density", "kg/m", above=0.0, of="yarn"),),
    stencil=2,
    energy_watched_as="energy",
    kept=True,
)
INERTIA = Term(name="inertia", elements="segments", define=define_inertia, sliding_only=True)
MASS_RATE = Term(name="mass_rate", elements="segments", define=define_mass_rate, sliding_only=True)
