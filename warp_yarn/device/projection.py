"""Non-rigid impact zones: the nearest place where nothing meets, and the transpose of its derivative.

    min ½ Σ m |x − x₁|²   subject to   g_k·x = n_k·Σ w x ≥ b_k

Its Karush–Kuhn–Tucker conditions are x = x₁ + M⁻¹ Gᵀ λ, λ ≥ 0, and s = G x − b ≥ 0 with λ·s = 0. With S = G M⁻¹ Gᵀ that
is a linear complementarity problem, s = S λ − (b − G x₁), of each **zone**: impacts that have nodes in common. It is
solved by active sets, to rounding. Of what is active, A,

    ∂x/∂x₁ = 1 − M⁻¹ G_Aᵀ S_AA⁻¹ G_A,

and the mass of each node enters by M, normals and weights by G. Which impacts are active is held fixed there. With an
adjoint ā of x and μ = S_AA⁻¹ G_A M⁻¹ ā, a row's is, at a node, λ v − μ x with v = M⁻¹ (ā − G_Aᵀ μ), and b's is μ.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

REGULAR = 1e-12
"""Added to S, of its diagonal: the same impact may be found twice, by two faces that share an edge."""
ROUNDING = 1e-11
"""Of what is left of a zone's largest violation."""


class Constraints(NamedTuple):
    """n·Σ w x ≥ b: nodes [constraints, 4] with weights [constraints, 4], 0 in place of what is fixed, normals
    [constraints, 3] and limits b [constraints] (m)."""

    nodes: np.ndarray
    weights: np.ndarray
    normals: np.ndarray
    limits: np.ndarray


class NoWayOut(Exception):
    """What is fixed leaves a constraint no way out.

    Attributes:
        node: of it.
    """

    def __init__(self, node: int):
        super().__init__(node)
        self.node = node


@dataclasses.dataclass(frozen=True)
class Zone:
    """Active constraints that have nodes in common.

    Args:
        nodes: [nodes].
        rows: G_A [constraints, 3 nodes].
        multipliers: λ [constraints] (kg m).
        members: which of all constraints they are [constraints].
    """

    nodes: np.ndarray
    rows: np.ndarray
    multipliers: np.ndarray
    members: np.ndarray


class Transposed(NamedTuple):
    """What an adjoint of x, ā, gives to others."""

    to_position: np.ndarray
    """To that of x₁, beside ā itself [nodes, 3]."""
    to_mass: np.ndarray
    """To those of the nodes' masses [nodes]."""
    flow: np.ndarray
    """v [nodes, 3]."""
    members: np.ndarray
    """Which constraints are active [active]."""
    multipliers: np.ndarray
    """λ of these [active]."""
    adjoints: np.ndarray
    """μ of these [active]."""


def project(position: np.ndarray, inverse_mass: np.ndarray, constraints: Constraints) -> tuple[np.ndarray, list[Zone]]:
    """Find the nearest place that satisfies constraints.

    Args:
        position: x₁ [nodes, 3] (m).
        inverse_mass: [nodes] (1/kg), 0 of what is held.
        constraints: all of them.

    Returns:
        x [nodes, 3], and the zones in which anything is active.

    Raises:
        NoWayOut: what is held leaves none.
    """
    result, zones = position.copy(), []
    for members in components(constraints, inverse_mass):
        part = Constraints(*(values[members] for values in constraints))
        nodes, rows = _rows(part)
        weight = np.repeat(inverse_mass[nodes], 3)
        violation = part.limits - rows @ position[nodes].ravel()
        multipliers = _solve(rows, weight, violation)
        move = weight * (rows.T @ multipliers)
        left = violation - rows @ move
        if left.max() > 1e-6 * max(violation.max(), 0.0):
            raise NoWayOut(int(part.nodes[int(left.argmax()), 0]))
        active = multipliers > 0.0
        if active.any():
            result[nodes] += move.reshape(-1, 3)
            zones.append(Zone(nodes, rows[active], multipliers[active], members[active]))
    return result, zones


