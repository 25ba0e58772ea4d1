"""The one error that a user sees for bad input: what is wrong, where, and what to do about it."""

from collections.abc import Iterable
from typing import Any

LONGEST = 600
"""characters of a place, and of what is wrong there, that an error quotes: of more, the beginning and the end"""


class InputError(ValueError):
    """Bad input from outside: a file, an option, a capture. The command line prints it and exits with code 2.

    It prints as "WHERE: PROBLEM, expected EXPECTED. REMEDY", for example "images.txt: line 7 has 9 fields, expected 10.
    Export the model again."; without `expected` as "WHERE: PROBLEM. REMEDY".

    Args:
      where: The file or argument; empty if `problem` names it.
      problem: What is wrong there: a clause without a full stop, or what is there in place of `expected`.
      expected: What should be there.
      remedy: What to do about it, a sentence.
    """

    def __init__(self, where: object, problem: str, expected: str = "", remedy: str = ""):
        half = LONGEST // 2
        where, problem = (t if len(t) <= LONGEST else f"{t[:half]} ... {t[-half:]}" for t in (str(where), problem))
        self.where, self.problem, self.expected, self.remedy = where, problem, expected, remedy
        super().__init__(f"{where}: {self.sentence} {remedy}".removeprefix(": ").rstrip())

    @property
    def sentence(self) -> str:
        """What is wrong, as a sentence, without where and without the remedy."""
        return f"{self.problem.rstrip('.')}{f', expected {self.expected}' if self.expected else ''}."


def describe_error(error: BaseException) -> str:
    """Why something failed, in words that a user knows: without the name of a Python exception, on one line."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.partition(" (")[0]
    if isinstance(error, KeyError) and error.args:
        return f"{error.args[0]!r} is missing"
    if isinstance(error, UnicodeDecodeError):
        return "its text is not UTF-8"
    if isinstance(error, MemoryError):
        return "memory has no room for it"
    if isinstance(error, TypeError | AttributeError | LookupError):
        return "its values are of another kind or number"
    return (str(error).strip().splitlines() or ["it ends early"])[0].rstrip(".")


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
