"""The conjugate gradient with the incomplete Cholesky preconditioner: two sweeps over the cloth an iteration.

It is the conjugate gradient on E (E + U)⁻ᵀ A (E + U)⁻¹ E, preconditioned by E: r is E (E + U)⁻ᵀ times the residual of
A x = b, and p the direction in the same sense. Eisenstat's observation is that A = Uᵀ + D + U then costs no more than
the two triangular solves that the preconditioner takes anyway. Here:

    backwards   p ← r + β p,   t = (E + U)⁻¹ p,   q = (D + U) t;   then t·A t = t·(q + U t), and α = r·E⁻¹r / t·A t
    forwards    q ← E (E + U)⁻ᵀ A t,   x ← x + α t,   r ← r − α q;   then r·E⁻¹r, and β

Of q, row i has given the rows behind it its part of Uᵀ (t − E⁻¹q) when they come to their turn. Both sweeps do all that
there is to do with a node's vectors while they are at hand, and of the diagonal blocks the iteration reads D once and
E⁻¹ twice, E never. They count their columns by hand: the object that Warp makes of a range costs 3 % of a step.

``threads.py`` tells how processor cores share the sweeps.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core import memory
from ..core.structs import structs
from ..core.variant import Variant
from . import beside, block_matrix, incomplete_cholesky
from . import threads as synchronization
from .threads import barrier, begin_solve, ended, keep_pace, partition, wait_for_solve


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, vec3, sym33, sliding = (
        variant.scalar, variant.vec3, variant.sym33, variant.sliding,
    )  # fmt: skip
    load, store = memory.functions(variant).load, memory.functions(variant).store
    shared = block_matrix.functions(variant)
    times, upper_product, subtract_transposed = shared.times, shared.upper_product, shared.subtract_transposed
    limit_of, write_report = shared.limit_of, shared.write_report
    BlockMatrix, SolverWork = structs(variant).BlockMatrix, structs(variant).SolverWork
    SolveReport, Pairs = structs(variant).SolveReport, structs(variant).Pairs
    has_more, add_beside = beside.functions(variant).has_more, beside.functions(variant).add_beside
    symmetric, product = (
        incomplete_cholesky.functions(variant).symmetric,
        incomplete_cholesky.functions(variant).product,
    )
    total = synchronization.functions(variant).total
    module = variant.module("conjugate_gradient")
    variant.fuse("conjugate_gradient")

    @wp.func
    def backward_sweep(
        thread: int,
        threads: int,
        swept: int,
        signals: wp.array(dtype=int),
        nodes: int,
        columns: int,
        blocks: BlockMatrix,
        inverse_pivot: wp.array(dtype=sym33),
        inverse_s: wp.array(dtype=scalar),
        beta: scalar,
        work: SolverWork,
    ) -> scalar:
        """Sweep backwards: p ← r + β p, t = (E + U)⁻¹ p, q = (D + U) t in a thread's columns, and their part of t·A
        t."""
        first = partition(columns, thread, threads)
        width = partition(columns, thread + 1, threads) - first
        rows = nodes / columns
        curvature = scalar(0.0)
        for row in range(rows):
            # from the last row up, and each from its end
            begin = (rows - 1 - row) * columns + first
            column = width - 1
            while column >= 0:
                if threads > 1:
                    keep_pace(signals, thread, thread + 1, thread - 1, threads, width - 1 - column, width, swept + row)
                i = begin + column
                w, w_u, w_v = upper_product(i, blocks, work.t_x, work.t_s)
                p = load(work.r_x, i) + load(work.p_x, i) * beta
                t = product(load(inverse_pivot, i), p - w)
                q = w + product(symmetric(load(blocks.diagonal_xx, i)), t)
                store(work.p_x, i, p)
                store(work.t_x, i, t)
                if wp.static(sliding):
                    p_u = load(work.r_s, 2 * i) + load(work.p_s, 2 * i) * beta
                    p_v = load(work.r_s, 2 * i + 1) + load(work.p_s, 2 * i + 1) * beta
                    u = load(inverse_s, 2 * i) * (p_u - w_u)
                    v = load(inverse_s, 2 * i + 1) * (p_v - w_v)
                    xs_u = load(blocks.diagonal_xs, 2 * i)
                    xs_v = load(blocks.diagonal_xs, 2 * i + 1)
                    q += xs_u * u + xs_v * v
                    q_u = w_u + wp.dot(xs_u, t) + load(blocks.diagonal_ss, 2 * i) * u
                    q_v = w_v + wp.dot(xs_v, t) + load(blocks.diagonal_ss, 2 * i + 1) * v
                    store(work.p_s, 2 * i, p_u)
                    store(work.p_s, 2 * i + 1, p_v)
                    store(work.t_s, 2 * i, u)
                    store(work.t_s, 2 * i + 1, v)
                    store(work.q_s, 2 * i, q_u)
                    store(work.q_s, 2 * i + 1, q_v)
                    curvature += u * (q_u + w_u) + v * (q_v + w_v)
                store(work.q_x, i, q)
                curvature += wp.dot(t, q + w)
                column -= 1
            if threads > 1:
                ended(signals, thread, swept + row + 1)
        return curvature

    @wp.func
    def forward_sweep(
        thread: int,
        threads: int,
        swept: int,
        signals: wp.array(dtype=int),
        nodes: int,
        columns: int,
        blocks: BlockMatrix,
        inverse_pivot: wp.array(dtype=sym33),
        inverse_s: wp.array(dtype=scalar),
        alpha: scalar,
        work: SolverWork,
        solution: wp.array(dtype=vec3),
        euler_solution: wp.array(dtype=scalar),
    ) -> scalar:
        """Sweep forwards: q ← E (E + U)⁻ᵀ A t, solution += α t, r −= α q in a thread's columns, and their part of
        r·E⁻¹r."""
        first = partition(columns, thread, threads)
        width = partition(columns, thread + 1, threads) - first
        rz = scalar(0.0)
        y_u = scalar(0.0)
        y_v = scalar(0.0)
        for row in range(nodes / columns):
            begin = row * columns + first
            column = int(0)
            while column < width:
                if threads > 1:
                    keep_pace(signals, thread, thread - 1, thread + 1, threads, column, width, swept + row)
                i = begin + column
                inverse = load(inverse_pivot, i)
                t = load(work.t_x, i)
                q = load(work.q_x, i)
                if wp.static(sliding):
                    inverse_u = load(inverse_s, 2 * i)
                    inverse_v = load(inverse_s, 2 * i + 1)
                    u = load(work.t_s, 2 * i)
                    v = load(work.t_s, 2 * i + 1)
                    q_u = load(work.q_s, 2 * i)
                    q_v = load(work.q_s, 2 * i + 1)
                    y_u = inverse_u * q_u - u
                    y_v = inverse_v * q_v - v
                    store(euler_solution, 2 * i, load(euler_solution, 2 * i) + u * alpha)
                    store(euler_solution, 2 * i + 1, load(euler_solution, 2 * i + 1) + v * alpha)
                    r_u = load(work.r_s, 2 * i) - q_u * alpha
                    r_v = load(work.r_s, 2 * i + 1) - q_v * alpha
                    store(work.r_s, 2 * i, r_u)
                    store(work.r_s, 2 * i + 1, r_v)
                    rz += r_u * inverse_u * r_u + r_v * inverse_v * r_v
                y = product(inverse, q) - t
                subtract_transposed(i, blocks, y, y_u, y_v, work.q_x, work.q_s)
                store(solution, i, load(solution, i) + t * alpha)
                r = load(work.r_x, i) - q * alpha
                store(work.r_x, i, r)
                rz += wp.dot(r, product(inverse, r))
                column += 1
            if threads > 1:
                ended(signals, thread, swept + row + 1)
        return rz

    @wp.kernel(module=module, enable_backward=False)
    def incomplete_conjugate_gradient(
        thread: int,
        signals: wp.array(dtype=int),
        # matrix
        nodes: int,
        columns: int,
        blocks: BlockMatrix,
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
        work: SolverWork,
        report: SolveReport,
    ):
        """Solve A · solution = rhs, to √(r·E⁻¹r) ≤ tolerance times its start, in one launch a thread.

        Thread 0 solves once; others are helpers that wait for one solve after the other until they are to end.
        What is held has an E⁻¹ of 0: it keeps its value, and enters the right-hand side through the first residual.
        """
        zero = scalar(0.0)
        threads = signals[3]
        begin = partition(nodes, thread, threads)
        end = partition(nodes, thread + 1, threads)
        first = partition(columns, thread, threads)
        width = partition(columns, thread + 1, threads) - first
        rows = nodes / columns
        number = int(0)
        stays = bool(True)
        if thread == 0 and threads > 1:
            begin_solve(signals)
        while stays:
            if thread == 0:
                stays = False
            else:
                wait_for_solve(signals, number, thread)
                number += 1
                if signals[2] != 0:
                    break
            arrived = signals[5] + threads
            swept = signals[16 + 16 * thread]
            start = zero
            for i in range(begin, end):
                store(work.r_x, i, load(rhs, i))
                store(work.p_x, i, vec3())
                start += wp.dot(load(solution, i), load(solution, i))
                if wp.static(sliding):
                    for s in range(2 * i, 2 * i + 2):
                        store(work.r_s, s, load(euler_rhs, s))
                        store(work.p_s, s, zero)
                        start += load(euler_solution, s) * load(euler_solution, s)
            start = total(start, 0, thread, threads, arrived, signals, work.sums)
            more = has_more(blocks, pairs)
            if more and start != zero:
                # r = b − (C − G) x, the rest of A comes with the sweep
                for i in range(begin, end):
                    store(work.q_x, i, vec3())
                unused = add_beside(blocks, pairs, begin, end, solution, work.q_x)
                for i in range(begin, end):
                    store(work.r_x, i, load(work.r_x, i) - load(work.q_x, i))
                arrived += threads
                unused = total(unused, 2, thread, threads, arrived, signals, work.sums)
            # r = E (E + U)⁻ᵀ (b − A x)
            rz = zero
            u = zero
            v = zero
            y_u = zero
            y_v = zero
            for row in range(rows):
                column = int(0)
                while column < width:
                    if threads > 1:
                        keep_pace(signals, thread, thread - 1, thread + 1, threads, column, width, swept + row)
                    i = row * columns + first + column
                    inverse = load(inverse_pivot, i)
                    x = vec3()
                    r = load(work.r_x, i)
                    if start != zero:
                        x = load(solution, i)
                        w, w_u, w_v = upper_product(i, blocks, solution, euler_solution)
                        r -= w + times(load(blocks.diagonal_xx, i), x)
                        if wp.static(sliding):
                            u = load(euler_solution, 2 * i)
                            v = load(euler_solution, 2 * i + 1)
                            xs_u = load(blocks.diagonal_xs, 2 * i)
                            xs_v = load(blocks.diagonal_xs, 2 * i + 1)
                            r -= xs_u * u + xs_v * v
                            r_u = load(work.r_s, 2 * i) - w_u - wp.dot(xs_u, x) - load(blocks.diagonal_ss, 2 * i) * u
                            r_v = (
                                load(work.r_s, 2 * i + 1)
                                - w_v
                                - wp.dot(xs_v, x)
                                - load(blocks.diagonal_ss, 2 * i + 1) * v
                            )
                            store(work.r_s, 2 * i, r_u)
                            store(work.r_s, 2 * i + 1, r_v)
                        store(work.r_x, i, r)
                    y = product(inverse, r)
                    rz += wp.dot(r, y)
                    if wp.static(sliding):
                        y_u = load(inverse_s, 2 * i) * load(work.r_s, 2 * i)
                        y_v = load(inverse_s, 2 * i + 1) * load(work.r_s, 2 * i + 1)
                        rz += load(work.r_s, 2 * i) * y_u + load(work.r_s, 2 * i + 1) * y_v
                    # what is held has y = 0 and gives others its x alone
                    subtract_transposed(
                        i, blocks,
                        y + x, y_u + u, y_v + v, work.r_x, work.r_s,
                    )  # fmt: skip
                    column += 1
                if threads > 1:
                    ended(signals, thread, swept + row + 1)
            swept += rows
            rz = total(rz, 1, thread, threads, arrived + threads, signals, work.sums)
            arrived += threads
            size = rz

            limit = limit_of(tolerance, size, report)
            count = int(0)
            beta = zero
            while count < most_iterations and rz > limit:
                curvature = backward_sweep(
                    thread, threads, swept, signals, nodes, columns, blocks,
                    inverse_pivot, inverse_s, beta, work,
                )  # fmt: skip
                curvature = total(curvature, 3, thread, threads, arrived + threads, signals, work.sums)
                swept += rows
                arrived += threads
                if more:
                    arrived += threads
                    of_more = add_beside(blocks, pairs, begin, end, work.t_x, work.q_x)
                    curvature += total(of_more, 2, thread, threads, arrived, signals, work.sums)
                if not (curvature > zero):
                    # past the attainable accuracy, or not finite
                    break
                rz_next = forward_sweep(
                    thread, threads, swept, signals, nodes, columns, blocks, inverse_pivot, inverse_s,
                    rz / curvature, work, solution, euler_solution,
                )  # fmt: skip
                rz_next = total(rz_next, 4, thread, threads, arrived + threads, signals, work.sums)
                swept += rows
                arrived += threads
                beta = rz_next / rz
                rz = rz_next
                count += 1
            if threads > 1:
                barrier(signals, arrived + threads)
            if thread == 0:
                if write_report(count, rz, size, limit, blocks, report):
                    worst = scalar(-1.0)
                    for i in range(nodes):
                        here = wp.dot(load(work.r_x, i), product(load(inverse_pivot, i), load(work.r_x, i)))
                        if not (here <= worst):
                            worst = here
                            report.status[1] = i

    return SimpleNamespace(incomplete_conjugate_gradient=incomplete_conjugate_gradient)
