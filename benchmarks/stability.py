"""Where each time-stepping method is accurate, stable but damped, or broken, and what broke it.

    python benchmarks/stability.py [--quick] [--fabric cotton] [--densities 1 0.1 0.01] [--png docs/stability.png]

The paper's hung cloth in its wind, all terms, for 1/15 s. First maps for every method: time step (1e-4 to 1/30 s) by
stretch modulus (a hundredth to a hundred times the fabric's), 5 × 5 plain, one map for each density. Then, as the
fabric is, the step by friction, weave, size, precision and fabric, one at a time: the full product would be some 10⁴
runs.

How stiff a case is, is k_s h²/(m L) of its stiffest yarn, m = ρ L being the mass of a segment; it is in the table, and
runs in which it is above 3e7 are left out: cotton has 5e6 at 1 ms.

Accurate: the positions at the end are within 5 % of the largest displacement on the way (root mean squares) of those
of the second-order method at 1/30 ms. Damped: stable, and farther off. Broken: the run ended in an error, or moved
thrice as far. The line is where an explicit method ends: 2/ω of the stiffest mode of the cloth at rest, without pins
and with its yarns locked; with them sliding M is singular and there is none.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tqdm
import warp as wp
from common import RESULTS, environment, one_core, write_csv
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from plots import PICTURES

import warp_yarn as wy
from warp_yarn.integrators import INTEGRATORS
from warp_yarn.io.files import atomic_write
from warp_yarn.presets import paper
from warp_yarn.presets.fabrics import FABRICS, STUDIED

DURATION = 1.0 / 15.0
COUNTS = (666, 200, 66, 20, 6, 2)
"""Steps of each run: from 1e-4 to 1/30 s."""
FINEST = 2000
LARGE = 50
"""Rows from which on a cloth takes too long for short steps, and for the reference."""
STRETCH = (1e-2, 1e-1, 1.0, 1e1, 1e2)
DENSITY = (1.0, 1e-1, 1e-2)
STIFFEST = 3e7
"""k_s h²/(m L) from which on a run is left out."""
ACCURATE, FAR = 0.05, 3.0
VERDICTS = ("accurate", "stable, damped", "broken")
COLORS = ("#5aae61", "#fee08b", "#d6604d")
CAUSES = {"Δs": "Δs", "Newton": "Newton", "not finite": "inf", "solver": "solver"}
"""What a message says, and its short name on the map."""


@dataclasses.dataclass(frozen=True)
class Case:
    """A hung cloth: its stretch moduli and densities in the fabric's, and so on."""

    stretch: float = 1.0
    density: float = 1.0
    friction: float = 0.5
    weave: str = "plain"
    size: int = 5
    precision: str = "double"
    fabric: str = "paper"

    def cloth(self) -> wy.Cloth:
        make = FABRICS[self.fabric]
        cloth = make(rows=self.size, columns=self.size, weave=self.weave, friction=self.friction)
        yarns = [
            dataclasses.replace(yarn, stretch=self.stretch * yarn.stretch, density=self.density * yarn.density)
            for yarn in cloth.yarns
        ]
        return cloth.replace(yarns=yarns)

    def scene(self, **options: Any) -> wy.Scene:
        return paper.hung(self.cloth(), **options)

    def stiffness(self, step: float) -> float:
        """k_s h²/(m L) of the stiffest yarn for its mass."""
        cloth = self.cloth()
        mass = np.array([yarn.density for yarn in cloth.yarns]) * cloth.shortest_spacing
        return float((cloth.stretch_stiffness / mass).max() * step**2 / cloth.shortest_spacing)

    def counts(self) -> tuple[int, ...]:
        """Of steps; large cloths at the longer steps alone, stiff ones at the shorter."""
        counts = COUNTS if self.size < LARGE else COUNTS[3:]
        return tuple(count for count in counts if self.stiffness(DURATION / count) <= STIFFEST)

    def farthest(self) -> float:
        """How far gravity and the wind's pressure would have brought it by the end, were nothing to hold it [m]."""
        cloth = self.cloth()
        mass = 2.0 * min(yarn.density for yarn in cloth.yarns) / cloth.longest_spacing
        pressure = wy.Wind(velocity=paper.WIND).density * float(np.square(paper.WIND).sum())
        return 0.5 * (9.8 + pressure / mass) * DURATION**2

    def label(self, usual: Case) -> str:
        """What sets it apart from the usual one."""
        changed = {
            f.name: getattr(self, f.name)
            for f in dataclasses.fields(self)
            if getattr(self, f.name) != getattr(usual, f.name)
        }
        if not changed:
            return usual.fabric
        (name, value), *_ = changed.items()
        return {"size": f"{value} × {value}", "friction": f"μ = {value}"}.get(name, str(value))


