"""scenes/hang.py at 5 × 5, in this process."""

import dataclasses
import functools
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
from internals import a_step_at_a_time, put
from pxr import Usd, UsdGeom
from scripts import ROOT, exit_code, load, samples

import warp_yarn as wy
from warp_yarn.io import usd as usd_files
from warp_yarn.simulation.state import FIELDS

hang = load("scenes/hang.py")


@pytest.fixture
def usd(tmp_path):
    return tmp_path / "new folder" / "hang.usdc"


def test_the_cloth_hangs_by_its_corners_and_blows_along_the_wind(usd, capsys):
    trajectory = hang.main(["--size", "5", "--steps", "20", "--output", str(usd)])
    cloth = trajectory.cloth
    moved = trajectory.position - cloth.position
    assert np.abs(moved[:, cloth.corners("top")]).max() < 1e-5
    lower = moved[:, -cloth.weave.columns :, 1].mean(axis=1)
    assert (np.diff(lower) > 0.0).all()
    # Pushed freely by the pressure ρ_w v² on the area L² of a node, which weighs about 2 L · 2.25e-3 kg/m, it would be
    # at ½ a t² = 2.2 mm; it is held, and the wind that it feels slackens.
    assert 1e-3 < lower[-1] < 2.2e-3
    assert samples(usd) == [21, 21]
    told = capsys.readouterr().out
    assert "5 × 5 yarns, plain: 21 frames" in told
    assert str(usd) in told


def test_wind_weave_yarns_and_size_are_the_ones_asked_for(usd):
    arguments = ["--rows", "5", "--columns", "7", "--weave", "twill", "--yarns", "3", "1", "--wind", "0", "-5", "0"]
    trajectory = hang.main([*arguments, "--steps", "2", "--step", "5e-4", "--output", str(usd), "--tubes"])
    cloth = trajectory.cloth
    assert (cloth.weave.name, cloth.weave.rows, cloth.weave.columns) == ("twill", 5, 7)
    assert cloth.yarns == (wy.paper.YARNS[3], wy.paper.YARNS[1])
    assert cloth.shear == 700.0
    assert trajectory.step == 5e-4
    assert trajectory.position[-1, :, 1].mean() < 0.0
    assert UsdGeom.Mesh(Usd.Stage.Open(str(usd)).GetPrimAtPath("/cloth/yarn_0"))


@pytest.mark.parametrize("fabric", [*wy.fabrics.STUDIED, "denim"])
def test_the_fabric_is_the_one_asked_for(fabric, usd, tmp_path):
    record = str(tmp_path / "first.npz")
    arguments = ["--fabric", fabric, "--size", "4", "--weave", "satin", "--steps", "2", "--output", str(usd)]
    cloth = hang.main([*arguments, "--record", record]).cloth
    expected = wy.fabrics.FABRICS[fabric](rows=4, columns=4, weave="satin")
    assert cloth.weave.name == "satin"
    assert (cloth.yarns, cloth.spacing, cloth.radius) == (expected.yarns, expected.spacing, expected.radius)
    assert hang.main(["--resume", record, "--steps", "1", "--output", str(usd)]).cloth.yarns == expected.yarns


DRAFT = ROOT / "docs" / "houndstooth.wif"


@pytest.mark.parametrize("fabric", ["paper", "handkerchief"])
def test_a_draft_is_woven_in_its_colours(fabric, usd):
    """To USD, too, where colours are linear: 27 of 255 is 0.0109, by the curve of sRGB."""
    arguments = ["--draft", str(DRAFT), "--fabric", fabric, "--rows", "7", "--columns", "6", "--steps", "1"]
    cloth = hang.main([*arguments, "--output", str(usd)]).cloth
    draft = wy.read_draft(DRAFT).tiled(rows=7, columns=6)
    np.testing.assert_array_equal(cloth.weave.flipped, draft.weave.flipped)
    np.testing.assert_array_equal([cloth.yarns[k].color for k in cloth.warp[::-1]], draft.warp_colors)
    np.testing.assert_array_equal([cloth.yarns[k].color for k in cloth.weft], draft.weft_colors)
    stage = Usd.Stage.Open(str(usd))
    shapes = [UsdGeom.BasisCurves(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.BasisCurves)]
    reds = sorted({round(float(shape.GetDisplayColorAttr().Get()[0][0]), 4) for shape in shapes})
    assert reds == pytest.approx([0.0109, 0.8714], abs=1e-4)
    expected = [dataclasses.replace(yarn, color=None) for yarn in wy.fabrics.FABRICS[fabric]().yarns]
    assert {dataclasses.replace(yarn, color=None) for yarn in cloth.yarns} == set(expected)


