"""A scene's arrays on the device, named as the kernels' arguments name them.

What a scene does not use is None: without sliding there is nothing of the Eulerian coordinates but their fixed rest
values, without shear and friction nothing of the contact, and so on.
"""

from typing import Any

import numpy as np
import warp as wp

from ..description.cloth import Cloth
from ..description.levels import BLOCKS, levels
from ..description.obstacles import SPEED
from ..description.scene import Scene
from ..kernels import TERMS, Term, Variant, build
from ..kernels.contact import barrier, distances
from ..kernels.contact import obstacles as obstacle_contact
from ..kernels.linear import multilevel, pair_blocks
from ..simulation.state import CLOTH_NUMBERS

NEAR_MARGIN = 0.5
"""Of the list of nodes that are near, in spacings: how far nodes may move relative to each other before a new one."""
NEAR_ROOM = 32
"""Nodes near each that there is room for at first."""
LARGE = 1 << 20
"""Bytes of an array."""

YARN_PARAMETERS = ("density", "stretch", "bend")

STATE_TYPES = {"position": 3, "euler": 2, "velocity": 3, "euler_velocity": 2, "anchor": 2}
"""Numbers a node has in each array of the state."""


class Arrays(dict[str, Any]):
    """Everything that kernels of a scene are launched with: arrays, and the two counts that they need."""

    def __init__(self, scene: Scene, variant: Variant, device: Any):
        super().__init__()
        self.scene, self.variant, self.device = scene, variant, device
        self.terms: list[Term] = [TERMS[name] for name in scene.terms]
        self.contact = any(term.needs_contact for term in self.terms)
        self.stencil = max(term.stencil for term in self.terms)
        # Single precision far from 0 would lose the cloth itself: a kilometre away its unit is 60 µm. What is
        # differentiated by positions stays where it is.
        near = variant.scalar is wp.float32 and not variant.reverse
        self.origin = scene.cloth.position.mean(axis=0) if near else np.zeros(3)
        """Where positions on the device are counted from [m]."""
        self._topology(scene.cloth)
        self._parameters(scene)
        self._state()
        self._work()
        self._structs: dict[str, tuple[Any, Any]] = {}
        law = barrier.structs(variant.forward).ContactLaw
        self._kinds = {
            "obstacles": (obstacle_contact.structs(variant.forward).Obstacles, ""),
            "law": (law, "contact_"),
            "self_law": (law, "self_contact_"),
            "pairs": (pair_blocks.structs(variant.forward).Pairs, ""),
        }
        """Structs of arrays, and what their arrays' names begin with."""
        self["tries"] = self.zeros(1, wp.int32)
        self["touching"] = self.zeros(3, wp.int32)
        if scene.obstacles:
            self._law(
                "contact", scene.contact.distance or scene.cloth.radius, scene.contact.range or scene.cloth.radius
            )
            self._obstacles(scene)
        if scene.self_contact:
            self._self_contact(scene)
        self.dims = {
            "nodes": self["nodes"],
            "segments": len(self["segment_nodes"]),
            "bends": len(self["bend_nodes"]),
            "crossings": len(self["crossing_node"]),
            "triangles": len(self["triangle_nodes"]) if self["triangle_nodes"] is not None else 0,
            "pins": len(scene.pins),
            "applied": len(scene.force_nodes),
            "obstacles": len(scene.obstacles),
            "node_obstacles": len(scene.obstacles) * self["nodes"],
        }

    def zeros(self, count: int, dtype: Any) -> wp.array:
        return wp.zeros(count, dtype=dtype, device=self.device)

    def numbers(self, values: Any) -> wp.array:
        """A parameter: an array of the variant's scalars, or of its vectors where values has a second axis of 3."""
        values = np.atleast_1d(np.asarray(values, dtype=np.float64))
        dtype = self.variant.vec3 if values.ndim == 2 else self.variant.scalar
        return wp.array(values.astype(wp.dtype_to_numpy(self.variant.scalar)), dtype=dtype, device=self.device)

    def _topology(self, cloth: Cloth) -> None:
        topology = cloth.topology
        used = {term.name for term in self.terms}
        skipped = {"shear": "corner_", "wind": "triangle_"}
        skipped = tuple(prefix for term, prefix in skipped.items() if term not in used)
        vectors = {1: wp.int32, 2: wp.vec2i, 3: wp.vec3i, 4: wp.vec4i}
        for name, values in vars(topology).items():
            if name == "neighbour":
                values = np.ascontiguousarray(values[:, : self.stencil]).ravel()
            if not isinstance(values, np.ndarray) or name == "node_yarns":
                continue
            dtype = vectors[1 if values.ndim == 1 else values.shape[1]]
            # on the CPU the same memory: nothing writes to either
            shared = {"dtype": dtype, "device": self.device, "copy": False}
            self[name] = None if name.startswith(skipped) else wp.array(values, **shared)
        free = np.ones(topology.nodes, dtype=np.int32)
        if self.scene.pin_stiffness is None:
            free[self.scene.pins] = 0
        self["is_free"] = wp.array(free, dtype=wp.int32, device=self.device)
        self["nodes"], self["stencil"] = topology.nodes, self.stencil

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

    def _obstacles(self, scene: Scene) -> None:
        several, variant = scene.obstacles, self.variant
        shapes = [getattr(distances, obstacle.shape.upper()) for obstacle in several]
        self["obstacle_shape"] = wp.array(shapes, dtype=wp.int32, device=self.device)
        self["obstacle_size"] = self.numbers([obstacle.size for obstacle in several])
        self["obstacle_friction"] = self.numbers([obstacle.friction for obstacle in several])
        pose = np.array([[*obstacle.position - self.origin, *obstacle.rotation] for obstacle in several])
        steps = max((len(obstacle.path) for obstacle in several if obstacle.path is not None), default=0)
        for place in ("", "_start", "_before") if steps else ("",):
            self[f"obstacle_position{place}"] = self.numbers(pose[:, :3])
            self[f"obstacle_rotation{place}"] = self.quaternions(pose[:, 3:])
        if steps:
            path = np.tile(pose, (steps, 1, 1))
            for k, obstacle in enumerate(several):
                if obstacle.path is not None:
                    path[: len(obstacle.path), k] = obstacle.path
                    path[len(obstacle.path) :, k] = obstacle.path[-1]
                    path[:, k, :3] -= self.origin
            self["obstacle_position_path"] = self.numbers(path[..., :3].reshape(-1, 3))
            self["obstacle_rotation_path"] = self.quaternions(path[..., 3:].reshape(-1, 4))
        else:
            self["obstacle_position_before"] = self["obstacle_position"]
            self["obstacle_rotation_before"] = self["obstacle_rotation"]
        for name in ("obstacle_velocity", "obstacle_spin"):
            self[name] = self.zeros(len(several), variant.vec3)
        first, corners, self.meshes = [], [np.zeros((0, 3))], []
        for obstacle in several:
            first.append(sum(map(len, corners)) // 3)
            if obstacle.shape == "mesh":
                corners.append(obstacle.vertices[obstacle.faces].reshape(-1, 3))
                points = wp.array(obstacle.vertices, dtype=wp.vec3, device=self.device)
                faces = wp.array(obstacle.faces.ravel(), dtype=wp.int32, device=self.device)
                self.meshes.append(wp.Mesh(points, faces))
            else:
                self.meshes.append(None)
        ids = [0 if mesh is None else mesh.id for mesh in self.meshes]
        self["meshes"] = wp.array(ids, dtype=wp.uint64, device=self.device)
        self["first_face"] = wp.array(first, dtype=wp.int32, device=self.device)
        # a dummy where there is no mesh: arrays of no length have no gradient
        soup = np.concatenate(corners)
        self["mesh_corner"] = self.numbers(soup if len(soup) else np.zeros((1, 3)))
        self["mesh_face"] = self.zeros(len(several) * self["nodes"], wp.int32)

    def _law(self, kind: str, distance: float, reach: float) -> None:
        contact = self.scene.contact
        stiffness = contact.stiffness or self.node_mass() * (SPEED / reach) ** 2
        self[f"{kind}_stiffness"] = self.numbers(stiffness)
        self[f"{kind}_distance"] = self.numbers(distance)
        self[f"{kind}_range"] = self.numbers(reach)
        self[f"{kind}_slip_speed"] = self.numbers(contact.slip_speed)
        self[f"{kind}_damping_speed"] = self.numbers(contact.damping_speed or np.inf)

    def _self_contact(self, scene: Scene) -> None:
        cloth, nodes = scene.cloth, self["nodes"]
        distance = scene.contact.self_distance or max(1.5 * cloth.spacing, 3.0 * cloth.radius)
        reach = scene.contact.self_range or cloth.spacing
        self._law("self_contact", distance, reach)
        self["contact_friction"] = self.numbers(scene.contact.friction)
        margin = NEAR_MARGIN * cloth.spacing
        self["near_margin"] = self.numbers(margin)
        self["near_reach"] = self.numbers(distance + reach + margin)
        self["folds_from"] = self.numbers(0.5 * np.pi * (distance + reach))
        self["rest_place"] = self.numbers(cloth.rest_place.ravel())
        self["near_count"] = self.zeros(nodes, wp.int32)
        self["near_position"] = self.zeros(nodes, self.variant.vec3)
        self["outdated"] = self.zeros(1, wp.int32)
        side = int(np.clip(np.sqrt(nodes) * cloth.spacing / (distance + reach), 8, 128))
        self.grid = wp.HashGrid(side, side, side, device=self.device, dtype=self.variant.scalar)
        self.grid.reserve(nodes)
        self.make_near_room(NEAR_ROOM)

    def make_near_room(self, room: int) -> None:
        """Makes room for so many nodes near each; the next look makes a list."""
        self["near_room"] = room
        self["near"] = self.zeros(room * self["nodes"], wp.int32)
        self["near_block"] = self.zeros(room * self["nodes"], self.variant.sym33)
        # far from everywhere
        self["near_position"].fill_(np.nan)

    def node_mass(self) -> float:
        """Mean mass of a node [kg]."""
        cloth = self.scene.cloth
        density = np.array([yarn.density for yarn in cloth.yarns])[cloth.material]
        return float(density[cloth.topology.segment_yarn].sum()) * cloth.spacing / cloth.nodes

    def quaternions(self, values: np.ndarray) -> wp.array:
        return wp.array(
            values.astype(wp.dtype_to_numpy(self.variant.scalar)), dtype=self.variant.quat, device=self.device
        )

    def struct(self, label: str) -> Any:
        """Arrays that a kernel takes as one argument, as they are now: Warp copies their addresses."""
        kind, prefix = self._kinds[label]
        arrays = {name: self[prefix + name] for name in kind.vars if prefix + name in self}
        addresses = tuple(
            (array.ptr, array.grad and array.grad.ptr) if isinstance(array, wp.array) else array
            for array in arrays.values()
        )
        if label not in self._structs or self._structs[label][0] != addresses:
            made = kind()
            for name, array in arrays.items():
                setattr(made, name, array)
            self._structs[label] = addresses, made
        return self._structs[label][1]

    def _state(self) -> None:
        n, scalar, vec3 = self["nodes"], self.variant.scalar, self.variant.vec3
        friction = any(term.name == "friction" for term in self.terms)
        for name, width in STATE_TYPES.items():
            stored = {"euler_velocity": self.variant.sliding, "anchor": friction}.get(name, True)
            dtype, count = (vec3, n) if width == 3 else (scalar, 2 * n)
            self[name] = self.zeros(count, dtype) if stored else None

    def _work(self) -> None:
        n, scalar, vec3, mat33 = self["nodes"], self.variant.scalar, self.variant.vec3, self.variant.mat33
        sliding = self.variant.sliding
        self["normal"] = self.zeros(n, vec3) if self.contact else None
        self["contact_load"] = self.zeros(n, scalar) if self.contact else None
        for name in ("force", "momentum", "rhs", "solution", "r_x", "p_x", "q_x", "t_x", "inverse_x"):
            self[name] = self.zeros(n, vec3)
        for name in (
            "euler_force",
            "euler_momentum",
            "euler_rhs",
            "euler_solution",
            "r_s",
            "p_s",
            "q_s",
            "t_s",
            "inverse_s",
        ):
            self[name] = self.zeros(2 * n, scalar) if sliding else None
        self["friction_force_out"] = self.zeros(2 * n, scalar) if self["anchor"] is not None else None
        self["diagonal_xx"] = self.zeros(n, mat33)
        self["inverse_pivot"] = self.zeros(n, self.variant.sym33)
        self["upper_xx"] = self.zeros(self.stencil * n, mat33)
        for name, count, dtype in (
            ("diagonal_xs", 2 * n, vec3),
            ("diagonal_ss", 2 * n, scalar),
            ("upper_xs", 4 * n, vec3),
            ("upper_sx", 4 * n, vec3),
            ("upper_ss", 4 * n, scalar),
        ):
            self[name] = self.zeros(count, dtype) if sliding else None
        self["status"] = self.zeros(3, wp.int32)
        self["counters"] = self.zeros(2, wp.int32)
        self["iterations"] = self.zeros(1, wp.int32)
        self["residual"] = self.zeros(1, scalar)
        self["weights"] = self.zeros(1, vec3)
        self["step_size"] = self.zeros(1, scalar)
        self["remaining"] = self.zeros(1, scalar)
        self["stage_times"] = self.zeros(4, scalar)

    def add_levels(self) -> None:
        """Makes room for the multilevel preconditioner: its index arrays, and what it factorizes."""
        free = self["is_free"].numpy() != 0
        found = levels(self.scene.cloth.topology, self.stencil, free)
        unknowns = 4 if self.variant.sliding else 3
        scalar, vec3, mat33, sym33 = self.variant.scalar, self.variant.vec3, self.variant.mat33, self.variant.sym33
        result = multilevel.structs(self.variant.forward).Levels()
        for name, values in vars(found).items():
            if isinstance(values, np.ndarray):
                dtype = wp.int32 if values.dtype == np.int32 else scalar
                values = np.ascontiguousarray(values).ravel().astype(wp.dtype_to_numpy(dtype))
                setattr(result, name, wp.array(values, dtype=dtype, device=self.device))
            else:
                setattr(result, name, values)
        coarse = found.coarse_nodes
        sizes = np.diff(found.level_start)
        result.coarse_levels = len(sizes)
        result.exact = int(sizes[-1]) if coarse else 0
        for name, count, dtype in (
            ("coarse_block", BLOCKS * coarse, mat33),
            ("line_factor", 8 * unknowns * len(found.line_node), scalar),
            ("coarse_line_factor", 24 * len(found.coarse_line_node), scalar),
            ("halves", self["nodes"], sym33),
            ("coarse_halves", coarse, sym33),
            ("coarsest", (3 * result.exact) ** 2, scalar),
            ("line_work", 4 * len(found.line_node), scalar),
            ("coarse_line_work", 4 * len(found.coarse_line_node), scalar),
            ("coarse_r", coarse, vec3),
            ("coarse_z", coarse, vec3),
        ):
            setattr(result, name, self.zeros(count, dtype))
        self["levels"] = result
        self.level_start = found.level_start.tolist()
        self.dims["warp_lines"] = found.warp_lines
        self.dims["weft_lines"] = len(found.line_start) - 1 - found.warp_lines
        self.dims["coarse_warp_lines"] = found.coarse_warp_lines
        self.dims["coarse_weft_lines"] = len(found.coarse_line_start) - 1 - found.coarse_warp_lines

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

    def launch(self, kernel: wp.Kernel, elements: str | int, **replaced: Any) -> None:
        """Launches a kernel over elements, its arguments found by their names."""
        dim = self.dims[elements] if isinstance(elements, str) else elements
        if dim:
            inputs = [replaced[a.label] if a.label in replaced else self.find(a.label) for a in kernel.adj.args]
            # what has no reverse is no part of a tape
            wp.launch(kernel, dim=dim, inputs=inputs, device=self.device, record_tape=kernel.options["enable_backward"])

    def find(self, label: str) -> Any:
        """What a kernel's argument of this name stands for; ``x_grad`` is the gradient of ``x``."""
        if label.endswith("_grad"):
            array = self[label.removesuffix("_grad")]
            return None if array is None else array.grad
        if label in self._kinds:
            return self.struct(label)
        return self[label]

    def add_frames(self, count: int) -> None:
        """Makes room for so many frames of what moves, as ``frame_position`` and so on."""
        for name in STATE_TYPES:
            array = self[name]
            still = array is None or (name == "euler" and not self.variant.sliding)
            self[f"frame_{name}"] = None if still else self.zeros(count * array.shape[0], array.dtype)
