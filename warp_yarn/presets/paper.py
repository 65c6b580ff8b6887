"""The yarns, numbers and scene of the paper (its section 4 and table 1), for scenes, benchmarks and tests to share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ..description.cloth import Cloth, Yarn
from ..description.scene import Scene, Wind
from ..description.weave import Weave, woven
from ..errors import InputError
from ..view.geometry import PALETTE

YARNS = {
    1: Yarn(density=2.0e-3, stretch=5.0e5, bend=1.4e-4, color=PALETTE[0]),
    2: Yarn(density=2.5e-3, stretch=1.7e5, bend=1.1e-4, color=PALETTE[1]),
    3: Yarn(density=2.4e-3, stretch=1.2e5, bend=0.9e-4, color=PALETTE[2]),
}
"""The paper's yarns by their numbers."""

SHEAR = {(1, 2): 1000.0, (1, 3): 700.0, (2, 3): 200.0}
"""S [Pa] of a cloth of two yarns, by their numbers."""

FRICTION_DAMPING = 1000.0
"""d_f [N s/m], ten thousand times critical: the paper's yarns hardly slide."""

STEP = 1e-3
"""h of the paper's simulations [s]."""

STEPS = 500
"""Their length."""

WIND = (0.0, 5.0, 0.0)
"""Velocity of their wind [m/s]."""


def cloth(
    weave: str | Weave = "plain", rows: int = 17, columns: int = 17, yarns: Sequence[int] = (1, 2), **options: Any
) -> Cloth:
    """Makes a cloth of two of the paper's yarns, upright.

    Args:
        weave: "plain", "twill" or "satin", words of ``Weave.from_notation`` such as "3/1 twill Z", or a Weave of as
            many yarns.
        rows, columns: number of warp and of weft yarns, at least 3.
        yarns: the numbers of two different yarns; even yarns of the cloth are of the first, odd ones of the second.
        options: of the Cloth, to change it: ``pose``, ``friction``, ...
    """
    pair = tuple(sorted(yarns))
    if pair not in SHEAR:
        pairs = ", ".join(f"{a} {b}" for a, b in SHEAR)
        raise InputError(f"yarns = {' '.join(map(str, yarns))}, must be two that the paper combines: {pairs}")
    draft = woven(weave, rows=rows, columns=columns)
    numbers = {"yarns": [YARNS[k] for k in yarns], "shear": SHEAR[pair], "friction_damping": FRICTION_DAMPING}
    return Cloth(draft, **{**numbers, **options})


def hung(cloth: Cloth, **options: Any) -> Scene:
    """Makes the paper's scene: the cloth hangs by its two top corners in a wind along +y.

    Args:
        options: of the Scene, to change it: ``wind``, ``sliding``, ``pin_stiffness``, ...
    """
    return Scene(cloth, **{"wind": Wind(velocity=WIND), "pins": cloth.corners("top"), **options})


def hung_cloth(
    weave: str | Weave = "plain", rows: int = 17, columns: int = 17, yarns: Sequence[int] = (1, 2), **options: Any
) -> Scene:
    """Makes ``hung(cloth(...), **options)``, all in one call."""
    return hung(cloth(weave, rows, columns, yarns), **options)
