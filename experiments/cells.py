"""The cells of a table in one file, and the processes that fill it side by side.

A file of cells (cells.jsonl) holds one line per cell, {"key": ..., "value": ...}. Finished cells are appended and lines
are never changed. If a key occurs twice, the later line counts. Cells of finished tables can be kept compressed beside
it (cells.jsonl.xz); they are read first and never written to.

Readers and writers hold a kernel lock on the file (flock, shared among readers). A process that is killed while it
writes leaves part of a line. Under the lock an incomplete last line can only be such a rest: readers skip it, the next
writer removes it, and both warn. Further lock files decide which process computes which setting (`exclusive_lock`).
The kernel releases all locks when a process ends, so that a killed process leaves no stale lock.
"""

import contextlib
import fcntl
import json
import lzma
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
    """Reads the values of all cells.

    Args:
      file: The file of cells. It may not exist yet.

    Returns:
      Values by key, of `file` and of the compressed file beside it.

    Raises:
      InputError: A complete line is not a cell, as after a merge with conflicts.
    """
    packed = file.with_name(f"{file.name}.xz")
    lines = lzma.decompress(packed.read_bytes()).split(b"\n")[:-1] if packed.exists() else []
    if file.exists():
        with file.open("rb") as stream:
            fcntl.flock(stream, fcntl.LOCK_SH)
            *own, rest = stream.read().split(b"\n")
        lines += own
        if rest:
            warnings.warn(f"{file}: skipped an incomplete last line. Its cell is computed again.", stacklevel=2)
    cells = {}
    for number, line in enumerate(lines, 1):
        try:
            cell = json.loads(line)
            cells[cell["key"]] = cell["value"]
        except (ValueError, KeyError, TypeError) as error:
            remedy = "Remove the line: if it was a cell, it will be computed again."
            raise InputError(file, f"line {number} is no cell: {line[:60]!r}", remedy=remedy) from error
    return cells


def append_cell(file: Path, key: str, value: Any) -> None:
    """Appends a cell to `file`. Removes an incomplete last line of a killed process first, with a warning."""
    line = json.dumps({"key": key, "value": value}).encode() + b"\n"
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("a+b") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        stream.seek(0)
        content = stream.read()
        end = content.rfind(b"\n") + 1
        if end < len(content):
            warnings.warn(f"{file}: removed an incomplete last line: {content[end:][:60]!r}", stacklevel=2)
            stream.truncate(end)
        stream.write(line)


@contextlib.contextmanager
def exclusive_lock(file: Path, *, wait: bool) -> Iterator[bool]:
    """Holds the lock `file` and yields True; without `wait`, yields False if another process holds it."""
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
            # A process that waits for the unlinked file gets it next and sees the finished work.
            file.unlink(missing_ok=True)


def run_helpers(count: int) -> None:
    """Runs this command `count` times with `--processes 0`, each process on its share of the cores, and waits.

    XLA starts a thread for each core that it sees: two processes that see all cores take 1.4 times as long. The
    processes share compiled programs on disk. They stop if this process is interrupted; the caller computes what a
    failed one leaves undone.

    Args:
      count: Number of processes.
    """
    command = [sys.executable, *sys.orig_argv[1:], "--processes", "0"]
    started = []
    with tempfile.TemporaryDirectory(prefix="jsecon-programs-", ignore_cleanup_errors=True) as programs:
        programs_cache = {"JAX_COMPILATION_CACHE_DIR": programs, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
        try:
            for cores in split_cores(available_cores(), count):
                with _pinned(cores):
                    started.append(subprocess.Popen(command, env=programs_cache | os.environ))
            for process in started:
                process.wait()
        finally:
            for process in started:
                process.terminate()
            for process in started:
                process.wait()


def available_cores() -> list[int]:
    """Cores that this process may run on; empty if the system cannot tell (other than Linux)."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def split_cores(cores: list[int], count: int) -> list[list[int]]:
    """Divides cores evenly among `count` processes; several processes share a core if there are fewer cores."""
    return [cores[k::count] or cores[k % len(cores) :][:1] if cores else [] for k in range(count)]


@contextlib.contextmanager
def _pinned(cores: list[int]) -> Iterator[None]:
    """Processes that start inside inherit these cores, or all if the list is empty."""
    before = available_cores()
    if cores:
        os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        if cores:
            os.sched_setaffinity(0, before)
