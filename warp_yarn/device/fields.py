"""What a declaration says of an array, and the conditions under which a scene has it."""

import dataclasses
from typing import Any

import numpy as np
import warp as wp

from ..description.scene import Scene
from ..description.varying import has_gusts
from ..kernels import Term, Variant, own


@dataclasses.dataclass(frozen=True)
class Field:
    """Declares an array.

    Args:
        element: what it has an entry of: a key of ``Arrays.sizes``, "count" of a number that all launches share, or
            "launch" of what a launch says itself.
        count: how many to an element.
        kind: its type: "scalar" (of the variant), "int", "uint64", "vec3", "vec4", "quat", "mat33", "sym33", "vec3i",
            "vec4i"; "any" of what stands for one array or another.
        unit: SI, "" of what has none.
        when: the condition of the scene under which it is there.
        meaning: what it is.
    """

    element: str
    count: int
    kind: str
    unit: str
    when: str
    meaning: str

    def dtype(self, variant: Variant) -> Any:
        """Find the Warp type of an entry."""
        fixed = {"int": wp.int32, "uint64": wp.uint64, "vec3i": wp.vec3i, "vec4i": wp.vec4i}
        return fixed[self.kind] if self.kind in fixed else getattr(variant, self.kind)


Group = dict[str, Field]


def conditions(scene: Scene, variant: Variant, terms: list[Term]) -> set[str]:
    """Find the conditions that hold for a scene, of those that ``Field.when`` may name."""
    return {name for name, value in known_conditions(scene, variant, terms).items() if value}


def known_conditions(scene: Scene, variant: Variant, terms: list[Term]) -> dict[str, bool]:
    """Look whether each condition that there is holds for a scene."""
    names = {term.name for term in terms}
    # which may read any index array
    others = any(not own(term) for term in terms)
    return {
        "always": True,
        # what a method adds, and not the scene
        "Newton's iteration": False,
        "slopes": False,
        "slopes of sliding": False,
        "sliding": variant.sliding,
        "general": variant.general,
        "contact": any(term.needs_contact for term in terms),
        "friction": "friction" in names,
        "shear": "shear" in names or others,
        "wind": "wind" in names or others,
        "seams": "seams" in names,
        "has gravity": scene.gravity is not None,
        "has wind": scene.wind is not None,
        "gravity changes": isinstance(scene.gravity, np.ndarray) and scene.gravity.ndim == 2,
        "wind changes": scene.wind is not None and np.ndim(scene.wind.velocity) == 2,
        "gusts": has_gusts(scene.functions),
        "has pins": len(scene.pins) > 0,
        "hard pins": len(scene.pins) > 0 and scene.pin_stiffness is None,
        "spring pins": len(scene.pins) > 0 and scene.pin_stiffness is not None,
        "pins move": scene.pin_path is not None,
        "has forces": len(scene.force_nodes) > 0,
        "forces change": len(scene.force_nodes) > 0 and len(scene.force_path) > 1,
        "obstacles": len(scene.obstacles) > 0 and scene.has_barrier,
        "obstacles move": scene.has_barrier and any(obstacle.path is not None for obstacle in scene.obstacles),
        "self-contact": scene.self_contact and scene.has_barrier,
        "middles": (len(scene.obstacles) > 0 or scene.self_contact) and scene.contact.samples == "nodes+mids",
        "crimp interchange": "crimp_interchange" in names,
        "crimped contact": scene.contact_force == "crimped",
    }
