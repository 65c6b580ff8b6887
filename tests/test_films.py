"""Films: runs by seconds and frames a second, files that frames are streamed into, however the run ends, and on from
them."""

import dataclasses
import errno
import os
import pickle
import signal
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from internals import a_step_at_a_time, put
from pxr import Usd, UsdGeom

import warp_yarn as wy
from warp_yarn.calibration.learn import CalibrationProblem, Parameter
from warp_yarn.io import files, recordings, usd
from warp_yarn.io.films import RECORDINGS
from warp_yarn.simulation.state import FIELDS
from warp_yarn.view import geometry

CLOTH = wy.paper.cloth("plain", 4, 4)
TOP = CLOTH.corners("top")
PATH = CLOTH.position[TOP] + 1e-4 * np.sin(0.3 * np.arange(1, 200))[:, None, None]
ENDINGS = (".npz", ".h5", ".usdc")


def scene(**options: object) -> wy.Scene:
    """Pins that move, so that the count of steps matters."""
    return wy.Scene(CLOTH, **{"pins": TOP, "pin_path": PATH, "wind": wy.Wind(velocity=(0.0, 5.0, 0.0)), **options})


def moving_box() -> wy.Scene:
    """A cloth over a floor, held, and beside it a box that moves from step to step."""
    cloth = CLOTH.replace(pose=CLOTH.position - CLOTH.position.min(axis=0) + [0.0, 0.0, 0.01])
    center = np.array([0.03, 0.0, 0.005])
    way = center + 1e-4 * np.array([1.0, 2.0, 0.0]) * np.arange(1, 30)[:, None]
    box = wy.Box(center=center, half_extents=(1e-3, 2e-3, 1e-3), path=way)
    floor = wy.Plane(point=(0, 0, 0), normal=(0, 0, 1))
    return wy.Scene(cloth, obstacles=[floor, box], pins=cloth.corners())


def simulator(**options: object) -> wy.Simulator:
    return wy.Simulator(scene(), **options)


def expected(steps: wy.Trajectory, places: np.ndarray, name: str) -> np.ndarray:
    """What frames after so many steps are, by linear interpolation of every step."""
    values = getattr(steps, name).reshape(len(steps), -1)
    found = [np.interp(places, np.arange(len(steps)), column) for column in values.T]
    return np.stack(found, axis=1).reshape(len(places), *getattr(steps, name).shape[1:])


def close(a: np.ndarray, b: np.ndarray) -> bool:
    return np.allclose(a, b, rtol=0, atol=1e-14 * max(1.0, np.abs(b).max()))


