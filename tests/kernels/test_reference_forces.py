"""Every term against an independent implementation's numbers on two random states (``tests/data``)."""

import functools
import json
from pathlib import Path

import numpy as np
import pytest
from checks import error, matrix

import warp_yarn as wy

DATA = Path(__file__).parent.parent / "data"
STATES = ("forces_plain5", "forces_twill6")
TERMS = ("gravity", "stretch", "bending", "inertia", "mass_rate", "wind", "shear")
TOLERANCE = 1e-10
"""The project's; the two implementations, both in double precision, differ by some 1e-13."""


@functools.cache
def load(name: str) -> tuple[dict[str, np.ndarray], wy.Simulator, wy.State]:
    path = DATA / f"{name}.npz"
    if not path.exists():
        pytest.skip(f"{path} is absent: the reference forces do not come with this copy of the project")
    with np.load(path) as file:
        data = dict(file)
    meta = json.loads(str(data["meta"]))
    cloth = wy.Cloth(
        wy.WEAVES[meta["weave"]](rows=meta["rows"], columns=meta["columns"]),
        yarns=[wy.Yarn(density=density, stretch=stretch, bend=bend) for density, stretch, bend in meta["yarns"]],
        spacing=meta["spacing"],
        radius=meta["radius"],
        shear=meta["shear_modulus"],
    )
    wind = wy.Wind(velocity=tuple(meta["wind_velocity"]), density=meta["wind_density"], drag=meta["wind_drag"])
    sim = wy.Simulator(wy.Scene(cloth, gravity=meta["gravity"], wind=wind))
    # the reference has every corner unlocked
    sim.arrays["corner_jams"].zero_()
    return data, sim, wy.State(data["position"], data["euler"], data["velocity"], data["euler_velocity"])


@pytest.mark.parametrize("term", TERMS)
@pytest.mark.parametrize("name", STATES)
def test_force(name: str, term: str) -> None:
    data, sim, state = load(name)
    x, s = sim.forces(state)[term]
    key = "shear_unlocked" if term == "shear" else term
    assert error(x, data[f"{key}_force"]) < TOLERANCE
    if f"{key}_euler_force" in data:
        assert error(s, data[f"{key}_euler_force"], least=np.abs(x).max()) < TOLERANCE


@pytest.mark.parametrize("name", STATES)
def test_contact(name: str) -> None:
    data, sim, state = load(name)
    normal, force = sim.contact(state)
    assert error(normal, data["contact_normal"]) < TOLERANCE
    assert error(force, data["contact_force"]) < TOLERANCE


@pytest.mark.parametrize("name", STATES)
def test_mass(name: str) -> None:
    """The file has the mass of every pair of nodes, the same in x, y and z."""
    data, sim, state = load(name)
    n = len(data["position"])
    x = matrix(sim, state, mass=1.0)[: 3 * n, : 3 * n].reshape(n, 3, n, 3)
    expected = np.einsum("ij,kl->ikjl", data["mass_lagrangian_block"], np.eye(3))
    assert error(x, expected) < TOLERANCE