OTHERS = (
    Case(),
    Case(friction=0.0),
    Case(friction=0.3),
    Case(friction=1.0),
    Case(weave="twill"),
    Case(weave="satin"),
    Case(size=3),
    Case(size=17),
    Case(size=33),
    Case(size=100),
    Case(precision="single"),
    *(Case(fabric=name) for name in STUDIED if name != "paper"),
)


def end(case: Case, method: str, count: int) -> tuple[np.ndarray, float]:
    """Positions after the duration, and the largest displacement on the way."""
    simulator = wy.Simulator(case.scene(), step=DURATION / count, integrator=method, precision=case.precision)
    start, farthest = simulator.state.position, 0.0
    while simulator.steps_done < count:
        # in parts: of a long run no frames are kept
        trajectory = simulator.run(min(50, count - simulator.steps_done))
        farthest = max(farthest, *(size_of(x - start) for x in trajectory.position))
    return trajectory.position[-1], farthest


@functools.cache
def converged(case: Case) -> tuple[np.ndarray, float] | None:
    """None where the method that makes it does not get through, or would take too long."""
    if case.size >= LARGE:
        return None
    try:
        return end(dataclasses.replace(case, precision="double"), "sdirk2", FINEST)
    except wy.SimulationError:
        return None


def size_of(x: np.ndarray) -> float:
    return float(np.sqrt((x**2).sum(axis=1).mean()))


def judge(case: Case, method: str, count: int) -> dict[str, Any]:
    """A row of the table: what became of a run."""
    step = DURATION / count
    row = {"method": method, **dataclasses.asdict(case), "step [s]": step, "k_s h²/(m L)": case.stiffness(step)}
    try:
        position, farthest = end(case, method, count)
    except wy.SimulationError as error:
        message = str(error)
        cause = next((short for text, short in CAUSES.items() if text in message), "error")
        return {**row, "verdict": VERDICTS[2], "error": "", "cause": cause, "message": message}
    reference = converged(case)
    if reference is None:
        # nothing to compare with: a cloth cannot have moved farther than a free one
        broken = farthest > FAR * case.farthest()
        return {**row, "verdict": VERDICTS[2 if broken else 1], "error": "", "cause": "far" * broken, "message": ""}
    error = size_of(position - reference[0]) / reference[1]
    broken = farthest > FAR * reference[1]
    verdict = VERDICTS[2] if broken else VERDICTS[0] if error <= ACCURATE else VERDICTS[1]
    return {**row, "verdict": verdict, "error": error, "cause": "far" * broken, "message": ""}


def explicit_limit(case: Case) -> float:
    """2/ω of the stiffest mode at rest, of the free cloth with its yarns locked [s]."""
    h, free = 1e-3, {"sliding": False, "wind": None, "pins": ()}

    def matrix(**options: Any) -> np.ndarray:
        scene = case.scene(**free, **options)
        return wy.Simulator(scene, step=h, integrator="linear").system().dense()

    m = matrix(terms=["mass"])
    stiffness = (matrix() - m) / h**2
    lower = np.linalg.inv(np.linalg.cholesky(m))
    return 2.0 / float(np.sqrt(np.linalg.eigvalsh(lower @ stiffness @ lower.T).max()))


def benchmark(maps: tuple[Case, ...], others: tuple[Case, ...], counts: tuple[int, ...]) -> list[dict[str, Any]]:
    runs = [
        (case, method, count)
        for case in dict.fromkeys((*maps, *others))
        for method in INTEGRATORS
        for count in case.counts()
        if count in counts
    ]
    return [judge(*run) for run in tqdm.tqdm(runs, unit="run", disable=None)]


