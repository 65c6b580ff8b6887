"""Random scenes: whatever they are, a run ends in success or in one of the project's own errors."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import warp_yarn as wy

# numbers that no fabric has are asked for
pytestmark = pytest.mark.filterwarnings("ignore::warp_yarn.WarpYarnWarning")

STEPS = 100


def log_uniform(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(np.log10(low), np.log10(high)).map(lambda x: float(10.0**x))


def yarns() -> st.SearchStrategy[wy.Yarn]:
    """From a thousandth to a thousand times the paper's, and none at all of what may be 0."""
    return st.builds(
        wy.Yarn,
        density=log_uniform(1e-6, 1.0),
        stretch=log_uniform(1e2, 1e8) | st.just(0.0),
        bend=log_uniform(1e-7, 1e-1) | st.just(0.0),
    )


def pose(rows: int, columns: int, spacing: float, roughness: float, seed: int) -> np.ndarray:
    """A flat grid, every node moved by up to so many spacings."""
    j, i = np.divmod(np.arange(rows * columns), columns)
    flat = np.stack([i, j, np.zeros_like(i)], axis=1)
    return spacing * (flat + roughness * np.random.default_rng(seed).uniform(-1.0, 1.0, flat.shape))


@st.composite
def scenes(draw: st.DrawFn) -> tuple[wy.Scene, float]:
    """A scene and a time step."""
    rows, columns = draw(st.integers(3, 5)), draw(st.integers(3, 5))
    weave = draw(
        st.sampled_from(list(wy.WEAVES.values())).map(lambda make: make(rows=rows, columns=columns))
        | st.lists(st.lists(st.booleans(), min_size=columns, max_size=columns), min_size=rows, max_size=rows).map(
            wy.Weave
        )
    )
    spacing = draw(log_uniform(1e-4, 1e-2))
    cloth = wy.Cloth(
        weave,
        yarns=draw(st.lists(yarns(), min_size=1, max_size=3)),
        spacing=spacing,
        radius=spacing * draw(st.floats(0.05, 0.5)),
        shear=draw(log_uniform(1e-1, 1e6) | st.just(0.0)),
        friction=draw(st.floats(0.0, 2.0)),
        friction_stiffness=draw(log_uniform(1.0, 1e5)),
        friction_damping=draw(log_uniform(1e-3, 1e4) | st.just(0.0)),
        parallel_stiffness=draw(log_uniform(1e-2, 1e3) | st.just(0.0)),
        pose=pose(rows, columns, spacing, draw(st.sampled_from([0.0, 0.1, 1.0])), draw(st.integers(0, 2**32 - 1))),
    )
    pins = draw(st.lists(st.integers(0, cloth.nodes - 1), unique=True, max_size=6))
    wind = draw(st.none() | st.builds(wy.Wind, velocity=st.tuples(*[st.floats(-50.0, 50.0)] * 3)))
    scene = wy.Scene(
        cloth,
        wind=wind,
        pins=pins,
        pin_stiffness=draw(st.none() | log_uniform(1.0, 1e5)),
        sliding=draw(st.booleans()),
    )
    return scene, draw(log_uniform(1e-4, 1.0 / 30.0))


@pytest.mark.slow
@settings(max_examples=12, deadline=None, derandomize=True, database=None, suppress_health_check=[HealthCheck.too_slow])
@given(scenes())
def test_success_or_an_error_of_ours(case: tuple[wy.Scene, float]) -> None:
    scene, step = case
    simulator = wy.Simulator(scene, step=step)
    try:
        trajectory = simulator.run(STEPS)
        assert len(trajectory) == STEPS + 1
    except wy.SimulationError as error:
        trajectory = error.trajectory
        assert len(trajectory) == error.step
    for name in ("position", "euler", "velocity", "euler_velocity"):
        assert np.isfinite(getattr(trajectory, name)).all(), name
