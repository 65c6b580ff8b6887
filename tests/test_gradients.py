"""Gradients of whole runs against central differences, for every input that a run takes."""

import inspect
import io
import subprocess
import sys
import warnings
from collections.abc import Callable

import numpy as np
import pytest
import torch
import torch.utils.checkpoint
import warp as wp
from inputs import EXACT, GROUPS, YARNS, cloth, gradcheck, jittered, scaled, scene_for
from richardson import richardson

import warp_yarn as wy
import warp_yarn.torch as wt
from warp_yarn.device import declared
from warp_yarn.gradients.inputs import NUMBERS, VECTORS

FEW = ("materials", "initial state")
MARKED_GROUPS = [group if group in FEW else pytest.param(group, marks=pytest.mark.slow) for group in GROUPS]


@pytest.mark.parametrize("steps", [1, pytest.param(5, marks=pytest.mark.slow)])
@pytest.mark.parametrize("group", MARKED_GROUPS)
def test_gradcheck(group: str, steps: int) -> None:
    rollout = wt.Rollout(scene_for(group, steps), steps, frames=[steps], integrator="linear", tolerance=EXACT)
    fixed = jittered(rollout.scene.cloth)
    if group == "initial state":
        del fixed["anchor"]
    assert gradcheck(*scaled(rollout, GROUPS[group], fixed))


@pytest.mark.parametrize("steps", [1, pytest.param(5, marks=pytest.mark.slow)])
def test_gradcheck_exact_pins(steps: int) -> None:
    rollout = wt.Rollout(
        scene_for("exact pins", steps, stiffness=None), steps, frames=[steps], integrator="linear", tolerance=EXACT
    )
    function, inputs = scaled(rollout, ("pin_path", "stretch", "position"), jittered(rollout.scene.cloth))
    assert gradcheck(function, inputs)


@pytest.mark.slow
def test_gradcheck_locked() -> None:
    rollout = wt.Rollout(scene_for("locked", 3, sliding=False), 3, frames=[3], integrator="linear", tolerance=EXACT)
    fixed = jittered(rollout.scene.cloth, sliding=False)
    names = ("density", "stretch", "bend", "shear", "wind_velocity", "position", "velocity", "euler")
    function, inputs = scaled(rollout, names, fixed)
    assert gradcheck(function, inputs)


def hung(friction: float, friction_damping: float, steps: int = 50) -> tuple[wt.Rollout, dict[str, torch.Tensor]]:
    """The hung 6 × 6 twill, and every number of it."""
    fabric = cloth(6, 6, "twill", friction=friction, friction_damping=friction_damping)
    scene = wy.Scene(fabric, wind=wy.Wind(velocity=(0.0, 5.0, 0.0)), pins=fabric.corners("top"))
    rollout = wt.Rollout(scene, steps, integrator="linear", tolerance=EXACT)
    values = {name: rollout.defaults[name] for name in (*NUMBERS, *VECTORS) if name in rollout.inputs}
    for name in ("density", "stretch", "bend"):
        values[name] = torch.tensor([getattr(yarn, name) for yarn in YARNS], dtype=torch.float64)
    return rollout, values


OF_SLIDING = ("friction", "friction_stiffness", "friction_damping", "friction_sharpness", "parallel_stiffness")


