"""Every reader in a folder of an odd name, on whole, empty and damaged files: it refuses each with an InputError, or
returns a well-formed result.

A file is taken apart into texts and bytes, one of them is damaged, and the checksums are made right again. Every choice
comes from a seed. Longer, with other seeds:

    FUZZ_MUTATIONS=10000 FUZZ_SEED=1 pytest -m long tests/test_fuzz.py
"""

import contextlib
import json
import os
import re
import time
import warnings
import zlib
from pathlib import Path

import numpy as np
import onnx
import pytest
from fuzz_readers import READERS, cases, check_result
from google.protobuf import json_format

from jsecon.errors import InputError

resource = pytest.importorskip("resource")
SEED = int(os.environ.get("FUZZ_SEED", 0))
MUTATIONS = int(os.environ.get("FUZZ_MUTATIONS", 200))
SECONDS = 30.0
"""CPU time that a reader's own thread may take for one file: tenths of a second, but minutes where it believes the
counts of a damaged header. The process as a whole may spend more, for instance on threads that other tests left."""
TIMES, MORE = 10, 1 << 30
"""memory that a reader may take: a multiple of the file's size, plus bytes"""
LONGEST_MESSAGE = 2500
HIDDEN = ResourceWarning, DeprecationWarning, PendingDeprecationWarning, ImportWarning
ODD_NAME = "Gr\xf6\xdfe [1] * 50%, \u6e2c\u8a66 'x'"
"""with signs of patterns, of lists and of other alphabets; names that are not UTF-8: test_names"""
NUMBERS = (0, -1, 1, 2**31, -(2**31), 2**32 - 1, 2**62, 2**64 - 1, float("nan"), float("inf"), 1e308, -1e308, 1e-320)
WORDS = (*map(repr, NUMBERS), "1e400", "9" * 5000, "1_0", "٣", "1,5", "0x10", "", "\0", "../x", "x" * 300)
WORDS += tuple(f"'{code}'" for code in ("<f8", ">f4", "<i4", "<u8", "|u1", "|b1", "<f2", "<c8", "|S3", "<M8[s]"))
"""the last are types of NumPy, as the header of a .npy has them"""
CODES = ("<i4", "<u4", "<i8", "<u8", "<f4", "<f8", "<u2", "u1", ">u4", ">u2", ">f4")
ODD = (None, True, *NUMBERS, 10**400, "", "a\0b", "\ud800", "x" * 5000, "../x", [], {}, [[]], [1, 2, 3], {"a": 1})


def pick(rng, items):
    return items[int(rng.integers(len(items)))]


def packed(rng) -> bytes:
    kind, number = np.dtype(pick(rng, CODES)), pick(rng, NUMBERS)
    if kind.kind == "f":
        with np.errstate(over="ignore"):
            return np.array(number).astype(kind).tobytes()
    whole = int(number) % 2**64 if np.isfinite(number) else 2 ** (8 * kind.itemsize - 1)
    return np.array(whole, np.uint64).astype(kind).tobytes()


def of_bytes(rng, data: bytes) -> bytes:
    """A bit flipped, the end cut off, blocks doubled, dropped or of noise, numbers replaced by extremes."""
    result = bytearray(data)
    for _ in range(rng.choice([1, 1, 2, 4])):
        if not result:
            return packed(rng)
        number = packed(rng)
        at = int(rng.integers(min(len(result), 64) if rng.random() < 0.3 else len(result)))  # headers come first
        at -= at % len(number) * int(rng.integers(2))  # as most numbers lie
        block = int(min(len(result) - at, 2 ** rng.integers(0, 12)))
        end, new = pick(rng, [
            (at + 1, bytes([result[at] ^ 1 << int(rng.integers(8))])), (len(result), b""), (at + block, b""),
            (at, result[at : at + block]), (at + block, rng.bytes(block)), *[(at + len(number), number)] * 2,
        ])  # fmt: skip
        result[at:end] = new
    return bytes(result)


