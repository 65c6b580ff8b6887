"""An implicit stage: the velocity w at which momentum is conserved at the state that w itself leads to.

    r(w) = η F(q, w) + M(q) (v₀ − w) = 0,   q = q₀ + η w

Every implicit method here is made of such stages (``warp_yarn/integrators``). Newton's iteration takes A, the symmetric
positive definite part of −∂r/∂w, for its matrix: M + η D + η² H. The adjoint of a stage that has converged is
(−∂r/∂w)ᵀ λ = w̄, with the exact derivative: ρ = w̄ + (∂r/∂w)ᵀ λ is driven to 0 with the same A.
"""

import functools
from types import SimpleNamespace

import warp as wp

from .step import NOT_FINITE
from .variant import Variant


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, vec3, sliding = variant.scalar, variant.vec3, variant.sliding
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
        """q = q₀ + η w, q̇ = w, and v₀ − w, whose momentum the residual has."""
        i = wp.tid()
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
    def correct(
        step_length: wp.array(dtype=scalar),
        solution_before: wp.array(dtype=vec3),
        euler_solution_before: wp.array(dtype=scalar),
        direction: wp.array(dtype=vec3),
        euler_direction: wp.array(dtype=scalar),
        solution: wp.array(dtype=vec3),
        euler_solution: wp.array(dtype=scalar),
    ):
        """w + α δ."""
        i = wp.tid()
        solution[i] = solution_before[i] + direction[i] * step_length[0]
        if wp.static(sliding):
            for d in range(2):
                s = 2 * i + d
                euler_solution[s] = euler_solution_before[s] + euler_direction[s] * step_length[0]

    @wp.kernel(module=module, enable_backward=False)
    def measure(
        nodes: int,
        inverse_x: wp.array(dtype=vec3),
        inverse_s: wp.array(dtype=scalar),
        vector: wp.array(dtype=vec3),
        euler_vector: wp.array(dtype=scalar),
        solution: wp.array(dtype=vec3),
        euler_solution: wp.array(dtype=scalar),
        direction: wp.array(dtype=vec3),
        euler_direction: wp.array(dtype=scalar),
        norms: wp.array(dtype=scalar),
    ):
        """‖r‖ in the norm of A's inverse diagonal, and ‖w‖ in that of its diagonal: both are √(energy); and r·δ."""
        slope = scalar(0.0)
        of_vector = scalar(0.0)
        of_solution = scalar(0.0)
        for i in range(nodes):
            for k in range(3):
                inverse = inverse_x[i][k]
                if inverse > scalar(0.0):
                    of_vector += inverse * vector[i][k] * vector[i][k]
                    of_solution += solution[i][k] * solution[i][k] / inverse
                    slope += vector[i][k] * direction[i][k]
            if wp.static(sliding):
                for s in range(2 * i, 2 * i + 2):
                    inverse = inverse_s[s]
                    if inverse > scalar(0.0):
                        of_vector += inverse * euler_vector[s] * euler_vector[s]
                        of_solution += euler_solution[s] * euler_solution[s] / inverse
                        slope += euler_vector[s] * euler_direction[s]
        norms[0] = wp.sqrt(of_vector)
        norms[1] = wp.sqrt(of_solution)
        norms[2] = slope

    @wp.kernel(module=module, enable_backward=False)
    def shortest_segment(
        segment_nodes: wp.array(dtype=wp.vec2i),
        segment_yarn: wp.array(dtype=int),
        yarn_direction: wp.array(dtype=int),
        euler: wp.array(dtype=scalar),
        shortest: wp.array(dtype=scalar),
    ):
        e = wp.tid()
        direction = yarn_direction[segment_yarn[e]]
        wp.atomic_min(
            shortest, 0, euler[2 * segment_nodes[e][1] + direction] - euler[2 * segment_nodes[e][0] + direction]
        )

    @wp.kernel(module=module, enable_backward=False)
    def next_base(
        carried_time: wp.array(dtype=scalar),
        carried_rate: wp.array(dtype=scalar),
        solution: wp.array(dtype=vec3),
        euler_solution: wp.array(dtype=scalar),
        base_position: wp.array(dtype=vec3),
        base_euler: wp.array(dtype=scalar),
        base_velocity: wp.array(dtype=vec3),
        base_euler_velocity: wp.array(dtype=scalar),
    ):
        """q₀ + t w and v₀ + k (w − v₀): from a stage's base to the next stage's."""
        i = wp.tid()
        w = solution[i]
        base_position[i] = base_position[i] + w * carried_time[0]
        base_velocity[i] = base_velocity[i] + (w - base_velocity[i]) * carried_rate[0]
        if wp.static(sliding):
            for d in range(2):
                s = 2 * i + d
                base_euler[s] = base_euler[s] + euler_solution[s] * carried_time[0]
                base_euler_velocity[s] += (euler_solution[s] - base_euler_velocity[s]) * carried_rate[0]

    @wp.kernel(module=module, enable_backward=False)
    def recall_first_stage(
        nodes: int,
        counters: wp.array(dtype=int),
        stage_size: wp.array(dtype=scalar),
        carried_time: wp.array(dtype=scalar),
        is_free: wp.array(dtype=int),
        frame_position: wp.array(dtype=vec3),
        frame_euler: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        solution: wp.array(dtype=vec3),
        euler_solution: wp.array(dtype=scalar),
        first_solution: wp.array(dtype=vec3),
        euler_first_solution: wp.array(dtype=scalar),
    ):
        """w of the first stage, from q⁺ = q₀ + t w₁ + η w₂; what is held has one velocity in both."""
        i = wp.tid()
        k = (counters[0] + 1) * nodes + i
        w = solution[i]
        first_solution[i] = w
        if is_free[i] != 0:
            first_solution[i] = (frame_position[k] - position[i] - w * stage_size[0]) / carried_time[0]
        if wp.static(sliding):
            for d in range(2):
                s = 2 * i + d
                moved = frame_euler[2 * k + d] - euler[s] - euler_solution[s] * stage_size[0]
                euler_first_solution[s] = moved / carried_time[0]

    @wp.kernel(module=module, enable_backward=False)
    def carry_adjoint(
        time: wp.array(dtype=scalar),
        rate: wp.array(dtype=scalar),
        base_position_grad: wp.array(dtype=vec3),
        base_euler_grad: wp.array(dtype=scalar),
        base_velocity_grad: wp.array(dtype=vec3),
        base_euler_velocity_grad: wp.array(dtype=scalar),
        stage_adjoint: wp.array(dtype=vec3),
        euler_stage_adjoint: wp.array(dtype=scalar),
    ):
        """Adjoint of q₀ + t w and v₀ + k (w − v₀): w̄ gains, and v̄₀ keeps 1 − k of itself.

        The end of a step, q⁺ = q₀ + η w and q̇⁺ = w, is t = η and k = 1.
        """
        i = wp.tid()
        v = base_velocity_grad[i]
        stage_adjoint[i] = base_position_grad[i] * time[0] + v * rate[0]
        base_velocity_grad[i] = v * (scalar(1.0) - rate[0])
        if wp.static(sliding):
            for d in range(2):
                s = 2 * i + d
                v_s = base_euler_velocity_grad[s]
                euler_stage_adjoint[s] = base_euler_grad[s] * time[0] + v_s * rate[0]
                base_euler_velocity_grad[s] = v_s * (scalar(1.0) - rate[0])

    @wp.kernel(module=module, enable_backward=False)
    def stage_adjoint_residual(
        stage_size: wp.array(dtype=scalar),
        stage_adjoint: wp.array(dtype=vec3),
        euler_stage_adjoint: wp.array(dtype=scalar),
        position_grad: wp.array(dtype=vec3),
        euler_grad: wp.array(dtype=scalar),
        velocity_grad: wp.array(dtype=vec3),
        euler_velocity_grad: wp.array(dtype=scalar),
        increment_grad: wp.array(dtype=vec3),
        euler_increment_grad: wp.array(dtype=scalar),
        seed: wp.array(dtype=vec3),
        euler_seed: wp.array(dtype=scalar),
        status: wp.array(dtype=int),
    ):
        """ρ = w̄ + (∂r/∂w)ᵀ λ, from what reverse mode has gathered."""
        i = wp.tid()
        r = stage_adjoint[i] + position_grad[i] * stage_size[0] + velocity_grad[i] - increment_grad[i]
        finite = wp.isfinite(r)
        seed[i] = r
        if wp.static(sliding):
            for d in range(2):
                s = 2 * i + d
                r_s = euler_stage_adjoint[s] + euler_grad[s] * stage_size[0] + euler_velocity_grad[s]
                r_s -= euler_increment_grad[s]
                finite = finite and wp.isfinite(r_s)
                euler_seed[s] = r_s
        if not finite:
            if wp.atomic_cas(status, 0, 0, wp.static(NOT_FINITE)) == 0:
                status[1] = i

    @wp.kernel(module=module, enable_backward=False)
    def absorb_stage(
        position_grad: wp.array(dtype=vec3),
        euler_grad: wp.array(dtype=scalar),
        increment_grad: wp.array(dtype=vec3),
        euler_increment_grad: wp.array(dtype=scalar),
        base_position_grad: wp.array(dtype=vec3),
        base_euler_grad: wp.array(dtype=scalar),
        base_velocity_grad: wp.array(dtype=vec3),
        base_euler_velocity_grad: wp.array(dtype=scalar),
    ):
        """The adjoints of q₀ and v₀ gain what came through q = q₀ + η w and v₀ − w."""
        i = wp.tid()
        base_position_grad[i] = base_position_grad[i] + position_grad[i]
        base_velocity_grad[i] = base_velocity_grad[i] + increment_grad[i]
        for d in range(2):
            s = 2 * i + d
            base_euler_grad[s] = base_euler_grad[s] + euler_grad[s]
            if wp.static(sliding):
                base_euler_velocity_grad[s] = base_euler_velocity_grad[s] + euler_increment_grad[s]

    return SimpleNamespace(
        enter_stage=enter_stage,
        correct=correct,
        measure=measure,
        shortest_segment=shortest_segment,
        next_base=next_base,
        recall_first_stage=recall_first_stage,
        carry_adjoint=carry_adjoint,
        stage_adjoint_residual=stage_adjoint_residual,
        absorb_stage=absorb_stage,
    )
