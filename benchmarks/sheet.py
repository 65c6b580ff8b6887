"""A cloth as a sheet, by Newton's cloth, fitted to the same frames: a baseline that knows no yarns.

The sheet has a particle at each crossing, and knows of the scene what it can without the yarns' materials: the pose,
where it is held, the wind, and how long the yarns at each particle are. Seven numbers are fitted: its density, its
stiffness along the warp and along the weft (springs), in shear and in area (triangles), its bending stiffness (edges),
and a damping. Newton's triangles alone are isotropic: a sheet of them that stretches as hard as a fabric shears a
hundred times too hard. With the springs it is a better sheet, and so a fairer baseline.

Newton's SolverSemiImplicit is symplectic Euler, explicit; its steps are fine enough for the stiffest sheet of the
range. The wind is this project's kernel, so the same force. Lengths are in mm and masses in g on the device: Newton
leaves out the bending of edges whose triangles are below 1e-6 in its unit of area.
"""

from __future__ import annotations

import contextlib
import importlib.util

import numpy as np
import scipy.optimize
import tqdm
import warp as wp
from warp_yarn.kernels import Variant
from warp_yarn.kernels.core.structs import structs
from warp_yarn.kernels.terms import wind

import warp_yarn as wy
from warp_yarn.presets import paper

SUBSTEPS = 40
"""A frame: at the top of the ranges, a particle of the border swings with some 4e4 / s, and 2 / 2.5e-5 s is 8e4 / s."""

MM = G = 1e3
"""Of a metre, of a kilogram."""

PARAMETERS = ("density", "warp", "weft", "shear", "area", "bend", "damping")
"""Of the sheet: kg per metre of yarn, N/m, N/m, N/m, N/m, N, kg/s."""

DAMPED = 1e-5
"""Damping against stiffness in shear to start from [s]: a wave takes some 30 µs from a particle to the next."""

DIFFERENCE = 1e-3
"""For derivatives, of the range of a parameter's logarithm: well above what 32 bits round."""

BLOWN_UP = 1e-2
"""A root mean square error [m] that stands for any larger one, and for a sheet that is not finite."""

MICROMETRE = 1e-6


def available() -> bool:
    """Whether Newton is installed."""
    return importlib.util.find_spec("newton") is not None


class Sheet:
    """The hung sheet that stands for a cloth.

    Args:
        scene: the scene of the cloth, with wind and pins; nothing of its yarns' materials is used.
    """

    def __init__(self, scene: wy.Scene):
        import newton

        cloth, topology = scene.cloth, scene.cloth.topology
        builder = newton.ModelBuilder(gravity=tuple(scene.gravity * MM))
        zero = wp.vec3(0.0, 0.0, 0.0)
        builder.add_cloth_mesh(
            pos=zero, rot=wp.quat_identity(), scale=MM, vel=zero, density=1.0, vertices=cloth.position.tolist(),
            indices=topology.triangle_nodes.ravel().tolist(), tri_drag=0.0, tri_lift=0.0, edge_kd=0.0,
        )  # fmt: skip
        for a, b in topology.segment_nodes.tolist():
            builder.add_spring(a, b, ke=0.0, kd=0.0, control=0.0)
        self.model = builder.finalize(device="cpu")
        self.model.particle_grid = None  # no contact among particles
        flags = self.model.particle_flags.numpy()
        flags[scene.pins] &= ~int(newton.ParticleFlags.ACTIVE)
        self.model.particle_flags.assign(flags)
        self.along_warp = topology.yarn_direction[topology.segment_yarn] == 0
        self.yarn_length = np.zeros(cloth.nodes)
        np.add.at(self.yarn_length, topology.segment_nodes, 0.5 * cloth.spacing)
        self.solver = newton.solvers.SolverSemiImplicit(self.model, enable_tri_contact=False)
        self.states = [self.model.state() for _ in range(2)]
        self.rest = wp.clone(self.states[0].particle_q)
        self._prepare_wind(scene)
        self._frame()  # compiles
        with wp.ScopedCapture(device="cpu") as capture:
            self._frame()
        self.graph = capture.graph

    def _prepare_wind(self, scene: wy.Scene) -> None:
        variant = Variant(wp.float32, sliding=False)
        self.wind, self.no_matrix = wind.define(variant), structs(variant).BlockMatrix()
        self.triangles = wp.array(scene.cloth.topology.triangle_nodes, dtype=wp.vec3i, device="cpu")
        numbers = (scene.wind.density * G / MM**3, scene.wind.drag * G / MM**2)
        velocity = wp.array([np.array(scene.wind.velocity) * MM], dtype=wp.vec3, device="cpu")
        self.air = [velocity, *(wp.array([number], dtype=float, device="cpu") for number in numbers)]

    def _frame(self) -> None:
        """The steps of one frame, an even number of them: it ends in the state that it began in."""
        state, result = self.states
        for _ in range(SUBSTEPS):
            state.clear_forces()
            moving = [state.particle_q, state.particle_qd, state.particle_f]
            # no blocks, gusts, momentum and matrix
            arguments = [self.triangles, None, *self.air, None, *moving, None, 0, self.no_matrix]
            wp.launch(self.wind, dim=len(self.triangles), inputs=arguments, device="cpu")
            self.solver.step(state, result, None, None, paper.STEP / SUBSTEPS)
            state, result = result, state

    def _set(self, values: np.ndarray) -> None:
        model, v = self.model, dict(zip(PARAMETERS, values, strict=True))
        mass = v["density"] * self.yarn_length * G
        model.particle_mass.assign(mass)
        model.particle_inv_mass.assign(1.0 / mass)
        model.spring_stiffness.assign(np.where(self.along_warp, v["warp"], v["weft"]) * G)
        triangle = np.array([v["shear"], v["area"], v["damping"], 0.0, 0.0]) * G
        model.tri_materials.assign(np.tile(triangle, (model.tri_count, 1)))
        edge = np.array([v["bend"] * G * MM, 0.0])
        model.edge_bending_properties.assign(np.tile(edge, (model.edge_count, 1)))

    def run(self, values: np.ndarray, frames: int) -> np.ndarray:
        """Positions [frames, nodes, 3] (m) from rest, the frames 1 ms apart; not finite where the sheet blew up."""
        self._set(values)
        for state in self.states:
            state.particle_q.assign(self.rest)
            state.particle_qd.zero_()
        positions = np.empty((frames, len(self.yarn_length), 3))
        for k in range(frames):
            wp.capture_launch(self.graph)
            positions[k] = self.states[0].particle_q.numpy() / MM
        return positions


