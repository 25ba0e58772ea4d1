"""Writing files so that a final name never holds a half-written file, and trees as what a .npz holds without pickle:
arrays, and JSON that says what they are."""

import contextlib
import dataclasses
import os
import uuid
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jsecon.errors import InputError, require

UNREADABLE = (
    *(OSError, EOFError, ValueError, LookupError, TypeError, AttributeError, ImportError, NotImplementedError),
    zipfile.BadZipFile,
)
"""what reading a damaged .npz, and `unpacked` of a damaged description, raise"""


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


def packed(node: Any, path: str, arrays: dict[str, np.ndarray], name_of: Callable[[type], str | None]) -> dict:
    """JSON that describes a tree of plain values, arrays, dicts, lists, tuples and records; its arrays go to `arrays`,
    by their path. name_of: what a type of record is called, None for any other. Raises ValueError on anything else.

    A node is one of: {"value": JSON value}, a list of them for a tuple; {"list": [...]}, {"tuple": [...]}, {"dict":
    {...}}, {"record": name, "fields": {...}}, {"array": path, "shape", "dtype"}.
    """

    def inner(parts: Any) -> dict:
        return {name: packed(part, f"{path}.{name}".lstrip("."), arrays, name_of) for name, part in parts}

    kind, plain = type(node), (bool, int, float, str, type(None))
    if isinstance(node, plain):
        return {"value": node}
    if kind is tuple and all(isinstance(part, plain) for part in node):
        return {"value": list(node)}
    if kind in (list, tuple):
        return {kind.__name__: list(inner(enumerate(node)).values())}
    if (name := name_of(kind)) is not None:
        return {"record": name, "fields": inner((f.name, getattr(node, f.name)) for f in dataclasses.fields(node))}
    if isinstance(node, Mapping) and all(isinstance(name, str) for name in node):
        return {"dict": inner(node.items())}
    array = np.asarray(node, None if hasattr(node, "__array__") else object)
    told = f"{kind.__module__}.{kind.__qualname__} of type {array.dtype}"
    require(array.dtype.kind in "biuf", path, told, "plain numbers", "Convert it to float32 or an integer type.")
    arrays[path] = array
    return {"array": path, "shape": list(array.shape), "dtype": array.dtype.name}


def unpacked(node: Any, arrays: Mapping[str, np.ndarray], kind_of: Callable[[str], type]) -> Any:
    """The tree that `packed` described, of NumPy's arrays; kind_of: the type of record of a name. Raises one of
    UNREADABLE on what `packed` did not write."""
    if "value" in node:
        return tuple(node["value"]) if isinstance(node["value"], list) else node["value"]
    if "array" in node:
        array = arrays[node["array"]]
        if "shape" in node and [*array.shape, array.dtype.name] != [*node["shape"], node["dtype"]]:
            told = f"{node['dtype']}{tuple(node['shape'])}"
            raise ValueError(f"{node['array']} is {array.dtype}{array.shape}, header says {told}")
        return array
    for kind in (list, tuple):
        if kind.__name__ in node:
            return kind(unpacked(part, arrays, kind_of) for part in node[kind.__name__])
    parts = node["dict"] if "dict" in node else node["fields"]
    parts = {name: unpacked(part, arrays, kind_of) for name, part in parts.items()}
    return parts if "dict" in node else kind_of(node["record"])(**parts)