# -- when frames are --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("asked", "steps", "places"),
    [
        ({"steps": 6}, 6, np.arange(7)),
        ({"seconds": 0.006}, 6, np.arange(7)),
        ({"seconds": 0.1, "fps": 50}, 100, [0, 20, 40, 60, 80, 100]),
        ({"seconds": 0.1, "fps": 24}, 100, [0, 125 / 3, 250 / 3]),
        ({"seconds": 1 / 24, "fps": 24}, 42, [0, 125 / 3]),  # as many steps as it takes to get there
        ({"seconds": 0.0104, "fps": 300}, 11, [0, 10 / 3, 20 / 3, 10]),
        ({"steps": 25, "fps": 100}, 25, [0, 10, 20]),
        ({"steps": 4, "fps": 1000}, 4, np.arange(5)),
        ({"steps": 0, "fps": 24}, 0, [0]),
        ({"seconds": 0.0}, 0, [0]),
        ({"steps": 7, "fps": 700}, 7, np.arange(5) * 10 / 7),
    ],
)
@pytest.mark.parametrize("chunk", [None, 3])
def test_frames_are_at_their_times(asked, steps, places, chunk):
    whole = simulator().run(steps)
    places = np.array(places)
    sim = simulator(chunk=chunk)
    film = sim.run(**asked)
    assert sim.steps_done == film.steps_done == steps and sim.state == whole[-1]
    assert len(film) == len(places) and np.allclose(film.time, 1e-3 * places, rtol=1e-12, atol=0)
    for name in FIELDS:
        assert close(getattr(film, name), expected(whole, places, name)), name
    # and those between two steps only: the others to the last bit
    for k in np.flatnonzero(places == np.round(places)):
        assert film[k] == whole[int(places[k])]
    assert film.end.state == whole[-1] and film.end.steps_done == steps
    sim.reset()
    given = list(sim.frames(**asked))
    assert len(given) == len(film) and all(a == b for a, b in zip(given, film, strict=True))
    assert sim.state == whole[-1]


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({}, "steps = None and seconds = None, must be one of them"),
        ({"steps": 1, "seconds": 1.0}, "steps = 1 and seconds = 1.0, must be one of them"),
        ({"steps": -1}, "steps = -1, must be a whole number, at least 0"),
        ({"steps": 1.0}, "steps = 1.0"),
        ({"seconds": -1e-9}, "seconds = -1e-09, must be finite and at least 0"),
        ({"seconds": np.nan}, "seconds = nan"),
        ({"seconds": "1"}, "seconds = '1'"),
        ({"seconds": 1e300}, "seconds = 1e.300, must be at most 2147483647 steps of 0.001 s"),
        ({"steps": 1, "fps": 0}, "fps = 0, must be finite and above 0"),
        ({"steps": 1, "fps": 1001}, "fps = 1001, must be at most 1000, a frame a step of 0.001 s"),
        ({"steps": 1, "fps": np.inf}, "fps = inf"),
    ],
)
def test_what_no_run_can_be(asked, message, tmp_path):
    """Of all three, and of an iterator when it is made, not when it is first asked."""
    sim = simulator()
    for run in (sim.run, sim.frames, lambda **options: sim.record(tmp_path / "a.npz", **options)):
        with pytest.raises(wy.InputError, match=message):
            run(**asked)
    assert sim.steps_done == 0 and not os.listdir(tmp_path)


def test_frames_of_a_run_that_goes_on():
    sim, again = simulator(), simulator()
    sim.run(7)
    again.run(7)
    film = again.run(seconds=0.05, fps=40)
    assert film.start == 7 and film.steps_done == 57
    assert all(a == b for a, b in zip(sim.frames(seconds=0.05, fps=40), film, strict=True))
    later = again.run(seconds=0.05, fps=40)
    assert film.joined(later).position.shape[0] == 5 and film.joined(later).steps_done == 107
    with pytest.raises(wy.InputError, match=r"later\.step = 0\.001, must be that of the frames before, 0\.025"):
        film.joined(again.run(1))


def test_the_simulator_is_at_the_frame_and_may_be_looked_into():
    sim = simulator()
    for k, frame in enumerate(sim.frames(seconds=0.02, fps=200)):
        assert sim.steps_done == 5 * k and sim.state == frame
        assert sim.forces()["stretch"][0].shape == (CLOTH.nodes, 3)
    between = [sim.steps_done for _ in sim.frames(seconds=0.01, fps=300)]
    assert between == [20, 24, 27, 30]


def test_states_may_be_set_between_frames_but_no_steps_made():
    sim = simulator()
    frames = sim.frames(seconds=0.02, fps=200)
    next(frames)
    sim.state = dataclasses.replace(sim.state, velocity=sim.state.velocity + np.array([0.0, 0.0, 1e-3]))
    other = simulator()
    other.state = sim.state
    assert next(frames) == other.run(5)[-1]
    sim.run(1)
    with pytest.raises(wy.InputError, match=r"after 6 steps, and its frames after 5: it may not be stepped"):
        next(frames)


# -- parts of a trajectory --------------------------------------------------------------------------------------------


