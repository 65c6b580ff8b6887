"""The watch over a model's energy: the host's side of ``kernels/stepping/energy_watch.py``."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..kernels import Term
from ..kernels.stepping.energy_watch import BLOW_UP, GAIN, STILL
from . import declarations

if TYPE_CHECKING:
    from .model import Model

MEMORY = ("bounds", "steps_to_audit", "audit_due", "alert", "outer_force")
"""What it writes down of steps, for those that come; outer_force where outer forces do work."""
LOOKED_AT = ("elastic_energy", "height_energy")
SAME = {wp.float64: 1e-9, wp.float32: 1e-4}
"""Part of energies that rounding, also of where pins are, makes of the same ones."""
AT_END, AT_START, AT_SLOPE = 3, 4, 5
"""The places of a step's end and start among ``stage_times``, behind those of three stages, and of the stage that finds
a slope where no step has left one."""


class EnergyWatch:
    """Compares the energy at the end of every step with what there was and the work that was done.

    Attributes:
        on: whether it does; where pins are moved exactly, their reaction is nowhere at hand.
    """

    def __init__(self, model: Model):
        self.model = model
        a = model.arrays
        # the reaction of pins that are moved exactly is nowhere at hand
        self.on = not (model.has_hard_pins and model.scene.pin_path is not None)
        a.make(declarations.ENERGY_WATCH)
        a.put("still_energy", 0.5 * a.node_mass() * a["nodes"] * STILL**2)
        if self._outer:
            a.make(declarations.OUTER_FORCES)
        a.put("gain", BLOW_UP if a.variant.reverse else GAIN)
        self.forget()

    def forget(self) -> None:
        """Begins to watch anew, from the present state on."""
        for name, value in (("audit_due", 1), ("alert", 0)):
            self.model.arrays.put(name, value)
        self.model.arrays.put("bounds", 0.0, 0.0, 0.0, -math.inf, 0.0, 0.0, 0.0)

    def memory(self) -> dict[str, np.ndarray]:
        """Copies what it has written down, and the energies that it looks at every step."""
        a = self.model.arrays
        return {name: a.values_of(name).copy() for name in (*MEMORY, *LOOKED_AT) if name in a}

    def recall(self, memory: dict[str, np.ndarray]) -> None:
        """Goes back to what ``memory`` gave."""
        for name in MEMORY:
            if name in memory and name in self.model.arrays:
                self.model.arrays[name].assign(memory[name])

    def go_on(self, memory: dict[str, np.ndarray], steps_done: int) -> None:
        """Goes on from what another one's ``memory`` gave after so many steps, if the energies of the present state
        are what they were there: by other inputs, or numbers that were changed by hand, it begins anew."""
        a = self.model.arrays
        shapes = {name: value.shape for name, value in self.memory().items()}
        if not self.on or shapes != {name: memory[name].shape for name in shapes if name in memory}:
            return
        a.put("counters", 0, steps_done)
        if self.model.inputs.move:
            self.model.inputs.load(AT_START)
        a.zero(*LOOKED_AT)
        self._add_energies(cheap=True)
        off = max(abs(float(a[name].numpy()[0] - memory[name][0])) for name in LOOKED_AT)
        if off <= SAME[a.variant.scalar] * max(abs(float(memory[name][0])) for name in LOOKED_AT):
            self.recall({name: memory[name].astype(a[name].numpy().dtype) for name in shapes})

    def trust(self) -> None:
        """Lets all steps pass, until ``forget``: steps that are made again, from the middle of a run, were
        watched the first time."""
        a = self.model.arrays
        a.put("bounds", math.inf, math.inf, 0.0, 0.0, 0.0, 0.0, 0.0)
        a.put("audit_due", 0)
        a.put("steps_to_audit", np.iinfo(np.int32).max)

    def begin_step(self) -> None:
        """Looks at all energies, if it is time to."""
        if self.on:
            wp.capture_if(self.model.arrays["audit_due"], on_true=self._audit)

    def _audit(self) -> None:
        if self.model.inputs.move:
            self.model.inputs.load(AT_START)
        self.model.add_contact_load()
        self.model.arrays.zero("energy", "elastic_energy", "height_energy")
        self._add_energies(cheap=True)
        self._add_energies(cheap=False)
        if self._outer:
            self._add_outer_forces("outer_force")
        self.model.launch("audit", 1)

    def _add_energies(self, *, cheap: bool) -> None:
        """Adds up the energy of the terms that are watched at every step, or of the others."""
        for term in self.model.arrays.terms:
            if term.energy is not None and bool(term.energy_watched_as) == cheap and term not in self._outer:
                self.add(term, self.model.arrays[term.energy_watched_as or "energy"])

    def add(self, term: Term, energy: wp.array) -> None:
        """Adds a term's energy at the present state."""
        arrays = self.model.contact.samples.of("position") if term.touches else {}
        self.model.launch(f"{term.name}_energy", term.elements, energy=energy, **arrays)

    def begin_work(self) -> None:
        """Begins to add up the work done in a step."""
        self.model.arrays.zero("stage_work")

    def add_work(self, stage: int) -> None:
        """Adds the work that is done at the present state in the share of a stage (of ``stage_shares``)."""
        if self.on:
            self._add_powers()
            self.model.launch("add_work", 1, stage=stage)

    @property
    def _outer(self) -> list[Term]:
        """Finds the terms that do work on the cloth and have no energy, gravity too where it varies."""
        of_height = self.model.inputs.gravity_varies
        terms = self.model.arrays.terms
        return [term for term in terms if term.works or (of_height and term.energy_watched_as == "height_energy")]

    def _add_outer_forces(self, target: str) -> None:
        """Fills an array with outer forces at the present state."""
        a = self.model.arrays
        a.zero(target)
        for term in self._outer:
            # the weight of what slides goes where the solver works
            others = {} if term.works else {"euler_force": a["q_s"]}
            self.model.launch_term(term, matrix=0, add_contact_load=0, force=a[target], **others)

    def _add_powers(self) -> None:
        """Adds up the power of outer forces and of moving pins at the present state."""
        a = self.model.arrays
        a.zero("power")
        if self._outer:
            # the forces go where the solver works
            self._add_outer_forces("q_x")
            self.model.launch("add_power", "nodes", force=a["q_x"])
        if "pins move" in a.conditions and any(term.name == "pins" for term in a.terms):
            self.model.launch("add_pin_power", "pins", step_duration=self.model.step_size)
        self.model.contact.add_power()

    def power_of(self, name: str) -> float:
        """Compute the power of a term that does work, at the present state along the solution, or of moving obstacles,
        "contact" [W]."""
        a = self.model.arrays
        a.zero("power")
        if name == "contact":
            self.model.contact.find()
            self.model.contact.add_power()
            return float(a["power"].numpy()[0])
        term = next(term for term in self._outer if term.name == name)
        a.zero("q_x", "q_s")
        self.model.launch_term(term, matrix=0, add_contact_load=0, force=a["q_x"], euler_force=a["q_s"])
        pairs = [("q_x", "solution"), *([("q_s", "euler_solution")] if self.model.scene.sliding else [])]
        return sum(float(np.vdot(*(a[name].numpy().astype(np.float64) for name in pair))) for pair in pairs)

    @property
    def workers(self) -> list[str]:
        """Names what ``power_of`` knows."""
        names = [term.name for term in self._outer]
        return [*names, "contact"] if self.model.contact.obstacles_move else names

    def end_step(self, *, by_stages: bool) -> None:
        """Compares the energy at the end of a step with the work done in it."""
        if not self.on:
            return
        a = self.model.arrays
        a.zero("energy", "elastic_energy", "height_energy")
        self._add_energies(cheap=True)
        self.model.launch("suspect", 1)
        wp.capture_if(a["looks_closely"], on_true=lambda: self._add_energies(cheap=False))
        self._add_powers()
        self.model.launch("close_step", 1, by_stages=int(by_stages))
        if self._outer:
            self.model.launch("keep_outer_force", "nodes", force=a["q_x"])
