"""Fabrics by name, for scenes, benchmarks and tests to share: the paper's, and two that stand for real ones.

The numbers of "handkerchief" and "cotton" are representative, not measured on one fabric: no published fabric has all
of them. Each function says which come from where. Stiffnesses of a yarn are k_s = Y π R² and k_b = B π R².
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from ..description.cloth import Cloth, Yarn
from ..description.weave import Weave, woven
from . import paper


def handkerchief(rows: int = 17, columns: int = 17, weave: str | Weave = "plain", **options: Any) -> Cloth:
    """Make a soft, open cloth of 100 g/m².

    L 1 mm, R L/3; yarns of 50 tex (5e-5 kg/m), k_s 3 N, k_b 2e-8 N m²; S 1000 Pa.
    Typical: the mass. Derived: k_b, from which the cloth bends like the middle half of 618 measured fabrics (Feng 2022,
    4e-6 to 4e-5 N m along the warp). Chosen: k_s, far below a cotton yarn's as pulled straight, which stands for crimp
    that the model leaves out; S, the paper's, some 20 times softer than apparel.

    Args:
        rows, columns: number of warp and of weft yarns, at least 3.
        weave: "plain", "twill" or "satin", words of ``Weave.from_notation`` such as "3/1 twill Z", or a Weave of as
            many yarns.
        options: of the Cloth, to change it: ``pose``, ``friction``, ...; Y and B stay those of R = L/3.
    """
    return _uniform(
        rows, columns, weave, spacing=1e-3, radius=1e-3 / 3.0, tex=50.0, k_s=3.0, k_b=2e-8, shear=1e3, options=options
    )


def cotton(rows: int = 17, columns: int = 17, weave: str | Weave = "plain", **options: Any) -> Cloth:
    """Make a shirt's cotton of 92 g/m².

    L 1/2300 m (23 yarns/cm), R 0.08 mm; yarns of 20 tex (2e-5 kg/m), k_s 20 N, k_b 5e-9 N m²; S 2.5e5 Pa.
    Typical: sett and tex. Derived: R, of a cotton yarn of 20 tex by Peirce's d = 0.0374 √tex mm; k_b and S, from which
    the cloth bends and shears as cotton broad cloth was measured to (Matsudaira 2015, 1.16e-5 N m) and as apparel is
    (0.5 to 2.5 gf/(cm deg)). Chosen: k_s, a fifth of what the fibres have (5 to 8 N/tex), as yarns are twisted and
    crimped.

    Args:
        rows, columns: number of warp and of weft yarns, at least 3.
        weave: "plain", "twill" or "satin", words of ``Weave.from_notation`` such as "3/1 twill Z", or a Weave of as
            many yarns.
        options: of the Cloth, to change it: ``pose``, ``friction``, ...; Y and B stay those of R = 0.08 mm.
    """
    return _uniform(
        rows, columns, weave, spacing=1 / 2300, radius=8e-5, tex=20.0, k_s=20.0, k_b=5e-9, shear=2.5e5, options=options
    )


def _uniform(
    rows: int,
    columns: int,
    weave: str | Weave,
    *,
    spacing: float,
    radius: float,
    tex: float,
    k_s: float,
    k_b: float,
    shear: float,
    options: dict[str, Any],
) -> Cloth:
    """Make a cloth of one yarn, of a mass in tex (1e-6 kg/m), a tension k_s [N] and a bending stiffness k_b [N m²]."""
    section = math.pi * radius**2
    yarn = Yarn(density=1e-6 * tex, stretch=k_s / section, bend=k_b / section)
    draft = woven(weave, rows=rows, columns=columns)
    return Cloth(draft, **{"yarns": [yarn], "spacing": spacing, "radius": radius, "shear": shear, **options})


FABRICS: dict[str, Callable[..., Cloth]] = {"paper": paper.cloth, "handkerchief": handkerchief, "cotton": cotton}
"""Fabrics by name: functions of rows, columns, weave and options of the Cloth."""
