"""The language field as one safetensors file. No pickle.

Its arrays are named by their place, such as "gaussians.means". The description that `jsecon.files.write_arrays` keeps
beside them is {"format", "version", "field"}; "field" is the tree as `jsecon.files.packed` describes it, records by
their class names, each array with its type and shape. A reader ignores fields of a record that it does not know. A
change of the meaning of known ones needs another `version`.
"""

import dataclasses
import functools
import os
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jsecon.backend import start_backend
from jsecon.errors import InputError, require
from jsecon.field.columns import ROWS
from jsecon.files import atomic_write, pack_tree, read_arrays, reading, unpack_tree, write_arrays
from jsecon.splat.project import unusable_rows
from jsecon.splat.sh import COEFFICIENT_COUNTS
from jsecon.types import Autoencoder, Camera, Codes, Event, Gaussians, LanguageField, Regions, UpAxis, Votes

VERSION = 3
_RECORDS = {
    cls.__name__: cls for cls in (LanguageField, Gaussians, Votes, Regions, Camera, Codes, Autoencoder, UpAxis, Event)
}
MAPPED = 1 << 20
"""bytes of a column from which a mapped field leaves it on disk"""
_REMEDY = "Make the field again with `jsecon run`."
_LETTERS = {
    "n": ("gaussians.means", 0),
    "r": ("regions.pixel_counts", 0),
    "d": ("codes.regions", -1),
    "e": ("regions.embeddings", -1),
    "t": ("cameras.world_to_camera", 0),
    "k": ("votes.regions", -1),
    "c": ("canonical_phrases", 0),
    "w": ("unrelated_words", 0),
    "b": ("gaussians.sh", 1),
    "m": ("tree", 0),
    "p": ("part_nodes", 0),
}
"""Array and axis of each of a field's sizes."""
_SHAPES = {
    ("n", 3): "gaussians.means gaussians.log_scales",
    ("n", 4): "gaussians.quaternions",
    ("n", "b", 3): "gaussians.sh",
    ("n",): "gaussians.opacity_logits votes.labelled votes.total votes.max_pixel_weight votes.views leaf",
    ("n", "d"): "codes.gaussians",
    ("n", "k"): "votes.regions votes.weights votes.weight_where_region_visible",
    ("r", "e"): "regions.embeddings",
    ("r", "d"): "codes.regions",
    ("r", "r"): "votes.overlap",
    ("t", 4, 4): "cameras.world_to_camera",
    ("t",): "cameras.fx cameras.fy cameras.cx cameras.cy",
    (): "votes.overflow",
    ("c", "e"): "canonical_phrases",
    ("w", "e"): "unrelated_words",
    (4, 4): "source_from_scene",
    ("m",): "tree",
    ("p",): "part_nodes",
    ("p", "e"): "part_regions.embeddings",
}
_OPTIONAL = (
    "gaussians.sh", "votes.weight_where_region_visible", "votes.overlap", "unrelated_words",
    "codes.gaussians", "codes.regions", "tree", "leaf", "part_regions.embeddings", "part_nodes",
)  # fmt: skip


def save_field(path: str | os.PathLike, field: LanguageField) -> None:
    """Writes a field to a file, atomically. Equal fields give equal bytes.

    Args:
      path: The file.
      field: The field. Log scales of -inf (flat Gaussians) and opacity logits of -inf and inf are allowed.

    Raises:
      ValueError: `load_field` would refuse the field: shapes disagree, or numbers are NaN or infinite.
      InputError: The folder cannot be written.
    """
    problem, arrays = _disagreement(field) or _oddity(field), {}
    require(problem is None, "save_field", problem, "what load_field reads", "Build the field from one run.")
    tree = pack_tree(field, "", arrays, lambda kind: kind.__name__ if kind in _RECORDS.values() else None)
    with atomic_write(path) as temporary:
        write_arrays(temporary, arrays, {"format": "jsecon-field", "version": VERSION, "field": tree})


def load_field(path: str | os.PathLike, *, mapped: bool = False) -> LanguageField:
    """Reads what `save_field` wrote.

    Args:
      path: The file.
      mapped: Whether columns above 1 MiB stay on disk, as memory maps, so that a field larger than memory opens at
        once. Their sizes are checked; their checksums and numbers only by `check_field`, which reads them.

    Returns:
      The field. Its arrays are on JAX's device, those wider than its number types NumPy's.

    Raises:
      InputError: The file is missing, not a field, cut short, damaged, of a later version, or inconsistent.
    """
    return _read(Path(path), MAPPED if mapped else sys.maxsize, checked=not mapped)


class Provenance(str):
    """A field's provenance that knows the folder of the file that it was read from."""

    folder: Path


def check_field(path: str | os.PathLike) -> None:
    """Reads a whole field file, checksums and numbers, a piece at a time.

    Args:
      path: The file.

    Raises:
      InputError: The file is missing, not a field, cut short, damaged, of a later version, or inconsistent.
    """
    _read(Path(path), MAPPED, checked=True)