def test_weaves_in_words(usd):
    cloth = hang.main(["--weave", "satin 5/2", "--size", "7", "--steps", "1", "--output", str(usd)]).cloth
    np.testing.assert_array_equal(cloth.weave.flipped, wy.Weave.from_notation("satin 5/2", rows=7, columns=7).flipped)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--weave", "satin 6/2"], "there is no satin of 6 ends"),
        (["--draft", "draft.txt"], "must end in .wif, .dtx, .wpo"),
        (["--draft", "missing.wif"], "missing.wif: there is no such file"),
        (["--draft", str(DRAFT), "--weave", "plain"], "--weave = plain does not go with --draft"),
        (["--draft", str(DRAFT), "--rows", "2"], "rows = 2"),
    ],
)
def test_drafts_and_weaves_that_cannot_be(arguments, told, usd, capsys):
    assert exit_code(hang, [*arguments, "--output", str(usd)]) == 2
    assert told in capsys.readouterr().err


def test_locked_yarns_do_not_slide(usd):
    trajectory = hang.main(["--size", "5", "--steps", "5", "--output", str(usd), "--locked"])
    np.testing.assert_array_equal(trajectory.euler, np.broadcast_to(trajectory.cloth.euler, trajectory.euler.shape))
    assert np.abs(trajectory.position[-1] - trajectory.position[0]).max() > 1e-5


def test_a_resumed_run_is_the_uninterrupted_one(usd, tmp_path):
    whole = hang.main(["--size", "5", "--steps", "12", "--output", str(usd)])
    record = str(tmp_path / "first.npz")
    hang.main(["--size", "5", "--steps", "6", "--output", str(usd), "--record", record])
    both = hang.main(["--resume", record, "--steps", "6", "--output", str(usd)])
    assert samples(usd) == [13, 13]
    for name in FIELDS:
        expected = getattr(whole, name)
        # The same operations on the same numbers.
        np.testing.assert_allclose(getattr(both, name), expected, rtol=0, atol=1e-14 * np.abs(expected).max())


@pytest.mark.parametrize("options", [["--wind", "0", "1", "0"], ["--locked"], ["--step", "5e-4", "--weave", "twill"]])
def test_a_resumed_run_goes_on_in_the_same_scene(usd, tmp_path, options):
    """Twice: the second recording is of a resumed run."""
    whole = hang.main(["--size", "5", *options, "--steps", "6", "--output", str(usd)])
    record = str(tmp_path / "first.npz")
    hang.main(["--size", "5", *options, "--steps", "2", "--output", str(usd), "--record", record])
    for _ in range(2):
        both = hang.main(["--resume", record, "--steps", "2", "--output", str(usd), "--record", record])
    assert both == whole and both.scene.same_as(whole.scene)


def test_learning_takes_the_scene_of_the_recording(usd, tmp_path):
    learn, record = load("scenes/learn.py"), str(tmp_path / "first.npz")
    arguments = ["--size", "3", "--locked", "--wind", "0", "1", "0", "--steps", "1", "--output", str(usd)]
    made = hang.main([*arguments, "--record", record])
    assert learn.read(learn.parser().parse_args([record]))[0].same_as(made.scene)
    with pytest.raises(wy.InputError, match="--wind does not go with"):
        learn.read(learn.parser().parse_args([record, "--wind", "0", "1", "0"]))
    dataclasses.replace(made, scene=None).save(record)
    old, _ = learn.read(learn.parser().parse_args([record, "--wind", "0", "2", "0"]))
    assert old.wind.velocity == (0.0, 2.0, 0.0) and old.sliding


