"""The language field as one file: a zip of .npy arrays with a JSON header that says what they are. No pickle.

The header, member `header.npy` (UTF-8 bytes), holds {"format", "version", "field"}; "field" is the field's tree, each
node one of: {"record": name, "fields": {...}}, {"dict": {...}}, {"array": member, "shape", "dtype"}, or {"value": JSON
value}.
"""

import dataclasses
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jsecon.errors import InputError, require
from jsecon.files import written_whole
from jsecon.language.autoencoder import Autoencoder
from jsecon.language.codes import Rotation, Spread
from jsecon.types import Camera, Gaussians, LanguageField, Regions, Votes

FORMAT, VERSION = "jsecon-field", 1
_RECORDS = {
    cls.__name__: cls for cls in (LanguageField, Gaussians, Votes, Regions, Camera, Autoencoder, Rotation, Spread)
}
_REMEDY = "Make the field again with `jsecon run`."


def save_field(path: str | os.PathLike, field: LanguageField) -> None:
    """Writes `field` to `path`, whole or not at all. Equal fields give equal bytes.

    Raises ValueError for arrays whose shapes disagree or that are not plain numbers, InputError where the folder cannot
    be written.
    """
    problem = _disagreement(field)
    require(problem is None, "save_field", problem, "arrays of one N, R, d, E and T", "Build the field from one run.")
    arrays: dict[str, np.ndarray] = {}
    header = {"format": FORMAT, "version": VERSION, "field": _pack(field, "", arrays)}
    text = np.frombuffer(json.dumps(header).encode(), np.uint8)
    with written_whole(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, allow_pickle=False, header=text, **arrays)


def load_field(path: str | os.PathLike) -> LanguageField:
    """Reads what `save_field` wrote. Arrays come back on JAX's device, those wider than its number types as NumPy.

    Raises InputError for a file that is missing, not a field, cut short, damaged, of a later version, or inconsistent.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(path, "a folder" if path.is_dir() else "no such file", "a field file", _REMEDY)
    if not zipfile.is_zipfile(path):
        raise InputError(
            path,
            f"{path.stat().st_size} bytes that are no complete zip archive",
            "a field file written by jsecon",
            f"It may have been cut short in copying. {_REMEDY}",
        )
    try:
        with np.load(path, allow_pickle=False) as members:
            if not isinstance(members, np.lib.npyio.NpzFile) or "header" not in members:
                raise InputError(path, "a zip archive without a jsecon header", "a field file", _REMEDY)
            header = json.loads(members["header"].tobytes().decode())
            if not isinstance(header, dict) or header.get("format") != FORMAT:
                raise InputError(path, "another program's header", f"format {FORMAT!r}", _REMEDY)
            if header.get("version") != VERSION:
                raise InputError(
                    path,
                    f"version {header.get('version')}",
                    f"version {VERSION}",
                    f"Read it with the jsecon that wrote it. {_REMEDY}",
                )
            field = _unpack(header["field"], members)
        problem = "no field at its root" if not isinstance(field, LanguageField) else _disagreement(field)
    except InputError:
        raise
    except (
        ValueError,
        KeyError,
        IndexError,
        TypeError,
        AttributeError,
        OSError,
        EOFError,
        NotImplementedError,
        zipfile.BadZipFile,
    ) as error:
        raise InputError(
            path,
            f"a damaged field file ({type(error).__name__}: {error})",
            "a whole one",
            f"It may have been changed or cut in copying. {_REMEDY}",
        ) from error
    if problem is not None:
        raise InputError(path, problem, "arrays of one N, R, d, E and T", _REMEDY)
    return field


def _pack(node: Any, name: str, arrays: dict[str, np.ndarray]) -> dict:
    if type(node).__name__ in _RECORDS and dataclasses.is_dataclass(node):
        parts = {f.name: _pack(getattr(node, f.name), f"{name}{f.name}.", arrays) for f in dataclasses.fields(node)}
        return {"record": type(node).__name__, "fields": parts}
    if isinstance(node, dict):
        return {"dict": {key: _pack(value, f"{name}{key}.", arrays) for key, value in node.items()}}
    if node is None or isinstance(node, str | int | tuple):
        return {"value": list(node) if isinstance(node, tuple) else node}
    array = np.asarray(node)
    require(
        array.dtype.kind in "biuf",
        "save_field",
        f"{name[:-1]} of type {array.dtype}",
        "plain numbers",
        "Convert it to float32 or an integer type.",
    )
    arrays[name[:-1]] = array
    return {"array": name[:-1], "shape": list(array.shape), "dtype": array.dtype.name}


def _unpack(node: dict, members: Any) -> Any:
    if "record" in node:
        cls = _RECORDS[node["record"]]
        return cls(**{name: _unpack(part, members) for name, part in node["fields"].items()})
    if "dict" in node:
        return {key: _unpack(part, members) for key, part in node["dict"].items()}
    if "value" in node:
        return tuple(node["value"]) if isinstance(node["value"], list) else node["value"]
    array = members[node["array"]]
    if list(array.shape) != node["shape"] or array.dtype.name != node["dtype"]:
        raise ValueError(
            f"{node['array']} is {array.dtype}{array.shape}, header says {node['dtype']}{tuple(node['shape'])}"
        )
    return jax.device_put(array) if jax.dtypes.canonicalize_dtype(array.dtype) == array.dtype else array


def _disagreement(field: LanguageField) -> str | None:
    """What is wrong with the shapes, in words, or None."""
    n, r = field.gaussians.means.shape[0], field.regions.pixels.shape[0]
    d, e = field.region_codes.shape[-1], field.regions.embeddings.shape[-1]
    frames = field.cameras.world_to_camera.shape[0]
    k = field.votes.regions.shape[-1]
    expected = {
        "gaussians.means": (field.gaussians.means, (n, 3)),
        "gaussians.log_scales": (field.gaussians.log_scales, (n, 3)),
        "gaussians.quaternions": (field.gaussians.quaternions, (n, 4)),
        "gaussians.opacity_logits": (field.gaussians.opacity_logits, (n,)),
        "codes": (field.codes, (n, d)),
        "votes.regions": (field.votes.regions, (n, k)),
        "votes.weights": (field.votes.weights, (n, k)),
        "votes.labelled": (field.votes.labelled, (n,)),
        "votes.total": (field.votes.total, (n,)),
        "votes.peak": (field.votes.peak, (n,)),
        "votes.views": (field.votes.views, (n,)),
        "regions.embeddings": (field.regions.embeddings, (r, e)),
        "region_codes": (field.region_codes, (r, d)),
        "cameras.world_to_camera": (field.cameras.world_to_camera, (frames, 4, 4)),
        "cameras.fx": (field.cameras.fx, (frames,)),
        "canonical": (field.canonical, (field.canonical.shape[0], e)),
        "to_source": (field.to_source, (4, 4)),
    }
    if field.votes.shown is not None:
        expected["votes.shown"] = (field.votes.shown, (n, k))
    if field.votes.overlap is not None:
        expected["votes.overlap"] = (field.votes.overlap, (r, r))
    for name, (array, shape) in expected.items():
        if tuple(array.shape) != shape:
            return f"{name} of shape {tuple(array.shape)} where the others ask for {shape}"
    if field.votes.num_regions != r:
        return f"votes over {field.votes.num_regions} regions beside {r} regions"
    if len(field.names) != frames:
        return f"{len(field.names)} frame names beside {frames} cameras"
    return None