@pytest.mark.slow
@pytest.mark.parametrize("slippery", [False, True], ids=["the paper's cloth", "a slippery cloth"])
def test_every_parameter_of_the_hung_cloth(slippery: bool) -> None:
    # On the paper's cloth sliding moves positions by less than differences can resolve, so what rules sliding is
    # differentiated where yarns slide farther, and the rest where no crossing passes friction's kinks. After more
    # than 15 steps the slippery one passes them, and differences by friction agree with themselves less and less.
    rollout, values = hung(0.5, 0.1, 15) if slippery else hung(0.5, 1000.0)
    names = [name for name in values if (name in OF_SLIDING) == slippery]
    weights = torch.randn(rollout.steps + 1, 36, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    rest = torch.tensor(rollout.scene.cloth.position)

    def loss(inputs: dict[str, torch.Tensor]) -> torch.Tensor:
        return (weights * (rollout(**inputs).position - rest)).sum() / 1e-3

    inputs = {name: values[name].clone().requires_grad_() for name in names}
    loss(inputs).backward()
    for name in names:
        for k in range(values[name].numel()):

            def along(x: float, name: str = name, k: int = k) -> float:
                moved = values[name].clone()
                moved.reshape(-1)[k] = x
                with torch.no_grad():
                    return float(loss({name: moved}))

            x = float(values[name].reshape(-1)[k])
            expected, error = richardson(along, x, abs(x) or 1.0)
            found = float(inputs[name].grad.reshape(-1)[k])
            # what the issue asks for; the differences agree with themselves to as much
            assert error < 1e-6 * abs(expected), (name, k)
            assert found == pytest.approx(expected, rel=1e-6, abs=0.0), (name, k)


def test_gradient_error_follows_the_solver_tolerance() -> None:
    exact, values = hung(0.5, 1000.0)
    gradients = {}
    for tolerance in (1e-4, 1e-8, EXACT):
        rollout = wt.Rollout(exact.scene, 10, tolerance=tolerance)
        stretch = values["stretch"].clone().requires_grad_()
        rollout(stretch=stretch).position[-1].pow(2).sum().backward()
        gradients[tolerance] = stretch.grad
    for tolerance in (1e-4, 1e-8):
        error = float((gradients[tolerance] / gradients[EXACT] - 1.0).abs().max())
        # the tolerance bounds the energy norm of a step's error; what ten steps make of it was seen to be 100 times it
        assert error < 300.0 * tolerance


@pytest.mark.slow
@pytest.mark.parametrize("at_limit", [False, True], ids=["relaxed", "friction at its limit"])
def test_state_of_rest_has_finite_and_right_gradients(at_limit: bool) -> None:
    fabric = cloth(5, 5, pose="flat", friction_damping=0.1)
    still = wy.Wind(velocity=(0.0, 0.0, 0.0))
    scene = wy.Scene(fabric, gravity=None, wind=still, pins=fabric.corners())
    rollout = wt.Rollout(scene, 3, frames=[3], integrator="linear", tolerance=EXACT)
    fixed = {}
    if at_limit:
        # k_f |δ| = μF_n, from the force with which bent yarns press on each other
        _, contact_force = rollout.simulator.contact()
        crossing = fabric.topology.is_crossing != 0
        assert contact_force[crossing].min() > 0.0
        reach = fabric.friction * contact_force / fabric.friction_stiffness
        fixed["anchor"] = torch.as_tensor(fabric.euler - reach[:, None])
    names = ("density", "stretch", "bend", "shear", "friction", "parallel_stiffness", "wind_velocity", "wind_drag")
    assert gradcheck(*scaled(rollout, names, fixed))


# -- how a run is kept ------------------------------------------------------------------------------------------------


def gradient_of(rollout: wt.Rollout) -> tuple[torch.Tensor, wt.Frames]:
    stretch = torch.tensor([5.0e5, 1.7e5], dtype=torch.float64, requires_grad=True)
    frames = rollout(stretch=stretch, **jittered(rollout.scene.cloth))
    last = frames.position[-1] / 1e-3
    (last.pow(2).sum() + (frames.euler[0] / 1e-3).sum()).backward()
    return stretch.grad, frames


@pytest.mark.parametrize("every", [2, 3, 7, 20])
def test_checkpoints_change_nothing(every: int) -> None:
    scene = scene_for("plain", 7)
    expected, frames = gradient_of(wt.Rollout(scene, 7))
    found, checkpointed = gradient_of(wt.Rollout(scene, 7, checkpoint_every=every))
    # the same operations in the same order: the same bits
    assert torch.equal(found, expected)
    assert all(torch.equal(a, b) for a, b in zip(frames, checkpointed, strict=True))


@pytest.mark.parametrize("every", [1, 3])
def test_chosen_frames_are_those_of_the_whole_run(every: int) -> None:
    scene = scene_for("plain", 7)
    chosen = [0, 2, 3, 6]
    part = wt.Rollout(scene, 7, frames=chosen, checkpoint_every=every)
    entire = wt.Rollout(scene, 7)
    gradients = []
    for rollout, pick in ((part, slice(None)), (entire, chosen)):
        inputs = {name: value.requires_grad_() for name, value in jittered(scene.cloth).items()}
        frames = rollout(**inputs)
        (frames.position[pick] * 1e3).pow(2).sum().backward()
        gradients.append(torch.cat([value.grad.reshape(-1) for value in inputs.values()]))
        assert len(frames.position) == (4 if rollout is part else 8)
    assert torch.equal(*gradients)


def test_run_is_the_simulator_s() -> None:
    scene = scene_for("forces", 5)
    tolerances = {"tolerance": 1e-8, "newton_tolerance": 1e-8}
    frames = wt.Rollout(scene, 70, **tolerances)()
    trajectory = wy.Simulator(scene, **tolerances).run(70)
    assert np.array_equal(frames.position.numpy(), trajectory.position)
    assert np.array_equal(frames.euler.numpy(), trajectory.euler)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("method", ["linear", "sdirk2"])
def test_large_arrays_are_cleared_beside_the_tape(monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    """By a kernel of ours, where small ones are by Warp: the gradient is the same, and Warp has nothing to warn of."""
    gradients = []
    for least in (1 << 40, 64):
        monkeypatch.setattr(declared, "LARGE", least)
        rollout = wt.Rollout(scene_for("plain", 2), 2, integrator=method)
        shear = rollout.defaults["shear"].clone().requires_grad_()
        rollout(shear=shear).position[-1].square().sum().backward()
        gradients.append(shear.grad)
    assert torch.equal(*gradients) and gradients[0].abs().min() > 0.0


def test_two_runs_in_one_loss() -> None:
    rollout = wt.Rollout(scene_for("plain", 3), 3)
    values = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (900.0, 1100.0)]
    separate = []
    for value in values:
        (gradient,) = torch.autograd.grad((rollout(shear=value).position[-1] * 1e3).pow(2).sum(), value)
        separate.append(gradient)
    both = sum((rollout(shear=value).position[-1] * 1e3).pow(2).sum() for value in values)
    assert torch.equal(torch.stack(torch.autograd.grad(both, values)), torch.stack(separate))


@pytest.mark.parametrize("reentrant", [True, False])
def test_torch_s_own_checkpoints(reentrant: bool) -> None:
    rollout = wt.Rollout(scene_for("plain", 3), 3)
    shear = torch.tensor(900.0, dtype=torch.float64, requires_grad=True)

    def loss(shear: torch.Tensor) -> torch.Tensor:
        return (rollout(shear=shear).position[-1] * 1e3).pow(2).sum()

    (expected,) = torch.autograd.grad(loss(shear), shear)
    torch.utils.checkpoint.checkpoint(loss, shear, use_reentrant=reentrant).backward()
    assert torch.equal(shear.grad, expected)


@pytest.mark.slow
def test_torch_is_imported_when_asked_for(tmp_path) -> None:
    code = "import sys, warp_yarn as wy; assert 'torch' not in sys.modules; wy.torch.Rollout"
    # elsewhere than in the checkout, whose warp_yarn/ would hide the installed one
    assert subprocess.run([sys.executable, "-c", code], cwd=tmp_path).returncode == 0
    # and where it is not installed, that is an answer
    without = """
import sys, warp_yarn as wy
sys.modules["torch"] = None
assert not hasattr(wy, "torch") and getattr(wy, "torch", 1) == 1
wy.torch
"""
    failed = subprocess.run([sys.executable, "-c", without], cwd=tmp_path, capture_output=True, text=True)
    assert "AttributeError: torch is not installed, which gradients need: pip install" in failed.stderr
    with pytest.raises(AttributeError, match="no attribute 'jax'"):
        wy.jax  # noqa: B018


def test_a_forward_user_has_no_gradient_arrays() -> None:
    simulator = wy.Simulator(scene_for("plain", 1))
    simulator.run(2)
    assert all(getattr(array, "grad", None) is None for array in simulator.arrays.values())


# -- the module -------------------------------------------------------------------------------------------------------


def test_fabric_is_bounded_and_composes() -> None:
    scene = scene_for("plain", 2)
    fabric = wt.Fabric(scene, 2, learn={"density": (1e-3, 3e-3), "shear": (0.0, 2000.0)}, initial={"shear": 600.0})
    assert torch.allclose(fabric.value("density"), torch.tensor([2.0e-3, 2.5e-3], dtype=torch.float64), rtol=1e-12)
    assert fabric.value("shear").item() == pytest.approx(600.0, rel=1e-12)

    wind = torch.nn.Linear(1, 3)  # a network before it, in single precision as torch makes it
    reader = torch.nn.Linear(3, 1).double()  # and one behind it
    output = reader(fabric(wind_velocity=wind(torch.ones(1))).position[-1]).sum()
    output.backward()
    for parameter in (*fabric.parameters(), *wind.parameters(), *reader.parameters()):
        assert parameter.grad is not None and bool(torch.isfinite(parameter.grad).all())
    assert wind.weight.grad.dtype == torch.float32

    optimizer = torch.optim.SGD(fabric.parameters(), lr=1e12)
    optimizer.step()
    for name, (low, high) in fabric.ranges.items():
        assert bool(((fabric.value(name) >= low) & (fabric.value(name) <= high)).all())

    other = wt.Fabric(scene, 2, learn={"density": (1e-3, 3e-3), "shear": (0.0, 2000.0)})
    other.load_state_dict(fabric.state_dict())
    assert all(torch.equal(other.value(name), fabric.value(name)) for name in fabric.ranges)


def test_gradient_descent_finds_a_parameter() -> None:
    scene = scene_for("plain", 10)
    fabric = wt.Fabric(scene, 10, learn={"wind_drag": (0.0, 5.0)}, initial={"wind_drag": 3.0})
    with torch.no_grad():
        target = fabric.rollout(wind_drag=torch.tensor(1.0)).position
    optimizer = torch.optim.LBFGS(fabric.parameters(), line_search_fn="strong_wolfe", max_iter=20)

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        loss = ((fabric().position - target) / 1e-5).pow(2).mean()
        loss.backward()
        return loss

    optimizer.step(closure)
    assert fabric.value("wind_drag").item() == pytest.approx(1.0, rel=1e-4)


# -- state_dict and ranges of a Fabric --------------------------------------------------------------------------------

RANGE = {"stretch": (1e5, 1e6)}


def test_a_state_dict_keeps_physical_values_in_other_ranges() -> None:
    scene = scene_for("plain", 1)
    trained = wt.Fabric(scene, 1, learn=RANGE, initial={"stretch": [5e5, 2e5]})
    buffer = io.BytesIO()
    torch.save(trained.state_dict(), buffer)
    buffer.seek(0)
    saved = torch.load(buffer, weights_only=True)
    other = wt.Fabric(scene, 1, learn={"stretch": (0.0, 6e5), "shear": (0.0, 1e5)})
    other.load_state_dict({**saved, "y.shear": torch.tensor(0.0), "_extra_state": {**RANGE, "shear": (0.0, 1e4)}})
    assert torch.allclose(other.value("stretch"), torch.tensor([5e5, 2e5], dtype=torch.float64), rtol=1e-12, atol=0.0)
    assert other.value("shear").item() == pytest.approx(5000.0, rel=1e-12)
    assert other.ranges == {"stretch": (0.0, 6e5), "shear": (0.0, 1e5)}
    # within a larger module, and by assignment; the given dict is left as it was
    model = torch.nn.Sequential(wt.Fabric(scene, 1, learn={"stretch": (0.0, 6e5)}))
    inside = {f"0.{name}": value for name, value in saved.items()}
    model.load_state_dict(inside, assign=True)
    assert torch.allclose(model[0].value("stretch"), trained.value("stretch"), rtol=1e-12, atol=0.0)
    assert torch.equal(inside["0.y.stretch"], saved["y.stretch"])
    # the same ranges: the same bits
    same = wt.Fabric(scene, 1, learn=RANGE)
    same.load_state_dict(saved)
    assert torch.equal(same.y["stretch"], trained.y["stretch"])


@pytest.mark.parametrize("strict", [True, False])
def test_a_state_dict_whose_values_cannot_be_kept_is_refused(strict: bool) -> None:
    scene = scene_for("plain", 1)
    saved = wt.Fabric(scene, 1, learn=RANGE).state_dict()
    narrow = wt.Fabric(scene, 1, learn={"stretch": (1.5e5, 5.1e5)})
    before = narrow.value("stretch").clone()
    with pytest.raises(wy.InputError, match="strictly between 150000 and 510000"):
        wide = wt.Fabric(scene, 1, learn=RANGE, initial={"stretch": [9e5, 2e5]})
        narrow.load_state_dict(wide.state_dict(), strict=strict)
    without = {name: value for name, value in saved.items() if name != "_extra_state"}
    for bad in (without, {**saved, "_extra_state": {"shear": (0.0, 1.0)}}):
        with pytest.raises(wy.InputError, match="no range of 'stretch'"):
            narrow.load_state_dict(bad, strict=strict)
    for pair in ((6e5, 1e5), (0.0, float("inf")), "ab", 1.0):
        with pytest.raises(wy.InputError, match=r"learn\['stretch'\]"):
            narrow.load_state_dict({**saved, "_extra_state": {"stretch": pair}}, strict=strict)
    assert torch.equal(narrow.value("stretch"), before)


def test_a_fabric_starts_from_the_scene_s_own_digits() -> None:
    fabric = wt.Fabric(scene_for("plain", 1), 1, learn={"density": (1e-3, 3e-3), "anchor": (-1.0, 1.0)})
    assert fabric.value("density").tolist() == pytest.approx([2.0e-3, 2.5e-3], rel=1e-14)
    assert torch.allclose(fabric.value("anchor"), fabric.rollout.defaults["euler"], rtol=0.0, atol=1e-15)


# -- what is refused --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        ({"spacing": torch.tensor(1e-3)}, "is no input of this scene.*inputs are"),
        ({"forces": torch.zeros(1, 1, 3)}, "is no input of this scene"),
        ({"shear": torch.zeros(2)}, r"shear has shape \(2,\), must be \(\)"),
        ({"stretch": torch.tensor([5e5, float("nan")])}, "stretch is not finite"),
        ({"stretch": torch.ones(2), "yarn_stretch": torch.ones(9)}, "both given"),
        ({"stretch": torch.tensor([5e5, -1.0])}, r"stretch\[1\] = -1\.0, must be finite and at least 0"),
        ({"yarn_density": np.arange(9)}, r"yarn_density\[0\] = 0\.0, must be finite and above 0"),
        ({"gravity": torch.ones(3, dtype=torch.complex128)}, "complex.*real"),
        ({"gravity": [1j, 0, 0]}, "real numbers"),
        ({"gravity": torch.ones(3).to_sparse()}, "dense"),
        ({"gravity": "down"}, "gravity must be a tensor"),
        ({"gravity": None}, "gravity must be a tensor"),
        ({"gravity": [1, [2], 3]}, "gravity must be a tensor"),
        # as an array it would lose its gradient
        ({"gravity": [torch.ones((), requires_grad=True)] * 3}, "gravity must be a tensor.*requires grad"),
        ({"steps_done": -1}, "steps_done = -1"),
        ({"steps_done": 2**31 - 1}, "steps_done.*must be at most 2147483646"),
        ({"state": 5}, "state = 5, must be a State"),
        ({"state": wy.Simulator(scene_for("plain", 1)).state, "anchor": torch.zeros(20, 2)}, "state and anchor"),
    ],
)
def test_bad_inputs(inputs: dict[str, torch.Tensor], message: str) -> None:
    with pytest.raises(wy.InputError, match=message):
        wt.Rollout(scene_for("plain", 1), 1)(**inputs)