def transposed(zones: list[Zone], inverse_mass: np.ndarray, adjoint: np.ndarray) -> Transposed:
    """Take an adjoint of x back.

    Args:
        zones: of the projection.
        inverse_mass: as it was.
        adjoint: ā [nodes, 3].
    """
    to_position, to_mass, adjoints = np.zeros_like(adjoint), np.zeros(len(adjoint)), [np.zeros(0)]
    for zone in zones:
        inverse = inverse_mass[zone.nodes]
        weight, of_move = np.repeat(inverse, 3), adjoint[zone.nodes].ravel()
        matrix = _regular((zone.rows * weight) @ zone.rows.T)
        adjoints.append(np.linalg.solve(matrix, zone.rows @ (weight * of_move)))
        back = zone.rows.T @ adjoints[-1]
        to_position[zone.nodes] -= back.reshape(-1, 3)
        change = ((of_move - back) * (zone.rows.T @ zone.multipliers)).reshape(-1, 3).sum(axis=1)
        to_mass[zone.nodes] -= change * inverse**2
    return Transposed(
        to_position,
        to_mass,
        inverse_mass[:, None] * (adjoint + to_position),
        np.concatenate([np.zeros(0, dtype=int), *(zone.members for zone in zones)]),
        np.concatenate([np.zeros(0), *(zone.multipliers for zone in zones)]),
        np.concatenate(adjoints),
    )


def components(constraints: Constraints, inverse_mass: np.ndarray) -> list[np.ndarray]:
    """Group constraints that have nodes in common which can move."""
    leader = list(range(len(constraints.limits)))

    def find(k: int) -> int:
        while leader[k] != k:
            leader[k] = leader[leader[k]]
            k = leader[k]
        return k

    first: dict[int, int] = {}
    moves = (constraints.weights != 0.0) & (inverse_mass[constraints.nodes] > 0.0)
    for k, slot in zip(*(index.tolist() for index in np.nonzero(moves)), strict=True):
        other = first.setdefault(int(constraints.nodes[k, slot]), k)
        leader[find(k)] = find(other)
    leaders = np.array([find(k) for k in leader], dtype=int)
    order = np.argsort(leaders, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(leaders[order])) + 1) if len(order) else []


def _rows(part: Constraints) -> tuple[np.ndarray, np.ndarray]:
    """Build G over the nodes that it has."""
    nodes, place = np.unique(part.nodes, return_inverse=True)
    place = place.reshape(part.nodes.shape)
    rows = np.zeros((len(part.limits), len(nodes), 3))
    entries = part.weights[:, :, None] * part.normals[:, None]
    np.add.at(rows, (np.arange(len(rows))[:, None], place), entries)
    return nodes, rows.reshape(len(rows), -1)


def _regular(matrix: np.ndarray) -> np.ndarray:
    return matrix + REGULAR * np.diag(np.diag(matrix))


def _solve(rows: np.ndarray, weight: np.ndarray, violation: np.ndarray) -> np.ndarray:
    """Find λ of a zone."""
    product = (rows * weight) @ rows.T
    size = np.sqrt(np.diag(product))
    # what nothing of can move
    held = size <= 0.0
    size[held] = 1.0
    matrix = _regular(product / np.outer(size, size))
    matrix[held, held] = 1.0
    wanted = np.where(held, -1.0, violation / size)
    result = _by_blocks(matrix, wanted)
    return (_one_by_one(matrix, wanted) if result is None else result) / size


def _among(matrix: np.ndarray, wanted: np.ndarray, active: np.ndarray) -> np.ndarray:
    """Solve for the active ones; the others are 0."""
    result = np.zeros(len(wanted))
    result[active] = np.linalg.solve(matrix[np.ix_(active, active)], wanted[active])
    return result


def _by_blocks(matrix: np.ndarray, wanted: np.ndarray) -> np.ndarray | None:
    """Turn all that is wrong, active or not, as long as that gets less; None where it does not end (Júdice and
    Pires 1994)."""
    active = wanted > 0.0
    least, patience = len(wanted) + 1, 3
    while patience > 0:
        result = _among(matrix, wanted, active)
        slack = matrix @ result - wanted
        wrong = np.where(active, result < 0.0, slack < -ROUNDING * np.abs(wanted).max())
        if not wrong.any():
            return result
        if wrong.sum() < least:
            least, patience = int(wrong.sum()), 3
        else:
            patience -= 1
        active = active ^ wrong
    return None


def _one_by_one(matrix: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Take in what is violated most, and leave out what would pull, step by step: each lessens the dual's energy
    (Lawson and Hanson 1974)."""
    result, active = np.zeros(len(wanted)), np.zeros(len(wanted), dtype=bool)
    for _ in range(10 * len(wanted)):
        left = np.where(active, 0.0, wanted - matrix @ result)
        worst = int(left.argmax())
        if left[worst] <= ROUNDING * np.abs(wanted).max():
            break
        active[worst] = True
        while True:
            target = _among(matrix, wanted, active)
            pulls = active & (target <= 0.0)
            if not pulls.any():
                break
            share = np.min(result[pulls] / np.maximum(result[pulls] - target[pulls], np.finfo(float).tiny))
            result = result + share * (target - result)
            active &= ~(pulls & (result <= ROUNDING * result.max(initial=0.0)))
            result[~active] = 0.0
        result = target
    return result
