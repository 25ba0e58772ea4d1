"""Where the model and the capture of a field are: the hints that a run leaves in a field, and what they may lead to.

A field may come from anybody, so its hints are paths relative to its own file, absolute ones are never opened, and a
model is used only where the name that follows from its content is the one that the run used.
"""

import os
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, NamedTuple

from jsecon.errors import InputError
from jsecon.files import parse_json
from jsecon.pipeline.options import Options
from jsecon.types import LanguageField


class Sources(NamedTuple):
    """What a field's hints lead to; None where they lead nowhere."""

    embedder: str | None
    """name of the embedder that the run used."""
    model: Path | None
    """its folder, if that is still there."""
    capture: Path | None
    """the capture's, if that is still there."""


def relative_folders(options: Options, out: Path) -> dict[str, str]:
    """The hints of a run: option -> its folder as it is reached from that of the field."""
    told = {}
    for name in ("embedder", "capture"):
        if (folder := getattr(options, name)) is not None:
            try:
                told[name] = Path(os.path.relpath(os.path.realpath(folder), os.path.realpath(out))).as_posix()
            except ValueError:  # on another drive of Windows: it must be given again
                continue
    return told


def locate_sources(field: LanguageField, beside: Path | None = None) -> Sources:
    """Where the model and the capture of a field are, by the hints of its run.

    Args:
      field: The field.
      beside: The folder of its file; known already of a field that `load_field` read.

    Raises:
      InputError: The provenance is not what a run writes.
    """
    beside = getattr(field.provenance, "folder", None) if beside is None else beside
    try:
        told = parse_json(field.provenance or "{}")
    except ValueError:
        told = None
    parts: list[Any] = [_part(told, part, kind) for part, kind in _PARTS.items()]
    folders, name, options = parts
    if None in (folders, name, options) or not all(isinstance(hint, str) for hint in folders.values()):
        remedy = "Give the folders yourself, with --embedder and --images, or run the capture again."
        raise InputError("field", "its provenance is not what jsecon run writes", remedy=remedy)
    model, capture = (_folder(beside, folders.get(kind)) for kind in ("embedder", "capture"))
    return Sources(name or None, model, capture)


_PARTS: dict[str, type] = {"folders": dict, "embedder": str, "options": dict}


def _part(told: Any, name: str, kind: type) -> Any:
    """A part of a provenance, empty where it is missing; None where it is of another kind."""
    found = told.get(name, kind()) if isinstance(told, dict) else None
    return found if isinstance(found, kind) else None


def _folder(beside: Path | None, hint: str | None) -> Path | None:
    """A folder, or a video, from its hint; None where the hint is missing or absolute, or leads nowhere."""
    if beside is None or not hint or PurePosixPath(hint).is_absolute() or PureWindowsPath(hint).anchor:
        return None
    folder = os.path.normpath(os.path.join(beside, hint))
    return Path(folder) if os.path.exists(folder) else None
