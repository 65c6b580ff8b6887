"""Implicit stages around Newton's iteration (``nonlinear``): the state at w, and what carries one stage to the next.

    r(w) = η F(q, w) + M(q) (v₀ − w) = 0,   q = q₀ + η w

w is the velocity at which momentum is conserved at the state that w itself leads to. Every implicit method here is made
of such stages, and of q₀ + t w and v₀ + k (w − v₀) that carry one to the next or to the end of a step
(``warp_yarn/integrators``). The adjoint of a stage that has converged is (−∂r/∂w)ᵀ λ = w̄, with the exact derivative
(``stage_adjoint.py``).
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.indexing import ends, index
from ..core.memory import functions as access
from ..core.variant import Variant


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, vec3, sliding = variant.scalar, variant.vec3, variant.sliding
    load = access(variant).load
    module = variant.module("stage")

    @wp.kernel(module=module, enable_backward=False)
    def enter_stage(
        stage_size: wp.array(dtype=scalar),
        base_position: wp.array(dtype=vec3),
        base_euler: wp.array(dtype=scalar),
        base_velocity: wp.array(dtype=vec3),
        base_euler_velocity: wp.array(dtype=scalar),
        solution: wp.array(dtype=vec3),
        euler_solution: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        velocity: wp.array(dtype=vec3),
        euler_velocity: wp.array(dtype=scalar),
        increment: wp.array(dtype=vec3),
        euler_increment: wp.array(dtype=scalar),
    ):
        """Place q = q₀ + η w, q̇ = w, and v₀ − w, whose momentum the residual has."""
        i = index(wp.tid())
        w = solution[i]
        position[i] = base_position[i] + w * stage_size[0]
        velocity[i] = w
        increment[i] = base_velocity[i] - w
        if wp.static(sliding):
            for d in range(2):
                s = 2 * i + d
                rate = euler_solution[s]
                euler[s] = base_euler[s] + rate * stage_size[0]
                euler_velocity[s] = rate
                euler_increment[s] = base_euler_velocity[s] - rate

    @wp.kernel(module=module, enable_backward=False)
    def lump_mass(
        segments: wp.array(dtype=wp.vec4i),
        density: wp.array(dtype=scalar),
        euler: wp.array(dtype=scalar),
        node_mass: wp.array(dtype=scalar),
    ):
        """Add half of every segment's mass to each of its nodes."""
        a, b, sa, sb, yarn, _direction = ends(segments, index(wp.tid()))
        m = scalar(0.5) * density[yarn] * (euler[sb] - euler[sa])
        wp.atomic_add(node_mass, a, m)
        wp.atomic_add(node_mass, b, m)

    @wp.kernel(module=module, enable_backward=False)
    def next_base(
        carried_time: wp.array(dtype=scalar),
        carried_rate: wp.array(dtype=scalar),
        is_free: wp.array(dtype=int),
        solution: wp.array(dtype=vec3),
        euler_solution: wp.array(dtype=scalar),
        start: wp.array(dtype=vec3),
        base_position: wp.array(dtype=vec3),
        base_euler: wp.array(dtype=scalar),
        base_velocity: wp.array(dtype=vec3),
        base_euler_velocity: wp.array(dtype=scalar),
    ):
        """Carry on to q₀ + t w and v₀ + k (w − v₀): from a stage's base to the next stage's, which starts from the same
        gain of velocity if asked for one. Sliding rates start from those of the stage before: they have next to no
        inertia."""
        i = index(wp.tid())
        w = solution[i]
        gain = w - base_velocity[i]
        v0 = base_velocity[i] + gain * carried_rate[0]
        base_position[i] = base_position[i] + w * carried_time[0]
        base_velocity[i] = v0
        if start and is_free[i] != 0:
            start[i] = v0 + gain
        if wp.static(sliding):
            for d in range(2):
                s = 2 * i + d
                rate = euler_solution[s]
                gain_s = rate - base_euler_velocity[s]
                base_euler[s] = base_euler[s] + rate * carried_time[0]
                base_euler_velocity[s] += gain_s * carried_rate[0]

    @wp.kernel(module=module, enable_backward=False)
    def estimate_error(
        nodes: int,
        step_size: wp.array(dtype=scalar),
        missing: wp.array(dtype=scalar),
        predicted: wp.array(dtype=vec3),
        solution: wp.array(dtype=vec3),
        step_error: wp.array(dtype=scalar),
    ):
        """Estimate the error of the node that is farthest off: h · missing · |w₂ − what the first stage's acceleration
        led to|."""
        most = scalar(0.0)
        for i in range(nodes):
            most = wp.max(most, wp.length_sq(load(solution, i) - load(predicted, i)))
        step_error[0] = wp.sqrt(most) * missing[0] * step_size[0]

    return SimpleNamespace(
        enter_stage=enter_stage,
        lump_mass=lump_mass,
        next_base=next_base,
        estimate_error=estimate_error,
    )
