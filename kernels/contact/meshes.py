"""Contact of nodes with the triangles of meshes, by the law of ``barrier.py`` in the distance to every triangle near.

    V = Σ V(|x − closest point of the triangle|)

The distance to a triangle has a gradient everywhere off it, that to a whole mesh has none where two faces are as close:
in a valley between two of them a node would feel one or the other, and find no rest. Beside an edge both of its faces
push, so that cloth lies a little higher there.

Parameters: as those of ``obstacles.py``.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.indexing import index
from ..core.status import CROWDED, fail
from ..core.structs import structs
from ..core.variant import Term, Variant
from . import barrier, distances, obstacles
from .barrier import DISTANCE, RANGE
from .distances import MESH


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    vec3, vec4 = variant.vec3, variant.vec4
    closest_on_triangle = distances.functions(variant).closest_on_triangle
    Obstacles, Faces = structs(variant).Obstacles, structs(variant).Faces

    @wp.func
    def to_face(obstacles: Obstacles, faces: Faces, face: int, x: vec3) -> vec4:
        """Find (n, g) of a place and a face."""
        k = faces.face_obstacle[face]
        local = wp.quat_rotate_inv(obstacles.obstacle_rotation[k], x - obstacles.obstacle_position[k])
        corner = 3 * face
        away = local - closest_on_triangle(
            local, faces.mesh_corner[corner], faces.mesh_corner[corner + 1], faces.mesh_corner[corner + 2]
        )
        n = wp.quat_rotate(obstacles.obstacle_rotation[k], wp.normalize(away))
        return vec4(n[0], n[1], n[2], wp.length(away))

    return SimpleNamespace(to_face=to_face)


def define(variant: Variant) -> wp.Kernel:
    scalar, vec3 = variant.scalar, variant.vec3
    to_face, obstacle_speed = functions(variant).to_face, obstacles.functions(variant).obstacle_speed
    law_of, note_contact = barrier.functions(variant).law_of, barrier.functions(variant).note
    contact_force, contact_matrix = barrier.functions(variant).force, barrier.functions(variant).matrix
    Obstacles, Faces, BlockMatrix = structs(variant).Obstacles, structs(variant).Faces, structs(variant).BlockMatrix

    @variant.kernel("meshes")
    def mesh_term(
        obstacles: Obstacles,
        faces: Faces,
        contact_stiffness: wp.array(dtype=scalar),
        contact_distance: wp.array(dtype=scalar),
        contact_range: wp.array(dtype=scalar),
        contact_slip_speed: wp.array(dtype=scalar),
        contact_damping_speed: wp.array(dtype=scalar),
        # state in
        position: wp.array(dtype=vec3),
        velocity: wp.array(dtype=vec3),
        increment: wp.array(dtype=vec3),
        step_size: wp.array(dtype=scalar),
        # forces out, and whether anything touches
        force: wp.array(dtype=vec3),
        touching: wp.array(dtype=int),
        # matrix out
        matrix: int,
        blocks: BlockMatrix,
    ):
        i = index(wp.tid())
        law = law_of(contact_stiffness, contact_distance, contact_range, contact_slip_speed, contact_damping_speed)
        for place in range(i * faces.face_room, i * faces.face_room + faces.face_count[i]):
            face = index(faces.near_face[place])
            k = index(faces.face_obstacle[face])
            x = position[i]
            at = to_face(obstacles, faces, face, x)
            if at[3] < law[DISTANCE] + law[RANGE]:
                n = vec3(at[0], at[1], at[2])
                v = velocity[i] - obstacle_speed(obstacles, k, x)
                friction = obstacles.obstacle_friction[k]
                wp.atomic_add(force, i, contact_force(law, friction, at[3], n, v))
                note_contact(law, n, v, increment[i], step_size[0], touching)
                if matrix != 0:
                    xx = contact_matrix(law, friction, at[3], n, v, blocks.coefficients[0], blocks.evaluations[0])
                    wp.atomic_add(blocks.diagonal_xx, i, xx)

    return mesh_term


def define_energy(variant: Variant) -> wp.Kernel:
    scalar, vec3 = variant.scalar, variant.vec3
    to_face, barrier_of = functions(variant).to_face, barrier.functions(variant).barrier
    Obstacles, Faces = structs(variant).Obstacles, structs(variant).Faces

    @variant.kernel("meshes")
    def mesh_energy(
        obstacles: Obstacles,
        faces: Faces,
        contact_stiffness: wp.array(dtype=scalar),
        contact_distance: wp.array(dtype=scalar),
        contact_range: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        energy: wp.array(dtype=scalar),
    ):
        i = index(wp.tid())
        reach = contact_range[0]
        for place in range(i * faces.face_room, i * faces.face_room + faces.face_count[i]):
            x = (to_face(obstacles, faces, faces.near_face[place], position[i])[3] - contact_distance[0]) / reach
            if x < scalar(1.0):
                wp.atomic_add(energy, 0, contact_stiffness[0] * reach * reach * barrier_of(x)[0])

    return mesh_energy


@functools.cache
def define_search(variant: Variant) -> SimpleNamespace:
    """Define what finds the faces that are near, and reports them."""
    scalar, vec3, vec4 = variant.scalar, variant.vec3, variant.vec4
    vec5 = wp.types.vector(5, scalar)
    to_face, obstacle_speed = functions(variant).to_face, obstacles.functions(variant).obstacle_speed
    law_of, contact_force = barrier.functions(variant).law_of, barrier.functions(variant).force
    Obstacles, Faces = structs(variant).Obstacles, structs(variant).Faces
    module = variant.module("mesh_search")

    @wp.kernel(module=module, enable_backward=False)
    def find_faces(
        obstacles: Obstacles,
        meshes: wp.array(dtype=wp.uint64),
        faces: Faces,
        contact_distance: wp.array(dtype=scalar),
        contact_range: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        status: wp.array(dtype=int),
    ):
        """List the faces that push a node. The search tree is in single precision, so the box is a little larger."""
        i = index(wp.tid())
        touch = contact_distance[0] + contact_range[0]
        count = int(0)
        for k in range(obstacles.obstacle_shape.shape[0]):
            if obstacles.obstacle_shape[k] == wp.static(MESH):
                local = wp.quat_rotate_inv(obstacles.obstacle_rotation[k], position[i] - obstacles.obstacle_position[k])
                place = wp.vec3(float(local[0]), float(local[1]), float(local[2]))
                margin = float(touch) * 1.001 + 1.0e-6 * wp.length(place)
                box = wp.vec3(margin, margin, margin)
                found = int(0)
                query = wp.mesh_query_aabb(meshes[k], place - box, place + box)
                while wp.mesh_query_aabb_next(query, found):
                    face = obstacles.first_face[k] + found
                    if to_face(obstacles, faces, face, position[i])[3] < touch:
                        if count < faces.face_room:
                            faces.near_face[i * faces.face_room + count] = face
                        count += 1
        if count > faces.face_room:
            fail(status, wp.static(CROWDED), i)
        faces.face_count[i] = wp.min(count, faces.face_room)

    @wp.func
    def push(obstacles: Obstacles, faces: Faces, law: vec5, face: int, at: vec4, x: vec3, velocity: vec3) -> vec3:
        """Compute the force of a face on a node, 0 where it does not touch."""
        k = faces.face_obstacle[face]
        result = vec3()
        if at[3] > law[DISTANCE] and at[3] < law[DISTANCE] + law[RANGE]:
            v = velocity - obstacle_speed(obstacles, k, x)
            result = contact_force(law, obstacles.obstacle_friction[k], at[3], vec3(at[0], at[1], at[2]), v)
        return result

    @wp.kernel(module=module, enable_backward=False)
    def report_faces(
        obstacles: Obstacles,
        faces: Faces,
        contact_stiffness: wp.array(dtype=scalar),
        contact_distance: wp.array(dtype=scalar),
        contact_range: wp.array(dtype=scalar),
        contact_slip_speed: wp.array(dtype=scalar),
        contact_damping_speed: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        velocity: wp.array(dtype=vec3),
        gaps: wp.array(dtype=vec4),
        contact_forces: wp.array(dtype=vec3),
    ):
        """Find (n, g) of the faces near every node, and their force."""
        i = index(wp.tid())
        law = law_of(contact_stiffness, contact_distance, contact_range, contact_slip_speed, contact_damping_speed)
        for place in range(i * faces.face_room, i * faces.face_room + faces.face_count[i]):
            face = faces.near_face[place]
            gaps[place] = to_face(obstacles, faces, face, position[i])
            contact_forces[place] = push(obstacles, faces, law, face, gaps[place], position[i], velocity[i])

    @wp.kernel(module=module, enable_backward=False)
    def add_mesh_power(
        obstacles: Obstacles,
        faces: Faces,
        contact_stiffness: wp.array(dtype=scalar),
        contact_distance: wp.array(dtype=scalar),
        contact_range: wp.array(dtype=scalar),
        contact_slip_speed: wp.array(dtype=scalar),
        contact_damping_speed: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        velocity: wp.array(dtype=vec3),
        power: wp.array(dtype=scalar),
    ):
        """Add up the power of moving meshes."""
        i = index(wp.tid())
        law = law_of(contact_stiffness, contact_distance, contact_range, contact_slip_speed, contact_damping_speed)
        x = position[i]
        for place in range(i * faces.face_room, i * faces.face_room + faces.face_count[i]):
            face = faces.near_face[place]
            f = push(obstacles, faces, law, face, to_face(obstacles, faces, face, x), x, velocity[i])
            done = wp.dot(f, obstacle_speed(obstacles, faces.face_obstacle[face], x))
            wp.atomic_add(power, 0, done)
            wp.atomic_add(power, 1, done)

    return SimpleNamespace(find_faces=find_faces, report_faces=report_faces, add_mesh_power=add_mesh_power)


TERM = Term(
    name="meshes",
    elements="samples",
    define=define,
    energy=define_energy,
    absent=lambda scene: (
        ""
        if scene.has_barrier and any(obstacle.shape == "mesh" for obstacle in scene.obstacles)
        else "there is no mesh with a barrier"
    ),
    touches=True,
    kept=True,
)
