"""Chart 4, what each term costs and what it changes: the motions of ``motions.py`` with terms left out one at a time.

    python benchmarks/terms.py [--size 17] [--motions hung snap pull] [--fabric cotton] [--step 5e-4]

A row says how far leaving a term out moves the cloth (root mean square over nodes and frames, relative to the
displacement) and which part of the step's time that saves (all of the motion, in turn with the whole scene, median of
the repeats, one core, after a run that compiles). "sliding" leaves out the sliding coordinates and all terms that only
they have. A term is needed where leaving it out moves the cloth more than halving the step does. One that the motion
cannot do without has the reason.

`python scenes/terms.py FILE` does the same for a scene of yours.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import warp as wp
from common import RESULTS, environment, one_core, print_table, write_csv
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from motions import Motion, add_options, find
from plots import COLORS, MARKERS, PICTURES, save

from warp_yarn.simulation.ablation import Ablation, ablate

LEAST = 1e-8
"""Changes below this are drawn here: rounding, and the solver's tolerance."""

CHEAPEST = -60.0
"""Where bars end of terms without which a step takes much longer [%]; their numbers are written beside them."""


def benchmark(motion: Motion, size: int, step: float, repeats: int) -> Ablation:
    """One motion, with the simulator's default method."""
    start = motion.simulator(size, step=step).state
    return ablate(motion.scene(size, step), steps=motion.steps(step), step=step, repeats=repeats, start=start)


def rows(motion: Motion, name: str, size: int, step: float, found: Ablation) -> list[dict[str, Any]]:
    changes = [*found.changes, *([found.together] if found.together else [])]
    result = []
    for change in changes:
        needed = change.moved is None or change.moved >= found.step_error
        result.append(
            {
                "motion": name,
                **motion.about(size),
                "step [ms]": 1e3 * step,
                "whole step takes [ms]": 1e3 * found.seconds,
                "left out": change.name,
                "moved": "" if change.moved is None else change.moved,
                "cost": "" if change.cost is None else change.cost,
                "cost IQR": change.spread,
                "half the step moves": found.step_error,
                "needed": "yes" if needed else "no",
                "failure": change.failure,
            }
        )
    return result


def draw(found: dict[str, Ablation], motions: dict[str, Motion], size: int, step: float) -> Figure:
    names = list(dict.fromkeys(change.name for ablation in found.values() for change in ablation.changes))
    figure = Figure(figsize=(10.0, 1.5 + 0.45 * len(names)), layout="constrained")
    moved_axes, cost_axes = figure.subplots(1, 2, sharey=True)
    for at, ablation in enumerate(found.values()):
        color, marker, shift = COLORS[at], MARKERS[at], 0.22 * (at - 0.5 * (len(found) - 1))
        moved_axes.axvline(ablation.step_error, color=color, linestyle="--", linewidth=1.0)
        for change in ablation.changes:
            place = names.index(change.name) + shift
            if change.moved is None or change.cost is None:
                moved_axes.plot(
                    0.985, place, "x", color=color, transform=moved_axes.get_yaxis_transform(), clip_on=False
                )
                continue
            moved_axes.plot(max(change.moved, LEAST), place, marker, color=color, markersize=6)
            cost = 100.0 * change.cost
            cost_axes.barh(place, max(cost, CHEAPEST), 0.2, color=color)
            if cost < CHEAPEST:
                cost_axes.text(0.98 * CHEAPEST, place, f"{cost:.0f} %", color="white", fontsize=7, va="center")
            else:
                half = 50.0 * change.spread
                cost_axes.plot([cost - half, cost + half], [place, place], color="0.2", linewidth=0.8)
    moved_axes.set_xscale("log")
    moved_axes.set_xlim(LEAST / 2.0, 100.0)
    moved_axes.set_xlabel("motion changed without it, relative to the motion")
    cost_axes.set_xlabel("time saved without it [% of a step]")
    cost_axes.set_xlim(CHEAPEST, 100.0)
    cost_axes.axvline(0.0, color="0.2", linewidth=0.8)
    moved_axes.set_yticks(range(len(names)), names)
    moved_axes.invert_yaxis()
    for axes in (moved_axes, cost_axes):
        axes.grid(axis="x", alpha=0.3)
    legend = {
        f"{motions[name].title} ({motions[name].fabric})": Line2D(
            [], [], color=COLORS[k], marker=MARKERS[k], linestyle=""
        )
        for k, name in enumerate(found)
    }
    legend["half the step changes as much"] = Line2D([], [], color="0.2", linestyle="--", linewidth=1.0)
    legend["fails without it"] = Line2D([], [], color="0.2", marker="x", linestyle="")
    figure.legend(legend.values(), legend, loc="outside lower center", ncols=min(len(legend), 4), fontsize=9)
    figure.suptitle(f"What each term costs and changes, {size} yarns across, steps of {1e3 * step:g} ms")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=17, help="rows and columns (%(default)s)")
    add_options(parser)
    parser.add_argument("--step", type=float, default=5e-4, metavar="SECONDS", help="time step (%(default)g)")
    parser.add_argument("--repeats", type=int, default=7, help="timed runs (%(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS / "terms.csv", help="CSV file (%(default)s)")
    parser.add_argument("--plot", type=Path, default=PICTURES / "terms.png", help="PNG file (%(default)s)")
    options = parser.parse_args(arguments)
    one_core()
    wp.config.log_level = wp.LOG_WARNING
    about = environment("matplotlib")
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    found, table = {}, []
    motions = {name: find(name, options.fabric) for name in options.motions}
    for name, made in motions.items():
        found[name] = benchmark(made, options.size, options.step, options.repeats)
        table += rows(made, name, options.size, options.step, found[name])
        print(f"\n{made.title}, {made.fabric}, {1e3 * found[name].seconds:.3g} ms a step")
        print("\n".join(found[name].lines()), flush=True)
    print()
    print_table([{name: value for name, value in row.items() if name != "failure"} for row in table])
    write_csv(options.output, table, about)
    save(draw(found, motions, options.size, options.step), options.plot)
    print("written:", options.output, options.plot)


if __name__ == "__main__":
    main()
