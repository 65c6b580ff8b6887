"""``scenes/learn.py``, and the other methods of ``benchmarks/optimizers.py``."""

import csv
import json

import h5py
import numpy as np
import pytest
from learning import DENSITY, SHEAR, motion
from pxr import Usd, UsdGeom
from scripts import exit_code, load, samples

import warp_yarn as wy
from warp_yarn.calibration.learn import PAPER, CalibrationProblem
from warp_yarn.io.published import DATASETS, PROPERTIES
from warp_yarn.simulation.state import FIELDS

scene_script = load("scenes/learn.py")
optimizers = load("benchmarks/optimizers.py")


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Ten frames of 5 × 5, two more than are learned from below."""
    path = tmp_path_factory.mktemp("recording") / "motion.npz"
    motion(wy.paper.hung_cloth(rows=5, columns=5), 10).save(path)
    return path


LEARNED = ("density[0]", "bend[0]", "shear")
SMALL = ["--frames", "8", "--integrator", "linear", "--parameters", *LEARNED]


def test_the_command_learns_writes_and_tells(recording, tmp_path, capsys):
    usd = tmp_path / "new folder" / "learn.usdc"
    result = scene_script.main([str(recording), *SMALL, "--output", str(usd)])
    assert json.loads(usd.with_suffix(".json").read_text(encoding="utf-8")) == result
    assert list(result["parameters"]) == list(LEARNED)
    for name, of in result["parameters"].items():
        assert of["value"] == pytest.approx(of["in the file"], rel=1e-3)
        assert of["start"] == next(p.start for p in PAPER if p.name == name) == result["paths"][name][0]
        assert result["paths"][name][-1] == of["value"]
        assert abs(of["value"] - of["in the file"]) < 3.0 * of["uncertainty"] and of["status"] == "determined"
    assert (result["frames"], result["step [s]"], result["integrator"]) == (8, 1e-3, "linear")
    assert np.diff(result["losses [m²]"]).max() < 0.0
    assert usd.with_suffix(".png").stat().st_size > 0
    told = capsys.readouterr().out
    assert all(name in told for name in LEARNED)
    assert "simulations" in told and "shorter step" not in told


@pytest.mark.slow
def test_the_animation_has_data_and_model_next_to_each_other(recording, tmp_path):
    usd = tmp_path / "learn.usda"
    arguments = [str(recording), *SMALL, "--first", "2", "--every", "2", "--frames", "2", "--output", str(usd)]
    scene_script.main([*arguments, "--step", "1e-3", "--slowdown", "10"])
    # Frames 2, 4, ..., 10, of two materials twice
    assert samples(usd) == [5] * 4
    stage = Usd.Stage.Open(str(usd))
    # four times 2 ms, ten times slower, at 24 time codes a second
    end = 4 * 2e-3 * 10.0 * 24.0
    assert (stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (pytest.approx(end), 24.0)
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0 and UsdGeom.GetStageUpAxis(stage) == "Z"
    assert stage.GetDefaultPrim().GetPath() == "/comparison"
    points = {
        name: UsdGeom.PointBased(stage.GetPrimAtPath(f"/comparison/{name}/yarn_0")).GetPointsAttr().Get(end)
        for name in ("data", "model")
    }
    # It has learned: single precision of USD, and 1 nm, at which learning ends
    np.testing.assert_allclose(points["model"], points["data"], atol=1e-7)
    boxes = UsdGeom.BBoxCache(end, ["default"])
    data, model = (
        boxes.ComputeWorldBound(stage.GetPrimAtPath(f"/comparison/{name}")).ComputeAlignedRange()
        for name in ("data", "model")
    )
    # free ends stick out into the gap
    assert model.GetMin()[0] > data.GetMax()[0] + 5e-4
    assert model.GetMin()[2] == pytest.approx(data.GetMin()[2], abs=1e-7)


def test_a_model_that_fails_later_is_written_as_far_as_it_goes(recording, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(scene_script, "plot", lambda *of: None)
    usd = tmp_path / "learn.usdc"

    def fail(self, values, frames=None, *, refine=1):
        made = motion(self.scene, 9, step=self.step)
        raise wy.SimulationError("too stiff", step=10, node=-1, term=None, trajectory=made)

    monkeypatch.setattr(CalibrationProblem, "trajectory", fail)
    arguments = [str(recording), *SMALL, "--frames", "4", "--step", "5e-4", "--output", str(usd)]
    assert exit_code(scene_script, arguments) == 1
    assert "too stiff" in capsys.readouterr().err
    # Ten states of half a millisecond are five frames.
    assert samples(usd) == [5] * 4
    assert list(json.loads(usd.with_suffix(".json").read_text(encoding="utf-8"))["parameters"]) == list(LEARNED)


def test_other_parameters_and_ranges(recording, tmp_path):
    usd = tmp_path / "learn.usdc"
    names = ["--parameters", "wind_drag", "stretch[1]", "--range", "wind_drag", "0", "2"]
    starts = ["--start", "stretch[1]", "1.6e5", "--iterations", "0", "--frames", "2", "--integrator", "linear"]
    of = scene_script.main([str(recording), *names, *starts, "--output", str(usd)])["parameters"]
    assert (of["wind_drag"]["range"], of["wind_drag"]["start"]) == ([0.0, 2.0], 1.0)
    assert (of["stretch[1]"]["range"], of["stretch[1]"]["start"]) == ([0.0, 3e5], 1.6e5)
    assert of["wind_drag"]["in the file"] == 0.5


@pytest.mark.slow
def test_an_interrupted_command_is_resumed(recording, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(scene_script, "plot", lambda *of: None)  # tested elsewhere, and slow
    usd = tmp_path / "learn.usdc"
    arguments = [str(recording), *SMALL, "--output", str(usd)]
    whole = scene_script.main(arguments)
    usd.with_suffix(".checkpoint.npz").unlink()
    calls = []

    def residuals(self, values, real=CalibrationProblem.residuals):
        calls.append(values)
        if len(calls) == 8:
            raise KeyboardInterrupt
        return real(self, values)

    with monkeypatch.context() as patch:
        patch.setattr(CalibrationProblem, "residuals", residuals)
        assert exit_code(scene_script, arguments) == 130
    assert "--resume goes on from" in capsys.readouterr().err
    resumed = scene_script.main([*arguments, "--resume"])
    assert {**resumed, "seconds": 0} == {**whole, "seconds": 0}
    # Without it, all over again: the same way, from the start
    assert {**scene_script.main(arguments), "seconds": 0} == {**whole, "seconds": 0}


def published_file(path, trajectory):
    """A recording of the paper's fabric as an HDF5 file of its structure."""
    cloth = trajectory.cloth
    values = dict.fromkeys(PROPERTIES, 0.0)
    for k, yarn in enumerate(cloth.yarns, start=1):
        values |= {f"Yarn{k}_rho": yarn.density, f"Yarn{k}_Y": yarn.stretch, f"Yarn{k}_B": yarn.bend}
    values |= {"Gravity": 9.8, "R": cloth.radius, "L": cloth.spacing, "S": cloth.shear, "mu": cloth.friction}
    values |= {"kc": 1.0, "kf": 1e3, "df": 1e3, "handle_stiff": 1e4}
    values |= {"wind_velocity_y": 5.0, "wind_density": 2.0, "wind_drag": 0.5}
    size = {"width": float(cloth.weave.columns), "length": float(cloth.weave.rows)}
    with h5py.File(path, "w") as file:
        for name, record in (("Size", size), ("Physical properties", values)):
            file[f"Properties/{name}"] = np.array([tuple(record.values())], [(key, "<f8") for key in record])
        for field, (group, kind, _) in DATASETS.items():
            for node, rows in enumerate(getattr(trajectory, field).swapaxes(0, 1)):
                j, i = divmod(node, cloth.weave.columns)
                file[f"Steps/{group}/Node {i} {j}/{kind}"] = rows


