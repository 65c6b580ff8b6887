"""A scene's arrays on the device, named as the kernels' arguments name them, and made as ``declarations.py`` declares.

What a scene does not use is None: without sliding there is nothing of the Eulerian coordinates but their fixed rest
values, without shear and friction nothing of the contact, and so on. What acts on the cloth (``INPUTS``) and is not
there has no name here at all.
"""

from typing import Any

import numpy as np
import warp as wp

from ..description.cloth import CLOTH_NUMBERS, Cloth
from ..description.cloths import Cloths
from ..description.levels import BLOCKS, levels
from ..description.scene import Scene
from ..description.seams import sewn
from ..description.strips import NONE, strips
from ..description.woven import OF_CROSSINGS
from ..kernels import TERMS, Term, Variant
from ..kernels.core.structs import structs
from ..kernels.linear.block_tridiagonal import factor_size
from . import contact, crimp, declarations
from .declared import DeclaredArrays
from .fields import Field, conditions

YARN_PARAMETERS = ("density", "stretch", "bend")

MOVING = {name: 3 if field.kind == "vec3" else field.count for name, field in declarations.MOVING.items()}
"""Numbers a node has in each array that a step changes: the state, and slopes that some methods leave to the next."""
STATE_TYPES = {name: MOVING[name] for name in declarations.STATE}
"""The same of the state."""


