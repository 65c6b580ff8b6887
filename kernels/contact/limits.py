"""How far a step may go before it comes near an obstacle, so that no iterate of a stage ever penetrates.

Along δ a node may use up nine tenths of what its gap is above D (the filtered line search of incremental potential
contact). All but a mesh are convex: there φ along a line lies above its tangents, so the place where the tangent
reaches the limit is still safe, and a few such places end at the limit or where φ grows. Near a mesh a node may go as
far as it is away.

A stage begins where straight lines from the state before it end that go to the stage's base, carried on at the velocity
that the iteration starts from, as far as each node may go. What an obstacle sweeps in the meantime is seen from the
obstacle, where it is the node that goes along a straight line; so is the way of what is held.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.indexing import index
from ..core.status import IMPACT, OVERLAPPING, fail
from ..core.structs import structs
from ..core.variant import Variant
from ..linear.pair_blocks import IMPACTS, TOUCHES
from . import barrier, obstacles
from . import meshes as mesh_contact
from .distances import MESH

LEFT = 0.1
"""Part of what a gap is above D that a step leaves of it at least."""
PLACES = 24
"""Of a line that are looked at."""


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    """Make what finds the way that is clear."""
    scalar, vec3, quat = variant.scalar, variant.vec3, variant.quat
    to_obstacle = obstacles.functions(variant).to_obstacle
    Obstacles, Faces = structs(variant).Obstacles, structs(variant).Faces
    vec4, to_face = variant.vec4, mesh_contact.functions(variant).to_face

    @wp.func
    def nearest(obstacles: Obstacles, faces: Faces, meshes: wp.array(dtype=wp.uint64), k: int, x: vec3) -> vec4:
        """Find (n, g) of a place and an obstacle; of a mesh that of its closest face: the search tree is in single
        precision, distances are not."""
        if obstacles.obstacle_shape[k] != wp.static(MESH):
            return to_obstacle(obstacles, k, x)
        local = wp.quat_rotate_inv(obstacles.obstacle_rotation[k], x - obstacles.obstacle_position[k])
        place = wp.vec3(float(local[0]), float(local[1]), float(local[2]))
        found = wp.mesh_query_point_no_sign(meshes[k], place, wp.static(1.0e10))
        return to_face(obstacles, faces, obstacles.first_face[k] + found.face, x)

    @wp.func
    def reach(
        obstacles: Obstacles,
        faces: Faces,
        meshes: wp.array(dtype=wp.uint64),
        k: int,
        x: vec3,
        move: vec3,
        limit: scalar,
    ) -> scalar:
        """Find the part of a move, 1 at most, before which φ stays above the limit."""
        gone = scalar(0.0)
        for _ in range(wp.static(PLACES)):
            place = x + move * gone
            at = nearest(obstacles, faces, meshes, k, place)
            room = at[3] - limit
            approach = -(at[0] * move[0] + at[1] * move[1] + at[2] * move[2])
            if obstacles.obstacle_shape[k] == wp.static(MESH):
                approach = wp.length(move)
            if approach <= scalar(0.0) or room >= approach * (scalar(1.0) - gone):
                gone = scalar(1.0)
                break
            if room <= scalar(0.0):
                break
            gone += room / approach
        return wp.min(gone, scalar(1.0))

    @wp.func
    def taken(
        obstacles: Obstacles,
        k: int,
        obstacle_position_before: wp.array(dtype=vec3),
        obstacle_rotation_before: wp.array(dtype=quat),
        x: vec3,
    ) -> vec3:
        """Find where a place is that goes with an obstacle, from where it was before."""
        local = wp.quat_rotate_inv(obstacle_rotation_before[k], x - obstacle_position_before[k])
        return obstacles.obstacle_position[k] + wp.quat_rotate(obstacles.obstacle_rotation[k], local)

    return SimpleNamespace(nearest=nearest, reach=reach, taken=taken)


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, vec3, quat = variant.scalar, variant.vec3, variant.quat
    obstacle_speed = obstacles.functions(variant).obstacle_speed
    nearest, reach, taken = functions(variant).nearest, functions(variant).reach, functions(variant).taken
    note_motion = barrier.functions(variant).note_motion
    Obstacles, Faces, Pairs = structs(variant).Obstacles, structs(variant).Faces, structs(variant).Pairs
    module = variant.module("contact_limits")

    @wp.kernel(module=module, enable_backward=False)
    def limit_to_obstacles(
        obstacles: Obstacles,
        faces: Faces,
        meshes: wp.array(dtype=wp.uint64),
        contact_distance: wp.array(dtype=scalar),
        stage_size: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        direction: wp.array(dtype=vec3),
        is_free: wp.array(dtype=int),
        step_length: wp.array(dtype=scalar),
    ):
        """Shortens the step along δ so far that it leaves something of every gap."""
        e = index(wp.tid())
        count = obstacles.obstacle_shape.shape[0]
        i = index(e / count)
        k = index(e % count)
        x = position[i]
        if is_free[i] != 0:
            gap = nearest(obstacles, faces, meshes, k, x)[3]
            limit = contact_distance[0] + scalar(wp.static(LEFT)) * (gap - contact_distance[0])
            move = direction[i] * stage_size[0]
            # most are far away
            if gap - wp.length(move) < limit:
                part = reach(obstacles, faces, meshes, k, x, move, limit)
                if part < scalar(1.0):
                    wp.atomic_min(step_length, 0, part)

    @wp.kernel(module=module, enable_backward=False)
    def start_outside(
        obstacles: Obstacles,
        faces: Faces,
        meshes: wp.array(dtype=wp.uint64),
        obstacle_position_before: wp.array(dtype=vec3),
        obstacle_rotation_before: wp.array(dtype=quat),
        contact_distance: wp.array(dtype=scalar),
        stage_size: wp.array(dtype=scalar),
        is_free: wp.array(dtype=int),
        position: wp.array(dtype=vec3),
        base_position: wp.array(dtype=vec3),
        solution: wp.array(dtype=vec3),
        status: wp.array(dtype=int),
    ):
        """Changes the velocity that a stage's iteration starts from, where it would lead into an obstacle: a node then
        goes only part of the way, from where the last stage left it. One that an obstacle comes upon goes with it."""
        i = index(wp.tid())
        count = obstacles.obstacle_shape.shape[0]
        distance = contact_distance[0]
        end = base_position[i] + solution[i] * stage_size[0]
        x = position[i]
        if is_free[i] == 0:
            x = end
        inside = int(0)
        for k in range(count):
            begin = taken(obstacles, k, obstacle_position_before, obstacle_rotation_before, position[i])
            gap = nearest(obstacles, faces, meshes, k, begin)[3]
            # seen from the obstacle, that is the way that a node goes which stays, or is held and sent elsewhere
            if is_free[i] == 0:
                if reach(obstacles, faces, meshes, k, begin, x - begin, distance) < scalar(1.0):
                    inside = int(1)
            elif reach(
                obstacles, faces, meshes, k, begin, x - begin, distance + scalar(0.5) * (gap - distance)
            ) < scalar(1.0):
                x = begin
        if is_free[i] != 0:
            move = end - x
            part = scalar(1.0)
            goes = wp.length_sq(x - position[i]) > scalar(0.0)
            for k in range(count):
                gap = nearest(obstacles, faces, meshes, k, x)[3]
                if not (gap > distance):
                    inside = int(1)
                elif goes:
                    # what takes it along may not take it through another one
                    begin = taken(obstacles, k, obstacle_position_before, obstacle_rotation_before, position[i])
                    if reach(obstacles, faces, meshes, k, begin, x - begin, distance) < scalar(1.0):
                        inside = int(1)
                limit = distance + scalar(wp.static(LEFT)) * (gap - distance)
                part = wp.min(part, reach(obstacles, faces, meshes, k, x, move, limit))
            if part < scalar(1.0) or goes:
                solution[i] = (x + move * part - base_position[i]) / stage_size[0]
        if inside != 0:
            fail(status, wp.static(OVERLAPPING), i)

    @wp.kernel(module=module, enable_backward=False)
    def ask_where_touching(touching: wp.array(dtype=int), rebuild_matrix: wp.array(dtype=int)):
        """Asks for a new matrix where anything touches: the barrier's changes from iterate to iterate."""
        if touching[wp.static(TOUCHES)] != 0:
            rebuild_matrix[0] = 1

    @wp.kernel(module=module, enable_backward=False)
    def note_obstacle_impacts(
        obstacles: Obstacles,
        faces: Faces,
        meshes: wp.array(dtype=wp.uint64),
        contact_distance: wp.array(dtype=scalar),
        contact_range: wp.array(dtype=scalar),
        step_size: wp.array(dtype=scalar),
        stage_size: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        velocity: wp.array(dtype=vec3),
        increment: wp.array(dtype=vec3),
        touching: wp.array(dtype=int),
    ):
        """Notes impacts where a stage's last iterate led, which no evaluation of forces has seen, and where a step at
        its acceleration would lead: what rested may be thrown off."""
        e = index(wp.tid())
        count = obstacles.obstacle_shape.shape[0]
        i = index(e / count)
        k = index(e % count)
        at = nearest(obstacles, faces, meshes, k, position[i])
        n = vec3(at[0], at[1], at[2])
        v = velocity[i] - obstacle_speed(obstacles, k, position[i])
        later = v - increment[i] * (step_size[0] / stage_size[0] - scalar(1.0))
        moved = vec3(at[3], wp.dot(n, v) * step_size[0], wp.dot(n, later) * step_size[0])
        note_motion(contact_distance[0] + contact_range[0], contact_range[0], moved, touching)

    @wp.kernel(module=module, enable_backward=False)
    def note_pair_impacts(
        pairs: Pairs,
        self_contact_distance: wp.array(dtype=scalar),
        self_contact_range: wp.array(dtype=scalar),
        step_size: wp.array(dtype=scalar),
        stage_size: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        velocity: wp.array(dtype=vec3),
        increment: wp.array(dtype=vec3),
        touching: wp.array(dtype=int),
    ):
        """Notes the same of pairs."""
        p = index(wp.tid())
        touch = self_contact_distance[0] + self_contact_range[0]
        for k in range(p * pairs.near_room, p * pairs.near_room + pairs.near_count[p]):
            q = index(pairs.near[k])
            r = position[p] - position[q]
            gap = wp.length(r)
            n = r / gap
            v = velocity[p] - velocity[q]
            later = v - (increment[p] - increment[q]) * (step_size[0] / stage_size[0] - scalar(1.0))
            moved = vec3(gap, wp.dot(n, v) * step_size[0], wp.dot(n, later) * step_size[0])
            note_motion(touch, self_contact_range[0], moved, touching)

    @wp.kernel(module=module, enable_backward=False)
    def refuse_impact(touching: wp.array(dtype=int), status: wp.array(dtype=int)):
        """Leaves a step with an impact to a method that does not extrapolate."""
        if touching[wp.static(IMPACTS)] != 0:
            fail(status, wp.static(IMPACT), -1)

    @wp.kernel(module=module, enable_backward=False)
    def copy_rotations(source: wp.array(dtype=quat), target: wp.array(dtype=quat)):
        k = wp.tid()
        target[k] = source[k]

    return SimpleNamespace(
        note_obstacle_impacts=note_obstacle_impacts,
        note_pair_impacts=note_pair_impacts,
        refuse_impact=refuse_impact,
        ask_where_touching=ask_where_touching,
        copy_rotations=copy_rotations,
        limit_to_obstacles=limit_to_obstacles,
        start_outside=start_outside,
    )


