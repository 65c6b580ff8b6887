"""The paper's experiments of learning (its sections 4.1 and 4.2.1), each with the paper's numbers beside ours.

    python benchmarks/paper.py table2     eight parameters from 25 frames of 5 × 5 to 25 × 25 yarns
    python benchmarks/paper.py table3     from 5, 10 and 25 frames
    python benchmarks/paper.py table4     errors of prediction, against Bayesian optimization and a sheet
    python benchmarks/paper.py figure6    how errors grow with time and size
    python benchmarks/paper.py bias       what the time step of each method does to the values found

Fabrics are simulated with known yarns and a hard friction (ground_truth.py), and learned from frames by
warp_yarn.learn, from the starts and within the ranges of the paper. "same" ground truth has the model's step and
method, "finer" a step ten times finer; learning begins with 1 ms, and halves it up to three times where the frames ask
for that ("step [ms]" is the last one). Tables go to benchmarks/results/paper_*.csv, charts to docs/paper_*.png.

"found" is where the model fits the frames best, "ours" the value without what learning takes for its time step's part
(Result.corrected). Errors are relative to the true value, and so is "uncertainty", the standard deviation that learning
gives; "status" is whether the data determine the parameter. "ratio" is how many times the paper's error is that of
ours. "runs" are simulations in units of those at 1 ms, so that one at 0.5 ms counts as two; a gradient is another.

table4: errors are means over --test frames and all nodes of the squared distance [1e-6 m²]. The baselines have 140 runs
each, as in the paper: Bayesian optimization (bayesian.py; pip install bayesian-optimization) the same model, ranges and
frames; the sheet (sheet.py; pip install newton) the same pose, pins and wind. Without Newton the sheet is left out.
Ours predicts with the values "found" and the step that they were found with.

figure6: errors by frames to learn from; and, with what the last of these gave, by time over 2000 frames, and of 500
frames of cloths with 2 and 4 times as many yarns in each direction. The paper has no numbers of it, and does not say
from how many frames it learned; nor does its table 3 say on how many yarns: 17 × 17 here, as in its table 4.

bias: what each integrator finds with some steps from the "finer" ground truth, and at 1 ms from the paper's published
data (--data, an HDF5 file), which were made with eq. 2 at 1 ms; steps are not halved. "residual" is the root mean
square distance that is left, relative to the motion.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import bayesian
import paper_parameters
import paper_prediction
import sheet
import warp as wp
from common import RESULTS, environment, print_table, write_csv
from ground_truth import KINDS, TIGHT, Fabric
from plots import PICTURES

import warp_yarn as wy
from warp_yarn.integrators import INTEGRATORS
from warp_yarn.presets import paper

COMMANDS: dict[str, Callable[[argparse.Namespace], Iterator[list[dict[str, Any]]]]] = {
    "table2": paper_parameters.table2,
    "table3": paper_parameters.table3,
    "table4": paper_prediction.table4,
    "figure6": paper_prediction.figure6,
    "bias": paper_parameters.bias,
}
"""Each gives the rows of one case after another."""

PLOTS = {"figure6": paper_prediction.plot_figure6, "bias": paper_parameters.plot_bias}


def pair(text: str) -> tuple[int, ...]:
    """An argparse type: "1 2"."""
    numbers = tuple(map(int, text.split()))
    if numbers not in paper.SHEAR:
        pairs = ", ".join(f"'{a} {b}'" for a, b in paper.SHEAR)
        raise argparse.ArgumentTypeError(f"{text!r} must be one of {pairs}")
    return numbers


def parser() -> argparse.ArgumentParser:
    result = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = result.add_subparsers(dest="command", required=True)
    for name in COMMANDS:
        add = commands.add_parser(name).add_argument
        if name in PLOTS:
            add("--weave", dest="weaves", choices=wy.WEAVES, nargs=1, default=["plain"], help="(plain)")
            add("--yarns", type=pair, nargs=1, default=[(1, 2)], metavar="PAIR", help="(1 2)")
            add("--plot", type=Path, default=PICTURES / f"paper_{name}.png", metavar="PNG", help="(%(default)s)")
        else:
            weaves, pairs = ([*wy.WEAVES], [*paper.SHEAR]) if name == "table4" else (["plain"], [(1, 2)])
            add("--weaves", choices=wy.WEAVES, nargs="+", default=weaves, help=f"({' '.join(weaves)})")
            add("--yarns", type=pair, nargs="+", default=pairs, metavar="PAIR", help="such as '1 2' '1 3'")
        if name == "table2":
            add("--sizes", type=int, nargs="+", default=list(paper_parameters.TABLE_2), help="(5 10 17 25)")
        else:
            add("--size", type=int, default=10 if name == "bias" else 17, help="rows and columns (%(default)s)")
        if name in ("table2", "bias"):
            add("--frames", type=int, default=25, help="to learn from (%(default)s)")
        else:
            add("--frames", type=int, nargs="+", default=[5, 10, 25], help="to learn from (5 10 25)")
        if name in ("table4", "figure6"):
            add("--runs", type=int, default=140, help="of each baseline (%(default)s)")
            add("--test", type=int, default=50, help="frames to predict (%(default)s)")
        if name == "figure6":
            add("--truth", choices=KINDS, nargs=1, default=["same"], help="(same)")
            add("--long", type=int, default=2000, help="frames of the errors by time (%(default)s)")
            add("--grow", type=int, default=500, help="frames of the errors by size (%(default)s)")
            add("--times", type=int, nargs="+", default=[1, 2, 4], help="the size (1 2 4)")
        elif name == "bias":
            add("--steps", type=float, nargs="+", default=[1e-3, 5e-4, 2.5e-4], help="s (1e-3 5e-4 2.5e-4)")
            add("--data", type=Path, metavar="FILE", help="of the paper's published data too")
        else:
            both = [*KINDS] if name != "table4" else ["same"]
            add("--truth", choices=KINDS, nargs="+", default=both, help=f"({' '.join(both)})")
        if name != "bias":
            add("--integrator", choices=INTEGRATORS, help="of the model (the simulator's own default)")
        add("--results", type=Path, default=RESULTS, metavar="FOLDER", help="of the CSV file (%(default)s)")
    return result


def main(arguments: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Runs a command.

    Returns:
        The rows of its table.
    """
    options = parser().parse_args(arguments)
    options.fabrics = [Fabric(weave, yarns) for weave in options.weaves for yarns in options.yarns]
    integrator = getattr(options, "integrator", None)
    options.simulator = TIGHT if integrator is None else {**TIGHT, "integrator": integrator}
    wp.config.log_level = wp.LOG_WARNING
    packages = ["torch", "scipy"]
    if options.command in ("table4", "figure6"):
        packages.append(bayesian.PACKAGE)
        if sheet.available():
            packages.append("newton")
        else:
            print("Newton is not installed (pip install newton): the sheet is left out.")
    about = environment(*packages)
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    output = options.results / f"paper_{options.command}.csv"
    rows: list[dict[str, Any]] = []
    for more in COMMANDS[options.command](options):
        rows += more
        # after each case: nobody may be there to start an interrupted night anew
        write_csv(output, rows, about)
    print_table([row for row in rows if row.get("panel") != "time" or row["x"] % 500 == 0])
    print("written:", output)
    if options.command in PLOTS:
        PLOTS[options.command](options.plot, rows)
        print("written:", options.plot)
    return rows


if __name__ == "__main__":
    try:
        main()
    except wy.WarpYarnError as error:
        sys.exit(f"error: {error}")
