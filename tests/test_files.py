"""Arrays and JSON are read without trust: what was written comes back, what a header only claims takes no memory."""

import io

import numpy as np
import pytest
from safetensors.numpy import load_file

from jsecon.files import READ_ERRORS, map_npy, parse_json, read_arrays, write_arrays

ARRAYS = {
    "table": np.arange(12, dtype=">f4").reshape(3, 4),
    "turned": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "number": np.array(7),
    "nothing": np.zeros((0, 3), np.int16),
    "flags": np.array([True, False]),
}


@pytest.mark.parametrize("mapped", [0, 1 << 30])
def test_arrays_and_their_description_come_back(tmp_path, mapped):
    write_arrays(tmp_path / "a.safetensors", ARRAYS, {"of": ["what", 1, None, "\udcff"]})
    description, arrays = read_arrays(tmp_path / "a.safetensors", memory_map_above=mapped)
    assert description == {"of": ["what", 1, None, "\udcff"]}
    others = load_file(tmp_path / "a.safetensors")  # by the format's own library
    assert arrays.keys() == others.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert arrays[name].dtype == array.dtype.newbyteorder("<")
        assert isinstance(arrays[name], np.memmap) == (mapped == 0 and array.size > 0)
        assert arrays[name].ctypes.data % array.itemsize == 0
        np.testing.assert_array_equal(arrays[name], array)
        np.testing.assert_array_equal(others[name], array)


def test_every_byte_counts(tmp_path):
    """A bit flipped in any byte is noticed."""
    path = tmp_path / "a.safetensors"
    write_arrays(path, {"a": np.arange(5.0), "b": np.ones((2, 3), np.int32)}, {"x": 1})
    content = path.read_bytes()
    for place in range(len(content)):
        path.write_bytes(content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :])
        with pytest.raises(READ_ERRORS):
            read_arrays(path)


def test_headers_of_other_writers_are_read(tmp_path):
    header = b"{'shape':(2L, 3L),\"descr\":\"<i2\", 'fortran_order' : False}\n"
    body = b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header + np.arange(6, dtype="<i2").tobytes()
    (tmp_path / "a.npy").write_bytes(body)
    np.testing.assert_array_equal(map_npy(tmp_path / "a.npy"), [[0, 1, 2], [3, 4, 5]])


def saved(array):
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


@pytest.mark.parametrize("content", [
    saved(np.zeros((2, 3))).replace(b"(2, 3)", b"(9, 9)"), saved(np.zeros((2, 3))).replace(b"(2, 3)", b"(1, 3)"),
    saved(np.zeros((2, 3))).replace(b"(2, 3),", b"(99999999999999999999, 0),"), saved(np.zeros(3))[:-1],
    saved(np.zeros(3)) + b"more", saved(np.array(["a"])), saved(np.zeros(2, "<M8[s]")), b"",
    b"\x93NUMPY\1\0\xff\xff",
])  # fmt: skip
def test_what_the_bytes_do_not_hold_is_refused(tmp_path, content):
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(READ_ERRORS):
        map_npy(tmp_path / "a.npy")


def test_json_without_end_or_bounds():
    assert parse_json('{"a": [12345678901234567890123, "b"]}') == {"a": [12345678901234567890123, "b"]}
    assert parse_json("\ufeff[1]".encode()) == [1]
    assert parse_json("9" * 400) == float("inf")
    with pytest.raises(ValueError, match="too deeply"):
        parse_json("[" * 100_000)
