"""Writing files so that a final name never holds a half-written file."""

import contextlib
import os
import uuid
from collections.abc import Iterator
from pathlib import Path

from jsecon.errors import InputError


@contextlib.contextmanager
def written_whole(path: str | os.PathLike) -> Iterator[Path]:
    """Yields a temporary path beside `path`; on leaving it is renamed to `path`, or removed if the body raised.

    The temporary name keeps `path`'s ending, for writers that choose the format by it. Raises InputError where the
    folder cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:8]}.partial{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch()
    except OSError as error:
        found, remedy = f"{error.strerror} on writing to {path.parent}", "Choose another, or mend its permissions."
        raise InputError(path, found, "a folder that can be written", remedy) from error
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: str | os.PathLike, text: str) -> None:
    """Writes `text` (UTF-8) to `path`, whole or not at all."""
    with written_whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
