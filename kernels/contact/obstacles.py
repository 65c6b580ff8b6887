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
from ..core.structs import structs
from ..core.variant import Term, TermParameter, Variant
from . import barrier, distances
from .barrier import DISTANCE, RANGE


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    vec3, vec4 = variant.vec3, variant.vec4
    Obstacles = structs(variant).Obstacles
    distance = distances.functions(variant).distance

    @wp.func
    def to_obstacle(obstacles: Obstacles, k: int, x: vec3) -> vec4:
        """Find (n, g) of a place and an obstacle that is no mesh."""
        local = wp.quat_rotate_inv(obstacles.obstacle_rotation[k], x - obstacles.obstacle_position[k])
        at = distance(obstacles.obstacle_shape[k], obstacles.obstacle_size[k], local)
        n = wp.quat_rotate(obstacles.obstacle_rotation[k], vec3(at[0], at[1], at[2]))
        return vec4(n[0], n[1], n[2], at[3])

    @wp.func
    def obstacle_speed(obstacles: Obstacles, k: int, x: vec3) -> vec3:
        """Compute the velocity of an obstacle's material at a place."""
        arm = x - obstacles.obstacle_position[k]
        return obstacles.obstacle_velocity[k] + wp.cross(obstacles.obstacle_spin[k], arm)

    return SimpleNamespace(to_obstacle=to_obstacle, obstacle_speed=obstacle_speed)


def define(variant: Variant) -> wp.Kernel:
    scalar, vec3 = variant.scalar, variant.vec3
    BlockMatrix = structs(variant).BlockMatrix
    note_contact = barrier.functions(variant).note
    to_obstacle, obstacle_speed = functions(variant).to_obstacle, functions(variant).obstacle_speed
    contact_force, contact_matrix = barrier.functions(variant).force, barrier.functions(variant).matrix
    Obstacles, law_of = structs(variant).Obstacles, barrier.functions(variant).law_of

    @variant.kernel("obstacles")
    def obstacle_term(
        obstacles: Obstacles,
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
        e = index(wp.tid())
        count = obstacles.obstacle_shape.shape[0]
        i = index(e / count)
        law = law_of(contact_stiffness, contact_distance, contact_range, contact_slip_speed, contact_damping_speed)
        k = index(e % count)
        x = position[i]
        at = to_obstacle(obstacles, k, x)
        gap = at[3]
        if gap < law[DISTANCE] + law[RANGE]:
            n = vec3(at[0], at[1], at[2])
            v = velocity[i] - obstacle_speed(obstacles, k, x)
            wp.atomic_add(force, i, contact_force(law, obstacles.obstacle_friction[k], gap, n, v))
            note_contact(law, n, v, increment[i], step_size[0], touching)
            if matrix != 0:
                friction = obstacles.obstacle_friction[k]
                xx = contact_matrix(law, friction, gap, n, v, blocks.coefficients[0], blocks.evaluations[0])
                wp.atomic_add(blocks.diagonal_xx, i, xx)

    return obstacle_term


def define_energy(variant: Variant) -> wp.Kernel:
    scalar, vec3 = variant.scalar, variant.vec3
    to_obstacle = functions(variant).to_obstacle
    barrier_of = barrier.functions(variant).barrier
    Obstacles = structs(variant).Obstacles

    @variant.kernel("obstacles")
    def obstacle_energy(
        obstacles: Obstacles,
        contact_stiffness: wp.array(dtype=scalar),
        contact_distance: wp.array(dtype=scalar),
        contact_range: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        energy: wp.array(dtype=scalar),
    ):
        e = index(wp.tid())
        count = obstacles.obstacle_shape.shape[0]
        gap = to_obstacle(obstacles, e % count, position[e / count])[3]
        reach = contact_range[0]
        x = (gap - contact_distance[0]) / reach
        if x < scalar(1.0):
            wp.atomic_add(energy, 0, contact_stiffness[0] * reach * reach * barrier_of(x)[0])

    return obstacle_energy


@functools.cache
def define_reports(variant: Variant) -> SimpleNamespace:
    """Define what is asked of contacts beside their force."""
    scalar, vec3 = variant.scalar, variant.vec3
    vec4, vec5 = variant.vec4, wp.types.vector(5, scalar)
    to_obstacle, obstacle_speed = functions(variant).to_obstacle, functions(variant).obstacle_speed
    contact_force = barrier.functions(variant).force
    Obstacles, law_of = structs(variant).Obstacles, barrier.functions(variant).law_of
    module = variant.module("contact_reports")

    @wp.func
    def force_on(obstacles: Obstacles, law: vec5, k: int, x: vec3, velocity: vec3) -> vec3:
        """Compute the force on a node, 0 where it does not touch."""
        at = to_obstacle(obstacles, k, x)
        result = vec3()
        if at[3] > law[DISTANCE] and at[3] < law[DISTANCE] + law[RANGE]:
            v = velocity - obstacle_speed(obstacles, k, x)
            result = contact_force(law, obstacles.obstacle_friction[k], at[3], vec3(at[0], at[1], at[2]), v)
        return result

    @wp.kernel(module=module, enable_backward=False)
    def report_contacts(
        obstacles: Obstacles,
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
        """Find (n, g) of every node and obstacle, and the force of those that touch."""
        e = index(wp.tid())
        count = obstacles.obstacle_shape.shape[0]
        i = index(e / count)
        k = index(e % count)
        law = law_of(contact_stiffness, contact_distance, contact_range, contact_slip_speed, contact_damping_speed)
        gaps[e] = to_obstacle(obstacles, k, position[i])
        contact_forces[e] = force_on(obstacles, law, k, position[i], velocity[i])

    @wp.kernel(module=module, enable_backward=False)
    def add_obstacle_power(
        obstacles: Obstacles,
        contact_stiffness: wp.array(dtype=scalar),
        contact_distance: wp.array(dtype=scalar),
        contact_range: wp.array(dtype=scalar),
        contact_slip_speed: wp.array(dtype=scalar),
        contact_damping_speed: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        velocity: wp.array(dtype=vec3),
        power: wp.array(dtype=scalar),
    ):
        """Add up the power of moving obstacles: their force on nodes times their velocity there."""
        e = index(wp.tid())
        count = obstacles.obstacle_shape.shape[0]
        i = index(e / count)
        k = index(e % count)
        law = law_of(contact_stiffness, contact_distance, contact_range, contact_slip_speed, contact_damping_speed)
        f = force_on(obstacles, law, k, position[i], velocity[i])
        done = wp.dot(f, obstacle_speed(obstacles, k, position[i]))
        wp.atomic_add(power, 0, done)
        wp.atomic_add(power, 1, done)

    return SimpleNamespace(report_contacts=report_contacts, add_obstacle_power=add_obstacle_power)


TERM = Term(
    name="obstacles",
    elements="sample_obstacles",
    define=define,
    energy=define_energy,
    parameters=(
        TermParameter("contact_stiffness", "N/m", above=0.0),
        TermParameter("contact_distance", "m", above=0.0),
        TermParameter("contact_range", "m", above=0.0),
        TermParameter("contact_slip_speed", "m/s", above=0.0),
        TermParameter("contact_damping_speed", "m/s", above=0.0),
    ),
    absent=lambda scene: "" if scene.obstacles and scene.has_barrier else "there is no obstacle with a barrier",
    touches=True,
    kept=True,
)
