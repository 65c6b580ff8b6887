"""The solver's incomplete Cholesky preconditioner, and the conjugate gradient with it, one node after the other.

    P = (E + U)ᵀ E⁻¹ (E + U),   E_j = A_jj − Σ_i U_ijᵀ E_i⁻¹ U_ij

U is the upper blocks of A as they are, E block-diagonal: only the diagonal blocks are corrected. Along one yarn that is
the exact factorization, and warp and weft stretch along different directions, so little is dropped: at 17 × 17 it needs
12 iterations where Jacobi needs 170, and hardly more on larger cloths. With Eisenstat's splitting
A = (E + U)ᵀ + (E + U) + (D − 2E) an iteration costs one pass over the blocks, as with Jacobi.

Processor cores share the work by columns of the cloth: each has a strip of them. A sweep goes along the rows, one after
the other, and a strip follows its neighbours: forwards, it begins a row when the strip before has ended it, and ends it
when the strip behind has ended the last one; backwards the other way round. So they all work, one row apart, and what
they compute is what one core does. They run one kernel at the same time; ``team`` is where they meet:

    team[0] how often strips came to a meeting   team[1] the number of the solve   team[2] 1: helpers are to go home
    team[3] how many strips                      team[4] the last helper to wait   team[5] team[0] before the solve
    team[16 + 16 k] rows that strip k has swept, of all sweeps

The layout of the matrix is told in ``solver.py``.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import solver
from .variant import Variant

# Processor cores alone meet like this; a GPU has one strip and never waits.
_MEET = """
#if !defined(__CUDA_ARCH__)
    __atomic_add_fetch(&team.data[0], 1, __ATOMIC_ACQ_REL);
    while (__atomic_load_n(&team.data[0], __ATOMIC_ACQUIRE) < goal) {}
#endif
"""
_CALL = """
#if !defined(__CUDA_ARCH__)
    team.data[5] = __atomic_load_n(&team.data[0], __ATOMIC_ACQUIRE);
    __atomic_add_fetch(&team.data[1], 1, __ATOMIC_ACQ_REL);
#endif
"""
_AWAIT = """
#if !defined(__CUDA_ARCH__)
    __atomic_store_n(&team.data[4], strip, __ATOMIC_RELEASE);
    while (__atomic_load_n(&team.data[1], __ATOMIC_ACQUIRE) == last
           && !__atomic_load_n(&team.data[2], __ATOMIC_ACQUIRE)) {}
#endif
"""
_SWEPT = """
#if !defined(__CUDA_ARCH__)
    __atomic_store_n(&team.data[16 + 16 * strip], rows, __ATOMIC_RELEASE);
#endif
"""
_FOLLOW = """
#if !defined(__CUDA_ARCH__)
    while (__atomic_load_n(&team.data[16 + 16 * strip], __ATOMIC_ACQUIRE) < rows) {}
