"""Runs experiments in small, one after the other in this process: python .ci/tables.py FOLDER NAME ...

They share imports and programs, which are compiled fast as those of the tests. Of several processes with the same
folder each takes the next experiment that no other has taken.
Each experiment leaves its results in FOLDER/NAME and its output in FOLDER/NAME.log.
"""

import contextlib
import os
import runpy
import sys
import time
from pathlib import Path

HOME = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(HOME), str(HOME / "tests")]

import compiling  # noqa: E402

os.environ.setdefault("XLA_FLAGS", compiling.ENVIRONMENT)
for threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):  # two processes work; threads wait by spinning
    os.environ.setdefault(threads, "1")

folder, names = Path(sys.argv[1]), sys.argv[2:]
for name in names:
    began = time.monotonic()
    try:
        log = (folder / f"{name}.log").open("x")
    except FileExistsError:
        continue
    sys.argv = [name, "--quick", "--processes", "1", "--out", str(folder / name)]
    with log, contextlib.redirect_stdout(log), contextlib.redirect_stderr(log):
        runpy.run_module(f"experiments.{name}", run_name="__main__", alter_sys=True)
    missing = [file for file in ("config.json", "metrics.json", "table.md") if not (folder / name / file).exists()]
    assert not missing, f"{name} left no {missing}"
    print(f"python -m experiments.{name} --quick: {time.monotonic() - began:.0f} s", flush=True)
