"""A table's cells in one file, and the processes that fill it side by side.

A file of cells (cells.jsonl) holds a line per cell, {"key": ..., "value": ...}. A finished cell is appended and no line
is ever changed; where a key stands twice, the later line counts.

Who reads or appends holds the kernel's lock on the file (flock; shared among readers). O_APPEND alone would keep the
lines of two writers apart, but a process killed within its write leaves a part of a line, and nobody could tell that
from a line that is being written. Under the lock a last line without its end can only be such a part: readers leave it
out, the next writer cuts it off, and both say so. Which process computes which setting is settled by locks on files of
their own (`alone`). The kernel frees both kinds with their holder: a stopped process leaves nothing that is stale.
"""

import contextlib
import fcntl
import json
import os
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jsecon.errors import InputError


def read_cells(file: Path) -> dict[str, Any]:
    """The values of the cells that `file` holds (none where there is no file yet), by key.

    Raises InputError where a whole line is no cell, as after a merge with conflicts. Warns of a cut last line.
    """
    try:
        stream = file.open("rb")
    except FileNotFoundError:
        return {}
    with stream:
        fcntl.flock(stream, fcntl.LOCK_SH)
        *lines, rest = stream.read().split(b"\n")
    if rest:
        warnings.warn(f"{file}: the last line is cut and left out: its cell will be computed again.", stacklevel=2)
    found = {}
    for number, line in enumerate(lines, 1):
        try:
            cell = json.loads(line)
            found[cell["key"]] = cell["value"]
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(
                file,
                f"line {number} is no cell: {line[:60]!r}",
                '{"key": ..., "value": ...} in every line',
                "Remove the line: if it was a cell, it will be computed again.",
            ) from error
    return found


def append_cell(file: Path, key: str, value: Any) -> None:
    """Adds a cell to `file`, after removing a last line that a killed process left cut (a warning says so)."""
    line = json.dumps({"key": key, "value": value}).encode() + b"\n"
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("a+b") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        stream.seek(0)
        held = stream.read()
        whole = held.rfind(b"\n") + 1
        if whole < len(held):
            warnings.warn(f"{file}: a cut last line was removed: {held[whole:][:60]!r}", stacklevel=2)
            stream.truncate(whole)
        stream.write(line)


@contextlib.contextmanager
def alone(file: Path, *, wait: bool) -> Iterator[bool]:
    """Holds the lock `file`; yields whether it does: without `wait`, False where another process holds it."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            yield False
            return
        try:
            yield True
        finally:
            # Who waits on the file unlinked here gets it next and finds the work done; who comes later makes a new one.
            file.unlink(missing_ok=True)


def helped(count: int) -> None:
    """`count` processes of this command with `--processes 0`, each with cores of its own, waited for; they are stopped
    where this one is interrupted. What one that failed has left undone is left to the caller.

    XLA has a thread for each core that it sees: two processes with all cores for each take 1.4 times as long. What one
    of them compiles the others read from disk.
    """
    command = [sys.executable, *sys.orig_argv[1:], "--processes", "0"]
    started = []
    with tempfile.TemporaryDirectory(prefix="jsecon-programs-", ignore_cleanup_errors=True) as programs:
        kept = {"JAX_COMPILATION_CACHE_DIR": programs, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
        try:
            for cores in shares(available(), count):
                with _on(cores):
                    started.append(subprocess.Popen(command, env=kept | os.environ))
            for process in started:
                process.wait()
        finally:
            for process in started:
                process.terminate()
            for process in started:
                process.wait()


def available() -> list[int]:
    """The cores that this process may run on, where the system tells (Linux), else none."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def shares(cores: list[int], count: int) -> list[list[int]]:
    """The cores of each of `count` processes, as even as can be; one each in turn where they are fewer."""
    return [cores[k::count] or cores[k % len(cores) :][:1] if cores else [] for k in range(count)]


@contextlib.contextmanager
def _on(cores: list[int]) -> Iterator[None]:
    """Processes started inside inherit these cores; none: all."""
    own = available()
    if cores:
        os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        if cores:
            os.sched_setaffinity(0, own)
