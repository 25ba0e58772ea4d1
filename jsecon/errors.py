"""The one error that a user sees for bad input: what was wrong, where, and what mends it."""

from collections.abc import Iterable
from typing import Any

LONGEST = 600
"""characters of a place, and of what was found there, that an error quotes: of more, the beginning and the end"""


class InputError(ValueError):
    """Bad input from outside: a file, an option, a capture. The command line prints it and exits with code 2.

    `where` is the file or argument, `found` what is there, `expected` what should be, `remedy` what to do about it.
    """

    def __init__(self, where: object, found: str, expected: str, remedy: str):
        half = LONGEST // 2
        where, found = (t if len(t) <= LONGEST else f"{t[:half]} ... {t[-half:]}" for t in (str(where), found))
        self.where, self.found, self.expected, self.remedy = where, found, expected, remedy
        super().__init__(f"{where}: found {found}; expected {expected}. {remedy}")


def require(condition: bool, name: str, got: object, expected: str, remedy: str) -> None:
    """Raise ValueError(got, expected, remedy) unless `condition`: for what is known at trace time (shapes, dtypes,
    options)."""
    if not condition:
        raise ValueError(f"{name}: got {got}, expected {expected}. {remedy}")


def require_shape(name: str, array: Any, expected: tuple[Any, ...], remedy: str) -> None:
    """Raise ValueError unless an array has the expected shape: numbers, letters for any size, ... for leading axes."""
    got = tuple(array.shape)
    wanted = (*got[: len(got) - len(expected) + 1], *expected[1:]) if expected[0] is ... else expected
    fits = len(got) == len(wanted) and all(isinstance(size, str) or size == own for own, size in zip(got, wanted))
    told = ", ".join("..." if size is ... else str(size) for size in expected)
    require(fits, name, got, f"({told}{',' * (len(expected) == 1)})", remedy)


def require_one_of(name: str, got: object, choices: Iterable[str], remedy: str) -> None:
    """Raise ValueError unless an option is one of its choices."""
    choices = tuple(choices)
    require(got in choices, name, repr(got), " or ".join(map(repr, choices)), remedy)
