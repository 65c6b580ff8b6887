"""The threads of every CPU launch in another order than 0, 1, 2, ...: pytest --shuffled ORDER tests/kernels.

On a GPU there is no order. A kernel that needs one, since a thread reads what another has written or two write to one
place, gives other numbers here, far beyond rounding.
"""

from __future__ import annotations

import warp as wp
from warp._src import build, codegen

ORDERS = {
    "reversed": "dim->size - 1 - turn",
    # a permutation, as the factor is prime
    "scrambled": "(turn * 2654435761ull + 40503ull) % dim->size",
}
"""Which thread has its turn, in the generated C++."""

LOOP = "for (size_t task_index = 0; task_index < dim->size; ++task_index)\n    {{"
"""Of Warp 1.19, in the templates of its CPU modules."""


def shuffle(order: str) -> None:
    """Make Warp compile kernels whose threads run in this order, into a cache of their own: their hash does not tell.

    Raises:
        RuntimeError: Warp's templates are others than those of 1.19, or a kernel was compiled before.
    """
    wp.init()
    build.init_kernel_cache(f"{wp.config.kernel_cache_dir}_{order}")
    for name in ("cpu_module_template_forward", "cpu_module_template_backward"):
        template = getattr(codegen, name)
        if template.count(LOOP) != 1:
            raise RuntimeError(f"Warp's {name} has no loop over threads as in 1.19: mend tests/threads.py")
        turns = "for (size_t turn = 0; turn < dim->size; ++turn)\n    {{\n"
        setattr(codegen, name, template.replace(LOOP, f"{turns}        const size_t task_index = {ORDERS[order]};"))
