"""Where the model and the points of a field are: the hints that a run writes into a field, and what they lead to.

A field may come from anybody. So its hints are paths relative to its file, absolute paths are never opened, and a model
is used only if the name that follows from its content is the one that the run used.
"""

import contextlib
import dataclasses
import json
import os
from collections.abc import Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, NamedTuple

import jsecon
from jsecon.errors import InputError
from jsecon.field.field import Provenance
from jsecon.files import parse_json
from jsecon.networks.hub import cached_address
from jsecon.pipeline.options import Options, is_bare_scene
from jsecon.read.captures.capture import taken_on
from jsecon.read.splats.point_clouds import read_crs
from jsecon.types import LanguageField


class _Sources(NamedTuple):
    """What the hints of a field lead to."""

    model: Path | None
    """folder of the model of the run, if that still exists"""
    address: str | None
    """where the model is on the hub ("hub:owner/name@commit"), if the run took it from there"""
    points: Path | None
    """file of the points or Gaussians that the run was given, if that still exists"""


def provenance(options: Options, keys: dict[str, str], out: Path, warnings: Sequence[str] = ()) -> str:
    """Writes where the field of a run comes from, and what the run warned of."""
    values = {name: str(value) if isinstance(value, Path) else value for name, value in vars(options).items()}
    folders = {name: getattr(options, name) for name in ("segmenter", "tracker", "embedder")}
    addresses = {name: cached_address(folder) for name, folder in folders.items() if isinstance(folder, Path)}
    models = {name: address for name, address in addresses.items() if address is not None}
    origin = {"jsecon": jsecon.__version__, "options": values | models, "keys": keys}
    origin |= {"folders": _relative_folders(options, out), "models": models, "warnings": list(warnings)}
    cloud = _given_points(options)
    origin["crs"] = "" if cloud is None else read_crs(cloud)
    origin["date"] = options.date or taken_on(options.capture)
    return json.dumps(origin, sort_keys=True)


def forget_warnings(field: LanguageField, names: Sequence[str]) -> LanguageField:
    """Leaves out what the run warned of some frames."""
    warnings = parse_json(field.provenance).get("warnings", [])
    kept = [text for text in warnings if not any(name in text for name in names)]
    return _with_origin(field, getattr(field.provenance, "folder", None), warnings=kept)


def move_hints(field: LanguageField, folder: Path) -> LanguageField:
    """Makes the hints of a field, which are relative to its file, those of a file in another folder."""
    before, folder = getattr(field.provenance, "folder", None), folder.resolve()
    if before in (None, folder):
        return field
    found = {kind: _resolve(before, hint) for kind, hint in parse_json(field.provenance).get("folders", {}).items()}
    hints = {kind: hint for kind, path in found.items() if path is not None and (hint := _hint(path, folder))}
    return _with_origin(field, folder, folders=hints)


def _with_origin(field: LanguageField, folder: Path | None, **changes: Any) -> LanguageField:
    origin = Provenance(json.dumps(parse_json(field.provenance) | changes, sort_keys=True))
    if folder is not None:
        origin.folder = folder
    return dataclasses.replace(field, provenance=origin)


def _given_points(options: Options) -> Path | None:
    """The file of points or Gaussians of a run."""
    bare = is_bare_scene(options.capture)
    return options.capture if bare else options.points or options.gaussians


def _relative_folders(options: Options, out: Path) -> dict[str, str]:
    """Folders of options, relative to the output folder."""
    inputs = {"embedder": options.embedder, "points": _given_points(options)}
    paths = {name: Path(path) for name, path in inputs.items() if path is not None}
    return {name: hint for name, path in paths.items() if cached_address(path) is None and (hint := _hint(path, out))}


def _hint(path: Path, folder: Path) -> str:
    """A path relative to a folder; empty on another drive of Windows, where the user must name it again."""
    with contextlib.suppress(ValueError):
        return Path(os.path.relpath(os.path.realpath(path), os.path.realpath(folder))).as_posix()
    return ""


def locate_sources(field: LanguageField) -> _Sources:
    """Locates the model and the points of a field by the hints of its run."""
    beside = getattr(field.provenance, "folder", None)
    try:
        origin = parse_json(field.provenance or "{}")
        folders, models = (origin.get(name, {}) for name in ("folders", "models"))
        model, points = (_resolve(beside, folders.get(kind)) for kind in ("embedder", "points"))
        address = models.get("embedder")
        return _Sources(model, None if address is None else str(address), points)
    except (ValueError, TypeError, AttributeError) as error:
        remedy = "Give the model yourself (--embedder), or run the capture again."
        raise InputError("field", "its provenance is not what jsecon run writes", remedy=remedy) from error


def _resolve(beside: Path | None, hint: str | None) -> Path | None:
    """A file or folder from its hint; None if the hint is missing or absolute, or leads nowhere."""
    if beside is None or not hint or PurePosixPath(hint).is_absolute() or PureWindowsPath(hint).anchor:
        return None
    folder = os.path.normpath(os.path.join(beside, hint))
    return Path(folder) if os.path.exists(folder) else None
