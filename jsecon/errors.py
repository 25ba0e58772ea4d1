"""The one error that a user sees for bad input: what was wrong, where, and what mends it."""


class InputError(ValueError):
    """Bad input from outside: a file, an option, a capture. The command line prints it and exits with code 2.

    `where` is the file or argument, `found` what is there, `expected` what should be, `remedy` what to do about it.
    """

    def __init__(self, where: object, *, found: str, expected: str, remedy: str):
        self.where, self.found, self.expected, self.remedy = str(where), found, expected, remedy
        super().__init__(f"{where}: found {found}; expected {expected}. {remedy}")


def require(condition: bool, name: str, *, got: object, expected: str, remedy: str) -> None:
    """Raise ValueError(got, expected, remedy) unless `condition`: for what is known at trace time (shapes, dtypes,
    options)."""
    if not condition:
        raise ValueError(f"{name}: got {got}, expected {expected}. {remedy}")