#endif
"""


@wp.func_native(_SWEPT)
def _swept(team: wp.array(dtype=int), strip: int, rows: int):
    """Tells the other strips how many rows this one has swept."""
    ...


@wp.func_native(_FOLLOW)
def _follow(team: wp.array(dtype=int), strip: int, rows: int):
    """Waits until a strip has swept so many rows."""
    ...


@wp.func_native(_MEET)
def _meet(team: wp.array(dtype=int), goal: int):
    """Comes to a meeting, and waits until so many have come."""
    ...


@wp.func_native(_CALL)
def _call(team: wp.array(dtype=int)):
    """Begins a solve."""
    ...


@wp.func_native(_AWAIT)
def _await(team: wp.array(dtype=int), last: int, strip: int):
    """Waits for a solve after the last one, or the end of all."""
    ...


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, vec3, mat33, sliding = variant.scalar, variant.vec3, variant.mat33, variant.sliding
    report = solver.functions(variant).report
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

    @wp.func
    def share(whole: int, strip: int, strips: int) -> int:
        """Where the share of a strip begins."""
        return int(wp.int64(whole) * wp.int64(strip) / wp.int64(strips))

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
        strip: int,
        strips: int,
        swept: int,
        team: wp.array(dtype=int),
        nodes: int,
        columns: int,
        stencil: int,
        neighbour: wp.array(dtype=int),
        upper_xx: wp.array(dtype=mat33),
        upper_xs: wp.array(dtype=vec3),
        upper_sx: wp.array(dtype=vec3),
        upper_ss: wp.array(dtype=scalar),
        inverse_pivot: wp.array(dtype=mat33),
        inverse_s: wp.array(dtype=scalar),
        beta: scalar,
        p_x: wp.array(dtype=vec3),
        p_s: wp.array(dtype=scalar),
        q_x: wp.array(dtype=vec3),
        q_s: wp.array(dtype=scalar),
        t_x: wp.array(dtype=vec3),
        t_s: wp.array(dtype=scalar),
    ):
        """p ← q + β p, q ← 0, and t = (E + U)⁻¹ p, in a strip."""
        first = share(columns, strip, strips)
        width = share(columns, strip + 1, strips) - first
        rows = nodes / columns
        for n in range(rows * width):
            # rows from the last one up, and each from its end
            row = n / width
            column = width - 1 - (n - row * width)
            if strip + 1 < strips and column == width - 1:
                _follow(team, strip + 1, swept + row + 1)
            if strip > 0 and column == 0:
                _follow(team, strip - 1, swept + row)
            i = (rows - 1 - row) * columns + first + column
            y = q_x[i] + p_x[i] * beta
            p_x[i] = y
            q_x[i] = vec3()
            for slot in range(stencil):
                k = stencil * i + slot
                j = neighbour[k]
                if j >= 0:
                    y -= upper_xx[k] * t_x[j]
            if wp.static(sliding):
                y_u = q_s[2 * i] + p_s[2 * i] * beta
                y_v = q_s[2 * i + 1] + p_s[2 * i + 1] * beta
                p_s[2 * i] = y_u
                p_s[2 * i + 1] = y_v
                q_s[2 * i] = scalar(0.0)
                q_s[2 * i + 1] = scalar(0.0)
                for slot in range(4):
                    if slot < stencil:
                        j = neighbour[stencil * i + slot]
                        if j >= 0:
                            k = 4 * i + slot
                            along = t_s[2 * j + slot % 2]
                            y -= upper_xs[k] * along
                            along_row = wp.dot(upper_sx[k], t_x[j]) + upper_ss[k] * along
                            if slot % 2 == 0:
                                y_u -= along_row
                            else:
                                y_v -= along_row
                t_s[2 * i] = inverse_s[2 * i] * y_u
                t_s[2 * i + 1] = inverse_s[2 * i + 1] * y_v
            t_x[i] = inverse_pivot[i] * y
            if strips > 1 and column == 0:
                _swept(team, strip, swept + row + 1)

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

    @wp.func
    def gather(
        i: int,
        stencil: int,
        neighbour: wp.array(dtype=int),
        upper_xx: wp.array(dtype=mat33),
        upper_xs: wp.array(dtype=vec3),
        upper_sx: wp.array(dtype=vec3),
        upper_ss: wp.array(dtype=scalar),
        t_x: wp.array(dtype=vec3),
        t_s: wp.array(dtype=scalar),
        q_x: wp.array(dtype=vec3),
        q_s: wp.array(dtype=scalar),
    ):
        """q += U t in row i."""
        y = q_x[i]
        for slot in range(stencil):
            k = stencil * i + slot
            j = neighbour[k]
            if j >= 0:
                y += upper_xx[k] * t_x[j]
        if wp.static(sliding):
            for slot in range(4):
                if slot < stencil:
                    j = neighbour[stencil * i + slot]
                    if j >= 0:
                        k = 4 * i + slot
                        along = t_s[2 * j + slot % 2]
                        y += upper_xs[k] * along
                        s = 2 * i + slot % 2
                        q_s[s] = q_s[s] + wp.dot(upper_sx[k], t_x[j]) + upper_ss[k] * along
        q_x[i] = y

    @wp.func
    def nodes_of(strip: int, strips: int, nodes: int, columns: int) -> int:
        """How many nodes a strip has."""
        return nodes / columns * (share(columns, strip + 1, strips) - share(columns, strip, strips))

    @wp.func
    def follow_forwards(n: int, strip: int, strips: int, swept: int, team: wp.array(dtype=int), columns: int) -> int:
        """The n-th node of a strip, once the sweep may go there.

        The last three of a row spread to columns that the strip behind spreads to from the row before.
        """
        if strips == 1:
            return n
        first = share(columns, strip, strips)
        width = share(columns, strip + 1, strips) - first
        row = n / width
        column = n - row * width
        if strip > 0 and column == 0:
            _follow(team, strip - 1, swept + row + 1)
        if strip + 1 < strips and column == width - 3:
            _follow(team, strip + 1, swept + row)
        return row * columns + first + column

    @wp.func
    def told_forwards(n: int, strip: int, strips: int, swept: int, team: wp.array(dtype=int), columns: int):
        """Tells the other strips where the n-th node ends a row."""
        if strips > 1:
            width = share(columns, strip + 1, strips) - share(columns, strip, strips)
            row = (n + 1) / width
            if row * width == n + 1:
                _swept(team, strip, swept + row)

    @wp.func
    def forward_sweep(
        strip: int,
        strips: int,
        swept: int,
        team: wp.array(dtype=int),
        nodes: int,
        columns: int,
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
        p_x: wp.array(dtype=vec3),
        p_s: wp.array(dtype=scalar),
        t_x: wp.array(dtype=vec3),
        t_s: wp.array(dtype=scalar),
        q_x: wp.array(dtype=vec3),
        q_s: wp.array(dtype=scalar),
    ) -> scalar:
        """q = t + (E + U)⁻ᵀ (p + (D − 2E) t) in a strip, and its part of p·q."""
        zero = scalar(0.0)
        pq = zero
        for n in range(nodes_of(strip, strips, nodes, columns)):
            i = follow_forwards(n, strip, strips, swept, team, columns)
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
            told_forwards(n, strip, strips, swept, team, columns)
        return pq

    @wp.func
    def total(
        mine: scalar,
        slot: int,
        strip: int,
        strips: int,
        met: int,
        team: wp.array(dtype=int),
        sums: wp.array(dtype=scalar),
    ) -> scalar:
        """The sum over the strips, when all have come to it."""
        if strips == 1:
            return mine
        sums[strips * slot + strip] = mine
        _meet(team, met)
        result = scalar(0.0)
        for k in range(strips):
            result += sums[strips * slot + k]
        return result

    @wp.kernel(module=module, enable_backward=False)
    def incomplete_conjugate_gradient(
        strip: int,
        team: wp.array(dtype=int),
        # matrix
        nodes: int,
        columns: int,
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
        t_x: wp.array(dtype=vec3),
        t_s: wp.array(dtype=scalar),
        sums: wp.array(dtype=scalar),
        # report out
        iterations: wp.array(dtype=int),
        residual: wp.array(dtype=scalar),
        status: wp.array(dtype=int),
    ):
        """A · solution = rhs, to √(r·P⁻¹r) ≤ tolerance √(b·P⁻¹b), in one launch of one thread a strip.

        Strip 0 solves once; others are helpers that wait for one solve after the other until they are sent home.
        Iterates on (E + U)⁻ᵀ A (E + U)⁻¹ with the preconditioner E; r, p and q below are those of the split system.
        """
        zero = scalar(0.0)
        strips = team[3]
        begin = share(nodes, strip, strips)
        end = share(nodes, strip + 1, strips)
        mine = nodes_of(strip, strips, nodes, columns)
        rows = nodes / columns
        number = int(0)
        stays = bool(True)
        if strip == 0 and strips > 1:
            _call(team)
        while stays:
            if strip == 0:
                stays = False
            else:
                _await(team, number, strip)
                number += 1
                if team[2] != 0:
                    break
            met = team[5] + strips
            swept = team[16 + 16 * strip]
            # r = b − A x, and p = b for the size to compare it with
            start = zero
            for i in range(begin, end):
                start += wp.dot(solution[i], solution[i])
                if wp.static(sliding):
                    start += euler_solution[2 * i] * euler_solution[2 * i]
                    start += euler_solution[2 * i + 1] * euler_solution[2 * i + 1]
            start = total(start, 0, strip, strips, met, team, sums)
            u = zero
            v = zero
            for i in range(begin, end):
                q_x[i] = vec3()
                p_x[i] = rhs[i]
                r_x[i] = rhs[i]
                if wp.static(sliding):
                    for s in range(2 * i, 2 * i + 2):
                        q_s[s] = zero
                        p_s[s] = euler_rhs[s]
                        r_s[s] = euler_rhs[s]
            met += strips
            if strips > 1:
                _meet(team, met)
            if start != zero:
                for n in range(mine):
                    i = follow_forwards(n, strip, strips, swept, team, columns)
                    x = solution[i]
                    gather(
                        i, stencil, neighbour, upper_xx, upper_xs, upper_sx, upper_ss,
                        solution, euler_solution, q_x, q_s,
                    )  # fmt: skip
                    ax = diagonal_xx[i] * x
                    if wp.static(sliding):
                        u = euler_solution[2 * i]
                        v = euler_solution[2 * i + 1]
                        xs_u = diagonal_xs[2 * i]
                        xs_v = diagonal_xs[2 * i + 1]
                        ax += xs_u * u + xs_v * v
                        q_s[2 * i] = q_s[2 * i] + wp.dot(xs_u, x) + diagonal_ss[2 * i] * u
                        q_s[2 * i + 1] = q_s[2 * i + 1] + wp.dot(xs_v, x) + diagonal_ss[2 * i + 1] * v
                    q_x[i] = q_x[i] + ax
                    spread(i, stencil, neighbour, upper_xx, upper_xs, upper_sx, upper_ss, -x, -u, -v, q_x, q_s)
                    told_forwards(n, strip, strips, swept, team, columns)
                swept += rows
                met += strips
                if strips > 1:
                    _meet(team, met)
                for i in range(begin, end):
                    r_x[i] = r_x[i] - q_x[i]
                    if wp.static(sliding):
                        for s in range(2 * i, 2 * i + 2):
                            r_s[s] = r_s[s] - q_s[s]
                met += strips
                if strips > 1:
                    _meet(team, met)
            # r ← (E + U)⁻ᵀ r, and the same of b for its size
            size = zero
            rz = zero
            b_u = zero
            b_v = zero
            r_u = zero
            r_v = zero
            for n in range(mine):
                i = follow_forwards(n, strip, strips, swept, team, columns)
                r = inverse_pivot[i] * r_x[i]
                rz += wp.dot(r, r_x[i])
                if wp.static(sliding):
                    r_u = inverse_s[2 * i] * r_s[2 * i]
                    r_v = inverse_s[2 * i + 1] * r_s[2 * i + 1]
                    rz += r_u * r_s[2 * i] + r_v * r_s[2 * i + 1]
                spread(i, stencil, neighbour, upper_xx, upper_xs, upper_sx, upper_ss, r, r_u, r_v, r_x, r_s)
                if start != zero:
                    b = inverse_pivot[i] * p_x[i]
                    size += wp.dot(b, p_x[i])
                    if wp.static(sliding):
                        b_u = inverse_s[2 * i] * p_s[2 * i]
                        b_v = inverse_s[2 * i + 1] * p_s[2 * i + 1]
                        size += b_u * p_s[2 * i] + b_v * p_s[2 * i + 1]
                    spread(i, stencil, neighbour, upper_xx, upper_xs, upper_sx, upper_ss, b, b_u, b_v, p_x, p_s)
                r_x[i] = r
                # p starts as E r: the sweep takes it from q
                q_x[i] = pivot[i] * r
                if wp.static(sliding):
                    r_s[2 * i] = r_u
                    r_s[2 * i + 1] = r_v
                    q_s[2 * i] = diagonal_ss[2 * i] * r_u
                    q_s[2 * i + 1] = diagonal_ss[2 * i + 1] * r_v
                told_forwards(n, strip, strips, swept, team, columns)
            swept += rows
            rz = total(rz, 1, strip, strips, met + strips, team, sums)
            size = total(size, 2, strip, strips, met + 2 * strips, team, sums)
            met += 2 * strips
            if start == zero:
                size = rz

            limit = tolerance[0] * tolerance[0] * size
            count = int(0)
            beta = zero
            while count < most_iterations and rz > limit:
                backward_sweep(
                    strip, strips, swept, team, nodes, columns,
                    stencil, neighbour, upper_xx, upper_xs, upper_sx, upper_ss,
                    inverse_pivot, inverse_s, beta, p_x, p_s, q_x, q_s, t_x, t_s,
                )  # fmt: skip
                swept += rows
                met += strips
                if strips > 1:
                    _meet(team, met)
                pq = forward_sweep(
                    strip, strips, swept, team, nodes, columns,
                    stencil, neighbour, diagonal_xx, diagonal_xs, diagonal_ss,
                    upper_xx, upper_xs, upper_sx, upper_ss, pivot, inverse_pivot, inverse_s,
                    p_x, p_s, t_x, t_s, q_x, q_s,
                )  # fmt: skip
                swept += rows
                met += strips
                pq = total(pq, 3, strip, strips, met, team, sums)
                if not (pq > zero):
                    # past the attainable accuracy, or not finite
                    break
                alpha = rz / pq
                rz_next = zero
                for i in range(begin, end):
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
                met += strips
                rz_next = total(rz_next, 4, strip, strips, met, team, sums)
                beta = rz_next / rz
                rz = rz_next
                count += 1
            if strips > 1:
                _meet(team, met + strips)
            if strip == 0:
                if report(count, rz, size, limit, iterations, residual, status):
                    worst = scalar(-1.0)
                    for i in range(nodes):
                        here = wp.dot(r_x[i], pivot[i] * r_x[i])
                        if not (here <= worst):
                            worst = here
                            status[1] = i

    return SimpleNamespace(factorize=factorize, incomplete_conjugate_gradient=incomplete_conjugate_gradient)