def test_a_part_of_a_trajectory_is_one():
    whole = simulator().run(20)
    for part in (slice(None, None, 10), slice(3, None, 4), slice(2, 9), slice(-5, None), slice(5, 5), slice(None)):
        taken = whole[part]
        assert isinstance(taken, wy.Trajectory) and len(taken) == len(range(21)[part])
        for name in FIELDS:
            assert np.array_equal(getattr(taken, name), getattr(whole, name)[part])
        if len(taken):
            assert np.allclose(taken.start * 1e-3 + taken.time, whole.time[part], rtol=0, atol=1e-15)
            assert taken.steps_done == range(21)[part][-1]
            sim = wy.Simulator.resumed(taken)
            assert sim.step_size == 1e-3 and sim.state == taken[-1]
    assert np.array_equal(whole[::2][::5].position, whole[::10].position) and whole[::2][::5].every == 10
    assert [frame == whole[k] for k, frame in enumerate(whole)] == [True] * 21
    with pytest.raises(wy.InputError, match=r"trajectory\[::-1\], must take frames in their order"):
        whole[::-1]
    film = simulator().run(seconds=0.1, fps=24)
    assert film[1:].start == pytest.approx(125 / 3) and film[1:].steps_done == 100
    with pytest.raises(wy.InputError, match=r"the last frame is after 41\.6667 steps, which no run goes on from"):
        _ = film[:2].steps_done


def test_a_part_of_a_motion_is_drawn_where_its_obstacles_are(tmp_path):
    """By frames, not by steps: an obstacle that moves is in a picture of every tenth frame where it was then."""
    trajectory = wy.Simulator(moving_box(), integrator="implicit-euler").run(6)
    for taken, steps in ((trajectory[::3], (0, 3, 6)), (trajectory[2:], (2, 3, 4, 5, 6)), (trajectory[1::4], (1, 5))):
        all_of_them, some = (geometry.placed(each)[1] for each in (trajectory, taken))
        np.testing.assert_allclose(some.position, all_of_them.position[list(steps)], rtol=0, atol=1e-15)
        # a frame a time code
        wy.write_usd(tmp_path / "a.usdc", taken, fps=1.0 / taken.step)
        stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
        box = UsdGeom.Xformable(stage.GetPrimAtPath("/obstacles/box_1"))
        there = [box.GetLocalTransformation(k).ExtractTranslation() for k in range(len(steps))]
        np.testing.assert_allclose(there, all_of_them.position[list(steps)], rtol=0, atol=1e-12)


def test_learning_refuses_rows_that_are_no_frames():
    target = simulator().run(20)
    learned = [Parameter("shear", 100.0, 5000.0, 2000.0)]
    CalibrationProblem(target.scene, target, learned, every=5)
    for part in (target[::5], target[5:]):
        with pytest.raises(wy.InputError, match="must be 0 and 1: pin_path and forces"):
            CalibrationProblem(target.scene, part, learned)
    still = wy.Simulator(wy.paper.hung(CLOTH)).run(20)[::5]
    CalibrationProblem(still.scene, still, learned)


# -- files ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", [".npz", ".h5", ".hdf5"])
@pytest.mark.parametrize("locked", [False, True], ids=["sliding", "locked"])
def test_recordings_hold_the_film(tmp_path, monkeypatch, ending, locked):
    """In several blocks."""
    monkeypatch.setattr(recordings, "BLOCK_BYTES", 2 * 13 * 8 * CLOTH.nodes)
    path, sim = tmp_path / f"film{ending}", wy.Simulator(scene(sliding=not locked), step=5e-4, integrator="linear")
    assert sim.record(path, seconds=0.05, fps=110) == 6
    film = wy.Simulator(scene(sliding=not locked), step=5e-4, integrator="linear").run(seconds=0.05, fps=110)
    back = wy.Trajectory.load(path)
    assert back == film and back.scene.same_as(sim.scene) and back.steps_done == 100
    assert back.options == film.options and back.options["integrator"] == "linear"
    assert back.end.state == film.end.state == sim.state
    for part in (slice(None, None, 2), slice(1, 4), slice(-1, None), slice(3, 100), slice(5, 5)):
        assert wy.Trajectory.load(path, part) == film[part]
    assert os.listdir(tmp_path) == [path.name]
    # and what save() writes, whole or streamed, is the same to whoever reads it
    film.save(path)
    assert wy.Trajectory.load(path) == film and wy.Trajectory.load(path).end.state == film.end.state
    assert wy.Trajectory.load(path, slice(1, None, 2)) == film[1::2]


