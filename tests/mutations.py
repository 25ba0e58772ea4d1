"""Damage to files: of bytes, texts, JSON, arrays, PNGs and ONNX graphs. Every choice comes from the `rng`
given, so that a seed names a damaged file."""

import copy
import io
import json
import re
import struct
import zlib

import numpy as np
import onnx

NUMBERS = (0, -1, 1, 2**31, -(2**31), 2**32 - 1, 2**63, 2**64 - 1, float("nan"), float("inf"), 1e308, -1e308, 1e-320)
WORDS = (*map(repr, NUMBERS), "1e400", "9" * 400, "9" * 5000, "1_0", "٣", "1,5", "0x10", "", "\0", "../x", "x" * 300)
CODES = ("<i4", "<u4", "<i8", "<u8", "<f4", "<f8", "<u2", "u1", ">u4", ">u2", ">f4")
ODD = (None, True, *NUMBERS, 10**400, "", "a\0b", "\ud800", "x" * 5000, "../x", [], {}, [[]], [1, 2, 3], {"a": 1})
ENCODINGS = ("utf-16", "utf-8-sig", "utf-32", "cp037")
TYPES = ("<f8", ">f4", "<i4", "<i8", "<u8", "u1", "?", "<f2", "<c8", "S3", "<M8[s]")
SIZES = (0, -1, 1, 2, 7, 2**31, 2**62, 2**63 - 1)
RAW = {"@deep list@": "[" * 100_000 + "]" * 100_000, "@deep dict@": '{"a":' * 50_000 + "1" + "}" * 50_000}
"""JSON that is nested too deep to be written by `json`, and what stands for it"""


def pick(rng, items):
    return items[int(rng.integers(len(items)))] if len(items) else None


def _packed(rng) -> bytes:
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
            return _packed(rng)
        at = int(rng.integers(min(len(result), 64) if rng.random() < 0.3 else len(result)))  # headers come first
        block = int(min(len(result) - at, 2 ** rng.integers(0, 12)))
        match rng.integers(7):
            case 0:
                result[at] ^= 1 << int(rng.integers(8))
            case 1:
                del result[at:]
            case 2:
                result[at:at] = result[at : at + block]
            case 3:
                del result[at : at + block]
            case 4:
                result[at : at + block] = rng.bytes(block)
            case _:
                number = _packed(rng)
                at -= at % len(number) * int(rng.integers(2))
                result[at : at + len(number)] = number
    return bytes(result)


def of_text(rng, data: bytes) -> bytes:
    """Words and numbers replaced, lines dropped, doubled or joined, and other encodings."""
    text = data.decode("utf-8", "surrogateescape")
    for _ in range(rng.choice([1, 1, 3])):
        lines, words = text.split("\n"), list(re.finditer(r"[^\s,:\"\[\]{}]+", text))
        at = int(rng.integers(len(lines)))
        match rng.integers(8):
            case 0:
                del lines[at]
            case 1:
                lines.insert(at, pick(rng, lines))
            case 2:
                lines[at] += " " + pick(rng, lines)
            case _ if words:
                word = pick(rng, words)
                new = pick(rng, words)[0] if rng.random() < 0.3 else pick(rng, WORDS)
                lines = [text[: word.start()] + new + text[word.end() :]]
        text = "\n".join(lines)
    found = text.encode("utf-8", "surrogateescape")
    if rng.random() < 0.15:
        return found.decode("utf-8", "replace").encode(pick(rng, ENCODINGS), "replace")
    return found


def _places(node) -> list:
    """(container, key) of each value within a JSON tree."""
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    return [place for key, value in items for place in ((node, key), *_places(value))]


def of_tree(rng, content):
    """JSON's values with keys and entries missing, doubled or renamed, and values of other kinds and sizes."""
    content = {"root": copy.deepcopy(content)}
    for _ in range(rng.choice([1, 1, 2])):
        places = _places(content)
        if rng.random() < 0.5:  # near the root: there are few of those among many numbers
            places = places[:1] + [place for place in places if not isinstance(place[0], list)]
        holder, key = pick(rng, places)
        match rng.integers(6):
            case 0 if holder is not content:
                del holder[key]
            case 1 if isinstance(holder, list):
                holder.insert(key, copy.deepcopy(holder[key]))
            case 1 if holder is not content:
                holder[str(pick(rng, ODD))[:300]] = holder.pop(key)
            case 2:
                other, at = pick(rng, places)
                holder[key] = copy.deepcopy(other[at])
            case 3 if rng.random() < 0.3:
                holder[key] = pick(rng, list(RAW))
            case 4 if isinstance(holder[key], list):
                holder[key] = holder[key][: int(rng.integers(len(holder[key]) + 1))]
            case _:
                holder[key] = copy.deepcopy(pick(rng, ODD))
    return content["root"]


def _written(tree) -> str:
    text = json.dumps(tree)
    for mark, raw in RAW.items():
        text = text.replace(json.dumps(mark), raw)
    return text


