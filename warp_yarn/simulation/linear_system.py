"""The linear system of a step as arrays of NumPy, to look into and to compare solvers with."""

import dataclasses
import itertools

import numpy as np

from ..device.model import MATRIX, Model
from ..moved import renamed


@dataclasses.dataclass(frozen=True)
class LinearSystem:
    """A symmetric linear system: entries of its matrix, right-hand side, and which unknowns are free to move.

    Unknown 3 i + k is velocity k of node i; behind them, with sliding, unknown 3 nodes + 2 i + d its rate along d.
    """

    rows: np.ndarray
    columns: np.ndarray
    entries: np.ndarray
    rhs: np.ndarray
    free: np.ndarray

    def dense(self) -> np.ndarray:
        """Makes a dense array of the matrix."""
        result = np.zeros((len(self.rhs), len(self.rhs)))
        np.add.at(result, (self.rows, self.columns), self.entries)
        return result


def read_system(model: Model) -> LinearSystem:
    """Reads the system that a model has assembled; ``kernels/linear/block_matrix.py`` tells how its blocks lie."""
    a, nodes, stencil = model.arrays, model.scene.cloth.nodes, model.arrays.stencil
    values = {name: a[name].numpy() for name in (*MATRIX, "rhs", "euler_rhs") if a[name] is not None}
    x = np.arange(3 * nodes).reshape(nodes, 3)
    s = 3 * nodes + np.arange(2 * nodes).reshape(nodes, 2)
    rows, columns, entries = [], [], []

    def add(i: np.ndarray, j: np.ndarray, value: np.ndarray, mirror: bool = True) -> None:
        pairs = [(i[:, :, None], j[:, None, :], value)]
        if mirror:
            pairs.append((j[:, :, None], i[:, None, :], value.swapaxes(1, 2)))
        for row, column, entry in pairs:
            row, column, entry = np.broadcast_arrays(row, column, entry)
            rows.append(row.ravel())
            columns.append(column.ravel())
            entries.append(entry.ravel())

    neighbour = a["neighbour"].numpy().reshape(nodes, stencil)
    add(x, x, values["diagonal_xx"], mirror=False)
    node, slot = np.nonzero(neighbour >= 0)
    other = neighbour[node, slot]
    add(x[node], x[other], values["upper_xx"].reshape(nodes, stencil, 3, 3)[node, slot])
    if model.scene.sliding:
        for k in range(2):
            add(x, s[:, [k]], values["diagonal_xs"].reshape(nodes, 2, 3)[:, k, :, None])
            add(s[:, [k]], s[:, [k]], values["diagonal_ss"].reshape(nodes, 2)[:, k, None, None], mirror=False)
        near = slot < 4
        node, slot, other = node[near], slot[near], other[near]
        d = slot % 2
        mine, its = s[node, d][:, None], s[other, d][:, None]
        add(x[node], its, values["upper_xs"].reshape(nodes, 4, 3)[node, slot][:, :, None])
        add(mine, x[other], values["upper_sx"].reshape(nodes, 4, 3)[node, slot][:, None, :])
        add(mine, its, values["upper_ss"].reshape(nodes, 4)[node, slot][:, None, None])
    if model.contact.self_contact:
        sample, slot = np.nonzero(np.arange(a["touch_room"]) < a["touch_count"].numpy()[:, None])
        place = sample * a["touch_room"] + slot
        # both lists of a pair have its block
        block = a["touch_block"].numpy()[place][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        mine, its = model.contact.samples.ends[sample], model.contact.samples.ends[a["touch"].numpy()[place]]
        for i, j in itertools.product(range(2), range(2)):
            # of a node alone all, of a middle half of it for either end
            there = (mine[:, i] >= 0) & (its[:, j] >= 0)
            share = np.where(mine[:, 1] < 0, 1.0, 0.5) * np.where(its[:, 1] < 0, 1.0, 0.5)
            add(x[mine[there, i]], x[its[there, j]], -(share[:, None, None] * block)[there], mirror=False)
    topology = model.scene.cloth.topology
    free = [np.repeat(a["is_free"].numpy() != 0, 3)]
    rhs = [values["rhs"].ravel()]
    if model.scene.sliding:
        free.append(np.repeat(topology.is_crossing != 0, 2))
        rhs.append(values["euler_rhs"])
    return LinearSystem(
        np.concatenate(rows),
        np.concatenate(columns),
        np.concatenate(entries),
        np.concatenate(rhs),
        np.concatenate(free),
    )


__getattr__ = renamed(__name__, {"System": "LinearSystem", "gather": "read_system"})
