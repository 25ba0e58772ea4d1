import json
import os
import subprocess
import sys
from pathlib import Path

from experiments.sharing import alone, available, shares

ROOT = Path(__file__).parent.parent

HOLDER = """
import sys, time
from pathlib import Path
from experiments.sharing import alone
with alone(Path(sys.argv[1]), wait=False) as free:
    print(free, flush=True)
    time.sleep(600)
"""

# Settings and figures that cost nothing: what is tested is who computes them.
TABLE = """
import argparse, os, time
from pathlib import Path
from types import SimpleNamespace
from experiments import tables, twins

def figures(setting, answers):
    (here / f"{os.getpid()}.here").touch()
    while len(list(here.glob("*.here"))) < 2:  # for the other process, however long its start takes
        time.sleep(0.05)
    return {"miou": 0.5, "process": os.getpid(), "cores": sorted(os.sched_getaffinity(0))}

tables.prepare = lambda *a, **k: SimpleNamespace(bench=SimpleNamespace(twin=True), shared=SimpleNamespace(settle=float))
tables.measure = figures
parser = argparse.ArgumentParser()
parser.add_argument("--out")
parser.add_argument("--processes", type=int)
given = parser.parse_args()
here = Path(given.out)
data = twins.Data("lerf", scenes=("a", "b"), seeds=(0, 1))
plan = tables.Plan(data, ("x",), sweep=(), out=given.out, processes=given.processes)
cells = tables.fill(plan, {"x": lambda setting, steps: None}, tell=lambda line: print(os.getpid(), line, flush=True))
assert [(cell["scene"], cell["seed"]) for cell in cells] == [(s, k) for s in "ab" for k in (0, 1)]
print("whole", flush=True)
"""


def test_a_lock_is_held_by_one_and_freed_with_its_holder(tmp_path):
    file = tmp_path / "cells" / "a.lock"
    with alone(file, wait=False) as first:
        assert first
        with alone(file, wait=False) as second:
            assert not second
    assert not file.exists()
    holder = subprocess.Popen([sys.executable, "-c", HOLDER, str(file)], stdout=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        assert holder.stdout.readline() == "True\n"
        with alone(file, wait=False) as free:
            assert not free
    finally:
        holder.kill()
        holder.wait()
    assert file.exists()  # stopped without a word
    with alone(file, wait=True) as free:
        assert free


def test_two_processes_share_a_table_and_each_cell_is_computed_once(tmp_path):
    script, cells = tmp_path / "table.py", tmp_path / "cells"
    script.write_text(TABLE)

    def table(processes):
        command = [sys.executable, str(script), "--out", str(tmp_path), "--processes", str(processes)]
        environment = {"PYTHONPATH": str(ROOT)}
        told = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
        assert told.returncode == 0, told.stderr
        return told.stdout.splitlines()

    lines = table(2)
    assert lines.count("whole") == 1, lines  # the processes that share it end without one
    assert len(list(cells.iterdir())) == len(lines) - 1 == 4, lines  # and no lock is left
    found = [json.loads(file.read_text()) for file in cells.iterdir()]
    assert len({cell["process"] for cell in found}) == 2
    assert {tuple(cell["cores"]) for cell in found} == {tuple(share) for share in shares(available(), 2)}
    next(cells.iterdir()).unlink()
    lines = table(2)
    assert len(lines) == 2, lines  # the lost cell alone was computed again, and nobody asked for help


def test_cores_are_shared_out():
    assert shares([0, 1], 2) == [[0], [1]]
    assert shares([3, 5, 8, 9, 11], 2) == [[3, 8, 11], [5, 9]]
    assert shares([4, 7], 5) == [[4], [7], [4], [7], [4]]
    assert shares([], 2) == [[], []]  # unknown: the processes are left where they are
    assert available() == sorted(os.sched_getaffinity(0))
