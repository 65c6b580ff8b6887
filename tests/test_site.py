"""The documentation site: that nothing is missing on it, that its commands are understood, and that its code runs."""

import importlib
import linecache
import re
import shlex
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
import warp_yarn.learn as wl
from scripts import ROOT, imported

import warp_yarn as wy
import warp_yarn.torch as wt

matplotlib.use("Agg")

DOCS = ROOT / "docs"
PAGES = sorted(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))
GALLERY = (DOCS / "gallery.md").read_text()
TUTORIAL = (DOCS / "tutorial.md").read_text()

SCENES = sorted(path.name for path in (ROOT / "scenes").glob("*.py") if path.stem not in ("common", "touch"))
EXAMPLES = sorted(path.name for path in (ROOT / "examples").glob("*.py"))
SMALL = 200_000
"""Bytes of a picture that was made for the site: a page of ten loads at once."""


def code(text: str) -> list[str]:
    return re.findall(r"^```python\n(.+?)^```", text, flags=re.M | re.S)


def sections(text: str, level: str) -> dict[str, str]:
    """By their headings."""
    parts = re.split(rf"^{level} (.+)$", text, flags=re.M)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def width_and_height(picture: Path) -> tuple[int, int]:
    return plt.imread(picture).shape[1::-1]


# What is on it


def test_every_page_is_in_the_navigation():
    nav = (ROOT / "mkdocs.yml").read_text().split("\nnav:\n")[1].split("\n\n")[0]
    named = re.findall(r"- (?:[^:\n]+: )?(\S+\.md)$", nav, flags=re.M)
    assert len(named) == len(set(named))
    assert set(PAGES) - set(named) == set(), "not in nav of mkdocs.yml"
    assert set(named) - set(PAGES) == set(), "in nav of mkdocs.yml, and no page"


def documented() -> dict[str, Any]:
    """The objects that pages of the API show, by how these name them."""
    result = {}
    for page in (DOCS / "api").glob("*.md"):
        for name in re.findall(r"^::: (\S+)$", page.read_text(), flags=re.M):
            assert name not in result, f"{name} is on two pages"
            # the site's builder finds sources by folders, and kernels/ is one
            module, _, member = re.sub(r"^kernels", "warp_yarn.kernels", name).rpartition(".")
            result[name] = getattr(importlib.import_module(module), member)
    return result


@pytest.mark.parametrize("module", [wy, wt, wl], ids=lambda module: module.__name__)
def test_every_public_name_is_on_a_page(module):
    shown = documented()
    missing = [
        name
        for name in module.__all__
        if name != "__version__"
        and not any(path.endswith(f".{name}") and thing is getattr(module, name) for path, thing in shown.items())
    ]
    assert not missing


def test_every_scene_and_example_is_in_the_gallery():
    shown = sections(GALLERY, "###")
    assert sorted(shown) == sorted(SCENES + EXAMPLES)
    for name, section in shown.items():
        folder = "scenes" if name in SCENES else "examples"
        # into_box.py is what throw.py --box runs
        command = {"into_box.py": "python scenes/throw.py --box"}.get(name, f"python {folder}/{name}")
        assert any(line.startswith(command) for line in section.splitlines()), f"{name} lacks its command"
        pictures = re.findall(r"^!\[.+\]\((\S+\.png)\)$", section, flags=re.M)
        assert pictures, f"{name} has no picture"
        for picture in pictures:
            assert (DOCS / picture).exists(), picture


def test_pictures_made_for_the_site_are_small():
    pictures = [path for path in DOCS.glob("*.png") if path.name.startswith(("tutorial_", "gallery_"))]
    assert len(pictures) >= 9
    assert [path.name for path in pictures if path.stat().st_size > SMALL] == []


