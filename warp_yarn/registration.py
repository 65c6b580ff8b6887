"""Terms and methods of time integration from outside the package, as if they were its own.

A file that defines one and registers it is all there is to do: scenes, simulators, gradients, calibration and ablations
find it by its name. What is registered is known in this process alone; another one, which loads a recording or a
pickle that names it, has to register it too.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
from typing import Any

import warp as wp

from .description.selection import checked_parameter
from .device.declarations import ASSEMBLY, COMPRESSION, FIELDS, INPUTS, PARAMETERS, STATE, TOPOLOGY
from .device.declared import arguments
from .device.exclusive import ALONE
from .errors import InputError, choice, integer, real
from .integrators import INTEGRATORS
from .integrators.stage import StageMethod
from .kernels import TERMS, Term, TermParameter, Variant, build, build_term, own, parameters
from .kernels.core.variant import ELEMENTS

NAME = re.compile(r"[a-z][a-z0-9_]*")
STENCILS = (0, 2, 4, 6)
SUMS_OF_ENERGY = ("", "elastic_energy", "height_energy")
OTHER_INPUTS = ("sliding", "state", "steps_done", "forces", "pin_path")
"""What calls and ablations say beside the names of terms, parameters and arrays."""
OF_FRICTION = {"anchor", "friction_force_out"}
"""What there is with friction alone."""
OF_STEPS = {"pin_target_path", "pin_start", "pin_motion", "applied_force_path", "gravity_path", "wind_velocity_path"}
OF_STEPS |= {"gust"}
"""What becomes an input of a step."""
OF_THE_SYSTEM = {"rhs", "euler_rhs", "solution", "euler_solution"}
"""What is made of what all terms write."""
FOR_TERMS = {*TOPOLOGY, *PARAMETERS, *INPUTS, *STATE, *ASSEMBLY, *COMPRESSION, "coefficients"}
FOR_TERMS |= {"evaluations", "energy", "matrix", "add_contact_load"}
FOR_TERMS -= OF_FRICTION | OF_STEPS | OF_THE_SYSTEM
"""What kernels of a term from outside the package may take, beside their parameters."""
METHOD = ("name", "order", "fallback", "local_error", "set_times", "advance", "prepare_adjoint", "backward_step")
STAGES = ("fraction", "carried", "stages")
"""What a method has, and a StageMethod as well."""
MAY_DAMP = re.compile(r"\bcoefficients\b(?!\s*:)(?!\[0\]\[[02]\])")
"""Any use of the factors but one of M's or H's alone."""
_OWN_METHODS = frozenset(INTEGRATORS)


def register_term(term: Term) -> None:
    """Adds a term to those that scenes can have.

    A scene has it where its ``parameters`` name one of the term's, or its ``terms`` the term. Its kernels are compiled
    into modules of their own, so it may be registered at any time; simulators that there are already stay as they are.

    Args:
        term: the term. Its name, and those of its parameters, are of small letters, digits and underscores; parameters
            are called as the term, or begin with its name and an underscore. ``CONTRIBUTING.md`` shows one.

    Raises:
        InputError: a name that is taken or not allowed, an attribute or default that cannot be used, a kernel that is
            none or has an argument that it may not take.
    """
    if not isinstance(term, Term):
        raise InputError(f"term = {term!r}, must be a Term")
    try:
        hash(term)
    except TypeError as error:
        raise InputError(f"term = {term!r}: its parameters and their defaults must be tuples ({error})") from error
    with ALONE:
        kernels = build(Variant(wp.float64, True))
        labels = {*FIELDS, *(argument.label for kernel in kernels.values() for argument in kernel.adj.args)}
        taken = {*TERMS, *kernels, *OTHER_INPUTS}
        # every term may have a kernel of its name with _energy behind it
        of_energies = {f"{name}_energy" for name in TERMS} | {name.removesuffix("_energy") for name in taken}
        _check_name("term.name", term.name, taken | of_energies)
        choice("term.elements", term.elements, ELEMENTS)
        choice("term.energy_watched_as", term.energy_watched_as, SUMS_OF_ENERGY)
        if term.stencil not in STENCILS:
            raise InputError(f"term.stencil = {term.stencil!r}, must be one of {', '.join(map(str, STENCILS))}")
        if term.reads_forces:
            raise InputError("term.reads_forces = True, must be False: friction alone reads the sum of forces")
        for parameter in term.parameters:
            _check_parameter(term, parameter, labels | taken | set(parameters()))
        names = [parameter.name for parameter in term.parameters]
        if len(set(names)) < len(names):
            raise InputError(f"term.parameters names one twice: {', '.join(names)}")
        try:
            own_kernels = build_term(term, Variant(wp.float64, True))
        except NameError as error:
            raise InputError(
                f"term {term.name!r} cannot be defined ({error}): Warp reads the annotations of a kernel's arguments, "
                "so its file must not have 'from __future__ import annotations'"
            ) from error
        for kernel in own_kernels.values():
            _check_kernel(term, kernel)
        TERMS[term.name] = term


def unregister_term(name: str) -> None:
    """Takes a registered term out again, such as before another one of its name; simulators that have it keep it.

    Raises:
        InputError: no term of this name was registered.
    """
    with ALONE:
        del TERMS[choice("term", name, [known for known, term in TERMS.items() if not own(term)])]


def register_integrator(method: type) -> None:
    """Adds a method of time integration to those that simulators can have.

    Args:
        method: a subclass of ``wy.StageMethod``, such as ``wy.sdirk`` makes of a Butcher tableau, or another class that
            has what ``warp_yarn/integrators`` says of a method.

    Raises:
        InputError: a name that is taken, or a class that lacks something.
    """
    if not isinstance(method, type):
        raise InputError(f"method = {method!r}, must be a class, such as a StageMethod")
    given: Any = method
    of_stages = issubclass(method, StageMethod)
    needed = (*METHOD, *(STAGES if of_stages else ()))
    for attribute in needed:
        if not hasattr(method, attribute):
            raise InputError(f"method {method.__name__} has no {attribute!r}, must have {', '.join(needed)}")
    name = given.name
    if not isinstance(name, str) or not name or name in INTEGRATORS:
        raise InputError(f"method.name = {name!r}, must be another one than {', '.join(INTEGRATORS)}")
    if given.fallback is not None:
        choice("method.fallback", given.fallback, INTEGRATORS)
    if of_stages:
        integer("method.stages", given.stages, least=1, most=2)
        real("method.fraction", given.fraction, above=0.0)
        # a single stage that ends the step covers it all; one that is carried is carried over all of it
        covered = given.carried if given.stages == 1 and given.carried else given.fraction + given.carried
        if abs(covered - 1.0) > 1e-12:
            raise InputError(
                f"method.fraction = {given.fraction:g} and carried = {given.carried:g} of {given.stages} stages cover "
                f"{covered:g} of a step, must cover 1"
            )
    with ALONE:
        INTEGRATORS[name] = method


def unregister_integrator(name: str) -> None:
    """Takes a registered method out again; simulators that have it keep it.

    Raises:
        InputError: no method of this name was registered.
    """
    with ALONE:
        del INTEGRATORS[choice("integrator", name, [known for known in INTEGRATORS if known not in _OWN_METHODS])]


def _check_name(what: str, name: Any, taken: set[str]) -> None:
    if not isinstance(name, str) or not NAME.fullmatch(name):
        raise InputError(f"{what} = {name!r}, must be a name of small letters, digits and underscores")
    if name in taken:
        raise InputError(f"{what} = {name!r} is taken, must be another name")


def _check_parameter(term: Term, parameter: Any, taken: set[str]) -> None:
    if not isinstance(parameter, TermParameter):
        raise InputError(f"term.parameters has {parameter!r}, must be a TermParameter")
    name = parameter.name
    # a term may be called as its only parameter
    _check_name("a parameter's name", name, taken)
    if name.endswith("_grad") or name.startswith("yarn_"):
        raise InputError(f"a parameter's name = {name!r}, must not begin with 'yarn_' nor end with '_grad'")
    if name != term.name and not name.startswith(f"{term.name}_"):
        raise InputError(f"a parameter's name = {name!r}, must be {term.name!r} or begin with '{term.name}_'")
    choice(f"{name}.of", parameter.of, ("scene", "yarn"))
    if parameter.size not in (1, 3) or (parameter.size == 3 and (parameter.of == "yarn" or parameter.range)):
        raise InputError(
            f"{name}.size = {parameter.size!r} of a {parameter.of}, must be 1, or 3 of a scene and without a range"
        )
    if parameter.least is not None and parameter.above is not None:
        raise InputError(f"{name} has least and above, must have one of them at most")
    if parameter.default is not None:
        checked_parameter(dataclasses.replace(parameter, name=f"the default of {name}"), parameter.default, 1)


def _check_kernel(term: Term, kernel: Any) -> None:
    if not isinstance(kernel, wp.Kernel):
        raise InputError(f"term {term.name!r} defines {kernel!r}, must be a kernel")
    labels = arguments(kernel)
    known = FOR_TERMS | set(parameters()) | {parameter.name for parameter in term.parameters}
    for label in labels:
        if label not in known:
            raise InputError(
                f"term {term.name!r}: its kernel has an argument {label!r}, must be one of {', '.join(sorted(known))}, "
                "or blocks: BlockMatrix"
            )
    source = _source(kernel)
    least = {"upper_": 4 if term.elements == "bends" else 2, "corner_blocks": 6, "triangle_blocks": 6}
    for name, stencil in least.items():
        if term.stencil < stencil and re.search(rf"\b{name}", source):
            raise InputError(f"term {term.name!r} has {name}..., stencil = {term.stencil}, must be at least {stencil}")
    if "normal" in labels and not term.needs_contact:
        raise InputError(f"term {term.name!r} reads the contact's normal, must have needs_contact=True")
    if "contact_load" in labels and not (term.needs_contact or term.presses):
        raise InputError(f"term {term.name!r} has contact_load, must have needs_contact=True or presses=True")
    if MAY_DAMP.search(source) and not term.explicit_in_ros2:
        raise InputError(f"term {term.name!r} adds a damping, coefficients[0][1], must have explicit_in_ros2=True")


def _source(kernel: wp.Kernel) -> str:
    """Collect the source of a kernel and of the Warp functions that it calls, and they call."""
    found: dict[Any, str] = {}
    waiting: list[Any] = [kernel]
    while waiting:
        part = waiting.pop()
        if part not in found:
            found[part] = part.adj.source
            names = inspect.getclosurevars(part.func)
            values = (*names.globals.values(), *names.nonlocals.values())
            waiting += [value for value in values if isinstance(value, wp.Function) and not value.is_builtin()]
    return "\n".join(found.values())
