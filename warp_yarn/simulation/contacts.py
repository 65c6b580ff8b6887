"""What touches in a state."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from ..device.contact import Near


@dataclasses.dataclass(eq=False, frozen=True)
class Contacts:
    """Where nodes touch obstacles and each other: NumPy, a row for each pair.

    Args:
        node: which [contacts].
        other: the other node [contacts], or -1.
        obstacle: the obstacle, by its place in ``scene.obstacles`` [contacts], or -1.
        gap: distance of the node from it [contacts] (m).
        normal: towards the node [contacts, 3].
        load: force along the normal on the node [contacts] (N), above 0.
        tangential: friction on the node [contacts, 3] (N).
        place: of the obstacle's surface, closest to the node, or halfway between two nodes [contacts, 3] (m).
    """

    node: np.ndarray
    other: np.ndarray
    obstacle: np.ndarray
    gap: np.ndarray
    normal: np.ndarray
    load: np.ndarray
    tangential: np.ndarray
    place: np.ndarray

    def __len__(self) -> int:
        return len(self.node)


def contacts_of(found: Sequence[Near], position: np.ndarray) -> Contacts:
    """Picks what touches of what is near."""
    none = np.zeros(0, dtype=np.int64)
    nothing = Near(none, none, none, np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
    joined = Near(*(np.concatenate(parts) for parts in zip(nothing, *found, strict=True)))
    touch = joined.force.any(axis=1)
    node, other, obstacle, gap, normal, force = (values[touch] for values in joined)
    load = np.einsum("ij,ij->i", force, normal)
    part = np.where(other >= 0, 0.5, 1.0)
    place = position[node] - (part * gap)[:, None] * normal
    return Contacts(node, other, obstacle, gap, normal, load, force - load[:, None] * normal, place)
