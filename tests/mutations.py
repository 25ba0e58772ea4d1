"""Damage to files: of bytes, texts, JSON, arrays, PNGs and ONNX graphs. Every choice comes from the `rng`
given, so that a seed names a damaged file."""

import copy
import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable

import numpy as np
import onnx

NUMBERS = (0, -1, 1, 2**31, -(2**31), 2**32 - 1, 2**63, 2**64 - 1, float("nan"), float("inf"), 1e308, -1e308, 1e-320)
WORDS = (*map(repr, NUMBERS), "1e400", "9" * 400, "9" * 5000, "1_0", "٣", "1,5", "0x10", "", "\0", "../x", "x" * 300)
CODES = ("<i4", "<u4", "<i8", "<u8", "<f4", "<f8", "<u2", "u1", ">u4", ">u2", ">f4")
ODD = (None, True, *NUMBERS, 10**400, "", "a\0b", "\ud800", "x" * 5000, "../x", [], {}, [[]], [1, 2, 3], {"a": 1})
_RAW = {"@deep list@": "[" * 100_000 + "]" * 100_000, "@deep dict@": '{"a":' * 50_000 + "1" + "}" * 50_000}


def _packed(rng, code: str) -> bytes:
    kind, number = np.dtype(code), NUMBERS[rng.integers(len(NUMBERS))]
    if kind.kind == "f":
        with np.errstate(over="ignore"):
            return np.array(number).astype(kind).tobytes()
    number = int(number) if np.isfinite(number) and abs(number) < 2**70 else 2 ** (8 * kind.itemsize - 1)
    number %= 1 << (8 * kind.itemsize)
    return number.to_bytes(kind.itemsize, "big" if code[0] == ">" else "little")


def of_bytes(rng, data: bytes) -> bytes:
    """Bits flipped, the end cut off, blocks doubled, zeroed, dropped or of noise, numbers replaced by extremes."""
    result, size = bytearray(data), len(data)
    if not size:
        return _packed(rng, "<u8")
    for _ in range(rng.choice([1, 1, 2, 4])):
        at = int(rng.integers(min(size, 64) if rng.random() < 0.3 else size))  # headers come first
        block = int(min(size - at, 2 ** rng.integers(0, 12)))
        match rng.integers(8):
            case 0:
                result[at] ^= 1 << int(rng.integers(8))
            case 1:
                del result[at:]
            case 2:
                result[at:at] = result[at : at + block]
            case 3:
                result[at : at + block] = bytes(block)
            case 4:
                del result[at : at + block]
            case 5:
                result[at : at + block] = rng.bytes(block)
            case _:
                number = _packed(rng, CODES[rng.integers(len(CODES))])
                at -= at % len(number) * int(rng.integers(2))
                result[at : at + len(number)] = number
        size = len(result)
        if not size:
            break
    return bytes(result)


def of_text(rng, data: bytes) -> bytes:
    """Words and numbers replaced, lines dropped, doubled, swapped or joined, and other encodings."""
    text = data.decode("utf-8", "surrogateescape")
    for _ in range(rng.choice([1, 1, 3])):
        lines, words = text.split("\n"), list(re.finditer(r"[^\s,:\"\[\]{}]+", text))
        at, other = (int(n) for n in rng.integers(len(lines), size=2))
        match rng.integers(10):
            case 0:
                del lines[at]
            case 1:
                lines.insert(at, lines[other])
            case 2:
                lines[at], lines[other] = lines[other], lines[at]
            case 3:
                lines[at] = lines[at] + " " + lines[other]
            case 4:
                lines[at] = ""
            case _ if words:
                word, new = words[rng.integers(len(words))], WORDS[rng.integers(len(WORDS))]
                if rng.random() < 0.3:
                    new = words[rng.integers(len(words))][0]
                lines = [text[: word.start()] + new + text[word.end() :]]
        text = "\n".join(lines)
    found = text.encode("utf-8", "surrogateescape")
    if rng.random() < 0.15:
        codes = ("utf-16", "utf-8-sig", "utf-32", "cp037")
        plain = found.decode("utf-8", "replace")
        found = [plain.encode(code, "replace") for code in codes][rng.integers(4)]
    elif rng.random() < 0.1:
        found = (found.replace(b"\n", b"\r\n"), found.replace(b"\n", b"\r"), found + b"\xff\xfe", b"\0" + found)[
            rng.integers(4)
        ]
    return found


def _nodes(node, holders: list) -> list:
    """(container, key) of each value within a JSON tree."""
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in items:
        holders.append((node, key))
        _nodes(value, holders)
    return holders