def made_with(name: str, value: float) -> None:
    """The same input where it is no tensor."""
    yarn, pinned = {"density": 2e-3, "stretch": 5e5, "bend": 1.4e-4}, cloth()
    if name in yarn:
        wy.Yarn(**{**yarn, name: value})
    elif name.startswith("wind_"):
        wy.Wind(velocity=(0.0, 5.0, 0.0), **{name.removeprefix("wind_"): value})
    elif name in inspect.signature(wy.Scene).parameters:
        wy.Scene(pinned, pins=[0], **{name: value})
    else:
        cloth(**{name: value})


@pytest.mark.parametrize("name", ["density", "stretch", "bend", *(name for name in NUMBERS if "contact" not in name)])
@pytest.mark.parametrize("value", [-1e-4, -0.0, 0.0, 1e-3, float("inf")])
def test_tensors_have_the_ranges_of_numbers(name: str, value: float) -> None:
    scene = scene_for("plain", 1)
    if name == "seam_stiffness":
        scene = scene.replace(seams=[[0, 19]])
    rollout = wt.Rollout(scene, 1, integrator="linear")
    allowed = True
    try:
        made_with(name, value)
    except wy.InputError:
        allowed = False
    tensor = torch.full(rollout.inputs[name], value, dtype=torch.float64)
    try:
        rollout(**{name: tensor})
    except wy.InputError:
        assert not allowed
    except wy.SimulationError:  # such yarns cannot be simulated, which is another thing
        assert allowed
    else:
        assert allowed