def bounds(cloth: wy.Cloth, values: dict[str, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Start, low and high of the sheet's parameters, for a sheet that is the mean of two yarns with these values.

    Args:
        cloth: its spacing and radius are used.
        values: of yarns to start from, named as in ``warp_yarn.calibration.learn.Parameter``.
    """
    area, spacing = np.pi * cloth.radius**2, cloth.spacing
    density, stretch, bend = (
        np.mean([values[f"{name}[{k}]"] for k in (0, 1)]) for name in ("density", "stretch", "bend")
    )
    membrane = stretch * area / spacing
    shear = 4.0 * values["shear"] * area / spacing  # four corners a crossing
    start = np.array([density, membrane, membrane, shear, shear, bend * area / spacing**2, shear * DAMPED])
    factor = np.array([1.0, 4.0, 4.0, 30.0, 30.0, 30.0, 100.0])
    low, high = start / factor, start * factor
    low[0], high[0] = 1e-3, 3e-3  # as the yarns'
    return start, low, high


class _SpentError(Exception):
    """All runs are used."""


def fit(
    sheet: Sheet, positions: np.ndarray, bounds: tuple[np.ndarray, np.ndarray, np.ndarray], runs: int, seed: int = 0
) -> np.ndarray:
    """Fits the sheet to frames by least squares in the logarithms of its parameters.

    Args:
        positions: the frames [frames, nodes, 3] (m), the first 1 ms after rest.
        bounds: start, low, high; a first search is from the start, further ones from anywhere in the range.
        runs: simulations, all of which are used.

    Returns:
        The best values found.
    """
    start, low, high = (np.log(values) for values in bounds)
    scale = 1.0 / np.sqrt(np.prod(positions.shape[:2]))
    best, least, used = np.exp(start), np.inf, 0
    bar = tqdm.tqdm(total=runs, unit="run", desc="sheet", disable=None, leave=False)

    def residuals(x: np.ndarray) -> np.ndarray:
        nonlocal best, least, used
        if used == runs:
            raise _SpentError
        used += 1
        bar.update()
        values = np.exp(low + (high - low) * (x - 1.0))
        error = (sheet.run(values, len(positions)) - positions).ravel() * scale
        loss = error @ error
        if not loss < BLOWN_UP**2:
            return np.full(error.shape, BLOWN_UP / np.sqrt(error.size)) / MICROMETRE
        if loss < least:
            best, least = values, loss
        return error / MICROMETRE

    # From 1 to 2 within the range, as SciPy's differences are relative to the variable.
    x = 1.0 + (start - low) / (high - low)
    generator = np.random.default_rng(seed)
    with bar, contextlib.suppress(_SpentError):
        while True:
            scipy.optimize.least_squares(residuals, x, bounds=(1.0, 2.0), diff_step=DIFFERENCE)
            x = generator.uniform(1.0, 2.0, len(low))
    return best