class Arrays(DeclaredArrays):
    """Everything that kernels of a scene are launched with: arrays, and the counts that they need.

    Attributes:
        origin: where positions on the device are counted from [m].
        meshes: of each obstacle Warp's mesh, or None; kept for as long as kernels look into them.
    """

    def __init__(self, scene: Scene, variant: Variant, device: Any):
        self.scene = scene
        self.meshes: list[wp.Mesh | None] = []
        self.terms: list[Term] = [TERMS[name] for name in scene.terms]
        self.contact = any(term.needs_contact for term in self.terms)
        self.stencil = max(term.stencil for term in self.terms)
        if scene.contact.samples != "nodes":
            # a middle couples the ends of its segment
            self.stencil = max(self.stencil, 2)
        # Single precision far from 0 would lose the cloth itself: a kilometre away its unit is 60 µm. What is
        # differentiated by positions stays where it is.
        near = variant.scalar is wp.float32 and not variant.reverse
        self.origin = scene.cloth.position.mean(axis=0) if near else np.zeros(3)
        seams = scene.seams if "seams" in scene.terms else scene.seams[:0]
        topology, self.seam_block = sewn(scene.cloth.topology, seams)
        self.topology = topology
        sizes = {
            "world": 1,
            "cloth": 1,
            **_number_sizes(scene.cloth, variant.general),
            "node": topology.nodes,
            "block": self.stencil * topology.nodes,
            "yarn": len(topology.yarn_direction),
            "segment": len(topology.segment_nodes),
            "bend": len(topology.bend_nodes),
            "crossing": len(topology.crossing_node),
            "triangle": len(topology.triangle_nodes),
            "seam": len(self.seam_block),
            "pin": len(scene.pins),
            "gravity step": _rows(scene.gravity),
            "wind step": 1 if scene.wind is None else _rows(scene.wind.velocity),
            "pin step": 0 if scene.pin_path is None else scene.pin_path[..., 0].size,
            "applied": len(scene.force_nodes),
            "applied step": scene.force_path[..., 0].size,
            **contact.sizes(scene),
        }
        dims = {f"{name}s": sizes[name] for name in ("node", "segment", "bend", "crossing", "triangle", "seam", "pin")}
        dims |= contact.dims(sizes) | {"applied": sizes["applied"]}
        super().__init__(variant, device, conditions(scene, variant, self.terms), sizes, dims)
        self._topology(scene.cloth)
        self._parameters(scene)
        for group in (declarations.STATE, declarations.STEP, declarations.ASSEMBLY, declarations.COMPRESSION):
            self.make(group)
        contact.set_arrays(self)
        crimp.set_arrays(self)

    def node_mass(self) -> float:
        """Compute the mean mass of a node [kg]."""
        cloth = self.scene.cloth
        density = np.array([yarn.density for yarn in cloth.yarns])[cloth.material]
        if not cloth.general:
            return float(density[cloth.topology.segment_yarn].sum()) * cloth.spacing / cloth.nodes
        return cloth.mass / cloth.nodes

    def _indices(self, name: str, values: np.ndarray) -> None:
        """Set an index array, or None where the scene has no use for it."""
        field = self._declaration(name)
        there = field.when in self.conditions
        # on the CPU the same memory: nobody writes to either
        shared = {"dtype": field.dtype(self.variant), "device": self.device, "copy": False}
        self[name] = wp.array(np.ascontiguousarray(values), **shared) if there else None

    def _topology(self, cloth: Cloth | Cloths) -> None:
        topology, yarn = self.topology, self.topology.segment_yarn
        free = np.ones(topology.nodes, dtype=np.int32)
        if "hard pins" in self.conditions:
            free[self.scene.pins] = 0
        made = {
            "segments": np.column_stack([topology.segment_nodes, yarn, topology.yarn_direction[yarn]]),
            "neighbour": topology.neighbour[:, : self.stencil].ravel(),
            "is_free": free,
            "corner_blocks": self.blocks(topology.corner_blocks),
            "triangle_blocks": self.blocks(topology.triangle_blocks),
            "seam_nodes": self.scene.seams.ravel(),
            "seam_block": self.seam_block,
            "node_yarns": cloth.node_yarns.ravel() if "general" in self.conditions else None,
        }
        counts = {"nodes": topology.nodes, "columns": cloth.columns, "stencil": self.stencil}
        for name in declarations.TOPOLOGY:
            if name in counts:
                self[name] = counts[name]
            else:
                self._indices(name, made[name] if name in made else getattr(topology, name))

    def blocks(self, blocks: np.ndarray) -> np.ndarray:
        """Find matrix blocks of a stencil six wide in the scene's own."""
        return blocks if self.stencil <= 6 else self.stencil * (blocks // 6) + blocks % 6

    def _parameters(self, scene: Scene) -> None:
        cloth = scene.cloth
        for name in YARN_PARAMETERS:
            self[name] = self.numbers([getattr(cloth.yarns[k], name) for k in cloth.material])
        _set_cloth_numbers(self, cloth)
        if scene.gravity is not None:
            self._vectors("gravity", scene.gravity)
        if scene.wind is not None:
            self._vectors("wind_velocity", scene.wind.velocity)
            self["wind_density"] = self.numbers(scene.wind.density)
            self["wind_drag"] = self.numbers(scene.wind.drag)
        if "seams" in self.conditions:
            self["seam_stiffness"] = self.numbers(scene.seam_stiffness)
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
        for name, parameter in scene.registered.items():
            element = "yarn" if parameter.of == "yarn" else "world"
            kind = "vec3" if parameter.size == 3 else "scalar"
            self.declare(name, Field(element, 1, kind, parameter.unit, "always", "of a term from outside the package"))
            value = scene.registered_value(name)
            self[name] = self.numbers(value[cloth.material] if parameter.of == "yarn" else value[None])

    def _vectors(self, name: str, value: Any) -> None:
        """Sets a vector, and the rows of one that changes; what a function says comes before each step."""
        rows = np.zeros((1, 3)) if callable(value) else np.asarray(value).reshape(-1, 3)
        self[name] = self.numbers(rows[:1])
        if np.ndim(value) == 2:
            self[f"{name}_path"] = self.numbers(rows)

    def add_frames(self, count: int) -> None:
        """Make room for so many frames of what moves, as ``frame_position`` and so on."""
        self.sizes["frame node"] = count * self.sizes["node"]
        self.make(declarations.FRAMES)

    def add_levels(self, with_strips: bool) -> None:
        """Make room for the multilevel preconditioner: its index arrays, and what it factorizes."""
        free = self["is_free"].numpy() != 0
        found = levels(self.topology, self.stencil, free)
        beside = strips(self.topology, self.stencil) if with_strips else NONE
        coarse, sizes = found.coarse_nodes, np.diff(found.level_start)
        exact = int(sizes[-1]) if coarse else 0
        self.sizes |= {
            "line end": len(found.line_start),
            "line node": len(found.line_node),
            "line factor": factor_size(4 if self.variant.sliding else 3) * len(found.line_node),
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
            "strip phase": len(beside.strip_phase),
            "strip end": len(beside.strip_start),
            "strip place": len(beside.strip_node),
            "coarsest pair": exact**2,
            "coarsest entry": (3 * exact) ** 2,
        }
        counts = {"coarse_levels": len(sizes), "blocks_per_node": BLOCKS, "exact": exact}
        counts["strips"] = len(beside.strip_start) - 1
        result = structs(self.variant.forward).Levels()
        for name, field in declarations.LEVELS.items():
            value = counts[name] if name in counts else getattr(found, name, getattr(beside, name, None))
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
        self.dims["strips"] = counts["strips"]
        self.dims["coarse_warp_lines"] = found.coarse_warp_lines
        self.dims["coarse_weft_lines"] = len(found.coarse_line_start) - 1 - found.coarse_warp_lines


def _rows(value: Any) -> int:
    """Counts the steps for which a vector is given; 1 of one that does not change."""
    return len(value) if np.ndim(value) == 2 else 1


def _number_sizes(cloth: Cloth | Cloths, general: bool) -> dict[str, int]:
    """Count what the numbers of a cloth are of: one of each in a plain cloth."""
    topology = cloth.topology
    counts = {
        "gap": 4 * topology.nodes,
        "half": 3 * len(topology.yarn_direction),
        "corner": 4 * len(topology.crossing_node),
        "cloth crossing": topology.nodes,
    }
    return counts if general else dict.fromkeys(counts, 1)


def _set_cloth_numbers(arrays: Arrays, cloth: Cloth | Cloths) -> None:
    """Fill what a cloth says in numbers: single ones, or in a general cloth those of every segment, yarn, ..."""
    general = "general" in arrays.conditions
    for name in CLOTH_NUMBERS:
        if general and name in OF_CROSSINGS:
            arrays[name] = arrays.numbers(cloth.at_nodes(name))
        elif not general or name not in ("spacing", "radius"):
            arrays[name] = arrays.numbers(getattr(cloth, name))
    if general:
        arrays["spacing"] = arrays.numbers(np.concatenate([cloth.node_spacing, cloth.node_widths]).ravel())
        arrays["radius"] = arrays.numbers(np.append(cloth.halves, 1.0 + cloth.yarn_crimp))
        arrays["lock_angle"] = arrays.numbers(cloth.corner_lock.ravel())
    else:
        arrays["lock_angle"] = arrays.numbers(2.0 * np.arcsin(cloth.radius / cloth.spacing))
    arrays["lengthening"] = arrays.numbers(1.0 + cloth.yarn_crimp) if general else None
