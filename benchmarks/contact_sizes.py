"""What contact costs: a step with a plane and with cloth on cloth, near and far, against size.

    python benchmarks/contact_sizes.py     two sheets of 17² to 223² nodes, 10⁵ in all: a quarter of an hour

Two sheets of the paper's cloth, one on a plane and one on the other, implicit Euler, 1 ms: time of a step beside that
of the same sheets free of all and at rest, which is the cheapest step there is, in turns; what of it goes to looking
for what is near and to evaluating contact; memory of contact for a node. Writes benchmarks/results/contact_sizes.csv,
and docs/contact_sizes.png with published times beside.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import warp as wp
from common import RESULTS, environment, one_core, print_table, turns, write_csv
from matplotlib.figure import Figure
from plots import COLORS, MARKERS, PICTURES, save

import warp_yarn as wy
from warp_yarn.device.contact_declarations import CONTACT, CONTACT_INPUTS

SETTLED = 30
"""Steps before the clock: the sheets lie then."""
PUBLISHED = (
    ("OGC, 50 layers", "CPU", 246_000, 0.21),
    ("OGC, 50 layers", "RTX 4090", 246_000, 6.3e-3),
    ("ppf, woven, a frame", "L4", 115_600, 23.2 * 60.0 / 450.0),
    ("ppf, five twists, a frame", "RTX 4090", 8_200_000, 145.0),
)
"""Times of others (Chen and others 2025; ppf-contact-solver): what, on what, vertices, and seconds a step or a frame,
of other models on other hardware: no more than an order of magnitude."""


def sheets(size: int, **contact: Any) -> wy.Scene:
    """Two sheets, the upper one a little above where it rests on the lower, that one where it rests on a plane."""

    def sheet(height: float) -> wy.Cloth:
        cloth = wy.paper.cloth(rows=size, columns=size, pose="flat")
        return cloth.replace(pose=cloth.position + np.array([0.0, 0.0, height]))

    return wy.Scene([sheet(1.0e-3), sheet(3.45e-3)], **contact)


def bytes_of_contact(simulator: wy.Simulator) -> int:
    """What arrays of contact take."""
    arrays = (simulator.arrays.get(name) for name in (*CONTACT, *CONTACT_INPUTS))
    return sum(array.capacity for array in arrays if isinstance(array, wp.array))


def seconds(launch: Callable[[], Any], repeats: int) -> float:
    """The median time of something [s]."""
    found = []
    for _ in range(repeats):
        start = time.perf_counter()
        launch()
        found.append(time.perf_counter() - start)
    return float(np.median(found))


def shares(simulator: wy.Simulator, repeats: int) -> tuple[float, float]:
    """Seconds of a look for what is near, and of an evaluation of contact with its matrix, at the present state."""
    model = simulator.model
    terms = [term for term in model.arrays.terms if term.touches]

    def look() -> None:
        model.arrays["near_position"].fill_(np.nan)
        model.contact.find()

    def evaluate() -> None:
        for term in terms:
            model.launch_term(term, matrix=1, add_contact_load=0)

    return seconds(look, repeats), seconds(evaluate, repeats)


def looks_a_step(simulator: wy.Simulator, steps: int = 20) -> float:
    """How often a step makes a new list of what is near."""
    looks = 0
    for _ in range(steps):
        before = simulator.arrays["near_position"].numpy().copy()
        simulator.run(1)
        looks += not np.array_equal(before, simulator.arrays["near_position"].numpy())
    return looks / steps


def row(size: int, steps: int, repeats: int) -> dict[str, Any]:
    """Times of one size."""
    # small sheets take too little time to be told from what else the machine does
    steps = max(steps, 20_000 // size**2)
    plane = wy.Plane(point=(0, 0, 0), normal=(0, 0, 1))
    scenes = {
        "without": sheets(size, gravity=None),
        "plane far": sheets(size, gravity=None, obstacles=[wy.Plane(point=(0, 0, -1), normal=(0, 0, 1))]),
        "lying": sheets(size, obstacles=[plane], self_contact=True),
    }
    simulators = {name: wy.Simulator(scene, integrator="implicit-euler") for name, scene in scenes.items()}
    for simulator in simulators.values():
        simulator.run(SETTLED)

    def run(simulator: wy.Simulator) -> Callable[[], float]:
        def timed() -> float:
            start = time.perf_counter()
            simulator.run(steps)
            return (time.perf_counter() - start) / steps

        return timed

    times = dict(zip(simulators, turns([run(s) for s in simulators.values()], repeats), strict=True))
    lying = simulators["lying"]
    medians = {name: float(np.median(values)) for name, values in times.items()}
    look, evaluation = shares(lying, repeats)
    evaluations = lying.integrator.iterations + 1
    looks = looks_a_step(lying)
    contacts = lying.contacts()
    return {
        "nodes": lying.scene.cloth.nodes,
        "without [ms]": 1e3 * medians["without"],
        "plane far / without": float(np.median(np.divide(times["plane far"], times["without"]))),
        "lying / without": float(np.median(np.divide(times["lying"], times["without"]))),
        "spread": float(np.ptp(np.percentile(np.divide(times["lying"], times["without"]), [25, 75]))),
        "look [ms]": 1e3 * look,
        "evaluation [ms]": 1e3 * evaluation,
        "looks a step": looks,
        "share of a step": (looks * look + evaluations * evaluation) / medians["lying"],
        "contacts a node": len(contacts) / lying.scene.cloth.nodes,
        "bytes a node": bytes_of_contact(lying) / lying.scene.cloth.nodes,
    }


def parser() -> argparse.ArgumentParser:
    """Describes the command line."""
    result = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    result.add_argument("--sizes", type=int, nargs="+", default=[17, 33, 65, 100, 223], help="yarns of a sheet")
    result.add_argument("--steps", type=int, default=3, help="steps of a turn, at least")
    result.add_argument("--repeats", type=int, default=3, help="turns")
    return result


def main(arguments: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Measures, prints and writes."""
    options = parser().parse_args(arguments)
    one_core()
    rows = [row(size, options.steps, options.repeats) for size in options.sizes]
    print_table(rows)
    for what, hardware, vertices, time_of_step in PUBLISHED:
        print(f"published: {what}, {hardware}: {vertices} vertices, {time_of_step:g} s")
    write_csv(RESULTS / "contact_sizes.csv", rows, environment())
    chart(rows, environment()["processor"])
    return rows


