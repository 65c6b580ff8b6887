"""The solver's line preconditioner on one grid: every yarn solved exactly, all of them at the same time.

    P⁻¹ = Σ over yarns (L⁻¹ − ½ D⁻¹)

L is the block-tridiagonal part of the matrix A along one yarn, the positions of its nodes and the rates at which they
slide along it; D its diagonal blocks of positions. Every node is on a warp yarn and on a weft yarn, so each takes half
of D⁻¹ away, which both have; on the cloth itself a quarter, which takes fewer iterations where it is crumpled.

A node has another rate, across the line, which follows it: where it is stretched unevenly, position and both rates go
together. L has that rate too, coupled to its own node alone, and eliminates it: ``across`` has what it follows by,
A_sx / A_ss, and 1 / A_ss.

P is positive definite whatever A: L⁻¹ − ½ D⁻¹ is, because L and the same matrix with the other sign on what is beside
the diagonal, 2 D − L, have the same pivots. Where a pivot is not safe (``block_tridiagonal.py``) nothing is taken away,
and no rate eliminated. What is held, and rates that a node on the border does not have, have rows and columns of 0 in
the factor, whose places are nodes.

``multilevel.py`` has the coarser grids, whose lines are solved alike. Coarse nodes have positions alone.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.structs import structs
from ..core.variant import Variant
from .block_tridiagonal import FACTORIZE, snippet

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
