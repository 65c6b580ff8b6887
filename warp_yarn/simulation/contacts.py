"""What touches in a state."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from ..device.contact import Near


@dataclasses.dataclass(eq=False, frozen=True)
class Contacts:
    """Where samples touch obstacles and each other: NumPy, a row for each pair.

    Args:
        node: which [contacts], or the first of the segment whose middle it is that touches.
        other: the other node [contacts], or the first of its segment, or -1 of an obstacle.
        obstacle: the obstacle, by its place in ``scene.obstacles`` [contacts], or -1.
        gap: distance from it [contacts] (m).
        normal: towards the sample [contacts, 3].
        load: force along the normal on the sample [contacts] (N), above 0.
        tangential: friction on the sample [contacts, 3] (N).
        place: of the obstacle's surface, closest to the sample, or halfway between two samples [contacts, 3] (m).
        node_end, other_end: the second node of the segment whose middle touches, or -1 where a node does [contacts].
    """

    node: np.ndarray
    other: np.ndarray
    obstacle: np.ndarray
    gap: np.ndarray
    normal: np.ndarray
    load: np.ndarray
    tangential: np.ndarray
    place: np.ndarray
    node_end: np.ndarray
    other_end: np.ndarray

    def __len__(self) -> int:
        return len(self.node)


def contacts_of(found: Sequence[Near], places: np.ndarray, ends: np.ndarray) -> Contacts:
    """Picks what touches of what is near.

    Args:
        found: what is near.
        places: of samples [samples, 3] (m).
        ends: their nodes [samples, 2].
    """
    none = np.zeros(0, dtype=np.int64)
    nothing = Near(none, none, none, np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
    joined = Near(*(np.concatenate(parts) for parts in zip(nothing, *found, strict=True)))
    touch = joined.force.any(axis=1)
    sample, other, obstacle, gap, normal, force = (values[touch] for values in joined)
    load = np.einsum("ij,ij->i", force, normal)
    part = np.where(other >= 0, 0.5, 1.0)
    place = places[sample] - (part * gap)[:, None] * normal
    node, node_end = ends[sample].T
    others, other_end = np.where(other >= 0, ends[other].T, -1)
    friction = force - load[:, None] * normal
    return Contacts(node, others, obstacle, gap, normal, load, friction, place, node_end, other_end)
