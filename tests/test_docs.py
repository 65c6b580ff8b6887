"""That pages for users say what the code has: every term has its section, every name in the glossary its object."""

import dataclasses
import importlib
import inspect
import linecache
import re
import shutil
import tomllib
from pathlib import Path

import pytest
from warp_yarn.kernels import TERMS

import warp_yarn as wy
from warp_yarn.description.topology import Topology

ROOT = Path(__file__).parents[1]
DOCS = sorted((ROOT / "docs").rglob("*.md"))


def anchors(text: str) -> set[str]:
    """As GitHub makes them of headings."""
    headings = re.findall(r"^#+ (.+)$", text, flags=re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def rows() -> list[list[str]]:
    """Of the glossary's tables of symbols."""
    lines = (ROOT / "docs" / "glossary.md").read_text().split("## Words")[0].splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    return [row for row in cells if not set("".join(row)) <= set("- ") and row[0] != "symbol"]


def test_every_term_has_its_section():
    headings = re.findall(r"^## (.+)$", (ROOT / "docs" / "physics.md").read_text(), flags=re.M)
    named = {name.strip() for heading in headings for name in heading.split(",")}
    assert set(TERMS) <= named
    # and no term that is none: other sections begin with a capital
    assert {name for name in named if name[0].islower()} == set(TERMS)


@pytest.mark.parametrize("row", rows(), ids=lambda row: f"{row[0] or row[1]}")
def test_a_name_of_the_glossary_is_in_the_code(row):
    assert len(row) == 5
    (name,) = re.findall(r"^`([\w.]+)`$", row[-1])
    base, _, member = name.rpartition(".")
    if base.startswith(("kernels", "integrators")):
        assert hasattr(importlib.import_module(f"warp_yarn.{base}"), member)
    else:
        cls = Topology if base == "Topology" else getattr(wy, base)
        parameters = inspect.signature(cls).parameters
        assert member in parameters or hasattr(cls, member) or f"self.{member} =" in inspect.getsource(cls)


def test_every_number_of_a_cloth_is_in_the_glossary():
    listed = {row[-1].strip("`") for row in rows()}
    numbers = {"Yarn": {f.name for f in dataclasses.fields(wy.Yarn)} - {"color"}}
    numbers |= {"Wind": {f.name for f in dataclasses.fields(wy.Wind)}}
    floats = inspect.signature(wy.Cloth).parameters.values()
    numbers["Cloth"] = {p.name for p in floats if p.annotation in ("float", "Each", "Each | None")}
    assert len(numbers["Cloth"]) == 9
    missing = {f"{cls}.{name}" for cls, names in numbers.items() for name in names} - listed
    assert not missing


@pytest.mark.parametrize("page", [*DOCS, *sorted(ROOT.glob("*.md"))], ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if target.startswith(("http://", "https://")):
            continue
        file, _, anchor = target.partition("#")
        path = page.parent / file if file else page
        assert path.exists(), target
        if anchor:
            assert anchor in anchors(path.read_text()), target


def test_the_page_on_outlines_does_what_it_says():
    blocks = re.findall(r"^```python\n(.+?)^```", (ROOT / "docs" / "outlines.md").read_text(), flags=re.M | re.S)
    space: dict = {}
    for block in blocks:
        exec(block, space)
    assert space["coarse"].nodes == 169
    assert space["scene"].seams.shape == (9, 2)
    assert space["disc"].nodes < space["frame"].nodes


def test_the_page_on_drafts_does_what_it_says(tmp_path, monkeypatch):
    """Its code, one block after the other, on fewer yarns."""
    blocks = re.findall(r"^```python\n(.+?)^```", (ROOT / "docs" / "drafts.md").read_text(), flags=re.M | re.S)
    assert len(blocks) == 2
    (tmp_path / "docs").mkdir()
    shutil.copy(ROOT / "docs" / "houndstooth.wif", tmp_path / "docs")
    monkeypatch.chdir(tmp_path)
    space: dict = {}
    for block in blocks:
        exec(block.replace("26", "6").replace("run(150)", "run(2)"), space)
    assert {path.name for path in tmp_path.iterdir() if path.is_file()} == {
        "draft.png",
        "houndstooth.usdc",
        "herringbone.wif",
    }
    assert len(space["cloth"].yarns) == 2 and len(space["trajectory"]) == 3


def test_ci_runs_the_test_command_of_the_readme():
    section = (ROOT / "README.md").read_text().split("## Test it")[1]
    command = re.search(r"```bash\n(.+)\n```", section)[1]
    assert ".venv/bin/mypy" in command and command.endswith(".venv/bin/pytest -n auto")
    assert command in (ROOT / ".ci" / "run").read_text().splitlines()


def test_hooks_before_a_commit_are_the_checks_of_ci():
    """In their order, and there is nothing else that CI looks at before it tests."""
    hooks = re.findall(r"^ +entry: ([a-z ]+?)(?: --.*)?$", (ROOT / ".pre-commit-config.yaml").read_text(), flags=re.M)
    commands = re.findall(r"\.venv/bin/([a-z]+(?: [a-z]+)?)", (ROOT / ".ci" / "run").read_text())
    assert hooks == [command for command in commands if command.startswith(("ruff", "mypy"))]
    assert len(hooks) == 3


def test_the_package_says_its_version_and_that_it_has_types():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert wy.__version__ == project["project"]["version"]
    assert project["tool"]["setuptools"]["package-data"]["warp_yarn"] == ["py.typed"]
    assert (ROOT / "warp_yarn" / "py.typed").exists()
    assert f"## {wy.__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_the_code_of_forces_md_runs():
    """Block after block, and it says what it says."""
    blocks = re.findall(r"^```python\n(.*?)^```", (ROOT / "docs" / "forces.md").read_text(), flags=re.M | re.S)
    assert len(blocks) == 4
    names: dict[str, object] = {}
    for k, block in enumerate(blocks):
        # a wp.func needs a file of its source
        source = f"docs/forces.md, block {k}"
        linecache.cache[source] = (len(block), None, block.splitlines(keepends=True), source)
        exec(compile(block, source, "exec"), names)
        if k == 0:
            assert names["found"].reactions[5:, 1].sum() == pytest.approx(2.0, abs=5e-3)
        if k == 1:
            # stiffer yarns sag less
            assert names["stretch"].grad.item() > 0.0
    assert len(names["pulls"]) == 9
