"""Writing files so that a final name never holds a half-written file, and trees as what a .npz holds without pickle:
arrays, and JSON that says what they are. Reading both without trust: no more memory is taken than the file's bytes can
fill, and no Python object is built."""

import codecs
import contextlib
import dataclasses
import errno
import json
import math
import os
import re
import struct
import sys
import uuid
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from jsecon.errors import InputError, require, why

UNREADABLE = (
    *(OSError, EOFError, ValueError, LookupError, TypeError, AttributeError, ImportError, RuntimeError),
    *(ArithmeticError, zipfile.BadZipFile, zlib.error),
)
"""what reading a damaged .npz, and `unpacked` of a damaged description, raise"""
ALIGNED = 64
"""bytes: the columns of a .npz that is to be mapped begin at a multiple of them, as jax wants its arrays"""
LONGEST_NAME = 80
"""characters of a name that a message quotes"""
_PADDING = 0xD935
"""the zip extra field that Android's zipalign fills up with"""
_WITHOUT_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP)
"""what the system says of a file system that has no locks"""
MOST_DEFLATED = 1032
"""bytes that one byte of a deflated stream can stand for"""
_HEADER = (
    rb"['\"]descr['\"] *: *['\"]([<>|=]?[biuf]\d+)['\"]",
    rb"['\"]fortran_order['\"] *: *(True|False)",
    rb"['\"]shape['\"] *: *\(([\dL, ]*)\)",
)
"""of a .npy: what is read of its header"""


@contextlib.contextmanager
def written_whole(path: str | os.PathLike) -> Iterator[Path]:
    """Yields a temporary path beside `path`; on leaving it is renamed to `path`, or removed if the body raised.

    The temporary name keeps `path`'s ending, for writers that choose the format by it. Raises InputError where the
    folder cannot be written, or has no room.
    """
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
    found = f"{why(error)} on writing to {path.parent}"
    return InputError(path, found, "a folder that can be written", remedy)


