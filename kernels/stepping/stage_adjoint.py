"""The adjoint of an implicit stage (``stage.py``) around reverse mode: w of the stages as the frames tell it, w̄ of what
they lead to, and ρ = w̄ + (∂r/∂w)ᵀ λ, which is driven to 0 with the same A.

A module of its own: who only simulates does not compile it.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.indexing import index
from ..core.memory import functions as access
from ..core.status import NOT_FINITE, fail
from ..core.variant import Variant


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    """Define the kernels of ``StageMethod.backward_step``, by name."""
    scalar, vec3, sliding = variant.scalar, variant.vec3, variant.sliding
    load = access(variant).load
    module = variant.module("stage_adjoint")

    @wp.kernel(module=module, enable_backward=False)
    def restore_first_stage(
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
        """Compute w of the first stage, from q⁺ = q₀ + t w₁ + η w₂; what is held has one velocity in both."""
        i = index(wp.tid())
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
    def restore_carried_stage(
        carried_rate: wp.array(dtype=scalar),
        velocity: wp.array(dtype=vec3),
        euler_velocity: wp.array(dtype=scalar),
        solution: wp.array(dtype=vec3),
        euler_solution: wp.array(dtype=scalar),
    ):
        """Compute w of a stage that was carried to the step's end, from q̇⁺ = q̇ + k (w − q̇)."""
        i = index(wp.tid())
        solution[i] = velocity[i] + (solution[i] - velocity[i]) / carried_rate[0]
        if wp.static(sliding):
            for s in range(2 * i, 2 * i + 2):
                euler_solution[s] = euler_velocity[s] + (euler_solution[s] - euler_velocity[s]) / carried_rate[0]

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
        """Reverse q₀ + t w and v₀ + k (w − v₀): w̄ gains, and v̄₀ keeps 1 − k of itself.

        The end of a step, q⁺ = q₀ + η w and q̇⁺ = w, is t = η and k = 1.
        """
        i = index(wp.tid())
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
        adjoint_rhs: wp.array(dtype=vec3),
        euler_adjoint_rhs: wp.array(dtype=scalar),
        status: wp.array(dtype=int),
    ):
        """Compute ρ = w̄ + (∂r/∂w)ᵀ λ, from what reverse mode has gathered."""
        i = index(wp.tid())
        r = stage_adjoint[i] + position_grad[i] * stage_size[0] + velocity_grad[i] - increment_grad[i]
        finite = wp.isfinite(r)
        adjoint_rhs[i] = r
        if wp.static(sliding):
            for d in range(2):
                s = 2 * i + d
                r_s = euler_stage_adjoint[s] + euler_grad[s] * stage_size[0] + euler_velocity_grad[s]
                r_s -= euler_increment_grad[s]
                finite = finite and wp.isfinite(r_s)
                euler_adjoint_rhs[s] = r_s
        if not finite:
            fail(status, wp.static(NOT_FINITE), i)

    @wp.kernel(module=module, enable_backward=False)
    def control_adjoint(
        nodes: int,
        inverse_x: wp.array(dtype=vec3),
        inverse_s: wp.array(dtype=scalar),
        adjoint_rhs: wp.array(dtype=vec3),
        euler_adjoint_rhs: wp.array(dtype=scalar),
        adjoint_tolerance: wp.array(dtype=scalar),
        status: wp.array(dtype=int),
        evaluations: wp.array(dtype=int),
        residual_norm: wp.array(dtype=scalar),
        first_residual_norm: wp.array(dtype=scalar),
        iterate: wp.array(dtype=int),
    ):
        """Choose whether ρ is to fall further, and falls: ‖ρ‖ is in the norm of ``control_newton``."""
        total = scalar(0.0)
        for i in range(nodes):
            r = load(adjoint_rhs, i)
            total += wp.dot(wp.cw_mul(load(inverse_x, i), r), r)
            if wp.static(sliding):
                for s in range(2 * i, 2 * i + 2):
                    total += load(inverse_s, s) * load(euler_adjoint_rhs, s) * load(euler_adjoint_rhs, s)
        now = wp.sqrt(total)
        falls = bool(True)
        if evaluations[0] == 0:
            first_residual_norm[0] = now
        else:
            falls = now < scalar(0.5) * residual_norm[0]
        evaluations[0] = evaluations[0] + 1
        residual_norm[0] = now
        iterate[0] = 0
        if falls and status[0] == 0 and now > adjoint_tolerance[0] * first_residual_norm[0]:
            iterate[0] = 1

    @wp.kernel(module=module, enable_backward=False)
    def add_stage_adjoint(
        position_grad: wp.array(dtype=vec3),
        euler_grad: wp.array(dtype=scalar),
        increment_grad: wp.array(dtype=vec3),
        euler_increment_grad: wp.array(dtype=scalar),
        base_position_grad: wp.array(dtype=vec3),
        base_euler_grad: wp.array(dtype=scalar),
        base_velocity_grad: wp.array(dtype=vec3),
        base_euler_velocity_grad: wp.array(dtype=scalar),
    ):
        """Add to the adjoints of q₀ and v₀ what came through q = q₀ + η w and v₀ − w."""
        i = index(wp.tid())
        base_position_grad[i] = base_position_grad[i] + position_grad[i]
        base_velocity_grad[i] = base_velocity_grad[i] + increment_grad[i]
        for d in range(2):
            s = 2 * i + d
            base_euler_grad[s] = base_euler_grad[s] + euler_grad[s]
            if wp.static(sliding):
                base_euler_velocity_grad[s] = base_euler_velocity_grad[s] + euler_increment_grad[s]

    return SimpleNamespace(
        restore_first_stage=restore_first_stage,
        restore_carried_stage=restore_carried_stage,
        carry_adjoint=carry_adjoint,
        stage_adjoint_residual=stage_adjoint_residual,
        control_adjoint=control_adjoint,
        add_stage_adjoint=add_stage_adjoint,
    )