def chart(rows: Sequence[dict[str, Any]], processor: str) -> None:
    """Draws times of a step over nodes, beside those that are published."""
    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    axes = figure.add_subplot()
    nodes = [row["nodes"] for row in rows]
    free = np.array([row["without [ms]"] for row in rows])
    lines = {
        "two sheets, free of all and at rest": free,
        "the same lying on each other and on a plane": free * [row["lying / without"] for row in rows],
        "of it: a new list of what is near": [row["look [ms]"] for row in rows],
        "of it: an evaluation of contact": [row["evaluation [ms]"] for row in rows],
    }
    for (label, values), color, marker in zip(lines.items(), COLORS, MARKERS, strict=False):
        axes.loglog(nodes, values, color=color, marker=marker, label=label)
    for what, hardware, vertices, time_of_step in PUBLISHED:
        axes.loglog(vertices, 1e3 * time_of_step, "*", color="black")
        label, (shift, side) = f"{what}\n{hardware}", (6, "left") if vertices < 1e6 else (-6, "right")
        axes.annotate(
            label, (vertices, 1e3 * time_of_step), (shift, 0), textcoords="offset points", ha=side, fontsize=8
        )
    axes.set(xlabel="nodes, or vertices", ylabel="time of a step [ms]", ylim=(0.1, 1e6))
    axes.set_title(f"here: {processor}, one core, implicit Euler, 1 ms", fontsize=9)
    axes.grid(True, which="both", alpha=0.2)
    axes.legend(fontsize=8)
    save(figure, PICTURES / "contact_sizes.png")


if __name__ == "__main__":
    main()