def of_json(rng, data: bytes) -> bytes:
    return _written(of_tree(rng, json.loads(data))).encode()


def of_array(rng, data: bytes) -> bytes:
    """A .npy file with another header, type or shape, or with an extreme number."""
    array, header = np.load(io.BytesIO(data)), data.index(b"\n") + 1
    with np.errstate(all="ignore"):
        match rng.integers(4):
            case 0:
                text = of_text(rng, data[10:header])[:65535]
                return data[:8] + struct.pack("<H", len(text)) + text + data[header:]
            case 1:
                array = array.astype(np.dtype(pick(rng, TYPES)), casting="unsafe")
            case 2 if array.ndim:
                array = pick(rng, [array[:0], array[1:], array[None], array.T, array.ravel(), array[..., :1]])
            case 3 if array.size and array.dtype.kind == "f":
                array.flat[rng.integers(array.size)] = np.array(pick(rng, NUMBERS), array.dtype)
            case _:
                return of_bytes(rng, data)
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def of_tensors(rng, data: bytes) -> bytes:
    """A safetensors file with another layout or description, or with an array that does not match, whose checksums are
    right."""
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
            name = pick(rng, [name for name in layout if name != "__metadata__"])
            begin, end = layout[name]["data_offsets"]
            size = min(8, end - begin)
            at = begin + int(rng.integers(end - begin - size + 1))
            body = body[:at] + rng.bytes(size) + body[at + size :]
            told["crc32"][name] = zlib.crc32(body[begin:end])
    text = _written(told)
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
    at = int(rng.integers(len(chunks)))
    kind, body = chunks[at]
    match rng.integers(6):
        case 0 if len(chunks) > 1:
            del chunks[at]
        case 1:
            chunks.insert(int(rng.integers(len(chunks))), [kind, body])
        case 2 if kind == b"IDAT":
            chunks[at][1] = zlib.compress(of_bytes(rng, zlib.decompressobj().decompress(body)))
        case 3:
            chunks[0][1] = of_bytes(rng, chunks[0][1])
        case 4:
            chunks[at][0] = bytes(rng.choice([b"tRNS", b"PLTE", b"gAMA", b"iCCP", b"acTL", b"eXIf", b"zzZz"]))
        case _:
            chunks[at][1] = of_bytes(rng, body)
    parts = (struct.pack(">I", len(b)) + k + b + struct.pack(">I", zlib.crc32(k + b)) for k, b in chunks)
    return data[:8] + b"".join(parts)


def of_graph(rng, data: bytes) -> bytes:
    """An ONNX graph with another size, type, name, operation or weight."""
    model = onnx.load_from_string(data)
    graph, size = model.graph, pick(rng, SIZES)
    node, weight = pick(rng, graph.node), pick(rng, graph.initializer)
    value = pick(rng, [*graph.input, *graph.output])
    dims = value.type.tensor_type.shape.dim
    match rng.integers(8):
        case 0:
            node.op_type = pick(
                rng, ["Add", "MatMul", "Conv", "Reshape", "Gather", "Cast", "Nothing", "Loop", "Resize"]
            )
        case 1 if weight is not None and len(weight.dims):
            weight.dims[int(rng.integers(len(weight.dims)))] = size
        case 2 if weight is not None:
            weight.raw_data = of_bytes(rng, weight.raw_data)
        case 3 if dims:
            pick(rng, dims).dim_value = size
        case 4:
            value.type.tensor_type.elem_type = int(rng.integers(0, 24))
        case 5:
            value.name = pick(rng, ["", "x", "input", node.output[0]])
        case 6:
            graph.node.remove(node)
        case _:
            model.opset_import[0].version = int(pick(rng, [0, 1, 7, 11, 18, 25, 99, -1]))
    return model.SerializeToString()


def of_ply(rng, data: bytes) -> bytes:
    """A .ply with another header over the same body, or another body."""
    end = data.index(b"end_header\n") + 11
    if rng.random() < 0.6:
        return of_text(rng, data[:end]) + data[end:]
    return data[:end] + (of_text if b"format ascii" in data else of_bytes)(rng, data[end:])


KINDS = {
    ".txt": (of_text, of_text, of_bytes),
    ".json": (of_json, of_json, of_text, of_bytes),
    ".npy": (of_array, of_array, of_bytes),
    ".safetensors": (of_tensors, of_tensors, of_tensors, of_bytes),
    ".png": (of_png, of_png, of_bytes),
    ".onnx": (of_graph, of_bytes),
    ".ply": (of_ply, of_ply, of_bytes),
}


def damaged(rng, data: bytes, ending: str) -> tuple[str, bytes]:
    """(what was done, the bytes) of a file of this ending."""
    way = pick(rng, KINDS.get(ending, (of_bytes,)))
    try:
        return way.__name__, way(rng, data)
    except Exception:  # damaged twice: no longer of its format
        return of_bytes.__name__, of_bytes(rng, data)
