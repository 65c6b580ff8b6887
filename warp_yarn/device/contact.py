"""What a model's cloth touches by a barrier: arrays of obstacles and of the law, and the host's side of
``kernels/contact``. (``impact_zones.py`` has the other method.)"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import warp as wp

from ..description.obstacles import TriangleMesh
from ..description.scene import Scene
from ..errors import InputError
from ..kernels.contact import distances
from . import declarations
from .energy_watch import AT_START

if TYPE_CHECKING:
    from .arrays import Arrays
    from .model import Model

SPEED = 3.0
"""Of a node whose kinetic energy the default stiffness stops within its range [m/s]: fabric that falls or is thrown."""
NEAR_MARGIN = 0.5
"""Of the list of nodes that are near, in spacings: how far nodes may move relative to each other before a new one."""
OBSTACLE_PATHS = ("obstacle_position_path", "obstacle_rotation_path")
PLACED = ("obstacle_position", "obstacle_rotation", "obstacle_velocity", "obstacle_spin")
"""Arrays that follow from the paths at the time of a stage."""
NEAR_ROOM, FACE_ROOM = 32, 16
"""Nodes and faces near each node that there is room for at first."""


class Near(NamedTuple):
    """What is near each other: a node with another one, or with an obstacle, the other of which is -1 then."""

    node: np.ndarray
    other: np.ndarray
    obstacle: np.ndarray
    gap: np.ndarray
    normal: np.ndarray
    force: np.ndarray


def sizes(scene: Scene) -> dict[str, int]:
    """Count what the contact of a scene has."""
    several = scene.obstacles
    faces = sum(len(obstacle.faces) for obstacle in several if isinstance(obstacle, TriangleMesh))
    return {
        "obstacle": len(several),
        "obstacle step": _steps(scene) * len(several),
        "node obstacle": len(several) * scene.cloth.nodes,
        "face": max(faces, 1),
        "near": 0,
        "near face": FACE_ROOM * scene.cloth.nodes if faces else 0,
    }


def _steps(scene: Scene) -> int:
    """Count the steps in which an obstacle moves."""
    return max((len(obstacle.path) for obstacle in scene.obstacles if obstacle.path is not None), default=0)


def set_arrays(arrays: Arrays) -> None:
    """Fill the arrays of a scene's contact."""
    scene, cloth, contact = arrays.scene, arrays.scene.cloth, arrays.scene.contact
    if "obstacles" in arrays.conditions:
        _set_law(arrays, "contact", contact.distance or cloth.half_thickness, contact.range or cloth.half_thickness)
        _set_obstacles(arrays, scene)
    if "self-contact" in arrays.conditions:
        distance = contact.self_distance or max(1.5 * cloth.longest_spacing, 3.0 * cloth.half_thickness)
        reach = contact.self_range or cloth.longest_spacing
        _set_law(arrays, "self_contact", distance, reach)
        arrays["contact_friction"] = arrays.numbers(contact.friction)
        arrays["near_margin"] = arrays.numbers(NEAR_MARGIN * cloth.longest_spacing)
        arrays["rest_place"] = arrays.numbers(cloth.rest_place.ravel())
    arrays["near_room"] = 0
    arrays["face_room"] = FACE_ROOM if arrays.sizes["near face"] else 0
    arrays.make(declarations.CONTACT)


def _set_law(arrays: Arrays, kind: str, distance: float, reach: float) -> None:
    contact = arrays.scene.contact
    stiffness = contact.stiffness or arrays.node_mass() * (SPEED / reach) ** 2
    arrays[f"{kind}_stiffness"] = arrays.numbers(stiffness)
    arrays[f"{kind}_distance"] = arrays.numbers(distance)
    arrays[f"{kind}_range"] = arrays.numbers(reach)
    arrays[f"{kind}_slip_speed"] = arrays.numbers(contact.slip_speed)
    arrays[f"{kind}_damping_speed"] = arrays.numbers(contact.damping_speed or np.inf)


