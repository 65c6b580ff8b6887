"""Reading the paper's published data, and following it."""

import contextlib
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from scripts import load

import warp_yarn as wy
from warp_yarn.io.published import PROPERTIES

DATA = Path(__file__).parents[2] / "shared" / "data" / "wind_plain_12_5x5.h5"

WIDTH, LENGTH, FRAMES = 4, 3, 5
VALUES = {
    "Gravity": 9.81, "Yarn1_rho": 2.1e-3, "Yarn2_rho": 2.2e-3, "R": 4e-4, "L": 1.1e-3, "Yarn1_Y": 3e5, "Yarn2_Y": 2e5,
    "Yarn1_B": 1.4e-4, "Yarn2_B": 1.1e-4, "kc": 1.5, "kf": 900.0, "df": 800.0, "mu": 0.4, "S": 700.0,
    "handle_stiff": 1.2e4, "wind_velocity_x": 1.0, "wind_velocity_y": 5.0, "wind_velocity_z": -1.0,
    "wind_density": 1.9, "wind_drag": 0.6, "woven_pattern": 2,
}  # fmt: skip
NODES = [(i, j) for j in range(LENGTH) for i in range(WIDTH)]


def arrays():
    """What the file below holds, in our order of nodes."""
    rng = np.random.default_rng(0)
    rest = np.array([(i, 0.0, -j) for i, j in NODES]) * VALUES["L"]
    euler = np.array(NODES) * VALUES["L"]
    inside = np.array([0 < i < WIDTH - 1 and 0 < j < LENGTH - 1 for i, j in NODES])[:, None]
    noise = [rng.normal(size=(FRAMES, len(NODES), n)) for n in (3, 2, 3, 2, 2)]
    return {
        "position": rest + 1e-5 * noise[0],
        "euler": euler + 1e-6 * noise[1] * inside,
        "velocity": 1e-2 * noise[2],
        "euler_velocity": 1e-4 * noise[3] * inside,
        "anchor": euler + 1e-6 * noise[4] * inside,
    }


PATHS = {
    "position": "Steps/Position/Node {i} {j}/LPOS",
    "euler": "Steps/Position/Node {i} {j}/EPOS",
    "velocity": "Steps/Velocity/Node {i} {j}/LVEL",
    "euler_velocity": "Steps/Velocity/Node {i} {j}/EVEL",
    "anchor": "Steps/Position/Node {i} {j}/EPOSBar",
}


def record(values):
    """A dataset of one record; woven_pattern, width and length are integers."""
    types = [(name, "<f8" if isinstance(value, float) else "<i4") for name, value in values.items()]
    return np.array([tuple(values.values())], dtype=types)


def replace(file, path, data):
    del file[path]
    file[path] = data


@pytest.fixture
def path(tmp_path):
    """A published file of 3 rows and 4 columns."""
    result = tmp_path / "small.h5"
    with h5py.File(result, "w") as file:
        file["Properties/Size"] = record({"width": WIDTH, "length": LENGTH})
        file["Properties/Physical properties"] = record(VALUES)
        for name, values in arrays().items():
            for (i, j), value in zip(NODES, values.swapaxes(0, 1), strict=True):
                file[PATHS[name].format(i=i, j=j)] = value
    return result


def test_the_file_of_the_tests_has_every_property():
    assert tuple(VALUES) == PROPERTIES


def test_scene_and_frames_are_those_of_the_file(path):
    published = wy.read_published(path)
    scene, cloth = published.scene, published.scene.cloth
    assert (cloth.weave.name, cloth.weave.rows, cloth.weave.columns) == ("satin", LENGTH, WIDTH)
    assert [yarn.density for yarn in cloth.yarns] == [2.1e-3, 2.2e-3]
    assert [yarn.stretch for yarn in cloth.yarns] == [3e5, 2e5]
    assert [yarn.bend for yarn in cloth.yarns] == [1.4e-4, 1.1e-4]
    assert cloth.warp.tolist() == [0, 1, 0]
    assert cloth.weft.tolist() == [0, 1, 0, 1]
    assert (cloth.spacing, cloth.radius, cloth.shear, cloth.friction) == (1.1e-3, 4e-4, 700.0, 0.4)
    assert (cloth.friction_stiffness, cloth.friction_damping, cloth.parallel_stiffness) == (900.0, 800.0, 1.5)
    assert scene.gravity.tolist() == [0.0, 0.0, -9.81]
    assert scene.wind == wy.Wind(velocity=(1.0, 5.0, -1.0), density=1.9, drag=0.6)
    assert scene.pins.tolist() == [0, WIDTH - 1]
    assert scene.pin_stiffness == 1.2e4
    assert scene.published_scaling
    for name, values in arrays().items():
        np.testing.assert_array_equal(getattr(published.trajectory, name), values)
    np.testing.assert_array_equal(cloth.position, arrays()["position"][0])
    assert published.trajectory.step == 1e-3


