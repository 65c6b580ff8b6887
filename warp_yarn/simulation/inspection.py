"""What one may look into: forces, contact, energies and the linear system of any state of a simulator's scene."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np

from ..device.arrays import MOVING
from ..device.contact import Near
from ..device.model import Model
from ..errors import InputError
from ..kernels.core.status import CROWDED
from ..kernels.core.structs import ONCE
from .alone import alone
from .checks import checked_state
from .contacts import Contacts, contacts_of
from .linear_system import LinearSystem, read_system
from .state import State
from .stepper import Stepper

GIVEN = ("gravity", "wind_velocity", "gust", "applied_force", "applied_force_path")
"""Arrays that functions are evaluated into."""


class Inspection:
    """Looks into the present state or another one, and leaves no trace. The base of the simulator, which has these:

    Attributes:
        model: the scene on the device.
        stepper: makes its steps.
        lock: held while one thread uses it.
    """

    model: Model
    stepper: Stepper
    lock: threading.RLock

    @alone
    def forces(self, state: State | None = None) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Computes the force of every term of the scene on a state (None: the present one), by name.

        Returns:
            {term: (x_forces [nodes, 3] in N, s_forces [nodes, 2] in N)}.
        """
        a, cloth, result = self.model.arrays, self.model.scene.cloth, {}
        crossing = np.repeat(cloth.topology.is_crossing != 0, 2)
        with Visit(self.stepper, state):
            self.model.add_contact_load()
            total = np.zeros(2 * cloth.nodes)
            for term in a.terms:
                if term.name == "mass":
                    continue
                a.zero("force", "euler_force", "friction_force_out")
                if term.reads_forces:
                    a["euler_force"].assign(total)
                self.model.contact.samples.clear(matrix=False)
                self.model.launch_term(term, matrix=0, add_contact_load=0)
                if term.touches:
                    self.model.contact.samples.scatter(matrix=False)
                out = "friction_force_out" if term.name == "friction" else "euler_force"
                along = np.zeros(2 * cloth.nodes)
                if a[out] is not None:
                    # the border has no Eulerian coordinate: what a segment puts there moves nothing
                    along = np.where(crossing, a[out].numpy(), 0.0)
                total += along
                result[term.name] = (a["force"].numpy().astype(np.float64), along.reshape(cloth.nodes, 2).copy())
        return result

    @alone
    def contact(self, state: State | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Computes contact normals, from warp to weft [nodes, 3], and contact forces F_n [nodes] (N), eq. 3; both are 0
        on the border.

        Raises:
            InputError: the scene has no contact.
        """
        a = self.model.arrays
        if not a.contact:
            raise InputError("this scene has no contact: neither 'shear' nor 'friction' is among its terms")
        with Visit(self.stepper, state):
            self.model.add_contact_load()
            load = a["contact_load"].numpy().astype(np.float64)
            return a["normal"].numpy().astype(np.float64), np.maximum(load, 0.0)

    @alone
    def contacts(self, state: State | None = None) -> Contacts:
        """Finds where nodes touch obstacles and each other (None: in the present state).

        Raises:
            InputError: impact zones keep them apart, which have no forces.
        """
        if self.model.zones is not None:
            raise InputError("contact.method is 'impact-zones', must be 'barrier': impact zones have no forces")
        contact, found = self.model.contact, []
        with Visit(self.stepper, state):
            position = self.model.arrays["position"].numpy() + self.model.arrays.origin
            if contact.obstacles:
                found.append(contact.near_obstacles())
            if contact.has_mesh:
                found.append(contact.near_faces())
            if contact.self_contact:
                found.append(contact.near_pairs())
        return contacts_of(found, contact.samples.places(position), contact.samples.ends)

    @alone
    def check_clear(self, state: State | None = None) -> None:
        """Refuses a state where cloth is nearer to an obstacle, or to itself, than it may come.

        Raises:
            InputError: the two places that are nearest, and how near.
        """
        if self.model.zones is not None:
            self.model.zones.check_clear(None if state is None else state.position)
        contact = self.model.contact
        if not contact.on:
            return
        with Visit(self.stepper, state):
            found = [contact.near_pairs()] if contact.self_contact else []
            # of a state that is set, the time is not known yet by which obstacles move
            where_known = state is None or not contact.obstacles_move
            if where_known and contact.obstacles:
                found.append(contact.near_obstacles())
            if where_known and contact.has_mesh:
                found.append(contact.near_faces())
        for near in found:
            if len(near.gap):
                gap, least, words = self._nearest(near)
                if not gap > least:
                    raise InputError(words)

    @alone
    def told_nearest(self, node: int) -> str:
        """Tells what is nearest to a node of the present state, with obstacles where the next step
        has them; or ""."""
        contact = self.model.contact
        with Visit(self.stepper, None, ahead=True):
            found = [contact.near_pairs()] if contact.self_contact else []
            found += [contact.near_obstacles()] if contact.obstacles else []
            found += [contact.near_faces()] if contact.has_mesh else []
        told = []
        for near in found:
            ends = contact.samples.ends
            its = (near.other >= 0) & (ends[near.other] == node).any(axis=1)
            mine = (ends[near.sample] == node).any(axis=1) | its
            if mine.any():
                gap, least, words = self._nearest(Near(*(values[mine] for values in near)))
                told.append((gap - least, words))
        return min(told)[1] if told else ""

    def _nearest(self, near: Near) -> tuple[float, float, str]:
        """Finds the two that are nearest: how near, how near they may be, and that in words."""
        name_of = self.model.contact.samples.name
        k = int(near.gap.argmin())
        sample, other, obstacle = int(near.sample[k]), int(near.other[k]), int(near.obstacle[k])
        of_pair = other >= 0
        name = "self_contact_distance" if of_pair else "contact_distance"
        least = float(self.model.arrays[name].numpy()[0])
        kind = "" if of_pair else type(self.model.scene.obstacles[obstacle]).__name__
        it = name_of(other) if of_pair else f"obstacles[{obstacle}], a {kind}"
        words = (
            f"{name_of(sample)} is {near.gap[k]:.3g} m from {it}: must be above the contact's "
            f"{'self_distance' if of_pair else 'distance'}, {least:.3g} m"
        )
        return float(near.gap[k]), least, words

    @alone
    def energy(self, state: State | None = None) -> dict[str, float]:
        """Computes the energy of every term that has one [J], by name; ``mass`` is the kinetic energy."""
        a, result = self.model.arrays, {}
        with Visit(self.stepper, state):
            self.model.add_contact_load()
            energy = a.zeros(1, a.variant.scalar)
            for term in a.terms:
                if term.energy is not None:
                    energy.zero_()
                    self.model.energy.add(term, energy)
                    # what touches is told as one
                    name = "contact" if term.touches else term.name
                    result[name] = result.get(name, 0.0) + float(energy.numpy()[0])
        return result

    @alone
    def system(self, state: State | None = None, weights: tuple[float, float, float] | None = None) -> LinearSystem:
        """Assembles the linear system of the next step of eq. 2, to look into.

        Args:
            state: of the step's beginning; None: the present one.
            weights: factors of M, D and H in its matrix; None: 1, h and h².
        """
        h = self.model.step_size
        with Visit(self.stepper, state, ahead=True):
            self.model.arrays.put("evaluations", ONCE)
            self.model.arrays.put("coefficients", *(weights or (1.0, h, h * h)))
            with_room(self.stepper, self.model.assemble)
            return read_system(self.model)


def with_room(stepper: Stepper, look: Callable[[], None]) -> bool:
    """Does what looks for what touches at the present positions, which no step may have come to, and makes room until
    there is enough for it; tells whether it had to."""
    look()
    made = False
    while int(stepper.model.arrays["status"].numpy()[0]) == CROWDED:
        stepper.make_room()
        look()
        made = True
    return made


class Visit:
    """Another state for as long as a block lasts; the arrays that a step works with are free for it.

    Pins and applied forces are those of the last step, or, if asked for, of the next one, or of the step after so many
    (``row``), whose stages are then at their times. Functions are evaluated where the cloth is, or where that step
    began.
    """

    def __init__(
        self,
        stepper: Stepper,
        state: State | None,
        *,
        ahead: bool = False,
        row: int | None = None,
        begun: np.ndarray | None = None,
    ):
        self.stepper = stepper
        self.ahead, self.by_stages = ahead, row is not None
        if row is None:
            row = stepper.steps_done if ahead else max(0, stepper.steps_done - 1)
        self.row, self.begun = row, begun
        self.visited = None if state is None else checked_state(state, stepper.model.scene)

    def __enter__(self) -> None:
        stepper, model, home = self.stepper, self.stepper.model, {}
        if self.visited is not None:
            home = {name: model.arrays[name].numpy().copy() for name in MOVING if stepper.frames.moves(name)}
        if model.inputs.functions:
            given = [name for name in GIVEN if model.arrays.get(name) is not None]
            home |= {name: model.arrays[name].numpy().copy() for name in given}

        def go_home() -> None:
            for name, value in home.items():
                model.arrays[name].assign(value)
            stepper.integrator.set_times(model.step_size, model.step_size)

        stepper.owe(go_home)
        model.arrays.put("counters", 0, self.row)
        if model.inputs.functions:
            begun = self.visited.position if self.begun is None and self.visited is not None else self.begun
            model.inputs.evaluate(self.row, stepper.frames.state().position if begun is None else begun)
        if not self.by_stages:
            # before the first step, pins are where they start
            model.arrays["stage_times"].fill_(float(self.ahead or stepper.steps_done > 0))
            model.inputs.load()
        if self.visited is not None:
            stepper.frames.upload(self.visited)
        with_room(stepper, model.contact.find)

    def __exit__(self, *_: object) -> None:
        self.stepper.pay()