def of_tree(rng, content):
    """JSON's values with keys and entries missing, doubled or renamed, and values of other kinds and sizes."""
    content = {"root": copy.deepcopy(content)}
    for _ in range(rng.choice([1, 1, 2])):
        holders = _nodes(content, [])
        if rng.random() < 0.5:  # near the root: there are few of those among many numbers
            holders = holders[:1] + [pair for pair in holders if not isinstance(pair[0], list)] or holders
        holder, key = holders[rng.integers(len(holders))]
        other, at = holders[rng.integers(len(holders))]
        match rng.integers(7):
            case 0 if holder is not content:
                del holder[key]
            case 1 if isinstance(holder, list):
                holder.insert(key, copy.deepcopy(holder[key]))
            case 1 if holder is not content:
                holder[str(ODD[rng.integers(len(ODD))])[:300]] = holder.pop(key)
            case 2:
                holder[key] = copy.deepcopy(other[at])
            case 3 if rng.random() < 0.3:
                holder[key] = list(_RAW)[rng.integers(2)]
            case 4 if isinstance(holder[key], list):
                holder[key] = holder[key][: int(rng.integers(len(holder[key]) + 1))]
            case 5 if isinstance(holder[key], int | float):
                holder[key] = NUMBERS[rng.integers(len(NUMBERS))]
            case _:
                holder[key] = copy.deepcopy(ODD[rng.integers(len(ODD))])
    return content["root"]


def of_json(rng, data: bytes) -> bytes:
    text = json.dumps(of_tree(rng, json.loads(data)))
    for mark, raw in _RAW.items():
        text = text.replace(json.dumps(mark), raw)
    return text.encode()


TYPES = ("<f8", ">f4", "<i4", "<i8", "<u8", "u1", "?", "<f2", "<c8", "S3", "<M8[s]")


