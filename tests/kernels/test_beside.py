"""What compressed yarns take from the matrix, beside it: the stretch force's own derivative, where that is definite."""

import dataclasses

import numpy as np
import pytest
from internals import numbers, solve_beside

import warp_yarn as wy

FABRICS = {"paper": wy.paper.cloth, "handkerchief": wy.fabrics.handkerchief, "cotton": wy.fabrics.cotton}

STIFFEST = 0.5
"""Of h, in times that a stretch wave takes from a crossing to the next: inertia is what keeps the matrix definite."""
STEP = 1e-4
"""Of fourth-order differences, in spacings: (1e-4)⁴ for the order, 1e-16/1e-4 for rounding."""
ERROR = 1e-8
"""Relative: of the differences, and of a linear solve to 1e-10."""


def squeezed(cloth: wy.Cloth, by: float, seed: int = 0) -> np.ndarray:
    """Positions of a cloth that is shorter than at rest, jittered by 3 % of a spacing."""
    jitter = np.random.default_rng(seed).normal(size=cloth.position.shape)
    return by * cloth.position + 0.03 * cloth.shortest_spacing * jitter


def simulator(fabric: str, sliding: bool, h: float, **options: object) -> wy.Simulator:
    cloth = FABRICS[fabric](rows=5, columns=7)
    yarn = cloth.yarns[0]
    wave = cloth.spacing * np.sqrt(yarn.density / cloth.stretch_stiffness[0])
    scene = wy.Scene(cloth, terms=("mass", "stretch"), sliding=sliding)
    return wy.Simulator(scene, step=h * wave, integrator="implicit-euler", tolerance=1e-10, **options)


def product(sim: wy.Simulator, w: np.ndarray, along: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """(M − h² dF/dq) w, by differences of the force, M as the mass term writes it."""
    state, h = sim.state, sim.step_size
    unit = STEP * sim.scene.cloth.shortest_spacing / max(np.abs(w).max(), 0.0 if along is None else np.abs(along).max())

    def force(k: float) -> list[np.ndarray]:
        moved = dataclasses.replace(state, position=state.position + k * unit * w)
        if along is not None:
            moved = dataclasses.replace(moved, euler=state.euler + k * unit * along)
        return list(sim.forces(moved)["stretch"])

    slopes = [
        (8.0 * (near - back) - (far - behind)) / (12.0 * unit)
        for near, back, far, behind in zip(force(1.0), force(-1.0), force(2.0), force(-2.0), strict=True)
    ]
    mass = sim.system(weights=(1.0, 0.0, 0.0)).dense()
    unknowns = w.ravel() if along is None else np.concatenate([w.ravel(), along.ravel()])
    inertia = mass @ unknowns
    count = w.size
    along_inertia = 0.0 if along is None else inertia[count:].reshape(-1, 2)
    return inertia[:count].reshape(-1, 3) - h * h * slopes[0], along_inertia - h * h * slopes[1]


@pytest.mark.parametrize("fabric", ["paper", "handkerchief", "cotton"])
@pytest.mark.parametrize("sliding", [True, False], ids=["sliding", "locked"])
@pytest.mark.parametrize(("preconditioner", "threads"), [("incomplete", 1), ("incomplete", 2), ("multilevel", 1)])
def test_solves_are_of_the_exact_derivative(fabric: str, sliding: bool, preconditioner: str, threads: int) -> None:
    """A − G times what the solve found is the right-hand side again, by differences of the force."""
    sim = simulator(fabric, sliding, STIFFEST, preconditioner=preconditioner, threads=threads)
    cloth = sim.scene.cloth
    sim.state = dataclasses.replace(sim.state, position=squeezed(cloth, 0.9))
    rng = np.random.default_rng(1)
    rhs, euler_rhs = rng.normal(size=(cloth.nodes, 3)), rng.normal(size=(cloth.nodes, 2))
    free = sim.system().free[3 * cloth.nodes :].reshape(-1, 2) if sliding else np.zeros((cloth.nodes, 2), dtype=bool)
    euler_rhs[~free] = 0.0
    w, along, seen = solve_beside(sim, rhs, euler_rhs)
    assert seen
    got, got_along = product(sim, w, along)
    assert np.abs(got - rhs).max() < ERROR * np.abs(rhs).max()
    if sliding:
        assert np.abs((got_along - euler_rhs)[free]).max() < ERROR * np.abs(rhs).max()


@pytest.mark.parametrize("preconditioner", ["incomplete", "multilevel"])
def test_an_indefinite_matrix_is_left_for_the_definite_part(preconditioner: str) -> None:
    """Where a step is long, squeezed yarns buckle in it: the solve is that of A, as if none were compressed."""
    sim = simulator("paper", False, 50.0, preconditioner=preconditioner)
    sim.state = dataclasses.replace(sim.state, position=squeezed(sim.scene.cloth, 0.8))
    system = sim.system()
    rhs = np.random.default_rng(1).normal(size=(sim.scene.cloth.nodes, 3))
    w, _, seen = solve_beside(sim, rhs, None)
    assert not seen
    expected = np.linalg.solve(system.dense(), rhs.ravel()).reshape(-1, 3)
    # both solves to 1e-10 of an energy, of a matrix whose condition is some 10⁴
    assert np.abs(w - expected).max() < 1e-6 * np.abs(expected).max()
    assert numbers(sim, "status")[0] == 0


def test_taut_yarns_have_nothing_beside() -> None:
    sim = simulator("paper", True, STIFFEST)
    sim.state = dataclasses.replace(sim.state, position=1.2 * sim.scene.cloth.position)
    rhs = np.ones((sim.scene.cloth.nodes, 3))
    _, _, seen = solve_beside(sim, rhs, np.zeros((sim.scene.cloth.nodes, 2)))
    assert not seen