@pytest.mark.slow
def test_a_published_file_is_learned_from_its_frame_1(tmp_path):
    path = tmp_path / "published.h5"
    scene = wy.paper.hung_cloth(rows=4, columns=5, published_scaling=True)
    published_file(path, motion(scene, 9))
    result = scene_script.main([str(path), *SMALL, "--output", str(tmp_path / "learn.usdc")])
    for of in result["parameters"].values():
        assert of["value"] == pytest.approx(of["in the file"], rel=1e-3)
    # Frames 1 to 9
    assert samples(tmp_path / "learn.usdc") == [9] * 4


def altered(path, tmp_path, **arrays):
    """A copy of a recording with other arrays."""
    with np.load(path) as data:
        result = tmp_path / "altered.npz"
        np.savez(result, **{**data, **{name: change(data[name]) for name, change in arrays.items()}})
    return result


def truncated(path, tmp_path):
    result = tmp_path / f"truncated{path.suffix}"
    result.write_bytes(path.read_bytes()[:2000])
    return result


def foreign_npz(path, tmp_path):
    np.savez(tmp_path / "foreign.npz", weights=np.zeros(3))
    return tmp_path / "foreign.npz"


def foreign_h5(path, tmp_path):
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["weights"] = np.zeros(3)
    return tmp_path / "foreign.h5"


def truncated_h5(path, tmp_path):
    published_file(tmp_path / "whole.h5", wy.Trajectory.load(path))
    return truncated(tmp_path / "whole.h5", tmp_path)


