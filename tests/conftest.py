"""Keeps Warp quiet and torch to one thread, gives the tests of a term their cases, and has the option --shuffled."""

import pytest
import threads
import torch
import warp as wp

pytest.register_assert_rewrite("cases", "checks")

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
    """A test with an argument `case` runs at each of its class's `cases`."""
    if "case" in metafunc.fixturenames and metafunc.cls is not None:
        metafunc.parametrize("case", metafunc.cls.cases, ids=str)
