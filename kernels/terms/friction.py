"""Friction of warp against weft along each of the two yarns of a crossing (eq. 4).

    F = −[½ (k_f δ − K(δ) μF_n) K(μF_n − |F_s|) + ½ (k_f δ + K(δ) μF_n)] − d_f ṡ,   K(z) = tanh(p z),   δ = s − s̄

s̄ is the anchor, F_s the force on s of everything except friction. Stuck, K of the second argument is 1 and the force
is the spring −k_f δ; sliding, it is −1 and the force is −μF_n sign δ. Sticking holds the anchor and sliding drags it
along, so that k_f |δ| never exceeds μF_n.

A single p for a length (~1e-6 m) and a force (~1e-4 N) makes both tanh arguments ≪ 1: with the published p = 10 the law
neither sticks nor slips. So both are made dimensionless, δ by μF_n/k_f and forces by μF_n, with a floor under μF_n for
slack crossings. And the spring ends at μF_n within the step already, not when the anchor is dragged after it: a yarn
that a step moves by many times μF_n/k_f would else be held by more than μF_n, the more the longer the step.
``published_scaling`` takes eq. 4 as published, arguments in SI units.

Parameters: ``friction`` μ; ``friction_stiffness`` k_f [N/m]; ``friction_damping`` d_f [N s/m];
``friction_sharpness`` p. In a general cloth all but p are of every crossing, and the floor's spacing is that to the
next crossing of the warp yarn.

The matrix holds −∂F/∂δ (never negative) and d_f. What F depends on through F_n and F_s is not symmetric, and left out.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core import general
from ..core.indexing import index
from ..core.structs import structs
from ..core.variant import Term, TermParameter, Variant

FLOOR = 1.0e-7
"""Displacement, in spacings, whose spring force is the floor under μF_n: 1e-10 m for the paper's cloth,
whose yarns slide by some 1e-6 m."""


SOFTNESS = 0.1
"""The spring gives way from this part under μF_n to as much beyond, by a parabola, so that the force has a derivative
at the limit too."""

CYCLING = 4
"""Evaluations in a stage after which every second matrix has the force over δ, if that is more: sliding either way the
force does not change with δ, so that Newton's iteration goes to and fro between the two. (Always, it would creep.)"""


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    scalar = variant.scalar
    vec2 = wp.types.vector(2, scalar)

    @wp.func
    def switch(z: scalar) -> scalar:
        """Compute tanh z to rounding of 1, at half the cost; from 20 on it is 1."""
        return scalar(1.0) - scalar(2.0) / (scalar(1.0) + wp.exp(scalar(2.0) * wp.min(z, scalar(20.0))))

    @wp.func
    def friction_force(
        delta: scalar,
        others: scalar,
        limit: scalar,
        stiffness: scalar,
        sharpness: scalar,
        floor: scalar,
        published_scaling: int,
    ) -> vec2:
        """Compute (F without its damping, −∂F/∂δ); limit = μF_n."""
        by_force = sharpness
        by_length = sharpness
        if published_scaling == 0:
            scale = limit + floor
            by_force = sharpness / scale
            by_length = sharpness * stiffness / scale
        sign = switch(by_length * delta)
        stuck = switch(by_force * (limit - wp.abs(others)))
        spring = stiffness * delta
        spring_slope = stiffness
        if published_scaling == 0:
            soft = scalar(wp.static(SOFTNESS)) * limit
            if wp.abs(spring) > limit - soft:
                held = limit
                spring_slope = scalar(0.0)
                left = limit + soft - wp.abs(spring)
                if left > scalar(0.0):
                    held -= scalar(0.25) * left * left / soft
                    spring_slope = stiffness * scalar(0.5) * left / soft
                spring = wp.sign(delta) * held
        half = scalar(0.5)
        one = scalar(1.0)
        f = -half * ((spring - sign * limit) * stuck + spring + sign * limit)
        slope = half * spring_slope * (one + stuck) + half * (one - stuck) * limit * by_length * (one - sign * sign)
        return vec2(f, slope)

    return SimpleNamespace(force=friction_force)


