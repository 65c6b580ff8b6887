"""Elements of arrays that are contiguous, as all of ours are.

Warp's own ``array[i]`` loads a stride, multiplies by it, and asks whether i counts from the end: on the CPU as much
work as the product of a 3 × 3 block. Through these the solver's iteration takes three quarters of the time. No adjoint.

And rows of blocks as vectors of the machine, for functions in C++ (``rows``): from three numbers, or loops over four,
the compiler makes twice the instructions.
"""

import functools
from types import SimpleNamespace

import warp as wp

from .variant import Variant

_READ = "return array.data[i];"
_WRITE = "array.data[i] = value;"

_ROWS = """
#if defined(__CUDA_ARCH__)
    struct row {
        SCALAR c[4];
        CUDA_CALLABLE SCALAR operator[](int k) const { return c[k]; }
        CUDA_CALLABLE SCALAR& operator[](int k) { return c[k]; }
        CUDA_CALLABLE row operator*(SCALAR s) const { return {c[0] * s, c[1] * s, c[2] * s, c[3] * s}; }
        CUDA_CALLABLE row operator*(row o) const { return {c[0] * o[0], c[1] * o[1], c[2] * o[2], c[3] * o[3]}; }
        CUDA_CALLABLE row operator+(row o) const { return {c[0] + o[0], c[1] + o[1], c[2] + o[2], c[3] + o[3]}; }
        CUDA_CALLABLE row operator-(row o) const { return *this + o * (SCALAR)-1; }
    };
#else
    typedef SCALAR row __attribute__((vector_size(4 * sizeof(SCALAR)), aligned(sizeof(SCALAR)), may_alias));
#endif
"""


def rows(variant: Variant, snippet: str) -> str:
    """Make a function's C++ with the variant's scalar in place of SCALAR, 1 or 0 in place of SLIDING, and a ``row`` of
    four.

    The row of a 3 × 3 block has three: the fourth is the next number in memory, and counts for nothing. Behind every
    block with a neighbour stands another, for the last node has no upper neighbour.
    """
    snippet = (_ROWS + snippet).replace("SCALAR", "double" if variant.scalar is wp.float64 else "float")
    return snippet.replace("SLIDING", str(int(variant.sliding)))


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    """Make ``load(array, i)`` and ``store(array, i, value)``, of every type that the solver's arrays have."""
    scalar, vec3, mat33, sym33 = variant.scalar, variant.vec3, variant.mat33, variant.sym33

    @wp.func_native(_READ)
    def load(array: wp.array(dtype=int), i: int) -> int: ...

    @wp.func_native(_READ)
    def load(array: wp.array(dtype=scalar), i: int) -> scalar: ...  # noqa: F811

    @wp.func_native(_READ)
    def load(array: wp.array(dtype=vec3), i: int) -> vec3: ...  # noqa: F811

    @wp.func_native(_READ)
    def load(array: wp.array(dtype=mat33), i: int) -> mat33: ...  # noqa: F811

    @wp.func_native(_READ)
    def load(array: wp.array(dtype=sym33), i: int) -> sym33: ...  # noqa: F811

    @wp.func_native(_WRITE)
    def store(array: wp.array(dtype=scalar), i: int, value: scalar): ...

    @wp.func_native(_WRITE)
    def store(array: wp.array(dtype=vec3), i: int, value: vec3): ...  # noqa: F811

    @wp.func_native(_WRITE)
    def store(array: wp.array(dtype=sym33), i: int, value: sym33): ...  # noqa: F811

    return SimpleNamespace(load=load, store=store)