def test_distance_is_the_root_mean_square_over_the_nodes(path):
    published = wy.read_published(path)
    position = published.trajectory.position
    away = position[3] + np.array([3e-4, 0.0, 4e-4])
    error, displacement = published.distance(away, 3)
    assert error == pytest.approx(5e-4, rel=1e-12)
    expected = np.sqrt(np.mean([np.linalg.norm(row) ** 2 for row in position[3] - position[1]]))
    assert displacement == pytest.approx(expected, rel=1e-12)


DEFECTS = {
    "no size": (lambda f: f.__delitem__("Properties/Size"), "no dataset 'Properties/Size'"),
    "a property missing": (
        lambda f: replace(
            f, "Properties/Physical properties", record({k: v for k, v in VALUES.items() if k != "Yarn2_rho"})
        ),
        "no field 'Yarn2_rho'",
    ),
    "a property not a number": (
        lambda f: replace(f, "Properties/Physical properties", record({**VALUES, "S": np.nan})),
        "nan, must be finite",
    ),
    "a property out of range": (
        lambda f: replace(f, "Properties/Physical properties", record({**VALUES, "Yarn1_rho": -1.0})),
        "density = -1.0",
    ),
    "two records": (
        lambda f: replace(f, "Properties/Physical properties", np.repeat(record(VALUES), 2)),
        "shape (2,), must be (1,)",
    ),
    "numbers without names": (lambda f: replace(f, "Properties/Size", [4, 3]), "no field 'width'"),
    "unknown weave": (
        lambda f: replace(f, "Properties/Physical properties", record({**VALUES, "woven_pattern": 7})),
        "woven_pattern = 7, must be one of 0 plain, 1 twill, 2 satin",
    ),
    "too small": (lambda f: replace(f, "Properties/Size", record({"width": 2, "length": 3})), "columns = 2"),
    "too large": (
        lambda f: replace(f, "Properties/Size", record({"width": 10**6, "length": 10**6})),
        "no Steps/Position/Node 4 0",
    ),
    "no frames at all": (lambda f: f.__delitem__("Steps"), "no Steps/Position/Node 0 0"),
    "missing node": (lambda f: f.__delitem__("Steps/Position/Node 2 1"), "no Steps/Position/Node 2 1"),
    "missing velocity": (lambda f: f.__delitem__("Steps/Velocity/Node 3 2"), "no Steps/Velocity/Node 3 2"),
    "missing array": (
        lambda f: f.__delitem__("Steps/Velocity/Node 1 1/EVEL"),
        "no dataset 'Steps/Velocity/Node 1 1/EVEL'",
    ),
    "a group for an array": (
        lambda f: (f.__delitem__("Steps/Position/Node 0 0/LPOS"), f.create_group("Steps/Position/Node 0 0/LPOS")),
        "no dataset 'Steps/Position/Node 0 0/LPOS'",
    ),
    "wrong frame count": (
        lambda f: replace(f, "Steps/Position/Node 2 1/EPOS", np.zeros((FRAMES - 1, 2))),
        "Node 2 1/EPOS has shape (4, 2), must be (5, 2)",
    ),
    "wrong width": (
        lambda f: replace(f, "Steps/Position/Node 0 0/LPOS", np.zeros((FRAMES, 2))),
        "Node 0 0/LPOS has shape (5, 2), must be (5, 3)",
    ),
    "one frame": (lambda f: replace(f, "Steps/Position/Node 0 0/LPOS", np.zeros((1, 3))), "has 1 frames"),
    "a number for an array": (lambda f: replace(f, "Steps/Position/Node 0 0/LPOS", 1.0), "has 1 frames"),
    "not a number": (
        lambda f: f["Steps/Velocity/Node 2 1/LVEL"].write_direct(np.full((FRAMES, 3), np.nan)),
        "Node 2 1/LVEL[0, 0] is nan, must be finite",
    ),
    "text for numbers": (
        lambda f: replace(f, "Steps/Position/Node 0 0/EPOS", np.full((FRAMES, 2), b"x")),
        "Node 0 0/EPOS must be an array of numbers",
    ),
}


