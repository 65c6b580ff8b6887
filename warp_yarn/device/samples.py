"""What touches: nodes, or the middles of segments between them too (``kernels/contact/samples.py``)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

if TYPE_CHECKING:
    from .arrays import Arrays
    from .model import Model

PASSES = 8
"""In which nodes are found that a stage has to start beside an obstacle, each from those of the pass before."""


def set_arrays(arrays: Arrays) -> None:
    """Fill the arrays that only middles need: the segments at each node, and what is free."""
    cloth = arrays.scene.cloth
    segment, count = cloth.topology.segment_nodes, np.zeros(cloth.nodes, dtype=int)
    at_node = np.full((cloth.nodes, 4), -1, dtype=np.int32)
    for e, ends in enumerate(segment):
        for node in ends:
            at_node[node, count[node]] = e
            count[node] += 1
    free = arrays["is_free"].numpy() != 0
    held = ~np.concatenate([free, free[segment].all(axis=1)]), ~np.concatenate([free, free[segment].any(axis=1)])
    for name, values in (
        ("node_segments", at_node.ravel()),
        ("sample_is_free", ~held[0]),
        ("sample_moves", ~held[1]),
    ):
        arrays[name] = wp.array(values.astype(np.int32), dtype=wp.int32, device=arrays.device)


class Samples:
    """The samples of a model, whose arrays stand in for those of nodes: there is nothing to stand in where nodes are
    all that touches.

    Attributes:
        count: how many there are.
    """

    def __init__(self, model: Model):
        self.model, self.count = model, model.arrays.sizes["sample"]
        self._there = "middles" in model.arrays.conditions
        topology = model.scene.cloth.topology
        single = np.column_stack([np.arange(topology.nodes), np.full(topology.nodes, -1)])
        # the nodes of each, the second of which is -1 of a node alone
        self.ends = np.concatenate([single, topology.segment_nodes]) if self._there else single

    def of(self, *names: str) -> dict[str, Any]:
        """Gather arrays of nodes, and give what stands in for them."""
        if not self._there:
            return {}
        a = self.model.arrays
        for name in names:
            self.model.launch("gather_samples", "samples", source=a[name], target=a[f"sample_{name}"])
        return self.standing_in(*names)

    def standing_in(self, *names: str) -> dict[str, Any]:
        """Give what stands in for arrays of nodes, as it is."""
        return {name: self.model.arrays[f"sample_{name}"] for name in names} if self._there else {}

    def offered(self, *, matrix: bool) -> dict[str, Any]:
        """Give what terms of contact take: their forces and blocks are scattered afterwards."""
        names = ("position", "velocity", "increment", "force")
        blocks = {"diagonal_xx": self.model.arrays["sample_block"]} if self._there and matrix else {}
        return self.standing_in(*names) | blocks

    def clear(self, *, matrix: bool) -> None:
        """Clear what is to be scattered."""
        if self._there:
            self.model.arrays.zero("sample_force", *(["sample_block"] if matrix else []))

    def scatter(self, *, matrix: bool, **replaced: Any) -> None:
        """Scatter forces, and blocks of the matrix."""
        if self._there:
            self.model.launch("scatter_forces", "samples", **replaced)
            if matrix:
                self.model.launch("scatter_blocks", "samples")

    def start_outside(self, **before: wp.array) -> None:
        """Let middles start a stage in the clear too, once nodes would: by their ends, which else stay, or go with the
        obstacle."""
        if self._there:
            self.model.arrays.zero("taken_by")
            for _ in range(PASSES):
                self.model.launch("mark_middles", "segments", is_last=0, **before)
                self.model.launch("stay_with_obstacle", "nodes", **before)
            self.model.launch("mark_middles", "segments", is_last=1, **before)

    def places(self, position: np.ndarray) -> np.ndarray:
        """Compute where samples are, of positions of nodes [nodes, 3]."""
        first, second = self.ends.T
        return 0.5 * (position[first] + position[np.where(second < 0, first, second)])

    def name(self, sample: int) -> str:
        """Name a sample."""
        cloth = self.model.scene.cloth
        nodes = [f"node {node} ({cloth.place(int(node))})" for node in self.ends[sample] if node >= 0]
        return nodes[0] if len(nodes) == 1 else f"the middle between {nodes[0]} and {nodes[1]}"