def test_a_link_out_of_the_pages_is_text_on_the_site():
    links = imported("docs/site_links.py").on_page_markdown
    text = "[a](../CONTRIBUTING.md#add-a-term), [`b`](../kernels/x.py), [c](../../d.md), [e](api/e.md), ![f](g.png)"
    assert links(text) == "a, `b`, c, [e](api/e.md), ![f](g.png)"


def commands() -> list[tuple[str, str]]:
    """Every command of a scene that a page has, with the page; of blocks and of code within a line."""
    result = []
    for page in [ROOT / "README.md", *DOCS.rglob("*.md")]:
        text = page.read_text()
        text = text.replace("\\\n", " ")
        found = re.findall(r"^(?:\$ )?python (scenes/\w+\.py[^\n#]*)", text, flags=re.M)
        found += re.findall(r"`python (scenes/\w+\.py[^`]*)`", text)
        result += [(page.name, " ".join(command.split())) for command in found]
    return sorted(set(result))


@pytest.mark.parametrize(("page", "command"), commands(), ids=lambda text: text)
def test_a_command_of_a_page_is_understood(page, command):
    script, *arguments = shlex.split(command)
    module = imported("scenes/into_box.py" if "--box" in arguments else script)
    if hasattr(module, "parser"):
        module.parser().parse_args(arguments)
    else:
        assert script == "scenes/published.py" and arguments[0].endswith(".h5")