@pytest.mark.parametrize("defect", DEFECTS)
def test_a_defect_is_named_together_with_the_file(path, defect):
    damage, named = DEFECTS[defect]
    with h5py.File(path, "a") as file:
        damage(file)
    with pytest.raises(wy.InputError) as error:
        wy.read_published(path)
    assert str(path) in str(error.value)
    assert named in str(error.value)


@pytest.mark.parametrize("kept", [0, 100, 0.5, 0.99])
def test_a_truncated_file_is_an_input_error(path, kept):
    data = path.read_bytes()
    path.write_bytes(data[: kept if isinstance(kept, int) else int(kept * len(data))])
    with pytest.raises(wy.InputError, match=r"small\.h5: not a whole HDF5 file"):
        wy.read_published(path)


def test_a_file_of_another_kind_is_an_input_error(tmp_path):
    with pytest.raises(wy.InputError, match=r"none\.h5: there is no such file"):
        wy.read_published(tmp_path / "none.h5")
    with pytest.raises(wy.InputError, match="there is no such file"):
        wy.read_published(tmp_path)
    text = tmp_path / "text.h5"
    text.write_text("Properties\n" * 1000)
    with pytest.raises(wy.InputError, match=r"text\.h5: not a whole HDF5 file"):
        wy.read_published(text)
    foreign = tmp_path / "foreign.h5"
    with h5py.File(foreign, "w") as file:
        file["weights"] = np.zeros(3)
    with pytest.raises(wy.InputError, match=r"foreign\.h5: has no dataset 'Properties/Size'"):
        wy.read_published(foreign)


def test_a_file_that_another_program_writes_to_is_named(path):
    code = f"import h5py, sys; file = h5py.File({str(path)!r}, 'a'); print('open', flush=True); sys.stdin.read()"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        other.stdout.readline()
        with pytest.raises(wy.InputError, match=r"small\.h5: another program has it open"):
            wy.read_published(path)
        other.stdin.close()
    assert len(wy.read_published(path).trajectory) == FRAMES


@pytest.mark.parametrize("seed", range(4))
def test_bytes_that_were_changed_are_an_input_error_or_do_no_harm(path, seed):
    random, data = np.random.default_rng(seed), path.read_bytes()
    for _ in range(40):
        changed = bytearray(data)
        for at in random.integers(0, min(len(data), 4000), random.integers(1, 30)):
            changed[at] = random.integers(256)
        path.write_bytes(changed)
        with contextlib.suppress(wy.InputError):
            wy.read_published(path)


def test_without_h5py_the_error_says_what_to_install(path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(wy.InputError, match=r'pip install "\.\[data\]".*pip install "h5py'):
        wy.read_published(path)


def test_the_scene_ends_with_code_2_on_a_foreign_file(tmp_path, capsys):
    scene = load("scenes/published.py")
    assert scene.command(scene.main, [str(tmp_path / "none.h5")]) == 2
    assert "none.h5: there is no such file" in capsys.readouterr().err


@pytest.mark.skipif(not DATA.exists(), reason=f"the paper's published data is not at {DATA}")
def test_the_published_motion_is_followed(tmp_path):
    usd = tmp_path / "published.usdc"
    relative = load("scenes/published.py").main([str(DATA), "--usd", str(usd)])
    assert list(relative) == [2, 5, 10, 25, 50, 100, 200, 300, 400, 499]
    # A dense prototype was at 6 %; both motions are some 10 % away from the converged one.
    assert relative[25] < 0.10
    assert max(relative[frame] for frame in (2, 5, 10, 50)) < 0.10
    assert usd.exists()
