"""Hold every argument of every kernel to the one place that declares it, and every array to what is declared."""

import dataclasses
import itertools
import re
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from cases import scene
from warp_yarn.kernels import Variant, build

import warp_yarn as wy
from warp_yarn.device.declarations import FIELDS, GROUPS, LEVELS, TOPOLOGY
from warp_yarn.device.declared import Struct
from warp_yarn.device.fields import Field, known_conditions

VARIANTS = [Variant(*kind) for kind in itertools.product((wp.float64, wp.float32), (True, False), (True, False))]
VARIANTS += [dataclasses.replace(variant, general=True) for variant in VARIANTS[:4]]
STRUCTS = {"BlockMatrix", "SolverWork", "SolveReport", "NewtonControl", "StateAdjoint", "Levels"}
STRUCTS |= {"Pairs", "Obstacles", "Faces", "Crimp"}
MOST_ARGUMENTS = 16
STAND_INS = {"pin_target_path", "pin_start", "applied_force_path", "inner_tolerance", "unit", "zero", "euler_zero"}
STAND_INS |= {
    f"sample_{name}" for name in ("position", "velocity", "increment", "direction", "base_position", "solution")
}
STAND_INS |= {"sample_is_free", "sample_moves", "gravity_path", "wind_velocity_path", "origin"}
"""Arrays that kernels know by another name: path, start, tolerance, rate, stage_adjoint; as of nodes; and what the
kernel of a user's gusts takes."""


def arguments(variant: Variant) -> list[tuple[str, str, object]]:
    """List (kernel, name, type) of every argument; a struct's fields in its place."""
    result = []
    for name, kernel in build(variant).items():
        for argument in kernel.adj.args:
            if isinstance(argument.type, Struct):
                assert argument.type.cls.__name__ in STRUCTS
                result += [(name, field, var.type) for field, var in argument.type.vars.items()]
            else:
                result.append((name, argument.label, argument.type))
    return result


@pytest.mark.parametrize("variant", VARIANTS, ids=str)
def test_every_argument_is_declared(variant):
    for kernel, label, kind in arguments(variant):
        field = FIELDS.get(label.removesuffix("_grad"))
        assert field is not None, f"{kernel}: {label} is not declared"
        array = isinstance(kind, wp.array)
        assert array or field.element in ("count", "launch"), f"{kernel}: {label} is no array"
        if field.kind != "any":
            expected = field.dtype(variant)
            actual = kind.dtype if array else {int: wp.int32}.get(kind, kind)
            assert actual == expected, f"{kernel}: {label} is {actual}, declared as {expected}"


@pytest.mark.parametrize("variant", VARIANTS, ids=str)
def test_no_kernel_takes_more_than_some_arguments(variant):
    counts = {name: len(kernel.adj.args) for name, kernel in build(variant).items()}
    assert {name: count for name, count in counts.items() if count > MOST_ARGUMENTS} == {}


def test_every_declaration_is_some_kernels_argument():
    """Those that are read on the host alone have no place here."""
    used = {label.removesuffix("_grad") for _, label, _ in arguments(VARIANTS[0])}
    copied = {name for name in FIELDS if name.startswith(("loss_", "kept_", "helper_"))}
    assert set(FIELDS) - used == copied | STAND_INS


def test_groups_share_no_name():
    names = [name for group in GROUPS.values() for name in group]
    assert len(names) == len(set(names))


def test_every_condition_is_known_and_of_use():
    """One that is misspelt never holds, and its arrays are never there."""
    known = set(known_conditions(scene("plain", None, True), VARIANTS[0], []))
    device = Path(wy.__file__).parent / "device"
    asked = re.findall(r'"([^"]+)" in [\w.]*\bconditions\b', "".join(file.read_text() for file in device.glob("*.py")))
    assert len(asked) > 10
    assert {field.when for field in FIELDS.values()} | set(asked) == known