@pytest.mark.parametrize("ending", [".npz", ".h5"])
def test_single_precision_is_near_and_goes_on_exactly(tmp_path, ending):
    """Far from the origin too: a cloth at 1 km is to a float32 but 6e-5 m exact, here to the 6e-8 of its size."""
    far = CLOTH.replace(pose=CLOTH.position + np.array([1000.0, -500.0, 0.0]))
    sim = wy.Simulator(wy.Scene(far, pins=TOP))
    paths = [tmp_path / f"{name}{ending}" for name in ("double", "single")]
    for path, precision in zip(paths, ("double", "single"), strict=True):
        sim.reset()
        sim.record(path, steps=12, precision=precision, compression=0)
    double, single = (wy.Trajectory.load(path) for path in paths)
    off = np.abs(double.position - single.position).max()
    assert 0.0 < off < 1e-7 * np.ptp(CLOTH.position, axis=0).max()
    if ending == ".npz":  # HDF5 has room for more frames
        assert paths[1].stat().st_size < 0.75 * paths[0].stat().st_size
    assert single.end.state == sim.state
    assert wy.Simulator.resumed(paths[1]).run(3) == wy.Simulator.resumed(paths[0]).run(3)
    double.save(paths[1], precision="single", compression=9)
    assert wy.Trajectory.load(paths[1]).end.state == double[-1]


@pytest.mark.parametrize("ending", [".npz", ".h5", None, "pickle"])
def test_what_gains_energy_goes_on_alike(tmp_path, ending):
    """A strip on the bias, of which eq. 2 gains energy in some steps: the watch makes them in parts, by what it has
    seen of those before."""
    cloth = wy.piece(wy.fabrics.cotton, wy.outline.rectangle(3.5e-3, 1.8e-3, angle=45.0), pose="flat")
    pins = np.flatnonzero(cloth.position[:, 1] < 0.12 * np.ptp(cloth.position[:, 1])).tolist()[::2]
    scene = wy.Scene(cloth, pins=pins, sliding=False)
    sim = wy.Simulator(scene, integrator="linear")
    if ending == "pickle":
        sim.run(10)
        again = pickle.loads(pickle.dumps(sim))
    elif ending is None:
        again = wy.Simulator.resumed(sim.run(10))
    else:
        sim.record(tmp_path / f"a{ending}", steps=10)
        again = wy.Simulator.resumed(tmp_path / f"a{ending}")
    assert again.run(8) == sim.run(8)
    steps = {step: size for step, size in sim.split_steps.items() if step > 10}
    assert steps and {step: size for step, size in again.split_steps.items() if step > 10} == steps
    # what it goes by is the watch's memory
    forgetful = wy.Simulator(scene, integrator="linear")
    forgetful.run(10)
    forgetful.state = forgetful.state
    forgetful.run(8)
    assert {step for step in forgetful.split_steps if step > 10} != set(steps)


def test_hdf5_is_readable_by_others(tmp_path):
    h5py = pytest.importorskip("h5py")
    sim = simulator()
    sim.record(tmp_path / "a.h5", steps=3)
    with h5py.File(tmp_path / "a.h5") as file:
        assert file["position"].shape == (4, CLOTH.nodes, 3) and file["position"].dtype == np.float64
        np.testing.assert_array_equal(file["position"][-1], sim.state.position)
        assert file["time_step"][()] == 1e-3 and file["time_step"].attrs["unit"] == "s"


@pytest.mark.parametrize("tubes", [False, True], ids=["curves", "tubes"])
@pytest.mark.parametrize("ending", [".usdc", ".usd", ".usda"])
def test_usd_is_what_write_usd_makes_of_the_frames(tmp_path, monkeypatch, ending, tubes):
    """Saved after every frame or two, with an obstacle that moves and a plane beneath."""
    monkeypatch.setattr(usd, "SAVE_BYTES", 1500)
    sim = wy.Simulator(moving_box(), integrator="implicit-euler")
    sim.record(tmp_path / f"a{ending}", seconds=0.02, fps=300, slowdown=4.0, tubes=tubes)
    sim.reset()
    film = sim.run(seconds=0.02, fps=300)
    wy.write_usd(tmp_path / f"b{ending}", film, slowdown=4.0, tubes=tubes)
    texts = []
    for name in "ab":
        stage = Usd.Stage.Open(str(tmp_path / f"{name}{ending}"))
        assert stage.GetTimeCodesPerSecond() == 24.0
        # a 75th of a second of playing time from frame to frame
        assert stage.GetEndTimeCode() == pytest.approx((len(film) - 1) * 24.0 / 75.0)
        texts.append(stage.GetRootLayer().ExportToString())
    assert texts[0] == texts[1]


