"""The conjugate gradient with the multilevel line preconditioner (``multilevel.py``)."""

import functools
from types import SimpleNamespace

import warp as wp

from ..core import memory
from ..core.structs import structs
from ..core.variant import Variant
from . import beside, block_matrix, incomplete_cholesky, multilevel
from . import threads as synchronization
from .threads import barrier, begin_solve, partition, wait_for_solve

_ROW = (
    block_matrix.UPPER
    + """
    auto add_lower = [&](int slot, int direction, row& s_x, SCALAR& s_s) {
        const int j = lower.data[blocks.stencil * i + slot];
        if (j < 0)
            return;
        const SCALAR* m = blocks.upper_xx.data[blocks.stencil * j + slot].data[0];
        const SCALAR* of = x.data[j].c;
        x_s = x_s + *(const row*)m * of[0] + *(const row*)(m + 3) * of[1] + *(const row*)(m + 6) * of[2];
#if SLIDING
        if (slot < 4) {
            const int k = 4 * j + slot;
            const SCALAR along = s.data[2 * j + direction];
            const row its = {of[0], of[1], of[2], 0};
            x_s = x_s + *(const row*)blocks.upper_sx.data[k].c * along;
            s_x = s_x + *(const row*)blocks.upper_xs.data[k].c * its;
            s_s += blocks.upper_ss.data[k] * along;
        }
#endif
    };
    for (int slot = 0; slot < blocks.stencil; slot += 2) {
        add(slot, 0, u_x, u_s);
        add(slot + 1, 1, v_x, v_s);
        add_lower(slot, 0, u_x, u_s);
        add_lower(slot + 1, 1, v_x, v_s);
    }
    const SCALAR* of = x.data[i].c;
    const SCALAR* m = blocks.diagonal_xx.data[i].data[0];
    const row its = {of[0], of[1], of[2], 0};
    a = a + *(const row*)m * its;
    b = b + *(const row*)(m + 3) * its;
    // the fourth number behind the last block is not ours
    c = c + row{m[6], m[7], m[8], 0} * its;
#if SLIDING
    const SCALAR u = s.data[2 * i], v = s.data[2 * i + 1];
    const SCALAR* xs_u = blocks.diagonal_xs.data[2 * i].c;
    const SCALAR* xs_v = blocks.diagonal_xs.data[2 * i + 1].c;
    for (int k = 0; k < 3; ++k)
        x_s[k] += xs_u[k] * u + xs_v[k] * v;
    const SCALAR y_u = u_x[0] + u_x[1] + u_x[2] + u_s + xs_u[0] * of[0] + xs_u[1] * of[1] + xs_u[2] * of[2]
        + blocks.diagonal_ss.data[2 * i] * u;
    const SCALAR y_v = v_x[0] + v_x[1] + v_x[2] + v_s + xs_v[0] * of[0] + xs_v[1] * of[1] + xs_v[2] * of[2]
        + blocks.diagonal_ss.data[2 * i + 1] * v;
#endif
    const SCALAR y_0 = a[0] + a[1] + a[2] + x_s[0];
    const SCALAR y_1 = b[0] + b[1] + b[2] + x_s[1];
    const SCALAR y_2 = c[0] + c[1] + c[2] + x_s[2];
    q_x.data[i].c[0] = y_0;
    q_x.data[i].c[1] = y_1;
    q_x.data[i].c[2] = y_2;
    SCALAR energy = y_0 * of[0] + y_1 * of[1] + y_2 * of[2];
#if SLIDING
    q_s.data[2 * i] = y_u;
    q_s.data[2 * i + 1] = y_v;
    energy += y_u * u + y_v * v;
#endif
    return energy;
"""
)


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, vec3, sliding = variant.scalar, variant.vec3, variant.sliding
    load, store = memory.functions(variant).load, memory.functions(variant).store
    limit_of, write_report = block_matrix.functions(variant).limit_of, block_matrix.functions(variant).write_report
    product = incomplete_cholesky.functions(variant).product
    total = synchronization.functions(variant).total
    precondition, barriers = multilevel.functions(variant).precondition, multilevel.functions(variant).barriers
    BlockMatrix, SolverWork = structs(variant).BlockMatrix, structs(variant).SolverWork
    SolveReport, Levels, Pairs = structs(variant).SolveReport, structs(variant).Levels, structs(variant).Pairs
    has_more, add_beside = beside.functions(variant).has_more, beside.functions(variant).add_beside
    module = variant.module("multilevel")
    variant.fuse("multilevel")

    @wp.func_native(memory.rows(variant, _ROW))
    def multiply_row(
        i: int,
        blocks: BlockMatrix,
        lower: wp.array(dtype=int),
        x: wp.array(dtype=vec3),
        s: wp.array(dtype=scalar),
        q_x: wp.array(dtype=vec3),
        q_s: wp.array(dtype=scalar),
    ) -> scalar:
        """Compute q = A x of a node, and its part of x·A x."""
        ...

    @wp.kernel(module=module, enable_backward=False)
    def multilevel_conjugate_gradient(
        thread: int,
        signals: wp.array(dtype=int),
        # matrix
        nodes: int,
        blocks: BlockMatrix,
        levels: Levels,
        pairs: Pairs,
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
        """Solve A · solution = rhs, to √(r·P⁻¹r) ≤ tolerance times what it was at the start, in one launch a thread.

        Thread 0 solves once; others are helpers that wait for one solve after the other until they are to end.
        What is held has a row of 0 in P⁻¹: it keeps its value.
        """
        zero = scalar(0.0)
        threads = signals[3]
        begin = partition(nodes, thread, threads)
        end = partition(nodes, thread + 1, threads)
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
            arrived = signals[5]
            unused = zero
            more = has_more(blocks, pairs)
            for i in range(begin, end):
                unused += multiply_row(
                    i, blocks, levels.lower, solution, euler_solution, work.q_x, work.q_s,
                )  # fmt: skip
                if more:
                    unused += add_beside(blocks, pairs, i, i + 1, solution, work.q_x)
                r = load(rhs, i) - load(work.q_x, i)
                store(work.r_x, i, r)
                store(work.p_x, i, vec3())
                store(work.t_x, i, -product(load(levels.halves, i), r))
                if wp.static(sliding):
                    for s in range(2 * i, 2 * i + 2):
                        store(work.r_s, s, load(euler_rhs, s) - load(work.q_s, s))
                        store(work.p_s, s, zero)
            rz = precondition(thread, threads, arrived, signals, nodes, levels, work.r_x, work.r_s, work.t_x, work.t_s)
            arrived += threads * (barriers(levels) + 1)
            rz = total(rz, 0, thread, threads, arrived, signals, work.sums)
            size = rz
            limit = limit_of(tolerance, size, report)
            count = int(0)
            beta = zero
            while count < most_iterations and rz > limit:
                for i in range(begin, end):
                    store(work.p_x, i, load(work.t_x, i) + load(work.p_x, i) * beta)
                    if wp.static(sliding):
                        store(work.p_s, 2 * i, load(work.t_s, 2 * i) + load(work.p_s, 2 * i) * beta)
                        store(work.p_s, 2 * i + 1, load(work.t_s, 2 * i + 1) + load(work.p_s, 2 * i + 1) * beta)
                if threads > 1:
                    arrived += threads
                    barrier(signals, arrived)
                curvature = zero
                for i in range(begin, end):
                    curvature += multiply_row(
                        i, blocks, levels.lower, work.p_x, work.p_s, work.q_x, work.q_s,
                    )  # fmt: skip
                    if more:
                        curvature += add_beside(blocks, pairs, i, i + 1, work.p_x, work.q_x)
                arrived += threads
                curvature = total(curvature, 1, thread, threads, arrived, signals, work.sums)
                if not (curvature > zero):
                    # past the attainable accuracy, or not finite
                    break
                alpha = rz / curvature
                for i in range(begin, end):
                    store(solution, i, load(solution, i) + load(work.p_x, i) * alpha)
                    r = load(work.r_x, i) - load(work.q_x, i) * alpha
                    store(work.r_x, i, r)
                    store(work.t_x, i, -product(load(levels.halves, i), r))
                    if wp.static(sliding):
                        for s in range(2 * i, 2 * i + 2):
                            store(euler_solution, s, load(euler_solution, s) + load(work.p_s, s) * alpha)
                            store(work.r_s, s, load(work.r_s, s) - load(work.q_s, s) * alpha)
                rz_next = precondition(
                    thread, threads, arrived, signals, nodes, levels, work.r_x, work.r_s, work.t_x, work.t_s
                )
                arrived += threads * (barriers(levels) + 1)
                rz_next = total(rz_next, 2 + count % 2, thread, threads, arrived, signals, work.sums)
                beta = rz_next / rz
                rz = rz_next
                count += 1
            if threads > 1:
                barrier(signals, arrived + threads)
            if thread == 0:
                if write_report(count, rz, size, limit, blocks, report):
                    worst = scalar(-1.0)
                    for i in range(nodes):
                        here = wp.dot(load(work.r_x, i), load(work.t_x, i))
                        if not (here <= worst):
                            worst = here
                            report.status[1] = i

    return SimpleNamespace(multilevel_conjugate_gradient=multilevel_conjugate_gradient)