@pytest.mark.parametrize(
    "frames", [[], [3, 2], [0, 9], [-1], [1.5, 2.7], [True, False, True], 5, "1", [[1, 2]], [0, 0], np.uint8([2, 1])]
)
def test_bad_frames(frames: list[int]) -> None:
    with pytest.raises(wy.InputError, match="frames"):
        wt.Rollout(scene_for("plain", 1), 5, frames=frames)


@pytest.mark.parametrize("options", [{"chunk": 3}, {"differentiable": False}])
def test_options_that_a_rollout_settles_itself(options: dict) -> None:
    with pytest.raises(wy.InputError, match="checkpoint_every"):
        wt.Rollout(scene_for("plain", 1), 5, **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"learn": {"spacing": (0.0, 1.0)}}, "learn names 'spacing'"),
        ({"learn": {"shear": (1.0, 1.0)}}, "must be above"),
        ({"learn": {"shear": (0.0, 500.0)}}, "strictly between 0 and 500"),
        ({"learn": {"friction": (-1.0, 1.0)}}, r"learn\['friction'\]\[0\] = -1\.0.*at least 0"),
        ({"learn": {"shear": (0.0, float("inf"))}}, r"learn\['shear'\]\[1\] = inf.*finite"),
        ({"learn": {"shear": 5.0}}, r"learn\['shear'\] = 5\.0, must be two numbers"),
        ({"learn": ["shear"]}, "must be a dict"),
        ({"learn": {"shear": (0.0, 2000.0)}, "initial": {"strech": 5e5}}, "initial = 'strech', must be one of shear"),
        ({"learn": {"shear": (0.0, 2000.0)}, "initial": {"bend": 1e-4}}, "initial = 'bend', must be one of shear"),
        ({"learn": {"shear": (0.0, 2000.0)}, "initial": {"shear": "stiff"}}, "shear must be a tensor"),
        ({"learn": {"shear": (0.0, 2000.0)}, "initial": {"shear": 1j}}, "shear must be a tensor.*real"),
        ({"learn": {"shear": (0.0, 2000.0)}, "initial": {"shear": [1.0, 2.0]}}, r"shear has shape \(2,\)"),
        ({"learn": {"shear": (0.0, 2000.0)}, "initial": {"shear": float("nan")}}, "strictly between"),
        ({"learn": {"shear": (0.0, 2000.0)}, "initial": 1000.0}, "initial = 1000.0, must be a dict"),
    ],
)
def test_bad_fabric(options: dict, message: str) -> None:
    with pytest.raises(wy.InputError, match=message):
        wt.Fabric(scene_for("plain", 1), 1, **options)