def test_usd_of_cloth_that_flies_far(tmp_path):
    """Its points are relative to a translation from the first frame on that needs one."""
    cloth = CLOTH.replace(friction=0.0)
    sim = wy.Simulator(wy.Scene(cloth, gravity=None, terms=["stretch"], sliding=False), step=0.05)
    state = sim.state
    sim.state = dataclasses.replace(state, velocity=state.velocity + np.array([50.0, 0.0, 0.0]))
    sim.record(tmp_path / "a.usdc", steps=8, slowdown=1.0 / (24.0 * 0.05))
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    cache = [UsdGeom.XformCache(k) for k in range(9)]
    shape = UsdGeom.BasisCurves(stage.GetPrimAtPath("/cloth/yarn_0"))
    middles = []
    for k in range(9):
        points = np.array(shape.GetPointsAttr().Get(k), dtype=np.float64)
        middles.append(points.mean(axis=0) + cache[k].GetLocalToWorldTransform(shape.GetPrim()).ExtractTranslation())
    moved = np.diff(middles, axis=0)
    # 2.5 m a step; single precision of what is beyond its reach would be off by 1e-6
    np.testing.assert_allclose(moved, np.tile([2.5, 0.0, 0.0], (8, 1)), rtol=0, atol=2e-7)


def test_all_files_of_a_run_have_its_frames(tmp_path):
    paths = [tmp_path / f"a{ending}" for ending in (*ENDINGS, ".usda", ".usdz")]
    assert simulator().record(*paths, seconds=0.1, fps=24) == 3
    assert sorted(os.listdir(tmp_path)) == sorted(path.name for path in paths)
    assert len(wy.Trajectory.load(paths[0])) == len(wy.Trajectory.load(paths[1])) == 3
    assert Usd.Stage.Open(str(paths[2])).GetEndTimeCode() == Usd.Stage.Open(str(paths[3])).GetEndTimeCode() == 2
    assert recorded(paths[4]) == 3


@pytest.mark.parametrize(
    ("paths", "options", "message"),
    [
        ([], {}, "needs a path at least"),
        (["a.npz", "b.obj"], {}, r"b\.obj', must end in \.usd, \.usda, \.usdc, \.usdz, \.npz, \.h5, \.hdf5"),
        (["a.npz", "missing/b.npz"], {}, "the folder .*missing does not exist"),
        (["a.npz"], {"precision": "half"}, "precision = 'half', must be one of double, single"),
        (["a.usdc"], {"compression": 10}, "compression = 10, must be a whole number, from 0 to 9"),
        (["a.npz"], {"slowdown": 0.0}, "slowdown = 0.0, must be finite and above 0"),
        (["a.npz"], {"after": "nowhere.npz"}, r"nowhere\.npz: there is no such file"),
    ],
)
def test_what_cannot_be_recorded_is_found_before_the_first_step(tmp_path, monkeypatch, paths, options, message):
    monkeypatch.chdir(tmp_path)
    sim = simulator()
    with pytest.raises(wy.InputError, match=message):
        sim.record(*paths, steps=5, **options)
    assert sim.steps_done == 0 and not os.listdir(tmp_path)


def test_a_missing_library_is_found_before_the_first_step(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    sim = simulator()
    with pytest.raises(wy.InputError, match=r'h5py is not installed.*pip install "\.\[data\]".*pip install "h5py'):
        sim.record(tmp_path / "a.npz", tmp_path / "a.h5", steps=5)
    assert sim.steps_done == 0 and not os.listdir(tmp_path)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_frames(tmp_path):
    """Frames of 1.7 kB, of which blocks of 16 kB are kept."""
    sim = simulator()
    peaks = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recordings, "BLOCK_BYTES", 1 << 14)
        sim.record(tmp_path / "a.npz", tmp_path / "a.h5", steps=5)
        for steps in (20, 220):
            sim.reset()
            tracemalloc.start()
            sim.record(tmp_path / "a.npz", tmp_path / "a.h5", steps=steps)
            peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
    # what is left is the names in a zip file's directory
    assert peaks[1] - peaks[0] < 0.4 * 200 * 13 * 8 * CLOTH.nodes


