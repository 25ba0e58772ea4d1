"""Cells of tables: kept in one file, also where writers are killed, and shared out among processes."""

import lzma
import warnings

import pytest

from experiments.cells import append_cell, exclusive_lock, read_cells
from jsecon.errors import InputError


def test_a_writer_killed_within_a_line_costs_that_cell_alone(tmp_path):
    file = tmp_path / "cells.jsonl"
    append_cell(file, "a", 1)
    with file.open("a") as half:
        half.write('{"key": "b", "val')
    with pytest.warns(UserWarning, match="incomplete last line"):
        assert read_cells(file) == {"a": 1}
    with pytest.warns(UserWarning, match='removed.*"key": "b"'):
        append_cell(file, "c", 3)
    assert file.read_bytes() == b'{"key": "a", "value": 1}\n{"key": "c", "value": 3}\n'
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # nothing is left to be said
        append_cell(file, "b", 2)
        assert read_cells(file) == {"a": 1, "b": 2, "c": 3}


@pytest.mark.parametrize("line", ["<<<<<<< HEAD", '{"key": "b"}', "[1, 2]", ""])
def test_a_whole_line_that_is_no_cell_is_refused(tmp_path, line):
    file = tmp_path / "cells.jsonl"
    file.write_text(f'{{"key": "a", "value": 1}}\n{line}\n{{"key": "c", "value": 3}}\n')
    with pytest.raises(InputError, match="line 2 is no cell"):
        read_cells(file)


def test_cells_are_read_as_written_and_the_later_line_counts(tmp_path):
    file = tmp_path / "new" / "cells.jsonl"
    assert read_cells(file) == {}
    value = {"miou": 0.1 + 0.2, "pairs": 8, "twin": True, "name": "Bär\n", "none": None}
    append_cell(file, "a", value)
    append_cell(file, "b", [1.0])
    assert read_cells(file) == {"a": value, "b": [1.0]}
    packed = file.with_name("cells.jsonl.xz")
    packed.write_bytes(lzma.compress(file.read_bytes()))
    file.unlink()
    append_cell(file, "a", {"miou": 0.5})
    assert read_cells(file) == {"a": {"miou": 0.5}, "b": [1.0]}
    assert len(file.read_text().splitlines()) == 1


def test_a_lock_is_held_by_one(tmp_path):
    file = tmp_path / "cells" / "a.lock"
    with exclusive_lock(file, wait=False) as first, exclusive_lock(file, wait=False) as second:
        assert first
        assert not second
    assert not file.exists()
