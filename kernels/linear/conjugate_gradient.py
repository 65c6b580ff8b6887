"""The conjugate gradient with the incomplete Cholesky preconditioner: two sweeps over the cloth an iteration.

It is the conjugate gradient on E (E + U)⁻ᵀ A (E + U)⁻¹ E, preconditioned by E: r is E (E + U)⁻ᵀ times the residual of
A x = b, and p the direction in the same sense. Eisenstat's observation is that A = Uᵀ + D + U then costs no more than
the two triangular solves that the preconditioner takes anyway. Here:

    backwards   p ← r + β p,   t = (E + U)⁻¹ p,   q = (D + U) t;   then t·A t = t·(q + U t), and α = r·E⁻¹r / t·A t
    forwards    q ← E (E + U)⁻ᵀ A t,   x ← x + α t,   r ← r − α q;   then r·E⁻¹r, and β

Of q, row i has given the rows behind it its part of Uᵀ (t − E⁻¹q) when they come to their turn. Both sweeps do all that
there is to do with a node's vectors while they are at hand, and of the diagonal blocks the iteration reads D once and
E⁻¹ twice, E never. They count their columns by hand: the object that Warp makes of a range costs 3 % of a step.

``team.py`` tells how processor cores share the sweeps.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core import memory
from ..core.variant import Variant
from . import block_matrix, incomplete_cholesky, pair_blocks
from . import threads as teams
from .threads import call, ended, keep_pace, meet, share, wait_for_call


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, vec3, mat33, sym33, sliding = (
        variant.scalar, variant.vec3, variant.mat33, variant.sym33, variant.sliding,
    )  # fmt: skip
    at, put = memory.functions(variant).at, memory.functions(variant).put
    times, gather, spread = (getattr(block_matrix.functions(variant), name) for name in ("times", "gather", "spread"))
    report = block_matrix.functions(variant).report
    symmetric, product = (
        incomplete_cholesky.functions(variant).symmetric,
        incomplete_cholesky.functions(variant).product,
    )
    total = teams.functions(variant).total
    add_pairs, Pairs = pair_blocks.functions(variant).add_pairs, pair_blocks.structs(variant).Pairs
    module = variant.module("conjugate_gradient")
    variant.fuse("conjugate_gradient")

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
        diagonal_xx: wp.array(dtype=mat33),
        diagonal_xs: wp.array(dtype=vec3),
        diagonal_ss: wp.array(dtype=scalar),
        upper_xx: wp.array(dtype=mat33),
        upper_xs: wp.array(dtype=vec3),
        upper_sx: wp.array(dtype=vec3),
        upper_ss: wp.array(dtype=scalar),
        inverse_pivot: wp.array(dtype=sym33),
        inverse_s: wp.array(dtype=scalar),
        beta: scalar,
        r_x: wp.array(dtype=vec3),
        r_s: wp.array(dtype=scalar),
        p_x: wp.array(dtype=vec3),
        p_s: wp.array(dtype=scalar),
        t_x: wp.array(dtype=vec3),
        t_s: wp.array(dtype=scalar),
        q_x: wp.array(dtype=vec3),
        q_s: wp.array(dtype=scalar),
    ) -> scalar:
        """p ← r + β p, t = (E + U)⁻¹ p, q = (D + U) t in a strip, and its part of t·A t."""
        first = share(columns, strip, strips)
        width = share(columns, strip + 1, strips) - first
        rows = nodes / columns
        curvature = scalar(0.0)
        for row in range(rows):
            # from the last row up, and each from its end
            begin = (rows - 1 - row) * columns + first
            column = width - 1
            while column >= 0:
                if strips > 1:
                    keep_pace(team, strip, strip + 1, strip - 1, strips, width - 1 - column, width, swept + row)
                i = begin + column
                w, w_u, w_v = gather(i, stencil, neighbour, upper_xx, upper_xs, upper_sx, upper_ss, t_x, t_s)
                p = at(r_x, i) + at(p_x, i) * beta
                t = product(at(inverse_pivot, i), p - w)
                q = w + product(symmetric(at(diagonal_xx, i)), t)
                put(p_x, i, p)
                put(t_x, i, t)
                if wp.static(sliding):
                    p_u = at(r_s, 2 * i) + at(p_s, 2 * i) * beta
                    p_v = at(r_s, 2 * i + 1) + at(p_s, 2 * i + 1) * beta
                    u = at(inverse_s, 2 * i) * (p_u - w_u)
                    v = at(inverse_s, 2 * i + 1) * (p_v - w_v)
                    xs_u = at(diagonal_xs, 2 * i)
                    xs_v = at(diagonal_xs, 2 * i + 1)
                    q += xs_u * u + xs_v * v
                    q_u = w_u + wp.dot(xs_u, t) + at(diagonal_ss, 2 * i) * u
                    q_v = w_v + wp.dot(xs_v, t) + at(diagonal_ss, 2 * i + 1) * v
                    put(p_s, 2 * i, p_u)
                    put(p_s, 2 * i + 1, p_v)
                    put(t_s, 2 * i, u)
                    put(t_s, 2 * i + 1, v)
                    put(q_s, 2 * i, q_u)
                    put(q_s, 2 * i + 1, q_v)
                    curvature += u * (q_u + w_u) + v * (q_v + w_v)
                put(q_x, i, q)
                curvature += wp.dot(t, q + w)
                column -= 1
            if strips > 1:
                ended(team, strip, swept + row + 1)
        return curvature

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
        upper_xx: wp.array(dtype=mat33),
        upper_xs: wp.array(dtype=vec3),
        upper_sx: wp.array(dtype=vec3),
        upper_ss: wp.array(dtype=scalar),
        inverse_pivot: wp.array(dtype=sym33),
        inverse_s: wp.array(dtype=scalar),
        alpha: scalar,
        t_x: wp.array(dtype=vec3),
        t_s: wp.array(dtype=scalar),
        q_x: wp.array(dtype=vec3),
        q_s: wp.array(dtype=scalar),
        solution: wp.array(dtype=vec3),
        euler_solution: wp.array(dtype=scalar),
        r_x: wp.array(dtype=vec3),
        r_s: wp.array(dtype=scalar),
    ) -> scalar:
        """q ← E (E + U)⁻ᵀ A t, solution += α t, r −= α q in a strip, and its part of r·E⁻¹r."""
        first = share(columns, strip, strips)
        width = share(columns, strip + 1, strips) - first
        rz = scalar(0.0)
        y_u = scalar(0.0)
        y_v = scalar(0.0)
        for row in range(nodes / columns):
            begin = row * columns + first
            column = int(0)
            while column < width:
                if strips > 1:
                    keep_pace(team, strip, strip - 1, strip + 1, strips, column, width, swept + row)
                i = begin + column
                inverse = at(inverse_pivot, i)
                t = at(t_x, i)
                q = at(q_x, i)
                if wp.static(sliding):
                    inverse_u = at(inverse_s, 2 * i)
                    inverse_v = at(inverse_s, 2 * i + 1)
                    u = at(t_s, 2 * i)
                    v = at(t_s, 2 * i + 1)
                    q_u = at(q_s, 2 * i)
                    q_v = at(q_s, 2 * i + 1)
                    y_u = inverse_u * q_u - u
                    y_v = inverse_v * q_v - v
                    put(euler_solution, 2 * i, at(euler_solution, 2 * i) + u * alpha)
                    put(euler_solution, 2 * i + 1, at(euler_solution, 2 * i + 1) + v * alpha)
                    r_u = at(r_s, 2 * i) - q_u * alpha
                    r_v = at(r_s, 2 * i + 1) - q_v * alpha
                    put(r_s, 2 * i, r_u)
                    put(r_s, 2 * i + 1, r_v)
                    rz += r_u * inverse_u * r_u + r_v * inverse_v * r_v
                y = product(inverse, q) - t
                spread(i, stencil, neighbour, upper_xx, upper_xs, upper_sx, upper_ss, y, y_u, y_v, q_x, q_s)
                put(solution, i, at(solution, i) + t * alpha)
                r = at(r_x, i) - q * alpha
                put(r_x, i, r)
                rz += wp.dot(r, product(inverse, r))
                column += 1
            if strips > 1:
                ended(team, strip, swept + row + 1)
        return rz

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
        pairs: Pairs,
        inverse_pivot: wp.array(dtype=sym33),
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
        """A · solution = rhs, to √(r·E⁻¹r) ≤ tolerance times its start, in one launch of one thread a strip.

        Strip 0 solves once; others are helpers that wait for one solve after the other until they are sent home.
        What is held has an E⁻¹ of 0: it keeps its value, and enters the right-hand side through the first residual.
        """
        zero = scalar(0.0)
        strips = team[3]
        begin = share(nodes, strip, strips)
        end = share(nodes, strip + 1, strips)
        first = share(columns, strip, strips)
        width = share(columns, strip + 1, strips) - first
        rows = nodes / columns
        number = int(0)
        stays = bool(True)
        if strip == 0 and strips > 1:
            call(team)
        while stays:
            if strip == 0:
                stays = False
            else:
                wait_for_call(team, number, strip)
                number += 1
                if team[2] != 0:
                    break
            met = team[5] + strips
            swept = team[16 + 16 * strip]
            start = zero
            for i in range(begin, end):
                put(r_x, i, at(rhs, i))
                put(p_x, i, vec3())
                start += wp.dot(at(solution, i), at(solution, i))
                if wp.static(sliding):
                    for s in range(2 * i, 2 * i + 2):
                        put(r_s, s, at(euler_rhs, s))
                        put(p_s, s, zero)
                        start += at(euler_solution, s) * at(euler_solution, s)
            start = total(start, 0, strip, strips, met, team, sums)
            touch = pairs.touching[wp.static(pair_blocks.PAIRS)] != 0
            if touch and start != zero:
                # r = b − C x, the rest of A comes with the sweep
                for i in range(begin, end):
                    put(q_x, i, vec3())
                unused = add_pairs(pairs, begin, end, solution, q_x)
                for i in range(begin, end):
                    put(r_x, i, at(r_x, i) - at(q_x, i))
                met += strips
                unused = total(unused, 2, strip, strips, met, team, sums)
            # r = E (E + U)⁻ᵀ (b − A x)
            rz = zero
            u = zero
            v = zero
            y_u = zero
            y_v = zero
            for row in range(rows):
                column = int(0)
                while column < width:
                    if strips > 1:
                        keep_pace(team, strip, strip - 1, strip + 1, strips, column, width, swept + row)
                    i = row * columns + first + column
                    inverse = at(inverse_pivot, i)
                    x = vec3()
                    r = at(r_x, i)
                    if start != zero:
                        x = at(solution, i)
                        w, w_u, w_v = gather(
                            i, stencil, neighbour, upper_xx, upper_xs, upper_sx, upper_ss, solution, euler_solution
                        )
                        r -= w + times(at(diagonal_xx, i), x)
                        if wp.static(sliding):
                            u = at(euler_solution, 2 * i)
                            v = at(euler_solution, 2 * i + 1)
                            xs_u = at(diagonal_xs, 2 * i)
                            xs_v = at(diagonal_xs, 2 * i + 1)
                            r -= xs_u * u + xs_v * v
                            r_u = at(r_s, 2 * i) - w_u - wp.dot(xs_u, x) - at(diagonal_ss, 2 * i) * u
                            r_v = at(r_s, 2 * i + 1) - w_v - wp.dot(xs_v, x) - at(diagonal_ss, 2 * i + 1) * v
                            put(r_s, 2 * i, r_u)
                            put(r_s, 2 * i + 1, r_v)
                        put(r_x, i, r)
                    y = product(inverse, r)
                    rz += wp.dot(r, y)
                    if wp.static(sliding):
                        y_u = at(inverse_s, 2 * i) * at(r_s, 2 * i)
                        y_v = at(inverse_s, 2 * i + 1) * at(r_s, 2 * i + 1)
                        rz += at(r_s, 2 * i) * y_u + at(r_s, 2 * i + 1) * y_v
                    # what is held has y = 0 and gives others its x alone
                    spread(
                        i, stencil, neighbour, upper_xx, upper_xs, upper_sx, upper_ss,
                        y + x, y_u + u, y_v + v, r_x, r_s,
                    )  # fmt: skip
                    column += 1
                if strips > 1:
                    ended(team, strip, swept + row + 1)
            swept += rows
            rz = total(rz, 1, strip, strips, met + strips, team, sums)
            met += strips
            size = rz

            limit = tolerance[0] * tolerance[0] * size
            count = int(0)
            beta = zero
            while count < most_iterations and rz > limit:
                curvature = backward_sweep(
                    strip, strips, swept, team, nodes, columns, stencil, neighbour,
                    diagonal_xx, diagonal_xs, diagonal_ss, upper_xx, upper_xs, upper_sx, upper_ss,
                    inverse_pivot, inverse_s, beta, r_x, r_s, p_x, p_s, t_x, t_s, q_x, q_s,
                )  # fmt: skip
                curvature = total(curvature, 3, strip, strips, met + strips, team, sums)
                swept += rows
                met += strips
                if touch:
                    met += strips
                    curvature += total(add_pairs(pairs, begin, end, t_x, q_x), 2, strip, strips, met, team, sums)
                if not (curvature > zero):
                    # past the attainable accuracy, or not finite
                    break
                rz_next = forward_sweep(
                    strip, strips, swept, team, nodes, columns, stencil, neighbour,
                    upper_xx, upper_xs, upper_sx, upper_ss, inverse_pivot, inverse_s,
                    rz / curvature, t_x, t_s, q_x, q_s, solution, euler_solution, r_x, r_s,
                )  # fmt: skip
                rz_next = total(rz_next, 4, strip, strips, met + strips, team, sums)
                swept += rows
                met += strips
                beta = rz_next / rz
                rz = rz_next
                count += 1
            if strips > 1:
                meet(team, met + strips)
            if strip == 0:
                if report(count, rz, size, limit, iterations, residual, status):
                    worst = scalar(-1.0)
                    for i in range(nodes):
                        here = wp.dot(at(r_x, i), product(at(inverse_pivot, i), at(r_x, i)))
                        if not (here <= worst):
                            worst = here
                            status[1] = i

    return SimpleNamespace(incomplete_conjugate_gradient=incomplete_conjugate_gradient)
