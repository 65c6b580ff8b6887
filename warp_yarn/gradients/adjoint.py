"""The adjoint of a run: gradients of any loss of its frames, by one captured backward step that is replayed.

Only states are kept. A backward step recalls the state that the step started from, assembles again, solves with the
same matrix (it is symmetric), and runs the assembling kernels in reverse (the integrator's file, and
``kernels/stepping/linear_adjoint.py``).
"""

from __future__ import annotations

import numpy as np
import warp as wp

from ..device.arrays import STATE_TYPES
from ..device.model import PATHS
from ..errors import GradientError, InputError
from ..kernels.core.status import NOT_FINITE
from ..simulation.simulator import Simulator


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
        self.wanted = (*STATE_TYPES, *parameters, *(f"{name}_path" for name in self.moving))
        a.require_grad(*self.wanted)
        for name in STATE_TYPES:
            # of the loss, by frame of a chunk; (u, v) has one even where it does not change: it may be an input
            if f"loss_{name}" not in a:
                array, frames = a[name], simulator.chunk + 1
                a[f"loss_{name}"] = None if array is None else a.zeros(frames * array.shape[0], array.dtype)
        simulator.integrator.prepare_adjoint(self._receive, self._give)

    def _receive(self) -> None:
        """Takes in what the loss asks of the present frame."""
        frames = {f"frame_{name}_grad": self.arrays[f"loss_{name}"] for name in STATE_TYPES}
        self.simulator.model.launch("receive", "nodes", **frames)

    def _give(self, stage: int) -> None:
        """Hands what a stage gave to inputs that change from step to step to the rows of their paths."""
        for name in self.moving:
            self.simulator.model.give_inputs(name, stage)

    def release(self) -> None:
        """Gives the gradients of parameters up, before another one asks for other parameters."""
        for name in self.wanted:
            if name not in STATE_TYPES and self.arrays[name] is not None:
                self.arrays[name].requires_grad = False

    def clear(self) -> None:
        """Sets every gradient that a run adds to back to 0."""
        self.arrays.zero_grad(*self.wanted)

    def backward_chunk(self, first: int, steps: int, before: int = 0) -> None:
        """Goes back over the steps of a chunk whose frames are on the device, to the chunk's first frame.

        Args:
            first: step of the run that the chunk started at.
            steps: how many steps it made.
            before: steps made before the run, by which moving pins and applied forces are looked up.

        Raises:
            GradientError: where an adjoint is not finite, or its solve does not converge.
        """
        a = self.arrays
        a.put("counters", steps, before + first + steps)
        with self.simulator.model.team():
            for k in range(steps, 0, -1):
                self.simulator.integrator.retreat()
                if a["status"].numpy()[0]:
                    self._fail(first + k)

    def finish(self) -> None:
        """Takes in what the loss asks of the first frame; the running adjoints are then those of the initial state."""
        self.arrays.zero("counters")
        self._receive()
        for name in self.wanted:
            array = self.arrays[name]
            if array is not None and not np.isfinite(array.grad.numpy()).all():
                raise GradientError(f"the gradient with respect to {name!r} is not finite", step=0, term=None)

    def _fail(self, k: int) -> None:
        a = self.arrays
        code, node = (int(value) for value in a["status"].numpy()[:2])
        a.zero("status")
        where = f"step {k}"
        if node >= 0:
            where += f", at node {node} ({self.simulator.scene.cloth.place(node)})"
        term = None
        if code == NOT_FINITE:
            message = f"the adjoint of {where} is not finite"
            term = self._blame()
            if term is not None:
                message += f"; the first term in reverse order that is not finite is {term!r}"
        else:
            residual = float(a["residual"].numpy()[0])
            message = f"the adjoint solve of {where} stopped at a residual of {residual:.1e}"
        raise GradientError(message, step=k, term=term)

    def _blame(self) -> str | None:
        """The kernel whose reverse first writes something that is not finite, in the step that is on the device."""
        for launch in reversed(self.simulator.integrator.tape.launches):
            gradients = [array.grad for array in launch[3] if isinstance(array, wp.array) and array.grad is not None]
            if any(not np.isfinite(gradient.numpy()).all() for gradient in gradients):
                return launch[0].key
        return None
