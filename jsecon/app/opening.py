"""Finds the field that a path names: a field's file, the folder of a run, or a splat of which a field is made.

Only names and first bytes are read, without jax, so that a server can answer before its fields are open.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

from jsecon.errors import InputError
from jsecon.files import FIELD_FILE, describe_substitute, reading
from jsecon.pipeline.options import is_bare_scene

T = TypeVar("T")
_REMEDY = "Give field.safetensors, the folder that jsecon run wrote it to, a splat or a point cloud."


class _FieldPath(NamedTuple):
    """Where a field is, or will be."""

    named: Path
    """path that the field is named after: its folder, or its scene"""
    file: Path
    """the field's file, which a splat may not have yet"""
    splat: Path | None
    """the file of Gaussians of which the field is made"""


def locate_field(path: Path) -> _FieldPath:
    """Finds the field that a path names, or raises an InputError that describes the file.

    That of a splat is in NAME_field beside NAME.ply.
    """
    with reading(path):
        if path.is_dir():
            if not (path / FIELD_FILE).is_file():
                remedy = f"Give the folder that jsecon run wrote, or make a field: jsecon run {path} --out my_field"
                raise InputError(path, f"a folder without {FIELD_FILE}", "the folder of a field", remedy)
            return _FieldPath(path.resolve(), path / FIELD_FILE, None)
        if not path.exists():
            raise InputError(path, "no such file", "a field file", f"Check the path. {_REMEDY}")
        with path.open("rb") as file:
            head = file.read(16)
    splat = is_bare_scene(path)
    if (substitute := describe_substitute(path, in_place=splat)) is not None:
        remedy = substitute[1] if splat or path.name == FIELD_FILE else _REMEDY
        raise InputError(path, f"it is {substitute[0]}", "" if splat else "a field", remedy)
    if splat:
        file = path.with_name(f"{path.stem}_field") / FIELD_FILE
        return _FieldPath(path.resolve().with_suffix(""), file, path)
    if path.suffix != ".safetensors" and head[8:9] != b"{":  # what is damaged is the reader's to say
        raise InputError(path, "it is a file of another kind" if head else "it is an empty file", "a field", _REMEDY)
    place = path.resolve()
    return _FieldPath(place.parent if path.name == FIELD_FILE else place.with_suffix(""), path, None)


def name_fields(paths: Sequence[Path]) -> dict[str, Path]:
    """Names fields after their folders or scenes; those of one name by as many folders as tell them apart."""
    named = [locate_field(path).named.parts for path in paths]
    names: dict[str, Path] = {}
    for path, parts in zip(paths, named):
        if named.count(parts) > 1:
            raise InputError(path, "the field is given twice", remedy="Give it once.")
        depths = range(1, len(parts) + 1)
        depth = next(n for n in depths if sum(other[-n:] == parts[-n:] for other in named) == 1)
        names["/".join(parts[-depth:])] = path
    return names


def find_scene(scenes: Mapping[str, T], name: str | None) -> T:
    """Returns the scene of a name; the first if the name is None."""
    if name is None:
        return next(iter(scenes.values()))
    if name not in scenes:
        raise InputError(f"field {name!r}", "there is no such field", remedy=f"There are {', '.join(scenes)}.")
    return scenes[name]
