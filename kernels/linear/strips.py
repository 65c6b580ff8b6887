"""The solver's strips: two neighbouring yarns each, solved together, for cloth whose yarns hardly stretch at all.

    P⁻¹ = what the lines and levels have + Σ over strips S⁻¹

Where yarns are kinked, crossings can move up and down in turn without stretching any yarn if those beside them move
along. A line holds its neighbours, and is stretched by that; two yarns together are not. Strips overlap: every yarn is
in two of them, so every four crossings beside each other are in one along the warp and in one along the weft.

S is the block-tridiagonal part of the matrix of positions along a strip, in blocks of two nodes. It is factorized and
solved as lines are (``block_tridiagonal.py``), so it is positive definite whatever A is. Index arrays are those of
``warp_yarn/description/strips.py``; strips of one phase have no node in common.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core import memory
from ..core.structs import structs
from ..core.variant import Variant
from .block_tridiagonal import FACTORIZE, snippet

_FETCH = """
    const int nodes = blocks.diagonal_xx.shape[0];
    auto is_free = [&](int e, SCALAR* free) {
        for (int side = 0; side < 2; ++side) {
            const int i = node.data[2 * e + side];
            free[3 * side] = free[3 * side + 1] = free[3 * side + 2] = i >= 0 && is_free_x.data[i] != 0;
        }
    };
    // the block of one node and another, to where it stands among those of two and two
    auto fetch = [&](int source, int row, int column, block& m) {
        if (source == 0)
            return;
        const int at = (source < 0 ? -source : source) - 1;
        for (int k = 0; k < 3; ++k)
            for (int j = 0; j < 3; ++j) {
                const SCALAR value = at < nodes ? blocks.diagonal_xx.data[at].data[k][j]
                                                : blocks.upper_xx.data[at - nodes].data[k][j];
                m[source < 0 ? row + j : row + k][source < 0 ? column + k : column + j] = value;
            }
    };
    auto diagonal = [&](int e, block& m) {
        clear(m);
        for (int side = 0; side < 2; ++side)
            fetch(node.data[2 * e + side] + 1, 3 * side, 3 * side, m);
        fetch(source.data[7 * e], 0, 3, m);
        for (int k = 0; k < 3; ++k)
            for (int j = 0; j < 3; ++j)
                m[3 + j][k] = m[k][3 + j];
    };
    auto upper = [&](int e, int slot, block& m) {
        clear(m);
        for (int k = 0; k < (slot == 0 ? 4 : 2); ++k)
            fetch(source.data[7 * e + (slot == 0 ? 1 : 5) + k], slot == 0 ? k / 2 * 3 : 3 * k, k % 2 * 3, m);
    };
    const int direction = 0;
"""
_SOLVE = """
    auto column = [](const SCALAR* m, int k) { return *(const row*)(m + 4 * k); };
    auto vector = [&](int i) {
        if (i < 0)
            return row{};
        return row{r_x.data[i].c[0], r_x.data[i].c[1], r_x.data[i].c[2], 0};
    };
    // y ← (I + G)⁻¹ r, of both nodes
    row y_a = {}, y_b = {};
    for (int e = begin; e < end; ++e) {
        const SCALAR* g = factor.data + (size_t)e * SIZE;
        row a = vector(node.data[2 * e]), b = vector(node.data[2 * e + 1]);
        for (int k = 0; k < 3; ++k) {
            a = a - column(g, 2 * k) * y_a[k] - column(g, 6 + 2 * k) * y_b[k];
            b = b - column(g, 2 * k + 1) * y_a[k] - column(g, 7 + 2 * k) * y_b[k];
        }
        y_a = a;
        y_b = b;
        *(row*)(work.data + 8 * (size_t)e) = a;
        *(row*)(work.data + 8 * (size_t)e + 4) = b;
    }
    // z += (I + G)⁻ᵀ E⁻¹ y
    row x_a = {}, x_b = {};
    for (int e = end - 1; e >= begin; --e) {
        const SCALAR* inv = factor.data + (size_t)e * SIZE + SIZE / 2;
        y_a = *(const row*)(work.data + 8 * (size_t)e);
        y_b = *(const row*)(work.data + 8 * (size_t)e + 4);
        row a = {}, b = {};
        for (int k = 0; k < 3; ++k) {
            a = a + column(inv, 2 * k) * y_a[k] + column(inv, 6 + 2 * k) * y_b[k];
            b = b + column(inv, 2 * k + 1) * y_a[k] + column(inv, 7 + 2 * k) * y_b[k];
        }
        if (e + 1 < end) {
            // Gᵀ of the place behind
            const SCALAR* g = factor.data + (size_t)(e + 1) * SIZE;
            for (int k = 0; k < 3; ++k) {
                const row p = column(g, 2 * k) * x_a + column(g, 2 * k + 1) * x_b;
                const row q = column(g, 6 + 2 * k) * x_a + column(g, 7 + 2 * k) * x_b;
                a[k] = a[k] - (p[0] + p[1] + p[2] + p[3]);
                b[k] = b[k] - (q[0] + q[1] + q[2] + q[3]);
            }
        }
        x_a = a;
        x_b = b;
        for (int side = 0; side < 2; ++side) {
            const int i = node.data[2 * e + side];
            const row x = side == 0 ? x_a : x_b;
            if (i >= 0)
                for (int k = 0; k < 3; ++k)
                    z_x.data[i].c[k] += x[k];
        }
    }
"""


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    """Make what factorizes or solves one strip."""
    scalar, vec3 = variant.scalar, variant.vec3
    BlockMatrix = structs(variant).BlockMatrix

    @wp.func_native(snippet(variant, FACTORIZE.replace("FETCH", _FETCH), 6, place="e"))
    def factorize_strip(
        begin: int,
        end: int,
        node: wp.array(dtype=int),
        source: wp.array(dtype=int),
        blocks: BlockMatrix,
        is_free_x: wp.array(dtype=int),
        factor: wp.array(dtype=scalar),
    ):
        """Factorize a strip."""
        ...

    @wp.func_native(snippet(variant, _SOLVE, 6))
    def solve_strip(
        begin: int,
        end: int,
        node: wp.array(dtype=int),
        factor: wp.array(dtype=scalar),
        work: wp.array(dtype=scalar),
        r_x: wp.array(dtype=vec3),
        z_x: wp.array(dtype=vec3),
    ):
        """Add up z += S⁻¹ r of a strip."""
        ...

    return SimpleNamespace(factorize_strip=factorize_strip, solve_strip=solve_strip)


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    load = memory.functions(variant).load
    factorize_strip = functions(variant).factorize_strip
    BlockMatrix, Levels = structs(variant).BlockMatrix, structs(variant).Levels
    module = variant.module("multilevel")

    @wp.kernel(module=module, enable_backward=False)
    def factorize_strips(blocks: BlockMatrix, is_free: wp.array(dtype=int), levels: Levels):
        """Factorize every strip."""
        k = wp.tid()
        factorize_strip(
            load(levels.strip_start, k), load(levels.strip_start, k + 1), levels.strip_node, levels.strip_source,
            blocks, is_free, levels.strip_factor,
        )  # fmt: skip

    return SimpleNamespace(factorize_strips=factorize_strips)