# -- runs that end early ----------------------------------------------------------------------------------------------


def recorded(path: Path) -> int:
    """Frames of a file, each of which is whole."""
    if path.suffix in RECORDINGS:
        return len(wy.Trajectory.load(path))
    stage = Usd.Stage.Open(str(path))
    shape = UsdGeom.PointBased(stage.GetPrimAtPath("/cloth/yarn_0"))
    times = shape.GetPointsAttr().GetTimeSamples()
    assert len(times) == shape.GetVelocitiesAttr().GetNumTimeSamples() and times[-1] == stage.GetEndTimeCode()
    return len(times)


class _Stop(BaseException):
    """As KeyboardInterrupt, which a test must not take for that of whoever runs it."""


def stopped_after(monkeypatch, steps: int, error: type[BaseException] = _Stop) -> None:
    """Ends runs after so many steps."""
    a_step_at_a_time(monkeypatch)
    run = wy.Simulator.run_chunk

    def stopping(sim: wy.Simulator, asked: int) -> int:
        if sim.steps_done == steps:
            raise error
        return run(sim, asked)

    monkeypatch.setattr(wy.Simulator, "run_chunk", stopping)


@pytest.mark.parametrize("fps", [None, 300, 24])
@pytest.mark.parametrize("steps", [0, 1, 3, 4, 41, 42, 43, 59])
def test_a_film_that_was_stopped_goes_on_as_if_it_was_not(tmp_path, fps, steps):
    """After whatever step: every file has the frames until there, and the recording what is missing."""
    whole = simulator()
    film = whole.run(60, fps=fps)
    paths = [tmp_path / f"a{ending}" for ending in ENDINGS]
    with pytest.MonkeyPatch.context() as patch:
        stopped_after(patch, steps)
        sim = simulator()
        with pytest.raises(_Stop):
            sim.record(*paths, steps=60, fps=fps)
    assert {recorded(path) for path in paths} == {sum(film.start + film.every * np.arange(61) <= steps + 1e-9)}
    for path in paths[:2]:
        sim = wy.Simulator.resumed(path)
        assert steps - 1 <= sim.steps_done <= steps
        both = tmp_path / "both.h5"
        sim.record(path, both, steps=60 - sim.steps_done, after=path)
        assert wy.Trajectory.load(path) == wy.Trajectory.load(both) == film
        assert sim.state == whole.state
    assert sorted(os.listdir(tmp_path)) == ["a.h5", "a.npz", "a.usdc", "both.h5"]


def test_a_film_goes_on_twice_and_elsewhere(tmp_path):
    """From what save() wrote too; and by other steps than its own it does not."""
    film = simulator().run(seconds=0.15, fps=24)
    path = tmp_path / "a.npz"
    simulator().run(seconds=0.05, fps=24).save(path)
    for _ in range(2):
        wy.Simulator.resumed(path).record(path, tmp_path / "a.usdc", seconds=0.05, after=path)
    assert wy.Trajectory.load(path) == film and recorded(tmp_path / "a.usdc") == len(film)
    sim = wy.Simulator.resumed(path)
    for options, message in (
        ({"fps": 25}, r"fps = 25, must be 24 as in .*a\.npz"),
        ({"fps": 24, "steps": 1, "seconds": 1}, "must be one of them"),
    ):
        with pytest.raises(wy.InputError, match=message):
            sim.record(path, after=path, **{"seconds": 0.1, **options})
    sim.run(1)
    with pytest.raises(wy.InputError, match="ends after 150 steps, the simulator is after 151"):
        sim.record(path, seconds=0.1, after=path)
    with pytest.raises(wy.InputError, match="is of another scene"):
        wy.Simulator(scene(wind=None)).record(path, seconds=0.1, after=path)
    with pytest.raises(wy.InputError, match=r"has steps of 0\.001 s, must be 0\.002"):
        wy.Simulator(scene(), step=2e-3).record(path, seconds=0.1, after=path)
    assert wy.Trajectory.load(path) == film


