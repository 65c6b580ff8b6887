"""What implicit methods share: a step of stages, each solved by Newton's iteration."""

from __future__ import annotations

from collections.abc import Callable

from ..device import declarations
from ..device.graphs import GraphCache
from ..device.model import Model
from .made import Made, Point, held
from .newton import Newton
from .stage_adjoint import StageAdjoint


class StageMethod:
    """A method whose step is one or two implicit stages of size η = fraction · h.

    The first stage starts from the present state (q, q̇). What it leads to is carried by t = carried · h, to
    q + t w₁ and q̇ + t (w₁ − q̇)/η: there a second stage starts, or the step ends if there is none. Where carried is 0
    the stage itself ends the step, and so does a second stage.
    """

    name: str
    order: int
    fraction: float
    carried: float
    stages: int
    fallback: str | None = None
    """The method that makes a step again that gained energy."""
    local_error: float | None = None
    """c of the error c h³ d³q/dt³ of a step, where its stages tell the third derivative."""

    def __init__(self, model: Model):
        self.model = model
        self.newton = Newton(model, has_fallback=self.fallback is not None)
        self.set_times(model.step_size, model.step_size)
        self._graphs = GraphCache(model.device)

    def set_times(self, step: float, remaining: float) -> None:
        """Sets h and the time in which hard pins reach their targets [s] (``Model.set_times``)."""
        a, stage = self.model.arrays, self.fraction * step
        self.model.set_times(step, remaining, stage, (self.fraction, self.fraction + self.carried)[: self.stages])
        a.put("newton_tolerance", self.model.newton_tolerance_at(step))
        a.put("stage_size", stage)
        a.put("carried_time", self.carried * step)
        a.put("carried_rate", self.carried / self.fraction)
        a.put("stage_shares", *self._shares, *[0.0] * (6 - self.stages))

    def advance(self) -> None:
        """Makes a step, and records it: one captured graph, whose loops end on the device."""
        self._graphs.run("forward", self._step)

    def _step(self) -> None:
        model = self.model
        estimates = "predicted" in model.arrays
        self._begin()
        for stage in range(self.stages):
            if stage:
                model.inputs.load(stage)
                self.newton.ask_for_matrix()
                model.launch("next_base", "nodes", start=model.arrays["solution"])
                if estimates:
                    model.copy(predicted="solution")
            self.newton.solve(stage)
            self.newton.refuse_impact()
            model.energy.add_work(stage)
        if estimates:
            model.launch("estimate_error", 1)
        if self.is_carried:
            model.launch("next_base", "nodes", start=None)
            self.model.copy(
                position="base_position",
                euler="base_euler",
                velocity="base_velocity",
                euler_velocity="base_euler_velocity",
            )
        self._end()

    def _end(self) -> None:
        """Ends a step, with what the next one asks of it."""
        if "slopes" in self.model.arrays.conditions:
            self.model.launch("add_slope", "nodes", share=1.0, is_first=1)
        self.model.end_step(by_stages=True)

    @property
    def _shares(self) -> tuple[float, ...]:
        """Gives the share of each stage's slope in what a step makes."""
        return (1.0,) if self.stages == 1 else (self.carried, self.fraction)

    def estimate_errors(self) -> None:
        """Makes steps leave an estimate of their error in ``step_error`` [m]: c h³ (a₂ − a₁)/(t₂ − t₁), of the
        accelerations at both stages' times. The second stage starts from the first's gain of velocity, η a₁, so it is
        in proportion to what Newton's iteration adds to that."""
        a = self.model.arrays
        a.make(declarations.ERROR_ESTIMATE)
        a.put("missing", self.local_error / (self.fraction * self.carried))

    @property
    def is_carried(self) -> bool:
        """Says whether what the only stage leads to is carried to the step's end."""
        return self.stages == 1 and self.carried > 0.0

    @property
    def iterations(self) -> int:
        """Counts Newton iterations of the last step."""
        return int(self.model.arrays["newton_iterations"].numpy()[0])

    def _begin(self) -> None:
        """Starts from the present state, at the present velocity."""
        model = self.model
        model.begin_step()
        model.energy.begin_work()
        model.inputs.load()
        model.arrays.zero("newton_iterations", "node_mass")
        model.launch("lump_mass", "segments")
        model.copy(solution="velocity", euler_solution="euler_velocity")
        model.set_pin_velocity()
        self.set_base()

    def set_base(self) -> None:
        self.model.copy(
            base_position="position",
            base_euler="euler",
            base_velocity="velocity",
            base_euler_velocity="euler_velocity",
        )

    def made(self, before: Point, after: Point, step: float) -> list[Made]:
        """Finds the stages of a step that was made from its two ends, as the adjoint does."""
        stage, carried = self.fraction * step, self.carried * step
        rate = self.carried / self.fraction
        if self.is_carried:
            return [Made.implicit(1.0, stage, before, before.velocity + (after.velocity - before.velocity) / rate)]
        if self.stages == 1:
            return [Made.implicit(1.0, stage, before, after.velocity)]
        first = (after.position - before.position - stage * after.velocity) / carried
        # what is held has one velocity in both
        fixed = held(self.model)
        first[fixed] = after.velocity[fixed]
        base = Point(before.position + carried * first, before.velocity + rate * (first - before.velocity))
        return [
            Made.implicit(self._shares[0], stage, before, first),
            Made.implicit(self._shares[1], stage, base, after.velocity),
        ]

    def assemble_made(self, stage: int) -> None:
        """Assembles the matrix and the right-hand side of a stage that was made, in place: what is left of it is the
        residual."""
        self.model.arrays.zero("evaluations")
        self.newton.assemble(matrix=True)

    def forget_graphs(self) -> None:
        """Captures anew, after arrays have changed their place."""
        self._graphs.clear()
        if hasattr(self, "_adjoint"):
            self.prepare_adjoint(*self._adjoint.around)

    def prepare_adjoint(self, before: Callable[[], None], after: Callable[[int], None]) -> None:
        """Makes room for the adjoints within a step, and records what the tape reverses."""
        self._adjoint = StageAdjoint(self, before, after)
        self.tape = self._adjoint.tape

    def backward_step(self) -> None:
        """Goes back over the step that ends at the present frame."""
        self._adjoint.backward_step()
