"""What an ONNX file declares of its inputs, read from its bytes before anything is opened: ONNX Runtime computes what
follows from a declared size while it opens a graph, and makes room for it however large it is.

Protocol buffers (protobuf.dev/programming-guides/encoding): a field's number and kind, then its number, or its length
and bytes. Fields of onnx.proto: ModelProto.graph 7; GraphProto.initializer 5, .input 11; TensorProto.name 8;
ValueInfoProto.name 1, .type 2; TypeProto.tensor_type 1; Tensor.shape 2; TensorShapeProto.dim 1; Dimension.dim_value 1.
"""

import mmap
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

_NUMBER, _BYTES, _SIZES = 0, 2, {1: 8, 5: 4}
"""kinds of fields: a number, bytes with their length before them, and those of a fixed size"""


class _Part(NamedTuple):
    """A stretch of the file, or a field's number."""

    start: int
    end: int
    number: int = 0


def declared_inputs(path: Path) -> dict[str, tuple[int, ...]]:
    """The inputs that a graph must be given, and the sizes of their axes as far as the file fixes them. What is no
    protocol buffer declares nothing: ONNX Runtime says what is wrong with it."""
    found: dict[str, tuple[int, ...]] = {}
    weights: set[str] = set()
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        try:
            for graph in _fields(data, _Part(0, len(data)), 7):
                weights |= {_text(data, part) for part in _fields(data, graph, 5, 8)}
                for value in _fields(data, graph, 11):
                    sizes = [part.number for part in _fields(data, value, 2, 1, 2, 1, 1)]
                    for name in _fields(data, value, 1):
                        found[_text(data, name)] = tuple(size for size in sizes if 0 < size < 1 << 63)
        except ValueError:
            pass
    return {name: sizes for name, sizes in found.items() if name not in weights}


def _text(data: mmap.mmap, part: _Part) -> str:
    return data[part.start : part.end].decode("utf-8", "replace")


def _fields(data: mmap.mmap, part: _Part, number: int, *inner: int) -> Iterator[_Part]:
    """The fields of a number in a message, or those within them. Raises ValueError where the bytes are none."""
    at = part.start
    while at < part.end:
        key, at = _number(data, at, part.end)
        value = 0
        if key & 7 == _NUMBER:
            value, end = _number(data, at, part.end)
        elif key & 7 == _BYTES:
            length, at = _number(data, at, part.end)
            end = at + length
        else:
            end = at + _SIZES.get(key & 7, part.end)
        if end > part.end:
            raise ValueError("a field that ends behind its message")
        if key >> 3 == number and inner:
            yield from _fields(data, _Part(at, end), *inner)
        elif key >> 3 == number:
            yield _Part(at, end, value)
        at = end


def _number(data: mmap.mmap, at: int, end: int) -> tuple[int, int]:
    """(number, where the next field begins)."""
    value = 0
    for shift in range(0, 70, 7):
        if at >= end:
            break
        byte, at = data[at], at + 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, at
    raise ValueError("a number without an end")
