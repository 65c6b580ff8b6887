"""That --shuffled changes the order of threads and nothing else, and that without it there is the usual one."""

import numpy as np
import pytest
import warp as wp


@wp.kernel(module="test_threads")
def note_turn(turns: wp.array(dtype=int), order: wp.array(dtype=int)):
    order[wp.tid()] = wp.atomic_add(turns, 0, 1)


@wp.kernel(module="test_threads")
def add_squares(x: wp.array(dtype=float), total: wp.array(dtype=float)):
    i = wp.tid()
    wp.atomic_add(total, 0, x[i] * x[i])


@wp.kernel(module="test_threads")
def add_previous(x: wp.array(dtype=int)):
    """A race: each thread reads what the one before may have written."""
    i = wp.tid()
    if i > 0:
        x[i] = x[i - 1] + 1


@pytest.mark.parametrize("count", [1, 2, 5, 64, 289])
def test_every_thread_has_one_turn(count: int, pytestconfig: pytest.Config) -> None:
    turns, order = wp.zeros(1, dtype=int), wp.zeros(count, dtype=int)
    wp.launch(note_turn, dim=count, inputs=[turns, order])
    natural = np.arange(count)
    np.testing.assert_array_equal(np.sort(order.numpy()), natural)
    if count > 2:  # two may be in order by chance
        shuffled = pytestconfig.getoption("shuffled") is not None
        assert (order.numpy() == natural).all() != shuffled


def test_every_thread_has_one_turn_in_reverse_mode() -> None:
    values = np.arange(7, dtype=np.float32)
    x, total = wp.array(values, requires_grad=True), wp.zeros(1, dtype=float, requires_grad=True)
    with wp.Tape() as tape:
        wp.launch(add_squares, dim=7, inputs=[x, total])
    tape.backward(loss=total)
    np.testing.assert_array_equal(x.grad.numpy(), 2.0 * values)


def test_a_race_is_seen(pytestconfig: pytest.Config) -> None:
    x = wp.zeros(64, dtype=int)
    wp.launch(add_previous, dim=64, inputs=[x])
    as_if_in_order = (x.numpy() == np.arange(64)).all()
    assert as_if_in_order == (pytestconfig.getoption("shuffled") is None)