def test_a_fabric_refuses_names_that_it_does_not_learn() -> None:
    fabric = wt.Fabric(scene_for("plain", 1), 1, learn={"shear": (0.0, 2000.0)})
    for call in (lambda: fabric.set("stretch", 1.0), lambda: fabric.value("sheer")):
        with pytest.raises(wy.InputError, match="must be one of shear"):
            call()
    with pytest.raises(wy.InputError, match="shear is learned"):
        fabric(shear=torch.tensor(1.0))


def of_stretch(rollout: wt.Rollout) -> Callable[[torch.Tensor], torch.Tensor]:
    """A loss that is linear in the frames: their gradients do not depend on anything."""
    return lambda stretch: rollout(stretch=1e5 * stretch).position[-1].sum()


def test_second_derivatives_are_refused() -> None:
    loss = of_stretch(wt.Rollout(scene_for("plain", 2), 2))
    x = torch.tensor([5.0, 1.7], dtype=torch.float64)
    weights = torch.randn(2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    functional = torch.autograd.functional
    asked = {
        "hessian": lambda: functional.hessian(lambda d: loss(d) + d.square().sum(), x),
        "hvp": lambda: functional.hvp(loss, x, weights),
        "jvp": lambda: functional.jvp(loss, x, weights),  # by the gradient of a gradient
        "of a square": lambda: functional.hessian(lambda d: loss(d).square(), x),
    }
    for name, call in asked.items():
        with pytest.raises(wy.GradientError, match="no second derivatives") as error:
            call()
        assert error.value.step is None, name
    # a penalty on the gradient: the first one is right, what comes of it is refused
    leaf = x.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(leaf), leaf, create_graph=True)
    (expected,) = torch.autograd.grad(loss(leaf), leaf)
    assert torch.equal(gradient, expected)
    with pytest.raises(wy.GradientError, match="no second derivatives"):
        gradient.square().sum().backward()


