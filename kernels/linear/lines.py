"""The solver's line preconditioner on one grid: every yarn solved exactly, all of them at the same time.

    P⁻¹ = Σ over yarns (L⁻¹ − ½ D⁻¹)

L is the block-tridiagonal part of the matrix A along one yarn, the positions of its nodes and the rates at which they
slide along it; D its diagonal blocks of positions. Every node is on a warp yarn and on a weft yarn, so each takes half
of D⁻¹ away, which both have. What A couples beyond the next node of a yarn (bending) goes to the diagonal blocks of
both nodes.

P is positive definite whatever A: L⁻¹ − ½ D⁻¹ is, because L and the same matrix with the other sign on what is beside
the diagonal, 2 D − L, have the same pivots. Where a pivot is not safely positive the node's own block takes its place,
and nothing is taken away there.

A line is factorized as L = (I + G) E (I + G)ᵀ, G below the diagonal. ``factor`` has Gᵢ and Eᵢ⁻¹ of the nodes of all
lines, line after line, by columns, each of four numbers. What is held, and rates that a node on the border does not
have, have rows and columns of 0 in both.

``multilevel.py`` has the coarser grids, whose lines are solved alike. Coarse nodes have positions alone.
"""

import functools
import re
from types import SimpleNamespace

import warp as wp

from ..core import memory
from ..core.structs import structs
from ..core.variant import Variant

