"""The line search along δ, the step of Newton's iteration, and what limits it: crossings keep their order."""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.indexing import coordinates, ends, index
from ..core.memory import functions as access
from ..core.status import ORDER_LOST, fail
from ..core.structs import structs
from ..core.variant import Variant
from .newton import is_held

LEAST_LEFT = 0.1
"""Part of a Δs that a step of the iteration leaves of it at least."""
LEAST_EXTRAPOLATED = 0.5
"""Part of a Δs that must be left where a first stage is extrapolated to the second one's base, else the step is split:
where crossings fly at each other, the second stage would begin inside the barrier, and gain several times the energy
of the start."""

LEAST_INNER = {wp.float64: 1e-4, wp.float32: 0.1}
"""The least change of velocity, beside that of the mass centre, that a free cloth's is taken for: rounding."""


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, vec3, sliding = variant.scalar, variant.vec3, variant.sliding
    load = access(variant).load
    NewtonControl = structs(variant).NewtonControl
    module = variant.module("stage")

    @wp.kernel(module=module, enable_backward=False)
    def check_initial_guess(
        segments: wp.array(dtype=wp.vec4i),
        stage_size: wp.array(dtype=scalar),
        euler: wp.array(dtype=scalar),
        base_euler: wp.array(dtype=scalar),
        euler_solution: wp.array(dtype=scalar),
        order_would_be_lost: wp.array(dtype=int),
        status: wp.array(dtype=int),
    ):
        """Check whether crossings would pass each other at the velocity that the iteration starts from, and whether the
        base has them much nearer to each other than the first stage left them."""
        a, _b, sa, sb, _yarn, _direction = ends(segments, index(wp.tid()))
        rest = base_euler[sb] - base_euler[sa]
        if rest + (euler_solution[sb] - euler_solution[sa]) * stage_size[0] <= scalar(0.0):
            order_would_be_lost[0] = 1
        if rest < scalar(LEAST_EXTRAPOLATED) * (euler[sb] - euler[sa]):
            fail(status, wp.static(ORDER_LOST), a)

    @wp.kernel(module=module, enable_backward=False)
    def begin_line_search(
        nodes: int,
        held_by: int,
        touching: wp.array(dtype=int),
        node_mass: wp.array(dtype=scalar),
        rhs: wp.array(dtype=vec3),
        euler_rhs: wp.array(dtype=scalar),
        direction: wp.array(dtype=vec3),
        euler_direction: wp.array(dtype=scalar),
        is_free: wp.array(dtype=int),
        solution: wp.array(dtype=vec3),
        euler_solution: wp.array(dtype=scalar),
        base_velocity: wp.array(dtype=vec3),
        base_euler_velocity: wp.array(dtype=scalar),
        control: NewtonControl,
    ):
        """Begins a line search along δ: a full step first, r·δ, how fast r falls along δ, δ·M δ, and of the change of
        velocity g = w + δ − v₀ that it leads to, g·M g.

        Of a cloth that nothing holds it is the change as seen by one who falls with it: its motion within itself is as
        right in free fall as at rest."""
        total = scalar(0.0)
        square = scalar(0.0)
        left = scalar(0.0)
        mass = scalar(0.0)
        impulse = vec3()
        for i in range(nodes):
            d = load(direction, i)
            total += wp.dot(load(rhs, i), d)
            gain = vec3()
            if is_free[i] != 0:
                gain = load(solution, i) + d - load(base_velocity, i)
            along = scalar(0.0)
            along_left = scalar(0.0)
            if wp.static(sliding):
                for s in range(2 * i, 2 * i + 2):
                    d_s = load(euler_direction, s)
                    total += load(euler_rhs, s) * d_s
                    gain_s = load(euler_solution, s) + d_s - load(base_euler_velocity, s)
                    along += scalar(0.5) * gain_s * gain_s
                    along_left += scalar(0.5) * d_s * d_s
            m = load(node_mass, i)
            mass += m
            impulse += gain * m
            square += m * (wp.dot(gain, gain) + along)
            left += m * (wp.dot(d, d) + along_left)
        if not is_held(held_by, touching):
            least = square * scalar(wp.static(LEAST_INNER[scalar] ** 2))
            square = wp.max(square - wp.dot(impulse, impulse) / mass, least)
        control.directional_derivative[0] = total
        control.kinetic[0] = square
        control.kinetic_left[0] = left
        control.step_length[0] = scalar(1.0)

    @wp.kernel(module=module, enable_backward=False)
    def shortest_segment(
        segments: wp.array(dtype=wp.vec4i),
        euler: wp.array(dtype=scalar),
        shortest: wp.array(dtype=scalar),
    ):
        sa, sb = coordinates(segments, index(wp.tid()))
        wp.atomic_min(shortest, 0, euler[sb] - euler[sa])

    @wp.kernel(module=module, enable_backward=False)
    def limit_step_length(
        segments: wp.array(dtype=wp.vec4i),
        stage_size: wp.array(dtype=scalar),
        euler: wp.array(dtype=scalar),
        euler_direction: wp.array(dtype=scalar),
        step_length: wp.array(dtype=scalar),
    ):
        """Shortens the step along δ so far that it leaves something of every Δs."""
        sa, sb = coordinates(segments, index(wp.tid()))
        rest = euler[sb] - euler[sa]
        loss = (euler_direction[sa] - euler_direction[sb]) * stage_size[0]
        allowed = rest * scalar(wp.static(1.0 - LEAST_LEFT))
        if loss > allowed and rest > scalar(0.0):
            wp.atomic_min(step_length, 0, allowed / loss)

    @wp.kernel(module=module, enable_backward=False)
    def apply_step(
        step_length: wp.array(dtype=scalar),
        solution_before: wp.array(dtype=vec3),
        euler_solution_before: wp.array(dtype=scalar),
        direction: wp.array(dtype=vec3),
        euler_direction: wp.array(dtype=scalar),
        solution: wp.array(dtype=vec3),
        euler_solution: wp.array(dtype=scalar),
    ):
        """Take the step, w + α δ."""
        i = index(wp.tid())
        solution[i] = solution_before[i] + direction[i] * step_length[0]
        if wp.static(sliding):
            for d in range(2):
                s = 2 * i + d
                euler_solution[s] = euler_solution_before[s] + euler_direction[s] * step_length[0]

    return SimpleNamespace(
        check_initial_guess=check_initial_guess,
        begin_line_search=begin_line_search,
        shortest_segment=shortest_segment,
        limit_step_length=limit_step_length,
        apply_step=apply_step,
    )
