"""The adjoint of a step of eq. 2 around its assembly.

A step solves A w = b and sets q⁺ = q + h w, q̇⁺ = w. With adjoints q̄⁺ and q̄̇⁺ of what it made,

    A λ = q̄̇⁺ + h q̄⁺   (A is symmetric: the same solver),   b̄ = λ,   Ā = −λ wᵀ,   q̄ = q̄⁺ + ...

and the dots come from reverse mode through the kernels that assembled A and b, recorded on a tape. What is held has
λ = 0, and its row of the residual is the adjoint of the velocity that holds it.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.status import NOT_FINITE, fail
from ..core.variant import Variant


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, vec3, mat33, sliding = variant.scalar, variant.vec3, variant.mat33, variant.sliding
    module = variant.module("adjoint")

    @wp.kernel(module=module, enable_backward=False)
    def adjoint_right_hand_side(
        step_size: wp.array(dtype=scalar),
        position_grad: wp.array(dtype=vec3),
        euler_grad: wp.array(dtype=scalar),
        velocity_grad: wp.array(dtype=vec3),
        euler_velocity_grad: wp.array(dtype=scalar),
        adjoint_rhs: wp.array(dtype=vec3),
        euler_adjoint_rhs: wp.array(dtype=scalar),
        rhs_grad: wp.array(dtype=vec3),
        euler_rhs_grad: wp.array(dtype=scalar),
        status: wp.array(dtype=int),
    ):
        """Compute the right-hand side q̄̇⁺ + h q̄⁺; λ starts at 0. The adjoint of the old velocity starts at 0 as well."""
        i = wp.tid()
        h = step_size[0]
        v = velocity_grad[i] + position_grad[i] * h
        finite = wp.isfinite(v)
        adjoint_rhs[i] = v
        velocity_grad[i] = vec3()
        rhs_grad[i] = vec3()
        if wp.static(sliding):
            for d in range(2):
                s = 2 * i + d
                rate = euler_velocity_grad[s] + euler_grad[s] * h
                finite = finite and wp.isfinite(rate)
                euler_adjoint_rhs[s] = rate
                euler_velocity_grad[s] = scalar(0.0)
                euler_rhs_grad[s] = scalar(0.0)
        if not finite:
            fail(status, wp.static(NOT_FINITE), i)

    @wp.kernel(module=module, enable_backward=False)
    def matrix_adjoint(
        stencil: int,
        neighbour: wp.array(dtype=int),
        solution: wp.array(dtype=vec3),
        euler_solution: wp.array(dtype=scalar),
        rhs_grad: wp.array(dtype=vec3),
        euler_rhs_grad: wp.array(dtype=scalar),
        diagonal_xx_grad: wp.array(dtype=mat33),
        diagonal_xs_grad: wp.array(dtype=vec3),
        diagonal_ss_grad: wp.array(dtype=scalar),
        upper_xx_grad: wp.array(dtype=mat33),
        upper_xs_grad: wp.array(dtype=vec3),
        upper_sx_grad: wp.array(dtype=vec3),
        upper_ss_grad: wp.array(dtype=scalar),
    ):
        """Compute Ā = −λ wᵀ on the blocks that are stored; a block above the diagonal stands for its mirror too."""
        i = wp.tid()
        w = solution[i]
        minus = -rhs_grad[i]
        diagonal_xx_grad[i] = wp.outer(minus, w)
        for slot in range(stencil):
            k = stencil * i + slot
            j = neighbour[k]
            if j >= 0:
                upper_xx_grad[k] = wp.outer(minus, solution[j]) - wp.outer(w, rhs_grad[j])
        if wp.static(sliding):
            for d in range(2):
                s = 2 * i + d
                w_s = euler_solution[s]
                minus_s = -euler_rhs_grad[s]
                diagonal_xs_grad[s] = minus * w_s + w * minus_s
                diagonal_ss_grad[s] = minus_s * w_s
                for reach in range(2):
                    slot = 2 * reach + d
                    if slot < stencil:
                        j = neighbour[stencil * i + slot]
                        if j >= 0:
                            k = 4 * i + slot
                            w_j = euler_solution[2 * j + d]
                            minus_j = -euler_rhs_grad[2 * j + d]
                            upper_xs_grad[k] = minus * w_j + w * minus_j
                            upper_sx_grad[k] = solution[j] * minus_s - rhs_grad[j] * w_s
                            upper_ss_grad[k] = minus_s * w_j + w_s * minus_j

    @wp.kernel(module=module, enable_backward=False)
    def hard_pin_adjoint(
        pin_node: wp.array(dtype=int),
        adjoint_rhs: wp.array(dtype=vec3),
        q_x: wp.array(dtype=vec3),
        solution_grad: wp.array(dtype=vec3),
    ):
        """Add up the adjoint of an exact pin's velocity: its row of adjoint_rhs − A λ, with q = A λ."""
        i = pin_node[wp.tid()]
        solution_grad[i] = solution_grad[i] + adjoint_rhs[i] - q_x[i]

    return SimpleNamespace(
        adjoint_right_hand_side=adjoint_right_hand_side,
        matrix_adjoint=matrix_adjoint,
        hard_pin_adjoint=hard_pin_adjoint,
    )
