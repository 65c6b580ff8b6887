"""Keeps Warp quiet and torch to one thread, gives the tests of a term their cases, has the option --shuffled, and a
disk that fills up."""

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import scripts
import threads
import torch
import warp as wp

pytest.register_assert_rewrite("cases", "checks", "internals", "inputs")

FEW = ("rest", "random", "folded")
"""States whose faults the others hardly add to."""

SCRIPTS_AT_COLLECTION = pytest.StashKey[list[str]]()

wp.config.quiet = True
torch.set_num_threads(1)


def pytest_addoption(parser: pytest.Parser) -> None:
    text = "run the threads of every launch in this order, to find kernels that need the usual one"
    parser.addoption("--shuffled", choices=threads.ORDERS, help=text)


def pytest_configure(config: pytest.Config) -> None:
    # torch.func's own
    config.addinivalue_line("filterwarnings", "ignore:`torch.jit.script` is deprecated:DeprecationWarning")
    order = config.getoption("shuffled")
    if order is not None:
        threads.shuffle(order)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run a test with an argument `case` at each of its class's `cases`; where time is short, at those of one weave in
    three states, unless there are none of them."""
    if "case" in metafunc.fixturenames and metafunc.cls is not None:
        cases = metafunc.cls.cases
        few = [case for case in cases if case.cloth_name == "plain" and case.state_name in FEW] or cases
        marked = [case if case in few else pytest.param(case, marks=pytest.mark.slow) for case in cases]
        metafunc.parametrize("case", marked, ids=str)


def pytest_collection_finish(session: pytest.Session) -> None:
    """Writes down what was imported by then that only running tests may import."""
    session.config.stash[SCRIPTS_AT_COLLECTION] = scripts.loaded()


@pytest.fixture
def scripts_at_collection(pytestconfig: pytest.Config) -> list[str]:
    """Scripts of scenes/ and benchmarks/ that were imported when the tests had been collected."""
    return pytestconfig.stash[SCRIPTS_AT_COLLECTION]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 3 MB, where this process may mount one."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=3m", "none", str(folder)]
    try:
        subprocess.run(mount, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("needs the right to mount a disk")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)
