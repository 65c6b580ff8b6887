"""Contact of nodes with obstacles, by the law of ``barrier.py`` in the distance φ of ``distances.py``.

    g = φ(Rᵀ(x − p)),   n = R ∇φ,   v = ẋ − (ṗ + ω × (x − p))

Obstacles stand still or move along a path of poses (p, R), at constant velocity and spin from one to the next; a stage
has them where they are at its time. They feel nothing of the cloth.

Parameters: ``obstacle_size`` [m], ``obstacle_friction`` μ, ``obstacle_position`` p [m] and ``obstacle_rotation`` R
(quaternion x, y, z, w) of each obstacle, or their paths; those of ``barrier.py``.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.indexing import index
from ..core.variant import Term, Variant
from . import barrier, distances
from .distances import MESH


@functools.cache
def structs(variant: Variant) -> SimpleNamespace:
    scalar, vec3, quat = variant.scalar, variant.vec3, variant.quat

    @wp.struct
    class Obstacles:
        """Of each: shape, size, friction, pose, velocity ṗ and spin ω. Of meshes: the first of its faces among
        ``mesh_corner``, three to a face; and of each node and mesh the face to take the closest point from."""

        obstacle_shape: wp.array(dtype=int)
        obstacle_size: wp.array(dtype=vec3)
        obstacle_friction: wp.array(dtype=scalar)
        obstacle_position: wp.array(dtype=vec3)
        obstacle_rotation: wp.array(dtype=quat)
        obstacle_velocity: wp.array(dtype=vec3)
        obstacle_spin: wp.array(dtype=vec3)
        first_face: wp.array(dtype=int)
        mesh_corner: wp.array(dtype=vec3)
        mesh_face: wp.array(dtype=int)

    return SimpleNamespace(Obstacles=Obstacles, ContactLaw=barrier.structs(variant).ContactLaw)


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    scalar, vec3 = variant.scalar, variant.vec3
    vec4 = wp.types.vector(4, scalar)
    Obstacles = structs(variant.forward).Obstacles
    distance, closest_on_triangle = (
        distances.functions(variant).distance,
        distances.functions(variant).closest_on_triangle,
    )

    @wp.func
    def to_obstacle(obstacles: Obstacles, k: int, face: int, x: vec3) -> vec4:
        """(n, g) of a place and an obstacle."""
        local = wp.quat_rotate_inv(obstacles.obstacle_rotation[k], x - obstacles.obstacle_position[k])
        on_mesh = vec3()
        if obstacles.obstacle_shape[k] == wp.static(MESH):
            corner = 3 * face
            on_mesh = closest_on_triangle(
                local,
                obstacles.mesh_corner[corner],
                obstacles.mesh_corner[corner + 1],
                obstacles.mesh_corner[corner + 2],
            )
        at = distance(obstacles.obstacle_shape[k], obstacles.obstacle_size[k], local, on_mesh)
        n = wp.quat_rotate(obstacles.obstacle_rotation[k], vec3(at[0], at[1], at[2]))
        return vec4(n[0], n[1], n[2], at[3])

    @wp.func
    def obstacle_speed(obstacles: Obstacles, k: int, x: vec3) -> vec3:
        """Velocity of an obstacle's material at a place."""
        arm = x - obstacles.obstacle_position[k]
        return obstacles.obstacle_velocity[k] + wp.cross(obstacles.obstacle_spin[k], arm)

    return SimpleNamespace(to_obstacle=to_obstacle, obstacle_speed=obstacle_speed)


def define(variant: Variant) -> wp.Kernel:
    scalar, vec3, mat33 = variant.scalar, variant.vec3, variant.mat33
    note_contact = barrier.functions(variant).note
    to_obstacle, obstacle_speed = functions(variant).to_obstacle, functions(variant).obstacle_speed
    contact_force, contact_matrix = barrier.functions(variant).force, barrier.functions(variant).matrix
    Obstacles, ContactLaw = structs(variant.forward).Obstacles, structs(variant.forward).ContactLaw

    @variant.kernel("obstacles")
    def obstacle_term(
        obstacles: Obstacles,
        law: ContactLaw,
        # state in
        position: wp.array(dtype=vec3),
        velocity: wp.array(dtype=vec3),
        increment: wp.array(dtype=vec3),
        step_size: wp.array(dtype=scalar),
        tries: wp.array(dtype=int),
        # forces out, and whether anything touches
        force: wp.array(dtype=vec3),
        touching: wp.array(dtype=int),
        # matrix out
        matrix: int,
        weights: wp.array(dtype=vec3),
        diagonal_xx: wp.array(dtype=mat33),
    ):
        e = index(wp.tid())
        count = obstacles.obstacle_shape.shape[0]
        i = index(e / count)
        k = index(e % count)
        x = position[i]
        at = to_obstacle(obstacles, k, obstacles.mesh_face[e], x)
        gap = at[3]
        if gap < law.distance[0] + law.range[0]:
            n = vec3(at[0], at[1], at[2])
            v = velocity[i] - obstacle_speed(obstacles, k, x)
            wp.atomic_add(force, i, contact_force(law, obstacles.obstacle_friction[k], gap, n, v))
            note_contact(law, n, v, increment[i], step_size[0], touching)
            if matrix != 0:
                wp.atomic_add(
                    diagonal_xx,
                    i,
                    contact_matrix(law, obstacles.obstacle_friction[k], gap, n, v, weights[0], tries[0]),
                )

    return obstacle_term


