"""A scene's arrays on the device, named as the kernels' arguments name them, and made as ``declarations.py`` declares.

What a scene does not use is None: without sliding there is nothing of the Eulerian coordinates but their fixed rest
values, without shear and friction nothing of the contact, and so on. What acts on the cloth (``INPUTS``) and is not
there has no name here at all.
"""

from typing import Any

import numpy as np
import warp as wp

from ..description.cloth import Cloth
from ..description.levels import BLOCKS, levels
from ..description.scene import Scene
from ..kernels import TERMS, Term, Variant, build
from ..kernels.core.structs import structs
from ..simulation.state import CLOTH_NUMBERS
from . import declarations
from .declarations import Field

Struct: Any = wp._src.codegen.Struct
"""The type of a kernel's argument that is a struct (Warp 1.19 has no public name for it)."""

LARGE = 1 << 20
"""Bytes of an array."""

YARN_PARAMETERS = ("density", "stretch", "bend")

STATE_TYPES = {name: 3 if field.kind == "vec3" else field.count for name, field in declarations.STATE.items()}
"""Numbers a node has in each array of the state."""


class Arrays(dict[str, Any]):
    """Everything that kernels of a scene are launched with: arrays, and the counts that they need.

    Attributes:
        declared: what every name stands for.
        conditions: those that hold for the scene (``declarations.conditions``).
        sizes: how many there are of each element.
        dims: how many threads a launch over elements has.
        origin: where positions on the device are counted from [m].
    """

    def __init__(self, scene: Scene, variant: Variant, device: Any):
        super().__init__()
        self.scene, self.variant, self.device = scene, variant, device
        self.declared = dict(declarations.FIELDS)
        self._empty: dict[Any, wp.array] = {}
        self.terms: list[Term] = [TERMS[name] for name in scene.terms]
        self.contact = any(term.needs_contact for term in self.terms)
        self.stencil = max(term.stencil for term in self.terms)
        self.conditions = declarations.conditions(scene, variant, self.terms)
        # Single precision far from 0 would lose the cloth itself: a kilometre away its unit is 60 µm. What is
        # differentiated by positions stays where it is.
        near = variant.scalar is wp.float32 and not variant.reverse
        self.origin = scene.cloth.position.mean(axis=0) if near else np.zeros(3)
        topology = scene.cloth.topology
        self.sizes = {
            "world": 1,
            "cloth": 1,
            "node": topology.nodes,
            "block": self.stencil * topology.nodes,
            "yarn": len(topology.yarn_direction),
            "segment": len(topology.segment_nodes),
            "bend": len(topology.bend_nodes),
            "crossing": len(topology.crossing_node),
            "triangle": len(topology.triangle_nodes),
            "pin": len(scene.pins),
            "pin step": 0 if scene.pin_path is None else scene.pin_path[..., 0].size,
            "applied": len(scene.force_nodes),
            "applied step": scene.force_path[..., 0].size,
        }
        self.dims = {
            f"{name}s": self.sizes[name] for name in ("node", "segment", "bend", "crossing", "triangle", "pin")
        }
        self.dims["applied"] = self.sizes["applied"]
        self._topology(scene.cloth)
        self._parameters(scene)
        for group in (declarations.STATE, declarations.STEP, declarations.ASSEMBLY):
            self.make(group)

    # -- making ------------------------------------------------------------------------------------------------------

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
        super().__setitem__(name, value)

    def _declaration(self, name: str) -> Field:
        if name not in self.declared:
            raise KeyError(f"{name!r} is not declared in warp_yarn/device/declarations.py")
        return self.declared[name]

    def make(self, group: declarations.Group) -> None:
        """Make the arrays of a group, of 0; those that are there stay, and None stands for what the scene has not."""
        for name in group:
            if name not in self:
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

    def _indices(self, name: str, values: np.ndarray) -> None:
        """Set an index array, or None where the scene has no use for it."""
        field = self._declaration(name)
        there = field.when in self.conditions
        # on the CPU the same memory: nobody writes to either
        shared = {"dtype": field.dtype(self.variant), "device": self.device, "copy": False}
        self[name] = wp.array(np.ascontiguousarray(values), **shared) if there else None

    def _topology(self, cloth: Cloth) -> None:
        topology, yarn = cloth.topology, cloth.topology.segment_yarn
        free = np.ones(topology.nodes, dtype=np.int32)
        if "hard pins" in self.conditions:
            free[self.scene.pins] = 0
        made = {
            "segments": np.column_stack([topology.segment_nodes, yarn, topology.yarn_direction[yarn]]),
            "neighbour": topology.neighbour[:, : self.stencil].ravel(),
            "is_free": free,
        }
        counts = {"nodes": topology.nodes, "columns": cloth.weave.columns, "stencil": self.stencil}
        for name in declarations.TOPOLOGY:
            if name in counts:
                self[name] = counts[name]
            else:
                self._indices(name, made[name] if name in made else getattr(topology, name))

    def _parameters(self, scene: Scene) -> None:
        cloth = scene.cloth
        for name in YARN_PARAMETERS:
            self[name] = self.numbers([getattr(cloth.yarns[k], name) for k in cloth.material])
        for name in CLOTH_NUMBERS:
            self[name] = self.numbers(getattr(cloth, name))
        self["lock_angle"] = self.numbers(2.0 * np.arcsin(cloth.radius / cloth.spacing))
        if scene.gravity is not None:
            self["gravity"] = self.numbers(scene.gravity[None])
        if scene.wind is not None:
            self["wind_velocity"] = self.numbers(np.asarray(scene.wind.velocity)[None])
            self["wind_density"] = self.numbers(scene.wind.density)
            self["wind_drag"] = self.numbers(scene.wind.drag)
        if len(scene.pins):
            wanted = cloth.position[scene.pins] if scene.pin_path is None else scene.pin_path[0]
            self["pin_node"] = wp.array(scene.pins, dtype=wp.int32, device=self.device)
            self["pin_target"] = self.numbers(wanted - self.origin)
            if scene.pin_path is not None:
                self["pin_target_path"] = self.numbers(scene.pin_path.reshape(-1, 3) - self.origin)
                self["pin_start"] = self.numbers(cloth.position[scene.pins] - self.origin)
                self["pin_motion"] = self.numbers(np.zeros_like(wanted))
            if scene.pin_stiffness is not None:
                self["pin_stiffness"] = self.numbers(scene.pin_stiffness)
        if len(scene.force_nodes):
            self["applied_node"] = wp.array(scene.force_nodes, dtype=wp.int32, device=self.device)
            self["applied_force"] = self.numbers(scene.force_path[0])
            if len(scene.force_path) > 1:
                self["applied_force_path"] = self.numbers(scene.force_path.reshape(-1, 3))
        self["published_scaling"] = int(scene.published_scaling)

    def add_frames(self, count: int) -> None:
        """Make room for so many frames of what moves, as ``frame_position`` and so on."""
        self.sizes["frame node"] = count * self.sizes["node"]
        self.make(declarations.FRAMES)

    def add_levels(self) -> None:
        """Make room for the multilevel preconditioner: its index arrays, and what it factorizes."""
        free = self["is_free"].numpy() != 0
        found = levels(self.scene.cloth.topology, self.stencil, free)
        coarse, sizes = found.coarse_nodes, np.diff(found.level_start)
        exact = int(sizes[-1]) if coarse else 0
        self.sizes |= {
            "line end": len(found.line_start),
            "line node": len(found.line_node),
            "line factor": 8 * (4 if self.variant.sliding else 3) * len(found.line_node),
            "level end": len(found.level_start),
            "coarse line end": len(found.coarse_line_start),
            "coarse line node": len(found.coarse_line_node),
            "coarse node": coarse,
            "coarse node end": coarse + 1,
            "coarse block": BLOCKS * coarse,
            "coarse block end": BLOCKS * coarse + 1,
            "any node": self.sizes["node"] + coarse,
            "child": len(found.child),
            "part": len(found.part),
            "coarsest pair": exact**2,
            "coarsest entry": (3 * exact) ** 2,
        }
        counts = {"coarse_levels": len(sizes), "blocks_per_node": BLOCKS, "exact": exact}
        result = structs(self.variant.forward).Levels()
        for name, field in declarations.LEVELS.items():
            value = counts[name] if name in counts else getattr(found, name, None)
            if value is None:
                value = self.new(name)
            elif isinstance(value, np.ndarray):
                dtype = field.dtype(self.variant)
                value = np.ascontiguousarray(value).ravel().astype(wp.dtype_to_numpy(dtype))
                value = wp.array(value, dtype=dtype, device=self.device)
            setattr(result, name, value)
        self["levels"] = result
        self.level_start = found.level_start.tolist()
        self.dims["warp_lines"] = found.warp_lines
        self.dims["weft_lines"] = len(found.line_start) - 1 - found.warp_lines
        self.dims["coarse_warp_lines"] = found.coarse_warp_lines
        self.dims["coarse_weft_lines"] = len(found.coarse_line_start) - 1 - found.coarse_warp_lines

    # -- values ------------------------------------------------------------------------------------------------------

    def put(self, name: str, *values: float) -> None:
        """Sets all numbers of a small array. On the CPU in its own memory: ``assign`` takes 20 µs to get there."""
        if self.device.is_cpu:
            self[name].numpy().reshape(-1)[:] = values
        else:
            self[name].assign(np.array(values))

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
        unknown = set(replaced) - _names(kernel)
        if unknown:
            raise TypeError(f"{kernel.key} has no argument {', '.join(sorted(unknown))}, only {sorted(_names(kernel))}")
        dim = self.dims[elements] if isinstance(elements, str) else elements
        if dim:
            inputs = [self._argument(a.label, a.type, replaced) for a in kernel.adj.args]
            wp.launch(kernel, dim=dim, inputs=inputs, device=self.device)

    def taken(self, kernel: wp.Kernel, **offered: Any) -> dict[str, Any]:
        """Choose what a kernel has arguments for."""
        return {name: value for name, value in offered.items() if name in _names(kernel)}

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


def _names(kernel: wp.Kernel) -> set[str]:
    """Find the names of a kernel's arguments, and of the fields of those that are structs."""
    fields = (name for a in kernel.adj.args if isinstance(a.type, Struct) for name in a.type.vars)
    return {a.label for a in kernel.adj.args} | set(fields)


def arrays_of(launch: Any) -> list[wp.array]:
    """List the arrays that a launch on a tape was given, those in structs among them."""
    result = []
    for value in launch[3]:
        fields = [getattr(value, name) for name in value._cls.vars] if hasattr(value, "_cls") else [value]
        result += [field for field in fields if isinstance(field, wp.array)]
    return result
