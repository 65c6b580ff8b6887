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
from ..core.variant import Variant
from . import block_matrix, incomplete_cholesky, lines, pair_blocks
from . import threads as teams
from .lines import BLOCKS
from .threads import call, meet, share, wait_for_call

SAFE = {wp.float64: 1e-12, wp.float32: 1e-5}
"""Part of a diagonal entry of the coarsest level that its pivot must keep; what does not is left to the lines."""

_ROW = (
    block_matrix.UPPER
    + """
    auto add_lower = [&](int slot, int direction, row& s_x, SCALAR& s_s) {
        const int j = lower.data[stencil * i + slot];
        if (j < 0)
            return;
        const SCALAR* m = upper_xx.data[stencil * j + slot].data[0];
        const SCALAR* of = x.data[j].c;
        x_s = x_s + *(const row*)m * of[0] + *(const row*)(m + 3) * of[1] + *(const row*)(m + 6) * of[2];
#if SLIDING
        if (slot < 4) {
            const int k = 4 * j + slot;
            const SCALAR along = s.data[2 * j + direction];
            const row its = {of[0], of[1], of[2], 0};
            x_s = x_s + *(const row*)upper_sx.data[k].c * along;
            s_x = s_x + *(const row*)upper_xs.data[k].c * its;
            s_s += upper_ss.data[k] * along;
        }
#endif
    };
    for (int slot = 0; slot < stencil; slot += 2) {
        add(slot, 0, u_x, u_s);
        add(slot + 1, 1, v_x, v_s);
        add_lower(slot, 0, u_x, u_s);
        add_lower(slot + 1, 1, v_x, v_s);
    }
    const SCALAR* of = x.data[i].c;
    const SCALAR* m = diagonal_xx.data[i].data[0];
    const row its = {of[0], of[1], of[2], 0};
    a = a + *(const row*)m * its;
    b = b + *(const row*)(m + 3) * its;
    // the fourth number behind the last block is not ours
    c = c + row{m[6], m[7], m[8], 0} * its;
#if SLIDING
    const SCALAR u = s.data[2 * i], v = s.data[2 * i + 1];
    const SCALAR* xs_u = diagonal_xs.data[2 * i].c;
    const SCALAR* xs_v = diagonal_xs.data[2 * i + 1].c;
    for (int k = 0; k < 3; ++k)
        x_s[k] += xs_u[k] * u + xs_v[k] * v;
    const SCALAR y_u = u_x[0] + u_x[1] + u_x[2] + u_s + xs_u[0] * of[0] + xs_u[1] * of[1] + xs_u[2] * of[2]
        + diagonal_ss.data[2 * i] * u;
    const SCALAR y_v = v_x[0] + v_x[1] + v_x[2] + v_s + xs_v[0] * of[0] + xs_v[1] * of[1] + xs_v[2] * of[2]
        + diagonal_ss.data[2 * i + 1] * v;
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
def structs(variant: Variant) -> SimpleNamespace:
    """Arrays that belong together, as one argument of a kernel."""
    scalar, vec3, mat33, sym33 = variant.scalar, variant.vec3, variant.mat33, variant.sym33

    @wp.struct
    class Levels:
        """Index arrays of ``warp_yarn.description.levels.Levels``, and the preconditioner's numbers."""

        coarse_levels: int
        warp_lines: int
        coarse_warp_lines: int
        exact: int
        line_start: wp.array(dtype=int)
        line_node: wp.array(dtype=int)
        lower: wp.array(dtype=int)
        level_start: wp.array(dtype=int)
        coarse_line_start: wp.array(dtype=int)
        coarse_line_node: wp.array(dtype=int)
        parent: wp.array(dtype=int)
        parent_weight: wp.array(dtype=scalar)
        child_start: wp.array(dtype=int)
        child: wp.array(dtype=int)
        child_weight: wp.array(dtype=scalar)
        block_start: wp.array(dtype=int)
        part: wp.array(dtype=int)
        part_weight: wp.array(dtype=scalar)
        coarsest_slot: wp.array(dtype=int)
        # numbers: matrices of the coarse levels, factors of all lines, ½ D⁻¹ of both lines of a node, the last level
        coarse_block: wp.array(dtype=mat33)
        line_factor: wp.array(dtype=scalar)
        coarse_line_factor: wp.array(dtype=scalar)
        halves: wp.array(dtype=sym33)
        coarse_halves: wp.array(dtype=sym33)
        coarsest: wp.array(dtype=scalar)
        # work space
        line_work: wp.array(dtype=scalar)
        coarse_line_work: wp.array(dtype=scalar)
        coarse_r: wp.array(dtype=vec3)
        coarse_z: wp.array(dtype=vec3)

    return SimpleNamespace(Levels=Levels)


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, vec3, mat33, sliding = variant.scalar, variant.vec3, variant.mat33, variant.sliding
    at, put = memory.functions(variant).at, memory.functions(variant).put
    report = block_matrix.functions(variant).report
    product = incomplete_cholesky.functions(variant).product
    total = teams.functions(variant).total
    add_pairs, Pairs = pair_blocks.functions(variant).add_pairs, pair_blocks.structs(variant).Pairs
    line = lines.functions(variant)
    factorize_nodes, factorize_coarse = line.factorize_nodes, line.factorize_coarse
    solve_nodes, solve_coarse = line.solve_nodes, line.solve_coarse
    Levels = structs(variant).Levels
    module = variant.module("multilevel")
    variant.fuse("multilevel")

    @wp.func_native(memory.rows(variant, _ROW))
    def multiply_row(
        i: int,
        stencil: int,
        neighbour: wp.array(dtype=int),
        lower: wp.array(dtype=int),
        diagonal_xx: wp.array(dtype=mat33),
        diagonal_xs: wp.array(dtype=vec3),
        diagonal_ss: wp.array(dtype=scalar),
        upper_xx: wp.array(dtype=mat33),
        upper_xs: wp.array(dtype=vec3),
        upper_sx: wp.array(dtype=vec3),
        upper_ss: wp.array(dtype=scalar),
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
        diagonal_xx: wp.array(dtype=mat33),
        upper_xx: wp.array(dtype=mat33),
    ):
        """A block of RᵀAR of a level, those of the level below being there."""
        block = BLOCKS * first + wp.tid()
        result = mat33()
        for k in range(at(levels.block_start, block), at(levels.block_start, block + 1)):
            source = at(levels.part, k)
            weight = at(levels.part_weight, k)
            turned = source < 0
            if turned:
                source = -1 - source
            m = mat33()
            if first > 0:
                m = at(levels.coarse_block, source)
            elif source < nodes:
                m = at(diagonal_xx, source)
            else:
                m = at(upper_xx, source - nodes)
            if turned:
                m = wp.transpose(m)
            result += m * weight
        levels.coarse_block[block] = result

    @wp.kernel(module=module, enable_backward=False)
    def factorize_lines(
        direction: int,
        stencil: int,
        neighbour: wp.array(dtype=int),
        is_free: wp.array(dtype=int),
        is_crossing: wp.array(dtype=int),
        levels: Levels,
        diagonal_xx: wp.array(dtype=mat33),
        diagonal_xs: wp.array(dtype=vec3),
        diagonal_ss: wp.array(dtype=scalar),
        upper_xx: wp.array(dtype=mat33),
        upper_xs: wp.array(dtype=vec3),
        upper_sx: wp.array(dtype=vec3),
        upper_ss: wp.array(dtype=scalar),
    ):
        """Every line of the cloth along one direction; warp yarns come first."""
        k = wp.tid() + direction * levels.warp_lines
        factorize_nodes(
            direction, at(levels.line_start, k), at(levels.line_start, k + 1), levels.line_node, stencil, neighbour,
            is_free, is_crossing, diagonal_xx, diagonal_xs, diagonal_ss, upper_xx, upper_xs, upper_sx, upper_ss,
            levels.line_factor, levels.halves,
        )  # fmt: skip

    @wp.kernel(module=module, enable_backward=False)
    def factorize_coarse_lines(direction: int, levels: Levels):
        """Every line of the coarse levels along one direction."""
        k = wp.tid() + direction * levels.coarse_warp_lines
        factorize_coarse(
            direction, at(levels.coarse_line_start, k), at(levels.coarse_line_start, k + 1), levels.coarse_line_node,
            levels.coarse_block, levels.coarse_line_factor, levels.coarse_halves,
        )  # fmt: skip

    @wp.kernel(module=module, enable_backward=False)
    def factorize_coarsest(first: int, count: int, levels: Levels):
        """The Cholesky factor of the last level, row by row, with the inverse of its diagonal."""
        size = 3 * count
        lower = levels.coarsest
        for i in range(count):
            for j in range(i, count):
                slot = at(levels.coarsest_slot, count * i + j)
                block = mat33()
                if slot >= 0:
                    block = at(levels.coarse_block, BLOCKS * (first + i) + slot)
                for k in range(3):
                    for m in range(3):
                        put(lower, size * (3 * j + m) + 3 * i + k, block[k, m])
        for j in range(size):
            diagonal = at(lower, size * j + j)
            for i in range(j, size):
                value = at(lower, size * i + j)
                for k in range(j):
                    value -= at(lower, size * i + k) * at(lower, size * j + k)
                if i == j:
                    safe = diagonal > scalar(0.0) and value > scalar(wp.static(SAFE[scalar])) * diagonal
                    put(lower, size * j + j, wp.where(safe, scalar(1.0) / wp.sqrt(value), scalar(0.0)))
                else:
                    put(lower, size * i + j, value * at(lower, size * j + j))

    @wp.func
    def solve_coarsest(levels: Levels, first: int, count: int):
        """z of the last level."""
        size = 3 * count
        for i in range(size):
            node = first + i / 3
            value = at(levels.coarse_r, node)[i % 3]
            for k in range(i):
                value -= at(levels.coarsest, size * i + k) * at(levels.coarse_z, first + k / 3)[k % 3]
            value *= at(levels.coarsest, size * i + i)
            levels.coarse_z[node][i % 3] = value
        for c in range(size):
            i = size - 1 - c
            node = first + i / 3
            value = at(levels.coarse_z, node)[i % 3]
            for k in range(i + 1, size):
                value -= at(levels.coarsest, size * k + i) * at(levels.coarse_z, first + k / 3)[k % 3]
            levels.coarse_z[node][i % 3] = value * at(levels.coarsest, size * i + i)

    @wp.func
    def restrict(levels: Levels, below: wp.array(dtype=vec3), begin: int, end: int):
        """r of coarse nodes from the level below, and the start of their z."""
        for i in range(begin, end):
            r = vec3()
            for k in range(at(levels.child_start, i), at(levels.child_start, i + 1)):
                r += at(below, at(levels.child, k)) * at(levels.child_weight, k)
            put(levels.coarse_r, i, r)
            put(levels.coarse_z, i, -product(at(levels.coarse_halves, i), r))

    @wp.func
    def interpolated(levels: Levels, i: int) -> vec3:
        """z of a node's parents at the node; ``i`` counts the cloth's nodes and then coarse ones."""
        result = vec3()
        for k in range(4 * i, 4 * i + 4):
            j = at(levels.parent, k)
            if j >= 0:
                result += at(levels.coarse_z, j) * at(levels.parent_weight, k)
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
            first = at(levels.level_start, level)
            size = at(levels.level_start, level + 1) - first
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
                    direction, at(levels.line_start, k), at(levels.line_start, k + 1), levels.line_node,
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
                    direction, at(levels.coarse_line_start, k), at(levels.coarse_line_start, k + 1),
                    levels.coarse_line_node, levels.coarse_line_factor, levels.coarse_line_work,
                    levels.coarse_r, levels.coarse_z,
                )  # fmt: skip
        if strip == 0 and levels.exact > 0:
            solve_coarsest(levels, at(levels.level_start, count - 1), levels.exact)
        for k in range(count - 1):
            if strips > 1:
                met += strips
                meet(team, met)
            level = count - 2 - k
            first = at(levels.level_start, level)
            size = at(levels.level_start, level + 1) - first
            for i in range(first + share(size, strip, strips), first + share(size, strip + 1, strips)):
                put(levels.coarse_z, i, at(levels.coarse_z, i) + interpolated(levels, nodes + i))
        if strips > 1:
            met += strips
            meet(team, met)
        rz = scalar(0.0)
        for i in range(share(nodes, strip, strips), share(nodes, strip + 1, strips)):
            z = at(z_x, i) + interpolated(levels, i)
            put(z_x, i, z)
            rz += wp.dot(at(r_x, i), z)
            if wp.static(sliding):
                rz += at(r_s, 2 * i) * at(z_s, 2 * i) + at(r_s, 2 * i + 1) * at(z_s, 2 * i + 1)
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
        stencil: int,
        neighbour: wp.array(dtype=int),
        diagonal_xx: wp.array(dtype=mat33),
        diagonal_xs: wp.array(dtype=vec3),
        diagonal_ss: wp.array(dtype=scalar),
        upper_xx: wp.array(dtype=mat33),
        upper_xs: wp.array(dtype=vec3),
        upper_sx: wp.array(dtype=vec3),
        upper_ss: wp.array(dtype=scalar),
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
            touch = pairs.touching[wp.static(pair_blocks.PAIRS)] != 0
            for i in range(begin, end):
                unused += multiply_row(
                    i, stencil, neighbour, levels.lower, diagonal_xx, diagonal_xs, diagonal_ss,
                    upper_xx, upper_xs, upper_sx, upper_ss, solution, euler_solution, q_x, q_s,
                )  # fmt: skip
                if touch:
                    unused += add_pairs(pairs, i, i + 1, solution, q_x)
                r = at(rhs, i) - at(q_x, i)
                put(r_x, i, r)
                put(p_x, i, vec3())
                put(t_x, i, -product(at(levels.halves, i), r))
                if wp.static(sliding):
                    for s in range(2 * i, 2 * i + 2):
                        put(r_s, s, at(euler_rhs, s) - at(q_s, s))
                        put(p_s, s, zero)
            rz = precondition(strip, strips, met, team, nodes, levels, r_x, r_s, t_x, t_s)
            met += strips * (meetings(levels) + 1)
            rz = total(rz, 0, strip, strips, met, team, sums)
            size = rz
            limit = tolerance[0] * tolerance[0] * size
            count = int(0)
            beta = zero
            while count < most_iterations and rz > limit:
                for i in range(begin, end):
                    put(p_x, i, at(t_x, i) + at(p_x, i) * beta)
                    if wp.static(sliding):
                        put(p_s, 2 * i, at(t_s, 2 * i) + at(p_s, 2 * i) * beta)
                        put(p_s, 2 * i + 1, at(t_s, 2 * i + 1) + at(p_s, 2 * i + 1) * beta)
                if strips > 1:
                    met += strips
                    meet(team, met)
                curvature = zero
                for i in range(begin, end):
                    curvature += multiply_row(
                        i, stencil, neighbour, levels.lower, diagonal_xx, diagonal_xs, diagonal_ss,
                        upper_xx, upper_xs, upper_sx, upper_ss, p_x, p_s, q_x, q_s,
                    )  # fmt: skip
                    if touch:
                        curvature += add_pairs(pairs, i, i + 1, p_x, q_x)
                met += strips
                curvature = total(curvature, 1, strip, strips, met, team, sums)
                if not (curvature > zero):
                    # past the attainable accuracy, or not finite
                    break
                alpha = rz / curvature
                for i in range(begin, end):
                    put(solution, i, at(solution, i) + at(p_x, i) * alpha)
                    r = at(r_x, i) - at(q_x, i) * alpha
                    put(r_x, i, r)
                    put(t_x, i, -product(at(levels.halves, i), r))
                    if wp.static(sliding):
                        for s in range(2 * i, 2 * i + 2):
                            put(euler_solution, s, at(euler_solution, s) + at(p_s, s) * alpha)
                            put(r_s, s, at(r_s, s) - at(q_s, s) * alpha)
                rz_next = precondition(strip, strips, met, team, nodes, levels, r_x, r_s, t_x, t_s)
                met += strips * (meetings(levels) + 1)
                rz_next = total(rz_next, 2 + count % 2, strip, strips, met, team, sums)
                beta = rz_next / rz
                rz = rz_next
                count += 1
            if strips > 1:
                meet(team, met + strips)
            if strip == 0:
                if report(count, rz, size, limit, iterations, residual, status):
                    worst = scalar(-1.0)
                    for i in range(nodes):
                        here = wp.dot(at(r_x, i), at(t_x, i))
                        if not (here <= worst):
                            worst = here
                            status[1] = i

    return SimpleNamespace(
        coarsen=coarsen,
        factorize_lines=factorize_lines,
        factorize_coarse_lines=factorize_coarse_lines,
        factorize_coarsest=factorize_coarsest,
        multilevel_conjugate_gradient=multilevel_conjugate_gradient,
    )
