"""The error for bad input, and checks of arguments. Each message says what is wrong, where, and what to do."""

import errno
from collections.abc import Iterable, Sequence
from typing import Any


class InputError(ValueError):
    """Bad input from outside: a file, an option, a capture. The command line prints it and exits with code 2.

    It prints as "WHERE: PROBLEM, expected EXPECTED. REMEDY", for example "images.txt: line 7 has 9 fields, expected 10.
    Export the model again."; without `expected` as "WHERE: PROBLEM. REMEDY".

    Args:
      where: The file or argument; empty if `problem` names it.
      problem: What is wrong there: a clause without a full stop, or what is there in place of `expected`.
      expected: What should be there.
      remedy: What to do about it, a sentence.

    Attributes:
      sentence: The problem as a sentence, without the place and the remedy.
    """

    def __init__(self, where: object, problem: str, expected: str = "", remedy: str = ""):
        texts = [t if len(t) <= 600 else f"{t[:300]} ... {t[-300:]}" for t in (str(where), problem)]
        self.where, self.problem = texts
        self.expected = expected
        self.remedy = remedy
        self.sentence = f"{self.problem.rstrip('.')}{f', expected {expected}' if expected else ''}."
        super().__init__(f"{self.where}: {self.sentence} {remedy}".removeprefix(": ").rstrip())


_MACHINE = {
    errno.EACCES: "Mend the permissions of the file and of its folders.",
    errno.EPERM: "Mend the permissions of the file and of its folders.",
    errno.EMFILE: "Raise the limit of open files, for example: ulimit -n 4096",
    errno.ENFILE: "Close other programs: the machine has no file handle left.",
    errno.EIO: "Check the disk, or the connection to it.",
    errno.ENOMEM: "End other programs, or take a machine with more memory.",
}
_MACHINE |= dict.fromkeys((errno.ESTALE, errno.ETIMEDOUT, errno.ENODEV, errno.ENXIO), _MACHINE[errno.EIO])
"""errors of the machine, which say nothing about the content of a file, and what to do about them"""


def machine_error(error: BaseException, path: object) -> InputError | None:
    """Returns the error to raise where reading a file fails by the machine and not by the file's content, else None."""
    if not isinstance(error, OSError) or error.errno not in _MACHINE:
        return None
    return InputError(error.filename or path, describe_error(error), remedy=_MACHINE[error.errno])


def join_first(names: Sequence[str]) -> str:
    """Joins the first four of some names, and their number if there are more."""
    return ", ".join(names[:4]) + (f", ... ({len(names)})" if len(names) > 4 else "")


def is_out_of_memory(error: BaseException) -> bool:
    """Whether NumPy or jax found no memory for an array."""
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "RESOURCE_EXHAUSTED" in str(error))


def describe_error(error: BaseException) -> str:
    """Describes an exception without its Python name."""
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
    """Checks what is known at trace time: shapes, dtypes, options."""
    if not condition:
        raise ValueError(f"{name}: got {got}, expected {expected}. {remedy}")


def require_shape(name: str, array: Any, expected: tuple[Any, ...], remedy: str) -> None:
    """Checks the shape of an array."""
    got = tuple(array.shape)
    shape = (*got[: len(got) - len(expected) + 1], *expected[1:]) if expected[0] is ... else expected
    fits = len(got) == len(shape) and all(isinstance(size, str) or size == actual for actual, size in zip(got, shape))
    sizes = ", ".join("..." if size is ... else str(size) for size in expected)
    require(fits, name, got, f"({sizes}{',' * (len(expected) == 1)})", remedy)


def require_one_of(name: str, got: object, choices: Iterable[str], remedy: str) -> None:
    """Checks that an option is one of its choices."""
    choices = tuple(choices)
    require(got in choices, name, repr(got), " or ".join(map(repr, choices)), remedy)
