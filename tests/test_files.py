"""Arrays and JSON are read without trust: what NumPy writes comes back, what a header only claims takes no memory."""

import io
import zipfile

import numpy as np
import pytest

from jsecon.files import UNREADABLE, map_array, parsed_json, read_arrays

ARRAYS = {
    "table": np.arange(12, dtype=">f4").reshape(3, 4),
    "turned": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "number": np.array(7),
    "nothing": np.zeros((0, 3), np.int16),
    "flags": np.array([True, False]),
}


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize("mapped", [0, 1 << 30])
def test_what_numpy_writes_comes_back(tmp_path, save, mapped):
    save(tmp_path / "a.npz", **ARRAYS)
    found = read_arrays(tmp_path / "a.npz", mapped=mapped)
    assert found.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert found[name].dtype == array.dtype
        assert found[name].flags.f_contiguous == array.flags.f_contiguous
        np.testing.assert_array_equal(found[name], array)


def test_headers_of_other_writers_are_read(tmp_path):
    header = b"{'shape':(2L, 3L),\"descr\":\"<i2\", 'fortran_order' : False}\n"
    body = b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header + np.arange(6, dtype="<i2").tobytes()
    (tmp_path / "a.npy").write_bytes(body)
    np.testing.assert_array_equal(map_array(tmp_path / "a.npy"), [[0, 1, 2], [3, 4, 5]])


def saved(array):
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


@pytest.mark.parametrize(
    "content",
    [
        saved(np.zeros((2, 3))).replace(b"(2, 3)", b"(9, 9)"),
        saved(np.zeros((2, 3))).replace(b"(2, 3),", b"(99999999999999999999, 0),"),
        saved(np.zeros(3))[:-1],
        saved(np.array(["a"])),
        saved(np.zeros(2, "<M8[s]")),
        b"",
        b"\x93NUMPY\1\0\xff\xff",
    ],
)
def test_what_the_bytes_do_not_hold_is_refused(tmp_path, content):
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(UNREADABLE):
        map_array(tmp_path / "a.npy")
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", content)
    with pytest.raises(UNREADABLE):
        read_arrays(tmp_path / "a.npz")


def test_a_size_that_no_deflated_stream_can_have_is_refused(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", a=np.zeros(9))
    data = bytearray((tmp_path / "a.npz").read_bytes())
    at = data.index(b"PK\1\2") + 24  # the size in the directory
    data[at : at + 4] = (1 << 30).to_bytes(4, "little")
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(ValueError, match="1073741824 bytes in a file of"):
        read_arrays(tmp_path / "a.npz")


def test_json_without_end_or_bounds():
    assert parsed_json('{"a": [12345678901234567890123, "b"]}') == {"a": [12345678901234567890123, "b"]}
    assert parsed_json("\ufeff[1]".encode()) == [1]
    assert parsed_json("9" * 400) == float("inf")
    with pytest.raises(ValueError, match="too deeply"):
        parsed_json("[" * 100_000)
