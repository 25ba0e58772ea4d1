"""Atomic writes, and files of arrays.

A file gets its final name when it is complete. Arrays are stored as safetensors, with a JSON description and checksums;
`pack_tree` describes a tree of records in this way. Reading takes no more memory than the file's bytes, and runs no
code.
"""

import codecs
import contextlib
import csv
import dataclasses
import errno
import importlib
import io
import json
import math
import os
import struct
import sys
import tempfile
import tokenize
import uuid
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout
from safetensors import SafetensorError, safe_open

from jsecon.errors import InputError, describe_error, is_out_of_memory, machine_error, require
from jsecon.process import memory_budget

READ_ERRORS = (
    *(OSError, EOFError, ValueError, LookupError, TypeError, AttributeError, ImportError, RuntimeError),
    *(ArithmeticError, SyntaxError, tokenize.TokenError, struct.error, zipfile.BadZipFile, zlib.error),
    SafetensorError,
)
"""exceptions that readers of damaged files raise"""
_DTYPES = {"BOOL": np.dtype(bool)} | {
    f"{letter}{8 * size}": np.dtype(f"<{letter.lower()}{size}")
    for letter, sizes in {"F": (2, 4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}.items()
    for size in sizes
}
"""NumPy's types by safetensors' names"""
FIELD_FILE = "field.safetensors"
"""name of a field in its folder"""
_CODES = {dtype: code for code, dtype in _DTYPES.items()}
_UNPACK, _DOWNLOAD = "Unpack it, and give what is in it.", "Download the file again."
_SUBSTITUTES = (
    (b"version https://git-lfs", "a Git LFS pointer", "Run: git lfs pull", ()),
    (b"PK\3\4", "a zip archive", _UNPACK, (".sog", ".npz")),
    (b"\x1f\x8b", "a gzip archive", _UNPACK, (".spz",)),
    *((head, "a page of HTML", _DOWNLOAD, ()) for head in (b"<!doctype", b"<html")),
)
"""first bytes in small letters, what begins so, what to do about it, and the suffixes of files that may begin so"""


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike) -> Iterator[Path]:
    """Opens a temporary path beside a file, which gets the file's name at the end, or is removed if the body raised."""
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:8]}.partial{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch()
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise _unwritten(path, error) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _unwritten(path: Path, error: OSError) -> InputError:
    remedy = "Choose another, mend its permissions, or free some room."
    problem = f"{describe_error(error)} on writing to {path.parent}"
    return InputError(path, problem, "a folder that can be written", remedy)


@contextlib.contextmanager
def exclusive_lock(folder: Path) -> Iterator[None]:
    """Locks a folder for this process, for the body of a `with`."""
    lock = FileLock(folder / ".lock", timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        remedy = "Wait for its end, or choose another output folder."
        raise InputError(folder, "another run that writes there", "one at a time", remedy) from error
    except NotImplementedError:  # a file system without locks
        pass
    except OSError as error:
        without_locks = errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP  # of such a file system
        if error.errno not in without_locks:
            raise _unwritten(folder / ".lock", error) from error
    try:
        yield
    finally:
        lock.release()


def path_within(folder: Path, name: str) -> Path:
    """Joins a folder and a name that comes from a file."""
    first = Path(os.path.normpath(name)).parts[:1]
    if "\0" in name or os.path.splitdrive(name)[0] or os.path.isabs(name) or first == ("..",):
        problem = f"the name {name[:80]!r} leads out of the folder"
        raise InputError(folder, problem, remedy="Rename it: names must lie beneath the folder.")
    return folder / name


def is_output_folder(folder: Path) -> bool:
    """Whether a folder is the output folder of a run or a query, which is never input."""
    return (folder / "cache" / "CACHEDIR.TAG").is_file() or (folder / "answers.html").is_file()


def list_files(root: Path, *, exclude: Path | None = None) -> Iterator[Path]:
    """Lists the files beneath a folder, through links too. Hidden files and output folders of jsecon are skipped."""
    excluded = None if exclude is None else exclude.resolve()
    files, visited = [], set()
    for place, folders, names in os.walk(root, followlinks=True):
        folder, home = Path(place), os.path.realpath(place)
        kept = () if home in visited else sorted(name for name in folders if not name.startswith("."))
        visited.add(home)  # a link to a folder above would lead round and round
        inputs = [name for name in kept if not is_output_folder(folder / name)]
        folders[:] = [name for name in inputs if (folder / name).resolve() != excluded]
        files += [folder / name for name in names if not name.startswith(".")]
    yield from (file for file in sorted(files) if file.is_file())


def remove_files(folder: Path, names: Iterable[str]) -> None:
    """Removes files that an earlier command wrote directly into a folder; those that are gone are no error."""
    for file in (folder / name for name in names if Path(name).name == name):
        try:
            file.unlink(missing_ok=True)
        except OSError as error:
            problem = f"the file of an earlier answer cannot be removed ({describe_error(error)})"
            raise InputError(file, problem, remedy="Remove it yourself, or choose another folder.") from error


def write_text(path: str | os.PathLike, text: str) -> None:
    r"""Writes a text (UTF-8) atomically."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def csv_text(columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """Writes values of some columns as CSV; a value that a row lacks is empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def read_lines(path: Path) -> Iterator[str]:
    """Reads a text file as UTF-8, with or without a byte order mark, line by line; other bytes become surrogates."""
    with path.open(encoding="utf-8-sig", errors="surrogateescape", newline="\n") as file:
        yield from file


def parse_json(text: str | bytes) -> Any:
    """Parses JSON."""
    try:
        return json.loads(text, parse_int=lambda digits: int(digits) if len(digits) < 300 else float(digits))
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def read_json(path: Path, expected: str, remedy: str) -> Any:
    """Reads a JSON file."""
    with reading(path, expected, remedy, problem="it is not JSON"):
        try:
            return parse_json(path.read_bytes())
        except OSError as error:
            raise machine_error(error, path) or InputError(path, describe_error(error), expected, remedy) from error


def describe_substitute(path: object, *, in_place: bool = True) -> tuple[str, str] | None:
    """Recognises what stands in place of a file by its first bytes: what it is, and a remedy; else None.

    Without `in_place`, archives that are the content of the file's own format count too.
    """
    if not os.path.isfile(str(path)):
        return None
    with contextlib.suppress(OSError), open(str(path), "rb") as file:
        head = file.read(64).removeprefix(codecs.BOM_UTF8).lstrip().lower()
        for start, what, remedy, suffixes in _SUBSTITUTES:
            if head.startswith(start.lower()) and not (in_place and str(path).lower().endswith(suffixes)):
                return f"{what} in place of the file" if in_place else what, remedy
    return None


@contextlib.contextmanager
def reading(
    path: object, expected: str = "", remedy: str = "", *, problem: str = "it cannot be read"
) -> Iterator[None]:
    """Turns what the reading of a damaged file raises (READ_ERRORS) into an InputError, which says what is there."""
    try:
        yield
    except READ_ERRORS as error:
        if is_out_of_memory(error):
            raise
        if (fault := machine_error(error, path)) is not None:
            raise fault from error
        where = error.where if isinstance(error, InputError) else path
        if (substitute := describe_substitute(where)) is not None:
            raise InputError(where, substitute[0], remedy=substitute[1]) from error
        if isinstance(error, InputError):
            raise
        raise InputError(path, f"{problem} ({describe_error(error)})", expected, remedy) from error


def scratch_array(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """Makes an array to be filled; one of more than a quarter of the memory budget lies in a file that has no name."""
    if (size := math.prod(shape) * np.dtype(dtype).itemsize) <= memory_budget() / 4:
        return np.empty(shape, dtype)
    with tempfile.TemporaryFile() as file:
        try:
            if hasattr(os, "posix_fallocate"):  # a mapped page without a place on the disk ends the process by SIGBUS
                os.posix_fallocate(file.fileno(), 0, size)
            return np.memmap(file, dtype, "w+", shape=shape)
        except OSError as error:
            problem = f"{error.strerror or error} for {size / 2**30:.1f} GiB"
            remedy = "Free some room, set TMPDIR to a folder that has it, or take fewer or smaller frames."
            raise InputError(tempfile.gettempdir(), problem, remedy=remedy) from error


def map_npy(path: Path) -> np.ndarray:
    """Memory-maps the array of a .npy file."""
    array = np.lib.format.open_memmap(path, mode="r")
    if array.dtype.kind not in "biuf":
        raise ValueError("no .npy of plain numbers")
    after = os.path.getsize(path) - array.offset
    if array.nbytes != after:
        raise ValueError(f"{after} bytes of numbers where the header announces {array.dtype} of shape {array.shape}")
    return array


def write_arrays(path: str | os.PathLike, arrays: Mapping[str, np.ndarray], description: Any = None) -> None:
    """Writes arrays as a safetensors file. Equal content gives equal bytes; memory maps are not copied into memory.

    Its metadata have two texts: "jsecon", JSON with the description and with each array's CRC-32, and "crc32", the
    CRC-32 of that JSON.
    """
    # safetensors.numpy.save_file makes files of mode 600, and hides a full disk behind another error.
    # The widest first, as there, so that every array is aligned to its type.
    ordered = sorted(arrays.items(), key=lambda item: (-item[1].dtype.itemsize, item[0]))
    parts = {name: np.asarray(array, array.dtype.newbyteorder("<"), order="C") for name, array in ordered}
    text = json.dumps({"description": description, "crc32": {name: _crc32(part) for name, part in parts.items()}})
    layout: dict[str, Any] = {"__metadata__": {"jsecon": text, "crc32": str(zlib.crc32(text.encode()))}}
    end = 0
    for name, part in parts.items():
        begin, end = end, end + part.nbytes
        layout[name] = {"dtype": _CODES[part.dtype], "shape": part.shape, "data_offsets": [begin, end]}
    header = json.dumps(layout).encode()
    header += b" " * (-len(header) % 8)
    with open(path, "wb") as file:
        file.write(len(header).to_bytes(8, "little") + header)
        for part in parts.values():
            file.write(part.data if part.size else b"")


def read_arrays(
    path: str | os.PathLike, *, memory_map_above: int = sys.maxsize, verify: bool = True
) -> tuple[Any, dict[str, np.ndarray]]:
    """Reads what `write_arrays` wrote."""
    arrays = {}
    with open(path, "rb") as file:  # first: safetensors calls a file that it may not open a missing one
        with safe_open(path, framework="numpy"):  # checks sizes and places: no gap, no overlap, no bytes behind the end
            pass
        length = int.from_bytes(file.read(8), "little")
        layout = parse_json(file.read(length))
        metadata = layout.pop("__metadata__", {})
        if "jsecon" not in metadata:
            problem, remedy = "it is a safetensors file of another program", "Give a file that jsecon wrote."
            raise InputError(path, problem, "a file of jsecon", remedy)
        if metadata.get("crc32") != str(zlib.crc32(metadata["jsecon"].encode())):
            raise ValueError("its description does not match its checksum")
        contents = parse_json(metadata["jsecon"])
        for name, entry in layout.items():
            dtype, shape, (begin, end) = _DTYPES[entry["dtype"]], tuple(entry["shape"]), entry["data_offsets"]
            is_mapped = end - begin > memory_map_above
            if is_mapped:
                array = np.memmap(path, dtype, "r", 8 + length + begin, shape)
            else:
                file.seek(8 + length + begin)
                array = np.fromfile(file, dtype, math.prod(shape)).reshape(shape)
            if (verify or not is_mapped) and _crc32(array) != contents["crc32"][name]:
                raise ValueError(f"{name} does not match its checksum")
            arrays[name] = array
    return contents["description"], arrays


def _crc32(array: np.ndarray) -> int:
    return zlib.crc32(array.data if array.size else b"")


def _name_of_record(kind: type) -> str | None:
    """Module and name of one of jsecon's records; None for any other type."""
    ours = dataclasses.is_dataclass(kind) and kind.__module__.startswith("jsecon.")
    return f"{kind.__module__}:{kind.__qualname__}" if ours else None


def _record_of_name(name: str) -> type:
    module, _, kind = name.partition(":")
    record = getattr(importlib.import_module(module), kind) if module.startswith("jsecon.") else None
    if not (isinstance(record, type) and dataclasses.is_dataclass(record)):
        raise ValueError(f"{name} is not a record of jsecon")
    return record


def pack_tree(
    node: Any, path: str, arrays: dict[str, np.ndarray], name_of: Callable[[type], str | None] = _name_of_record
) -> dict:
    """Describes a tree of plain values, arrays, dicts, lists, tuples and records as JSON.

    A node is one of: {"value": JSON value}, a list of them for a tuple; {"list": [...]}, {"tuple": [...]}, {"dict":
    {...}}, {"record": name, "fields": {...}}, {"array": path, "shape", "dtype"}.
    """

    def inner(parts: Any) -> dict:
        return {name: pack_tree(part, f"{path}.{name}".lstrip("."), arrays, name_of) for name, part in parts}

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
    got = f"{kind.__module__}.{kind.__qualname__} of type {array.dtype}"
    is_plain = array.dtype.newbyteorder("<") in _CODES
    require(is_plain, path, got, "plain numbers", "Convert it to float32 or an integer type.")
    arrays[path] = array
    return {"array": path, "shape": list(array.shape), "dtype": array.dtype.name}


def unpack_tree(node: Any, arrays: Mapping[str, np.ndarray], kind_of: Callable[[str], type] = _record_of_name) -> Any:
    """Builds the tree that `pack_tree` described."""
    if "value" in node:
        return tuple(node["value"]) if isinstance(node["value"], list) else node["value"]
    if "array" in node:
        array = arrays[node["array"]]
        if "shape" in node and [*array.shape, array.dtype.name] != [*node["shape"], node["dtype"]]:
            expected = f"{node['dtype']}{tuple(node['shape'])}"
            raise ValueError(f"{node['array']} is {array.dtype}{array.shape}, its header declares {expected}")
        return array
    for kind in (list, tuple):
        if kind.__name__ in node:
            return kind(unpack_tree(part, arrays, kind_of) for part in node[kind.__name__])
    parts = node["dict"] if "dict" in node else node["fields"]
    parts = {name: unpack_tree(part, arrays, kind_of) for name, part in parts.items()}
    return parts if "dict" in node else kind_of(node["record"])(**parts)
