"""Fabrics by name, for scenes, benchmarks and tests to share: the paper's, two that stand for real ones, and real ones.

The numbers of "handkerchief" and "cotton" are representative, not measured on one fabric. Each function says which come
from where. Stiffnesses of a yarn are k_s = Y π R² and k_b = B π R². The others are made of data sheets, in which every
number has its source: ``wy.fabrics.kevlar_s706.sources``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from ..description.cloth import Cloth, Yarn
from ..description.weave import Weave, woven
from ..errors import Named
from . import paper
from .named import Datum, NamedFabric, derived, measured, typical


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


# -- of data sheets --------------------------------------------------------------------------------------------------

GF_PER_CM_DEGREE = 9.80665e-3 / 1e-2 / math.radians(1.0)
"""N/m a radian: the shear stiffness of the textile laboratories' units."""

_MATSUDAIRA = "Matsudaira et al. 2015, J. Textile Eng. 61(6):69, by KES-F (as quoted by others)"
_VAT = "Vlákna a textil 1/2018 (as quoted by others)"
_CHENG = "Cheng et al. 2005 (as quoted by others)"
_CAO = "Cao et al. 2008, table 1"
_EAS = "data sheet of 7628, eas-fiberglass.net"
_USUAL = "usual; no published fabric has it with the rest"
_HEARLE = "Morton & Hearle (as remembered), fibres crossed"
_OF_MASS = "mass over tex times sett"
_ROOM = "95 % of the spacing: a round yarn has no room at this sett"
_HALF = "half of the cloth's thickness"


def _both(**data: Datum) -> dict[str, Datum]:
    """Give warp and weft the same."""
    return {f"{side}_{name}": datum for name, datum in data.items() for side in ("warp", "weft")}


def _apparel(shear: float) -> Datum:
    """Say where a shear stiffness [gf/(cm deg)] is from."""
    return typical(shear * GF_PER_CM_DEGREE, source=f"{shear:g} gf/(cm deg); apparel has 0.5 to 2.5 by KES-F")


cotton_shirting = NamedFabric(
    "cotton shirting, broad cloth",
    weave=measured("plain", source=_MATSUDAIRA),
    **_both(
        fibre=measured("cotton", source=_MATSUDAIRA),
        tex=typical(14.8, source="40s; with the sett it makes the mass"),
        twist=typical(1040.0, source="twist factor 40 tex½/cm"),
        crimp=derived(0.0364, source=_OF_MASS),
    ),
    ends=typical(52.4, source="133 an inch; with tex it makes the mass"),
    picks=typical(28.3, source="72 an inch; with tex it makes the mass"),
    mass=measured(0.1238, source=_MATSUDAIRA),
    thickness=measured(0.497e-3, source=_MATSUDAIRA),
    bending=measured(1.157e-5, source=_MATSUDAIRA),
    shear=_apparel(1.0),
    friction=typical(0.25, source=_HEARLE),
)
wool_tropical = NamedFabric(
    "wool tropical, a summer suiting",
    weave=measured("plain", source=_MATSUDAIRA),
    **_both(
        fibre=measured("wool", source=_MATSUDAIRA),
        tex=typical(33.3, source="2/60 Nm; with the sett it makes the mass"),
        twist=typical(500.0, source="twist factor 29 tex½/cm"),
        crimp=derived(0.0635, source=_OF_MASS),
    ),
    ends=typical(24.5, source="with tex it makes the mass"),
    picks=typical(21.5, source="with tex it makes the mass"),
    mass=measured(0.1629, source=_MATSUDAIRA),
    thickness=measured(0.407e-3, source=_MATSUDAIRA),
    bending=measured(6.57e-6, source=_MATSUDAIRA),
    shear=_apparel(0.6),
    friction=typical(0.22, source=_HEARLE),
)


def _polycotton(weave: str, ends: float, picks: float, mass: float, crimp: float) -> NamedFabric:
    """Make one of a series of the same yarns in several weaves."""
    return NamedFabric(
        f"polyester and cotton, {weave}",
        weave=measured(weave, source=_VAT),
        **_both(
            fibre=measured({"polyester": 0.5, "cotton": 0.5}, source=_VAT),
            crimp=derived(crimp, source=_OF_MASS),
        ),
        warp_tex=measured(36.9, source=_VAT),
        weft_tex=measured(28.27, source=_VAT),
        warp_twist=typical(626.0, source="twist factor 38 tex½/cm"),
        weft_twist=typical(715.0, source="twist factor 38 tex½/cm"),
        warp_width=derived(round(0.95e-2 / ends, 6), source=_ROOM),
        ends=measured(ends, source=_VAT),
        picks=measured(picks, source=_VAT),
        mass=measured(mass, source=_VAT),
        shear=_apparel(1.0),
        friction=typical(0.25, source=f"{_HEARLE}, of cotton"),
    )