def nan_h5(path, tmp_path):
    published_file(tmp_path / "nan.h5", wy.Trajectory.load(path))
    with h5py.File(tmp_path / "nan.h5", "a") as file:
        file["Steps/Position/Node 2 1/LPOS"][3] = np.nan
    return tmp_path / "nan.h5"


def short_h5(path, tmp_path):
    published_file(tmp_path / "short.h5", wy.Trajectory.load(path).cut(6))
    return tmp_path / "short.h5"


def with_nan_at(frame):
    def change(array):
        array[frame] = np.nan
        return array

    return change


CORRUPT = {
    "truncated": (truncated, r"truncated.npz: not a recording of warp_yarn"),
    "foreign": (foreign_npz, r"foreign.npz: not a recording of warp_yarn"),
    "another size": (lambda *of: altered(*of, position=lambda x: x[:, :24]), "position has shape (11, 24, 3), must be"),
    "NaN": (lambda *of: altered(*of, position=with_nan_at(7)), "position[7, 0, 0] is nan, must be finite"),
    "fewer frames": (lambda *of: altered(*of, **dict.fromkeys(FIELDS, lambda x: x[:5])), "target has 5 frames"),
    "missing": (lambda path, folder: folder / "none.npz", "none.npz: there is no such file"),
    "truncated HDF5": (truncated_h5, "truncated.h5: not a whole HDF5 file"),
    "foreign HDF5": (foreign_h5, "foreign.h5: has no dataset 'Properties/Size'"),
    "NaN in HDF5": (nan_h5, "Node 2 1/LPOS[3, 0] is nan, must be finite"),
    "fewer frames in HDF5": (short_h5, "target has 6 frames, which leaves 4 to compare with"),
}


@pytest.mark.parametrize("defect", CORRUPT)
def test_corrupt_frames_end_in_one_line_that_says_what_is_wrong(recording, tmp_path, defect, capsys):
    damage, message = CORRUPT[defect]
    path = damage(recording, tmp_path)
    assert exit_code(scene_script, [str(path), *SMALL, "--output", str(tmp_path / "learn.usdc")]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.startswith("error: ") and said.count("\n") == 1
    assert not list(tmp_path.glob("learn.*"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--frames", "0"], "frames = 0"),
        (["--frames", "11"], "frames = 11"),
        (["--first", "-1"], "first = -1"),
        (["--every", "0"], "every = 0"),
        (["--step", "3e-4"], "step = 0.0003 s"),
        (["--integrator", "leapfrog"], "leapfrog"),
        (["--iterations", "-1"], "iterations = -1"),
        (["--resolution", "0"], "resolution = 0"),
        (["--halvings", "-1"], "halvings = -1"),
        (["--parameters", "wool"], "'wool'"),
        (["--parameters", "wind_drag"], "--range wind_drag LOW HIGH"),
        (
            ["--parameters", "shear", "--range", "bend[0]", "0", "1"],
            "--range bend[0]: not among what is learned, shear",
        ),
        (["--range", "shear", "0", "wide"], "--range shear = 'wide'"),
        (["--range", "shear", "2", "1"], "shear: low = 2"),
        (["--start", "shear", "2000"], "shear: start = 2000"),
        (["--resume"], "there is no"),
        (["--output", "learn.obj"], "learn.obj"),
        (["--plot", "learn.pdf"], "learn.pdf"),
    ],
)
def test_bad_arguments(recording, arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert exit_code(scene_script, [str(recording), *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.rglob("learn.*"))


def test_wind_does_not_go_with_a_published_file(recording, tmp_path, capsys):
    path = short_h5(recording, tmp_path)
    assert exit_code(scene_script, [str(path), "--wind", "0", "1", "0", "--output", str(tmp_path / "learn.usdc")]) == 2
    assert "--wind does not go with" in capsys.readouterr().err


# -- benchmarks/optimizers.py -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_every_method_has_a_row_of_what_it_took(monkeypatch, tmp_path):
    monkeypatch.setattr(optimizers, "RATES", {"Adam": (0.1,), "gradient descent": (0.1,)})
    monkeypatch.setattr(optimizers, "PAPER", (DENSITY, SHEAR))
    monkeypatch.setattr(optimizers, "one_core", lambda: None)
    output = tmp_path / "optimizers.csv"
    optimizers.main(["--sizes", "4", "--frames", "4", "--runs", "12", "--output", str(output)])
    with open(output, newline="") as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    assert list(rows) == list(optimizers.METHODS)
    assert float(rows["ours"]["nearest"]) < 0.01 and 0 < int(rows["ours"]["runs to 1 %"]) <= 12
    # Twelve steps are few for these: the table must not say that they arrived.
    assert rows["gradient descent"]["runs to 1 %"] == "" and int(rows["gradient descent"]["of runs"]) == 12