def draw(path: Path, rows: list[dict[str, Any]], maps: tuple[Case, ...], others: tuple[Case, ...]) -> None:
    """A column of panels a method: a map for each density above, the other factors below."""
    found = {(row["method"], *(row[f.name] for f in dataclasses.fields(Case)), row["step [s]"]): row for row in rows}
    steps = sorted({row["step [s]"] for row in rows})
    groups = [tuple(cases) for _, cases in itertools.groupby(maps, key=lambda case: case.density)]
    ratios = [*map(len, groups), len(others)]
    figure = Figure(figsize=(1.0 + 3.4 * len(INTEGRATORS), 2.0 + 0.4 * sum(ratios)), layout="constrained")
    axes = figure.subplots(len(ratios), len(INTEGRATORS), squeeze=False, sharex=True, height_ratios=ratios)
    for column, method in enumerate(INTEGRATORS):
        for axis, cases in zip(axes[:, column], (*groups, others), strict=True):
            panel(axis, [[found.get((method, *dataclasses.astuple(case), h)) for h in steps] for case in cases])
            labels = [case.label(others[0]) if cases is others else f"×{case.stretch:g}" for case in cases]
            axis.set_yticks(range(len(cases)), labels if column == 0 else [])
        for axis, cases in zip(axes[:, column], groups, strict=False):
            limits = [explicit_limit(case) for case in cases]
            at = np.interp(np.log(limits), np.log(steps), np.arange(len(steps)), left=-0.5)
            axis.plot(at, range(len(cases)), "k.-", linewidth=1.0)
            if others[0] in cases:
                row = cases.index(others[0])
                axis.add_patch(Rectangle((-0.48, row - 0.48), len(steps) - 0.04, 0.96, fill=False, linewidth=2.0))
        axes[0, column].set_title(f"{method} (order {INTEGRATORS[method].order})")
        axes[-1, column].set_xticks(range(len(steps)), [f"{1e3 * h:.2g}" for h in steps])
        axes[-1, column].set_xlabel("time step (ms)")
    for axis, cases in zip(axes[:, 0], groups, strict=False):
        axis.set_ylabel(f"stretch modulus\n(×1: of {cases[0].fabric})\ndensity ×{cases[0].density:g}")
    legend = [Patch(color=color, label=verdict) for verdict, color in zip(VERDICTS, COLORS, strict=True)]
    line = axes[0, 0].lines[0]
    line.set_label("an explicit method's limit, yarns locked")
    unknown = Line2D([], [], color="k", marker="$?$", linestyle="", label="nothing to compare with")
    left_out = Patch(facecolor="white", edgecolor="0.7", label="too large or too stiff to run")
    figure.legend(handles=[*legend, line, unknown, left_out], loc="outside lower center", ncols=6, frameon=False)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png")


def panel(axis: Any, table: list[list[dict[str, Any] | None]]) -> None:
    """Verdicts as colours, with the error in percent or what broke the run."""
    values = [[np.nan if row is None else VERDICTS.index(row["verdict"]) for row in line] for line in table]
    axis.imshow(values, cmap=ListedColormap(COLORS), vmin=0, vmax=2, aspect="auto")
    for j, line in enumerate(table):
        for i, row in enumerate(line):
            if row is not None:
                text = row["cause"] or (f"{100.0 * row['error']:.2g} %" if row["error"] != "" else "?")
                axis.text(i, j, text, ha="center", va="center", fontsize=7)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="three steps, three moduli and small cloths alone")
    parser.add_argument("--fabric", choices=FABRICS, default="paper", help="of the maps (%(default)s)")
    text = "in the fabric's, a map for each (%(default)s)"
    parser.add_argument("--densities", type=float, nargs="+", default=list(DENSITY), metavar="X", help=text)
    parser.add_argument("--png", type=Path, default=PICTURES / "stability.png", help="(%(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS / "stability.csv", help="CSV file (%(default)s)")
    options = parser.parse_args(arguments)
    one_core()
    wp.config.log_level = wp.LOG_WARNING
    stretch, others, counts = STRETCH, OTHERS, COUNTS
    if options.quick:
        stretch, counts = STRETCH[::2], COUNTS[2::2]
        others = tuple(case for case in others if case.size < 17)
    usual = Case(fabric=options.fabric)
    maps = tuple(
        dataclasses.replace(usual, stretch=s, density=d) for d, s in itertools.product(options.densities, stretch)
    )
    # the usual one first; a fabric that is set apart by itself stays
    others = tuple(
        dict.fromkeys(
            (
                usual,
                *(
                    case if case.fabric != "paper" else dataclasses.replace(case, fabric=options.fabric)
                    for case in others
                ),
            )
        )
    )
    about = environment("matplotlib")
    rows = benchmark(maps, others, counts)
    write_csv(options.output, rows, about)
    options.png.parent.mkdir(parents=True, exist_ok=True)
    draw(options.png, rows, maps, others)
    for method in INTEGRATORS:
        share = [sum(row["verdict"] == verdict for row in rows if row["method"] == method) for verdict in VERDICTS]
        print(f"{method}:", ", ".join(f"{n} {verdict}" for n, verdict in zip(share, VERDICTS, strict=True)))
    print("written:", options.output, options.png)


if __name__ == "__main__":
    main()