def define(variant: Variant) -> wp.Kernel:
    scalar = variant.scalar
    BlockMatrix = structs(variant).BlockMatrix
    friction_force = functions(variant).force
    own = general.functions(variant).own

    @variant.kernel("terms")
    def friction_term(
        # topology
        crossing_node: wp.array(dtype=int),
        # parameters
        friction: wp.array(dtype=scalar),
        friction_stiffness: wp.array(dtype=scalar),
        friction_damping: wp.array(dtype=scalar),
        friction_sharpness: wp.array(dtype=scalar),
        spacing: wp.array(dtype=scalar),
        published_scaling: int,
        # state in
        euler: wp.array(dtype=scalar),
        euler_velocity: wp.array(dtype=scalar),
        anchor: wp.array(dtype=scalar),
        contact_load: wp.array(dtype=scalar),
        euler_force: wp.array(dtype=scalar),
        # forces and momentum out
        friction_force_out: wp.array(dtype=scalar),
        euler_momentum: wp.array(dtype=scalar),
        # matrix out
        matrix: int,
        blocks: BlockMatrix,
    ):
        e = index(wp.tid())
        i = index(crossing_node[e])
        limit = friction[own(i)] * wp.max(contact_load[i], scalar(0.0))
        floor = friction_stiffness[own(i)] * spacing[own(2 * i)] * scalar(wp.static(FLOOR))
        for direction in range(2):
            s = 2 * i + direction
            f = friction_force(
                euler[s] - anchor[s],
                euler_force[s],
                limit,
                friction_stiffness[own(i)],
                friction_sharpness[0],
                floor,
                published_scaling,
            )
            friction_force_out[s] = f[0] - friction_damping[own(i)] * euler_velocity[s]
            if matrix != 0:
                damping = blocks.coefficients[0][1] * friction_damping[own(i)]
                wp.atomic_add(euler_momentum, s, damping * euler_velocity[s])
                slope = f[1]
                if blocks.evaluations[0] > wp.static(CYCLING) and blocks.evaluations[0] % 2 == 0:
                    delta = wp.abs(euler[s] - anchor[s])
                    slope = wp.max(slope, wp.abs(f[0]) / wp.max(delta, floor / friction_stiffness[own(i)]))
                wp.atomic_add(blocks.diagonal_ss, s, damping + blocks.coefficients[0][2] * slope)

    return friction_term


def define_anchor(variant: Variant) -> wp.Kernel:
    scalar = variant.scalar
    own = general.functions(variant).own

    @variant.kernel("terms")
    def update_anchor(
        crossing_node: wp.array(dtype=int),
        friction: wp.array(dtype=scalar),
        friction_stiffness: wp.array(dtype=scalar),
        contact_load: wp.array(dtype=scalar),
        euler_next: wp.array(dtype=scalar),
        anchor: wp.array(dtype=scalar),
        anchor_next: wp.array(dtype=scalar),
    ):
        """Move s̄ to where it is after the step: held while k_f |δ| ≤ μF_n, dragged along beyond."""
        e = index(wp.tid())
        i = index(crossing_node[e])
        reach = friction[own(i)] * wp.max(contact_load[i], scalar(0.0)) / friction_stiffness[own(i)]
        for direction in range(2):
            s = 2 * i + direction
            delta = euler_next[s] - anchor[s]
            anchor_next[s] = euler_next[s] - wp.clamp(delta, -reach, reach)

    return update_anchor


def define_energy(variant: Variant) -> wp.Kernel:
    scalar = variant.scalar
    own = general.functions(variant).own

    @variant.kernel("energy")
    def friction_energy(
        crossing_node: wp.array(dtype=int),
        friction: wp.array(dtype=scalar),
        friction_stiffness: wp.array(dtype=scalar),
        euler: wp.array(dtype=scalar),
        anchor: wp.array(dtype=scalar),
        contact_load: wp.array(dtype=scalar),
        energy: wp.array(dtype=scalar),
    ):
        """Add up what friction's springs can give back: the work of their force, at most μF_n, on the way to the
        anchor."""
        i = crossing_node[wp.tid()]
        limit = friction[own(i)] * wp.max(contact_load[i], scalar(0.0))
        for direction in range(2):
            delta = wp.abs(euler[2 * i + direction] - anchor[2 * i + direction])
            spring = wp.min(delta, limit / friction_stiffness[own(i)])
            stored = scalar(0.5) * friction_stiffness[own(i)] * spring * spring + limit * (delta - spring)
            wp.atomic_add(energy, 0, stored)

    return friction_energy


TERM = Term(
    name="friction",
    elements="crossings",
    define=define,
    energy=define_energy,
    parameters=(
        TermParameter("friction", "", least=0.0, of="crossing"),
        TermParameter("friction_stiffness", "N/m", above=0.0, of="crossing"),
        TermParameter("friction_damping", "N s/m", least=0.0, of="crossing"),
        TermParameter("friction_sharpness", "", above=0.0),
    ),
    needs_contact=True,
    sliding_only=True,
    reads_forces=True,
)
