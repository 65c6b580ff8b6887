"""What runs on the device, pure Warp, in five rooms that say themselves what belongs there and what they import.

Installed as ``warp_yarn.kernels``. A new effect is a new file in ``terms`` with its ``TERM``, and one line here, or a
file anywhere and ``wy.register_term``; ``CONTRIBUTING.md`` has the rest.
"""

import dataclasses
import functools

import warp as wp

from .contact import broad_phase, limits, meshes, obstacles, samples, self_contact
from .core import general
from .core.variant import Term, TermParameter, Variant
from .linear import (
    block_matrix,
    conjugate_gradient,
    incomplete_cholesky,
    multilevel,
    multilevel_conjugate_gradient,
    strips,
)
from .nonlinear import line_search, newton
from .stepping import dirk, energy_watch, esdirk, esdirk_adjoint, frames, linear, linear_adjoint, ros2, stage_adjoint
from .terms import (
    applied_force,
    bending,
    crimp_interchange,
    crimped_contact,
    crossing_normal,
    friction,
    gravity,
    inertia,
    jamming,
    pins,
    seams,
    shear,
    stretch,
    wind,
)

__all__ = ["TERMS", "Term", "TermParameter", "Variant", "build", "build_term", "in_order", "own", "parameters"]

_OWN = (
    inertia.MASS,
    inertia.INERTIA,
    inertia.MASS_RATE,
    stretch.TERM,
    crimp_interchange.TERM,
    bending.TERM,
    gravity.TERM,
    jamming.TERM,
    shear.TERM,
    wind.TERM,
    seams.TERM,
    pins.TERM,
    applied_force.TERM,
    obstacles.TERM,
    meshes.TERM,
    self_contact.TERM,
    friction.TERM,  # last: it reads the sum of the others
)
TERMS: dict[str, Term] = {term.name: term for term in _OWN}
"""Every term by its name, those that were registered last."""


def own(term: Term) -> bool:
    """Tell whether a term is the package's own, and not one that was registered."""
    return term in _OWN


def parameters() -> dict[str, TermParameter]:
    """Find the parameters of all terms, by name."""
    return {parameter.name: parameter for term in tuple(TERMS.values()) for parameter in term.parameters}


def in_order() -> dict[str, Term]:
    """Sort every term, by its name, as they are launched: one that was registered stands before friction, and where it
    presses before all that reads the contact."""
    terms = list(_OWN)
    for term in tuple(TERMS.values()):
        if not own(term):
            after = (k for k, t in enumerate(terms) if t.reads_forces or (term.presses and t.needs_contact))
            terms.insert(next(after), term)
    return {term.name: term for term in terms}


def build(variant: Variant, terms: tuple[str, ...] = ()) -> dict[str, wp.Kernel]:
    """Define every kernel of a variant, by name: ``stretch``, ``stretch_energy``, ...

    Args:
        variant: the variant.
        terms: names of terms whose kernels are wanted too where they are not the package's own.
    """
    kernels = _build(variant)
    for term in (TERMS[name] for name in terms):
        if not own(term):
            kernels = kernels | build_term(term, variant)
    return kernels


@functools.cache
def build_term(term: Term, variant: Variant) -> dict[str, wp.Kernel]:
    """Define the kernels of a term that is not the package's own, in modules of their own: see ``_build``."""
    variant = dataclasses.replace(variant, term=term.name)
    variant.fuse("terms")
    kernels = {term.name: term.define(variant)}
    if term.energy is not None:
        kernels[f"{term.name}_energy"] = term.energy(variant.forward)
    return kernels


@functools.cache
def _build(variant: Variant) -> dict[str, wp.Kernel]:
    """Define the package's own kernels.

    All at once, since a kernel that is added to a Warp module after its first launch compiles the whole module again.
    """
    if variant.general:
        return _build_general(variant)
    variant.fuse("terms")
    # Nodes on one line have products that cancel to the last digit. Contracted, as CUDA's compiler does by itself, one
    # of two is rounded and the other not, and there is a normal of 1e-46 where there is none.
    wp.set_module_options({"fuse_fp": False}, variant.module("contact"))
    kernels = {
        "contact_normal": crossing_normal.define_normal(variant),
        "update_anchor": friction.define_anchor(variant),
        "gusty_wind": wind.define_gusty(variant),
    }
    kernels |= vars(crimped_contact.define(variant))
    for term in _OWN:
        kernels[term.name] = term.define(variant)
        if term.energy is not None:
            kernels[f"{term.name}_energy"] = term.energy(variant.forward)
    for part in (linear, ros2, samples):
        kernels |= vars(part.define_reversible(variant))
    kernels |= vars(limits.define_motion(variant)) | vars(newton.define_turning(variant.forward))
    kernels |= vars(stretch.define_compression(variant.forward))
    for reports in (obstacles.define_reports, meshes.define_search, self_contact.define_limits):
        kernels |= vars(reports(variant.forward))
    for part in (
        linear,
        block_matrix,
        incomplete_cholesky,
        conjugate_gradient,
        multilevel,
        multilevel_conjugate_gradient,
        strips,
        dirk,
        newton,
        line_search,
        limits,
        samples,
        broad_phase,
        energy_watch,
        frames,
        linear_adjoint,
        stage_adjoint,
        esdirk,
        esdirk_adjoint,
        ros2,
    ):
        kernels |= vars(part.define(variant.forward))
    return kernels


def _build_general(variant: Variant) -> dict[str, wp.Kernel]:
    """Define the kernels of general cloths: those that read a cloth's numbers anew, and the others of plain cloths."""
    kernels = dict(_build(variant.plain))
    variant.fuse("terms")
    for term in _OWN:
        if general.reads(kernels[term.name]):
            kernels[term.name] = term.define(variant)
            if term.energy is not None:
                kernels[f"{term.name}_energy"] = term.energy(variant.forward)
    kernels["update_anchor"] = friction.define_anchor(variant)
    kernels |= vars(crimped_contact.define(variant))
    kernels |= vars(ros2.define_reversible(variant)) | vars(newton.define_turning(variant.forward))
    kernels |= vars(stretch.define_compression(variant.forward))
    return kernels
