"""Methods whose first stage is explicit: its slope is that of the last stage of the step before (``esdirk3.py``).

    q_i = q + h (a_i0 q̇ + Σ_j a_ij w_j),   v_i = q̇ + h (a_i0 q̈ + Σ_j a_ij q̈_j),   q̈_j = (w_j − v_j)/η

are where the implicit stages i = 1, 2, 3 start from, q̈ the slope that the step before left. What is held has one
velocity in all of a step.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.indexing import index
from ..core.variant import Variant

COEFFICIENTS = 10
"""Of a tableau: a₁₀, a₂₀, a₂₁, b₀, b₁, b₂; and the shares of slopes before in what is expected of those of the second
implicit stage (of the first one's; the rest is the explicit one's) and of the third."""


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    """Define what a tableau says of a stage."""
    scalar, vec3 = variant.scalar, variant.vec3

    @wp.func
    def row(stage: int, a: wp.array(dtype=scalar)) -> vec3:
        """Look up (a_i0, a_i1, a_i2)."""
        if stage == 0:
            return vec3(a[0], scalar(0.0), scalar(0.0))
        if stage == 1:
            return vec3(a[1], a[2], scalar(0.0))
        return vec3(a[3], a[4], a[5])

    return SimpleNamespace(row=row)


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, vec3, sliding = variant.scalar, variant.vec3, variant.sliding
    row = functions(variant).row
    module = variant.module("esdirk")

    @wp.kernel(module=module, enable_backward=False)
    def ask_for_slope(slope: wp.array(dtype=vec3), asks_for_slope: wp.array(dtype=int)):
        """Look whether the slope is not known."""
        asks_for_slope[0] = wp.where(wp.isnan(slope[0][0]), 1, 0)

    @wp.func
    def base(
        stage: int,
        h: scalar,
        eta: scalar,
        a: wp.array(dtype=scalar),
        v: vec3,
        slope: vec3,
        w1: vec3,
        w2: vec3,
    ):
        """Compute ((q_i − q)/h, v_i, q̈_i as the slopes before let expect it) of an implicit stage i, from 0 on."""
        v_1 = v + slope * (h * a[0])
        rate = v * a[0]
        start = v_1
        expected = slope
        if stage > 0:
            slope_1 = (w1 - v_1) / eta
            v_2 = v + (slope * a[1] + slope_1 * a[2]) * h
            rate = v * a[1] + w1 * a[2]
            start = v_2
            expected = slope + (slope_1 - slope) * a[6]
            if stage > 1:
                slope_2 = (w2 - v_2) / eta
                rate = v * a[3] + w1 * a[4] + w2 * a[5]
                start = v + (slope * a[3] + slope_1 * a[4] + slope_2 * a[5]) * h
                expected = slope * a[7] + slope_1 * a[8] + slope_2 * a[9]
        return rate, start, expected

    @wp.kernel(module=module, enable_backward=False)
    def enter_base(
        stage: int,
        step_size: wp.array(dtype=scalar),
        stage_size: wp.array(dtype=scalar),
        tableau: wp.array(dtype=scalar),
        is_free: wp.array(dtype=int),
        start_position: wp.array(dtype=vec3),
        start_velocity: wp.array(dtype=vec3),
        slope: wp.array(dtype=vec3),
        first_solution: wp.array(dtype=vec3),
        second_solution: wp.array(dtype=vec3),
        solution: wp.array(dtype=vec3),
        base_position: wp.array(dtype=vec3),
        base_velocity: wp.array(dtype=vec3),
        start: wp.array(dtype=vec3),
    ):
        """Place what a stage starts from, and w that its iteration starts at, by the slopes before."""
        i = index(wp.tid())
        h = step_size[0]
        w1 = first_solution[i]
        w2 = second_solution[i]
        if is_free[i] == 0:
            w1 = solution[i]
            w2 = w1
        rate, v, expected = base(stage, h, stage_size[0], tableau, start_velocity[i], slope[i], w1, w2)
        base_velocity[i] = v
        if is_free[i] == 0:
            # it goes at one velocity from the step's start on
            base_position[i] = start_position[i] + (rate + (w1 - start_velocity[i]) * row(stage, tableau)[0]) * h
            return
        base_position[i] = start_position[i] + rate * h
        if start:
            start[i] = v + expected * stage_size[0]

    @wp.kernel(module=module, enable_backward=False)
    def enter_euler_base(
        stage: int,
        step_size: wp.array(dtype=scalar),
        stage_size: wp.array(dtype=scalar),
        tableau: wp.array(dtype=scalar),
        start_euler: wp.array(dtype=scalar),
        start_euler_velocity: wp.array(dtype=scalar),
        euler_slope: wp.array(dtype=scalar),
        euler_first_solution: wp.array(dtype=scalar),
        euler_second_solution: wp.array(dtype=scalar),
        base_euler: wp.array(dtype=scalar),
        base_euler_velocity: wp.array(dtype=scalar),
    ):
        """Place the same of (u, v), of whose rates the iteration starts at those of the stage before."""
        if wp.static(sliding):
            i = index(wp.tid())
            a = 2 * i
            b = 2 * i + 1
            zero = scalar(0.0)
            rate, v, _expected = base(
                stage,
                step_size[0],
                stage_size[0],
                tableau,
                vec3(start_euler_velocity[a], start_euler_velocity[b], zero),
                vec3(euler_slope[a], euler_slope[b], zero),
                vec3(euler_first_solution[a], euler_first_solution[b], zero),
                vec3(euler_second_solution[a], euler_second_solution[b], zero),
            )
            for d in range(2):
                base_euler[a + d] = start_euler[a + d] + rate[d] * step_size[0]
                base_euler_velocity[a + d] = v[d]

    @wp.kernel(module=module, enable_backward=False)
    def add_slope(
        share: scalar,
        is_first: int,
        stage_size: wp.array(dtype=scalar),
        is_free: wp.array(dtype=int),
        solution: wp.array(dtype=vec3),
        euler_solution: wp.array(dtype=scalar),
        base_velocity: wp.array(dtype=vec3),
        base_euler_velocity: wp.array(dtype=scalar),
        slope: wp.array(dtype=vec3),
        euler_slope: wp.array(dtype=scalar),
    ):
        """Give a stage's slope to that of a step, in this share; is_first: none was given before. What is held has
        none."""
        i = index(wp.tid())
        if is_first != 0:
            slope[i] = vec3()
        if is_free[i] != 0:
            slope[i] = slope[i] + (solution[i] - base_velocity[i]) / stage_size[0] * share
        if wp.static(sliding):
            for s in range(2 * i, 2 * i + 2):
                if is_first != 0:
                    euler_slope[s] = scalar(0.0)
                of_stage = (euler_solution[s] - base_euler_velocity[s]) / stage_size[0]
                euler_slope[s] = euler_slope[s] + of_stage * share

    @wp.kernel(module=module, enable_backward=False)
    def record_slope(
        nodes: int,
        counters: wp.array(dtype=int),
        slope: wp.array(dtype=vec3),
        euler_slope: wp.array(dtype=scalar),
        frame_slope: wp.array(dtype=vec3),
        frame_euler_slope: wp.array(dtype=scalar),
    ):
        """Record it beside the frame."""
        i = index(wp.tid())
        k = index(counters[0] * nodes + i)
        frame_slope[k] = slope[i]
        if wp.static(sliding):
            for d in range(2):
                frame_euler_slope[2 * k + d] = euler_slope[2 * i + d]

    return SimpleNamespace(
        ask_for_slope=ask_for_slope,
        enter_base=enter_base,
        enter_euler_base=enter_euler_base,
        add_slope=add_slope,
        record_slope=record_slope,
    )