def test_a_recording_without_a_scene_is_not_resumed(usd, tmp_path, capsys):
    record = tmp_path / "old.npz"
    made = hang.main(["--size", "3", "--steps", "1", "--output", str(usd)])
    dataclasses.replace(made, scene=None).save(record)
    assert exit_code(hang, ["--resume", str(record), "--output", str(usd)]) == 2
    assert "has no scene to go on with" in capsys.readouterr().err


@pytest.mark.slow
def test_a_disk_that_fills_up_ends_with_code_2_and_keeps_the_frames(usd, tmp_path, small_disk, capsys, monkeypatch):
    """Those until then are in the file, and where temporary files go for --resume; pictures are drawn."""
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    a_step_at_a_time(monkeypatch)
    monkeypatch.setattr(usd_files, "SAVE_BYTES", 1000)
    run = wy.Simulator.run_chunk

    def fill(simulator, steps):
        if simulator.steps_done == 3:
            (small_disk / "filler").write_bytes(bytes(shutil.disk_usage(small_disk).free))
        return run(simulator, steps)

    monkeypatch.setattr(wy.Simulator, "run_chunk", fill)
    output, png = small_disk / "hang.usdc", tmp_path / "hang.png"
    assert exit_code(hang, ["--size", "3", "--steps", "40", "--output", str(output), "--png", str(png)]) == 2
    told = capsys.readouterr().err
    assert "No space left on device" in told and "hang.usdc" in told
    [kept] = (tmp_path / "temporary").rglob("*.npz")
    frames = wy.Trajectory.load(kept)
    assert str(kept) in told and 4 <= len(frames) < 41 and frames.scene is not None
    # the frame that the disk had no room for is in one or the other
    assert all(abs(count - len(frames)) <= 1 for count in samples(output))
    assert sorted(path.name for path in small_disk.iterdir()) == ["filler", "hang.usdc"]
    assert png.exists()
    monkeypatch.setattr(wy.Simulator, "run_chunk", run)
    both = hang.main(["--resume", str(kept), "--steps", str(40 - frames.steps_done), "--output", str(usd)])
    assert both == hang.main(["--size", "3", "--steps", "40", "--output", str(usd)])


