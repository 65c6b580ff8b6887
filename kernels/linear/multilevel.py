"""The solver's multilevel line preconditioner.

    P⁻¹ = lines of A + Σ over levels R (lines of RᵀAR) Rᵀ + R (RᵀAR)⁻¹ Rᵀ of the last one

R interpolates bilinearly from every 2nd, 4th, 8th … yarn to the cloth. Lines solve exactly along yarns (``lines.py``),
levels take what is smooth across them, so the iterations depend on neither the number of yarns nor their stiffness,
where those of the incomplete factorization grow with both. All parts are added up, so they can be solved at the same
time, and each is positive definite, so P is. Rates of sliding have lines, and no part in the levels. Where yarns hardly
stretch, strips of two yarns are added too (``strips.py``).

Its index arrays are those of ``warp_yarn/description/levels.py``. Every loop here is over nodes, lines or coarse nodes
that do not depend on each other, a share of them for each processor core (``threads.py``); between two loops all wait
for all.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core import memory
from ..core.structs import structs
from ..core.variant import Variant
from . import incomplete_cholesky, lines, strips
from .threads import barrier, partition

SAFE = {wp.float64: 1e-12, wp.float32: 1e-5}
"""Part of a diagonal entry of the coarsest level that its pivot must keep; what does not is left to the lines."""


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    """Make ``precondition``, and ``barriers``, how many it comes to."""
    scalar, vec3, sliding = variant.scalar, variant.vec3, variant.sliding
    load, store = memory.functions(variant).load, memory.functions(variant).store
    product = incomplete_cholesky.functions(variant).product
    solve_nodes, solve_coarse = lines.functions(variant).solve_nodes, lines.functions(variant).solve_coarse
    solve_strip = strips.functions(variant).solve_strip
    Levels = structs(variant).Levels

    @wp.func
    def solve_coarsest(levels: Levels, first: int, count: int):
        """Solve for z of the last level."""
        size = 3 * count
        for i in range(size):
            node = first + i / 3
            value = load(levels.coarse_r, node)[i % 3]
            for k in range(i):
                value -= load(levels.coarsest, size * i + k) * load(levels.coarse_z, first + k / 3)[k % 3]
            value *= load(levels.coarsest, size * i + i)
            levels.coarse_z[node][i % 3] = value
        for c in range(size):
            i = size - 1 - c
            node = first + i / 3
            value = load(levels.coarse_z, node)[i % 3]
            for k in range(i + 1, size):
                value -= load(levels.coarsest, size * k + i) * load(levels.coarse_z, first + k / 3)[k % 3]
            levels.coarse_z[node][i % 3] = value * load(levels.coarsest, size * i + i)

    @wp.func
    def restrict(levels: Levels, below: wp.array(dtype=vec3), begin: int, end: int):
        """Compute r of coarse nodes from the level below, and the start of their z."""
        for i in range(begin, end):
            r = vec3()
            for k in range(load(levels.child_start, i), load(levels.child_start, i + 1)):
                r += load(below, load(levels.child, k)) * load(levels.child_weight, k)
            store(levels.coarse_r, i, r)
            store(levels.coarse_z, i, -product(load(levels.coarse_halves, i), r))

    @wp.func
    def interpolated(levels: Levels, i: int) -> vec3:
        """Interpolate z of a node's parents at the node; ``i`` counts the cloth's nodes and then coarse ones."""
        result = vec3()
        for k in range(4 * i, 4 * i + 4):
            j = load(levels.parent, k)
            if j >= 0:
                result += load(levels.coarse_z, j) * load(levels.parent_weight, k)
        return result

    @wp.func
    def precondition(
        thread: int, threads: int, arrived: int, signals: wp.array(dtype=int), nodes: int, levels: Levels,
        r_x: wp.array(dtype=vec3), r_s: wp.array(dtype=scalar), z_x: wp.array(dtype=vec3), z_s: wp.array(dtype=scalar),
    ) -> scalar:  # fmt: skip
        """Compute z = P⁻¹ r, its part of r·z; z is to start at − ½ D⁻¹ r. Comes to ``barriers(levels)`` barriers."""
        count = levels.coarse_levels
        for level in range(count):
            if threads > 1:
                arrived += threads
                barrier(signals, arrived)
            first = load(levels.level_start, level)
            size = load(levels.level_start, level + 1) - first
            begin = first + partition(size, thread, threads)
            end = first + partition(size, thread + 1, threads)
            if level == 0:
                restrict(levels, r_x, begin, end)
            else:
                restrict(levels, levels.coarse_r, begin, end)
        for direction in range(2):
            if threads > 1:
                arrived += threads
                barrier(signals, arrived)
            first = direction * levels.warp_lines
            size = wp.where(direction == 0, levels.warp_lines, levels.line_start.shape[0] - 1 - levels.warp_lines)
            for k in range(first + partition(size, thread, threads), first + partition(size, thread + 1, threads)):
                solve_nodes(
                    direction, load(levels.line_start, k), load(levels.line_start, k + 1), levels.line_node,
                    levels.line_factor, levels.line_work, r_x, r_s, z_x, z_s,
                )  # fmt: skip
            first = direction * levels.coarse_warp_lines
            size = wp.where(
                direction == 0,
                levels.coarse_warp_lines,
                levels.coarse_line_start.shape[0] - 1 - levels.coarse_warp_lines,
            )
            for k in range(first + partition(size, thread, threads), first + partition(size, thread + 1, threads)):
                solve_coarse(
                    direction, load(levels.coarse_line_start, k), load(levels.coarse_line_start, k + 1),
                    levels.coarse_line_node, levels.coarse_line_factor, levels.coarse_line_work,
                    levels.coarse_r, levels.coarse_z,
                )  # fmt: skip
        for phase in range(wp.where(levels.strips > 0, 4, 0)):
            if threads > 1:
                arrived += threads
                barrier(signals, arrived)
            first = load(levels.strip_phase, phase)
            size = load(levels.strip_phase, phase + 1) - first
            for k in range(first + partition(size, thread, threads), first + partition(size, thread + 1, threads)):
                solve_strip(
                    load(levels.strip_start, k), load(levels.strip_start, k + 1), levels.strip_node,
                    levels.strip_factor, levels.strip_work, r_x, z_x,
                )  # fmt: skip
        if thread == 0 and levels.exact > 0:
            solve_coarsest(levels, load(levels.level_start, count - 1), levels.exact)
        for k in range(count - 1):
            if threads > 1:
                arrived += threads
                barrier(signals, arrived)
            level = count - 2 - k
            first = load(levels.level_start, level)
            size = load(levels.level_start, level + 1) - first
            for i in range(first + partition(size, thread, threads), first + partition(size, thread + 1, threads)):
                store(levels.coarse_z, i, load(levels.coarse_z, i) + interpolated(levels, nodes + i))
        if threads > 1:
            arrived += threads
            barrier(signals, arrived)
        rz = scalar(0.0)
        for i in range(partition(nodes, thread, threads), partition(nodes, thread + 1, threads)):
            z = load(z_x, i) + interpolated(levels, i)
            store(z_x, i, z)
            rz += wp.dot(load(r_x, i), z)
            if wp.static(sliding):
                rz += load(r_s, 2 * i) * load(z_s, 2 * i) + load(r_s, 2 * i + 1) * load(z_s, 2 * i + 1)
        return rz

    @wp.func
    def barriers(levels: Levels) -> int:
        """Count the barriers that ``precondition`` comes to."""
        return levels.coarse_levels + 3 + wp.max(levels.coarse_levels - 1, 0) + wp.where(levels.strips > 0, 4, 0)

    return SimpleNamespace(precondition=precondition, barriers=barriers)


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    scalar, mat33 = variant.scalar, variant.mat33
    load, store = memory.functions(variant).load, memory.functions(variant).store
    line = lines.functions(variant)
    factorize_nodes, factorize_coarse = line.factorize_nodes, line.factorize_coarse
    BlockMatrix, Levels = structs(variant).BlockMatrix, structs(variant).Levels
    module = variant.module("multilevel")
    variant.fuse("multilevel")

    @wp.kernel(module=module, enable_backward=False)
    def coarsen(
        first: int,
        nodes: int,
        levels: Levels,
        blocks: BlockMatrix,
    ):
        """Compute a block of RᵀAR of a level, those of the level below being there."""
        block = levels.blocks_per_node * first + wp.tid()
        result = mat33()
        for k in range(load(levels.block_start, block), load(levels.block_start, block + 1)):
            source = load(levels.part, k)
            weight = load(levels.part_weight, k)
            turned = source < 0
            if turned:
                source = -1 - source
            m = mat33()
            if first > 0:
                m = load(levels.coarse_block, source)
            elif source < nodes:
                m = load(blocks.diagonal_xx, source)
            else:
                m = load(blocks.upper_xx, source - nodes)
            if turned:
                m = wp.transpose(m)
            result += m * weight
        levels.coarse_block[block] = result

    @wp.kernel(module=module, enable_backward=False)
    def factorize_lines(
        along: int,
        blocks: BlockMatrix,
        is_free: wp.array(dtype=int),
        is_crossing: wp.array(dtype=int),
        levels: Levels,
    ):
        """Factorize every line of the cloth along one direction; warp yarns come first."""
        k = wp.tid() + along * levels.warp_lines
        factorize_nodes(
            along, load(levels.line_start, k), load(levels.line_start, k + 1), levels.line_node,
            blocks, is_free, is_crossing, levels.line_factor, levels.halves,
        )  # fmt: skip

    @wp.kernel(module=module, enable_backward=False)
    def factorize_coarse_lines(along: int, levels: Levels):
        """Factorize every line of the coarse levels along one direction."""
        k = wp.tid() + along * levels.coarse_warp_lines
        factorize_coarse(
            along, load(levels.coarse_line_start, k), load(levels.coarse_line_start, k + 1),
            levels.coarse_line_node, levels.blocks_per_node,
            levels.coarse_block, levels.coarse_line_factor, levels.coarse_halves,
        )  # fmt: skip

    @wp.kernel(module=module, enable_backward=False)
    def factorize_coarsest(first: int, count: int, levels: Levels):
        """Compute the Cholesky factor of the last level, row by row, with the inverse of its diagonal."""
        size = 3 * count
        lower = levels.coarsest
        for i in range(count):
            for j in range(i, count):
                slot = load(levels.coarsest_slot, count * i + j)
                block = mat33()
                if slot >= 0:
                    block = load(levels.coarse_block, levels.blocks_per_node * (first + i) + slot)
                for k in range(3):
                    for m in range(3):
                        store(lower, size * (3 * j + m) + 3 * i + k, block[k, m])
        for j in range(size):
            diagonal = load(lower, size * j + j)
            for i in range(j, size):
                value = load(lower, size * i + j)
                for k in range(j):
                    value -= load(lower, size * i + k) * load(lower, size * j + k)
                if i == j:
                    safe = diagonal > scalar(0.0) and value > scalar(wp.static(SAFE[scalar])) * diagonal
                    store(lower, size * j + j, wp.where(safe, scalar(1.0) / wp.sqrt(value), scalar(0.0)))
                else:
                    store(lower, size * i + j, value * load(lower, size * j + j))

    return SimpleNamespace(
        coarsen=coarsen,
        factorize_lines=factorize_lines,
        factorize_coarse_lines=factorize_coarse_lines,
        factorize_coarsest=factorize_coarsest,
    )
