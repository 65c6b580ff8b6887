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
from . import contact_declarations, samples
from .energy_watch import AT_START
from .samples import Samples

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
SAMPLED = ("position", "velocity", "increment")
"""Arrays of nodes that contact reads."""
NEAR_ROOM, FACE_ROOM = 8, 16
"""Samples and faces near each sample that there is room for at first."""
SAMPLES_A_NODE = 3.0
"""With middles: a node has two segments, but at the border."""


class Near(NamedTuple):
    """What is near each other: a sample with another one, or with an obstacle, the other of which is -1 then."""

    sample: np.ndarray
    other: np.ndarray
    obstacle: np.ndarray
    gap: np.ndarray
    normal: np.ndarray
    force: np.ndarray


def sizes(scene: Scene) -> dict[str, int]:
    """Count what the contact of a scene has."""
    several, nodes = scene.obstacles, scene.cloth.nodes
    samples = nodes if scene.contact.samples == "nodes" else nodes + len(scene.cloth.topology.segment_nodes)
    faces = sum(len(obstacle.faces) for obstacle in several if isinstance(obstacle, TriangleMesh))
    return {
        "obstacle": len(several),
        "obstacle step": _steps(scene) * len(several),
        "sample": samples,
        "face": max(faces, 1),
        "near": 0,
        "touch": 0,
        "near face": FACE_ROOM * samples if faces else 0,
    }


def dims(sizes: dict[str, int]) -> dict[str, int]:
    """Count what kernels of contact run over, by ``sizes``."""
    samples, obstacles = sizes["sample"], sizes["obstacle"]
    return {"obstacles": obstacles, "samples": samples, "sample_obstacles": samples * obstacles}


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
        place = cloth.rest_place
        if "middles" in arrays.conditions:
            place = np.concatenate([place, place[cloth.topology.segment_nodes].mean(axis=1)])
        arrays["rest_place"] = arrays.numbers(place.ravel())
    if "middles" in arrays.conditions:
        samples.set_arrays(arrays)
    arrays["near_room"] = arrays["touch_room"] = 0
    arrays["face_room"] = FACE_ROOM if arrays.sizes["near face"] else 0
    arrays.make(contact_declarations.CONTACT)