@pytest.mark.parametrize("ending", [".npz", ".h5"])
def test_a_recording_is_not_lost_while_it_is_copied(tmp_path, monkeypatch, ending):
    """Stopped before all of the frames of before are in the new file: the old one stays."""
    path = tmp_path / f"a{ending}"
    simulator().record(path, steps=9)
    before, sim = path.read_bytes(), wy.Simulator.resumed(path)
    stream = recordings.stream

    def stopping(path):
        for k, frame in enumerate(stream(path)):
            if k == 5:
                raise _Stop
            yield frame

    monkeypatch.setattr(recordings, "stream", stopping)
    with pytest.raises(_Stop):
        sim.record(path, tmp_path / "a.usdc", steps=3, after=path)
    assert path.read_bytes() == before and os.listdir(tmp_path) == [path.name]
    monkeypatch.setattr(recordings, "stream", stream)
    assert sim.record(path, steps=3, after=path) == 13


def test_steps_that_follow_their_error_go_on_too(tmp_path):
    """By the size of the last part, which a recording has."""
    options = {"step": 0.01, "step_error": 0.05}
    whole = simulator(**options).run(12)
    sim = simulator(**options)
    sim.record(tmp_path / "a.npz", steps=6)
    assert sim.substepping.next_size != 1.0
    again = wy.Simulator.resumed(tmp_path / "a.npz")
    assert again.step_error == 0.05 and again.run(6).joined(again.run(0)) == whole[6:]


def test_what_resumed_takes():
    trajectory = simulator(integrator="linear", step=5e-4, energy_watch=False).run(3)
    sim = wy.Simulator.resumed(trajectory)
    assert sim.integrator.name == "linear" and sim.step_size == 5e-4 and sim.steps_done == 3
    assert wy.Simulator.resumed(trajectory, integrator="sdirk2").integrator.name == "sdirk2"
    with pytest.raises(wy.InputError, match="has no scene to go on with"):
        wy.Simulator.resumed(dataclasses.replace(trajectory, scene=None))
    with pytest.raises(wy.InputError, match="there is no such file"):
        wy.Simulator.resumed("nowhere.npz")


def test_a_step_that_fails_leaves_the_frames_before_it(tmp_path, monkeypatch):
    a_step_at_a_time(monkeypatch)
    run = wy.Simulator.run_chunk

    def storm(sim, steps):
        if sim.steps_done == 7:
            put(sim, "wind_velocity", np.inf)
        return run(sim, steps)

    monkeypatch.setattr(wy.Simulator, "run_chunk", storm)
    paths = [tmp_path / f"a{ending}" for ending in ENDINGS]
    sim = simulator()
    with pytest.raises(wy.SimulationError) as failure:
        sim.record(*paths, steps=20, fps=400)
    assert failure.value.step == 8 and len(failure.value.trajectory) == 1 and sim.steps_done == 7
    assert failure.value.trajectory[-1] == sim.state
    assert [recorded(path) for path in paths] == [3, 3, 3]
    assert wy.Trajectory.load(paths[0]).end.steps_done == 7
    sim = simulator()
    with pytest.raises(wy.SimulationError) as failure:
        sim.run(20, fps=400)
    assert len(failure.value.trajectory) == 3 and failure.value.trajectory == sim.trajectory
    assert failure.value.trajectory.end.steps_done == 7


def test_an_interrupted_run_in_memory_has_its_frames(monkeypatch):
    film = simulator().run(60, fps=24)
    with pytest.MonkeyPatch.context() as patch:
        stopped_after(patch, 50)
        sim = simulator()
        with pytest.raises(_Stop):
            sim.run(60, fps=24)
    frames = sim.trajectory
    assert frames == film[:2] and frames.end.steps_done == 50 and frames.end.state == sim.state
    sim.run(1)
    assert sim.trajectory is None


def test_a_loop_that_is_left_leaves_the_simulator_where_it_is():
    sim = simulator()
    for k, _ in enumerate(sim.frames(100)):
        if k == 3:
            break
    assert sim.steps_done == 3
    assert sim.run(2)[-1] == simulator().run(5)[-1]