@functools.cache
def define_motion(variant: Variant) -> SimpleNamespace:
    """Define what moves obstacles, in reverse too."""
    scalar, vec3, quat = variant.scalar, variant.vec3, variant.quat

    @wp.func
    def rotation_vector(q: quat) -> vec3:
        """Find axis times angle of a rotation, the shorter way round."""
        w = q[3]
        v = vec3(q[0], q[1], q[2])
        if w < scalar(0.0):
            w = -w
            v = -v
        square = wp.dot(v, v)
        factor = scalar(2.0)
        if square > scalar(1.0e-10):
            sine = wp.sqrt(square)
            factor = scalar(2.0) * wp.atan2(sine, w) / sine
        return v * factor

    @wp.func
    def turned(vector: vec3) -> quat:
        """Make the rotation by an axis times an angle."""
        square = wp.dot(vector, vector)
        half = scalar(0.5) - square / scalar(48.0)
        w = scalar(1.0) - square / scalar(8.0)
        if square > scalar(1.0e-8):
            angle = wp.sqrt(square)
            half = wp.sin(scalar(0.5) * angle) / angle
            w = wp.cos(scalar(0.5) * angle)
        return quat(vector[0] * half, vector[1] * half, vector[2] * half, w)

    @variant.kernel("obstacles")
    def place_obstacles(
        counters: wp.array(dtype=int),
        stage: int,
        stage_times: wp.array(dtype=scalar),
        step_duration: scalar,
        obstacle_position_start: wp.array(dtype=vec3),
        obstacle_rotation_start: wp.array(dtype=quat),
        obstacle_position_path: wp.array(dtype=vec3),
        obstacle_rotation_path: wp.array(dtype=quat),
        obstacle_position: wp.array(dtype=vec3),
        obstacle_rotation: wp.array(dtype=quat),
        obstacle_velocity: wp.array(dtype=vec3),
        obstacle_spin: wp.array(dtype=vec3),
    ):
        """Compute pose, velocity and spin at the time of a stage, between the path's row before and this step's."""
        k = index(wp.tid())
        count = obstacle_position_start.shape[0]
        rows = obstacle_position_path.shape[0] / count
        row = wp.min(counters[1], rows - 1) * count + k
        p = obstacle_position_start[k]
        q = obstacle_rotation_start[k]
        if counters[1] > 0:
            before = wp.min(counters[1] - 1, rows - 1) * count + k
            p = obstacle_position_path[before]
            q = obstacle_rotation_path[before]
        move = obstacle_position_path[row] - p
        turn = rotation_vector(obstacle_rotation_path[row] * wp.quat_inverse(q))
        time = stage_times[stage]
        obstacle_position[k] = p + move * time
        obstacle_rotation[k] = turned(turn * time) * q
        obstacle_velocity[k] = move / step_duration
        obstacle_spin[k] = turn / step_duration

    return SimpleNamespace(place_obstacles=place_obstacles)