def test_transforms_are_refused() -> None:
    rollout = wt.Rollout(scene_for("plain", 2), 2)
    loss, x = of_stretch(rollout), torch.tensor([5.0, 1.7], dtype=torch.float64)
    frames_of = lambda d: rollout(stretch=1e5 * d).position[-1, 3]  # noqa: E731
    for call in (
        lambda: torch.func.grad(loss)(x),
        lambda: torch.func.vmap(loss)(torch.stack([x, x])),
        lambda: torch.func.jvp(loss, (x,), (x,)),
        lambda: torch.func.jacrev(loss)(x),
        # gradients of several losses at once
        lambda: torch.autograd.functional.jacobian(frames_of, x, vectorize=True),
    ):
        with pytest.raises(wy.InputError, match=r"torch\.func"):
            call()
    with warnings.catch_warnings(), pytest.raises(wy.InputError, match=r"torch\.jit"):
        warnings.simplefilter("ignore")  # torch.jit is deprecated
        torch.jit.trace(loss, x)
    with torch.autograd.forward_ad.dual_level(), pytest.raises(wy.GradientError, match="no forward mode"):
        loss(torch.autograd.forward_ad.make_dual(x.clone().requires_grad_(), x))
    # one by one they are right
    rows = torch.autograd.functional.jacobian(frames_of, x)
    leaf = x.clone().requires_grad_()
    (first,) = torch.autograd.grad(frames_of(leaf)[0], leaf)
    assert torch.equal(rows[0], first)


