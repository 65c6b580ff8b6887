"""Forces that the user applies to nodes, which may change from step to step.

Parameters: ``applied_force`` [N], of the chosen nodes in this step.
"""

import warp as wp

from ..core.indexing import index
from ..core.variant import Term, Variant


def define(variant: Variant) -> wp.Kernel:
    vec3 = variant.vec3

    @variant.kernel("terms")
    def applied_term(
        applied_node: wp.array(dtype=int),
        applied_force: wp.array(dtype=vec3),
        force: wp.array(dtype=vec3),
    ):
        e = index(wp.tid())
        wp.atomic_add(force, index(applied_node[e]), applied_force[e])

    return applied_term


TERM = Term(
    name="applied",
    elements="applied",
    define=define,
    absent=lambda scene: "" if len(scene.force_nodes) else "forces is empty",
    works=True,
    kept=True,
)
