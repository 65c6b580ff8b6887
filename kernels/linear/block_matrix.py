"""The implicit system: its matrix on the weave's stencil, and the preconditioned conjugate gradients that solve it.

The matrix is symmetric, so each node keeps its own blocks and those of its upper neighbours only, in fixed slots:
0 and 1 the next crossing of its warp and weft yarn, 2 and 3 the second next, 4 and 5 the diagonal ones. The first
four slots carry sliding blocks of the yarn's own coordinate too (slot mod 2 is its direction); a diagonal neighbour
couples positions alone. A slot that a scene's terms do not fill is not stored (``stencil`` is 2, 4 or 6 wide; 8 where
nodes are sewn together, in slots 6 and 7).

    diagonal_xx [node]        3 × 3    upper_xx [stencil·node + slot]  3 × 3   row x of node, column x of neighbour
    diagonal_xs [2·node + d]  3        upper_xs [4·node + slot]        3       row x of node, column s of neighbour
    diagonal_ss [2·node + d]  1        upper_sx [4·node + slot]        3       row s of node, column x of neighbour
                                       upper_ss [4·node + slot]        1

Three preconditioners P. Here the diagonal of A (``jacobi``), with an iteration in one thread. One that takes a
fraction of the iterations is in ``incomplete_cholesky.py``, with its iteration in ``conjugate_gradient.py``; lines on
many levels are in ``multilevel.py``, with theirs in ``multilevel_conjugate_gradient.py``.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core import memory
from ..core.status import NOT_CONVERGED, NOT_FINITE
from ..core.structs import structs
from ..core.variant import Variant
from . import beside

UPPER = """
    row a = {}, b = {}, c = {}, x_s = {}, u_x = {}, v_x = {};
    SCALAR u_s = 0, v_s = 0;
    auto add = [&](int slot, int direction, row& s_x, SCALAR& s_s) {
        const int j = blocks.neighbour.data[blocks.stencil * i + slot];
        if (j < 0)
            return;
        const SCALAR* m = blocks.upper_xx.data[blocks.stencil * i + slot].data[0];
        const SCALAR* of = x.data[j].c;
        const row its = {of[0], of[1], of[2], 0};
        a = a + *(const row*)m * its;
        b = b + *(const row*)(m + 3) * its;
        c = c + *(const row*)(m + 6) * its;
#if SLIDING
        if (slot < 4) {
            const int k = 4 * i + slot;
            const SCALAR along = s.data[2 * j + direction];
            x_s = x_s + *(const row*)blocks.upper_xs.data[k].c * along;
            s_x = s_x + *(const row*)blocks.upper_sx.data[k].c * its;
            s_s += blocks.upper_ss.data[k] * along;
        }
#endif
    };
"""
"""C++ that adds up row i of U (x, s), slot by slot."""
_UPPER_PRODUCT = (
    UPPER
    + """
    for (int slot = blocks.stencil - 1; slot >= 0; --slot) {
        add(slot, 1, v_x, v_s);
#if SLIDING
        add(--slot, 0, u_x, u_s);
#endif
    }
    wp::vec_t<5, SCALAR> y;
    y.c[0] = a[0] + a[1] + a[2];
    y.c[1] = b[0] + b[1] + b[2];
    y.c[2] = c[0] + c[1] + c[2];
#if SLIDING
    for (int k = 0; k < 3; ++k)
        y.c[k] += x_s[k];
    y.c[3] = u_x[0] + u_x[1] + u_x[2] + u_s;
    y.c[4] = v_x[0] + v_x[1] + v_x[2] + v_s;
#endif
    return y;
"""
)
_SUBTRACT_TRANSPOSED = """
    auto take = [&](int slot, int direction, SCALAR along) {
        const int j = blocks.neighbour.data[blocks.stencil * i + slot];
        if (j < 0)
            return;
        const SCALAR* m = blocks.upper_xx.data[blocks.stencil * i + slot].data[0];
        SCALAR* of = y_x.data[j].c;
        row its = {of[0], of[1], of[2], 0};
        its = its - *(const row*)m * x.c[0];
        its = its - *(const row*)(m + 3) * x.c[1];
        its = its - *(const row*)(m + 6) * x.c[2];
#if SLIDING
        if (slot < 4) {
            const int k = 4 * i + slot;
            its = its - *(const row*)blocks.upper_sx.data[k].c * along;
            y_s.data[2 * j + direction] -= wp::dot(blocks.upper_xs.data[k], x) + blocks.upper_ss.data[k] * along;
        }
#endif
        of[0] = its[0];
        of[1] = its[1];
        of[2] = its[2];
    };
    for (int slot = 0; slot < blocks.stencil; ++slot) {
        take(slot, 0, u);
#if SLIDING
        take(++slot, 1, v);
#endif
    }
