"""What a run says while it works, and to whom: the stages that it will run, each as it is done, notes, time left."""

import contextlib
import dataclasses
import functools
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Literal, Protocol, TypeAlias, runtime_checkable

from tqdm import tqdm

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


QUIET_SECONDS = 2.0
"""a step shorter than this shows no bar"""
LINE_SECONDS = 15.0
"""between two lines of progress where standard error is no terminal"""


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
        with tqdm.external_write_mode(file=self._out):
            print(text, file=self._out, flush=True)

    def note(self, text: str) -> None:
        self.say(f"  note: {text}")

    @contextlib.contextmanager
    def progress(self, name: str) -> Iterator[Progress]:
        """Draws a bar with the time left, or writes a line now and then."""
        with contextlib.closing((_Bar if self._err.isatty() else _Lines)(name, self._err)) as shown:
            yield shown.update


class _Bar:
    """A tqdm bar that appears after two seconds and starts afresh when the total changes or the count falls back."""

    def __init__(self, name: str, err: Stream):
        self._bar = None
        self._new = functools.partial(
            tqdm, desc=f"  {name}", file=err, leave=False, delay=QUIET_SECONDS, dynamic_ncols=True
        )

    def update(self, done: int, total: int) -> None:
        if self._bar is not None and (total != self._bar.total or done < self._bar.n):
            self.close()
        if self._bar is None:
            self._bar = self._new(total=total, initial=done)
        self._bar.update(done - self._bar.n)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


class _Lines:
    """A line every so many seconds, for logs."""

    def __init__(self, name: str, err: Stream):
        self._name, self._err = name, err
        self._begin(0, None)
        self._last = self._started

    def _begin(self, done: int, total: int | None) -> None:
        self._started, self._first, self._total, self._done = time.monotonic(), done, total, done

    def update(self, done: int, total: int) -> None:
        if total != self._total or done < self._done:
            self._begin(done, total)
        self._done, now = done, time.monotonic()
        if done > self._first and now - self._last >= LINE_SECONDS:
            left = (now - self._started) / (done - self._first) * (total - done)
            print(f"  {self._name}: {done} of {total}, about {left:.0f} s left", file=self._err, flush=True)
            self._last = now

    def close(self) -> None:
        pass
