"""The step of ROS2 around its two linear solves, and the adjoint of what stands between them.

``warp_yarn/integrators/ros2.py`` has the equations. Where γ = 1 − 1/√2, so that 2γ² − 4γ + 1 = 0, its step ends at

    q⁺ = q₂ + ½ h (w₁ + w₂),   q̇⁺ = w₁ + (w₁ + w₂)/(2γ)

which has no q̇ left in it: the velocity of what has no mass is forgotten within the step.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core import general
from ..core.status import NOT_FINITE, fail
from ..core.structs import structs
from ..core.variant import Variant

GAMMA = 1.0 - 0.5**0.5


@functools.cache
def define_reversible(variant: Variant) -> SimpleNamespace:
    """Define what the adjoint runs in reverse."""
    scalar, vec3 = variant.scalar, variant.vec3
    own = general.functions(variant).own

    @variant.kernel("ros2")
    def second_stage_damping(
        crossing_node: wp.array(dtype=int),
        friction_damping: wp.array(dtype=scalar),
        coefficients: wp.array(dtype=vec3),
        euler_velocity: wp.array(dtype=scalar),
        euler_first_solution: wp.array(dtype=scalar),
        euler_rhs: wp.array(dtype=scalar),
    ):
        """Add η D (v₂ − 2 w₁) of friction."""
        i = crossing_node[wp.tid()]
        for direction in range(2):
            s = 2 * i + direction
            rate = euler_velocity[s] - scalar(2.0) * euler_first_solution[s]
            wp.atomic_add(euler_rhs, s, coefficients[0][1] * friction_damping[own(i)] * rate)

    return SimpleNamespace(second_stage_damping=second_stage_damping)


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, vec3, sliding = variant.scalar, variant.vec3, variant.sliding
    StateAdjoint = structs(variant).StateAdjoint
    module = variant.module("ros2")

    @wp.kernel(module=module, enable_backward=False)
    def enter_second_stage(
        step_size: wp.array(dtype=scalar),
        first_solution: wp.array(dtype=vec3),
        euler_first_solution: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        velocity: wp.array(dtype=vec3),
        euler_velocity: wp.array(dtype=scalar),
        increment: wp.array(dtype=vec3),
        euler_increment: wp.array(dtype=scalar),
        start: wp.array(dtype=vec3),
        euler_start: wp.array(dtype=scalar),
        status: wp.array(dtype=int),
    ):
        """Place q₂ = q + h w₁, v₂ = q̇ + (w₁ − q̇)/γ and v₂ − 4 w₁ + 2 q̇, whose momentum the second stage has.

        The solve for w₂, if there is to be one, starts from −w₁: from there a step at a constant velocity takes it
        nowhere. It is w₂ of what is held, too, which so arrives where w₁ alone would bring it.
        """
        i = wp.tid()
        h = step_size[0]
        rate = scalar(wp.static(1.0 / GAMMA))
        w = first_solution[i]
        v = velocity[i]
        x2 = position[i] + w * h
        v2 = v + (w - v) * rate
        finite = wp.isfinite(x2)
        position[i] = x2
        velocity[i] = v2
        increment[i] = v2 - w * scalar(4.0) + v * scalar(2.0)
        if start:
            start[i] = -w
        if wp.static(sliding):
            for d in range(2):
                s = 2 * i + d
                w_s = euler_first_solution[s]
                v_s = euler_velocity[s]
                u2 = euler[s] + w_s * h
                v2_s = v_s + (w_s - v_s) * rate
                finite = finite and wp.isfinite(u2)
                euler[s] = u2
                euler_velocity[s] = v2_s
                euler_increment[s] = v2_s - w_s * scalar(4.0) + v_s * scalar(2.0)
                if euler_start:
                    euler_start[s] = -w_s
        if not finite:
            fail(status, wp.static(NOT_FINITE), i)

    @wp.kernel(module=module, enable_backward=False)
    def leave_second_stage(
        step_size: wp.array(dtype=scalar),
        first_solution: wp.array(dtype=vec3),
        euler_first_solution: wp.array(dtype=scalar),
        solution: wp.array(dtype=vec3),
        euler_solution: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        velocity: wp.array(dtype=vec3),
        euler_velocity: wp.array(dtype=scalar),
        status: wp.array(dtype=int),
    ):
        """Compute q⁺ and q̇⁺, and whether they are finite."""
        i = wp.tid()
        half = scalar(0.5) * step_size[0]
        rate = scalar(wp.static(0.5 / GAMMA))
        w = first_solution[i]
        both = w + solution[i]
        x = position[i] + both * half
        finite = wp.isfinite(x)
        position[i] = x
        velocity[i] = w + both * rate
        if wp.static(sliding):
            for d in range(2):
                s = 2 * i + d
                w_s = euler_first_solution[s]
                both_s = w_s + euler_solution[s]
                u = euler[s] + both_s * half
                finite = finite and wp.isfinite(u)
                euler[s] = u
                euler_velocity[s] = w_s + both_s * rate
        if not finite:
            fail(status, wp.static(NOT_FINITE), i)

    @wp.kernel(module=module, enable_backward=False)
    def restore_both_stages(
        nodes: int,
        counters: wp.array(dtype=int),
        step_size: wp.array(dtype=scalar),
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
        """Compute w₁ and w₂ of a step that led from q to q⁺ and q̇⁺, which ``restore_frame`` left in the solution.

        With a = (q⁺ − q)/h, w₁ + w₂ = 2γ (q̇⁺ − a)/(1 − γ) and w₁ = a − ½ (w₁ + w₂).
        """
        i = wp.tid()
        k = (counters[0] + 1) * nodes + i
        h = step_size[0]
        factor = scalar(wp.static(2.0 * GAMMA / (1.0 - GAMMA)))
        half = scalar(0.5)
        w = solution[i]
        both = vec3()
        if is_free[i] != 0:
            mean = (frame_position[k] - position[i]) / h
            both = (w - mean) * factor
            w = mean - both * half
        first_solution[i] = w
        solution[i] = both - w
        if wp.static(sliding):
            for d in range(2):
                s = 2 * i + d
                mean_s = (frame_euler[2 * k + d] - euler[s]) / h
                both_s = (euler_solution[s] - mean_s) * factor
                w_s = mean_s - both_s * half
                euler_first_solution[s] = w_s
                euler_solution[s] = both_s - w_s

    @wp.kernel(module=module, enable_backward=False)
    def second_stage_adjoint(
        step_size: wp.array(dtype=scalar),
        position_grad: wp.array(dtype=vec3),
        euler_grad: wp.array(dtype=scalar),
        velocity_grad: wp.array(dtype=vec3),
        euler_velocity_grad: wp.array(dtype=scalar),
        stage_adjoint: wp.array(dtype=vec3),
        euler_stage_adjoint: wp.array(dtype=scalar),
        adjoint_rhs: wp.array(dtype=vec3),
        euler_adjoint_rhs: wp.array(dtype=scalar),
        rhs_grad: wp.array(dtype=vec3),
        euler_rhs_grad: wp.array(dtype=scalar),
        status: wp.array(dtype=int),
    ):
        """Compute the right-hand side w̄₂ = ½ h q̄⁺ + q̄̇⁺/(2γ), and w̄₁ = w̄₂ + q̄̇⁺ of the step's end; λ and v̄₂
        start at 0."""
        i = wp.tid()
        half = scalar(0.5) * step_size[0]
        rate = scalar(wp.static(0.5 / GAMMA))
        v = velocity_grad[i]
        w2 = position_grad[i] * half + v * rate
        finite = wp.isfinite(w2)
        adjoint_rhs[i] = w2
        stage_adjoint[i] = w2 + v
        velocity_grad[i] = vec3()
        rhs_grad[i] = vec3()
        if wp.static(sliding):
            for d in range(2):
                s = 2 * i + d
                v_s = euler_velocity_grad[s]
                w2_s = euler_grad[s] * half + v_s * rate
                finite = finite and wp.isfinite(w2_s)
                euler_adjoint_rhs[s] = w2_s
                euler_stage_adjoint[s] = w2_s + v_s
                euler_velocity_grad[s] = scalar(0.0)
                euler_rhs_grad[s] = scalar(0.0)
        if not finite:
            fail(status, wp.static(NOT_FINITE), i)

    @wp.kernel(module=module, enable_backward=False)
    def first_stage_adjoint(
        step_size: wp.array(dtype=scalar),
        is_free: wp.array(dtype=int),
        adjoint: StateAdjoint,
        increment_grad: wp.array(dtype=vec3),
        euler_increment_grad: wp.array(dtype=scalar),
        euler_first_solution_grad: wp.array(dtype=scalar),
        solution_grad: wp.array(dtype=vec3),
        stage_adjoint: wp.array(dtype=vec3),
        euler_stage_adjoint: wp.array(dtype=scalar),
        adjoint_rhs: wp.array(dtype=vec3),
        euler_adjoint_rhs: wp.array(dtype=scalar),
        status: wp.array(dtype=int),
    ):
        """Reverse ``enter_second_stage``: the right-hand side w̄₁, with all of it, and v̄.

        q̄ is what q̄₂ is. w₂ of what is held is −w₁.
        """
        i = wp.tid()
        h = step_size[0]
        rate = scalar(wp.static(1.0 / GAMMA))
        one, two, four = scalar(1.0), scalar(2.0), scalar(4.0)
        m = increment_grad[i]
        v2 = adjoint.velocity_grad[i] + m
        w1 = stage_adjoint[i] + adjoint.position_grad[i] * h + v2 * rate - m * four
        if is_free[i] == 0:
            w1 -= solution_grad[i]
        finite = wp.isfinite(w1)
        adjoint_rhs[i] = w1
        adjoint.velocity_grad[i] = v2 * (one - rate) + m * two
        if wp.static(sliding):
            for d in range(2):
                s = 2 * i + d
                m_s = euler_increment_grad[s]
                v2_s = adjoint.euler_velocity_grad[s] + m_s
                w1_s = euler_stage_adjoint[s] + adjoint.euler_grad[s] * h + v2_s * rate - m_s * four
                w1_s += euler_first_solution_grad[s]
                finite = finite and wp.isfinite(w1_s)
                euler_adjoint_rhs[s] = w1_s
                adjoint.euler_velocity_grad[s] = v2_s * (one - rate) + m_s * two
        if not finite:
            fail(status, wp.static(NOT_FINITE), i)

    return SimpleNamespace(
        enter_second_stage=enter_second_stage,
        leave_second_stage=leave_second_stage,
        restore_both_stages=restore_both_stages,
        second_stage_adjoint=second_stage_adjoint,
        first_stage_adjoint=first_stage_adjoint,
    )