@pytest.mark.parametrize(
    ("name", "options", "sliding"),
    [
        ("twill", {"integrator": "sdirk2", "preconditioner": "multilevel", "step_error": 1e-2}, True),
        ("twill", {"integrator": "ros2", "differentiable": True}, False),
        ("twill", {"integrator": "implicit-midpoint", "precision": "single"}, True),
        ("general", {"integrator": "sdirk2", "preconditioner": "multilevel", "step_error": 1e-2}, True),
        ("general", {"integrator": "implicit-midpoint", "precision": "single"}, True),
    ],
    ids=str,
)
def test_arrays_are_as_declared(name, options, sliding):
    simulator = wy.Simulator(scene(name, None, sliding), chunk=3, **options)
    simulator.run(2)
    arrays = simulator.arrays
    rows, columns = simulator.scene.cloth.weave.flipped.shape
    nodes, crossings = rows * columns, (rows - 2) * (columns - 2)
    segments = rows * (columns - 1) + columns * (rows - 1)
    sizes = {"world": 1, "node": nodes, "segment": segments, "yarn": rows + columns, "crossing": crossings}
    sizes["frame node"] = 4 * nodes
    numbers = {"gap": 4 * nodes, "half": 3 * (rows + columns), "corner": 4 * crossings, "cloth crossing": nodes}
    sizes |= numbers if name == "general" else dict.fromkeys(numbers, 1)
    for name, array in arrays.items():
        if name == "levels":
            continue
        field = FIELDS[name]
        if field.element == "count":
            assert isinstance(array, int)
        elif array is None:
            assert field.when not in arrays.conditions
        else:
            assert array.dtype == field.dtype(arrays.variant)
            if field.element in sizes:
                assert array.shape == (field.count * sizes[field.element],)
    for name in TOPOLOGY:
        assert name in arrays
    if "levels" in arrays:
        for name, field in LEVELS.items():
            if field.element != "count":
                count = field.count * arrays.sizes[field.element]
                assert getattr(arrays["levels"], name).shape == (count,), name


def test_what_is_not_declared_cannot_be_set():
    arrays = wy.Simulator(scene("plain", ("stretch",))).arrays
    with pytest.raises(KeyError, match="positoin"):
        arrays["positoin"] = arrays["position"]
    with pytest.raises(KeyError, match="positoin"):
        arrays.update(positoin=arrays["position"])
    with pytest.raises(KeyError, match="positoin"):
        arrays.setdefault("positoin", arrays["position"])
    with pytest.raises(TypeError, match="position"):
        arrays["position"] = arrays["euler"]
    with pytest.raises(TypeError, match="position"):
        arrays["position"] = arrays.zeros(3, wp.vec3d)
    with pytest.raises(KeyError, match="declared already"):
        arrays.declare("stretch", Field("cloth", 1, "scalar", "N", "always", "another one"))
    arrays.declare("drag", Field("yarn", 1, "scalar", "N s/m", "always", "of a term from outside"))
    arrays["drag"] = arrays.numbers(np.ones(10))
    assert "drag" not in FIELDS


def test_a_launch_refuses_what_its_kernel_does_not_take():
    model = wy.Simulator(scene("plain", ("stretch", "shear"))).model
    options = {"matrix": 0, "add_contact_load": 0}
    with pytest.raises(TypeError, match="forse"):
        model.launch("stretch", "segments", forse=model.arrays["q_x"], **options)
    with pytest.raises(TypeError, match="bend"):  # a name that is declared, of another kernel
        model.launch("stretch", "segments", bend=model.arrays["bend"], **options)
    with pytest.raises(KeyError, match="matrix"):  # what every launch has to say
        model.launch("stretch", "segments", add_contact_load=0)
    # a field of a struct stands for itself
    model.arrays.zero("force")
    model.launch("stretch", "segments", matrix=1, add_contact_load=0, diagonal_xx=model.arrays.new("diagonal_xx"))
    assert not model.arrays["diagonal_xx"].numpy().any()
