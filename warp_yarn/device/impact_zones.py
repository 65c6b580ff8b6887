"""Impact zones: the paper's response to collisions, after the step of eq. 2 (Harmon et al. 2008; section 3.3).

What meets on the way of a step (``impacts.py``) is put where it is ``thickness`` apart, with the least change of
½ Σ m |x − x₁|² (``projection.py``); then the way from the step's start to there is looked at again, and what meets
there joins the rest, until nothing does. Velocities take the whole of the change, Δx/h. The published code differs, and
why: it gives velocities a tenth of that (so that a cloth at rest keeps falling into what it lies on), takes four points
for coplanar within 1e-12 m at roots that are good to 1e-6 (and so misses impacts), looks at the first root of the cubic
alone, and ends the program where 100 rounds are not enough. As there, impacts have no friction, and (u, v) is not
touched.

Found on the device, solved by the host, in NumPy and between two captured graphs: a first version. Zones are small, but
those of a sheet on a sheet grow with it, as the cube of their impacts.

Gradients go back through the projections' conditions, round by round, with what is active held fixed; and, which the
paper leaves out, through how normals and weights follow from the way of the step (``impact_geometry.py``), the time of
an impact included.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..description.obstacles import Box
from ..errors import InputError
from ..kernels.core.status import OVERLAPPING, UNRESOLVED
from .impact_geometry import adjoint
from .impacts import Found, detection_of, none, turned
from .projection import Constraints, NoWayOut, Zone, project, transposed

if TYPE_CHECKING:
    from .model import Model

THICKNESS = 0.1
"""In spacings: far above rounding and what a normal turns within a round; far below the spacing, at which the cloth's
own cells are apart, and small beside what a yarn is thick."""
MOST_ROUNDS = 100
"""As published."""
NEAR = 0.5
"""Of the thickness, within which a place is looked at again: normals turn, so that a round ends a little nearer."""
EXACT = 1e-6
"""Of the thickness: what is left of it satisfies a constraint."""


class Round(NamedTuple):
    """A look at the way of a step, and what followed from it."""

    seen: np.ndarray
    """The end of the way [nodes, 3] (m)."""
    found: Found
    """What was found there, beside what the rounds before found."""
    zones: list[Zone]
    """Of the projection from all of that."""


@dataclasses.dataclass(frozen=True)
class Projected:
    """What was done at the end of a step, as its reverse needs it.

    Args:
        rounds: of it.
        start: of the step [nodes, 3] (m).
        inverse_mass: [nodes] (1/kg).
        length: Δs of every segment [segments] (m).
        move: what it moved nodes by [nodes, 3] (m).
        step: h (s).
    """

    rounds: list[Round]
    start: np.ndarray
    inverse_mass: np.ndarray
    length: np.ndarray
    move: np.ndarray
    step: float


class ImpactZones:
    """Keeps the cloth of a model apart from obstacles and itself.

    Attributes:
        made: projections by the frame of the chunk that they led to.
        rounds: of the last step.
    """

    def __init__(self, model: Model):
        self.model, scene = model, model.scene
        self.thickness: float = scene.contact.thickness or THICKNESS * scene.cloth.shortest_spacing
        self.detection, self._obstacle = detection_of(scene, model.device)
        self.made: dict[int, Projected] = {}
        self.rounds = 0
        a, topology = model.arrays, scene.cloth.topology
        self._free = a["is_free"].numpy().astype(float)
        self._ends = 2 * topology.segment_nodes + topology.yarn_direction[topology.segment_yarn][:, None]
        self._start = self._position()
        self._to_start: np.ndarray | None = None

    def _position(self) -> np.ndarray:
        return self.model.arrays["position"].numpy() + self.model.arrays.origin

    def begin(self) -> None:
        """Note where a step starts."""
        self._start = self._position()

    def apply(self) -> None:
        """Keep the end of a step apart."""
        a = self.model.arrays
        frame = int(a["counters"].numpy()[0]) + 1
        self.made.pop(frame, None)
        if a["status"].numpy()[0]:
            return
        length, inverse_mass = self._masses()
        end = self._position()
        try:
            position, rounds = self.resolve(self._start, end, inverse_mass)
        except NoWayOut as error:
            a.put("status", OVERLAPPING if self.rounds < MOST_ROUNDS else UNRESOLVED, error.node, 0)
            return
        if rounds:
            move, step = position - end, float(a["step_size"].numpy()[0])
            a["position"].assign(position - a.origin)
            a["velocity"].assign(a["velocity"].numpy() + move / step)
            self.made[frame] = Projected(rounds, self._start, inverse_mass, length, move, step)

    def resolve(self, start: np.ndarray, end: np.ndarray, inverse_mass: np.ndarray) -> tuple[np.ndarray, list[Round]]:
        """Find the place nearest to the end of a step that its start leads to without an impact.

        Raises:
            NoWayOut: there is none, or ``MOST_ROUNDS`` did not find it.
        """
        position, found, rounds = end, none(), []
        near = self.thickness
        for self.rounds in range(MOST_ROUNDS):
            more = self.detection.find(start, position, near)
            more = more.pick(more.gap(self.detection.places(position)) < (1.0 - EXACT) * self.thickness)
            if not len(more.weights):
                return position, rounds
            found, seen = found.and_these(more), position
            position, zones = project(end, inverse_mass, self._constraints(found))
            rounds.append(Round(seen, more, zones))
            near = NEAR * self.thickness
        self.rounds = MOST_ROUNDS
        raise NoWayOut(self._node(more, 0))

    def _constraints(self, found: Found) -> Constraints:
        fixed = found.vertices >= self.detection.nodes
        places = self.detection.places(np.zeros((self.detection.nodes, 3)))
        limits = self.thickness - found.gap(places)
        nodes, weights = np.where(fixed, 0, found.vertices), np.where(fixed, 0.0, found.weights)
        # a node to name where there is no way out
        named = np.where(fixed[:, :1], np.where(fixed, -1, found.vertices).max(axis=1, keepdims=True), nodes)
        return Constraints(np.where(fixed, named, nodes), weights, found.normals, limits)

    def _node(self, found: Found, k: int) -> int:
        """Name a node of the cloth that has a part in an impact."""
        of_cloth = found.vertices[k][found.vertices[k] < self.detection.nodes]
        return int(of_cloth[0])

    def _masses(self) -> tuple[np.ndarray, np.ndarray]:
        """Compute Δs of all segments [segments] (m), and 1/m of all nodes [nodes] (1/kg): half of each segment's mass
        is at either of its nodes."""
        a = self.model.arrays
        euler, yarn = a["euler"].numpy().astype(float), self.model.scene.cloth.topology.segment_yarn
        length = euler[self._ends[:, 1]] - euler[self._ends[:, 0]]
        half = 0.5 * a["density"].numpy().astype(float)[yarn] * length
        mass = np.bincount(self._ends.ravel() // 2, np.repeat(half, 2), minlength=self.detection.nodes)
        return length, self._free / mass

    def put(self, frame: int, made: Sequence[Projected | None]) -> None:
        """Put what was done at steps before in place again, those that led to this frame and the next ones."""
        self.made = {frame + k: projected for k, projected in enumerate(made) if projected is not None}

    def reverse(self) -> None:
        """Take the running adjoints of a step's end back to before its projection, once the device has the state
        that the step started from; and put what the step had solved for in ``solution``."""
        a = self.model.arrays
        made = self.made.get(int(a["counters"].numpy()[0]) + 1)
        self._to_start = None
        if made is None:
            return
        a["solution"].assign(a["solution"].numpy() - made.move / made.step)
        at_end = a["position"].grad.numpy().astype(float)
        of_move = at_end + a["velocity"].grad.numpy() / made.step
        self._to_start, to_end, to_mass = self.taken_back(made, of_move)
        a["position"].grad.assign(at_end + to_end)
        topology = self.model.scene.cloth.topology
        to_half = 0.5 * to_mass[topology.segment_nodes].sum(axis=1)
        density, euler = a["density"], a["euler"]
        if density.grad is not None:
            to_yarn = np.bincount(topology.segment_yarn, to_half * made.length, minlength=len(density))
            density.grad.assign(density.grad.numpy() + to_yarn)
        if euler.grad is not None:
            to_length = to_half * density.numpy()[topology.segment_yarn]
            ends = np.stack([-to_length, to_length], axis=1)
            to_euler = np.bincount(self._ends.ravel(), ends.ravel(), minlength=len(euler))
            euler.grad.assign(euler.grad.numpy() + to_euler)

    def end_reverse(self) -> None:
        """Add what the way's start has to do with impacts, once the running adjoints are those of the step's start."""
        if self._to_start is not None:
            gradient = self.model.arrays["position"].grad
            gradient.assign(gradient.numpy() + self._to_start)

    def taken_back(self, made: Projected, of_move: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Take the adjoint of a move back through all rounds: to those of the step's start and end [nodes, 3], and of
        the nodes' masses [nodes]."""
        places, nodes = self.detection.places, self.detection.nodes
        last = made.rounds[0].seen + made.move
        ends = [*(one.seen for one in made.rounds[1:]), last]
        to_seen = [np.zeros_like(of_move) for _ in made.rounds] + [of_move]
        to_start, to_end, to_mass = np.zeros_like(last), np.zeros_like(last), np.zeros(nodes)
        first = np.cumsum([0, *(len(one.found.times) for one in made.rounds)])
        for r in reversed(range(len(made.rounds))):
            back = transposed(made.rounds[r].zones, made.inverse_mass, to_seen[r + 1])
            # what a later round looked at is the step's end, moved
            to_end += back.to_position + (to_seen[r + 1] if r + 1 < len(made.rounds) else 0.0)
            to_mass += back.to_mass
            flow, placed = np.concatenate([back.flow, np.zeros_like(self.detection.fixed)]), places(ends[r])
            for q in range(r + 1):
                rows = (back.members >= first[q]) & (back.members < first[q + 1])
                found = made.rounds[q].found.pick(back.members[rows] - first[q])
                of = back.multipliers[rows, None, None], back.adjoints[rows, None, None]
                row = of[0] * flow[found.vertices] - of[1] * placed[found.vertices]
                parts = adjoint(
                    found,
                    places(made.start)[found.vertices],
                    places(made.rounds[q].seen)[found.vertices],
                    np.einsum("kij,kj->ki", row, found.normals),
                    np.einsum("ki,kij->kj", found.weights, row),
                )
                of_cloth = found.vertices < nodes
                for target, part in zip((to_start, to_seen[q]), parts, strict=True):
                    np.add.at(target, found.vertices[of_cloth], part[of_cloth])
        return to_start, to_end + to_seen[0], to_mass

    # -- the start ---------------------------------------------------------------------------------------------------

    def check_clear(self, position: np.ndarray | None = None) -> None:
        """Refuse a state (None: the present one) where cloth goes through something, or is much nearer to it than
        steps leave it.

        Raises:
            InputError: what, and where.
        """
        position = self._position() if position is None else position
        scene, places = self.model.scene, self.detection.places(position)
        for vertices in self.detection.crossings(position)[:1]:
            raise InputError(f"{self._meeting(vertices)}: it goes through that, must be beside")
        found = self.detection.find(position, position, NEAR * self.thickness)
        if len(found.weights):
            gap = found.gap(places)
            k = int(gap.argmin())
            least = NEAR * self.thickness
            raise InputError(
                f"{self._meeting(found.vertices[k])}: {gap[k]:.3g} m apart, must be {least:.3g} m at least, "
                f"{NEAR:g} of the contact's thickness"
            )
        for k, obstacle in enumerate(scene.obstacles):
            if isinstance(obstacle, Box):
                backwards = obstacle.rotation * np.array([-1.0, -1.0, -1.0, 1.0])
                local = turned(backwards, position - obstacle.position)
                inside = np.flatnonzero((np.abs(local) < obstacle.size).all(axis=1))
                if len(inside):
                    node = int(inside[0])
                    raise InputError(f"node {node} ({scene.cloth.place(node)}) is inside obstacles[{k}], a Box")

    def _meeting(self, vertices: Any) -> str:
        """Name the two things that meet."""
        cloth, nodes = self.model.scene.cloth, self.detection.nodes
        node = int(next(k for k in vertices if k < nodes))
        name = f"node {node} ({cloth.place(node)})"
        others = [int(k) - nodes for k in vertices if k >= nodes]
        if others:
            obstacle = int(self._obstacle[others[0]])
            return f"{name} and obstacles[{obstacle}], a {type(self.model.scene.obstacles[obstacle]).__name__}"
        other = int(vertices[-1])
        return f"{name} and node {other} ({cloth.place(other)})"
