"""Cells of tables: kept in one file, also where writers are killed, and shared out among processes."""

import lzma
import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from experiments.cells import append_cell, available_cores, exclusive_lock, read_cells, split_cores
from jsecon.errors import InputError

ROOT = Path(__file__).parent.parent.parent

HOLDER = """
import sys, time
from pathlib import Path
from experiments.cells import exclusive_lock
with exclusive_lock(Path(sys.argv[1]), wait=False) as free:
    print(free, flush=True)
    time.sleep(600)
"""

WRITER = """
import sys
from pathlib import Path
from experiments.cells import append_cell
for k in range(200):
    append_cell(Path(sys.argv[1]), f"{sys.argv[2]} {k}", {"long": "x" * 50 * (k % 7), "number": k / 3})
"""

# Stops within its write, as a process does that is killed there: the lock is held, half of the line is in the file.
HALF = """
import fcntl, os, sys, time
file = os.open(sys.argv[1], os.O_WRONLY | os.O_APPEND)
fcntl.flock(file, fcntl.LOCK_EX)
os.write(file, b'{"key": "b", "val')
print("half", flush=True)
time.sleep(600)
"""

# Settings and figures that cost nothing: what is tested is who computes them.
TABLE = """
import argparse, os, time
from pathlib import Path
from types import SimpleNamespace
from experiments.tables import fill, twins

def figures(setting, answers):
    (here / f"{os.getpid()}.here").touch()
    while len(list(here.glob("*.here"))) < 2:  # for the other process, however long its start takes
        time.sleep(0.05)
    programs = os.environ.get("JAX_COMPILATION_CACHE_DIR", "")
    told = {"miou": 0.5, "process": os.getpid(), "cores": sorted(os.sched_getaffinity(0))}
    return told | {"programs": programs, "kept": os.path.isdir(programs)}

fill.prepare = lambda *a, **k: SimpleNamespace(bench=SimpleNamespace(twin=True), shared=SimpleNamespace(settle=float))
fill.measure = figures
parser = argparse.ArgumentParser()
parser.add_argument("--out")
parser.add_argument("--processes", type=int)
given = parser.parse_args()
here = Path(given.out)
data = twins.Data("lerf", scenes=("a", "b"), seeds=(0, 1))
plan = fill.Plan(data, ("x",), sweep=(), out=given.out, processes=given.processes)
cells = fill.fill(plan, {"x": lambda setting, steps: None}, tell=lambda line: print(os.getpid(), line, flush=True))
assert [(cell["scene"], cell["seed"]) for cell in cells] == [(s, k) for s in "ab" for k in (0, 1)]
print("whole", flush=True)
"""


def test_a_cell_is_read_as_it_was_written(tmp_path):
    file = tmp_path / "new" / "cells.jsonl"
    assert read_cells(file) == {}
    value = {"miou": 0.1 + 0.2, "pairs": 8, "twin": True, "name": "Bär\n", "none": None}
    append_cell(file, "a", value)
    append_cell(file, "b", [1.0])
    assert read_cells(file) == {"a": value, "b": [1.0]}
    assert len(file.read_text().splitlines()) == 2
    append_cell(file, "a", {"miou": 0.5})
    assert read_cells(file) == {"a": {"miou": 0.5}, "b": [1.0]}  # the later line counts
    assert len(file.read_text().splitlines()) == 3


def test_two_writers_at_once_leave_whole_lines(tmp_path):
    file = tmp_path / "cells.jsonl"
    writers = [subprocess.Popen([sys.executable, "-c", WRITER, str(file), name], cwd=ROOT) for name in "ab"]
    assert [writer.wait(timeout=120) for writer in writers] == [0, 0]
    found = read_cells(file)
    assert set(found) == {f"{name} {k}" for name in "ab" for k in range(200)}
    assert all(cell["number"] == int(key.split()[1]) / 3 for key, cell in found.items())


