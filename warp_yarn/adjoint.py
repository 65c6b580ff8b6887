"""The adjoint of a run: gradients of any loss of its frames, by one captured backward step that is replayed.

Only states are kept. A backward step recalls the state that the step started from, assembles again, solves with the
same matrix (it is symmetric), and runs the assembling kernels in reverse (``kernels/adjoint.py``).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from .arrays import STATE_TYPES
from .errors import GradientError
from .simulator import MATRIX, PATHS, SUMS, Simulator

BETWEEN = (*SUMS, "friction_force_out", "normal", "contact_load", "euler_next")
"""Arrays within a step whose adjoints start at 0."""
FRAMES = ("position", "euler", "velocity", "euler_velocity")
"""What a loss may ask of every frame."""


class Adjoint:
    """Differentiates runs of a simulator.

    Args:
        simulator: the simulator; its parameter arrays hold the values to differentiate at.
        parameters: names of the arrays whose gradients are wanted, such as "density" or "gravity", beside those of the
            initial state, which are always there.
    """

    def __init__(self, simulator: Simulator, parameters: tuple[str, ...]):
        self.simulator, self.parameters = simulator, parameters
        a = self.arrays = simulator.arrays
        sliding = simulator.scene.sliding
        if "seed" not in a:
            vec3, scalar, n = a.variant.vec3, a.variant.scalar, a["nodes"]
            a["seed"] = a.zeros(n, vec3)
            a["euler_seed"] = a.zeros(2 * n, scalar) if sliding else None
            a["euler_next"] = a.zeros(2 * n, scalar) if sliding else None
            a["anchor_next"] = None if a["anchor"] is None else a.zeros(2 * n, scalar)
        chained = (*STATE_TYPES, *BETWEEN, *MATRIX, "rhs", "euler_rhs", "solution", "anchor_next", *parameters)
        for name in chained:
            if a[name] is not None:
                a[name].requires_grad = True
        for name in FRAMES:
            # of the loss, by frame of a chunk
            if f"loss_{name}" not in a:
                width = 1 if STATE_TYPES[name] == 3 else 2
                dtype = a.variant.vec3 if width == 1 else a.variant.scalar
                a[f"loss_{name}"] = a.zeros((simulator.chunk + 1) * width * a["nodes"], dtype)
        self.moving = [name for name in PATHS if name in parameters and f"{name}_path" in a]
        for name in self.moving:
            a[f"{name}_path"].requires_grad = True
        if sliding:
            # s⁺ is the end of the step for friction's anchor too: one running adjoint
            a["euler_next"].grad = a["euler"].grad
        self.tape, self.anchor_tape = wp.Tape(), wp.Tape()
        with self.tape:
            simulator.assemble()
            simulator.prescribe()
        with self.anchor_tape:
            if a["anchor"] is not None:
                simulator.drag_anchor("euler_next", "anchor_next")
        self._graph: Any = None

    # -- one step ----------------------------------------------------------------------------------------------------

    def _begin(self) -> None:
        """Recalls the step that ends at the present frame, and takes in what the loss asks of that frame."""
        a, kernels = self.arrays, self.simulator.kernels
        self._receive()
        a.launch(kernels["count"], 1, by=-1)
        a.launch(kernels["recall"], "nodes")
        self.simulator.take_inputs()
        self.simulator.assemble()
        for name in BETWEEN:
            if a[name] is not None and name != "euler_next":
                a[name].grad.zero_()
        if a["anchor"] is not None:
            wp.copy(a["anchor_next"].grad, a["anchor"].grad)
            a["anchor"].grad.zero_()
            self.anchor_tape.backward()

    def _solve(self) -> None:
        """λ, in the gradient of the right-hand side, and from it Ā and the adjoint of what is held."""
        a, simulator, kernels = self.arrays, self.simulator, self.simulator.kernels
        a.launch(kernels["adjoint_right_hand_side"], "nodes")
        sliding = simulator.scene.sliding
        simulator.solve(
            rhs=a["seed"],
            euler_rhs=a["euler_seed"],
            solution=a["rhs"].grad,
            euler_solution=a["euler_rhs"].grad if sliding else None,
        )
        if simulator.held:
            a["q_x"].zero_()
            if sliding:
                a["q_s"].zero_()
            a["solution"].grad.zero_()
            a.launch(kernels["apply_matrix"], 1, p_x=a["rhs"].grad, p_s=a.find("euler_rhs_grad"))
            a.launch(kernels["held_adjoint"], "pins")
        a.launch(kernels["matrix_adjoint"], "nodes")

    def _end(self) -> None:
        a = self.arrays
        for name in self.moving:
            give = self.simulator.kernels["give"]
            a.launch(give, len(a[name]), values_grad=a[name].grad, path_grad=a[f"{name}_path"].grad)

    def _capture(self) -> Any:
        with wp.ScopedCapture(device=self.simulator.device, force_module_load=False) as capture:
            self._begin()
            self._solve()
            self.tape.backward()
            self._end()
        return capture.graph

    def _receive(self) -> None:
        frames = {f"frame_{name}_grad": self.arrays[f"loss_{name}"] for name in FRAMES}
        self.arrays.launch(self.simulator.kernels["receive"], "nodes", **frames)

    # -- a run -------------------------------------------------------------------------------------------------------

    def clear(self) -> None:
        """Sets every gradient that a run adds to back to 0."""
        a = self.arrays
        for name in (*STATE_TYPES, *self.parameters, *(f"{name}_path" for name in self.moving)):
            if a[name] is not None:
                a[name].grad.zero_()

    def backward_chunk(self, first: int, steps: int) -> None:
        """Goes back over the steps of a chunk whose frames are on the device, to the chunk's first frame.

        Args:
            first: step, since the beginning, that the chunk started at.
            steps: how many steps it made.

        Raises:
            GradientError: where an adjoint is not finite, or its solve does not converge.
        """
        a = self.arrays
        if self._graph is None:
            # Loads the adjoint halves of the modules, which a capture cannot.
            self._graph = self._capture()
        a["counters"].assign(np.array([steps, first + steps], dtype=np.int32))
        for k in range(steps, 0, -1):
            wp.capture_launch(self._graph)
            if a["status"].numpy()[0]:
                self._fail(first + k)

    def finish(self) -> None:
        """Takes in what the loss asks of the first frame; the running adjoints are then those of the initial state."""
        self.arrays["counters"].assign(np.zeros(2, dtype=np.int32))
        self._receive()
        for name in (*STATE_TYPES, *self.parameters):
            array = self.arrays[name]
            if array is not None and not np.isfinite(array.grad.numpy()).all():
                raise GradientError(f"the gradient with respect to {name!r} is not finite", step=0, term=None)

    def _fail(self, k: int) -> None:
        a = self.arrays
        code, node = (int(value) for value in a["status"].numpy()[:2])
        a.zero("status")
        columns = self.simulator.scene.cloth.weave.columns
        where = f"step {k}, at node {node} (row {node // columns}, column {node % columns})"
        if code == 1:
            term = self._blame()
            message = f"the adjoint of {where} is not finite"
            if term is not None:
                message += f"; the first term in reverse order that is not finite is {term!r}"
        else:
            term = None
            residual = float(a["residual"].numpy()[0])
            message = f"the adjoint solve of {where} stopped at a residual of {residual:.1e}"
        raise GradientError(message, step=k, term=term)

    def _blame(self) -> str | None:
        """The kernel whose reverse first writes something that is not finite, in the step that is on the device."""
        for launch in reversed(self.tape.launches):
            outputs = [array.grad for array in launch[3] if isinstance(array, wp.array) and array.grad is not None]
            if any(not np.isfinite(grad.numpy()).all() for grad in outputs):
                return launch[0].key
        return None