@contextlib.contextmanager
def alone(folder: Path) -> Iterator[None]:
    """While it is open, `folder` is this caller's to write to. Raises InputError where it is another's, or is full."""
    lock = FileLock(folder / ".lock", timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        remedy = "Wait for its end, or choose another output folder."
        raise InputError(folder, "another run that writes there", "one at a time", remedy) from error
    except NotImplementedError:  # a file system without locks
        pass
    except OSError as error:
        if error.errno not in _WITHOUT_LOCKS:
            raise _unwritten(folder / ".lock", error) from error
    try:
        yield
    finally:
        lock.release()


def path_within(folder: Path, name: str) -> Path:
    """The path of what a file names beneath a folder. Raises InputError for a name that leads out of the folder."""
    first = Path(os.path.normpath(name)).parts[:1]
    if "\0" in name or os.path.splitdrive(name)[0] or os.path.isabs(name) or first == ("..",):
        found = f"the name {name[:LONGEST_NAME]!r} leads out of the folder"
        raise InputError(folder, found, remedy="Rename it: names must lie beneath the folder.")
    return folder / name


def made_by_jsecon(folder: Path) -> bool:
    """Whether a folder is the output folder of a run or of a query, and so no input, wherever it lies."""
    return (folder / "cache" / "CACHEDIR.TAG").is_file() or (folder / "answers.html").is_file()


def files_beneath(root: Path, *, leave_out: Path | None = None) -> Iterator[Path]:
    """Yields the files beneath a folder in name order, through links too.

    Hidden files are left out, the folders in it that are output of jsecon, and `leave_out`.
    """
    own = None if leave_out is None else leave_out.resolve()
    found, visited = [], set()
    for place, folders, names in os.walk(root, followlinks=True):
        folder, home = Path(place), os.path.realpath(place)
        kept = () if home in visited else sorted(name for name in folders if not name.startswith("."))
        visited.add(home)  # a link to a folder above would lead round and round
        folders[:] = [name for name in kept if not made_by_jsecon(folder / name) and (folder / name).resolve() != own]
        found += [folder / name for name in names if not name.startswith(".")]
    yield from (file for file in sorted(found) if file.is_file())


def write_text(path: str | os.PathLike, text: str) -> None:
    """Writes `text` (UTF-8) to `path`, whole or not at all; bytes of file names that are no UTF-8 as \\udcxx."""
    with written_whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def read_text(path: Path) -> str:
    """Reads a text file as UTF-8, or as UTF-16 where it begins with that byte order mark.

    Bytes that are no UTF-8 become surrogates, as in file names: a path made of them finds its file.
    """
    data = path.read_bytes()
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", "replace")
    return data.removeprefix(codecs.BOM_UTF8).decode("utf-8", "surrogateescape")


def parsed_json(text: str | bytes) -> Any:
    """What a JSON text holds, whole numbers of 300 digits and more as floats. Raises ValueError."""
    try:
        return json.loads(text, parse_int=lambda digits: int(digits) if len(digits) < 300 else float(digits))
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def read_json(path: Path, expected: str, remedy: str) -> Any:
    """What a JSON file holds, as `parsed_json` has it. Raises InputError where it cannot be read."""
    try:
        return parsed_json(path.read_bytes())
    except OSError as error:
        raise InputError(path, why(error), expected, remedy) from error
    except ValueError as error:
        raise InputError(path, f"it is not JSON ({why(error)})", expected, remedy) from error


def array_layout(stream: Any, size: int) -> tuple[tuple[int, ...], np.dtype, bool]:
    """(shape, type, whether in Fortran's order) of the .npy of `size` bytes in a stream, which is then at its numbers.

    Read here, since NumPy makes room for all that a header announces, and warns of odd ones. Raises one of UNREADABLE
    where it is no .npy of plain numbers, or the bytes are not as many as it announces.
    """
    magic = stream.read(8)
    length = stream.read(2 if magic[6:7] == b"\1" else 4)
    header = stream.read(min(int.from_bytes(length, "little"), 1 << 16))
    found = [re.search(key, header) for key in _HEADER]
    if not magic.startswith(b"\x93NUMPY") or None in found:
        raise ValueError("no .npy of plain numbers")
    kind, order, sizes = (match[1].decode() for match in found if match)
    dtype, shape = np.dtype(kind), tuple(int(number) for number in re.findall(r"\d+", sizes))
    left = size - len(magic) - len(length) - len(header)
    if math.prod(shape) * dtype.itemsize != left:
        raise ValueError(f"{left} bytes of numbers where the header announces {dtype} of shape {shape}")
    return shape, dtype, order == "True"


def read_array(stream: Any, size: int) -> np.ndarray:
    """The array of the .npy of `size` bytes in a stream. Raises as `array_layout` does."""
    shape, dtype, fortran = array_layout(stream, size)
    array = np.empty(shape[::-1] if fortran else shape, dtype)
    flat = array.reshape(-1).view(np.uint8)
    for start in range(0, len(flat), 1 << 24):
        block = flat[start : start + (1 << 24)]
        block[:] = np.frombuffer(stream.read(len(block)), np.uint8)  # ValueError where the stream ends before
    return array.T if fortran else array


def map_array(path: Path, start: int = 0, size: int | None = None) -> np.ndarray:
    """The array of a .npy in the bytes of a file from `start` on, of which the system holds what is in use. Raises as
    `array_layout` does."""
    with open(path, "rb") as file:
        file.seek(start)
        shape, dtype, fortran = array_layout(file, path.stat().st_size - start if size is None else size)
        return np.memmap(path, dtype, "r", file.tell(), shape, "F" if fortran else "C")


def write_arrays(path: str | os.PathLike, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes a .npz, not compressed, whose numbers begin at multiples of ALIGNED bytes. Equal arrays give equal bytes;
    memory maps are copied in pieces."""
    with open(path, "w+b") as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy")
            # behind a local header, the field for sizes above 4 GiB, and our own before its filling
            begin = file.tell() + 30 + len(entry.filename.encode()) + 20 + 6
            filling = -begin % ALIGNED
            entry.extra = struct.pack("<HHH", _PADDING, 2 + filling, ALIGNED) + bytes(filling)
            with archive.open(entry, "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)


def write_column(path: str | os.PathLike, shape: tuple[int, ...], dtype: Any, blocks: Iterable[np.ndarray]) -> None:
    """Writes a .npy of `shape`, block of rows after block: what a disk has no room for is an error here, and a signal
    in a memory map."""
    with open(path, "wb") as file:
        header = {"descr": np.lib.format.dtype_to_descr(np.dtype(dtype)), "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(file, header)
        for block in blocks:
            file.write(np.ascontiguousarray(block, dtype).tobytes())


def read_arrays(path: str | os.PathLike, *, mapped: int = sys.maxsize, checked: bool = True) -> dict[str, np.ndarray]:
    """The arrays of a .npz by name; those of more than `mapped` bytes are mapped, and not read at all unless they are
    to be `checked` against their checksums. Raises one of UNREADABLE where it is damaged."""
    arrays, most = {}, os.path.getsize(path)
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            stored = entry.compress_type == zipfile.ZIP_STORED
            if entry.file_size > most * (1 if stored else MOST_DEFLATED):
                raise ValueError(f"{entry.filename} of {entry.file_size} bytes in a file of {most}")
            name = entry.filename.removesuffix(".npy")
            with archive.open(entry) as member, open(path, "rb") as file:
                if not (stored and entry.file_size > mapped):
                    arrays[name] = read_array(member, entry.file_size)
                    continue
                while checked and member.read(1 << 24):  # to the end, where its checksum is compared
                    pass
                file.seek(entry.header_offset + 26)
                start = sum(struct.unpack("<HH", file.read(4))) + file.tell()
            arrays[name] = map_array(Path(path), start, entry.file_size)
    return arrays


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
