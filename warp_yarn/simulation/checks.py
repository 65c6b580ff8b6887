"""What a simulator refuses: states that it cannot start from, and options that it cannot be made with."""

from __future__ import annotations

import contextlib
import os
import warnings
from typing import Any

import numpy as np

from ..description.scene import Scene
from ..errors import InputError, brief, integer, real
from ..integrators import INTEGRATORS
from ..integrators.linear import LinearlyImplicitEuler
from ..integrators.ros2 import ROS2
from ..integrators.stage import StageMethod
from .state import State

CHUNK_BYTES = 1 << 22
"""Room for frames on the device: enough that copying them out costs nothing, little enough for a large cloth."""

FRAME_BYTES = 13 * 8
"""Of a node's numbers in a frame."""

LARGEST = 2**31 - 1
"""Of what kernels count."""


def checked_state(state: Any, scene: Scene) -> State:
    """Copies a state that a scene can be in.

    Raises:
        InputError: it is none: a shape, a value that is not finite, crossings out of order, or what slides where
            nothing does.
    """
    if not isinstance(state, State):
        raise InputError(f"state = {brief(state)}, must be a State")
    state = state.checked(scene.cloth.nodes)
    topology = scene.cloth.topology
    direction = topology.yarn_direction[topology.segment_yarn]
    a, b = topology.segment_nodes.T
    rest = state.euler[b, direction] - state.euler[a, direction]
    if rest.min() <= 0.0:
        k = int(rest.argmin())
        raise InputError(
            f"state.euler: Δs = {rest[k]:g} between nodes {a[k]} and {b[k]} of yarn {topology.segment_yarn[k]}, "
            "must be above 0: crossings keep their order along a yarn"
        )
    if not scene.sliding and np.abs(state.euler_velocity).max() > 0.0:
        raise InputError("state.euler_velocity is not 0, but yarns of this scene do not slide (sliding=False)")
    border = topology.is_crossing == 0
    if np.abs(state.euler_velocity[border]).max() > 0.0:
        raise InputError("state.euler_velocity is not 0 on the border, where nodes have no Eulerian coordinate")
    return state


def check_contact(scene: Scene, integrator: str) -> None:
    """Refuses contact with a method whose steps end elsewhere than a stage, of which none penetrates; and impact zones
    with another one than that of eq. 2.

    Raises:
        InputError: such a method.
    """
    if not isinstance(scene, Scene) or not (scene.obstacles or scene.self_contact):
        return
    if scene.has_impact_zones:
        if integrator != LinearlyImplicitEuler.name:
            raise InputError(
                f"integrator = {integrator!r} with impact zones, which come after a step of eq. 2: must be "
                f"{LinearlyImplicitEuler.name!r}, or contact.method 'barrier'"
            )
        return

    def ends_with_a_stage(method: type) -> bool:
        return issubclass(method, StageMethod) and (method.stages == 2 or not method.carried)

    if not ends_with_a_stage(INTEGRATORS[integrator]):
        able = ", ".join(repr(name) for name, method in INTEGRATORS.items() if ends_with_a_stage(method))
        raise InputError(
            f"integrator = {integrator!r} with contact: a step may end inside something; must be one of {able}, or "
            "contact.method 'impact-zones' with 'linear'"
        )


def check_sliding_crimp(scene: Scene, integrator: str) -> None:
    """Refuses crimp interchange of yarns that slide with a method that takes the matrix for exact.

    Raises:
        InputError: such a method.
    """
    if integrator == ROS2.name and isinstance(scene, Scene) and scene.crimp_interchange and scene.sliding:
        raise InputError(
            f"integrator = {integrator!r} with crimp_interchange and sliding: it takes the matrix for exact, which has "
            "no place for how warp and weft are coupled; must be sliding=False, or another integrator"
        )


def checked_chunk(chunk: int | None, nodes: int, *, one: bool = False) -> int:
    """Gives the steps to a chunk: kernels count its nodes in 31 bits, and its frames have to be in memory. It is one
    where something is to be done before each step."""
    if one and chunk not in (None, 1):
        raise InputError(f"chunk = {chunk!r}, must be 1 or None with a hook or functions, which come before each step")
    if one:
        return 1
    if chunk is None:
        return min(64, max(1, CHUNK_BYTES // (FRAME_BYTES * nodes)))
    most = LARGEST // (2 * nodes) - 1
    with contextlib.suppress(AttributeError, ValueError, OSError):  # Windows does not tell
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        most = min(most, memory // (FRAME_BYTES * nodes) - 1)
    return integer("chunk", chunk, least=1, most=max(most, 1))


def checked_step_error(step_error: float | None, integrator: str, differentiable: bool) -> float | None:
    """Gives the allowed error as a float; an InputError says why steps cannot follow it."""
    if step_error is None:
        return None
    allowed = real("step_error", step_error, above=0.0)
    if differentiable:
        raise InputError("step_error with differentiable: gradients go back through whole steps; leave one out")
    able = [name for name, method in INTEGRATORS.items() if method.local_error is not None]
    if integrator not in able:
        names = ", ".join(repr(name) for name in able)
        raise InputError(f"step_error with integrator = {integrator!r}: only {names} estimates its error")
    return allowed


def warn_of_threads(threads: int) -> None:
    """Warns the caller's caller where there are fewer processor cores than threads."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if threads > cores:
        warnings.warn(
            f"threads = {threads}, but there are {cores} processor cores at hand: they will wait for each other",
            RuntimeWarning,
            stacklevel=3,
        )
