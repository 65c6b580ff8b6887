"""Bad input: every refusal names the argument, its value and what is allowed."""

import ctypes
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import warp_yarn as wy

YARN = wy.paper.YARNS[1]
PLAIN = wy.Weave.plain(rows=4, columns=4)
CLOTH = wy.Cloth(PLAIN, yarns=[YARN])
SCENE = wy.Scene(CLOTH)
NAN = float("nan")


def state(**replaced: object) -> wy.State:
    n = CLOTH.nodes
    arrays = {
        "position": CLOTH.position.copy(),
        "euler": CLOTH.euler,
        "velocity": np.zeros((n, 3)),
        "euler_velocity": np.zeros((n, 2)),
    }
    return wy.State(**{**arrays, **replaced})


def swapped() -> np.ndarray:
    """(u, v) with two crossings of the warp yarn in row 1 out of order."""
    euler = CLOTH.euler.copy()
    euler[5, 0], euler[6, 0] = euler[6, 0], euler[5, 0]
    return euler


def with_nan() -> np.ndarray:
    position = CLOTH.position.copy()
    position[7, 2] = NAN
    return position


def run_after(steps: int) -> None:
    simulator = wy.Simulator(SCENE)
    simulator.steps_done = steps
    simulator.run(2)


REFUSED: dict[str, tuple[Callable, str]] = {
    "density": (lambda: wy.Yarn(density=0.0, stretch=1.0, bend=1.0), r"density = 0\.0.*above 0"),
    "stretch": (lambda: wy.Yarn(density=1.0, stretch=-1.0, bend=1.0), r"stretch = -1\.0.*at least 0"),
    "bend": (lambda: wy.Yarn(density=1.0, stretch=1.0, bend=NAN), r"bend = nan.*finite"),
    "not a number": (lambda: wy.Yarn(density="thick", stretch=1.0, bend=1.0), "density = 'thick'"),
    "color": (lambda: wy.Yarn(density=1, stretch=1, bend=1, color=(2, 0, 0)), r"color.*from 0 to 1"),
    "rows": (lambda: wy.Weave.plain(rows=2, columns=5), r"rows = 2.*at least 3"),
    "columns": (lambda: wy.Weave.twill(rows=5, columns=2.5), r"columns = 2\.5.*whole"),
    "draft size": (lambda: wy.Weave(np.zeros((3, 2))), r"3 × 2.*at least 3 × 3"),
    "draft values": (lambda: wy.Weave(np.full((4, 4), 2)), "0 and 1"),
    "draft text": (lambda: wy.Weave("plain"), "0 and 1"),
    "weave": (lambda: wy.Cloth("plain", yarns=[YARN]), r"weave = 'plain'.*must be a Weave"),
    "no yarns": (lambda: wy.Cloth(PLAIN, yarns=[]), "at least one Yarn"),
    "warp length": (lambda: wy.Cloth(PLAIN, yarns=[YARN], warp=[0]), r"warp.*1 yarns, must be of 4"),
    "warp material": (lambda: wy.Cloth(PLAIN, yarns=[YARN], warp=[0, 0, 1, 0]), r"warp names material 1.*0 to 0"),
    "spacing": (lambda: wy.Cloth(PLAIN, yarns=[YARN], spacing=0.0), r"spacing = 0\.0.*above 0"),
    "radius": (lambda: wy.Cloth(PLAIN, yarns=[YARN], radius=float("inf")), r"radius = inf.*finite"),
    "thick yarns": (lambda: wy.Cloth(PLAIN, yarns=[YARN], radius=6e-4), r"radius = 0\.0006.*half the spacing"),
    "pose": (lambda: wy.Cloth(PLAIN, yarns=[YARN], pose="diagonal"), r"pose = 'diagonal'.*upright, flat"),
    "pose shape": (lambda: wy.Cloth(PLAIN, yarns=[YARN], pose=np.zeros((3, 3))), r"pose has shape.*\(16, 3\)"),
    "corner": (lambda: CLOTH.corners("left"), "which = 'left'"),
    "node": (lambda: CLOTH.node(4, 0), "outside a cloth of 4 × 4"),
    "pin": (lambda: wy.Scene(CLOTH, pins=[16]), r"pins names node 16.*0 to 15"),
    "pin twice": (lambda: wy.Scene(CLOTH, pins=[1, 1]), "twice"),
    "pin stiffness": (lambda: wy.Scene(CLOTH, pins=[1], pin_stiffness=0.0), r"pin_stiffness = 0\.0.*above 0"),
    "pin path": (lambda: wy.Scene(CLOTH, pins=[1], pin_path=np.zeros((3, 2, 3))), r"pin_path has shape.*\(any, 1, 3\)"),
    "wind": (lambda: wy.Wind(velocity=(0, NAN, 0)), r"wind velocity\[1\] is nan"),
    "wind type": (lambda: wy.Scene(CLOTH, wind=(0, 5, 0)), "must be a Wind"),
    "gravity": (lambda: wy.Scene(CLOTH, gravity=(0, 0)), r"gravity has shape \(2,\), must be \(3\)"),
    "force node": (lambda: wy.Scene(CLOTH, forces={99: (0, 0, 1)}), "forces names node 99"),
    "force shape": (lambda: wy.Scene(CLOTH, forces={3: (0, 0)}), r"forces\[3\] has shape"),
    "sliding": (lambda: wy.Scene(CLOTH, sliding="no"), "sliding = 'no', must be True or False"),
    "self_contact": (lambda: wy.Scene(CLOTH, self_contact=1), "self_contact = 1, must be True or False"),
    "published": (lambda: wy.Scene(CLOTH, published_scaling=None), "published_scaling = None, must be True or False"),
    "crimp_interchange": (lambda: wy.Scene(CLOTH, crimp_interchange="off"), "crimp_interchange = 'off', must be True"),
    "energy_watch": (lambda: wy.Simulator(SCENE, energy_watch="no"), "energy_watch = 'no', must be True or False"),
    "differentiable": (lambda: wy.Simulator(SCENE, differentiable=0), "differentiable = 0, must be True or False"),
    "term": (lambda: wy.Scene(CLOTH, terms=["tension"]), r"terms = 'tension'.*stretch"),
    "term of sliding": (lambda: wy.Scene(CLOTH, sliding=False, terms=["friction"]), "do not slide"),
    "term without wind": (lambda: wy.Scene(CLOTH, terms=["wind"]), "wind is None"),
    "terms text": (lambda: wy.Scene(CLOTH, terms="stretch"), "list of names"),
    "step": (lambda: wy.Simulator(SCENE, step=0.0), r"step = 0\.0.*above 0"),
    "device": (lambda: wy.Simulator(SCENE, device="tpu"), r"device = 'tpu'.*cpu"),
    "precision": (lambda: wy.Simulator(SCENE, precision="half"), r"precision = 'half'.*double, single"),
    "tolerance": (lambda: wy.Simulator(SCENE, tolerance=-1), r"tolerance = -1.*above 0"),
    "scene": (lambda: wy.Simulator(CLOTH), "must be a Scene"),
    "steps": (lambda: wy.Simulator(SCENE).run(-1), r"steps = -1.*at least 0"),
    "state shape": (lambda: wy.Simulator(SCENE).forces(state(velocity=np.ones((4, 3)))), r"has shape \(4, 3\)"),
    "state NaN": (lambda: wy.Simulator(SCENE).forces(state(position=with_nan())), r"state\.position\[7, 2\] is nan"),
    "state order": (lambda: wy.Simulator(SCENE).forces(state(euler=swapped())), r"Δs = .* between nodes 5 and 6"),
    "contact": (lambda: wy.Simulator(wy.Scene(CLOTH, terms=["stretch"])).contact(), "no contact"),
    "text density": (lambda: wy.Yarn(density="0.002", stretch=1.0, bend=1.0), r"density = '0\.002', must be a number"),
    "huge density": (lambda: wy.Yarn(density=10**400, stretch=1.0, bend=1.0), r"density = 1000.*must be a number"),
    "complex color": (lambda: wy.Yarn(density=1, stretch=1, bend=1, color=(0, 0, 1j)), "color must be an array"),
    "one yarn": (lambda: wy.Cloth(PLAIN, yarns=YARN), r"yarns = Yarn\(.*must be a list of at least one Yarn"),
    "warp number": (lambda: wy.Cloth(PLAIN, yarns=[YARN], warp=0), "warp = 0, must be the materials of 4 yarns"),
    "weft text": (lambda: wy.Cloth(PLAIN, yarns=[YARN], weft="0000"), "weft = '0000', must be the materials of 4"),
    "warp lists": (lambda: wy.Cloth(PLAIN, yarns=[YARN], warp=[[0]] * 4), "warp = .*must be a list of whole numbers"),
    "node text": (lambda: CLOTH.node("0", 0), "node .*row '0'"),
    "forces array": (lambda: wy.Scene(CLOTH, forces=np.zeros((3, 3))), "(?s)forces = .*must be a dictionary"),
    "forces text": (lambda: wy.Scene(CLOTH, forces={3: "up"}), r"forces\[3\] .*'up'"),
    "forces ragged": (lambda: wy.Scene(CLOTH, forces={3: [(0, 0, 1), (0, 1)]}), r"forces\[3\] must be an array"),
    "forces complex": (lambda: wy.Scene(CLOTH, forces={3: (0, 0, 1j)}), r"forces\[3\] must be an array of numbers"),
    "forces by text": (lambda: wy.Scene(CLOTH, forces={"3": (0, 0, 1)}), "forces = .*must be a list of whole numbers"),
    "pins ragged": (lambda: wy.Scene(CLOTH, pins=[[1, 2], [3]]), "pins = .*must be a list of whole numbers"),
    "terms number": (lambda: wy.Scene(CLOTH, terms=3), "terms = 3, must be a list of names"),
    "term unhashable": (lambda: wy.Scene(CLOTH, terms=[["stretch"]]), r"terms = \['stretch'\], must be one of"),
    "state dict": (lambda: setattr(wy.Simulator(SCENE), "state", {}), r"state = \{\}, must be a State"),
    "state to look at": (lambda: wy.Simulator(SCENE).energy({}), r"state = \{\}, must be a State"),
    "state text": (lambda: wy.Simulator(SCENE).forces(state(velocity="x")), "state.velocity must be an array"),
    "steps done": (lambda: setattr(wy.Simulator(SCENE), "steps_done", -1), "steps_done = -1, must be a whole number"),
    "steps done float": (lambda: setattr(wy.Simulator(SCENE), "steps_done", 1.5), r"steps_done = 1\.5"),
    "chunk": (lambda: wy.Simulator(SCENE, chunk=10**9), r"chunk = 1000000000, must be a whole number, from 1 to"),
    "max_iterations": (lambda: wy.Simulator(SCENE, max_iterations=2**31), "max_iterations = 2147483648, .* to 214748"),
    "frames": (lambda: wy.Simulator(SCENE).run(10**15), "steps = 10{15}, whose frames take .* GiB, more than there is"),
    "too late": (lambda: run_after(2**31 - 2), "steps = 2 after 2147483646, must end at step 2147483647 at most"),
    "recording": (lambda: wy.Trajectory.load(__file__), "not a recording"),
    "no recording": (lambda: wy.Trajectory.load("nowhere.npz"), "no such file"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_refused(case: str) -> None:
    call, message = REFUSED[case]
    with pytest.raises(wy.InputError, match=message) as error:
        call()
    assert isinstance(error.value, wy.WarpYarnError) and isinstance(error.value, ValueError)


def test_setting_a_state_refuses_sliding_where_yarns_do_not() -> None:
    rates = np.zeros((CLOTH.nodes, 2))
    rates[5] = 1.0
    with pytest.raises(wy.InputError, match="do not slide"):
        wy.Simulator(wy.Scene(CLOTH, sliding=False)).state = state(euler_velocity=rates)
    rates[0] = 1.0
    with pytest.raises(wy.InputError, match="border"):
        wy.Simulator(SCENE).state = state(euler_velocity=rates)


def test_a_step_that_is_not_finite_says_where_and_keeps_the_frames() -> None:
    velocity = np.zeros((CLOTH.nodes, 3))
    velocity[6] = 1e200
    sim = wy.Simulator(SCENE)
    sim.state = state(velocity=velocity)
    with pytest.raises(wy.SimulationError, match=r"step 1 .*node .*not finite.*in parts as small as") as error:
        sim.run(10)
    assert error.value.step == 1 and len(error.value.trajectory) == 1
    assert 0 <= error.value.node < CLOTH.nodes and error.value.term in SCENE.terms
    assert np.array_equal(sim.state.velocity, velocity)  # it stays at the last good frame


def test_errors_pass_from_process_to_process() -> None:
    velocity = np.zeros((CLOTH.nodes, 3))
    velocity[6] = 1e200
    sim = wy.Simulator(SCENE)
    sim.state = state(velocity=velocity)
    with pytest.raises(wy.SimulationError) as failure:
        sim.run(1)
    failed = failure.value
    failed.add_note("in a benchmark")
    copied = pickle.loads(pickle.dumps(failed))
    assert type(copied) is wy.SimulationError and str(copied) == str(failed)
    assert (copied.step, copied.node, copied.term) == (failed.step, failed.node, failed.term)
    assert copied.__notes__ == ["in a benchmark"]
    np.testing.assert_array_equal(copied.trajectory.position, failed.trajectory.position)
    gradient = pickle.loads(pickle.dumps(wy.GradientError("not finite", step=2, term="bending")))
    assert (type(gradient), str(gradient), gradient.step, gradient.term) == (
        wy.GradientError,
        "not finite",
        2,
        "bending",
    )


def test_crossings_that_meet_stop_the_run() -> None:
    """Two crossings of a yarn that fly at each other with nothing to keep them apart."""
    rates = np.zeros((CLOTH.nodes, 2))
    rates[5, 0], rates[6, 0] = 0.2, -0.2
    sim = wy.Simulator(wy.Scene(CLOTH, gravity=None, terms=["inertia"]), integrator="linear")
    sim.state = state(euler_velocity=rates)
    with pytest.raises(wy.SimulationError, match=r"Δs .* reached 0|gains energy") as error:
        sim.run(20)
    # 1 mm closes at 0.4 mm a step; the yarn's other crossings share the momentum, some hundredths of a millimetre
    assert error.value.step == 3 and error.value.node in (5, -1) and len(error.value.trajectory) == 3
    gaps = error.value.trajectory.euler[:, 6, 0] - error.value.trajectory.euler[:, 5, 0]
    assert gaps == pytest.approx([1e-3, 6e-4, 2e-4], abs=5e-5)
    assert len(sim.run(0)) == 1  # and it can go on from there


def test_a_solver_that_does_not_converge_stops_the_run() -> None:
    scene = wy.Scene(CLOTH, wind=wy.Wind(velocity=(0, 5, 0)))
    sim = wy.Simulator(scene, integrator="linear", max_iterations=1, tolerance=1e-12)
    with pytest.raises(wy.SimulationError, match=r"stopped after 1 iterations at a residual of .*above its tolerance"):
        sim.run(5)


def test_the_largest_numbers_are_taken() -> None:
    sim = wy.Simulator(SCENE, max_iterations=2**31 - 1)
    sim.steps_done = 2**31 - 3
    assert len(sim.run(2)) == 3 and sim.steps_done == 2**31 - 1


def test_without_torch_there_is_no_attribute(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    for name in ("warp_yarn.torch", "warp_yarn.gradients.rollout"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.delattr(wy, "torch", raising=False)
    assert not hasattr(wy, "torch") and getattr(wy, "torch", 3) == 3
    with pytest.raises(wy.InputError, match=r'pip install "\.\[torch\]".*pip install "torch"'):
        _ = wy.torch


@pytest.mark.parametrize("when", ["before Warp starts", "later"])
def test_a_kernel_cache_that_cannot_be_written_is_named(tmp_path, when) -> None:
    """A file stands where the folder should be: so it is refused to root too."""
    (tmp_path / "cache").write_text("")
    code = (
        "import warp as wp, warp_yarn as wy\n"
        f"wp.config.quiet = True; {'wp.init()' if when == 'later' else ''}\n"
        "wp.config.kernel_cache_dir = 'cache/kernels'\n"
        "sim = None\n"
        "for call in (lambda: sim.run(1), lambda: sim.energy()):\n"
        "    try:\n"
        "        sim = sim or wy.Simulator(wy.paper.hung_cloth('plain', 3, 3)); call()\n"
        "    except wy.InputError as error: print(error)\n"
    )
    ran = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=100)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.count("WARP_CACHE_PATH") == 2


CLOTH_OF_MANY = wy.paper.cloth(rows=20, columns=20)


@pytest.mark.parametrize(
    ("call", "shown"),
    [
        (lambda big: wy.write_usd("a.usdc", big), "trajectory = an array of shape (400, 3), must be a Trajectory"),
        (
            lambda big: wy.write_usd("a.usdc", wy.State(big, big, big, big)),
            "trajectory = State(400 nodes), must be a Trajectory",
        ),
        (lambda big: wy.write_usd("a.usdc", [big]), "trajectory = an object of type list"),
        (lambda big: wy.write_usd("a.usdc", "x" * 5000), "xxx…, must be a Trajectory"),
        (lambda big: wy.Simulator(big), "scene = an array of shape (400, 3), must be a Scene"),
        (lambda big: wy.Scene(CLOTH_OF_MANY, pins=big), "pins = an array of shape (400, 3), must be a list"),
        (lambda big: wy.Scene(CLOTH_OF_MANY, pins=[0] * 4000), "pins names a node twice"),
        (lambda big: wy.Yarn(density=big, stretch=1, bend=1), "density = an array of shape (400, 3), must be a number"),
    ],
)
def test_messages_print_no_arrays(call, shown, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(wy.InputError) as error:
        call(CLOTH_OF_MANY.position)
    assert shown in str(error.value) and len(str(error.value)) < 300 and "\n" not in str(error.value)


def test_more_steps_than_a_chunk_are_refused():
    simulator = wy.Simulator(wy.paper.hung_cloth(rows=3, columns=3), chunk=2)
    with pytest.raises(wy.InputError, match="steps = 3, must be a whole number, from 0 to 2"):
        simulator.run_chunk(3)


def test_warp_starts_without_a_banner():
    """And where there is no CUDA driver, without a warning of that; what else comes is not lost."""
    code = (
        "import os, sys, warp_yarn as wy\n"
        "from warp_yarn.device import start\n"
        "start.device('cpu')\n"
        "with start.without_line(b'unwanted', where=True):\n"
        "    os.write(2, b'wanted\\nunwanted line\\nalso wanted\\n')\n"
        "print('done')\n"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=100)
    assert ran.returncode == 0 and ran.stdout == "done\n"
    told = ran.stderr.splitlines()
    assert told[-2:] == ["wanted", "also wanted"]
    assert not told[:-2] or ctypes_finds_cuda()


LEVELS = {
    "nobody asks": ("", "", False, wp.LOG_WARNING),
    "asked for after the import": ("", "wp.config.log_level = wp.LOG_INFO", True, wp.LOG_INFO),
    "asked for more before": ("wp.config.log_level = wp.LOG_DEBUG", "", True, wp.LOG_DEBUG),
    "asked for less before": ("wp.config.log_level = wp.LOG_ERROR", "", False, wp.LOG_ERROR),
}


@pytest.mark.parametrize("name", LEVELS)
def test_modules_are_loaded_without_a_word_until_somebody_asks(name):
    before, after, told, level = LEVELS[name]
    code = (
        f"import warp as wp\n{before}\nimport warp_yarn as wy\n{after}\n"
        "wy.Simulator(wy.paper.hung_cloth(rows=3, columns=3)).run(1)\nprint('LEVEL', wp.config.log_level)"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert ran.returncode == 0
    assert ("Module warp_yarn" in ran.stdout + ran.stderr) == told
    if not told:
        assert len(ran.stdout.splitlines()) == 1
    assert f"LEVEL {level}" in ran.stdout


NAMES = {
    "fabric": (
        lambda: wy.fabrics.FABRICS["denym"],
        KeyError,
        "fabric = 'denym', must be one of paper, .*; near: denim",
    ),
    "fabric's attribute": (
        lambda: wy.fabrics.kevlar,
        AttributeError,
        "fabric = 'kevlar', must be .*; near: kevlar_s706",
    ),
    "nothing near": (lambda: wy.fabrics.xyz, AttributeError, "fabric = 'xyz', must be one of .* glass_7628$"),
    "weave": (lambda: wy.WEAVES["plian"], KeyError, "weave = 'plian', must be one of plain, twill, satin; near: plain"),
    "fibre": (lambda: wy.FIBRES["cottn"], KeyError, "fibre = 'cottn', must be one of cotton, .*; near: cotton"),
    "fibre of a yarn": (lambda: wy.Yarn.from_tex(20, "cottn"), ValueError, "fibre = 'cottn', must .*; near: cotton"),
}


@pytest.mark.parametrize("name", NAMES)
def test_names_that_are_not_there_tell_which_are_near(name):
    call, kind, message = NAMES[name]
    with pytest.raises(wy.InputError, match=message) as error:
        call()
    assert isinstance(error.value, kind)


def test_names_stay_a_dictionary_and_a_module():
    assert wy.fabrics.FABRICS.get("denym") is None and "denym" not in wy.fabrics.FABRICS
    assert not hasattr(wy.fabrics, "denym") and not hasattr(wy.fabrics, "__path__")
    for names in (wy.FIBRES, wy.WEAVES):
        again = pickle.loads(pickle.dumps(names))
        assert again == names and again.what == names.what


def test_what_can_be_resumed_is_told():
    told = r"must be a Trajectory or end in \.npz, \.h5, \.hdf5: .* record\(\.\.\.\)"
    for path in ("a.usdc", "film.mp4", Path("a.PNG")):
        with pytest.raises(wy.InputError, match=told):
            wy.Simulator.resumed(path)


@pytest.mark.parametrize("view", ["top", (0, 0), (0, 0, 0)])
def test_what_a_view_may_be_is_told(view, tmp_path):
    trajectory = wy.Simulator(wy.paper.hung_cloth(rows=3, columns=3)).run(1)
    with pytest.raises(wy.InputError, match=r"view .*: 3 numbers, .* such as \(0, 0, 1\) from the top"):
        wy.write_png(tmp_path / "a.png", trajectory, view=view)


def test_states_and_trajectories_are_told_in_a_line():
    trajectory = wy.Simulator(wy.paper.hung_cloth(rows=3, columns=4)).run(2)
    assert repr(trajectory[0]) == "State(12 nodes)"
    cloth = "Cloth(Weave(plain, 3 × 4), 2 yarns, spacing 0.001 m)"
    assert repr(trajectory) == f"Trajectory(3 frames of 12 nodes, 0.001 s apart, {cloth})"
    other = trajectory.cloth.replace(pose=trajectory.cloth.position + 1.0)
    both = wy.Simulator(wy.Scene([trajectory.cloth, other])).run(0)
    assert repr(both) == f"Trajectory(1 frame of 24 nodes, 0.001 s apart, Cloths({cloth}, {cloth}))"


def ctypes_finds_cuda() -> bool:
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    return True


def test_true_is_no_number():
    with pytest.raises(wy.InputError, match="density = True, must be a number"):
        wy.Yarn(density=True, stretch=1.0, bend=1.0)
