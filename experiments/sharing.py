"""One table by several processes: who computes what is settled by locks on files, which the kernel frees with their
holder, so that nothing stale is left by a process that was stopped."""

import contextlib
import fcntl
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path


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

    XLA has a thread for each core that it sees: two processes with all cores for each take 1.4 times as long.
    """
    command = [sys.executable, *sys.orig_argv[1:], "--processes", "0"]
    started = []
    try:
        for cores in shares(available(), count):
            with _on(cores):
                started.append(subprocess.Popen(command))
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