def test_recording_by_warp_is_refused() -> None:
    rollout = wt.Rollout(scene_for("plain", 2), 2)
    x = torch.tensor([5.0, 1.7], dtype=torch.float64, requires_grad=True)

    def value(rollout: wt.Rollout) -> list:
        output = of_stretch(rollout)(x)
        return [output.item(), *torch.autograd.grad(output, x)[0].tolist()]

    expected, others = value(rollout), of_stretch(rollout)(x)
    fresh = wt.Rollout(rollout.scene, 2)
    for recording, what in ((wp.Tape, "Tape"), (lambda: wp.ScopedCapture(device="cpu"), "capture")):
        for call in (
            lambda: rollout(),
            lambda: fresh(stretch=1e5 * x),
            lambda: torch.autograd.grad(others, x, retain_graph=True),
        ):
            with recording(), pytest.raises(wy.InputError, match=what):
                call()
        assert value(fresh) == expected and value(rollout) == expected


def test_forward_failure_raises_the_forward_error() -> None:
    rollout = wt.Rollout(scene_for("plain", 3), 3)
    state = jittered(rollout.scene.cloth)
    state["velocity"] = state["velocity"] * 1e300
    with pytest.raises(wy.SimulationError, match="step 1"):
        rollout(**state)
    # and the rollout is still good for another call
    assert bool(torch.isfinite(rollout().position).all())


def test_gradient_that_is_not_finite_names_step_and_term() -> None:
    rollout = wt.Rollout(scene_for("plain", 3), 3)
    stretch = torch.tensor([5.0e5, 1.7e5], dtype=torch.float64, requires_grad=True)
    frames = rollout(stretch=stretch)
    with pytest.raises(wy.GradientError, match=r"step 2.*not finite") as error:
        (frames.position[2] * float("inf")).sum().backward()
    assert error.value.step == 2
