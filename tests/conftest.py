"""Keeps Warp quiet and torch to one thread, gives the tests of a term their cases, knows which ones are slow, has
options --shuffled, --slower-than, and a disk that fills up."""

import subprocess
from collections import Counter
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

SLOW = Path(__file__).with_name("slow.txt")
"""Tests that took longer than the others when they were measured, besides those whose files mark them as slow."""
SCRIPTS_AT_COLLECTION = pytest.StashKey[list[str]]()

wp.config.quiet = True
torch.set_num_threads(1)


def pytest_addoption(parser: pytest.Parser) -> None:
    text = "run the threads of every launch in this order, to find kernels that need the usual one"
    parser.addoption("--shuffled", choices=threads.ORDERS, help=text)
    text = f"write the names of the tests that take longer than this to {SLOW.name}; needs a warm cache of kernels"
    parser.addoption("--slower-than", type=float, metavar="SECONDS", help=text)


def pytest_configure(config: pytest.Config) -> None:
    # torch.func's own
    config.addinivalue_line("filterwarnings", "ignore:`torch.jit.script` is deprecated:DeprecationWarning")
    if config.getoption("slower_than") is not None:
        config.pluginmanager.register(Stopwatch(config.getoption("slower_than")))
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


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks as slow what was measured to be."""
    slow = set(SLOW.read_text().splitlines())
    for item in items:
        if item.nodeid in slow:
            item.add_marker(pytest.mark.slow)


class Stopwatch:
    """Writes down which tests are slow."""

    def __init__(self, limit: float):
        self.limit, self.seconds = limit, Counter[str]()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Adds up what a test, its setup and its end take."""
        self.seconds[report.nodeid] += report.duration

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Writes the list, sorted; of what was not run it keeps what it had."""
        if not hasattr(session.config, "workerinput"):  # a worker of pytest-xdist sees but its own
            kept = {name for name in SLOW.read_text().splitlines() if name not in self.seconds}
            slow = {name for name, seconds in self.seconds.items() if seconds > self.limit}
            SLOW.write_text("".join(f"{name}\n" for name in sorted(kept | slow)))


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
