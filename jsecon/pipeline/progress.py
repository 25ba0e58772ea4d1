"""Progress of a run: its stages, notes, results, and the time that is left."""

import contextlib
import dataclasses
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, Literal, TypeAlias

Status: TypeAlias = Literal["run", "cached"]

QUIET_SECONDS = 2.0
"""s; shorter steps show no progress"""


@dataclasses.dataclass(frozen=True)
class Step:
    """A stage of a run."""

    name: str
    """Name of the stage."""
    status: Status
    """Whether it runs or is read from the cache."""
    why: str
    """How it is computed."""


class Console:
    """Prints the messages of a run as lines to `out`, and draws its progress on `err`. Without these it is silent."""

    def __init__(self, out: Any = None, err: Any = None):
        self._out, self._err = out, err
        self._lock = threading.RLock()  # of what is printed
        self._drawn = False  # a line of progress on the terminal

    def print_line(self, text: str) -> None:
        """Prints a line, in place of a line of progress that is drawn."""
        if self._out is not None:
            with self._lock:
                self._erase()
                print(text, file=self._out, flush=True)

    def done(self, name: str, seconds: float, fresh: bool) -> None:
        """Prints the end of a stage."""
        if fresh:
            self.print_line(f"  {name:<16} {'done':<9} {seconds:.1f} s")

    def note(self, text: str) -> None:
        """Prints a note."""
        self.print_line(f"  note: {text}")

    @contextlib.contextmanager
    def progress(self, name: str) -> Iterator[Callable[[int, int], None]]:
        """Shows the time left: in one line that is drawn again on a terminal, in a line now and then elsewhere."""
        if self._err is None:
            yield lambda done, total: None
            return
        clock, ended, terminal = _Clock(name), threading.Event(), self._err.isatty()

        def draw() -> None:
            pause = QUIET_SECONDS
            while not ended.wait(pause):
                with self._lock:
                    self._drawn = terminal
                    line = f"\r{clock.line}\x1b[K" if terminal else f"{clock.line}\n"
                    self._err.write(line)
                    self._err.flush()
                pause = 0.5 if terminal else 15.0

        drawing = threading.Thread(target=draw, daemon=True)
        drawing.start()
        try:
            yield clock.count
        finally:
            ended.set()
            drawing.join()
            self._erase()

    def _erase(self) -> None:
        if self._drawn:
            self._err.write("\r\x1b[K")
            self._err.flush()
            self._drawn = False


class _Clock:
    """The progress of a step. A new total or a smaller count starts the estimate of the time left afresh."""

    def __init__(self, name: str):
        self._name, self._began = name, time.monotonic()
        self._since, self._first, self._state = self._began, 0, (0, 0)

    def count(self, done: int, total: int) -> None:
        if total != self._state[1] or done < self._state[0]:
            self._since, self._first = time.monotonic(), done
        self._state = done, total

    @property
    def line(self) -> str:
        """The time left, or the time so far if it cannot be estimated."""
        now, (done, total) = time.monotonic(), self._state
        if self._first < done < total:
            left = (now - self._since) / (done - self._first) * (total - done)
            return f"  {self._name}: {done} of {total}, about {left:.0f} s left"
        return f"  {self._name}: {now - self._began:.0f} s so far"