polycotton_twill = _polycotton("2/2 twill", 45.0, 27.0, 0.2481, 0.0236)
polycotton_panama = _polycotton("panama 2/2", 44.0, 27.0, 0.2418, 0.0130)
denim = NamedFabric(
    "denim",
    weave=typical("3/1 twill", source=_USUAL),
    **_both(
        fibre=typical("cotton", source=_USUAL),
        tex=typical(93.0, source=f"84 to 118; {_USUAL}"),
        twist=typical(467.0, source="twist factor 45 tex½/cm"),
        crimp=derived(0.0679, source=_OF_MASS),
    ),
    ends=typical(26.5, source=f"25 to 28; {_USUAL}"),
    picks=typical(17.5, source=f"16 to 18; {_USUAL}"),
    mass=typical(0.437, source=f"0.400 to 0.475; {_USUAL}"),
    shear=_apparel(2.5),
    friction=typical(0.25, source=_HEARLE),
)
silk_satin = NamedFabric(
    "silk satin, charmeuse",
    weave=typical("satin 5/2", source=_USUAL),
    **_both(
        fibre=typical("silk", source=_USUAL),
        tex=typical(4.7, source=f"2 threads of 20/22 den; {_USUAL}"),
        crimp=typical(0.005, source="of filaments that float over four"),
    ),
    ends=typical(125.0, source=f"120 to 140; {_USUAL}"),
    picks=typical(45.0, source=f"45 to 50; {_USUAL}"),
    mass=typical(0.080, source=_USUAL),
    shear=_apparel(0.5),
    friction=typical(0.26, source=_HEARLE),
)
kevlar_s706 = NamedFabric(
    "Kevlar KM2 style 706, of 600 den",
    weave=measured("plain", source=_CHENG),
    **_both(
        fibre=measured("kevlar km2", source=_CHENG),
        tex=measured(66.7, source=f"600 den; {_CHENG}"),
        thickness=derived(0.115e-3, source=_HALF),
        crimp=typical(0.01, source="about 1 %, less in the weft (as remembered)"),
    ),
    ends=measured(13.39, source=f"34 an inch; {_CHENG}"),
    picks=measured(13.39, source=f"34 an inch; {_CHENG}"),
    mass=measured(0.180, source="of its makers (as remembered)"),
    thickness=measured(0.23e-3, source="of its makers (as remembered)"),
    shear=typical(GF_PER_CM_DEGREE, source="1 gf/(cm deg), as apparel; no measurement at hand"),
    friction=measured(0.23, source="Rao et al. 2009, static (as remembered)"),
)
glass_twintex_plain = NamedFabric(
    "Twintex TPEET22XXX, glass and polypropylene",
    weave=measured("plain", source=_CAO),
    **_both(
        fibre=typical(
            {"glass roving": 0.6, "polypropylene": 0.4}, source="60 % of the mass is glass, usual of Twintex"
        ),
        tex=measured(1870.0, source=_CAO),
        thickness=derived(0.6e-3, source=_HALF),
        crimp=derived(0.0428, source=_OF_MASS),
    ),
    warp_width=measured(4.18e-3, source=_CAO),
    weft_width=measured(4.22e-3, source=_CAO),
    ends=measured(1.91, source=f"{_CAO}, of K. U. Leuven"),
    picks=measured(1.90, source=f"{_CAO}, of K. U. Leuven"),
    mass=measured(0.743, source=_CAO),
    thickness=measured(1.2e-3, source=_CAO),
    shear=measured(66.0, source="Cao et al. 2008: picture frames, secant at 20°, 34 to 126 N/m by laboratory"),
    friction=typical(0.13, source=f"{_HEARLE}, of glass"),
)
glass_7628 = NamedFabric(
    "E glass style 7628, of circuit boards",
    weave=measured("plain", source=_EAS),
    **_both(
        fibre=measured("glass yarn", source=_EAS),
        tex=measured(68.0, source=f"G75 1/0, ± 5 %; {_EAS}"),
        twist=measured(28.0, source=_EAS),
        thickness=derived(0.09e-3, source=_HALF),
    ),
    ends=measured(17.32, source=f"44 an inch; {_EAS}"),
    picks=measured(13.39, source=f"34 an inch; {_EAS}"),
    mass=measured(0.208, source=f"± 5 %; {_EAS}"),
    thickness=measured(0.18e-3, source=_EAS),
    shear=typical(GF_PER_CM_DEGREE, source="1 gf/(cm deg), as apparel; no measurement at hand"),
    friction=typical(0.13, source=_HEARLE),
)

NAMED: dict[str, NamedFabric] = {name: each for name, each in globals().items() if isinstance(each, NamedFabric)}
"""Those of data sheets, by name."""
STUDIED: dict[str, Callable[..., Cloth]] = {"paper": paper.cloth, "handkerchief": handkerchief, "cotton": cotton}
"""The fabrics that charts and long tests go over: heavy and soft, light, light and stiff."""
FABRICS: Named[Callable[..., Cloth]] = Named("fabric", {**STUDIED, **NAMED})
"""All fabrics by name: functions of rows, columns, weave and options of the Cloth."""
__getattr__ = FABRICS.attribute