@pytest.mark.parametrize("scene", ["hang", "drape", "fold", "pull", "stack"])
def test_films_are_as_long_and_as_fast_as_asked_for(scene, tmp_path):
    """24 frames of playing time a second, and twenty times slower: some fall between two steps."""
    output, record = tmp_path / "a.usdc", tmp_path / "a.h5"
    small = ["--size", "4"] if scene == "hang" else ["--rows", "4", "--columns", "4", "--friction", "0"]
    options = [*small, "--seconds", "0.012", "--output", str(output), "--record", str(record)]
    if scene == "fold":
        options += ["--fold", "10"]
    if scene == "pull":
        options += ["--acceleration", "1"]
    script = load(f"scenes/{scene}.py")
    every = script.main(options)
    steps = 12 + (10 if scene == "fold" else 0)
    assert len(every) == steps + 1
    film = script.main([*options, "--fps", "24"])
    assert len(film) == int(steps * 1e-3 * 480) + 1 and film.step == pytest.approx(1 / 480)
    places = 1e3 * film.time
    for k, place in enumerate(places):
        before, share = int(place + 1e-9), place - int(place + 1e-9)
        after = min(before + 1, steps)
        expected = every.position[before] + share * (every.position[after] - every.position[before])
        np.testing.assert_allclose(film.position[k], expected, rtol=0, atol=1e-14)
    stage = Usd.Stage.Open(str(output))
    assert stage.GetTimeCodesPerSecond() == pytest.approx(24.0) and stage.GetEndTimeCode() == len(film) - 1
    assert wy.Trajectory.load(record) == film


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--steps", "3", "--seconds", "1"], "--steps 3 and --seconds 1, must be one of them"),
        (["--seconds", "0"], "--seconds = 0.0, must be finite and above 0"),
        (["--fps", "-1"], "--fps = -1.0, must be finite and above 0"),
        (["--fps", "x"], "--fps = 'x', must be a number, finite and above 0"),
        (["--fps", "60"], "--fps 60 at --slowdown 20, must be at most 50: a frame a step of 0.001 s"),
        (["--slowdown", "0"], "--slowdown = 0.0, must be finite and above 0"),
        (["--slowdown", "nan"], "--slowdown = nan, must be finite and above 0"),
    ],
)
@pytest.mark.parametrize("scene", ["hang", "drape"])
def test_lengths_and_rates_out_of_range_are_named(scene, arguments, named, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert exit_code(load(f"scenes/{scene}.py"), arguments) == 2
    assert named in capsys.readouterr().err and not list(tmp_path.rglob("*"))


DRAWING = {
    "hang": ["--size", "3", "--steps", "2"],
    "drape": ["--rows", "4", "--columns", "4", "--steps", "2"],
    "fold": ["--rows", "4", "--columns", "9", "--steps", "2"],
    "pull": ["--rows", "4", "--columns", "4", "--steps", "2"],
    "stack": ["--rows", "3", "--columns", "5", "--layers", "2", "--steps", "2"],
    "throw": ["--size", "3", "--steps", "8", "--iterations", "1"],
    "throw into a box": ["--box", "--epochs", "1"],
}
"""Short runs of every scene that draws."""


@pytest.mark.slow
@pytest.mark.parametrize("scene", DRAWING)
def test_pictures_of_a_size_and_from_where_they_are_asked_for(scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    views = []
    for draw in ("write_png", "write_mp4"):
        monkeypatch.setattr(wy, draw, functools.partial(seen_by, getattr(wy, draw), views))
    asked = ["--png", "a.png", "--mp4", "a.mp4", "--pixels", "64", "48", "--view", "0", "-1", "0.5"]
    assert exit_code(load(f"scenes/{scene.split()[0]}.py"), [*DRAWING[scene], *asked]) == 0
    assert imageio.imread("a.png").shape == (48, 64, 3)
    with imageio.get_reader("a.mp4") as movie:
        assert movie.get_data(0).shape == (48, 64, 3)
    assert views == [[0.0, -1.0, 0.5]] * 2


def seen_by(draw, views, *arguments, **options):
    views.append(options["view"])
    draw(*arguments, **options)


@pytest.mark.slow
@pytest.mark.parametrize("scene", DRAWING)
@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--pixels", "64", "8"], "--pixels[1] = 8"),
        (["--pixels", "64"], "--pixels"),
        (["--mp4", "a.mp4", "--pixels", "64", "49"], "--pixels = (64, 49), must be even in a movie"),
        (["--view", "0", "0", "0"], "--view = (0.0, 0.0, 0.0), must not be 0"),
        (["--view", "0", "nan", "0"], "--view[1] is nan"),
    ],
)
def test_pictures_that_cannot_be_are_named_before_the_run(scene, arguments, named, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(wy.Simulator, "run_chunk", None)
    script = load(f"scenes/{scene.split()[0]}.py")
    assert exit_code(script, [*DRAWING[scene], "--png", "a.png", *arguments]) == 2
    assert named in capsys.readouterr().err
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


@pytest.mark.parametrize("scene", ["hang", "stack"])
@pytest.mark.parametrize(
    ("option", "package"), [("--png", "imageio.v2"), ("--mp4", "imageio.v2"), ("--mp4", "imageio_ffmpeg")]
)
def test_a_missing_extra_is_found_before_the_run(scene, option, package, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setattr(wy.Simulator, "run_chunk", None)
    output = tmp_path / "a.usdc"
    arguments = ["--rows", "4", "--columns", "4", "--output", str(output), option, str(tmp_path / f"a.{option[2:]}")]
    assert exit_code(load(f"scenes/{scene}.py"), arguments) == 2
    told = capsys.readouterr().err
    assert f"{package.split('.')[0]} is not installed" in told and 'pip install ".[render]"' in told
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "packages", "extra"),
    [
        ("learn", ["torch", "matplotlib"], "torch"),
        ("throw", ["torch", "matplotlib"], "torch"),
        ("pullout", ["matplotlib"], "bench"),
        ("throw", ["matplotlib"], "bench"),
    ],
)
def test_help_needs_no_extras_and_a_run_says_which(scene, packages, extra, tmp_path):
    code = (
        "import sys, runpy\n"
        f"for name in {packages}: sys.modules[name] = None\n"
        "sys.path.insert(0, sys.argv[1].rpartition('/')[0])\n"
        "sys.argv[:] = sys.argv[1:]\n"
        "runpy.run_path(sys.argv[0], run_name='__main__')\n"
    )
    script = [sys.executable, "-c", code, str(ROOT / "scenes" / f"{scene}.py")]
    ran = subprocess.run([*script, "--help"], capture_output=True, text=True, timeout=100)
    assert ran.returncode == 0 and "usage:" in ran.stdout and not ran.stderr
    given = ["a.npz"] if scene == "learn" else []
    ran = subprocess.run([*script, *given], capture_output=True, text=True, timeout=100, cwd=tmp_path)
    assert ran.returncode == 2 and f'pip install ".[{extra}]"' in ran.stderr and "Traceback" not in ran.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("README.md", "# A heading\n\nand text", r"README\.md: is no Python file that sets `scene`"),
        ("scene.py", "scene = (", r"scene\.py: is no Python file"),
        ("scene.bin", b"\xff\x00\x01", r"scene\.bin: is no Python file"),
        ("scene.py", "a = 1", r"must set `scene` to a warp_yarn\.Scene"),
        ("scene.py", "a = 1\nb = c", r"scene\.py, line 2: NameError: name 'c' is not defined"),
        ("scene.py", "import sys\nsys.exit(0)", r"scene\.py, line 2: SystemExit: 0"),
        (
            "scene.py",
            "import warp_yarn as wy\n\nwy.Yarn(density=0, stretch=1, bend=1)",
            r"scene\.py, line 3: density = 0",
        ),
        ("scene.py", "float('x')", r"scene\.py, line 1: ValueError: could not convert"),
        (
            "scene.py",
            "import warp_yarn as wy\nscene = wy.paper.hung_cloth(rows=3, columns=3)\nstate = scene.cloth.position",
            r"sets `state` to an array of shape \(9, 3\), must be a warp_yarn\.State",
        ),
    ],
)
def test_files_that_set_no_scene(name, text, message, tmp_path):
    terms = load("scenes/terms.py")
    file = tmp_path / name
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(wy.InputError, match=message):
        terms.main([str(file)])


