"""The step of eq. 2 around its linear solve: right-hand side, preconditioner, start, advance and checks.

    (M + h² H + h D) q̇⁺ = h F + (M + h D) q̇,   q⁺ = q + h q̇⁺

H and D are the symmetric positive semi-definite stiffness and damping that the terms wrote into the matrix.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.indexing import ends, index
from ..core.status import NOT_FINITE, ORDER_LOST, fail
from ..core.variant import Variant


@functools.cache
def define_reversible(variant: Variant) -> SimpleNamespace:
    """Define what the adjoint runs in reverse."""
    scalar, vec3, sliding = variant.scalar, variant.vec3, variant.sliding

    @variant.kernel("terms")
    def right_hand_side(
        step_size: wp.array(dtype=scalar),
        force: wp.array(dtype=vec3),
        euler_force: wp.array(dtype=scalar),
        friction_force_out: wp.array(dtype=scalar),
        momentum: wp.array(dtype=vec3),
        euler_momentum: wp.array(dtype=scalar),
        rhs: wp.array(dtype=vec3),
        euler_rhs: wp.array(dtype=scalar),
    ):
        i = index(wp.tid())
        rhs[i] = force[i] * step_size[0] + momentum[i]
        if wp.static(sliding):
            for direction in range(2):
                s = 2 * i + direction
                f = euler_force[s]
                if friction_force_out:
                    f += friction_force_out[s]
                euler_rhs[s] = f * step_size[0] + euler_momentum[s]

    @variant.kernel("terms")
    def set_pin_velocity(
        pin_node: wp.array(dtype=int),
        pin_target: wp.array(dtype=vec3),
        remaining: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        solution: wp.array(dtype=vec3),
    ):
        """Set the velocity that brings an exact pin to its target within the step, or what is left of it."""
        e = index(wp.tid())
        i = index(pin_node[e])
        solution[i] = (pin_target[e] - position[i]) / remaining[0]

    return SimpleNamespace(right_hand_side=right_hand_side, set_pin_velocity=set_pin_velocity)


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, vec3, mat33, sliding = variant.scalar, variant.vec3, variant.mat33, variant.sliding
    module = variant.module("step")

    @wp.kernel(module=module, enable_backward=False)
    def precondition(
        is_free: wp.array(dtype=int),
        is_crossing: wp.array(dtype=int),
        diagonal_xx: wp.array(dtype=mat33),
        diagonal_ss: wp.array(dtype=scalar),
        inverse_x: wp.array(dtype=vec3),
        inverse_s: wp.array(dtype=scalar),
    ):
        """Compute Jacobi's preconditioner: the inverse of the diagonal, and 0 for what does not move, which keeps it
        out of the iteration."""
        i = index(wp.tid())
        one = scalar(1.0)
        if is_free[i] != 0:
            block = diagonal_xx[i]
            inverse_x[i] = vec3(one / block[0, 0], one / block[1, 1], one / block[2, 2])
        else:
            inverse_x[i] = vec3()
        if wp.static(sliding):
            for direction in range(2):
                s = 2 * i + direction
                if is_crossing[i] != 0:
                    inverse_s[s] = one / diagonal_ss[s]
                else:
                    inverse_s[s] = scalar(0.0)

    @wp.kernel(module=module, enable_backward=False)
    def advance(
        step_size: wp.array(dtype=scalar),
        solution: wp.array(dtype=vec3),
        euler_solution: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        velocity: wp.array(dtype=vec3),
        euler_velocity: wp.array(dtype=scalar),
        status: wp.array(dtype=int),
    ):
        """Advance to q⁺ = q + h q̇⁺, and whether it is finite."""
        i = index(wp.tid())
        h = step_size[0]
        v = solution[i]
        x = position[i] + v * h
        finite = wp.isfinite(x)
        velocity[i] = v
        position[i] = x
        if wp.static(sliding):
            for direction in range(2):
                s = 2 * i + direction
                rate = euler_solution[s]
                u = euler[s] + rate * h
                euler_velocity[s] = rate
                euler[s] = u
                finite = finite and wp.isfinite(u)
        if not finite:
            fail(status, wp.static(NOT_FINITE), i)

    @wp.kernel(module=module, enable_backward=False)
    def check_order(
        segments: wp.array(dtype=wp.vec4i),
        euler: wp.array(dtype=scalar),
        status: wp.array(dtype=int),
    ):
        """Check that Δs > 0: crossings keep their order along a yarn."""
        a, _b, sa, sb, _yarn, _direction = ends(segments, index(wp.tid()))
        if euler[sb] <= euler[sa]:
            fail(status, wp.static(ORDER_LOST), a)

    @wp.kernel(module=module, enable_backward=False)
    def copy_vectors(source: wp.array(dtype=vec3), target: wp.array(dtype=vec3)):
        i = index(wp.tid())
        target[i] = source[i]

    @wp.kernel(module=module, enable_backward=False)
    def copy_numbers(source: wp.array(dtype=scalar), target: wp.array(dtype=scalar)):
        i = index(wp.tid())
        target[i] = source[i]

    @wp.kernel(module=module, enable_backward=False)
    def clear_vectors(array: wp.array(dtype=vec3)):
        array[index(wp.tid())] = vec3()

    @wp.kernel(module=module, enable_backward=False)
    def clear_matrices(array: wp.array(dtype=mat33)):
        array[index(wp.tid())] = mat33()

    @wp.kernel(module=module, enable_backward=False)
    def clear_numbers(array: wp.array(dtype=scalar)):
        array[index(wp.tid())] = scalar(0.0)

    return SimpleNamespace(
        clear_vectors=clear_vectors,
        clear_matrices=clear_matrices,
        clear_numbers=clear_numbers,
        copy_vectors=copy_vectors,
        copy_numbers=copy_numbers,
        precondition=precondition,
        advance=advance,
        check_order=check_order,
    )