FACTORIZE = """
    // K unknowns a place: a node's position, and where yarns slide its rate along this yarn; or two nodes' positions
    typedef SCALAR block[K][WIDTH];
    auto product = [](const block& a, const block& b, block& c) {
        for (int i = 0; i < K; ++i)
            for (int j = 0; j < K; ++j) {
                SCALAR sum = 0;
                for (int k = 0; k < K; ++k)
                    sum += a[i][k] * b[k][j];
                c[i][j] = sum;
            }
    };
    // the inverse of a positive definite matrix by its Cholesky factor; false where it is not safely one
    auto invert = [](const block& m, int size, block& inverse) {
        block l;
        for (int j = 0; j < size; ++j) {
            for (int i = j; i < size; ++i) {
                SCALAR sum = m[i][j];
                for (int k = 0; k < j; ++k)
                    sum -= l[i][k] * l[j][k];
                if (i == j) {
                    if (!(sum > (SCALAR)SAFE * m[j][j]))
                        return false;
                    l[j][j] = 1 / sqrt(sum);
                } else
                    l[i][j] = sum * l[j][j];
            }
        }
        for (int c = 0; c < size; ++c) {
            SCALAR y[K];
            for (int i = 0; i < size; ++i) {
                SCALAR sum = i == c;
                for (int k = c; k < i; ++k)
                    sum -= l[i][k] * y[k];
                y[i] = i < c ? 0 : sum * l[i][i];
            }
            for (int i = size - 1; i >= c; --i) {
                SCALAR sum = y[i];
                for (int k = i + 1; k < size; ++k)
                    sum -= l[k][i] * inverse[k][c];
                inverse[i][c] = sum * l[i][i];
            }
        }
        for (int i = 0; i < size; ++i)
            for (int j = i + 1; j < size; ++j)
                inverse[i][j] = inverse[j][i];
        return true;
    };
    auto clear = [](block& m) {
        for (int i = 0; i < K; ++i)
            for (int j = 0; j < WIDTH; ++j)
                m[i][j] = 0;
    };
FETCH
    SCALAR free[WIDTH], free_before[WIDTH] = {};
    block own, far, far_before, far_next, next, pivot, inverse, before;
    clear(far_before);
    clear(far_next);
    clear(before);
    clear(inverse);
    for (int e = begin; e < end; ++e) {
        const int i = PLACE;
        SCALAR* g = factor.data + (size_t)e * SIZE;
        SCALAR* inv = g + COLUMN * K;
        is_free(i, free);
        diagonal(i, own);
        SCALAR across[4] = {0, 0, 0, 0}, slides[3] = {0, 0, 0};
#if K == 4
        other_rate(i, free[0], across, slides);
#endif
        for (int k = 0; k < 3; ++k)
            for (int j = 0; j < 3; ++j)
                own[k][j] -= slides[k] * across[j];
        for (int k = 0; k < K; ++k)
            if (free[k] == 0) {
                for (int j = 0; j < K; ++j)
                    own[k][j] = own[j][k] = 0;
                own[k][k] = 1;
            }
        // what is coupled beyond the next node, its symmetric part on the diagonal of both nodes
        upper(i, 2 + direction, far);
        block line;
        for (int k = 0; k < K; ++k)
            for (int j = 0; j < K; ++j) {
                const SCALAR lumped = (far[k][j] + far[j][k] + far_before[k][j] + far_before[j][k]) / 2;
                line[k][j] = own[k][j] + lumped * free[k] * free[j];
            }
        for (int k = 0; k < K; ++k)
            for (int j = 0; j < WIDTH; ++j) {
                far_before[k][j] = far_next[k][j];
                far_next[k][j] = far[k][j];
            }
        // G = Uᵀ E⁻¹ of the node before
        block gain, taken;
        clear(gain);
        clear(taken);
        if (e > begin) {
            for (int k = 0; k < K; ++k)
                for (int j = 0; j < K; ++j)
                    next[k][j] *= free_before[k] * free[j];
            block turned;
            for (int k = 0; k < K; ++k)
                for (int j = 0; j < K; ++j)
                    turned[k][j] = next[j][k];
            product(turned, inverse, gain);
            product(gain, next, taken);
        }
        for (int k = 0; k < K; ++k)
            for (int j = 0; j < K; ++j)
                pivot[k][j] = line[k][j] - taken[k][j];
        clear(inverse);
        SCALAR half = HALF;
        const bool safe = invert(pivot, K, inverse);
        for (int k = 0; k < 3; ++k)
            for (int j = 0; j < 3; ++j) {
                own[k][j] += slides[k] * across[j];
                line[k][j] += slides[k] * across[j];
            }
        if (!safe) {
            half = across[0] = across[1] = across[2] = 0;
            if (!invert(own, K, inverse))
                clear(inverse);
        }
#if K != 6
        block beside;
        clear(beside);
        if (half > 0 && !invert(line, 3, beside))
            half = 0;
        SCALAR sum[6] = {beside[0][0], beside[0][1], beside[0][2], beside[1][1], beside[1][2], beside[2][2]};
        const SCALAR mask[6] = {free[0] * free[0], free[0] * free[1], free[0] * free[2],
                                free[1] * free[1], free[1] * free[2], free[2] * free[2]};
        for (int k = 0; k < 6; ++k) {
            const SCALAR mine = half * mask[k] * sum[k];
            halves.data[i].c[k] = direction == 0 ? mine : halves.data[i].c[k] + mine;
        }
#endif
        for (int k = 0; k < K; ++k)
            for (int j = 0; j < K; ++j)
                inverse[k][j] *= free[k] * free[j];
        for (int k = 0; k < 2 * COLUMN * K; ++k)
            g[k] = 0;
        for (int j = 0; j < K; ++j)
            for (int k = 0; k < K; ++k) {
                // of two nodes, each has a row of four
                const int at = COLUMN * j + k + (K == 6 && k > 2);
                g[at] = gain[k][j];
                inv[at] = inverse[k][j];
            }
#if K == 4
        for (int k = 0; k < 4; ++k)
            g[8 * K + k] = across[k];
#endif
        upper(i, direction, next);
        for (int k = 0; k < K; ++k)
            free_before[k] = free[k];
    }
"""
_FETCH_NODES = """
    auto is_free = [&](int i, SCALAR* free) {
        free[0] = free[1] = free[2] = is_free_x.data[i] != 0;
        free[3] = is_crossing.data[i] != 0;
    };
    auto diagonal = [&](int i, block& m) {
        for (int k = 0; k < 3; ++k)
            for (int j = 0; j < 3; ++j)
                m[k][j] = blocks.diagonal_xx.data[i].data[k][j];
#if SLIDING
        for (int k = 0; k < 3; ++k)
            m[k][3] = m[3][k] = blocks.diagonal_xs.data[2 * i + direction].c[k];
        m[3][3] = blocks.diagonal_ss.data[2 * i + direction];
#endif
    };
#if SLIDING
    auto other_rate = [&](int i, SCALAR free, SCALAR* across, SCALAR* slides) {
        const int o = 2 * i + 1 - direction;
        const SCALAR d = blocks.diagonal_ss.data[o];
        if (is_crossing.data[i] == 0 || !(d > 0))
            return;
        across[3] = 1 / d;
        for (int k = 0; k < 3; ++k) {
            slides[k] = free * blocks.diagonal_xs.data[o].c[k];
            across[k] = slides[k] / d;
        }
    };
#endif
    auto upper = [&](int i, int slot, block& m) {
        if (slot >= blocks.stencil || blocks.neighbour.data[blocks.stencil * i + slot] < 0) {
            clear(m);
            return;
        }
        for (int k = 0; k < 3; ++k)
            for (int j = 0; j < 3; ++j)
                m[k][j] = blocks.upper_xx.data[blocks.stencil * i + slot].data[k][j];
#if SLIDING
        for (int k = 0; k < 3; ++k) {
            m[k][3] = blocks.upper_xs.data[4 * i + slot].c[k];
            m[3][k] = blocks.upper_sx.data[4 * i + slot].c[k];
        }
        m[3][3] = blocks.upper_ss.data[4 * i + slot];
#endif
    };
"""
_FETCH_COARSE = """
    auto is_free = [&](int i, SCALAR* free) {
        free[0] = free[1] = free[2] = coarse_block.data[blocks_per_node * i].data[0][0] > 0;
    };
    auto fetch = [&](int at, block& m) {
        for (int k = 0; k < 3; ++k)
            for (int j = 0; j < 3; ++j)
                m[k][j] = coarse_block.data[at].data[k][j];
    };
    auto diagonal = [&](int i, block& m) { fetch(blocks_per_node * i, m); };
    auto upper = [&](int i, int slot, block& m) { fetch(blocks_per_node * i + 1 + slot, m); };
"""
_SOLVE = """
    auto vector = [&](int i) {
        return row{r_x.data[i].c[0], r_x.data[i].c[1], r_x.data[i].c[2], 0};
    };
    auto column = [](const SCALAR* m, int k) { return *(const row*)(m + 4 * k); };
    // y ← (I + G)⁻¹ r
    row y = {};
    for (int e = begin; e < end; ++e) {
        const int i = node.data[e];
        const SCALAR* g = factor.data + (size_t)e * SIZE;
        row r = vector(i);
#if K == 4
        r = r - column(g, 8) * r_s.data[2 * i + 1 - direction];
        r[3] = r_s.data[2 * i + direction];
#endif
        row a = r - column(g, 0) * y[0];
        row b = column(g, 1) * y[1];
        a = a - column(g, 2) * y[2];
#if K == 4
        b = b + column(g, 3) * y[3];
#endif
        y = a - b;
        *(row*)(work.data + 4 * (size_t)e) = y;
    }
    // z += (I + G)⁻ᵀ E⁻¹ y
    row x = {};
    for (int e = end - 1; e >= begin; --e) {
        const SCALAR* inv = factor.data + (size_t)e * SIZE + 4 * K;
        const row own = *(const row*)(work.data + 4 * (size_t)e);
        row a = column(inv, 0) * own[0] + column(inv, 1) * own[1];
        row b = column(inv, 2) * own[2];
#if K == 4
        b = b + column(inv, 3) * own[3];
#endif
        if (e + 1 < end) {
            // Gᵀ of the node behind
            const SCALAR* g = factor.data + (size_t)(e + 1) * SIZE;
            const row p0 = column(g, 0) * x, p1 = column(g, 1) * x, p2 = column(g, 2) * x;
            auto sum = [](row p) { return p[0] + p[1] + p[2] + p[3]; };
            row taken = {sum(p0), sum(p1), sum(p2), 0};
#if K == 4
            const row p3 = column(g, 3) * x;
            taken[3] = sum(p3);
#endif
            a = a - taken;
        }
        x = a + b;
        const int i = node.data[e];
        z_x.data[i].c[0] += x[0];
        z_x.data[i].c[1] += x[1];
        z_x.data[i].c[2] += x[2];
#if K == 4
        const SCALAR* across = inv + 16;
        SCALAR* own_rate = z_s.data + 2 * i + direction;
        SCALAR* other_rate = z_s.data + 2 * i + 1 - direction;
        const SCALAR other = across[3] * r_s.data[2 * i + 1 - direction]
            - (across[0] * x[0] + across[1] * x[1] + across[2] * x[2]);
        *own_rate = x[3] + (direction == 0 ? 0 : *own_rate);
        *other_rate = other + (direction == 0 ? 0 : *other_rate);
#endif
    }
"""
SAFE = {wp.float64: "1e-11", wp.float32: "1e-5"}
"""Part of a diagonal entry that its pivot must keep."""


