"""The solver's incomplete Cholesky preconditioner.

    P = (E + U)ᵀ E⁻¹ (E + U),   E_j = A_jj − Σ_i U_ijᵀ E_i⁻¹ U_ij

U is the upper blocks of A as they are, E block-diagonal: only the diagonal blocks are corrected. Along one yarn that is
the exact factorization, and warp and weft stretch along different directions, so little is dropped: at 17 × 17 it needs
10 iterations to 1e-6 where the diagonal of A needs 125, its diagonal blocks 86 (so there is no block Jacobi), and on
larger cloths 9, 151 and 107.

The layout of the matrix is told in ``solver.py``.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core import memory
from ..core.variant import Variant

_CORRECT_PIVOTS = """
    for (int slot = 0; slot < stencil; ++slot) {
        const int j = neighbour.data[stencil * i + slot];
        if (j >= 0) {
            const SCALAR* b = upper_xx.data[stencil * i + slot].data[0];
            const row b0 = *(const row*)b, b1 = *(const row*)(b + 3), b2 = *(const row*)(b + 6);
            const row x = b0 * m.c[0] + b1 * m.c[1] + b2 * m.c[2];
            const row y = b0 * m.c[1] + b1 * m.c[3] + b2 * m.c[4];
            const row z = b0 * m.c[2] + b1 * m.c[4] + b2 * m.c[5];
            const row first = x * b[0] + y * b[3] + z * b[6];
            const row second = x * b[1] + y * b[4] + z * b[7];
            SCALAR* e = pivot.data[j].c;
            e[0] -= first[0];
            e[1] -= first[1];
            e[2] -= first[2];
            e[3] -= second[1];
            e[4] -= second[2];
            e[5] -= x[2] * b[2] + y[2] * b[5] + z[2] * b[8];
        }
    }
"""


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    scalar, vec3, mat33, sym33 = variant.scalar, variant.vec3, variant.mat33, variant.sym33

    @wp.func
    def symmetric(m: mat33) -> sym33:
        return sym33(m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2])

    @wp.func
    def product(m: sym33, x: vec3) -> vec3:
        """Compute m x."""
        return vec3(
            m[0] * x[0] + m[1] * x[1] + m[2] * x[2],
            m[1] * x[0] + m[3] * x[1] + m[4] * x[2],
            m[2] * x[0] + m[4] * x[1] + m[5] * x[2],
        )

    @wp.func_native(memory.rows(variant, _CORRECT_PIVOTS))
    def correct_pivots(
        m: sym33, i: int, stencil: int, neighbour: wp.array(dtype=int), upper_xx: wp.array(dtype=mat33),
        pivot: wp.array(dtype=sym33),
    ):  # fmt: skip
        """Correct pivots, pivot −= bᵀ m b of the neighbours of a node, b its blocks."""
        ...

    @wp.func
    def inverse_of(m: sym33) -> sym33:
        """Invert a positive definite matrix; 0 where it is not safely so."""
        c00 = m[3] * m[5] - m[4] * m[4]
        c01 = m[2] * m[4] - m[1] * m[5]
        c02 = m[1] * m[4] - m[2] * m[3]
        c11 = m[0] * m[5] - m[2] * m[2]
        c12 = m[1] * m[2] - m[0] * m[4]
        c22 = m[0] * m[3] - m[1] * m[1]
        determinant = m[0] * c00 + m[1] * c01 + m[2] * c02
        safe = scalar(wp.static(1.0e-6))
        if m[0] > scalar(0.0) and c22 > safe * m[0] * m[3] and determinant > safe * c22 * m[5]:
            f = scalar(1.0) / determinant
            return sym33(c00 * f, c01 * f, c02 * f, c11 * f, c12 * f, c22 * f)
        return sym33()

    return SimpleNamespace(symmetric=symmetric, product=product, correct_pivots=correct_pivots, inverse_of=inverse_of)


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, mat33, sym33 = variant.scalar, variant.mat33, variant.sym33
    load, store = memory.functions(variant).load, memory.functions(variant).store
    symmetric, correct_pivots = functions(variant).symmetric, functions(variant).correct_pivots
    inverse_of = functions(variant).inverse_of
    variant.fuse("incomplete")

    @wp.kernel(module=variant.module("incomplete"), enable_backward=False)
    def factorize(
        nodes: int,
        stencil: int,
        neighbour: wp.array(dtype=int),
        is_free: wp.array(dtype=int),
        diagonal_xx: wp.array(dtype=mat33),
        upper_xx: wp.array(dtype=mat33),
        inverse_pivot: wp.array(dtype=sym33),
    ):
        """Compute E⁻¹ of the positions, E being added up in its place; 0 for what is held, which keeps it out.

        Sliding coordinates keep their diagonal: friction's damping dominates it, and their share of E changes the
        iterations by less than one.
        """
        for i in range(nodes):
            store(inverse_pivot, i, symmetric(load(diagonal_xx, i)))
        for i in range(nodes):
            inverse = sym33()
            if is_free[i] != 0:
                inverse = inverse_of(load(inverse_pivot, i))
                if inverse[0] <= scalar(0.0):
                    # What was dropped made it indefinite: any positive definite E will do, so take the block itself.
                    inverse = symmetric(wp.inverse(diagonal_xx[i]))
                correct_pivots(inverse, i, stencil, neighbour, upper_xx, inverse_pivot)
            store(inverse_pivot, i, inverse)

    return SimpleNamespace(factorize=factorize)