def test_an_output_folder_that_cannot_be_written_is_found_before_the_run(monkeypatch, capsys):
    if not Path("/proc/self").is_dir():
        pytest.skip("needs the files of a Linux")
    monkeypatch.setattr(wy.Simulator, "run", None)
    assert exit_code(hang, ["--size", "3", "--output", "/proc/self/hang.usdc"]) == 2
    assert "/proc/self/hang.usdc: nothing can be written" in capsys.readouterr().err


@pytest.mark.parametrize("encoding", [pytest.param("cp932", marks=pytest.mark.slow), "ascii"])
def test_output_does_not_depend_on_the_terminal(usd, encoding):
    """Nor does what is written."""
    environment = {**os.environ, "PYTHONIOENCODING": encoding, "PYTHONUTF8": "0", "LC_ALL": "C"}
    script = ROOT / "scenes" / "hang.py"
    arguments = [sys.executable, str(script), "--size", "3", "--steps", "2", "--output", str(usd)]
    for asked in (arguments, [*arguments[:2], "--help"], [*arguments, "--yarns", "1", "9"]):
        ran = subprocess.run(asked, capture_output=True, env=environment, timeout=100)
        assert ran.returncode == (2 if "9" in asked else 0), ran.stderr
        assert b"UnicodeEncodeError" not in ran.stderr
    assert samples(usd) == [3, 3]


def test_a_recording_settles_cloth_and_step(usd, tmp_path, capsys):
    record = str(tmp_path / "first.npz")
    hang.main(["--size", "5", "--steps", "1", "--output", str(usd), "--record", record])
    others = (["--fabric", "paper"], ["--wind", "0", "5", "0"], ["--wind", "1", "0", "0"], ["--locked"])
    for option in (["--rows", "5"], ["--weave", "plain"], ["--draft", str(DRAFT)], ["--step", "1e-3"], *others):
        assert exit_code(hang, ["--resume", record, *option]) == 2
        assert option[0] in capsys.readouterr().err


@pytest.mark.parametrize(
    "scene, option", [("hang", "--size"), ("hang", "--rows"), ("throw", "--size"), ("drape", "--rows")]
)
def test_too_few_yarns_are_told_by_the_option(scene, option, capsys):
    assert exit_code(load(f"scenes/{scene}.py"), [option, "2"]) == 2
    assert f"{option} = 2, must be a whole number, at least 3" in capsys.readouterr().err


