"""Files and classes stay small enough to be read at once."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROOMS = ("kernels", "warp_yarn/device", "warp_yarn/integrators")
LONGEST_FILE, LONGEST_CLASS = 400, 200


@pytest.mark.parametrize("room", ROOMS)
def test_no_file_and_no_class_is_long(room):
    files = sorted((ROOT / room).rglob("*.py"))
    assert files
    long = {}
    for file in files:
        text = file.read_text(encoding="utf-8")
        parts = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ClassDef)]
        lengths = {f"class {node.name}": (node.end_lineno - node.lineno + 1, LONGEST_CLASS) for node in parts}
        lengths["file"] = (len(text.splitlines()), LONGEST_FILE)
        long |= {(file.name, name): length for name, (length, most) in lengths.items() if length > most}
    assert long == {}