def of_text(rng, data: bytes) -> bytes:
    """Words and numbers replaced, lines dropped, doubled or joined, and other encodings."""
    text = data.decode("utf-8", "surrogateescape")
    for _ in range(rng.choice([1, 1, 3])):
        lines, words = text.split("\n"), list(re.finditer(r"[^\s,:\"\[\]{}]+", text))
        if words and rng.random() < 0.6:
            word, new = pick(rng, words), pick(rng, words)[0] if rng.random() < 0.3 else pick(rng, WORDS)
            text = text[: word.start()] + new + text[word.end() :]
            continue
        at, other = int(rng.integers(len(lines))), pick(rng, lines)
        lines[at : at + 1] = pick(rng, ([], [other, lines[at]], [f"{lines[at]} {other}"]))
        text = "\n".join(lines)
    if rng.random() < 0.15:
        return text.encode(pick(rng, ("utf-16", "utf-8-sig", "utf-32", "cp037")), "replace")
    return text.encode("utf-8", "surrogateescape")


def places(node) -> list:
    """(container, key) of each value within a JSON tree."""
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    return [place for key, value in items for place in ((node, key), *places(value))]


def of_json(rng, data: bytes) -> bytes:
    """JSON's values with keys and entries missing, doubled or renamed, and values of other kinds and sizes."""
    content = {"root": json.loads(data)}
    for _ in range(rng.choice([1, 1, 2])):
        found = places(content)
        if rng.random() < 0.5:  # near the root: there are few of those among many numbers
            found = found[:1] + [place for place in found if not isinstance(place[0], list)]
        (holder, key), (other, at) = pick(rng, found), pick(rng, found)
        match rng.integers(5):
            case 0 if holder is not content:
                del holder[key]
            case 1 if isinstance(holder, list):
                holder.insert(key, holder[key])
            case 1 if holder is not content:
                holder[str(pick(rng, ODD))[:300]] = holder.pop(key)
            case 2:
                holder[key] = json.loads(json.dumps(other[at]))
            case 3 if isinstance(holder[key], list):
                holder[key] = holder[key][: int(rng.integers(len(holder[key]) + 1))]
            case _:
                holder[key] = pick(rng, ODD)
    return json.dumps(content["root"]).encode()


def split_header(end: bytes, start: int = 0):
    """Takes a file apart in front of its header, which begins at `start`, and behind the `end` of that."""

    def split(data: bytes) -> list[bytes]:
        at = data.index(end) + len(end)
        return [data[:start], data[start:at], data[at:]]

    return split


def join_npy(parts: list[bytes]) -> bytes:
    start, header, body = parts
    return start[:8] + len(header).to_bytes(2, "little") + header + body


def split_png(data: bytes) -> list[bytes]:
    chunks, at = [], 8
    while at < len(data):
        size = int.from_bytes(data[at : at + 4])
        kind, body = data[at + 4 : at + 8], data[at + 8 : at + 8 + size]
        chunks.append(kind + (zlib.decompress(body) if kind == b"IDAT" else body))
        at += 12 + size
    return chunks


def join_png(chunks: list[bytes]) -> bytes:
    bodies = [b"IDAT" + zlib.compress(chunk[4:]) if chunk[:4] == b"IDAT" else chunk for chunk in chunks]
    parts = [(len(b) - 4).to_bytes(4) + b + zlib.crc32(b).to_bytes(4) for b in bodies]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def split_tensors(data: bytes) -> list[bytes]:
    length = int.from_bytes(data[:8], "little")
    layout = json.loads(data[8 : 8 + length])
    return [layout.pop("__metadata__")["jsecon"].encode(), json.dumps(layout).encode(), data[8 + length :]]


def join_tensors(parts: list[bytes]) -> bytes:
    told, layout, body = parts
    with contextlib.suppress(Exception):  # of a damaged part
        entries = json.loads(layout).items()
        content = json.loads(told)
        content["crc32"] = {name: zlib.crc32(body[slice(*entry["data_offsets"])]) for name, entry in entries}
        told = json.dumps(content).encode()
    metadata = json.dumps({"jsecon": told.decode(), "crc32": str(zlib.crc32(told))}).encode()
    header = layout.rstrip()[:-1] + b', "__metadata__": ' + metadata + b"}"
    return len(header).to_bytes(8, "little") + header + body