"""


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    """Make what both preconditioned iterations share. U is the upper half of A, without its diagonal blocks."""
    scalar, vec3, mat33, sliding = variant.scalar, variant.vec3, variant.mat33, variant.sliding
    vec5 = wp.types.vector(5, scalar)
    load, store = memory.functions(variant).load, memory.functions(variant).store
    BlockMatrix, SolveReport = structs(variant).BlockMatrix, structs(variant).SolveReport
    takes_compression = beside.functions(variant).takes_compression

    @wp.func
    def times(m: mat33, x: vec3) -> vec3:
        """Compute m x. By rows, as they lie in memory: Warp's own product goes by columns."""
        return vec3(wp.dot(m[0], x), wp.dot(m[1], x), wp.dot(m[2], x))

    @wp.func_native(memory.rows(variant, _UPPER_PRODUCT))
    def upper_product_together(
        i: int,
        blocks: BlockMatrix,
        x: wp.array(dtype=vec3),
        s: wp.array(dtype=scalar),
    ) -> vec5: ...

    @wp.func
    def upper_product(
        i: int,
        blocks: BlockMatrix,
        x: wp.array(dtype=vec3),
        s: wp.array(dtype=scalar),
    ):
        """Add up row i of U (x, s): of the position, u and v. The next node comes last: a sweep has it latest."""
        y = upper_product_together(i, blocks, x, s)
        return vec3(y[0], y[1], y[2]), y[3], y[4]

    @wp.func_native(memory.rows(variant, _SUBTRACT_TRANSPOSED))
    def subtract_transposed(
        i: int,
        blocks: BlockMatrix,
        x: vec3,
        u: scalar,
        v: scalar,
        y_x: wp.array(dtype=vec3),
        y_s: wp.array(dtype=scalar),
    ):
        """Add up y −= Uᵀ (x, u, v), what row i of U gives to others."""
        ...

    @wp.func
    def multiply(
        nodes: int,
        blocks: BlockMatrix,
        p_x: wp.array(dtype=vec3),
        p_s: wp.array(dtype=scalar),
        q_x: wp.array(dtype=vec3),
        q_s: wp.array(dtype=scalar),
    ):
        """Add up q += A p. One pass: a row adds its upper half to itself, and the transposed blocks to its
        neighbours."""
        u = scalar(0.0)
        v = scalar(0.0)
        for i in range(nodes):
            x = load(p_x, i)
            y, y_u, y_v = upper_product(i, blocks, p_x, p_s)
            y += times(load(blocks.diagonal_xx, i), x)
            if wp.static(sliding):
                u = load(p_s, 2 * i)
                v = load(p_s, 2 * i + 1)
                xs_u = load(blocks.diagonal_xs, 2 * i)
                xs_v = load(blocks.diagonal_xs, 2 * i + 1)
                y += xs_u * u + xs_v * v
                store(q_s, 2 * i, load(q_s, 2 * i) + y_u + wp.dot(xs_u, x) + load(blocks.diagonal_ss, 2 * i) * u)
                store(
                    q_s,
                    2 * i + 1,
                    load(q_s, 2 * i + 1) + y_v + wp.dot(xs_v, x) + load(blocks.diagonal_ss, 2 * i + 1) * v,
                )
            store(q_x, i, load(q_x, i) + y)
            subtract_transposed(i, blocks, -x, -u, -v, q_x, q_s)

    @wp.func
    def limit_of(tolerance: wp.array(dtype=scalar), size: scalar, report: SolveReport) -> scalar:
        """Compute down to where an iteration goes: nowhere once a step has failed, as a GPU's host hears of it late."""
        if report.status[0] != 0:
            return scalar(wp.static(float("inf")))
        return tolerance[0] * tolerance[0] * size

    @wp.func
    def write_report(
        count: int, rz: scalar, size: scalar, limit: scalar, blocks: BlockMatrix, report: SolveReport
    ) -> bool:
        """Write how the iteration ended, unless a step before has failed; return whether it failed itself."""
        if report.status[0] != 0:
            return False
        report.iterations[0] = count
        report.residual[0] = wp.sqrt(wp.max(rz, scalar(0.0)) / wp.max(size, scalar(1.0e-30)))
        if rz <= limit:
            return False
        if takes_compression(blocks):
            # A − G need not be positive definite, and who asked for it takes A then
            blocks.indefinite[0] = 1
            return False
        report.status[0] = wp.where(wp.isfinite(rz), wp.static(NOT_CONVERGED), wp.static(NOT_FINITE))
        return True

    return SimpleNamespace(
        times=times,
        upper_product=upper_product,
        subtract_transposed=subtract_transposed,
        multiply=multiply,
        limit_of=limit_of,
        write_report=write_report,
    )


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, vec3, sliding = variant.scalar, variant.vec3, variant.sliding
    multiply, limit_of = functions(variant).multiply, functions(variant).limit_of
    write_report = functions(variant).write_report
    module = variant.module("solver")
    BlockMatrix, SolverWork = structs(variant).BlockMatrix, structs(variant).SolverWork
    SolveReport = structs(variant).SolveReport

    @wp.kernel(module=module, enable_backward=False)
    def apply_matrix(
        nodes: int,
        blocks: BlockMatrix,
        p_x: wp.array(dtype=vec3),
        p_s: wp.array(dtype=scalar),
        q_x: wp.array(dtype=vec3),
        q_s: wp.array(dtype=scalar),
    ):
        """Add up q += A p."""
        multiply(
            nodes, blocks, p_x, p_s, q_x, q_s,
        )  # fmt: skip

    @wp.kernel(module=module, enable_backward=False)
    def jacobi_conjugate_gradient(
        # matrix
        nodes: int,
        blocks: BlockMatrix,
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
        work: SolverWork,
        report: SolveReport,
    ):
        """Solve A · solution = rhs, to √(r·P⁻¹r) ≤ tolerance times what it was at the start, in one launch of one
        thread.

        What is held still has an inverse diagonal of 0, so it keeps its value, enters the right-hand side through
        the first residual, and its row of the residual is what holding it takes.
        """
        zero = scalar(0.0)
        for i in range(nodes):
            work.q_x[i] = vec3()
            if wp.static(sliding):
                work.q_s[2 * i] = zero
                work.q_s[2 * i + 1] = zero
        multiply(
            nodes, blocks, solution, euler_solution, work.q_x, work.q_s,
        )  # fmt: skip
        rz = zero
        for i in range(nodes):
            r = rhs[i] - work.q_x[i]
            z = wp.cw_mul(inverse_x[i], r)
            rz += wp.dot(r, z)
            work.r_x[i] = r
            work.p_x[i] = z
            work.q_x[i] = vec3()
            if wp.static(sliding):
                for s in range(2 * i, 2 * i + 2):
                    r_1 = euler_rhs[s] - work.q_s[s]
                    z_1 = inverse_s[s] * r_1
                    rz += r_1 * z_1
                    work.r_s[s] = r_1
                    work.p_s[s] = z_1
                    work.q_s[s] = zero

        size = rz
        limit = limit_of(tolerance, size, report)
        count = int(0)
        while count < most_iterations and rz > limit:
            multiply(
                nodes, blocks, work.p_x, work.p_s, work.q_x, work.q_s,
            )  # fmt: skip
            pq = zero
            for i in range(nodes):
                pq += wp.dot(work.p_x[i], work.q_x[i])
                if wp.static(sliding):
                    pq += work.p_s[2 * i] * work.q_s[2 * i] + work.p_s[2 * i + 1] * work.q_s[2 * i + 1]
            if not (pq > zero):
                # past the attainable accuracy, or not finite
                break
            alpha = rz / pq
            rz_next = zero
            for i in range(nodes):
                solution[i] = solution[i] + work.p_x[i] * alpha
                r = work.r_x[i] - work.q_x[i] * alpha
                rz_next += wp.dot(r, wp.cw_mul(inverse_x[i], r))
                work.r_x[i] = r
                work.q_x[i] = vec3()
                if wp.static(sliding):
                    for s in range(2 * i, 2 * i + 2):
                        euler_solution[s] = euler_solution[s] + work.p_s[s] * alpha
                        r_1 = work.r_s[s] - work.q_s[s] * alpha
                        rz_next += r_1 * inverse_s[s] * r_1
                        work.r_s[s] = r_1
                        work.q_s[s] = zero
            beta = rz_next / rz
            rz = rz_next
            for i in range(nodes):
                work.p_x[i] = wp.cw_mul(inverse_x[i], work.r_x[i]) + work.p_x[i] * beta
                if wp.static(sliding):
                    for s in range(2 * i, 2 * i + 2):
                        work.p_s[s] = inverse_s[s] * work.r_s[s] + work.p_s[s] * beta
            count += 1

        if write_report(count, rz, size, limit, blocks, report):
            worst = scalar(-1.0)
            for i in range(nodes):
                here = wp.dot(work.r_x[i], wp.cw_mul(inverse_x[i], work.r_x[i]))
                if not (here <= worst):
                    worst = here
                    report.status[1] = i

    return SimpleNamespace(apply_matrix=apply_matrix, jacobi_conjugate_gradient=jacobi_conjugate_gradient)
