"""Block-tridiagonal matrices along lines and strips of yarns: their factorization, as text of C++.

A matrix is factorized as L = (I + G) E (I + G)ᵀ, G below the diagonal. ``factor`` has Gᵢ and Eᵢ⁻¹ of all places, line
after line, by columns, of four numbers or eight. What A couples beyond the next place (bending) goes to the diagonal
blocks of both. Where a pivot is not safely positive the place's own block takes its place.
"""

import re

import warp as wp

from ..core import memory
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
