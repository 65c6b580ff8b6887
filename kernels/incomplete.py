"""The solver's incomplete Cholesky preconditioner, and the conjugate gradient with it, one node after the other.

    P = (E + U)ᵀ E⁻¹ (E + U),   E_j = A_jj − Σ_i U_ijᵀ E_i⁻¹ U_ij

U is the upper blocks of A as they are, E block-diagonal: only the diagonal blocks are corrected. Along one yarn that is
the exact factorization, and warp and weft stretch along different directions, so little is dropped: at 17 × 17 it needs
12 iterations where Jacobi needs 170, and hardly more on larger cloths. With Eisenstat's splitting
A = (E + U)ᵀ + (E + U) + (D − 2E) an iteration costs one pass over the blocks, as with Jacobi.

The layout of the matrix is told in ``solver.py``.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import solver
from .variant import Variant


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, vec3, mat33, sliding = variant.scalar, variant.vec3, variant.mat33, variant.sliding
    multiply, report = solver.functions(variant).multiply, solver.functions(variant).report
    module = variant.module("incomplete")

    @wp.func
    def inverse_of(m: mat33) -> mat33:
        """Inverse of a symmetric positive definite matrix; 0 where it is not safely so."""
        c00 = m[1, 1] * m[2, 2] - m[1, 2] * m[1, 2]
        c01 = m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2]
        c02 = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
        c11 = m[0, 0] * m[2, 2] - m[0, 2] * m[0, 2]
        c12 = m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2]
        c22 = m[0, 0] * m[1, 1] - m[0, 1] * m[0, 1]
        determinant = m[0, 0] * c00 + m[0, 1] * c01 + m[0, 2] * c02
        safe = scalar(wp.static(1.0e-6))
        if m[0, 0] > scalar(0.0) and c22 > safe * m[0, 0] * m[1, 1] and determinant > safe * c22 * m[2, 2]:
            f = scalar(1.0) / determinant
            return mat33(c00 * f, c01 * f, c02 * f, c01 * f, c11 * f, c12 * f, c02 * f, c12 * f, c22 * f)
        return mat33()

    @wp.kernel(module=module, enable_backward=False)
    def factorize(
        nodes: int,
        stencil: int,
        neighbour: wp.array(dtype=int),
        is_free: wp.array(dtype=int),
        diagonal_xx: wp.array(dtype=mat33),
        upper_xx: wp.array(dtype=mat33),
        pivot: wp.array(dtype=mat33),
        inverse_pivot: wp.array(dtype=mat33),
    ):
        """E and E⁻¹ of the positions; 0 for what is held, which keeps it out. Sliding coordinates keep their diagonal:
        friction's damping dominates it, and their share of E changes the iterations by less than one."""
        for i in range(nodes):
            pivot[i] = diagonal_xx[i]
        for i in range(nodes):
            inverse = mat33()
            if is_free[i] != 0:
                inverse = inverse_of(pivot[i])
                if inverse[0, 0] <= scalar(0.0):
                    # What was dropped made it indefinite: any positive definite E will do, so take the block itself.
                    pivot[i] = diagonal_xx[i]
                    inverse = wp.inverse(diagonal_xx[i])
                for slot in range(stencil):
                    k = stencil * i + slot
                    j = neighbour[k]
                    if j >= 0:
                        block = upper_xx[k]
                        pivot[j] = pivot[j] - wp.transpose(block) * inverse * block
            inverse_pivot[i] = inverse

    @wp.func
    def backward_sweep(
        nodes: int,
        stencil: int,
        neighbour: wp.array(dtype=int),
        upper_xx: wp.array(dtype=mat33),
        upper_xs: wp.array(dtype=vec3),
        upper_sx: wp.array(dtype=vec3),
        upper_ss: wp.array(dtype=scalar),
        inverse_pivot: wp.array(dtype=mat33),
        inverse_s: wp.array(dtype=scalar),
        p_x: wp.array(dtype=vec3),
        p_s: wp.array(dtype=scalar),
        t_x: wp.array(dtype=vec3),
        t_s: wp.array(dtype=scalar),
    ):
        """t = (E + U)⁻¹ p."""
        for n in range(nodes):
            i = nodes - 1 - n
            y = p_x[i]
            for slot in range(stencil):
                k = stencil * i + slot
                j = neighbour[k]
                if j >= 0:
                    y -= upper_xx[k] * t_x[j]
            if wp.static(sliding):
                y_u = p_s[2 * i]
                y_v = p_s[2 * i + 1]
                for slot in range(4):
                    if slot < stencil:
                        j = neighbour[stencil * i + slot]
                        if j >= 0:
                            k = 4 * i + slot
                            along = t_s[2 * j + slot % 2]
                            y -= upper_xs[k] * along
                            row = wp.dot(upper_sx[k], t_x[j]) + upper_ss[k] * along
                            if slot % 2 == 0:
                                y_u -= row
                            else:
                                y_v -= row
                t_s[2 * i] = inverse_s[2 * i] * y_u
                t_s[2 * i + 1] = inverse_s[2 * i + 1] * y_v
            t_x[i] = inverse_pivot[i] * y

    @wp.func
    def spread(
        i: int,
        stencil: int,
        neighbour: wp.array(dtype=int),
        upper_xx: wp.array(dtype=mat33),
        upper_xs: wp.array(dtype=vec3),
        upper_sx: wp.array(dtype=vec3),
        upper_ss: wp.array(dtype=scalar),
        x: vec3,
        u: scalar,
        v: scalar,
        q_x: wp.array(dtype=vec3),
        q_s: wp.array(dtype=scalar),
    ):
        """q −= Uᵀ y for the row i of y."""
        for slot in range(stencil):
            k = stencil * i + slot
            j = neighbour[k]
            if j >= 0:
                q_x[j] = q_x[j] - x * upper_xx[k]
        if wp.static(sliding):
            for slot in range(4):
                if slot < stencil:
                    j = neighbour[stencil * i + slot]
                    if j >= 0:
                        k = 4 * i + slot
                        s = 2 * j + slot % 2
                        mine = u
                        if slot % 2 == 1:
                            mine = v
                        q_x[j] = q_x[j] - upper_sx[k] * mine
                        q_s[s] = q_s[s] - wp.dot(upper_xs[k], x) - upper_ss[k] * mine

    @wp.kernel(module=module, enable_backward=False)
    def incomplete_conjugate_gradient(
        # matrix
        nodes: int,
        stencil: int,
        neighbour: wp.array(dtype=int),
        diagonal_xx: wp.array(dtype=mat33),
        diagonal_xs: wp.array(dtype=vec3),
        diagonal_ss: wp.array(dtype=scalar),
        upper_xx: wp.array(dtype=mat33),
        upper_xs: wp.array(dtype=vec3),
        upper_sx: wp.array(dtype=vec3),
        upper_ss: wp.array(dtype=scalar),
        pivot: wp.array(dtype=mat33),
        inverse_pivot: wp.array(dtype=mat33),
        inverse_s: wp.array(dtype=scalar),
        # right-hand side, and when to stop
        rhs: wp.array(dtype=vec3),
        euler_rhs: wp.array(dtype=scalar),
        tolerance: scalar,
        most_iterations: int,
        # start in, solution out
        solution: wp.array(dtype=vec3),
        euler_solution: wp.array(dtype=scalar),
        # work space
        r_x: wp.array(dtype=vec3),
        r_s: wp.array(dtype=scalar),
        p_x: wp.array(dtype=vec3),
        p_s: wp.array(dtype=scalar),
        q_x: wp.array(dtype=vec3),
        q_s: wp.array(dtype=scalar),
        t_x: wp.array(dtype=vec3),
        t_s: wp.array(dtype=scalar),
        # report out
        iterations: wp.array(dtype=int),
        residual: wp.array(dtype=scalar),
        status: wp.array(dtype=int),
    ):
        """A · solution = rhs, to √(r·P⁻¹r) ≤ tolerance √(b·P⁻¹b), in one launch of one thread.

        Iterates on (E + U)⁻ᵀ A (E + U)⁻¹ with the preconditioner E; r, p and q below are those of the split system.
        """
        zero = scalar(0.0)
        for i in range(nodes):
            q_x[i] = vec3()
            if wp.static(sliding):
                q_s[2 * i] = zero
                q_s[2 * i + 1] = zero
        multiply(
            nodes, stencil, neighbour, diagonal_xx, diagonal_xs, diagonal_ss,
            upper_xx, upper_xs, upper_sx, upper_ss, solution, euler_solution, q_x, q_s,
        )  # fmt: skip
        # r = (E + U)⁻ᵀ (b − A x), and p = (E + U)⁻ᵀ b for the size to compare it with
        for i in range(nodes):
            p_x[i] = rhs[i]
            r_x[i] = rhs[i] - q_x[i]
            q_x[i] = vec3()
            if wp.static(sliding):
                for s in range(2 * i, 2 * i + 2):
                    p_s[s] = euler_rhs[s]
                    r_s[s] = euler_rhs[s] - q_s[s]
                    q_s[s] = zero
        size = zero
        rz = zero
        for i in range(nodes):
            b = inverse_pivot[i] * p_x[i]
            r = inverse_pivot[i] * r_x[i]
            size += wp.dot(b, p_x[i])
            rz += wp.dot(r, r_x[i])
            b_u = zero
            b_v = zero
            r_u = zero
            r_v = zero
            if wp.static(sliding):
                b_u = inverse_s[2 * i] * p_s[2 * i]
                b_v = inverse_s[2 * i + 1] * p_s[2 * i + 1]
                r_u = inverse_s[2 * i] * r_s[2 * i]
                r_v = inverse_s[2 * i + 1] * r_s[2 * i + 1]
                size += b_u * p_s[2 * i] + b_v * p_s[2 * i + 1]
                rz += r_u * r_s[2 * i] + r_v * r_s[2 * i + 1]
            spread(i, stencil, neighbour, upper_xx, upper_xs, upper_sx, upper_ss, b, b_u, b_v, p_x, p_s)
            spread(i, stencil, neighbour, upper_xx, upper_xs, upper_sx, upper_ss, r, r_u, r_v, r_x, r_s)
            # p starts as E r, which the sweep has just left here
            p_x[i] = pivot[i] * r
            r_x[i] = r
            if wp.static(sliding):
                p_s[2 * i] = diagonal_ss[2 * i] * r_u
                p_s[2 * i + 1] = diagonal_ss[2 * i + 1] * r_v
                r_s[2 * i] = r_u
                r_s[2 * i + 1] = r_v

        limit = tolerance * tolerance * size
        count = int(0)
        while count < most_iterations and rz > limit:
            backward_sweep(
                nodes, stencil, neighbour, upper_xx, upper_xs, upper_sx, upper_ss,
                inverse_pivot, inverse_s, p_x, p_s, t_x, t_s,
            )  # fmt: skip
            # q = t + (E + U)⁻ᵀ (p + (D − 2E) t)
            pq = zero
            for i in range(nodes):
                t = t_x[i]
                g = q_x[i] + p_x[i] + diagonal_xx[i] * t - pivot[i] * t * scalar(2.0)
                y_u = zero
                y_v = zero
                if wp.static(sliding):
                    u = t_s[2 * i]
                    v = t_s[2 * i + 1]
                    xs_u = diagonal_xs[2 * i]
                    xs_v = diagonal_xs[2 * i + 1]
                    g += xs_u * u + xs_v * v
                    p_u = p_s[2 * i]
                    p_v = p_s[2 * i + 1]
                    g_u = q_s[2 * i] + p_u + wp.dot(xs_u, t) - diagonal_ss[2 * i] * u
                    g_v = q_s[2 * i + 1] + p_v + wp.dot(xs_v, t) - diagonal_ss[2 * i + 1] * v
                    y_u = inverse_s[2 * i] * g_u
                    y_v = inverse_s[2 * i + 1] * g_v
                    q_s[2 * i] = u + y_u
                    q_s[2 * i + 1] = v + y_v
                    pq += p_u * (u + y_u) + p_v * (v + y_v)
                y = inverse_pivot[i] * g
                spread(i, stencil, neighbour, upper_xx, upper_xs, upper_sx, upper_ss, y, y_u, y_v, q_x, q_s)
                q_x[i] = t + y
                pq += wp.dot(p_x[i], t + y)
            if not (pq > zero):
                # past the attainable accuracy, or not finite
                break
            alpha = rz / pq
            rz_next = zero
            for i in range(nodes):
                solution[i] = solution[i] + t_x[i] * alpha
                r = r_x[i] - q_x[i] * alpha
                z = pivot[i] * r
                rz_next += wp.dot(r, z)
                r_x[i] = r
                q_x[i] = z
                if wp.static(sliding):
                    for s in range(2 * i, 2 * i + 2):
                        euler_solution[s] = euler_solution[s] + t_s[s] * alpha
                        r_1 = r_s[s] - q_s[s] * alpha
                        z_1 = diagonal_ss[s] * r_1
                        rz_next += r_1 * z_1
                        r_s[s] = r_1
                        q_s[s] = z_1
            beta = rz_next / rz
            rz = rz_next
            for i in range(nodes):
                p_x[i] = q_x[i] + p_x[i] * beta
                q_x[i] = vec3()
                if wp.static(sliding):
                    for s in range(2 * i, 2 * i + 2):
                        p_s[s] = q_s[s] + p_s[s] * beta
                        q_s[s] = zero
            count += 1

        if report(count, rz, size, limit, iterations, residual, status):
            worst = scalar(-1.0)
            for i in range(nodes):
                here = wp.dot(r_x[i], pivot[i] * r_x[i])
                if not (here <= worst):
                    worst = here
                    status[1] = i

    return SimpleNamespace(factorize=factorize, incomplete_conjugate_gradient=incomplete_conjugate_gradient)
