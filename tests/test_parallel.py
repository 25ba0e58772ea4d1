"""Views spread over processes: the same sums as in one."""

import functools
import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jsecon.parallel import (
    LANES,
    accumulate_over_views,
    allgather_tree,
    concurrent_lanes,
    map_over_processes,
)

PROGRAM = """
import sys
import jax
rank, world, port, count = map(int, sys.argv[1:])
jax.distributed.initialize(f"127.0.0.1:{port}", world, rank)
from test_parallel import rows, summed
state, outs = summed(count)
print(*map(int, state), "|", *map(int, outs), "|", *rows(count))
"""


def summed(count: int, progress=None):
    """(sum, number) of 0, 10, 20, ... and the views doubled."""

    def step(state, factor, view):
        return (state + jnp.stack([view, 1]), factor * view)

    def merge(a, b):
        return a + b

    views = 10 * jnp.arange(count)
    return accumulate_over_views(step, jnp.zeros(2, int), merge, jnp.int32(2), views, progress=progress)


def rows(count: int) -> list[str]:
    """Rows of several lengths, as words."""
    found = map_over_processes(count, lambda own: ((np.arange(t), {"t": t}) for t in own))
    return [f"{row.sum()}of{told['t']}" for row, told in found]


def test_processes_exchange_trees_of_arrays_and_plain_values():
    tree = {"a": [np.arange(3, dtype=np.int32), np.zeros((0, 2), bool)], "b": (1.5, "two", None), "c": np.float32(4)}
    (back,) = allgather_tree(tree)
    np.testing.assert_array_equal(back["a"][0], tree["a"][0])
    assert (back["a"][0].dtype, back["a"][1].shape) == (np.int32, (0, 2))
    assert (back["b"], back["c"]) == (tree["b"], 4)


def test_views_are_added_up_in_lanes_that_are_joined_in_their_order():
    values = np.asarray(np.random.default_rng(0).normal(size=101) * 10.0 ** np.arange(-50, 51).clip(-6, 6), np.float32)

    def step(state, _, view):
        return (state + view, None)

    got, _ = accumulate_over_views(step, np.float32(0), lambda a, b: a + b, np.float32(0), values)
    lanes = np.zeros(LANES, np.float32)
    for t, value in enumerate(values):
        lanes[t % LANES] += value
    assert np.float32(got) == functools.reduce(lambda a, b: np.float32(a + b), lanes)


@pytest.mark.parametrize(
    ("devices", "at_once"), [(1, 1), (2, 2), (3, 3), (5, 4), (6, 4), (7, 4), (8, 8), (12, 8), (16, 8)]
)
def test_no_turn_has_more_lanes_than_devices_and_none_many_fewer(monkeypatch, devices, at_once):
    local = [jax.local_devices()[0]] * devices
    monkeypatch.setattr(jax, "devices", lambda: local)
    assert concurrent_lanes(100, 1 << 20) == at_once
    assert concurrent_lanes(3, 1 << 20) == min(devices, 3)  # a lane a view
    assert concurrent_lanes(100, 1 << 30) == min(devices, 2)  # memory


def test_one_process_counts_every_view_once():
    told = []
    state, outs = summed(5, progress=lambda done, total: told.append((done, total)))
    np.testing.assert_array_equal(state, [100, 5])
    np.testing.assert_array_equal(outs, [0, 20, 40, 60, 80])
    assert told[-1] == (5, 5)


@pytest.mark.parametrize("count", [5, pytest.param(1, marks=pytest.mark.long)])
def test_two_processes_end_with_what_one_does(count):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    given = [[sys.executable, "-c", PROGRAM, *map(str, (rank, 2, port, count))] for rank in range(2)]
    paths = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    places = {**os.environ, "PYTHONPATH": paths}
    running = [subprocess.Popen(line, env=places, stdout=-1, stderr=-1, text=True) for line in given]
    said = [process.communicate(timeout=120) for process in running]
    state, outs = summed(count)
    expected = " | ".join(" ".join(map(str, words)) for words in (map(int, state), map(int, outs), rows(count)))
    for out, error in said:
        assert out.strip().splitlines()[-1:] == [expected], error