def of_array(rng, data: bytes) -> bytes:
    """A .npy file with another header, type or shape, or with extreme numbers."""
    array, header = np.load(io.BytesIO(data)), data.index(b"\n") + 1
    match rng.integers(4):
        case 0:
            text = of_text(rng, data[10:header])[:65535]
            return data[:8] + struct.pack("<H", len(text)) + text + data[header:]
        case 1:
            kind = np.dtype(TYPES[rng.integers(len(TYPES))])
            with np.errstate(all="ignore"):
                array = array.astype(kind, casting="unsafe")
        case 2 if array.ndim:
            array = [array[:0], array[1:], array[None], array.T, array.ravel(), array[..., :1]][rng.integers(6)]
        case 3 if array.size and array.dtype.kind == "f":
            array = array.copy()
            with np.errstate(all="ignore"):
                array.flat[rng.integers(array.size)] = np.array(NUMBERS[rng.integers(len(NUMBERS))], array.dtype)
        case _:
            return of_bytes(rng, data)
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def of_archive(rng, data: bytes) -> bytes:
    """An .npz file with a damaged or missing array, whose checksums are right."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = list(members)[rng.integers(len(members))]
    body = members.pop(name)
    if rng.random() < 0.7:
        members[name] = of_array(rng, body)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, body in members.items():
            archive.writestr(name, body)
    return stream.getvalue()


def of_tensors(rng, data: bytes) -> bytes:
    """A safetensors file with another layout or another description, or with arrays that do not match, whose checksums
    are right."""
    length = int.from_bytes(data[:8], "little")
    layout, body = json.loads(data[8 : 8 + length]), data[8 + length :]
    told = json.loads(layout["__metadata__"]["jsecon"])
    match rng.integers(4):
        case 0:
            text = of_json(rng, data[8 : 8 + length])
            return len(text).to_bytes(8, "little") + text + body
        case 1:
            told = of_tree(rng, told)
        case 2:
            body = of_bytes(rng, body)
        case _:
            name, entry = [item for item in layout.items() if item[0] != "__metadata__"][rng.integers(len(layout) - 1)]
            begin, end = entry["data_offsets"]
            numbers = np.frombuffer(body[begin:end], np.dtype(f"<u{min(np.gcd(end - begin, 8), 8)}")).copy()
            if len(numbers):
                numbers[rng.integers(len(numbers))] = rng.integers(1 << 63) >> rng.integers(64)
            body = body[:begin] + numbers.tobytes() + body[end:]
            told["crc32"][name] = zlib.crc32(body[begin:end])
    text = json.dumps(told)
    for mark, raw in _RAW.items():
        text = text.replace(json.dumps(mark), raw)
    layout["__metadata__"] = {"jsecon": text, "crc32": str(zlib.crc32(text.encode()))}
    header = json.dumps(layout).encode()
    return len(header).to_bytes(8, "little") + header + body


def of_png(rng, data: bytes) -> bytes:
    """A PNG with damaged, missing or doubled chunks, whose checksums are right."""
    chunks, at = [], 8
    while at + 8 <= len(data):
        size = int.from_bytes(data[at : at + 4])
        chunks.append([data[at + 4 : at + 8], data[at + 8 : at + 8 + size]])
        at += 12 + size
    for _ in range(rng.choice([1, 1, 2])):
        at = int(rng.integers(len(chunks)))
        kind, body = chunks[at]
        match rng.integers(7):
            case 0 if len(chunks) > 1:
                del chunks[at]
            case 1:
                chunks.insert(int(rng.integers(len(chunks))), [kind, body])
            case 2 if kind == b"IDAT":
                raw = of_bytes(rng, zlib.decompressobj().decompress(body))
                chunks[at][1] = zlib.compress(raw)
            case 3 | 4:
                chunks[0][1] = of_bytes(rng, chunks[0][1])
            case 5:
                chunks[at][0] = bytes(rng.choice([b"tRNS", b"PLTE", b"gAMA", b"iCCP", b"acTL", b"eXIf", b"zzZz"]))
            case _:
                chunks[at][1] = of_bytes(rng, body)
    parts = (struct.pack(">I", len(b)) + k + b + struct.pack(">I", zlib.crc32(k + b)) for k, b in chunks)
    return data[:8] + b"".join(parts)


def of_graph(rng, data: bytes) -> bytes:
    """An ONNX graph with other sizes, types, names, operations or weights."""
    model = onnx.load_from_string(data)
    graph = model.graph
    for _ in range(rng.choice([1, 1, 2])):

        def pick(items):
            return items[int(rng.integers(len(items)))] if len(items) else None

        node, weight, value = pick(graph.node), pick(graph.initializer), pick([*graph.input, *graph.output])
        size = int([0, -1, 1, 2, 7, 2**31, 2**62, 2**63 - 1][rng.integers(8)])
        match rng.integers(11):
            case 0 if node and len(node.input):
                node.input[int(rng.integers(len(node.input)))] = pick(
                    ["", "x", *(v for n in graph.node for v in n.output)]
                )
            case 1 if node:
                node.op_type = pick(["Add", "MatMul", "Conv", "Reshape", "Gather", "Cast", "Nothing", "Loop", "Resize"])
            case 2 if weight is not None and len(weight.dims):
                weight.dims[int(rng.integers(len(weight.dims)))] = size
            case 3 if weight is not None:
                weight.raw_data = of_bytes(rng, weight.raw_data)
            case 4 if weight is not None:
                weight.data_type = int(rng.integers(0, 24))
            case 5 if value is not None and len(value.type.tensor_type.shape.dim):
                pick(value.type.tensor_type.shape.dim).dim_value = size
            case 6 if value is not None:
                value.type.tensor_type.elem_type = int(rng.integers(0, 24))
            case 7 if value is not None:
                value.name = pick(["", "x", "input", node.output[0] if node else "y"])
            case 8 if node and len(node.attribute):
                attribute = pick(node.attribute)
                attribute.i = size
                for n in range(len(attribute.ints)):
                    attribute.ints[n] = size
            case 9 if node:
                graph.node.remove(node)
            case _:
                model.opset_import[0].version = int([0, 1, 7, 11, 18, 25, 99, -1][rng.integers(8)])
    return model.SerializeToString()


def of_ply(rng, data: bytes) -> bytes:
    """A .ply with another header over the same body, or another body."""
    end = data.index(b"end_header\n") + 11
    if rng.random() < 0.6:
        return of_text(rng, data[:end]) + data[end:]
    return data[:end] + (of_text if b"format ascii" in data else of_bytes)(rng, data[end:])


KINDS: dict[str, tuple[Callable, ...]] = {
    ".txt": (of_text, of_text, of_bytes),
    ".json": (of_json, of_json, of_text, of_bytes),
    ".npy": (of_array, of_array, of_bytes),
    ".npz": (of_archive, of_archive, of_bytes),
    ".safetensors": (of_tensors, of_tensors, of_tensors, of_bytes),
    ".png": (of_png, of_png, of_bytes),
    ".onnx": (of_graph, of_bytes),
    ".ply": (of_ply, of_ply, of_bytes),
}


def damaged(rng, data: bytes, ending: str) -> tuple[str, bytes]:
    """(what was done, the bytes) of a file of this ending."""
    way = KINDS.get(ending, (of_bytes,))
    way = way[int(rng.integers(len(way)))]
    try:
        return way.__name__, way(rng, data)
    except Exception:  # damaged twice: no longer of its format
        return of_bytes.__name__, of_bytes(rng, data)
