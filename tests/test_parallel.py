"""Views spread over cores and processes: the same results as in one."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jsecon.parallel import map_over_processes, map_views

PROGRAM = """
import sys
import jax
rank, world, port, count = map(int, sys.argv[1:])
jax.distributed.initialize(f"127.0.0.1:{port}", world, rank)
from test_parallel import rows, squares
print(*squares(count), "|", *rows(count))
"""


def squares(count: int, progress=None) -> list[int]:
    return [int(row) for row in map_views(count, lambda t: np.int32(t * t), progress)]


def rows(count: int) -> list[str]:
    """Rows of several lengths, as words."""
    found = map_over_processes(count, lambda own: ((np.arange(t), {"t": (t, None)}) for t in own))
    return [f"{row.sum()}{row.dtype}of{told['t'][0]}" for row, told in found]


def test_one_process_counts_every_view_once_in_order():
    told = []
    assert squares(20, lambda done, total: told.append((done, total))) == [t * t for t in range(20)]
    assert told == [(t + 1, 20) for t in range(20)]
    assert squares(0) == []


def test_the_error_of_a_view_ends_the_work():
    seen = []

    def fail(t):
        seen.append(t)
        raise ValueError(f"view {t}")

    with pytest.raises(ValueError, match="view 0"):
        map_views(1000, fail)
    assert len(seen) < 1000


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
    expected = f"{' '.join(map(str, squares(count)))} | {' '.join(rows(count))}"
    for out, error in said:
        assert out.strip().splitlines()[-1:] == [expected], error
