"""What a scene says of crimp, on the device."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..description import crimp

if TYPE_CHECKING:
    from .arrays import Arrays


def set_arrays(arrays: Arrays) -> None:
    """Sets what crimp interchange, or a contact force at crimped positions, has; nothing where a scene has neither."""
    cloth = arrays.scene.cloth
    if "crimp interchange" in arrays.conditions:
        found = crimp.interchange(cloth)
        found["crimp_corners"] = arrays.blocks(found["crimp_corners"])
        for name, values in found.items():
            dtype = arrays.declared[name].dtype(arrays.variant)
            arrays[name] = wp.array(np.ascontiguousarray(values), dtype=dtype, device=arrays.device)
    if "crimped contact" in arrays.conditions:
        arrays["contact_offset"] = arrays.numbers(0.5 * crimp.heights(cloth))
