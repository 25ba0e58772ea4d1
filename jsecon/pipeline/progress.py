"""What a run says while it works, and to whom: the stages that it will run, each as it is done, notes, time left."""

import contextlib
import dataclasses
import functools
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Literal, Protocol, TypeAlias, runtime_checkable

from tqdm import tqdm

from jsecon.process import compiling

Progress: TypeAlias = Callable[[int, int], None]
"""told how far a step has come: (done, total)"""
Status: TypeAlias = Literal["run", "cached", "left out"]


@dataclasses.dataclass(frozen=True)
class Step:
    """A stage, or a part of one, and what becomes of it."""

    name: str
    """stage, or the part of one that is left out."""
    status: Status
    why: str
    """how it will be done, or why not."""


class Listener:
    """Whoever is told of a run: the command line (`Console`), a test. This one keeps it to itself."""

    def steps(self, title: str, steps: Sequence[Step]) -> None:
        """All that is known before any of it runs."""

    def step(self, step: Step) -> None:
        """A line that only the data could settle."""

    def done(self, name: str, seconds: float, fresh: bool) -> None:
        """A stage has ended; `fresh`: it was computed now."""

    def note(self, text: str) -> None:
        """Something the user should know about the input or the run."""

    def say(self, text: str) -> None:
        """A line of results."""

    @contextlib.contextmanager
    def progress(self, name: str) -> Iterator[Progress]:
        """A callback `(done, total)` for the time of a step."""
        yield lambda done, total: None


class _Tqdm(tqdm):
    """A bar whose lock is one of C: a stop could leave tqdm's own, two in Python, half taken."""


_Tqdm.set_lock(threading.RLock())
QUIET_SECONDS = 2.0
"""a step shorter than this shows nothing"""
LINE_SECONDS = 15.0
"""between two lines of progress where standard error is no terminal"""
TICK_SECONDS = 0.5
"""between two looks at a step that tells nothing itself"""


@runtime_checkable
class Stream(Protocol):
    """Where lines go: sys.stdout, sys.stderr, or what stands in for them."""

    def write(self, text: str, /) -> object: ...

    def flush(self) -> None: ...

    def isatty(self) -> bool: ...


class Console(Listener):
    """The listener of the command line: results on standard output, progress and time left on standard error."""

    def __init__(self, out: Stream | None = None, err: Stream | None = None):
        self._out, self._err = out or sys.stdout, err or sys.stderr

    def steps(self, title: str, steps: Sequence[Step]) -> None:
        self.say(title)
        for step in steps:
            self.step(step)

    def step(self, step: Step) -> None:
        self.say(f"  {step.name:<16} {step.status:<9} {step.why}".rstrip())

    def done(self, name: str, seconds: float, fresh: bool) -> None:
        if fresh:
            self.say(f"  {name:<16} {'done':<9} {seconds:.1f} s")

    def say(self, text: str) -> None:
        with _Tqdm.external_write_mode(file=self._out):
            print(text, file=self._out, flush=True)

    def note(self, text: str) -> None:
        self.say(f"  note: {text}")

    @contextlib.contextmanager
    def progress(self, name: str) -> Iterator[Progress]:
        """Draws a bar with the time left, or writes a line now and then. What tells nothing for a while, as jax does
        while it compiles, shows its own time."""
        shown, ended = (_Bar if self._err.isatty() else _Lines)(name, self._err), threading.Event()

        def tick() -> None:
            while not ended.wait(TICK_SECONDS):
                shown.tick()

        ticking = threading.Thread(target=tick, daemon=True)
        ticking.start()
        try:
            yield shown.update
        finally:
            ended.set()
            ticking.join()
            shown.close()


def _doing(name: str) -> str:
    """The step, and that jax compiles for it where it does."""
    kept = ", once on this machine" if os.environ.get("JAX_COMPILATION_CACHE_DIR") else ""
    return f"  {name}: compiling{kept}" if compiling() else f"  {name}"


class _Bar:
    """A tqdm bar that appears after two seconds and starts afresh when the total changes or the count falls back; until
    something is counted, a clock."""

    def __init__(self, name: str, err: Stream):
        self._name, self._started, self._bar, self._alone = name, time.monotonic(), None, threading.Lock()
        self._new = functools.partial(_Tqdm, file=err, leave=False, dynamic_ncols=True)

    def update(self, done: int, total: int) -> None:
        with self._alone:
            if self._bar is not None and (total != self._bar.total or done < self._bar.n):
                self._end()
            if self._bar is None:
                left = max(0.0, QUIET_SECONDS - (time.monotonic() - self._started))
                self._bar = self._new(total=total, initial=done, desc=f"  {self._name}", delay=left)
            self._bar.update(done - self._bar.n)

    def tick(self) -> None:
        with self._alone:
            if time.monotonic() - self._started < QUIET_SECONDS:
                return
            if self._bar is None:
                self._bar = self._new(bar_format="{desc}[{elapsed}]", delay=QUIET_SECONDS)
                self._bar.start_t -= time.monotonic() - self._started
            self._bar.set_description(_doing(self._name))

    def _end(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def close(self) -> None:
        with self._alone:
            self._end()


class _Lines:
    """A line after two seconds and then every so many, for logs."""

    def __init__(self, name: str, err: Stream):
        self._name, self._err, self._alone = name, err, threading.Lock()
        self._begin(0, 0)
        self._first_of_all, self._due = self._started, self._started + QUIET_SECONDS

    def _begin(self, done: int, total: int) -> None:
        self._started, self._first, self._total, self._done = time.monotonic(), done, total, done

    def update(self, done: int, total: int) -> None:
        with self._alone:
            if total != self._total or done < self._done:
                self._begin(done, total)
            self._done = done
        self.tick()

    def tick(self) -> None:
        with self._alone:
            if (now := time.monotonic()) < self._due:
                return
            told, counted = f"{now - self._first_of_all:.0f} s so far", self._done - self._first
            if counted > 0 and self._done < self._total:
                left = (now - self._started) / counted * (self._total - self._done)
                told = f"{self._done} of {self._total}, about {left:.0f} s left"
            print(f"{_doing(self._name)}: {told}", file=self._err, flush=True)
            self._due = now + LINE_SECONDS

    def close(self) -> None:
        pass
