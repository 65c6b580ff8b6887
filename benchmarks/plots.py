"""What the charts share: colours that everyone can tell apart, and files that appear whole or not at all."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from warp_yarn.io.files import atomic_write

PICTURES = Path(__file__).parents[1] / "docs"

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Of Okabe and Ito: different to colour-blind eyes, and in grey."""

MARKERS = ("o", "s", "^", "D", "v", "P", "*")


def save(figure: Figure, path: Path) -> None:
    """Writes a figure as a PNG file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=130)
