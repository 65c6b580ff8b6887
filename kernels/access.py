"""Elements of arrays that are contiguous, as all of ours are.

Warp's own ``array[i]`` loads a stride, multiplies by it, and asks whether i counts from the end: on the CPU as much
work as the product of a 3 × 3 block. Through these the solver's iteration takes three quarters of the time. No adjoint.
"""

import functools
from types import SimpleNamespace

import warp as wp

from .variant import Variant

_READ = "return array.data[i];"
_WRITE = "array.data[i] = value;"


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    """``at(array, i)`` and ``put(array, i, value)``, of every type that the solver's arrays have."""
    scalar, vec3, mat33, sym33 = variant.scalar, variant.vec3, variant.mat33, variant.sym33

    @wp.func_native(_READ)
    def at(array: wp.array(dtype=int), i: int) -> int: ...

    @wp.func_native(_READ)
    def at(array: wp.array(dtype=scalar), i: int) -> scalar: ...  # noqa: F811

    @wp.func_native(_READ)
    def at(array: wp.array(dtype=vec3), i: int) -> vec3: ...  # noqa: F811

    @wp.func_native(_READ)
    def at(array: wp.array(dtype=mat33), i: int) -> mat33: ...  # noqa: F811

    @wp.func_native(_READ)
    def at(array: wp.array(dtype=sym33), i: int) -> sym33: ...  # noqa: F811

    @wp.func_native(_WRITE)
    def put(array: wp.array(dtype=scalar), i: int, value: scalar): ...

    @wp.func_native(_WRITE)
    def put(array: wp.array(dtype=vec3), i: int, value: vec3): ...  # noqa: F811

    @wp.func_native(_WRITE)
    def put(array: wp.array(dtype=sym33), i: int, value: sym33): ...  # noqa: F811

    return SimpleNamespace(at=at, put=put)
