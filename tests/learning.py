"""Problems of learning for tests: motions of eq. 2, at most 5 × 5, and what can go wrong with them."""

import dataclasses

import numpy as np

import warp_yarn as wy
from warp_yarn.calibration.learn import PAPER, CalibrationProblem, value_of

SCENE = wy.paper.hung_cloth(rows=4, columns=4)
FRAMES = 8
SHEAR, BEND, DENSITY, FRICTION = (
    next(p for p in PAPER if p.name == name) for name in ("shear", "bend[0]", "density[0]", "friction")
)
COULOMB = {"friction_sharpness": 1e6}


def motion(scene=SCENE, frames=FRAMES, step=1e-3, **options):
    """Simulates. Differentiable: with the kernels that learning uses, so that no others are compiled."""
    return wy.Simulator(scene, step=step, differentiable=True, **{"integrator": "linear", **options}).run(frames)


def problem_of(target, parameters=(DENSITY, BEND, SHEAR), scene=SCENE, **options):
    """Makes a problem of eq. 2."""
    return CalibrationProblem(scene, target, parameters, **{"integrator": "linear", **options})


def truth(of):
    """Looks up the scene's own values of what is learned."""
    return np.array([value_of(of.scene, name) for name in of.names])


def failing_where(problem, fails):
    """Makes a problem's simulations fail at some values."""
    residuals, asked = problem.residuals, []

    def or_fail(values):
        asked.append(values)
        if fails(values):
            raise wy.SimulationError("too stiff", step=1, node=-1, term=None, trajectory=None)
        return residuals(values)

    problem.residuals = or_fail
    return asked


def moved(stiffness, until=24):
    """5 × 5 of soft yarns, which a step resolves; corners that go to and fro, and a node that is pulled in turns."""
    yarns = [dataclasses.replace(yarn, stretch=1e-3 * yarn.stretch) for yarn in SCENE.cloth.yarns]
    cloth = wy.Cloth(wy.Weave.plain(rows=5, columns=5), yarns=yarns)
    pins = cloth.corners("top")
    k = np.arange(1, until + 1)[:, None]
    path = cloth.position[pins] + 2e-4 * np.sin(0.5 * k)[..., None] * [[1.0, 0.5, 0.0], [0.0, 1.0, 0.5]]
    forces = {22: 2e-5 * np.cos(0.7 * k) * [0.0, 1.0, 0.0], 12: [1e-5, 0.0, 0.0]}
    return wy.Scene(cloth, pins=pins, pin_stiffness=stiffness, pin_path=path, forces=forces)