def factor_size(unknowns: int) -> int:
    """Count the numbers of a node in a line's factor: G and E⁻¹, and where yarns slide what the other rate follows."""
    return 2 * _column(unknowns) * unknowns + 4 * (unknowns == 4)


def _column(unknowns: int) -> int:
    return 8 if unknowns == 6 else 4


def snippet(variant: Variant, text: str, unknowns: int, half: str = "0.5", place: str = "node.data[e]") -> str:
    """Make a function's C++ for so many unknowns of each place along a line."""
    words = {
        "SAFE": SAFE[variant.scalar],
        "HALF": half,
        "PLACE": place,
        "SIZE": factor_size(unknowns),
        "COLUMN": _column(unknowns),
        "WIDTH": max(unknowns, 4),
        "K": unknowns,
    }
    return memory.rows(variant, re.sub(r"\b(" + "|".join(words) + r")\b", lambda found: str(words[found[0]]), text))


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    """Make what factorizes or solves one line: ``nodes`` of the cloth, with rates where yarns slide, or ``coarse``
    ones."""
    scalar, vec3, mat33, sym33 = variant.scalar, variant.vec3, variant.mat33, variant.sym33
    unknowns = 4 if variant.sliding else 3
    BlockMatrix = structs(variant).BlockMatrix

    @wp.func_native(snippet(variant, FACTORIZE.replace("FETCH", _FETCH_NODES), unknowns, "0.25"))
    def factorize_nodes(
        direction: int,
        begin: int,
        end: int,
        node: wp.array(dtype=int),
        blocks: BlockMatrix,
        is_free_x: wp.array(dtype=int),
        is_crossing: wp.array(dtype=int),
        factor: wp.array(dtype=scalar),
        halves: wp.array(dtype=sym33),
    ):
        """Factorizes a line of the cloth, and adds ½ D⁻¹ to the halves of its nodes; warp yarns come first."""
        ...

    @wp.func_native(snippet(variant, FACTORIZE.replace("FETCH", _FETCH_COARSE), 3))
    def factorize_coarse(
        direction: int,
        begin: int,
        end: int,
        node: wp.array(dtype=int),
        blocks_per_node: int,
        coarse_block: wp.array(dtype=mat33),
        factor: wp.array(dtype=scalar),
        halves: wp.array(dtype=sym33),
    ):
        """Factorizes a line of a coarse level."""
        ...

    @wp.func_native(snippet(variant, _SOLVE, unknowns))
    def solve_nodes(
        direction: int,
        begin: int,
        end: int,
        node: wp.array(dtype=int),
        factor: wp.array(dtype=scalar),
        work: wp.array(dtype=scalar),
        r_x: wp.array(dtype=vec3),
        r_s: wp.array(dtype=scalar),
        z_x: wp.array(dtype=vec3),
        z_s: wp.array(dtype=scalar),
    ):
        """Add up z += L⁻¹ r of a line of the cloth; of rates z = L⁻¹ r, each of which is on one line alone."""
        ...

    @wp.func_native(snippet(variant, _SOLVE, 3))
    def solve_coarse(
        direction: int,
        begin: int,
        end: int,
        node: wp.array(dtype=int),
        factor: wp.array(dtype=scalar),
        work: wp.array(dtype=scalar),
        r_x: wp.array(dtype=vec3),
        z_x: wp.array(dtype=vec3),
    ):
        """Add up z += L⁻¹ r of a line of a coarse level."""
        ...

    return SimpleNamespace(
        factorize_nodes=factorize_nodes,
        factorize_coarse=factorize_coarse,
        solve_nodes=solve_nodes,
        solve_coarse=solve_coarse,
    )
