"""Why a step could not be made, as an error that says where, and which term is to blame."""

from __future__ import annotations

import numpy as np

from ..device.impact_zones import MOST_ROUNDS
from ..device.model import Model
from ..errors import SimulationError
from ..kernels.core import status
from .state import Trajectory
from .substepping import Substepping

Forces = dict[str, tuple[np.ndarray, np.ndarray]]


class Failure:
    """What the device says of a step that failed; it is read, and forgotten there, when this is made.

    Attributes:
        code: of ``kernels/core/status.py``.
        node: index of the node, or -1 where no single node is to blame.
    """

    def __init__(self, model: Model):
        arrays, self.model = model.arrays, model
        self.code, self.node = (int(value) for value in arrays["status"].numpy()[:2])
        if self.node >= 0:
            # contact knows nodes and middles of segments
            self.node = int(model.contact.samples.ends[self.node, 0])
        self.residual = float(arrays["residual"].numpy()[0])
        self.iterations = int(arrays["iterations"].numpy()[0])
        arrays.put("status", 0, 0, 0)

    def error(
        self,
        step: int,
        trajectory: Trajectory,
        forces: Forces,
        substepping: Substepping,
        step_error: float | None,
        near: str = "",
    ) -> SimulationError:
        """Makes the error of a step.

        Args:
            step: its number, counted from 1 in its run.
            trajectory: the frames before it.
            forces: on the last of them, by term.
            substepping: has tried to make the step in parts.
            step_error: that was allowed, in spacings of the yarns.
            near: what was nearest to the node before the step, in words.
        """
        model, node, term = self.model, self.node, blamed(forces, self.node)
        where = f"step {step} (t = {step * model.step_size:g} s):"
        if node >= 0:
            where += f" at node {node} ({model.scene.cloth.place(node)})"
        smallest = substepping.last_size * model.step_size
        near = f" (before the step, {near})" if near else ""
        what = {
            status.NOT_FINITE: f"a value is not finite{near}",
            status.ORDER_LOST: "Δs to the next crossing of the yarn reached 0",
            status.NOT_CONVERGED: (
                f"the solver stopped after {self.iterations} iterations at a residual of {self.residual:.1e}, "
                f"above its tolerance of {model.tolerance:.1e}"
            ),
            status.STALLED: (
                f"Newton's iteration stopped at a residual of {self.residual:.1e}, "
                f"above its tolerance of {model.newton_tolerance_at(smallest):.1e}"
            ),
            status.GAINED: "the cloth gains energy that nothing gave it: take a shorter step or another integrator",
            status.OVERLAPPING: f"it is pressed into something that leaves it no way out{near}",
            status.CROWDED: "more of it comes together than there is room for",
            status.IMPACT: "something strikes it",
            status.UNRESOLVED: f"impacts are left after {MOST_ROUNDS} rounds of impact zones",
            status.INACCURATE: f"its error stays above step_error = {step_error}: allow more",
        }[self.code]
        return SimulationError(
            f"{where} {what}. The largest term {'there ' if node >= 0 else ''}is {term!r}. "
            f"It was tried in parts as small as {smallest:.1e} s; "
            f"the {len(trajectory)} frames before are in this error's trajectory",
            step=step,
            node=node,
            term=term,
            trajectory=trajectory,
        )


def blamed(forces: Forces, node: int) -> str | None:
    """Finds the term with the largest, or a not finite, force on a node; on all of them where node is -1."""
    size = {}
    for name, (force, euler_force) in forces.items():
        at = node if node >= 0 else slice(None)
        with np.errstate(all="ignore"):
            total = float(np.abs(force[at]).sum() + np.abs(euler_force[at]).sum())
        size[name] = total if np.isfinite(total) else np.inf
    return max(size, key=lambda name: size[name], default=None)