def split_onnx(data: bytes) -> list[bytes]:
    return [json.dumps(json_format.MessageToDict(onnx.load_from_string(data))).encode()]


def join_onnx(parts: list[bytes]) -> bytes:
    return json_format.ParseDict(json.loads(parts[0]), onnx.ModelProto()).SerializeToString()


CONTAINERS = {
    ".npy": (split_header(b"\n", 10), join_npy),
    ".ply": (split_header(b"end_header\n"), b"".join),
    ".png": (split_png, join_png),
    ".safetensors": (split_tensors, join_tensors),
    ".onnx": (split_onnx, join_onnx),
}
"""ending of a file -> what takes it apart, and what joins its parts"""


def damaged(rng, data: bytes, ending: str) -> tuple[str, bytes]:
    """(what was done, the bytes) of a file of this ending."""
    split, join = CONTAINERS.get(ending, (lambda data: [data], b"".join))
    try:
        parts = split(data) if rng.random() < 0.75 else [data]
        at, is_whole = int(rng.integers(len(parts))), len(parts) == 1
        match rng.integers(12):
            case 0 if not is_whole:
                del parts[at]
            case 1 if not is_whole:
                parts.insert(at, pick(rng, parts))
            case _:
                ways = [of_json] if parts[at][:1] in (b"{", b"[") else []
                ways += [of_text] if parts[at].isascii() and parts[at] else []
                way = pick(rng, [*ways, *ways, of_bytes])
                parts[at] = way(rng, parts[at])
                return way.__name__, join(parts)
        return "parts", join(parts)
    except Exception:  # no longer of its format
        return of_bytes.__name__, of_bytes(rng, data)


def read_and_check(files, read, size, capfd):
    """Reads files within the limits of time and memory, without a warning or a line on stderr. True if they are
    refused."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (used + TIMES * size + MORE, hard))
    began, refused = time.thread_time(), False
    try:
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            for category in HIDDEN:
                warnings.simplefilter("ignore", category)
            warnings.filterwarnings("ignore", module=r"PIL\.")  # of odd entries of a TIFF or an EXIF
            check_result(read())
    except InputError as error:
        refused, text, remedy = True, str(error), error.remedy
        assert remedy
        assert len(text) <= LONGEST_MESSAGE
        assert not re.search("nsufficient memory|bad.alloc|MemoryError|nable to allocate", text), text
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    assert time.thread_time() - began <= SECONDS
    assert not warned, warned[0]
    err = capfd.readouterr().err
    # libtiff writes there, whoever calls it, and so does the Rust of tokenizers when it panics.
    assert err == "" or files[0].suffix == ".tif" or "tokenizers/src" in err
    return refused


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads the address space from /proc")
@pytest.mark.parametrize("mutations", [10, pytest.param(MUTATIONS, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_refused_or_read_whole(name, mutations, tmp_path, capfd):
    made = list(cases(name, tmp_path / ODD_NAME))
    capfd.readouterr()
    for case in made:
        assert not read_and_check(*case, MORE, capfd)
    places = [(case, file) for case in made for file in case[0]]
    for number in range(-len(places), mutations):
        rng = np.random.default_rng([SEED, zlib.crc32(name.encode()), abs(number)])
        case, file = places[number if number < 0 else int(rng.integers(len(places)))]
        intact = file.read_bytes()
        way, data = ("empty", b"") if number < 0 else damaged(rng, intact, file.suffix)
        file.write_bytes(data)
        try:
            read_and_check(*case, len(data), capfd)
        except BaseException as error:
            error.add_note(f"mutation {number} of seed {SEED}: {way} of {file.parent.name}/{file.name}")
            raise
        file.write_bytes(intact)