def test_a_writer_killed_within_a_line_costs_that_cell_alone(tmp_path):
    file = tmp_path / "cells.jsonl"
    append_cell(file, "a", 1)
    with subprocess.Popen([sys.executable, "-c", HALF, str(file)], stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout.readline() == "half\n"
        writer.kill()
    with pytest.warns(UserWarning, match="incomplete last line"):
        assert read_cells(file) == {"a": 1}
    with pytest.warns(UserWarning, match='removed.*"key": "b"'):
        append_cell(file, "c", 3)
    assert file.read_bytes() == b'{"key": "a", "value": 1}\n{"key": "c", "value": 3}\n'
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # nothing is left to be said
        append_cell(file, "b", 2)
        assert read_cells(file) == {"a": 1, "b": 2, "c": 3}


@pytest.mark.parametrize("line", ["<<<<<<< HEAD", '{"key": "b"}', "[1, 2]", ""])
def test_a_whole_line_that_is_no_cell_is_refused(tmp_path, line):
    file = tmp_path / "cells.jsonl"
    file.write_text(f'{{"key": "a", "value": 1}}\n{line}\n{{"key": "c", "value": 3}}\n')
    with pytest.raises(InputError, match="line 2 is no cell"):
        read_cells(file)


def test_a_lock_is_held_by_one_and_freed_with_its_holder(tmp_path):
    file = tmp_path / "cells" / "a.lock"
    with exclusive_lock(file, wait=False) as first:
        assert first
        with exclusive_lock(file, wait=False) as second:
            assert not second
    assert not file.exists()
    holder = subprocess.Popen([sys.executable, "-c", HOLDER, str(file)], stdout=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        assert holder.stdout.readline() == "True\n"
        with exclusive_lock(file, wait=False) as free:
            assert not free
    finally:
        holder.kill()
        holder.wait()
    assert file.exists()  # stopped without a word
    with exclusive_lock(file, wait=True) as free:
        assert free


def table(place, processes):
    (script := place / "table.py").write_text(TABLE)
    command = [sys.executable, str(script), "--out", str(place), "--processes", str(processes)]
    environment = {"PYTHONPATH": str(ROOT)}
    told = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert told.returncode == 0, told.stderr
    return told.stdout.splitlines()


@pytest.mark.long
def test_two_processes_share_a_table_and_each_cell_is_computed_once(tmp_path):
    file = tmp_path / "cells.jsonl"
    lines = table(tmp_path, 2)
    assert lines.count("whole") == 1, lines  # the processes that share it end without one
    found = read_cells(file)
    assert len(file.read_text().splitlines()) == len(found) == len(lines) - 1 == 4, lines
    assert not list(tmp_path.glob("*.lock"))
    assert len({cell["process"] for cell in found.values()}) == 2
    assert {tuple(cell["cores"]) for cell in found.values()} == {
        tuple(share) for share in split_cores(available_cores(), 2)
    }
    (programs,) = {cell["programs"] for cell in found.values()}  # one folder for both, while they run
    assert all(cell["kept"] for cell in found.values())
    assert programs
    assert not Path(programs).exists()
    append_cell(file, "of another table", {"miou": 1})  # is left alone
    lost, *kept = file.read_text().splitlines(keepends=True)
    file.write_text("".join(kept) + lost[:20])  # as a killed process leaves it
    lines = table(tmp_path, 2)
    assert len(lines) == 2, lines  # the lost cell alone was computed again, and nobody asked for help
    assert read_cells(file).keys() == {*found, "of another table"}


@pytest.mark.long
def test_a_helper_goes_on_where_another_process_is_at_a_setting(tmp_path):
    (tmp_path / "other.here").touch()
    with exclusive_lock(tmp_path / "a-1-medium.lock", wait=False) as free:  # longer than the helper lives
        assert free
        lines = table(tmp_path, 0)
    assert len(lines) == 3, lines
    assert {(cell["scene"], cell["seed"]) for cell in read_cells(tmp_path / "cells.jsonl").values()} == {
        ("a", 0),
        ("b", 0),
        ("b", 1),
    }


def test_cores_are_shared_out():
    assert split_cores([0, 1], 2) == [[0], [1]]
    assert split_cores([3, 5, 8, 9, 11], 2) == [[3, 8, 11], [5, 9]]
    assert split_cores([4, 7], 5) == [[4], [7], [4], [7], [4]]
    assert split_cores([], 2) == [[], []]  # unknown: the processes are left where they are
    assert available_cores() == sorted(os.sched_getaffinity(0))


def test_compressed_cells_are_read_and_later_ones_replace_them(tmp_path):
    file = tmp_path / "cells.jsonl"
    append_cell(file, "a", 1)
    append_cell(file, "b", 2)
    packed = tmp_path / "cells.jsonl.xz"
    packed.write_bytes(lzma.compress(file.read_bytes()))
    file.unlink()
    assert read_cells(file) == {"a": 1, "b": 2}
    before = packed.read_bytes()
    append_cell(file, "b", 3)
    assert read_cells(file) == {"a": 1, "b": 3}
    assert packed.read_bytes() == before