def define_energy(variant: Variant) -> wp.Kernel:
    scalar, vec3 = variant.scalar, variant.vec3
    to_obstacle = functions(variant).to_obstacle
    barrier_of = barrier.functions(variant).barrier
    Obstacles, ContactLaw = structs(variant.forward).Obstacles, structs(variant.forward).ContactLaw

    @variant.kernel("obstacles")
    def obstacle_energy(
        obstacles: Obstacles, law: ContactLaw, position: wp.array(dtype=vec3), energy: wp.array(dtype=scalar)
    ):
        e = index(wp.tid())
        count = obstacles.obstacle_shape.shape[0]
        gap = to_obstacle(obstacles, e % count, obstacles.mesh_face[e], position[e / count])[3]
        reach = law.range[0]
        x = (gap - law.distance[0]) / reach
        if x < scalar(1.0):
            wp.atomic_add(energy, 0, law.stiffness[0] * reach * reach * barrier_of(x)[0])

    return obstacle_energy


@functools.cache
def define_reports(variant: Variant) -> SimpleNamespace:
    """What is asked of contacts beside their force."""
    scalar, vec3 = variant.scalar, variant.vec3
    vec4 = wp.types.vector(4, scalar)
    to_obstacle, obstacle_speed = functions(variant).to_obstacle, functions(variant).obstacle_speed
    contact_force = barrier.functions(variant).force
    Obstacles, ContactLaw = structs(variant.forward).Obstacles, structs(variant.forward).ContactLaw
    module = variant.module("contact_reports")

    @wp.func
    def force_on(obstacles: Obstacles, law: ContactLaw, e: int, k: int, x: vec3, velocity: vec3) -> vec3:
        at = to_obstacle(obstacles, k, obstacles.mesh_face[e], x)
        result = vec3()
        if at[3] > law.distance[0] and at[3] < law.distance[0] + law.range[0]:
            v = velocity - obstacle_speed(obstacles, k, x)
            result = contact_force(law, obstacles.obstacle_friction[k], at[3], vec3(at[0], at[1], at[2]), v)
        return result

    @wp.kernel(module=module, enable_backward=False)
    def report_contacts(
        obstacles: Obstacles,
        law: ContactLaw,
        position: wp.array(dtype=vec3),
        velocity: wp.array(dtype=vec3),
        gaps: wp.array(dtype=vec4),
        contact_forces: wp.array(dtype=vec3),
    ):
        """(n, g) of every node and obstacle, and the force of those that touch."""
        e = index(wp.tid())
        count = obstacles.obstacle_shape.shape[0]
        i = index(e / count)
        k = index(e % count)
        gaps[e] = to_obstacle(obstacles, k, obstacles.mesh_face[e], position[i])
        contact_forces[e] = force_on(obstacles, law, e, k, position[i], velocity[i])

    @wp.kernel(module=module, enable_backward=False)
    def add_obstacle_power(
        obstacles: Obstacles,
        law: ContactLaw,
        position: wp.array(dtype=vec3),
        velocity: wp.array(dtype=vec3),
        power: wp.array(dtype=scalar),
    ):
        """Power of moving obstacles: their force on nodes times their velocity there."""
        e = index(wp.tid())
        count = obstacles.obstacle_shape.shape[0]
        i = index(e / count)
        k = index(e % count)
        f = force_on(obstacles, law, e, k, position[i], velocity[i])
        done = wp.dot(f, obstacle_speed(obstacles, k, position[i]))
        wp.atomic_add(power, 0, done)
        wp.atomic_add(power, 1, done)

    return SimpleNamespace(report_contacts=report_contacts, add_obstacle_power=add_obstacle_power)


TERM = Term(name="obstacles", elements="node_obstacles", define=define, energy=define_energy, touches=True)