CODE = """
import os, signal, sys, time
import warp as wp; wp.config.log_level = wp.LOG_ERROR
import numpy as np
import warp_yarn as wy
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
sim = wy.Simulator(wy.paper.hung_cloth(rows=4, columns=4))
chunk, run = sim.chunk, wy.Simulator.run_chunk
def told(self, steps):
    if self.steps_done >= 200:
        print("on the way", flush=True)
        wy.Simulator.run_chunk = run
    return run(self, steps)
wy.Simulator.run_chunk = told
sim.record(*sys.argv[1:], steps=10**7, fps=100)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows ends processes without a signal")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT], ids=["SIGTERM", "SIGINT"])
def test_a_process_that_is_ended_leaves_whole_files(tmp_path, number):
    paths = [tmp_path / f"a{ending}" for ending in ENDINGS]
    arguments = [sys.executable, "-c", CODE, *map(str, paths)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        assert process.stdout.readline().strip() == b"on the way"
        process.send_signal(number)
        assert process.wait(60.0) != 0
    assert sorted(os.listdir(tmp_path)) == ["a.h5", "a.npz", "a.usdc"]
    [count] = {recorded(path) for path in paths}
    assert count >= 20
    npz, h5 = (wy.Trajectory.load(path) for path in paths[:2])
    assert npz == h5 and npz.end.state == h5.end.state
    sim = wy.Simulator(npz.scene)
    run = sim.run(npz.steps_done, fps=100)
    # the frame at the end may be lacking: the signal may come between a step and its frame
    assert len(run) - len(npz) in (0, 1) and run[: len(npz)] == npz
    assert sim.state == npz.end.state


@pytest.mark.slow
@pytest.mark.parametrize("ending", ENDINGS)
def test_a_full_disk_leaves_what_was_there_and_another_disk_has_room(tmp_path, small_disk, monkeypatch, ending):
    for module, name in ((recordings, "BLOCK_BYTES"), (usd, "SAVE_BYTES")):
        monkeypatch.setattr(module, name, 1 << 16)
    path, other = small_disk / f"a{ending}", tmp_path / "b.npz"
    sim = simulator()
    with pytest.raises(OSError, match=rf"No space left on device.*a{ending}|no more room") as failure:
        sim.record(path, other, steps=10**5, compression=0)
    assert failure.value.errno == errno.ENOSPC
    assert os.listdir(small_disk) == [path.name]
    count = recorded(path)
    # what was frames is a third of the disk at least: but for what is kept free, and its other uses. A frame of curves
    # has two numbers of 12 bytes for each point: 4 crossings, 2 free ends, and both ends once more, of 8 yarns
    assert count * (24 * 8 * 8 if ending == ".usdc" else 13 * 8 * CLOTH.nodes) > 1e6
    assert abs(recorded(other) - count) <= 1
    if ending != ".usdc":
        frames = wy.Trajectory.load(path)
        again = wy.Simulator(scene()).run(len(frames) - 1)
        assert frames == again
        sim = wy.Simulator.resumed(path)
        assert sim.state == frames.end.state and sim.steps_done == frames.steps_done
        assert sim.steps_done in (len(frames) - 1, len(frames))


def test_a_disk_that_is_full_from_the_beginning(small_disk):
    (small_disk / "filler").write_bytes(bytes(3 << 20))
    sim = simulator()
    for ending in ENDINGS:
        with pytest.raises(OSError, match="No space left"):
            sim.record(small_disk / f"a{ending}", steps=3)
    assert sim.steps_done == 0 and os.listdir(small_disk) == ["filler"]


def test_signals_wait_for_a_frame_to_be_written():
    came = []
    before = signal.signal(signal.SIGINT, lambda *_: came.append(1))
    try:
        with files.deferred():
            os.kill(os.getpid(), signal.SIGINT)
            for _ in range(1000):
                assert not came
        assert came == [1]
        with pytest.raises(ZeroDivisionError), files.deferred():
            os.kill(os.getpid(), signal.SIGINT)
            raise ZeroDivisionError
        assert came == [1, 1]
    finally:
        signal.signal(signal.SIGINT, before)
