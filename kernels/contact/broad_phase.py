"""Which nodes may touch each other: a list for each node of those that are near, made on the device.

Two nodes of a cloth can touch where a fold can bring them together: where they are at least (π/2)(D + d̂) apart along
the cloth, the arc of a fold of two layers. Those nearer are kept apart by the yarns themselves.

A list has what is within D + d̂ and a margin, and holds until nodes have moved by the margin relative to each other:
each by half of it relative to one of them, so that a cloth which flies needs no new one. Its order is that of the
nodes, and steps of the iteration are shortened to what a new list would hold for: results do not depend on where the
list was made.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core.indexing import index
from ..core.status import CROWDED, fail
from ..core.structs import structs
from ..core.variant import Variant


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, vec3 = variant.scalar, variant.vec3
    Pairs = structs(variant).Pairs
    module = variant.module("broad_phase")

    @wp.kernel(module=module, enable_backward=False)
    def measure_stray(
        nodes: int,
        near_margin: wp.array(dtype=scalar),
        stage_size: wp.array(dtype=scalar),
        moves: int,
        position: wp.array(dtype=vec3),
        direction: wp.array(dtype=vec3),
        near_position: wp.array(dtype=vec3),
        outdated: wp.array(dtype=int),
    ):
        """Check whether a node is, or would be after a whole step of the iteration, farther from where it was when the
        list was made than the list allows."""
        i = index(wp.tid())
        middle = index(nodes / 2)
        stray = position[i] - near_position[i] - (position[middle] - near_position[middle])
        if moves != 0:
            stray += (direction[i] - direction[middle]) * stage_size[0]
        # one that is not finite is left to who asks for a new list in vain
        if not (wp.length(stray) <= scalar(0.5) * near_margin[0]):
            outdated[0] = 1

    @wp.kernel(module=module, enable_backward=False)
    def list_near(
        grid: wp.uint64,
        pairs: Pairs,
        self_contact_distance: wp.array(dtype=scalar),
        self_contact_range: wp.array(dtype=scalar),
        near_margin: wp.array(dtype=scalar),
        rest_place: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        near_position: wp.array(dtype=vec3),
        outdated: wp.array(dtype=int),
        status: wp.array(dtype=int),
    ):
        """Make the list of a node."""
        i = index(wp.tid())
        x = position[i]
        near_position[i] = x
        outdated[0] = 0
        u = rest_place[2 * i]
        v = rest_place[2 * i + 1]
        count = int(0)
        touch = self_contact_distance[0] + self_contact_range[0]
        reach = touch + near_margin[0]
        # the arc of a fold of two layers
        apart = scalar(wp.static(0.25 * wp.PI * wp.PI)) * touch * touch
        for j in wp.hash_grid_query(grid, x, reach):
            du = rest_place[2 * j] - u
            dv = rest_place[2 * j + 1] - v
            if du * du + dv * dv >= apart and wp.length_sq(position[j] - x) < reach * reach:
                if count < pairs.near_room:
                    # in the order of nodes: sums round alike, whatever the grid
                    place = index(i * pairs.near_room + count)
                    while place > i * pairs.near_room and pairs.near[place - 1] > j:
                        pairs.near[place] = pairs.near[place - 1]
                        place -= 1
                    pairs.near[place] = j
                count += 1
        if count > pairs.near_room:
            fail(status, wp.static(CROWDED), i)
        pairs.near_count[i] = wp.min(count, pairs.near_room)

    @wp.kernel(module=module, enable_backward=False)
    def limit_to_list(
        nodes: int,
        near_margin: wp.array(dtype=scalar),
        stage_size: wp.array(dtype=scalar),
        direction: wp.array(dtype=vec3),
        step_length: wp.array(dtype=scalar),
    ):
        """Shortens a step to half of the margin: the list holds for a whole one, or is new (``measure_stray``)."""
        i = index(wp.tid())
        size = wp.length(direction[i] - direction[index(nodes / 2)]) * stage_size[0]
        allowed = scalar(0.5) * near_margin[0]
        if size > allowed:
            wp.atomic_min(step_length, 0, allowed / size)

    return SimpleNamespace(measure_stray=measure_stray, list_near=list_near, limit_to_list=limit_to_list)
