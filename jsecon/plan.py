"""What a run is about to do, and who is told: the lines of a plan, and the protocol of whoever reports it."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Literal, Protocol, TypeAlias, runtime_checkable

Progress: TypeAlias = Callable[[int, int], None]
"""told how far a step has come: (done, total)"""
Status: TypeAlias = Literal["run", "cached", "left out"]


@dataclasses.dataclass(frozen=True)
class Step:
    """One line of the plan."""

    name: str
    """stage, or the part of one that is left out."""
    status: Status
    why: str
    """how it will be done, or why not."""


@runtime_checkable
class Reporter(Protocol):
    """Whoever is told of a run: the command line, a notebook, nobody."""

    def plan(self, title: str, steps: Sequence[Step]) -> None: ...

    def step(self, step: Step) -> None:
        """A line that only the data could settle, after the plan."""
        ...

    def done(self, name: str, seconds: float, fresh: bool) -> None: ...

    def note(self, text: str) -> None: ...

    def say(self, text: str) -> None: ...

    def progress(self, name: str) -> contextlib.AbstractContextManager[Progress]: ...


class Silent:
    """Tells nobody."""

    def plan(self, title: str, steps: Sequence[Step]) -> None:
        pass

    def step(self, step: Step) -> None:
        pass

    def done(self, name: str, seconds: float, fresh: bool) -> None:
        pass

    def note(self, text: str) -> None:
        pass

    def say(self, text: str) -> None:
        pass

    @contextlib.contextmanager
    def progress(self, name: str) -> Iterator[Progress]:
        yield lambda done, total: None