# What its code does


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder to run code in, beside which are the files that pages name."""
    for name in ("docs", "examples"):
        (tmp_path / name).symlink_to(ROOT / name)
    (tmp_path / "out").mkdir()
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    plt.close("all")


def run(blocks: list[str]) -> dict[str, Any]:
    """Runs code block after block, and returns the names that it leaves."""
    names: dict[str, Any] = {}
    for k, block in enumerate(blocks):
        # a kernel, or a wp.func, needs a file of its source
        source = f"block {k}"
        linecache.cache[source] = (len(block), None, block.splitlines(keepends=True), source)
        exec(compile(block, source, "exec"), names)
    return names


def made(folder: Path, step: str, name: str) -> dict[str, Any]:
    """Runs a step of the tutorial as it is, and looks that its picture is there, on the page too, and is a picture."""
    (section,) = (text for heading, text in sections(TUTORIAL, "##").items() if heading.startswith(step))
    names = run(code(section))
    assert f"(tutorial_{name}.png)" in section
    shown = plt.imread(folder / f"{name}.png")[..., :3]
    assert np.ptp(shown.reshape(-1, 3), axis=0).max() > 0.5
    assert width_and_height(DOCS / f"tutorial_{name}.png") == width_and_height(folder / f"{name}.png")
    return names


def test_the_tutorial_has_five_steps():
    assert [heading[:2] for heading in sections(TUTORIAL, "##")] == ["1.", "2.", "3.", "4.", "5."]


@pytest.mark.slow
def test_step_1_a_cloth_hangs_and_blows_along_the_wind(folder):
    trajectory = made(folder, "1.", "hang")["trajectory"]
    assert (folder / "hang.usdc").exists() and len(trajectory) == 301
    lower = trajectory.position[:, -17:, 1].mean(axis=1)
    assert lower[-1] > 5e-3


@pytest.mark.slow
def test_step_2_a_handkerchief_bends_rather_than_being_pressed_together(folder):
    names = made(folder, "2.", "fabric")
    cloth, top = names["cloth"], names["trajectory"].position[-1, :25]
    assert cloth.mass / (24e-3) ** 2 == pytest.approx(0.1, rel=0.05)  # as the page says; yarns at the border are few
    assert np.linalg.norm(top[-1] - top[0]) == pytest.approx(10e-3, abs=1e-4)
    length = np.linalg.norm(np.diff(top, axis=0), axis=1).sum()
    assert length == pytest.approx(24e-3, rel=0.01)


@pytest.mark.slow
def test_step_3_the_ball_carries_the_cloth(folder, capsys):
    names = made(folder, "3.", "contact")
    # what is left is that the hem still swings
    assert names["carried"] == pytest.approx(names["weight"], rel=0.01)
    assert "0.0119 N of 0.0119 N" in capsys.readouterr().out


@pytest.mark.slow
def test_step_4_tangents_are_those_of_the_loss(folder):
    names = made(folder, "4.", "gradients")
    speeds, losses = (names[name].detach().numpy() for name in ("speeds", "losses"))
    slopes = names["speeds"].grad.numpy()
    assert speeds[losses.argmin()] == 3.0
    # of a quadratic they are the same; within half a metre a second the loss is nearly one
    rise, mean = np.diff(losses) / np.diff(speeds), 0.5 * (slopes[1:] + slopes[:-1])
    np.testing.assert_allclose(mean, rise, atol=0.03 * np.abs(slopes).max())


@pytest.mark.slow
def test_step_5_the_yarns_are_found(folder):
    names = made(folder, "5.", "learning")
    result, truth = names["result"], names["truth"]
    for name, value in truth.items():
        assert result.status[name] == "determined"
        assert abs(result.values[name] - value) < 3.0 * result.uncertainty[name] < 0.02 * value


HUNG = "import warp_yarn as wy\n"
BEFORE = {
    "contact.md": HUNG + "cloth = wy.paper.cloth(rows=4, columns=4, pose='flat')\n"
    "cloth = cloth.replace(pose=cloth.position + [0, 0, 0.0125])\n",
    "learning.md": HUNG + "wy.Simulator(wy.paper.hung_cloth(rows=4, columns=4)).run(12).save('out/hang.npz')\n",
}
"""What a page takes for granted: code to run before its own."""
BETWEEN = {
    "gradients.md": "scene = scene.replace(forces={0: (0, 0, 1e-6)})\npolicy = lambda position: 1e-3 * position[:1]\n",
}
"""And before its last block."""
FEWER = {
    "README.md": {"rows=31, columns=31": "rows=5, columns=5"},
    "choosing.md": {"17": "5"},
    "contact.md": {"run(300)": "run(3)"},
    "control.md": {"epochs=70": "epochs=1"},
    "gradients.md": {"rows=9, columns=9": "rows=4, columns=4", "steps=50, frames=[50]": "steps=10, frames=[10]"},
    "api/simulation.md": {"rows=9, columns=9": "rows=4, columns=4"},
    "pictures.md": {"rows=9, columns=9": "rows=4, columns=4", "run(100)": "run(4)", "viewer.wait()": "viewer.close()"},
}
"""What is made smaller to be quick."""
ELSEWHERE = ("drafts.md", "tutorial.md")
"""Pages whose code other tests run, and look at what it makes: drafts.md that in tests/test_docs.py."""


def with_code() -> list[str]:
    found = [page for page in PAGES if page not in ELSEWHERE and code((DOCS / page).read_text())]
    return ["README.md", *found]


@pytest.mark.slow
@pytest.mark.parametrize("page", with_code())
def test_the_code_of_a_page_runs(page, folder):
    blocks = code((ROOT / page if page == "README.md" else DOCS / page).read_text())
    for old, new in FEWER.get(page, {}).items():
        assert any(old in block for block in blocks)
        blocks = [block.replace(old, new) for block in blocks]
    # tests/test_blender.py runs what is Blender's
    blocks = [block for block in blocks if not block.startswith("import bpy")]
    blocks.insert(0, BEFORE.get(page, ""))
    blocks.insert(len(blocks) - 1, BETWEEN.get(page, ""))
    try:
        run(blocks)
    finally:
        if page == "gallery.md":
            wy.unregister_term("linear_drag")
            wy.unregister_integrator("sdirk2-far")
    if page == "gallery.md":
        for name in ("gallery_linear_drag.png", "gallery_butcher_tableau.png"):
            assert width_and_height(folder / name) == width_and_height(DOCS / name)