def _set_law(arrays: Arrays, kind: str, distance: float, reach: float) -> None:
    contact = arrays.scene.contact
    # all that touches is as stiff, of however many samples
    more = 1.0 if contact.samples == "nodes" else SAMPLES_A_NODE ** (1 if kind == "contact" else 2)
    stiffness = contact.stiffness or arrays.node_mass() / more * (SPEED / reach) ** 2
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
        samples: what touches.
        last: the last of its terms, or None.
    """

    damps_impacts = True

    def __init__(self, model: Model):
        self.model, scene = model, model.scene
        # what is not modelled does not hold anything up either
        self.obstacles, self.self_contact = "obstacles" in scene.terms, "self_contact" in scene.terms
        self.on = self.obstacles or self.self_contact
        self.obstacles_move = "obstacles move" in model.arrays.conditions
        self.samples = Samples(model)
        self.last = next((term for term in reversed(model.arrays.terms) if term.touches), None)
        self._tapes: dict[int, wp.Tape] = {}
        self.has_mesh = "meshes" in scene.terms
        if self.self_contact:
            if model.preconditioner == "jacobi":
                raise InputError("preconditioner = 'jacobi' with self_contact: must be 'multilevel' or 'incomplete'")
            a, cloth = model.arrays, scene.cloth
            self._reach = float(a["self_contact_distance"].numpy()[0] + a["self_contact_range"].numpy()[0])
            side = int(np.clip(np.sqrt(cloth.nodes) * cloth.longest_spacing / self._reach, 8, 128))
            self.grid = wp.HashGrid(side, side, side, device=a.device, dtype=a.variant.scalar)
            self.grid.reserve(self.samples.count)
            self.make_room(NEAR_ROOM)

    def make_room(self, room: int | None = None) -> None:
        """Make room for so many samples near each, or for twice as many of what is full, and twice as many faces; the
        next look makes a list. Where a later matrix has counted anew since, twice as many of both."""
        a = self.model.arrays
        if self.self_contact:
            # of what is near, half may touch
            kinds = {"near": (1, ("near",)), "touch": (2, ("touch", "touch_block"))}
            full = [kind for kind in kinds if int(a[f"{kind}_count"].numpy().max()) >= a[f"{kind}_room"]]
            for kind in kinds if room else full or kinds:
                part, arrays = kinds[kind]
                a[f"{kind}_room"] = max(room // part, 1) if room else 2 * a[f"{kind}_room"]
                a.sizes[kind] = a[f"{kind}_room"] * self.samples.count
                for name in arrays:
                    a[name] = a.new(name)
            # far from everywhere
            a["near_position"].fill_(np.nan)
        if self.has_mesh and room is None:
            a["face_room"] *= 2
            a.sizes["near face"] = a["face_room"] * self.samples.count
            a["near_face"] = a.new("near_face")

    def find(self, *, matrix: bool = False) -> None:
        """Look for what contact needs to know of the present positions, before any of its terms."""
        if not (self.on or self.has_mesh):
            return
        self.model.arrays.zero("touching")
        self.samples.clear(matrix=matrix)
        place = {name: array for name, array in self.samples.of(*SAMPLED).items() if name == "position"}
        if self.has_mesh:
            self.model.launch("find_faces", "samples", **place)
        if self.self_contact:
            self._keep_list(moves=False)

    def _keep_list(self, *, moves: bool) -> None:
        """Make a new list of what is near where samples have moved too far for the last, or would by a step."""
        arrays = self.samples.standing_in("position", "direction")
        self.model.launch("measure_stray", "samples", moves=int(moves), nodes=self.samples.count, **arrays)
        wp.capture_if(self.model.arrays["outdated"], on_true=self._list_near)

    def _list_near(self) -> None:
        a, place = self.model.arrays, self.samples.standing_in("position")
        reach = self._reach + float(a["near_margin"].numpy()[0])
        self.grid.build(place.get("position", a["position"]), reach)
        self.model.launch("list_near", "samples", grid=self.grid.id, **place)

    def keep_clear(self) -> None:
        """Let a stage's iteration start where nothing penetrates."""
        if self.obstacles:
            a = self.model.arrays
            # those that stand still were there before, wherever inputs have put them
            end = "_before" if self.obstacles_move else ""
            before = {f"obstacle_{part}_before": a[f"obstacle_{part}{end}"] for part in ("position", "rotation")}
            self.model.launch("start_outside", "nodes", **before)
            self.samples.start_outside(**before)
        if self.self_contact:
            self.model.launch("aim", "nodes")
            self._limit_to_pairs()
            self.model.launch("start_apart", "nodes")
            arrays = self.samples.of("position", "base_position", "solution") | self.samples.standing_in("is_free")
            self.model.launch("check_apart", "samples", nodes=self.samples.count, **arrays)

    def limit_step(self) -> None:
        """Shorten a step of the iteration so that nothing penetrates."""
        if self.obstacles:
            arrays = self.samples.of("position", "direction")
            if arrays:
                arrays["is_free"] = self.model.arrays["sample_moves"]
            self.model.launch("limit_to_obstacles", "sample_obstacles", **arrays)
        if self.self_contact:
            self._limit_to_pairs()

    def _limit_to_pairs(self) -> None:
        arrays = self.samples.of("position", "direction")
        self._keep_list(moves=True)
        of_list = {name: array for name, array in arrays.items() if name == "direction"}
        self.model.launch("limit_to_list", "samples", nodes=self.samples.count, **of_list)
        self.model.launch("limit_to_pairs", "samples", **arrays)

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
        arrays = self.samples.of(*SAMPLED)
        if self.obstacles:
            self.model.launch("note_obstacle_impacts", "sample_obstacles", **arrays)
        if self.self_contact:
            self.model.launch("note_pair_impacts", "samples", **arrays)

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
            arrays = self.samples.of("position", "velocity")
            self.model.launch("add_obstacle_power", "sample_obstacles", **arrays)
            if self.has_mesh:
                self.model.launch("add_mesh_power", "samples", **arrays)

    # -- reports -----------------------------------------------------------------------------------------------------

    def near_obstacles(self) -> Near:
        """Report every sample and obstacle, and their force."""
        several = len(self.model.scene.obstacles)
        every = np.arange(self.samples.count * several)
        gaps, forces = self._reported("report_contacts", "sample_obstacles", len(every))
        sample, obstacle = np.divmod(every, max(several, 1))
        return Near(sample, np.full_like(sample, -1), obstacle, gaps[:, 3], gaps[:, :3], forces)

    def near_faces(self) -> Near:
        """Report every sample and face of a mesh that are near each other, and their force."""
        a, room = self.model.arrays, self.model.arrays["face_room"]
        gaps, forces = self._reported("report_faces", "samples", self.samples.count * room)
        sample, slot = np.divmod(np.arange(self.samples.count * room), room)
        kept = slot < a["face_count"].numpy()[sample]
        obstacle = a["face_obstacle"].numpy()[a["near_face"].numpy()[kept]]
        sample = sample[kept]
        return Near(sample, np.full_like(sample, -1), obstacle, gaps[kept, 3], gaps[kept, :3], forces[kept])

    def near_pairs(self) -> Near:
        """Report every two samples that are near each other, and their force."""
        a, room = self.model.arrays, self.model.arrays["near_room"]
        gaps, forces = self._reported("report_pairs", "samples", self.samples.count * room)
        sample, slot = np.divmod(np.arange(self.samples.count * room), room)
        other = a["near"].numpy()
        kept = (slot < a["near_count"].numpy()[sample]) & (sample < other)
        sample, other = sample[kept], other[kept]
        return Near(sample, other, np.full_like(sample, -1), gaps[kept, 3], gaps[kept, :3], forces[kept])

    def _reported(self, kernel: str, elements: str, count: int) -> tuple[np.ndarray, np.ndarray]:
        self.find()
        a = self.model.arrays
        arrays: dict[str, Any] = {
            "gaps": a.zeros(count, a.variant.vec4),
            "contact_forces": a.zeros(count, a.variant.vec3),
        }
        self.model.launch(kernel, elements, **arrays, **self.samples.standing_in("position", "velocity"))
        return arrays["gaps"].numpy(), arrays["contact_forces"].numpy()
