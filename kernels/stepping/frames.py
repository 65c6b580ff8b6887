"""Frames of a run, kept on the device: recording them forward, and recalling them for the adjoint.

A captured step must not change its pointers, so what moves is a pair of counters on the device: ``counters[0]`` is the
present frame of the chunk that is kept, ``counters[1]`` the step since the simulation began, by which moving pins and
applied forces are looked up.

Running adjoints stand in the gradients of the state's own arrays (``position.grad`` and so on).
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.indexing import index
from ..core.variant import Variant


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, vec3, sliding = variant.scalar, variant.vec3, variant.sliding
    module = variant.module("history")

    @wp.kernel(module=module, enable_backward=False)
    def count(counters: wp.array(dtype=int), status: wp.array(dtype=int), by: int):
        """Moves on by a step (or back), and notes at which one something went wrong."""
        counters[0] = counters[0] + by
        counters[1] = counters[1] + by
        if status[0] != 0 and status[2] == 0:
            status[2] = counters[0]

    @wp.kernel(module=module, enable_backward=False)
    def load_inputs(counters: wp.array(dtype=int), path: wp.array(dtype=vec3), values: wp.array(dtype=vec3)):
        """Load this step's row of a path; its last row ever after."""
        e = index(wp.tid())
        rows = path.shape[0] / values.shape[0]
        values[e] = path[wp.min(counters[1], rows - 1) * values.shape[0] + e]

    @wp.kernel(module=module, enable_backward=False)
    def scatter_gradient(
        counters: wp.array(dtype=int), values_grad: wp.array(dtype=vec3), path_grad: wp.array(dtype=vec3)
    ):
        """Reverse ``load_inputs``."""
        e = index(wp.tid())
        rows = path_grad.shape[0] / values_grad.shape[0]
        k = wp.min(counters[1], rows - 1) * values_grad.shape[0] + e
        path_grad[k] = path_grad[k] + values_grad[e]
        values_grad[e] = vec3()

    @wp.kernel(module=module, enable_backward=False)
    def move_along(
        counters: wp.array(dtype=int),
        stage: int,
        stage_times: wp.array(dtype=scalar),
        start: wp.array(dtype=vec3),
        path: wp.array(dtype=vec3),
        values: wp.array(dtype=vec3),
        motion: wp.array(dtype=vec3),
    ):
        """Find where a path is at the time of a stage, on the straight line from the row before to this step's, which
        is where the step ends; and how far it goes in the step. The first one begins at the start."""
        e = index(wp.tid())
        count = values.shape[0]
        rows = path.shape[0] / count
        step = counters[1]
        before = start[e]
        if step > 0:
            before = path[wp.min(step - 1, rows - 1) * count + e]
        after = path[wp.min(step, rows - 1) * count + e]
        values[e] = before + (after - before) * stage_times[stage]
        motion[e] = after - before

    @wp.kernel(module=module, enable_backward=False)
    def scatter_gradient_along(
        counters: wp.array(dtype=int),
        stage: int,
        stage_times: wp.array(dtype=scalar),
        values_grad: wp.array(dtype=vec3),
        path_grad: wp.array(dtype=vec3),
    ):
        """Reverse ``move_along``."""
        e = index(wp.tid())
        count = values_grad.shape[0]
        rows = path_grad.shape[0] / count
        step = counters[1]
        time = stage_times[stage]
        if step > 0:
            k = wp.min(step - 1, rows - 1) * count + e
            path_grad[k] = path_grad[k] + values_grad[e] * (scalar(1.0) - time)
        k = wp.min(step, rows - 1) * count + e
        path_grad[k] = path_grad[k] + values_grad[e] * time
        values_grad[e] = vec3()

    @wp.kernel(module=module, enable_backward=False)
    def record(
        nodes: int,
        counters: wp.array(dtype=int),
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        velocity: wp.array(dtype=vec3),
        euler_velocity: wp.array(dtype=scalar),
        anchor: wp.array(dtype=scalar),
        frame_position: wp.array(dtype=vec3),
        frame_euler: wp.array(dtype=scalar),
        frame_velocity: wp.array(dtype=vec3),
        frame_euler_velocity: wp.array(dtype=scalar),
        frame_anchor: wp.array(dtype=scalar),
    ):
        i = index(wp.tid())
        k = index(counters[0] * nodes + i)
        frame_position[k] = position[i]
        frame_velocity[k] = velocity[i]
        if wp.static(sliding):
            for d in range(2):
                frame_euler[2 * k + d] = euler[2 * i + d]
                frame_euler_velocity[2 * k + d] = euler_velocity[2 * i + d]
                if anchor:
                    frame_anchor[2 * k + d] = anchor[2 * i + d]

    @wp.kernel(module=module, enable_backward=False)
    def restore_frame(
        nodes: int,
        counters: wp.array(dtype=int),
        frame_position: wp.array(dtype=vec3),
        frame_euler: wp.array(dtype=scalar),
        frame_velocity: wp.array(dtype=vec3),
        frame_euler_velocity: wp.array(dtype=scalar),
        frame_anchor: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        velocity: wp.array(dtype=vec3),
        euler_velocity: wp.array(dtype=scalar),
        anchor: wp.array(dtype=scalar),
        solution: wp.array(dtype=vec3),
        euler_solution: wp.array(dtype=scalar),
        euler_next: wp.array(dtype=scalar),
    ):
        """Restore the state that a step started from, and what the step made of it."""
        i = index(wp.tid())
        k = index(counters[0] * nodes + i)
        next = k + nodes
        position[i] = frame_position[k]
        velocity[i] = frame_velocity[k]
        solution[i] = frame_velocity[next]
        if wp.static(sliding):
            for d in range(2):
                s = 2 * i + d
                euler[s] = frame_euler[2 * k + d]
                euler_velocity[s] = frame_euler_velocity[2 * k + d]
                euler_solution[s] = frame_euler_velocity[2 * next + d]
                euler_next[s] = frame_euler[2 * next + d]
                if anchor:
                    anchor[s] = frame_anchor[2 * k + d]

    @wp.kernel(module=module, enable_backward=False)
    def add_loss_gradient(
        nodes: int,
        counters: wp.array(dtype=int),
        frame_position_grad: wp.array(dtype=vec3),
        frame_euler_grad: wp.array(dtype=scalar),
        frame_velocity_grad: wp.array(dtype=vec3),
        frame_euler_velocity_grad: wp.array(dtype=scalar),
        frame_anchor_grad: wp.array(dtype=scalar),
        position_grad: wp.array(dtype=vec3),
        euler_grad: wp.array(dtype=scalar),
        velocity_grad: wp.array(dtype=vec3),
        euler_velocity_grad: wp.array(dtype=scalar),
        anchor_grad: wp.array(dtype=scalar),
    ):
        """Adds what the loss asks of the present frame to the running adjoints."""
        i = index(wp.tid())
        k = index(counters[0] * nodes + i)
        position_grad[i] = position_grad[i] + frame_position_grad[k]
        velocity_grad[i] = velocity_grad[i] + frame_velocity_grad[k]
        for d in range(2):
            s = 2 * i + d
            euler_grad[s] = euler_grad[s] + frame_euler_grad[2 * k + d]
            if wp.static(sliding):
                euler_velocity_grad[s] = euler_velocity_grad[s] + frame_euler_velocity_grad[2 * k + d]
                if anchor_grad:
                    anchor_grad[s] = anchor_grad[s] + frame_anchor_grad[2 * k + d]

    return SimpleNamespace(
        count=count,
        load_inputs=load_inputs,
        scatter_gradient=scatter_gradient,
        move_along=move_along,
        scatter_gradient_along=scatter_gradient_along,
        record=record,
        restore_frame=restore_frame,
        add_loss_gradient=add_loss_gradient,
    )
