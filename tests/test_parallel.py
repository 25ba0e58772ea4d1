"""Views spread over processes: the same sums as in one."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jsecon.parallel import spread_over_devices

PROGRAM = """
import sys
import jax
rank, world, port, count = map(int, sys.argv[1:])
jax.distributed.initialize(f"127.0.0.1:{port}", world, rank)
from test_parallel import summed
state, outs = summed(count)
print(*map(int, state), "|", *map(int, outs))
"""


def summed(count: int, progress=None):
    """(sum, number) of 0, 10, 20, ... and the views doubled."""
    step = jax.jit(lambda state, factor, view: (state + jnp.stack([view, 1]), factor * view))
    merge = lambda a, b: a + b
    views = 10 * jnp.arange(count)
    return spread_over_devices(step, jnp.zeros(2, int), merge, jnp.int32(2), views, progress=progress)


def test_one_process_counts_every_view_once():
    told = []
    state, outs = summed(5, progress=lambda done, total: told.append((done, total)))
    np.testing.assert_array_equal(state, [100, 5])
    np.testing.assert_array_equal(outs, [0, 20, 40, 60, 80])
    assert told[-1] == (5, 5)


@pytest.mark.parametrize("count", [5, 1])
def test_two_processes_end_with_what_one_does(count):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    given = [[sys.executable, "-c", PROGRAM, *map(str, (rank, 2, port, count))] for rank in range(2)]
    places = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    running = [subprocess.Popen(line, env=places, stdout=-1, stderr=-1, text=True) for line in given]
    said = [process.communicate(timeout=120) for process in running]
    state, outs = summed(count)
    expected = " ".join(map(str, map(int, state))) + " | " + " ".join(map(str, map(int, outs)))
    for out, error in said:
        assert out.strip().splitlines()[-1:] == [expected], error