def _set_obstacles(arrays: Arrays, scene: Scene) -> None:
    several, steps = scene.obstacles, _steps(scene)
    shapes = [getattr(distances, obstacle.shape.upper()) for obstacle in several]
    arrays["obstacle_shape"] = wp.array(shapes, dtype=wp.int32, device=arrays.device)
    arrays["obstacle_size"] = arrays.numbers([obstacle.size for obstacle in several])
    arrays["obstacle_friction"] = arrays.numbers([obstacle.friction for obstacle in several])
    pose = np.array([[*obstacle.position - arrays.origin, *obstacle.rotation] for obstacle in several])
    for place in ("", "_start", "_before") if steps else ("", "_before"):
        arrays[f"obstacle_position{place}"] = arrays.numbers(pose[:, :3])
        arrays[f"obstacle_rotation{place}"] = _quaternions(arrays, pose[:, 3:])
    if steps:
        path = np.tile(pose, (steps, 1, 1))
        for k, obstacle in enumerate(several):
            if obstacle.path is not None:
                path[: len(obstacle.path), k] = obstacle.path
                path[len(obstacle.path) :, k] = obstacle.path[-1]
                path[:, k, :3] -= arrays.origin
        arrays["obstacle_position_path"] = arrays.numbers(path[..., :3].reshape(-1, 3))
        arrays["obstacle_rotation_path"] = _quaternions(arrays, path[..., 3:].reshape(-1, 4))
    first: list[int] = []
    corners: list[np.ndarray] = []
    meshes: list[wp.Mesh | None] = []
    for obstacle in several:
        first.append(int(np.sum([len(corner) for corner in corners])) // 3)
        meshes.append(None)
        if isinstance(obstacle, TriangleMesh):
            corners.append(obstacle.vertices[obstacle.faces].reshape(-1, 3))
            points = wp.array(obstacle.vertices, dtype=wp.vec3, device=arrays.device)
            faces = wp.array(obstacle.faces.ravel(), dtype=wp.int32, device=arrays.device)
            meshes[-1] = wp.Mesh(points, faces)
    arrays.meshes = meshes
    ids = [0 if mesh is None else mesh.id for mesh in meshes]
    arrays["meshes"] = wp.array(ids, dtype=wp.uint64, device=arrays.device)
    arrays["first_face"] = wp.array(first, dtype=wp.int32, device=arrays.device)
    # an array of no length has no gradient
    arrays["mesh_corner"] = arrays.numbers(np.concatenate(corners) if corners else np.zeros((3, 3)))
    counts = [len(obstacle.faces) if isinstance(obstacle, TriangleMesh) else 0 for obstacle in several]
    of_face = np.repeat(np.arange(len(several)), counts) if corners else np.zeros(1)
    arrays["face_obstacle"] = wp.array(of_face.astype(np.int32), dtype=wp.int32, device=arrays.device)


def _quaternions(arrays: Arrays, values: np.ndarray) -> wp.array:
    values = values.astype(wp.dtype_to_numpy(arrays.variant.scalar))
    return wp.array(values, dtype=arrays.variant.quat, device=arrays.device)


class Contact:
    """The contact of a model's cloth with obstacles and with itself, by a barrier.

    Attributes:
        on: whether the scene has any.
        obstacles_move: whether any obstacle has a path.
        damps_impacts: whether a method that has a fallback leaves steps with an impact to it.
        has_mesh: whether any is a mesh.
    """

    damps_impacts = True

    def __init__(self, model: Model):
        self.model, scene = model, model.scene
        # what is not modelled does not hold anything up either
        self.obstacles, self.self_contact = "obstacles" in scene.terms, "self_contact" in scene.terms
        self.on = self.obstacles or self.self_contact
        self.obstacles_move = "obstacles move" in model.arrays.conditions
        self._tapes: dict[int, wp.Tape] = {}
        self.has_mesh = "meshes" in scene.terms
        if self.self_contact:
            if model.preconditioner == "jacobi":
                raise InputError("preconditioner = 'jacobi' with self_contact: must be 'multilevel' or 'incomplete'")
            a, cloth = model.arrays, scene.cloth
            self._reach = float(a["self_contact_distance"].numpy()[0] + a["self_contact_range"].numpy()[0])
            side = int(np.clip(np.sqrt(cloth.nodes) * cloth.longest_spacing / self._reach, 8, 128))
            self.grid = wp.HashGrid(side, side, side, device=a.device, dtype=a.variant.scalar)
            self.grid.reserve(cloth.nodes)
            self.make_room(NEAR_ROOM)

    def make_room(self, room: int | None = None) -> None:
        """Make room for so many nodes near each, or twice as many nodes and faces as there is; the next look makes a
        list."""
        a = self.model.arrays
        if self.self_contact:
            a["near_room"] = room or 2 * a["near_room"]
            a.sizes["near"] = a["near_room"] * a["nodes"]
            a["near"], a["near_block"] = a.new("near"), a.new("near_block")
            # far from everywhere
            a["near_position"].fill_(np.nan)
        if self.has_mesh and room is None:
            a["face_room"] *= 2
            a.sizes["near face"] = a["face_room"] * a["nodes"]
            a["near_face"] = a.new("near_face")

    def find(self) -> None:
        """Look for what contact needs to know of the present positions."""
        if self.on:
            self.model.arrays.zero("touching")
        if self.has_mesh:
            self.model.launch("find_faces", "nodes")
        if self.self_contact:
            self._keep_list(moves=False)

    def _keep_list(self, *, moves: bool) -> None:
        """Make a new list of what is near where nodes have moved too far for the last, or would by a step."""
        self.model.launch("measure_stray", "nodes", moves=int(moves))
        wp.capture_if(self.model.arrays["outdated"], on_true=self._list_near)

    def _list_near(self) -> None:
        a = self.model.arrays
        self.grid.build(a["position"], self._reach + float(a["near_margin"].numpy()[0]))
        self.model.launch("list_near", "nodes", grid=self.grid.id)

    def keep_clear(self) -> None:
        """Let a stage's iteration start where nothing penetrates."""
        if self.obstacles:
            a = self.model.arrays
            # those that stand still were there before, wherever inputs have put them
            end = "_before" if self.obstacles_move else ""
            before = {f"obstacle_{part}_before": a[f"obstacle_{part}{end}"] for part in ("position", "rotation")}
            self.model.launch("start_outside", "nodes", **before)
        if self.self_contact:
            self.model.launch("aim", "nodes")
            self._limit_to_pairs()
            self.model.launch("start_apart", "nodes")
            self.model.launch("check_apart", "nodes")

    def limit_step(self) -> None:
        """Shorten a step of the iteration so that nothing penetrates."""
        if self.obstacles:
            self.model.launch("limit_to_obstacles", "node_obstacles")
        if self.self_contact:
            self._limit_to_pairs()

    def _limit_to_pairs(self) -> None:
        self._keep_list(moves=True)
        self.model.launch("limit_to_list", "nodes")
        self.model.launch("limit_to_pairs", "nodes")

    def ask_for_matrix(self) -> None:
        """Ask for a new matrix where anything touches."""
        if self.on:
            self.model.launch("ask_where_touching", 1)

    def refuse_impact(self) -> None:
        """Leave a step with an impact to a method that damps."""
        if self.on and self.damps_impacts:
            wp.capture_if(self.model.arrays["touching"], on_true=self._note_impacts)
            self.model.launch("refuse_impact", 1)

    def _note_impacts(self) -> None:
        if self.obstacles:
            self.model.launch("note_obstacle_impacts", "node_obstacles")
        if self.self_contact:
            self.model.launch("note_pair_impacts", "nodes")

    def load(self, stage: int) -> None:
        """Put obstacles where they are at the time of a stage, and note where they were at that of the state before."""
        if self.obstacles_move:
            self._place(stage - 1 if stage == 1 else AT_START)
            for part, kernel in (("position", "copy_vectors"), ("rotation", "copy_rotations")):
                a = self.model.arrays
                arrays = {"source": a[f"obstacle_{part}"], "target": a[f"obstacle_{part}_before"]}
                self.model.launch(kernel, "obstacles", **arrays)
            self._place(stage)

    def _place(self, stage: int) -> None:
        self.model.launch("place_obstacles", "obstacles", stage=stage, step_duration=self.model.step_size)

    def scatter_gradient(self, stage: int) -> None:
        """Reverse ``load`` of obstacles: what a stage gave to where they were goes to the rows of their paths."""
        if stage not in self._tapes:
            self._tapes[stage] = wp.Tape()
            with self._tapes[stage]:
                self._place(stage)
        self._tapes[stage].backward()
        self.model.arrays.zero_grad(*PLACED)

    def add_power(self) -> None:
        """Add the power of moving obstacles to ``power``."""
        if self.obstacles_move:
            self.model.launch("add_obstacle_power", "node_obstacles")
            if self.has_mesh:
                self.model.launch("add_mesh_power", "nodes")

    # -- reports -----------------------------------------------------------------------------------------------------

    def near_obstacles(self) -> Near:
        """Report every node and obstacle, and their force."""
        nodes, several = self.model.scene.cloth.nodes, len(self.model.scene.obstacles)
        self.find()
        gaps, forces = self._reported("report_contacts", "node_obstacles", nodes * several)
        node, obstacle = np.divmod(np.arange(nodes * several), max(several, 1))
        return Near(node, np.full_like(node, -1), obstacle, gaps[:, 3], gaps[:, :3], forces)

    def near_faces(self) -> Near:
        """Report every node and face of a mesh that are near each other, and their force."""
        a, nodes = self.model.arrays, self.model.scene.cloth.nodes
        self.find()
        room = a["face_room"]
        gaps, forces = self._reported("report_faces", "nodes", nodes * room)
        node, slot = np.divmod(np.arange(nodes * room), room)
        kept = slot < a["face_count"].numpy()[node]
        obstacle = a["face_obstacle"].numpy()[a["near_face"].numpy()[kept]]
        node = node[kept]
        return Near(node, np.full_like(node, -1), obstacle, gaps[kept, 3], gaps[kept, :3], forces[kept])

    def near_pairs(self) -> Near:
        """Report every two nodes that are near each other, and their force."""
        a, nodes = self.model.arrays, self.model.scene.cloth.nodes
        self.find()
        room = a["near_room"]
        gaps, forces = self._reported("report_pairs", "nodes", nodes * room)
        node, slot = np.divmod(np.arange(nodes * room), room)
        other = a["near"].numpy()
        kept = (slot < a["near_count"].numpy()[node]) & (node < other)
        node, other = node[kept], other[kept]
        return Near(node, other, np.full_like(node, -1), gaps[kept, 3], gaps[kept, :3], forces[kept])

    def _reported(self, kernel: str, elements: str, count: int) -> tuple[np.ndarray, np.ndarray]:
        a = self.model.arrays
        arrays: dict[str, Any] = {
            "gaps": a.zeros(count, a.variant.vec4),
            "contact_forces": a.zeros(count, a.variant.vec3),
        }
        self.model.launch(kernel, elements, **arrays)
        return arrays["gaps"].numpy(), arrays["contact_forces"].numpy()
