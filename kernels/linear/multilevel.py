"""The solver's multilevel line preconditioner, and the conjugate gradient with it.

    P⁻¹ = lines of A + Σ over levels R (lines of RᵀAR) Rᵀ + R (RᵀAR)⁻¹ Rᵀ of the last one

R interpolates bilinearly from every 2nd, 4th, 8th … yarn to the cloth. Lines solve exactly along yarns (``lines.py``),
levels take what is smooth across them, so the iterations depend on neither the number of yarns nor their stiffness,
where those of the incomplete factorization grow with both. All parts are added up, so they can be solved at the same
time, and each is positive definite, so P is. Rates of sliding have lines, and no part in the levels.

Its index arrays are those of ``warp_yarn/description/levels.py``. Every loop here is over nodes, lines or coarse nodes
that do not depend on each other, a share of them for each processor core (``threads.py``); between two loops all wait
for all.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core import memory
from ..core.structs import structs
from ..core.variant import Variant
from . import block_matrix, incomplete_cholesky, lines
from . import threads as teams
from .threads import call, meet, share, wait_for_call

SAFE = {wp.float64: 1e-12, wp.float32: 1e-5}
"""Part of a diagonal entry of the coarsest level that its pivot must keep; what does not is left to the lines."""

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
    scalar, vec3, mat33, sliding = variant.scalar, variant.vec3, variant.mat33, variant.sliding
    load, store = memory.functions(variant).load, memory.functions(variant).store
    write_report = block_matrix.functions(variant).write_report
    BlockMatrix, SolverWork = structs(variant).BlockMatrix, structs(variant).SolverWork
    SolveReport, Levels = structs(variant).SolveReport, structs(variant).Levels
    product = incomplete_cholesky.functions(variant).product
    total = teams.functions(variant).total
    line = lines.functions(variant)
    factorize_nodes, factorize_coarse = line.factorize_nodes, line.factorize_coarse
    solve_nodes, solve_coarse = line.solve_nodes, line.solve_coarse
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
        """q = A x of a node, and its part of x·A x."""
        ...

    @wp.kernel(module=module, enable_backward=False)
    def coarsen(
        first: int,
        nodes: int,
        levels: Levels,
        blocks: BlockMatrix,
    ):
        """A block of RᵀAR of a level, those of the level below being there."""
        block = levels.blocks_per_node * first + wp.tid()
        result = mat33()
        for k in range(load(levels.block_start, block), load(levels.block_start, block + 1)):
            source = load(levels.part, k)
            weight = load(levels.part_weight, k)
            turned = source < 0
            if turned:
                source = -1 - source
            m = mat33()
            if first > 0:
                m = load(levels.coarse_block, source)
            elif source < nodes:
                m = load(blocks.diagonal_xx, source)
            else:
                m = load(blocks.upper_xx, source - nodes)
            if turned:
                m = wp.transpose(m)
            result += m * weight
        levels.coarse_block[block] = result

    @wp.kernel(module=module, enable_backward=False)
    def factorize_lines(
        along: int,
        blocks: BlockMatrix,
        is_free: wp.array(dtype=int),
        is_crossing: wp.array(dtype=int),
        levels: Levels,
    ):
        """Every line of the cloth along one direction; warp yarns come first."""
        k = wp.tid() + along * levels.warp_lines
        factorize_nodes(
            along, load(levels.line_start, k), load(levels.line_start, k + 1), levels.line_node,
            blocks, is_free, is_crossing, levels.line_factor, levels.halves,
        )  # fmt: skip

    @wp.kernel(module=module, enable_backward=False)
    def factorize_coarse_lines(along: int, levels: Levels):
        """Every line of the coarse levels along one direction."""
        k = wp.tid() + along * levels.coarse_warp_lines
        factorize_coarse(
            along, load(levels.coarse_line_start, k), load(levels.coarse_line_start, k + 1),
            levels.coarse_line_node, levels.blocks_per_node,
            levels.coarse_block, levels.coarse_line_factor, levels.coarse_halves,
        )  # fmt: skip

    @wp.kernel(module=module, enable_backward=False)
    def factorize_coarsest(first: int, count: int, levels: Levels):
        """The Cholesky factor of the last level, row by row, with the inverse of its diagonal."""
        size = 3 * count
        lower = levels.coarsest
        for i in range(count):
            for j in range(i, count):
                slot = load(levels.coarsest_slot, count * i + j)
                block = mat33()
                if slot >= 0:
                    block = load(levels.coarse_block, levels.blocks_per_node * (first + i) + slot)
                for k in range(3):
                    for m in range(3):
                        store(lower, size * (3 * j + m) + 3 * i + k, block[k, m])
        for j in range(size):
            diagonal = load(lower, size * j + j)
            for i in range(j, size):
                value = load(lower, size * i + j)
                for k in range(j):
                    value -= load(lower, size * i + k) * load(lower, size * j + k)
                if i == j:
                    safe = diagonal > scalar(0.0) and value > scalar(wp.static(SAFE[scalar])) * diagonal
                    store(lower, size * j + j, wp.where(safe, scalar(1.0) / wp.sqrt(value), scalar(0.0)))
                else:
                    store(lower, size * i + j, value * load(lower, size * j + j))

    @wp.func
    def solve_coarsest(levels: Levels, first: int, count: int):
        """z of the last level."""
        size = 3 * count
        for i in range(size):
            node = first + i / 3
            value = load(levels.coarse_r, node)[i % 3]
            for k in range(i):
                value -= load(levels.coarsest, size * i + k) * load(levels.coarse_z, first + k / 3)[k % 3]
            value *= load(levels.coarsest, size * i + i)
            levels.coarse_z[node][i % 3] = value
        for c in range(size):
            i = size - 1 - c
            node = first + i / 3
            value = load(levels.coarse_z, node)[i % 3]
            for k in range(i + 1, size):
                value -= load(levels.coarsest, size * k + i) * load(levels.coarse_z, first + k / 3)[k % 3]
            levels.coarse_z[node][i % 3] = value * load(levels.coarsest, size * i + i)

    @wp.func
    def restrict(levels: Levels, below: wp.array(dtype=vec3), begin: int, end: int):
        """r of coarse nodes from the level below, and the start of their z."""
        for i in range(begin, end):
            r = vec3()
            for k in range(load(levels.child_start, i), load(levels.child_start, i + 1)):
                r += load(below, load(levels.child, k)) * load(levels.child_weight, k)
            store(levels.coarse_r, i, r)
            store(levels.coarse_z, i, -product(load(levels.coarse_halves, i), r))

    @wp.func
    def interpolated(levels: Levels, i: int) -> vec3:
        """z of a node's parents at the node; ``i`` counts the cloth's nodes and then coarse ones."""
        result = vec3()
        for k in range(4 * i, 4 * i + 4):
            j = load(levels.parent, k)
            if j >= 0:
                result += load(levels.coarse_z, j) * load(levels.parent_weight, k)
        return result

    @wp.func
    def precondition(
        strip: int, strips: int, met: int, team: wp.array(dtype=int), nodes: int, levels: Levels,
        r_x: wp.array(dtype=vec3), r_s: wp.array(dtype=scalar), z_x: wp.array(dtype=vec3), z_s: wp.array(dtype=scalar),
    ) -> scalar:  # fmt: skip
        """z = P⁻¹ r, its part of r·z; z is to start at − ½ D⁻¹ r. Comes to ``meetings(levels)`` meetings."""
        count = levels.coarse_levels
        for level in range(count):
            if strips > 1:
                met += strips
                meet(team, met)
            first = load(levels.level_start, level)
            size = load(levels.level_start, level + 1) - first
            begin = first + share(size, strip, strips)
            end = first + share(size, strip + 1, strips)
            if level == 0:
                restrict(levels, r_x, begin, end)
            else:
                restrict(levels, levels.coarse_r, begin, end)
        for direction in range(2):
            if strips > 1:
                met += strips
                meet(team, met)
            first = direction * levels.warp_lines
            size = wp.where(direction == 0, levels.warp_lines, levels.line_start.shape[0] - 1 - levels.warp_lines)
            for k in range(first + share(size, strip, strips), first + share(size, strip + 1, strips)):
                solve_nodes(
                    direction, load(levels.line_start, k), load(levels.line_start, k + 1), levels.line_node,
                    levels.line_factor, levels.line_work, r_x, r_s, z_x, z_s,
                )  # fmt: skip
            first = direction * levels.coarse_warp_lines
            size = wp.where(
                direction == 0,
                levels.coarse_warp_lines,
                levels.coarse_line_start.shape[0] - 1 - levels.coarse_warp_lines,
            )
            for k in range(first + share(size, strip, strips), first + share(size, strip + 1, strips)):
                solve_coarse(
                    direction, load(levels.coarse_line_start, k), load(levels.coarse_line_start, k + 1),
                    levels.coarse_line_node, levels.coarse_line_factor, levels.coarse_line_work,
                    levels.coarse_r, levels.coarse_z,
                )  # fmt: skip
        if strip == 0 and levels.exact > 0:
            solve_coarsest(levels, load(levels.level_start, count - 1), levels.exact)
        for k in range(count - 1):
            if strips > 1:
                met += strips
                meet(team, met)
            level = count - 2 - k
            first = load(levels.level_start, level)
            size = load(levels.level_start, level + 1) - first
            for i in range(first + share(size, strip, strips), first + share(size, strip + 1, strips)):
                store(levels.coarse_z, i, load(levels.coarse_z, i) + interpolated(levels, nodes + i))
        if strips > 1:
            met += strips
            meet(team, met)
        rz = scalar(0.0)
        for i in range(share(nodes, strip, strips), share(nodes, strip + 1, strips)):
            z = load(z_x, i) + interpolated(levels, i)
            store(z_x, i, z)
            rz += wp.dot(load(r_x, i), z)
            if wp.static(sliding):
                rz += load(r_s, 2 * i) * load(z_s, 2 * i) + load(r_s, 2 * i + 1) * load(z_s, 2 * i + 1)
        return rz

    @wp.func
    def meetings(levels: Levels) -> int:
        """How often ``precondition`` meets."""
        return levels.coarse_levels + 3 + wp.max(levels.coarse_levels - 1, 0)

    @wp.kernel(module=module, enable_backward=False)
    def multilevel_conjugate_gradient(
        strip: int,
        team: wp.array(dtype=int),
        # matrix
        nodes: int,
        blocks: BlockMatrix,
        levels: Levels,
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
        """A · solution = rhs, to √(r·P⁻¹r) ≤ tolerance times what it was at the start, in one thread a strip.

        Strip 0 solves once; others are helpers that wait for one solve after the other until they are sent home.
        What is held has a row of 0 in P⁻¹: it keeps its value.
        """
        zero = scalar(0.0)
        strips = team[3]
        begin = share(nodes, strip, strips)
        end = share(nodes, strip + 1, strips)
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
            met = team[5]
            unused = zero
            for i in range(begin, end):
                unused += multiply_row(
                    i, blocks, levels.lower, solution, euler_solution, work.q_x, work.q_s,
                )  # fmt: skip
                r = load(rhs, i) - load(work.q_x, i)
                store(work.r_x, i, r)
                store(work.p_x, i, vec3())
                store(work.t_x, i, -product(load(levels.halves, i), r))
                if wp.static(sliding):
                    for s in range(2 * i, 2 * i + 2):
                        store(work.r_s, s, load(euler_rhs, s) - load(work.q_s, s))
                        store(work.p_s, s, zero)
            rz = precondition(strip, strips, met, team, nodes, levels, work.r_x, work.r_s, work.t_x, work.t_s)
            met += strips * (meetings(levels) + 1)
            rz = total(rz, 0, strip, strips, met, team, work.sums)
            size = rz
            limit = tolerance[0] * tolerance[0] * size
            count = int(0)
            beta = zero
            while count < most_iterations and rz > limit:
                for i in range(begin, end):
                    store(work.p_x, i, load(work.t_x, i) + load(work.p_x, i) * beta)
                    if wp.static(sliding):
                        store(work.p_s, 2 * i, load(work.t_s, 2 * i) + load(work.p_s, 2 * i) * beta)
                        store(work.p_s, 2 * i + 1, load(work.t_s, 2 * i + 1) + load(work.p_s, 2 * i + 1) * beta)
                if strips > 1:
                    met += strips
                    meet(team, met)
                curvature = zero
                for i in range(begin, end):
                    curvature += multiply_row(
                        i, blocks, levels.lower, work.p_x, work.p_s, work.q_x, work.q_s,
                    )  # fmt: skip
                met += strips
                curvature = total(curvature, 1, strip, strips, met, team, work.sums)
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
                rz_next = precondition(strip, strips, met, team, nodes, levels, work.r_x, work.r_s, work.t_x, work.t_s)
                met += strips * (meetings(levels) + 1)
                rz_next = total(rz_next, 2 + count % 2, strip, strips, met, team, work.sums)
                beta = rz_next / rz
                rz = rz_next
                count += 1
            if strips > 1:
                meet(team, met + strips)
            if strip == 0:
                if write_report(count, rz, size, limit, report):
                    worst = scalar(-1.0)
                    for i in range(nodes):
                        here = wp.dot(load(work.r_x, i), load(work.t_x, i))
                        if not (here <= worst):
                            worst = here
                            report.status[1] = i

    return SimpleNamespace(
        coarsen=coarsen,
        factorize_lines=factorize_lines,
        factorize_coarse_lines=factorize_coarse_lines,
        factorize_coarsest=factorize_coarsest,
        multilevel_conjugate_gradient=multilevel_conjugate_gradient,
    )
