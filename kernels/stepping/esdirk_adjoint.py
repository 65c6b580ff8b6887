"""The adjoint of methods whose first stage is explicit (``esdirk.py``), around that of implicit stages.

q̄, v̄ and w̄ are adjoints of q, v and w. A stage hands what it started from on: of h a_ij q̄_i + (h a_ij/η) v̄_i to w̄_j,
−(h a_ij/η) v̄_i to v̄_j, of an earlier stage j, and the rest to where the step started.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.indexing import index
from ..core.variant import Variant
from . import esdirk


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, vec3, sliding = variant.scalar, variant.vec3, variant.sliding
    row = esdirk.functions(variant).row
    module = variant.module("esdirk_adjoint")

    @wp.kernel(module=module, enable_backward=False)
    def restore_slope(
        nodes: int,
        counters: wp.array(dtype=int),
        frame_slope: wp.array(dtype=vec3),
        frame_euler_slope: wp.array(dtype=scalar),
        slope: wp.array(dtype=vec3),
        euler_slope: wp.array(dtype=scalar),
    ):
        """Restore the slope that a step started with."""
        i = index(wp.tid())
        k = index(counters[0] * nodes + i)
        slope[i] = frame_slope[k]
        if wp.static(sliding):
            for d in range(2):
                euler_slope[2 * i + d] = frame_euler_slope[2 * k + d]

    @wp.func
    def both(
        h: scalar,
        eta: scalar,
        a: wp.array(dtype=scalar),
        moved: vec3,
        gained: vec3,
        v: vec3,
        slope: vec3,
        w3: vec3,
        slope_3: vec3,
    ):
        """Solve for (w₁, w₂) of what a step moved by and gained in velocity."""
        of_rates = moved / h - v * a[3] - w3 * (eta / h)
        of_slopes = gained / h - slope * a[3] - slope_3 * (eta / h)
        v_1 = v + slope * (h * a[0])
        v_2 = v + slope * (h * a[1])
        # b₁ w₁ + b₂ w₂ = of_rates, and with w in place of the slopes c₁ w₁ + (b₂/η) w₂ = right
        across = a[5] * h * a[2] / (eta * eta)
        c_1 = a[4] / eta - across
        right = of_slopes + v_1 * c_1 + v_2 * (a[5] / eta)
        w1 = (of_rates / eta - right) / across
        w2 = (of_rates - w1 * a[4]) / a[5]
        return w1, w2

    @wp.kernel(module=module, enable_backward=False)
    def restore_stages(
        nodes: int,
        counters: wp.array(dtype=int),
        step_size: wp.array(dtype=scalar),
        stage_size: wp.array(dtype=scalar),
        tableau: wp.array(dtype=scalar),
        is_free: wp.array(dtype=int),
        frame_position: wp.array(dtype=vec3),
        frame_slope: wp.array(dtype=vec3),
        position: wp.array(dtype=vec3),
        velocity: wp.array(dtype=vec3),
        slope: wp.array(dtype=vec3),
        solution: wp.array(dtype=vec3),
        first_solution: wp.array(dtype=vec3),
        second_solution: wp.array(dtype=vec3),
    ):
        """Compute w of the first two implicit stages from the step's ends."""
        i = index(wp.tid())
        k = (counters[0] + 1) * nodes + i
        first_solution[i] = solution[i]
        second_solution[i] = solution[i]
        if is_free[i] != 0:
            w1, w2 = both(
                step_size[0],
                stage_size[0],
                tableau,
                frame_position[k] - position[i],
                solution[i] - velocity[i],
                velocity[i],
                slope[i],
                solution[i],
                frame_slope[k],
            )
            first_solution[i] = w1
            second_solution[i] = w2

    @wp.kernel(module=module, enable_backward=False)
    def restore_euler_stages(
        nodes: int,
        counters: wp.array(dtype=int),
        step_size: wp.array(dtype=scalar),
        stage_size: wp.array(dtype=scalar),
        tableau: wp.array(dtype=scalar),
        frame_euler_slope: wp.array(dtype=scalar),
        euler: wp.array(dtype=scalar),
        euler_next: wp.array(dtype=scalar),
        euler_velocity: wp.array(dtype=scalar),
        euler_slope: wp.array(dtype=scalar),
        euler_solution: wp.array(dtype=scalar),
        euler_first_solution: wp.array(dtype=scalar),
        euler_second_solution: wp.array(dtype=scalar),
    ):
        """Compute the same of (u, v)."""
        if wp.static(sliding):
            i = index(wp.tid())
            a = 2 * i
            b = 2 * i + 1
            k = 2 * ((counters[0] + 1) * nodes + i)
            zero = scalar(0.0)
            v = vec3(euler_velocity[a], euler_velocity[b], zero)
            w = vec3(euler_solution[a], euler_solution[b], zero)
            w1, w2 = both(
                step_size[0],
                stage_size[0],
                tableau,
                vec3(euler_next[a] - euler[a], euler_next[b] - euler[b], zero),
                w - v,
                v,
                vec3(euler_slope[a], euler_slope[b], zero),
                w,
                vec3(frame_euler_slope[k], frame_euler_slope[k + 1], zero),
            )
            for d in range(2):
                euler_first_solution[a + d] = w1[d]
                euler_second_solution[a + d] = w2[d]

    @wp.kernel(module=module, enable_backward=False)
    def slope_adjoint(
        share: scalar,
        is_whole: int,
        stage_size: wp.array(dtype=scalar),
        is_free: wp.array(dtype=int),
        slope_grad: wp.array(dtype=vec3),
        euler_slope_grad: wp.array(dtype=scalar),
        stage_adjoint: wp.array(dtype=vec3),
        euler_stage_adjoint: wp.array(dtype=scalar),
        base_velocity_grad: wp.array(dtype=vec3),
        base_euler_velocity_grad: wp.array(dtype=scalar),
    ):
        """Reverse ``add_slope``; is_whole: of the stage that was the first to give."""
        i = index(wp.tid())
        by = share / stage_size[0]
        if is_free[i] != 0:
            g = slope_grad[i] * by
            stage_adjoint[i] = stage_adjoint[i] + g
            base_velocity_grad[i] = base_velocity_grad[i] - g
        if is_whole != 0:
            slope_grad[i] = vec3()
        if wp.static(sliding):
            for s in range(2 * i, 2 * i + 2):
                g_s = euler_slope_grad[s] * by
                euler_stage_adjoint[s] = euler_stage_adjoint[s] + g_s
                base_euler_velocity_grad[s] = base_euler_velocity_grad[s] - g_s
                if is_whole != 0:
                    euler_slope_grad[s] = scalar(0.0)

    @wp.kernel(module=module, enable_backward=False)
    def hand_on(
        stage: int,
        step_size: wp.array(dtype=scalar),
        stage_size: wp.array(dtype=scalar),
        tableau: wp.array(dtype=scalar),
        is_free: wp.array(dtype=int),
        base_position_grad: wp.array(dtype=vec3),
        base_velocity_grad: wp.array(dtype=vec3),
        first_solution_grad: wp.array(dtype=vec3),
        second_solution_grad: wp.array(dtype=vec3),
        first_base_grad: wp.array(dtype=vec3),
        second_base_grad: wp.array(dtype=vec3),
        start_position_grad: wp.array(dtype=vec3),
        start_velocity_grad: wp.array(dtype=vec3),
        slope_grad: wp.array(dtype=vec3),
        solution_grad: wp.array(dtype=vec3),
    ):
        """Reverse ``enter_base`` of a stage, once its q̄ and v̄ are whole."""
        i = index(wp.tid())
        h = step_size[0]
        q = base_position_grad[i]
        v = base_velocity_grad[i]
        a = row(stage, tableau)
        start_position_grad[i] = start_position_grad[i] + q
        over = h / stage_size[0]
        start_velocity_grad[i] = start_velocity_grad[i] + v
        if is_free[i] != 0:
            start_velocity_grad[i] = start_velocity_grad[i] + q * (h * a[0])
            slope_grad[i] = slope_grad[i] + v * (h * a[0])
        else:
            solution_grad[i] = solution_grad[i] + q * (h * a[0])
        first_solution_grad[i] = first_solution_grad[i] + (q * h + v * over) * a[1]
        first_base_grad[i] = first_base_grad[i] - v * (over * a[1])
        second_solution_grad[i] = second_solution_grad[i] + (q * h + v * over) * a[2]
        second_base_grad[i] = second_base_grad[i] - v * (over * a[2])

    @wp.kernel(module=module, enable_backward=False)
    def hand_euler_on(
        stage: int,
        step_size: wp.array(dtype=scalar),
        stage_size: wp.array(dtype=scalar),
        tableau: wp.array(dtype=scalar),
        base_euler_grad: wp.array(dtype=scalar),
        base_euler_velocity_grad: wp.array(dtype=scalar),
        euler_first_solution_grad: wp.array(dtype=scalar),
        euler_second_solution_grad: wp.array(dtype=scalar),
        euler_first_base_grad: wp.array(dtype=scalar),
        euler_second_base_grad: wp.array(dtype=scalar),
        start_euler_grad: wp.array(dtype=scalar),
        start_euler_velocity_grad: wp.array(dtype=scalar),
        euler_slope_grad: wp.array(dtype=scalar),
    ):
        """Reverse ``enter_euler_base``; without sliding (u, v) is handed on all the same, as it may be an input."""
        s = index(wp.tid())
        h = step_size[0]
        q = base_euler_grad[s]
        start_euler_grad[s] = start_euler_grad[s] + q
        if wp.static(sliding):
            v = base_euler_velocity_grad[s]
            a = row(stage, tableau)
            over = h / stage_size[0]
            start_euler_velocity_grad[s] = start_euler_velocity_grad[s] + q * (h * a[0]) + v
            euler_slope_grad[s] = euler_slope_grad[s] + v * (h * a[0])
            of_w = q * h + v * over
            euler_first_solution_grad[s] = euler_first_solution_grad[s] + of_w * a[1]
            euler_first_base_grad[s] = euler_first_base_grad[s] - v * (over * a[1])
            euler_second_solution_grad[s] = euler_second_solution_grad[s] + of_w * a[2]
            euler_second_base_grad[s] = euler_second_base_grad[s] - v * (over * a[2])

    return SimpleNamespace(
        restore_slope=restore_slope,
        restore_stages=restore_stages,
        restore_euler_stages=restore_euler_stages,
        slope_adjoint=slope_adjoint,
        hand_on=hand_on,
        hand_euler_on=hand_euler_on,
    )
