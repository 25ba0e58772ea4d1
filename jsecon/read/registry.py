"""Registries of readers: the table of formats that a file or folder may have.

A row has the name of a format, the marks that tell it, and the function that reads it. Other packages add rows by an
entry point whose object is a `Reader`; the groups are jsecon.captures, jsecon.masks and jsecon.splats.
"""

import contextlib
import functools
import importlib
import importlib.metadata
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jsecon.errors import InputError, describe_error

SCENES = (".ply", ".spz", ".sog", ".splat", ".las", ".laz", ".e57", ".pcd", ".xyz", ".txt")
"""suffixes of files of Gaussians or points, which may be scenes without photographs"""


class Reader(NamedTuple):
    """A format, the marks that tell it, and the function that reads it."""

    name: str
    marks: tuple[str, ...]
    """Ends of a file's name, which begin with "." or "_" (".spz", "_s.npy"): one must fit. Or names in a folder, which
    may be patterns ("rgb.txt", "sparse/*/cameras.bin"): all must be there."""
    read: Callable[..., Any]
    """Reads the file or folder. Raises InputError, or a built-in error of a damaged file (jsecon.files.READ_ERRORS)."""

    def fits(self, path: Path) -> bool:
        """Whether a file or folder has the marks."""
        if path.is_dir():
            return not self.marks[0].startswith((".", "_")) and all(any(path.glob(mark)) for mark in self.marks)
        name = path.name.lower()
        return any(name.endswith(mark) for mark in self.marks if mark.startswith((".", "_")))


def readers(group: str, own: Sequence[Reader]) -> tuple[Reader, ...]:
    """Lists the readers of installed packages, by their entry points in `group`, and then jsecon's `own`."""
    return (*_added_readers(group, tuple(sys.path)), *own)


@functools.lru_cache
def _added_readers(group: str, path: tuple[str, ...]) -> tuple[Reader, ...]:
    """The readers of packages on a search path, whose listing takes some 10 ms."""
    added = []
    for entry in importlib.metadata.entry_points(group=group):
        try:
            reader = entry.load()
            if not isinstance(reader, Reader):
                raise ValueError(f"it is a {type(reader).__name__}")
        except Exception as error:  # whatever a foreign package raises when it is imported
            problem = f"the reader {entry.value} of another package cannot be loaded ({describe_error(error)})"
            remedy = "Update or uninstall the package that registers it."
            raise InputError(f"{group}:{entry.name}", problem, remedy=remedy) from error
        added.append(reader)
    return tuple(added)


@contextlib.contextmanager
def decoding(path: Path, name: str) -> Iterator[Any]:
    """Yields a package of the extra formats; whatever it raises on damaged bytes becomes an InputError."""
    import numpy as np  # late: to read a command line needs none of it

    try:
        with np.errstate(invalid="ignore", over="ignore"):
            yield importlib.import_module(name)
    except ImportError as error:
        problem = f"a {path.suffix.lower()} like this needs the package {error.name or name}, which is not installed"
        raise InputError(path, problem, remedy="Run: pip install 'jsecon[formats]'") from error
    except Exception as error:
        problem = f"the file is damaged or cut short ({describe_error(error).replace(f': {path}', '')})"
        raise InputError(path, problem, remedy="Export it again.") from error
