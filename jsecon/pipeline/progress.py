"""Progress of a run: its stages, notes, results, and the time that is left.

A run reports to a `Listener`. The command line passes a `Console`, which prints results to standard output and draws
progress on standard error.
"""

import contextlib
import dataclasses
import io
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, Literal, TypeAlias

from tqdm import tqdm

Status: TypeAlias = Literal["run", "cached", "skipped"]

QUIET_SECONDS = 2.0
"""s; shorter steps show no progress"""
BAR_SECONDS = 0.5
"""s between two drawings of a bar, so that its clock runs while a step reports no count"""
LINE_SECONDS = 15.0
"""s between two lines of progress where standard error is not a terminal"""


@dataclasses.dataclass(frozen=True)
class Step:
    """A stage of a run, or a part of a stage that the run leaves out."""

    name: str
    """Name of the stage or part."""
    status: Status
    """Whether it runs, is read from the cache, or is left out."""
    why: str
    """How it is computed, or why it is left out."""


class Listener:
    """Receives the messages of a run. Each becomes a line for `say`, which this base class ignores."""

    def say(self, text: str) -> None:
        """Receives a line of results."""

    def step(self, step: Step) -> None:
        """Receives a step: first all that are planned, later also parts that only the data could settle."""
        self.say(f"  {step.name:<16} {step.status:<9} {step.why}".rstrip())

    def done(self, name: str, seconds: float, fresh: bool) -> None:
        """Receives the end of a stage."""
        if fresh:
            self.say(f"  {name:<16} {'done':<9} {seconds:.1f} s")

    def note(self, text: str) -> None:
        """Receives a note."""
        self.say(f"  note: {text}")

    @contextlib.contextmanager
    def progress(self, name: str) -> Iterator[Callable[[int, int], None]]:
        """Reports the progress of a step, for the body of a `with`."""
        yield lambda done, total: None


class Console(Listener):
    """The listener of the command line."""

    def __init__(self, out: Any = None, err: Any = None):
        self._out = out or sys.stdout
        self._err = err or sys.stderr

    def say(self, text: str) -> None:
        """Prints a line, above the bar if one is drawn."""
        with _Bar.external_write_mode(file=self._out):
            print(text, file=self._out, flush=True)

    @contextlib.contextmanager
    def progress(self, name: str) -> Iterator[Callable[[int, int], None]]:
        """Draws a bar with the time left on a terminal, and prints a line now and then elsewhere."""
        terminal = self._err.isatty()
        shown = (_Bar if terminal else _Lines)(name, self._err)
        ended = threading.Event()

        def draw() -> None:
            pause = QUIET_SECONDS
            while not ended.wait(pause):
                shown.draw()
                pause = BAR_SECONDS if terminal else LINE_SECONDS

        drawing = threading.Thread(target=draw, daemon=True)
        drawing.start()
        try:
            yield shown.count
        finally:
            ended.set()
            drawing.join()
            shown.end()


class _Bar(tqdm):
    """A tqdm bar on a terminal. `count` does not draw it, so that short steps show no bar."""

    monitor_interval = 0  # without the thread of tqdm that redraws bars

    def __init__(self, name: str, file: Any):
        self._drawn = False
        super().__init__(desc=f"  {name}", file=file, leave=False, dynamic_ncols=True, delay=QUIET_SECONDS)
        self._time = time.monotonic  # a clock that cannot be set back
        self.start_t = self.last_print_t = time.monotonic()

    def count(self, done: int, total: int) -> None:
        """Sets the progress. A new total or a smaller count starts the estimate of the time left afresh."""
        with self.get_lock():
            if total != self.total or done < self.n:
                self.total = total
                self.initial = done
                self.start_t = time.monotonic()
            self.n = done

    def draw(self) -> None:
        """Draws the bar."""
        self.refresh()

    def display(self, msg: str | None = None, pos: int | None = None) -> None:
        """Writes the bar to the terminal."""
        self._drawn = True
        super().display(msg, pos)

    def end(self) -> None:
        """Removes the bar."""
        if self._drawn:
            self.clear()
        self.close()


_Bar.set_lock(threading.RLock())  # one lock of C: a signal could leave the pair of locks of tqdm half taken


class _Lines(_Bar):
    """A line of text at each `draw`, for logs."""

    def __init__(self, name: str, file: Any):
        self._began = time.monotonic()
        self._log = file
        super().__init__(name, io.StringIO())

    def draw(self) -> None:
        """Prints the time left, or the time so far if it cannot be estimated."""
        with self.get_lock():
            if self.total and self.initial < self.n < self.total:
                left = (time.monotonic() - self.start_t) / (self.n - self.initial) * (self.total - self.n)
                text = f"{self.n} of {self.total}, about {left:.0f} s left"
            else:
                text = f"{time.monotonic() - self._began:.0f} s so far"
        print(f"{self.desc}: {text}", file=self._log, flush=True)
