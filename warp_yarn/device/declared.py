"""Arrays by the names that kernels have for them: made, set, cleared and launched with as they are declared."""

import collections
from typing import Any

import numpy as np
import warp as wp

from ..kernels import Variant, build
from . import declarations
from .fields import Field, Group

Struct: Any = wp._src.codegen.Struct
"""The type of a kernel's argument that is a struct (Warp 1.19 has no public name for it)."""

LARGE = 1 << 20
"""Bytes of an array."""


class DeclaredArrays(collections.UserDict[str, Any]):
    """Arrays of a variant on a device.

    Args:
        variant: of the kernels.
        device: of Warp.
        conditions: those that hold for the scene (``fields.conditions``).
        sizes: how many there are of each element.
        dims: how many threads a launch over elements has.

    Attributes:
        declared: what every name stands for.
    """

    def __init__(
        self, variant: Variant, device: Any, conditions: set[str], sizes: dict[str, int], dims: dict[str, int]
    ):
        super().__init__()
        self.variant, self.device = variant, device
        self.conditions, self.sizes, self.dims = conditions, sizes, dims
        self.declared = dict(declarations.FIELDS)
        self._empty: dict[Any, wp.array] = {}
        self._views: dict[str, np.ndarray] = {}

    def declare(self, name: str, field: Field) -> None:
        """Declare one more name, as of a parameter of a term from outside of the package."""
        if name in self.declared and self.declared[name] != field:
            raise KeyError(f"{name!r} is declared already, as {self.declared[name]}")
        self.declared[name] = field

    def __setitem__(self, name: str, value: Any) -> None:
        """Give a declared name its array.

        Raises:
            KeyError: the name is not declared.
            TypeError: the array is not what is declared.
        """
        if name != "levels":
            field = self._declaration(name)
            if isinstance(value, wp.array):
                count = field.count * self.sizes[field.element]
                dtype = field.dtype(self.variant)
                if value.dtype != dtype or value.shape != (count,):
                    raise TypeError(f"{name} is {value.dtype} {value.shape}, must be {dtype} ({count},): {field}")
        self._views.pop(name, None)
        super().__setitem__(name, value)

    def __missing__(self, name: str) -> Any:
        """Say what a KeyError is about."""
        raise KeyError(f"{name!r} is no array of this scene: a launch has to give it, or it has to be declared")

    def _declaration(self, name: str) -> Field:
        if name not in self.declared:
            raise KeyError(f"{name!r} is not declared in warp_yarn/device/declarations.py")
        return self.declared[name]

    def make(self, group: Group) -> None:
        """Make the arrays of a group, of 0; those that are there stay, and None stands for what the scene has not."""
        for name in group:
            if self.get(name) is None:
                self[name] = self.new(name)

    def new(self, name: str) -> wp.array | None:
        """Make an array of 0 as a name is declared, or None where the scene has none."""
        field = self._declaration(name)
        if field.when not in self.conditions:
            return None
        return self.zeros(field.count * self.sizes[field.element], field.dtype(self.variant))

    def zeros(self, count: int, dtype: Any) -> wp.array:
        """Make an array of 0."""
        return wp.zeros(count, dtype=dtype, device=self.device)

    def numbers(self, values: Any) -> wp.array:
        """Make an array of the variant's scalars, or of its vectors where values has a second axis of 3."""
        values = np.atleast_1d(np.asarray(values, dtype=np.float64))
        dtype = self.variant.vec3 if values.ndim == 2 else self.variant.scalar
        return wp.array(values.astype(wp.dtype_to_numpy(self.variant.scalar)), dtype=dtype, device=self.device)

    # -- values ------------------------------------------------------------------------------------------------------

    def put(self, name: str, *values: float) -> None:
        """Sets all numbers of a small array. On the CPU in its own memory: ``assign`` takes 20 µs to get there."""
        if self.device.is_cpu:
            self.values_of(name).reshape(-1)[:] = values
        else:
            self[name].assign(np.array(values))

    def values_of(self, name: str) -> np.ndarray:
        """Give an array's numbers: on the CPU its own memory, of which Warp takes 2 µs to make a view."""
        if not self.device.is_cpu:
            return self[name].numpy()
        if name not in self._views:
            self._views[name] = self[name].numpy()
        return self._views[name]

    def zero(self, *names: str) -> None:
        """Sets arrays to 0, those that the scene has."""
        for name in names:
            if self[name] is not None:
                self._clear(self[name])

    def require_grad(self, *names: str) -> None:
        """Makes room for the gradients of arrays, those that the scene has."""
        for name in names:
            if self[name] is not None:
                self[name].requires_grad = True

    def zero_grad(self, *names: str) -> None:
        """Sets gradients to 0, of the arrays that the scene has."""
        for name in names:
            if self[name] is not None:
                self._clear(self[name].grad)

    def _clear(self, array: wp.array) -> None:
        """Sets an array to 0: by a kernel where it is large, since zero_ is faster, but a graph that is captured on the
        CPU keeps as many bytes as it clears for itself (Warp 1.19)."""
        if array.capacity < LARGE:
            array.zero_()
        else:
            kind = {self.variant.vec3: "vectors", self.variant.mat33: "matrices"}.get(array.dtype, "numbers")
            clear = build(self.variant)[f"clear_{kind}"]
            # as zero_, no part of a tape
            wp.launch(clear, dim=array.shape[0], inputs=[array], device=self.device, record_tape=False)

    def copy_into(self, target: wp.array | None, source: wp.array | None) -> None:
        """Copy an array by a kernel: wp.copy copies gradients too, and keeps a copy for itself where it is captured on
        the CPU."""
        if target is not None:
            kernel = "copy_vectors" if target.dtype == self.variant.vec3 else "copy_numbers"
            self.launch(build(self.variant)[kernel], target.shape[0], source=source, target=target)

    # -- launches ----------------------------------------------------------------------------------------------------

    def launch(self, kernel: wp.Kernel, elements: str | int, **replaced: Any) -> None:
        """Launch a kernel over elements, its arguments found by their names.

        Args:
            kernel: the kernel.
            elements: what it runs over, a key of ``dims``, or how many threads it has.
            replaced: what it takes in place of others, and what the launch says itself.

        Raises:
            TypeError: the kernel has no argument of such a name.
            KeyError: it has an argument that is neither declared nor given.
        """
        unknown = set(replaced) - arguments(kernel)
        if unknown:
            raise TypeError(
                f"{kernel.key} has no argument {', '.join(sorted(unknown))}, only {sorted(arguments(kernel))}"
            )
        dim = self.dims[elements] if isinstance(elements, str) else elements
        if dim:
            inputs = [self._argument(a.label, a.type, replaced) for a in kernel.adj.args]
            wp.launch(kernel, dim=dim, inputs=inputs, device=self.device)

    def taken(self, kernel: wp.Kernel, **offered: Any) -> dict[str, Any]:
        """Choose what a kernel has arguments for."""
        known = arguments(kernel)
        return {name: value for name, value in offered.items() if name in known}

    def _argument(self, label: str, kind: Any, replaced: dict[str, Any]) -> Any:
        """Find what a kernel's argument is launched with; the fields of a struct are found as arguments are."""
        if label in replaced:
            return replaced[label]
        if label == "levels" or not isinstance(kind, Struct):
            return self.find(label)
        result = kind()
        for name, field in kind.vars.items():
            value = self._argument(name, field.type, replaced)
            setattr(result, name, self._nothing(field.type.dtype) if value is None else value)
        return result

    def _nothing(self, dtype: Any) -> wp.array:
        """Find an array of no length: reverse mode knows no struct with None in it."""
        if dtype not in self._empty:
            self._empty[dtype] = self.zeros(0, dtype)
        return self._empty[dtype]

    def find(self, label: str) -> Any:
        """Find what a name stands for; ``x_grad`` is the gradient of ``x``."""
        if label.endswith("_grad"):
            array = self[label.removesuffix("_grad")]
            return None if array is None else array.grad
        return self[label]


def arguments(kernel: wp.Kernel) -> set[str]:
    """Find the names of a kernel's arguments; in place of a struct those of its fields."""
    names: set[str] = set()
    for argument in kernel.adj.args:
        names |= set(argument.type.vars) if isinstance(argument.type, Struct) else {argument.label}
    return names


def arrays_of(launch: Any) -> list[wp.array]:
    """List the arrays that a launch on a tape was given, those in structs among them."""
    result = []
    for value in launch[3]:
        fields = [getattr(value, name) for name in value._cls.vars] if hasattr(value, "_cls") else [value]
        result += [field for field in fields if isinstance(field, wp.array)]
    return result
