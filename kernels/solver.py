"""The implicit system: its matrix on the weave's stencil, and the preconditioned conjugate gradients that solve it.

The matrix is symmetric, so each node keeps its own blocks and those of its upper neighbours only, in fixed slots:
0 and 1 the next crossing of its warp and weft yarn, 2 and 3 the second next, 4 and 5 the diagonal ones. The first
four slots carry sliding blocks of the yarn's own coordinate too (slot mod 2 is its direction); a diagonal neighbour
couples positions alone. A slot that a scene's terms do not fill is not stored (``stencil`` is 2, 4 or 6 wide).

    diagonal_xx [node]        3 × 3    upper_xx [stencil·node + slot]  3 × 3   row x of node, column x of neighbour
    diagonal_xs [2·node + d]  3        upper_xs [4·node + slot]        3       row x of node, column s of neighbour
    diagonal_ss [2·node + d]  1        upper_sx [4·node + slot]        3       row s of node, column x of neighbour
                                       upper_ss [4·node + slot]        1

Two preconditioners P. Here the diagonal of A (``jacobi``): every node on its own, so it is what a parallel machine
wants. In ``incomplete.py`` one that takes a twelfth of the iterations, node after node.
"""

import functools
from types import SimpleNamespace

import warp as wp

from .step import NOT_CONVERGED, NOT_FINITE
from .variant import Variant


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    """What both preconditioned iterations share."""
    scalar, vec3, mat33, sliding = variant.scalar, variant.vec3, variant.mat33, variant.sliding

    @wp.func
    def multiply(
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
        p_x: wp.array(dtype=vec3),
        p_s: wp.array(dtype=scalar),
        q_x: wp.array(dtype=vec3),
        q_s: wp.array(dtype=scalar),
    ):
        """q += A p. One pass: a row adds its upper half to itself, and the transposed blocks to its neighbours."""
        for i in range(nodes):
            x = p_x[i]
            y = q_x[i] + diagonal_xx[i] * x
            if wp.static(sliding):
                u = p_s[2 * i]
                v = p_s[2 * i + 1]
                xs_u = diagonal_xs[2 * i]
                xs_v = diagonal_xs[2 * i + 1]
                y += xs_u * u + xs_v * v
                y_u = q_s[2 * i] + wp.dot(xs_u, x) + diagonal_ss[2 * i] * u
                y_v = q_s[2 * i + 1] + wp.dot(xs_v, x) + diagonal_ss[2 * i + 1] * v
            for slot in range(stencil):
                k = stencil * i + slot
                j = neighbour[k]
                if j >= 0:
                    block = upper_xx[k]
                    y += block * p_x[j]
                    q_x[j] = q_x[j] + x * block
            if wp.static(sliding):
                for slot in range(4):
                    if slot < stencil:
                        j = neighbour[stencil * i + slot]
                        if j >= 0:
                            k = 4 * i + slot
                            s = 2 * j + slot % 2
                            xs = upper_xs[k]
                            sx = upper_sx[k]
                            ss = upper_ss[k]
                            mine = u
                            if slot % 2 == 1:
                                mine = v
                            y += xs * p_s[s]
                            q_s[s] = q_s[s] + wp.dot(xs, x) + ss * mine
                            row = wp.dot(sx, p_x[j]) + ss * p_s[s]
                            if slot % 2 == 0:
                                y_u += row
                            else:
                                y_v += row
                            q_x[j] = q_x[j] + sx * mine
                q_s[2 * i] = y_u
                q_s[2 * i + 1] = y_v
            q_x[i] = y

    @wp.func
    def report(
        count: int,
        rz: scalar,
        size: scalar,
        limit: scalar,
        iterations: wp.array(dtype=int),
        residual: wp.array(dtype=scalar),
        status: wp.array(dtype=int),
    ) -> bool:
        """Writes how the iteration ended; whether it failed, and no step before it had."""
        iterations[0] = count
        residual[0] = wp.sqrt(wp.max(rz, scalar(0.0)) / wp.max(size, scalar(1.0e-30)))
        if rz <= limit or status[0] != 0:
            return False
        status[0] = wp.where(wp.isfinite(rz), wp.static(NOT_CONVERGED), wp.static(NOT_FINITE))
        return True

    return SimpleNamespace(multiply=multiply, report=report)


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, vec3, mat33, sliding = variant.scalar, variant.vec3, variant.mat33, variant.sliding
    multiply, report = functions(variant).multiply, functions(variant).report
    module = variant.module("solver")

    @wp.kernel(module=module, enable_backward=False)
    def apply_matrix(
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
        p_x: wp.array(dtype=vec3),
        p_s: wp.array(dtype=scalar),
        q_x: wp.array(dtype=vec3),
        q_s: wp.array(dtype=scalar),
    ):
        """q += A p."""
        multiply(
            nodes, stencil, neighbour, diagonal_xx, diagonal_xs, diagonal_ss,
            upper_xx, upper_xs, upper_sx, upper_ss, p_x, p_s, q_x, q_s,
        )  # fmt: skip

    @wp.kernel(module=module, enable_backward=False)
    def jacobi_conjugate_gradient(
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
        inverse_x: wp.array(dtype=vec3),
        inverse_s: wp.array(dtype=scalar),
        # right-hand side, and when to stop
        rhs: wp.array(dtype=vec3),
        euler_rhs: wp.array(dtype=scalar),
        tolerance: wp.array(dtype=scalar),
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
        # report out
        iterations: wp.array(dtype=int),
        residual: wp.array(dtype=scalar),
        status: wp.array(dtype=int),
    ):
        """A · solution = rhs, to √(r·P⁻¹r) ≤ tolerance √(b·P⁻¹b), in one launch of one thread.

        What is held still has an inverse diagonal of 0, so it keeps its value, enters the right-hand side through
        the first residual, and its row of the residual is what holding it takes.
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
        size = zero
        rz = zero
        for i in range(nodes):
            b = rhs[i]
            size += wp.dot(wp.cw_mul(inverse_x[i], b), b)
            r = b - q_x[i]
            z = wp.cw_mul(inverse_x[i], r)
            rz += wp.dot(r, z)
            r_x[i] = r
            p_x[i] = z
            q_x[i] = vec3()
            if wp.static(sliding):
                for s in range(2 * i, 2 * i + 2):
                    b_s = euler_rhs[s]
                    size += inverse_s[s] * b_s * b_s
                    r_1 = b_s - q_s[s]
                    z_1 = inverse_s[s] * r_1
                    rz += r_1 * z_1
                    r_s[s] = r_1
                    p_s[s] = z_1
                    q_s[s] = zero

        limit = tolerance[0] * tolerance[0] * size
        count = int(0)
        while count < most_iterations and rz > limit:
            multiply(
                nodes, stencil, neighbour, diagonal_xx, diagonal_xs, diagonal_ss,
                upper_xx, upper_xs, upper_sx, upper_ss, p_x, p_s, q_x, q_s,
            )  # fmt: skip
            pq = zero
            for i in range(nodes):
                pq += wp.dot(p_x[i], q_x[i])
                if wp.static(sliding):
                    pq += p_s[2 * i] * q_s[2 * i] + p_s[2 * i + 1] * q_s[2 * i + 1]
            if not (pq > zero):
                # past the attainable accuracy, or not finite
                break
            alpha = rz / pq
            rz_next = zero
            for i in range(nodes):
                solution[i] = solution[i] + p_x[i] * alpha
                r = r_x[i] - q_x[i] * alpha
                rz_next += wp.dot(r, wp.cw_mul(inverse_x[i], r))
                r_x[i] = r
                q_x[i] = vec3()
                if wp.static(sliding):
                    for s in range(2 * i, 2 * i + 2):
                        euler_solution[s] = euler_solution[s] + p_s[s] * alpha
                        r_1 = r_s[s] - q_s[s] * alpha
                        rz_next += r_1 * inverse_s[s] * r_1
                        r_s[s] = r_1
                        q_s[s] = zero
            beta = rz_next / rz
            rz = rz_next
            for i in range(nodes):
                p_x[i] = wp.cw_mul(inverse_x[i], r_x[i]) + p_x[i] * beta
                if wp.static(sliding):
                    for s in range(2 * i, 2 * i + 2):
                        p_s[s] = inverse_s[s] * r_s[s] + p_s[s] * beta
            count += 1

        if report(count, rz, size, limit, iterations, residual, status):
            worst = scalar(-1.0)
            for i in range(nodes):
                here = wp.dot(r_x[i], wp.cw_mul(inverse_x[i], r_x[i]))
                if not (here <= worst):
                    worst = here
                    status[1] = i

    return SimpleNamespace(apply_matrix=apply_matrix, jacobi_conjugate_gradient=jacobi_conjugate_gradient)
