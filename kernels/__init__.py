"""What runs on the device, pure Warp, in five rooms that say themselves what belongs there and what they import.

Installed as ``warp_yarn.kernels``. A new effect is a new file in ``terms`` with its ``TERM``, and one line here;
``CONTRIBUTING.md`` has the rest.
"""

import functools

import warp as wp

from .contact import broad_phase, limits, obstacles, self_contact
from .core.variant import Term, Variant
from .linear import block_matrix, conjugate_gradient, incomplete_cholesky, multilevel
from .nonlinear import newton
from .stepping import energy_watch, frames, linear, linear_adjoint, ros2, stage_adjoint
from .terms import (
    applied_force,
    bending,
    crossing_normal,
    friction,
    gravity,
    inertia,
    jamming,
    pins,
    shear,
    stretch,
    wind,
)

__all__ = ["TERMS", "Term", "Variant", "build"]

_REGISTERED = (
    inertia.MASS,
    inertia.INERTIA,
    inertia.MASS_RATE,
    stretch.TERM,
    bending.TERM,
    gravity.TERM,
    jamming.TERM,
    shear.TERM,
    wind.TERM,
    pins.TERM,
    applied_force.TERM,
    obstacles.TERM,
    self_contact.TERM,
    friction.TERM,  # last: it reads the sum of the others
)
TERMS: dict[str, Term] = {term.name: term for term in _REGISTERED}


@functools.cache
def build(variant: Variant) -> dict[str, wp.Kernel]:
    """Every kernel of a variant, by name: ``stretch``, ``stretch_energy``, ...

    All at once, since a kernel that is added to a Warp module after its first launch compiles the whole module again.
    """
    variant.fuse("terms")
    # Nodes on one line have products that cancel to the last digit. Contracted, as CUDA's compiler does by itself, one
    # of two is rounded and the other not, and there is a normal of 1e-46 where there is none.
    wp.set_module_options({"fuse_fp": False}, variant.module("contact"))
    kernels = {"contact_normal": crossing_normal.define_normal(variant), "drag_anchor": friction.define_anchor(variant)}
    for term in TERMS.values():
        kernels[term.name] = term.define(variant)
        if term.energy is not None:
            kernels[f"{term.name}_energy"] = term.energy(variant.forward)
    for part in (linear, ros2):
        kernels |= vars(part.define_reversible(variant))
    kernels |= vars(limits.define_motion(variant)) | vars(obstacles.define_reports(variant.forward))
    kernels |= vars(self_contact.define_limits(variant.forward))
    for part in (
        linear,
        block_matrix,
        incomplete_cholesky,
        conjugate_gradient,
        multilevel,
        newton,
        limits,
        broad_phase,
        energy_watch,
        frames,
        linear_adjoint,
        stage_adjoint,
        ros2,
    ):
        kernels |= vars(part.define(variant.forward))
    return kernels
