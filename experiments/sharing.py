"""One table by several processes: who computes what is settled by locks on files, which the kernel frees with their
holder, so that nothing stale is left by a process that was stopped."""

import contextlib
import fcntl
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


@contextlib.contextmanager
def helpers(count: int) -> Iterator[None]:
    """`count` more processes of this command with `--processes 0`: waited for, or stopped where this one fails."""
    command = [sys.executable, *sys.orig_argv[1:], "--processes", "0"]
    started = [subprocess.Popen(command) for _ in range(count)]
    try:
        yield
    except BaseException:
        for process in started:
            process.terminate()
        raise
    finally:
        for process in started:
            process.wait()
