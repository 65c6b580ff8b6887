"""Contact of a cloth with itself, by the law of ``barrier.py`` between balls about its nodes.

    g = |x_p − x_q|,   n = (x_p − x_q)/g,   v = ẋ_p − ẋ_q

Balls of a contact distance of their own: capsules of the yarns' radius would touch at rest already, where neighbours
lie side by side and yarns cross in one node. Each node takes the force of its own pairs, and each pair is the same from
both sides, to the last bit but for the sign, so that momentum is conserved to rounding.

Friction is of the nodes' velocities: two that stick and turn as one about each other are braked as well, above
ε/g of spin (0.4 rad/s of the paper's cloth).

Parameters: those of ``barrier.py``, with ``self_`` before them; ``contact_friction`` μ.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.indexing import index
from ..core.status import CROWDED, OVERLAPPING, fail
from ..core.structs import structs
from ..core.variant import Term, TermParameter, Variant
from ..linear.pair_blocks import PAIRS_TOUCH
from . import barrier
from .barrier import DISTANCE, RANGE


def define(variant: Variant) -> wp.Kernel:
    scalar, vec3, sym33 = variant.scalar, variant.vec3, variant.sym33
    BlockMatrix = structs(variant).BlockMatrix
    contact_force, contact_matrix = barrier.functions(variant).force, barrier.functions(variant).matrix
    note_contact = barrier.functions(variant).note
    law_of = barrier.functions(variant).law_of
    Pairs = structs(variant).Pairs

    @variant.kernel("self_contact")
    def self_contact_term(
        pairs: Pairs,
        self_contact_stiffness: wp.array(dtype=scalar),
        self_contact_distance: wp.array(dtype=scalar),
        self_contact_range: wp.array(dtype=scalar),
        self_contact_slip_speed: wp.array(dtype=scalar),
        self_contact_damping_speed: wp.array(dtype=scalar),
        contact_friction: wp.array(dtype=scalar),
        # state in
        position: wp.array(dtype=vec3),
        velocity: wp.array(dtype=vec3),
        increment: wp.array(dtype=vec3),
        step_size: wp.array(dtype=scalar),
        # forces out, whether anything touches, and more than there is room for
        force: wp.array(dtype=vec3),
        touching: wp.array(dtype=int),
        status: wp.array(dtype=int),
        # matrix out
        matrix: int,
        blocks: BlockMatrix,
    ):
        p = index(wp.tid())
        law = law_of(
            self_contact_stiffness, self_contact_distance, self_contact_range, self_contact_slip_speed,
            self_contact_damping_speed,
        )  # fmt: skip
        first = p * pairs.near_room
        if matrix != 0:
            pairs.touch_count[p] = 0
        for k in range(first, first + pairs.near_count[p]):
            q = index(pairs.near[k])
            r = position[p] - position[q]
            gap = wp.length(r)
            if gap < law[DISTANCE] + law[RANGE]:
                n = r / gap
                v = velocity[p] - velocity[q]
                wp.atomic_add(force, p, contact_force(law, contact_friction[0], gap, n, v))
                note_contact(law, n, v, increment[p] - increment[q], step_size[0], touching)
                touching[wp.static(PAIRS_TOUCH)] = 1
                if matrix != 0:
                    b = contact_matrix(
                        law, contact_friction[0], gap, n, v, blocks.coefficients[0], blocks.evaluations[0]
                    )
                    wp.atomic_add(blocks.diagonal_xx, p, b)
                    slot = pairs.touch_count[p]
                    if slot < pairs.touch_room:
                        place = index(p * pairs.touch_room + slot)
                        pairs.touch[place] = q
                        pairs.touch_block[place] = sym33(b[0, 0], b[0, 1], b[0, 2], b[1, 1], b[1, 2], b[2, 2])
                        pairs.touch_count[p] = slot + 1
                    else:
                        fail(status, wp.static(CROWDED), p)

    return self_contact_term


def define_energy(variant: Variant) -> wp.Kernel:
    scalar, vec3 = variant.scalar, variant.vec3
    barrier_of = barrier.functions(variant).barrier
    Pairs = structs(variant).Pairs

    @variant.kernel("self_contact")
    def self_contact_energy(
        pairs: Pairs,
        self_contact_stiffness: wp.array(dtype=scalar),
        self_contact_distance: wp.array(dtype=scalar),
        self_contact_range: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        energy: wp.array(dtype=scalar),
    ):
        p = index(wp.tid())
        reach = self_contact_range[0]
        for k in range(p * pairs.near_room, p * pairs.near_room + pairs.near_count[p]):
            x = (wp.length(position[p] - position[pairs.near[k]]) - self_contact_distance[0]) / reach
            if x < scalar(1.0):
                # a half, since every pair is in two lists
                v = self_contact_stiffness[0] * reach * reach * barrier_of(x)[0]
                wp.atomic_add(energy, 0, scalar(0.5) * v)

    return self_contact_energy


@functools.cache
def define_limits(variant: Variant) -> SimpleNamespace:
    """Define what keeps pairs apart from iterate to iterate, and reports them."""
    scalar, vec3 = variant.scalar, variant.vec3
    contact_force = barrier.functions(variant).force
    law_of = barrier.functions(variant).law_of
    Pairs = structs(variant).Pairs
    vec4 = variant.vec4
    module = variant.module("self_contact_limits")

    @wp.kernel(module=module, enable_backward=False)
    def limit_to_pairs(
        pairs: Pairs,
        self_contact_distance: wp.array(dtype=scalar),
        stage_size: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        direction: wp.array(dtype=vec3),
        step_length: wp.array(dtype=scalar),
    ):
        """Shortens a step to where two nodes first come nearer than it may: a quadratic equation (``limits.py``)."""
        p = index(wp.tid())
        distance = self_contact_distance[0]
        for k in range(p * pairs.near_room, p * pairs.near_room + pairs.near_count[p]):
            q = index(pairs.near[k])
            r = position[p] - position[q]
            move = (direction[p] - direction[q]) * stage_size[0]
            b = wp.dot(r, move)
            if p < q and b < scalar(0.0):
                limit = distance + scalar(wp.static(0.1)) * (wp.length(r) - distance)
                c = wp.dot(r, r) - limit * limit
                square = b * b - wp.dot(move, move) * c
                if square > scalar(0.0):
                    part = c / (wp.sqrt(square) - b)
                    if part < scalar(1.0):
                        wp.atomic_min(step_length, 0, part)

    @wp.kernel(module=module, enable_backward=False)
    def aim(
        stage_size: wp.array(dtype=scalar),
        base_position: wp.array(dtype=vec3),
        solution: wp.array(dtype=vec3),
        position: wp.array(dtype=vec3),
        direction: wp.array(dtype=vec3),
        step_length: wp.array(dtype=scalar),
    ):
        """Find the way from the last state to where a stage's iteration would start, as a step of that."""
        i = index(wp.tid())
        direction[i] = (base_position[i] - position[i]) / stage_size[0] + solution[i]
        step_length[0] = scalar(1.0)

    @wp.kernel(module=module, enable_backward=False)
    def start_apart(
        stage_size: wp.array(dtype=scalar),
        is_free: wp.array(dtype=int),
        base_position: wp.array(dtype=vec3),
        position: wp.array(dtype=vec3),
        step_length: wp.array(dtype=scalar),
        direction: wp.array(dtype=vec3),
        solution: wp.array(dtype=vec3),
    ):
        """Start where the way may lead to. What is held goes all of it."""
        i = index(wp.tid())
        if is_free[i] != 0 and step_length[0] < scalar(1.0):
            solution[i] = (position[i] - base_position[i]) / stage_size[0] + direction[i] * step_length[0]
        direction[i] = vec3()

    @wp.kernel(module=module, enable_backward=False)
    def report_pairs(
        pairs: Pairs,
        self_contact_stiffness: wp.array(dtype=scalar),
        self_contact_distance: wp.array(dtype=scalar),
        self_contact_range: wp.array(dtype=scalar),
        self_contact_slip_speed: wp.array(dtype=scalar),
        self_contact_damping_speed: wp.array(dtype=scalar),
        contact_friction: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        velocity: wp.array(dtype=vec3),
        gaps: wp.array(dtype=vec4),
        contact_forces: wp.array(dtype=vec3),
    ):
        """Find (n, g) of what is near, and the force on a node of those that touch it."""
        p = index(wp.tid())
        law = law_of(
            self_contact_stiffness, self_contact_distance, self_contact_range, self_contact_slip_speed,
            self_contact_damping_speed,
        )  # fmt: skip
        for k in range(p * pairs.near_room, p * pairs.near_room + pairs.near_count[p]):
            r = position[p] - position[pairs.near[k]]
            gap = wp.length(r)
            n = r / gap
            gaps[k] = vec4(n[0], n[1], n[2], gap)
            if gap > law[DISTANCE] and gap < law[DISTANCE] + law[RANGE]:
                v = velocity[p] - velocity[pairs.near[k]]
                contact_forces[k] = contact_force(law, contact_friction[0], gap, n, v)

    @wp.func
    def nearest_on_way(r: vec3, move: vec3) -> scalar:
        """Find the least length of r on its way along a move."""
        size = wp.dot(move, move)
        part = scalar(0.0)
        if size > scalar(0.0):
            part = wp.clamp(-wp.dot(r, move) / size, scalar(0.0), scalar(1.0))
        return wp.length(r + move * part)

    @wp.kernel(module=module, enable_backward=False)
    def check_apart(
        nodes: int,
        pairs: Pairs,
        self_contact_distance: wp.array(dtype=scalar),
        self_contact_range: wp.array(dtype=scalar),
        rest_place: wp.array(dtype=scalar),
        is_free: wp.array(dtype=int),
        stage_size: wp.array(dtype=scalar),
        step_length: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        base_position: wp.array(dtype=vec3),
        solution: wp.array(dtype=vec3),
        status: wp.array(dtype=int),
    ):
        """Check whether a stage starts with all apart, and whether what is held came there through nothing: it went all
        of its way, which the list need not cover where others did not."""
        p = index(wp.tid())
        distance = self_contact_distance[0]
        x = base_position[p] + solution[p] * stage_size[0]
        of_p = x - position[p]
        if is_free[p] == 0 and step_length[0] < scalar(1.0) and wp.length_sq(of_p) > scalar(0.0):
            touch = distance + self_contact_range[0]
            apart = scalar(wp.static(0.25 * wp.PI * wp.PI)) * touch * touch
            for q in range(nodes):
                du = rest_place[2 * q] - rest_place[2 * p]
                dv = rest_place[2 * q + 1] - rest_place[2 * p + 1]
                if du * du + dv * dv >= apart:
                    of_q = base_position[q] + solution[q] * stage_size[0] - position[q]
                    if not (nearest_on_way(position[p] - position[q], of_p - of_q) > distance):
                        fail(status, wp.static(OVERLAPPING), p)
        else:
            for k in range(p * pairs.near_room, p * pairs.near_room + pairs.near_count[p]):
                q = index(pairs.near[k])
                of_q = base_position[q] + solution[q] * stage_size[0] - position[q]
                if not (nearest_on_way(position[p] - position[q], of_p - of_q) > distance):
                    fail(status, wp.static(OVERLAPPING), p)

    return SimpleNamespace(
        check_apart=check_apart,
        limit_to_pairs=limit_to_pairs,
        aim=aim,
        start_apart=start_apart,
        report_pairs=report_pairs,
    )


TERM = Term(
    name="self_contact",
    elements="samples",
    define=define,
    energy=define_energy,
    parameters=(
        TermParameter("self_contact_stiffness", "N/m", above=0.0),
        TermParameter("self_contact_distance", "m", above=0.0),
        TermParameter("self_contact_range", "m", above=0.0),
        TermParameter("self_contact_slip_speed", "m/s", above=0.0),
        TermParameter("self_contact_damping_speed", "m/s", above=0.0),
        TermParameter("contact_friction", "", least=0.0),
    ),
    absent=lambda scene: "" if scene.self_contact and scene.has_barrier else "there is no self_contact by a barrier",
    touches=True,
)