def _read(path: Path, mapped: int, checked: bool) -> LanguageField:
    if not path.is_file():
        raise InputError(path, "a folder" if path.is_dir() else "no such file", "a field file", _REMEDY)
    start_backend()
    changed = f"It may have been changed or cut short in copying. {_REMEDY}"
    with reading(path, "a whole one", changed, problem="the field file is damaged"):
        header, members = read_arrays(path, memory_map_above=mapped, verify=checked)
        if not isinstance(header, dict) or header.get("format") != "jsecon-field":
            raise InputError(path, "it is a file of jsecon, but no field", "a field file", _REMEDY)
        if (version := header.get("version")) != VERSION:
            raise InputError(path, f"it was written by another version of jsecon (format {version})", remedy=_REMEDY)
        field = unpack_tree(_known(header["field"]), members, _RECORDS.__getitem__)
        whole = isinstance(field, LanguageField)
        problem = _disagreement(field) or _oddity(field, checked) if whole else "no field at its root"
        field = jax.tree.map(_on_device, field)
    if problem is not None:
        raise InputError(path, problem, "arrays of one N, R, d, E and T", _REMEDY)
    provenance = Provenance(field.provenance)
    provenance.folder = path.resolve().parent
    return dataclasses.replace(field, provenance=provenance)


def _known(node: Any) -> Any:
    """A description of a tree without what a later version may have added: fields of our records that they lack."""
    if not isinstance(node, dict) or node.get("record") not in _RECORDS:
        return node
    names = {part.name for part in dataclasses.fields(_RECORDS[node["record"]])}
    return node | {"fields": {name: _known(part) for name, part in node["fields"].items() if name in names}}


def _on_device(leaf: object) -> object:
    """Arrays that jax's number types hold as jax's; others, those that are mapped, and plain values, as they are."""
    if not isinstance(leaf, np.ndarray) or isinstance(leaf, np.memmap):
        return leaf
    return jax.device_put(leaf) if jax.dtypes.canonicalize_dtype(leaf.dtype) == leaf.dtype else leaf


def _array(field: LanguageField, name: str) -> Any:
    """An array by its dotted name; None if the field lacks it, or the record around it."""

    def step(part, name):
        return None if part is None else getattr(part, name)

    return functools.reduce(step, name.split("."), field)


def _disagreement(field: LanguageField) -> str | None:
    """What is wrong with the shapes, in words, or None."""
    measured = {letter: (_array(field, name), axis) for letter, (name, axis) in _LETTERS.items()}
    sizes = {letter: array.shape[axis] for letter, (array, axis) in measured.items() if array is not None}
    for shape, names in _SHAPES.items():
        expected = tuple(sizes.get(size, size) for size in shape)
        for name in names.split():
            array = _array(field, name)
            if not (name in _OPTIONAL and array is None) and tuple(array.shape) != expected:
                return f"{name} of shape {tuple(array.shape)} where the others ask for {expected}"
    if field.votes.num_regions != sizes["r"]:
        return f"votes over {field.votes.num_regions} regions beside {sizes['r']} regions"
    if len(field.names) != sizes["t"]:
        return f"{len(field.names)} frame names beside {sizes['t']} cameras"
    return None


def _oddity(field: LanguageField, checked: bool = True) -> str | None:
    """What is wrong with the numbers or texts, in words, or None; mapped columns are read only if `checked`."""
    nodes = 0 if field.tree is None else len(field.tree)
    sizes = {"votes.regions": field.regions.count, "leaf": nodes, "part_nodes": nodes}
    for place, leaf in jax.tree_util.tree_leaves_with_path(field):
        if isinstance(leaf, np.memmap) and not checked:
            continue
        name, column = jax.tree_util.keystr(place).lstrip("."), np.atleast_1d(np.asarray(leaf))
        for numbers in (column[first : first + ROWS] for first in range(0, len(column), ROWS)):
            column_name = name.removeprefix("gaussians.")
            wrong = unusable_rows(column_name, numbers) if column_name != name else ~np.isfinite(numbers)
            if wrong.any():
                return f"{name} with numbers that are not finite{' or zero' if column_name == 'quaternions' else ''}"
            if name in sizes and not (numbers.dtype.kind == "i" and ((numbers >= -1) & (numbers < sizes[name])).all()):
                return f"{name} with numbers beyond {sizes[name]}"
    if field.gaussians.sh is not None and field.gaussians.sh.shape[1] not in COEFFICIENT_COUNTS:
        return f"harmonics of {field.gaussians.sh.shape[1]} functions"
    if (field.tree is None) != (field.leaf is None):
        return "a tree without the smallest nodes of its Gaussians, or these without a tree"
    if field.tree is not None and not _is_tree(np.asarray(field.tree), field.regions.count):
        return "a tree whose nodes do not come before their parents, or form circles"
    scale = field.metres_per_unit
    if scale is not None and not (isinstance(scale, int | float) and 0 < scale < np.inf):
        return f"a unit of {scale!r} metres"
    return None


def _is_tree(parent: np.ndarray, count: int) -> bool:
    """Whether these are the parents of the nodes of a tree over `count` regions and their parts."""
    ids = np.arange(len(parent))
    if parent.dtype.kind != "i" or len(parent) < count:
        return False
    above = (parent > ids) & (parent >= count) & (parent < len(parent))
    of_region = (ids >= count) & (parent >= 0) & (parent < count)
    if not (above | of_region | (parent == -1)).all():
        return False
    for _ in range(len(parent).bit_length()):  # no node is above itself
        parent = np.where(parent >= 0, parent[parent], -1)
    return bool((parent == -1).all())