def test_a_failing_simulation_leaves_the_frames_before_it(usd, monkeypatch, capsys):
    a_step_at_a_time(monkeypatch)
    run = wy.Simulator.run_chunk

    def storm(simulator, steps):
        if simulator.steps_done == 3:
            put(simulator, "wind_velocity", np.inf)
        return run(simulator, steps)

    monkeypatch.setattr(wy.Simulator, "run_chunk", storm)
    arguments = ["--size", "5", "--steps", "10", "--output", str(usd)]
    with pytest.raises(wy.SimulationError) as failure:
        hang.main(arguments)
    assert failure.value.step == 4
    assert len(failure.value.trajectory) == failure.value.step
    assert samples(usd) == [failure.value.step] * 2
    usd.unlink()
    capsys.readouterr()
    assert exit_code(hang, arguments) == 1
    assert samples(usd) == [failure.value.step] * 2
    told = capsys.readouterr()
    assert f"The simulation failed in step {failure.value.step}" in told.err
    assert f"{failure.value.step} frames" in told.out


def test_ctrl_c_leaves_the_finished_frames(usd, monkeypatch, capsys):
    a_step_at_a_time(monkeypatch)
    run, calls = wy.Simulator.run_chunk, []

    def interrupted(simulator, steps):
        calls.append(steps)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return run(simulator, steps)

    monkeypatch.setattr(wy.Simulator, "run_chunk", interrupted)
    assert exit_code(hang, ["--size", "5", "--steps", "10", "--output", str(usd)]) == 130
    assert samples(usd) == [4, 4]
    assert "Ctrl-C" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--size", "2"], "--size = 2"),
        (["--columns", "-4"], "columns = -4"),
        (["--size", "five"], "--size"),
        (["--weave", "knit"], "--weave"),
        (["--fabric", "felt"], "--fabric"),
        (["--fabric", "cotton", "--size", "2"], "--size = 2"),
        (["--fabric", "cotton", "--yarns", "1", "2"], "--yarns = 1 2"),
        (["--yarns", "1", "1"], "yarns = 1 1"),
        (["--yarns", "1", "9"], "yarns = 1 9"),
        (["--wind", "0", "nan", "0"], "wind velocity[1] is nan"),
        (["--wind", "5"], "--wind"),
        (["--steps", "0"], "steps = 0"),
        (["--step", "0"], "step = 0"),
        (["--step", "inf"], "step = inf"),
        (["--slowdown", "-1"], "--slowdown"),
        (["--output", "hang.obj"], "hang.obj"),
        (["--png", "hang.usdc"], "hang.usdc"),
        (["--resume", "nowhere.npz"], "nowhere.npz: there is no such file"),
        (["--colour", "red"], "--colour"),
    ],
)
def test_wrong_arguments_end_with_code_2_and_a_message(arguments, named, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert exit_code(hang, arguments) == 2
    told = capsys.readouterr()
    assert named in told.err
    assert "Traceback" not in told.err
    assert not list(tmp_path.rglob("*.usdc"))


def test_a_folder_that_cannot_be_made_ends_with_code_2(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert exit_code(hang, ["--output", str(tmp_path / "file" / "hang.usdc")]) == 2
    assert "file" in capsys.readouterr().err


@pytest.mark.slow
def test_pictures_on_request(usd, tmp_path):
    png, mp4 = tmp_path / "hang.png", tmp_path / "pictures" / "hang.mp4"
    arguments = ["--size", "3", "--steps", "4", "--slowdown", "20", "--png", str(png), "--mp4", str(mp4)]
    hang.main([*arguments, "--output", str(usd)])
    assert png.read_bytes().startswith(b"\x89PNG")
    assert b"ftyp" in mp4.read_bytes()[:16]


@pytest.mark.parametrize(
    ("options", "message"),
    [("--scale 0.1", "--scale 0.1 is of --mesh"), ("--over box --mesh a.obj", "must be one of both")],
)
def test_options_of_drape_that_contradict_each_other(options, message):
    with pytest.raises(wy.InputError, match=message):
        load("scenes/drape.py").main(options.split())
