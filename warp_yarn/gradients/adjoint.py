"""The adjoint of a run: gradients of any loss of its frames, by one captured backward step that is replayed.

Only states are kept. A backward step recalls the state that the step started from, assembles again, solves with the
same matrix (it is symmetric), and runs the assembling kernels in reverse (the integrator's file, and
``kernels/stepping/linear_adjoint.py``).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..device import declarations
from ..device.arrays import MOVING, STATE_TYPES
from ..device.contact import OBSTACLE_PATHS, PLACED
from ..device.declared import arrays_of
from ..device.inputs import PATHS
from ..errors import GradientError, InputError
from ..kernels.core.status import CROWDED, NOT_FINITE
from ..simulation.simulator import Simulator


class Crowded(Exception):
    """More is near each other than there is room for, at a state where the run made no list of it."""


class Adjoint:
    """Differentiates runs of a simulator, which has one at a time: its integrator records for the last one.

    Args:
        simulator: the simulator; its parameter arrays hold the values to differentiate at.
        parameters: names of the arrays whose gradients are wanted, such as "density" or "gravity", beside those of the
            initial state, which are always there.
    """

    def __init__(self, simulator: Simulator, parameters: tuple[str, ...]):
        if not simulator.arrays.variant.reverse:
            raise InputError("simulator has no reverse mode, must be made with differentiable=True")
        self.simulator, self.parameters = simulator, parameters
        a = self.arrays = simulator.arrays
        self.moving = [name for name in PATHS if name in parameters and f"{name}_path" in a]
        slopes = [name for name in MOVING if name not in STATE_TYPES and name in a]
        self.wanted = (*STATE_TYPES, *slopes, *parameters, *(f"{name}_path" for name in self.moving))
        a.require_grad(*self.wanted)
        self.places = any(name in parameters for name in OBSTACLE_PATHS)
        if self.places:
            a.require_grad(*PLACED)
        # (u, v) has one even where it does not change: it may be an input
        a.make(declarations.LOSS)
        self._prepared: list[Any] = []
        self._prepare(simulator.integrator)

    def _prepare(self, method: Any) -> None:
        """Readies a method of the simulator to go back over its steps."""
        if method not in self._prepared:
            method.prepare_adjoint(self._add_loss_gradient, self._scatter_gradient)
            self._prepared.append(method)

    def _add_loss_gradient(self) -> None:
        """Adds what the loss asks of the present frame to the running adjoints."""
        frames = {f"frame_{name}_grad": self.arrays[f"loss_{name}"] for name in STATE_TYPES}
        self.simulator.model.launch("add_loss_gradient", "nodes", **frames)

    def _scatter_gradient(self, stage: int) -> None:
        """Adds what a stage gave to inputs that change from step to step to the rows of their paths."""
        for name in self.moving:
            self.simulator.model.inputs.scatter_gradient(name, stage)
        if self.places:
            self.simulator.model.contact.scatter_gradient(stage)

    def release(self) -> None:
        """Gives the gradients of parameters up, before another one asks for other parameters."""
        for name in self.wanted:
            if name not in MOVING and self.arrays[name] is not None:
                self.arrays[name].requires_grad = False

    def clear(self) -> None:
        """Sets every gradient that a run adds to back to 0."""
        self.arrays.zero_grad(*self.wanted, *(PLACED if self.places else ()))

    def backward_chunk(self, first: int, steps: int, before: int = 0) -> None:
        """Goes back over the steps of a chunk whose frames are on the device, to the chunk's first frame.

        Args:
            first: step of the run that the chunk started at.
            steps: how many steps it made.
            before: steps made before the run, by which moving pins and applied forces are looked up.

        Raises:
            GradientError: where an adjoint is not finite, or its solve does not converge.
            Crowded: all of it is to be gone over again, with more room.
        """
        self.arrays.put("counters", steps, before + first + steps)
        with self.simulator.model.threads.at_hand():
            for k in range(steps, 0, -1):
                self._backward(self.simulator.integrator, first + k)

    def backward_part(self, method: Any, size: float, left: float, step: int, before: int = 0) -> None:
        """Goes back over a part of a step, from its end, frame 1 on the device, to its start, frame 0.

        What the loss asks of the step's end is for its last part, the first that is taken back; it is 0 afterwards.

        Args:
            method: the integrator that made it.
            size: of the step.
            left: part of the step that was left when it began.
            step: number of the step in the run, from 1 on.
            before: as of ``backward_chunk``.

        Raises:
            GradientError: as of ``backward_chunk``.
        """
        self._prepare(method)
        h = self.simulator.step_size
        try:
            method.set_times(size * h, left * h)
            self.arrays.put("counters", 1, before + step)
            with self.simulator.model.threads.at_hand():
                self._backward(method, step)
        finally:
            self.simulator.integrator.set_times(h, h)
        self.arrays.zero(*(f"loss_{name}" for name in STATE_TYPES))

    def _backward(self, method: Any, step: int) -> None:
        """Goes back over what ends at the present frame."""
        method.backward_step()
        code = int(self.arrays["status"].numpy()[0])
        if code == CROWDED:
            raise Crowded
        if code:
            self._fail(method, step)

    def finish(self) -> None:
        """Adds what the loss asks of the first frame; the running adjoints are then those of the initial state.

        Raises:
            GradientError: a gradient that is not finite.
        """
        self.arrays.zero("counters")
        self._add_loss_gradient()
        for name in self.wanted:
            array = self.arrays[name]
            if array is not None and not np.isfinite(array.grad.numpy()).all():
                raise GradientError(f"the gradient with respect to {name!r} is not finite", step=0, term=None)

    def _fail(self, method: Any, k: int) -> None:
        """Raises a GradientError that says what went wrong at a step."""
        a = self.arrays
        code, node = (int(value) for value in a["status"].numpy()[:2])
        a.zero("status")
        where = f"step {k}"
        if node >= 0:
            where += f", at node {node} ({self.simulator.scene.cloth.place(node)})"
        term = None
        if code == NOT_FINITE:
            message = f"the adjoint of {where} is not finite"
            term = self._blame(method)
            if term is not None:
                message += f"; the first term in reverse order that is not finite is {term!r}"
        else:
            residual = float(a["residual"].numpy()[0])
            message = f"the adjoint solve of {where} stopped at a residual of {residual:.1e}"
        raise GradientError(message, step=k, term=term)

    def _blame(self, method: Any) -> str | None:
        """Finds the kernel whose reverse first writes what is not finite, in the step that is on the device."""
        for launch in reversed(method.tape.launches):
            gradients = [array.grad for array in arrays_of(launch) if array.grad is not None]
            if any(not np.isfinite(gradient.numpy()).all() for gradient in gradients):
                return launch[0].key
        return None
