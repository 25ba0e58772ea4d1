"""A field larger than memory is asked in blocks, to the same answers and the same files."""

import json

import pytest
from capture_files import run_cli

from jsecon import Box, InputError, open_scene
from jsecon.field import columns, field as field_file

TEXTS = ("red", "blue or green but not red", "magenta", "tea")


@pytest.fixture
def forced(monkeypatch):
    """No room in memory, every column on disk, a handful of blocks."""
    monkeypatch.setenv("JSECON_MEMORY", "1e-9")
    monkeypatch.setattr(field_file, "MAPPED", 0)
    monkeypatch.setattr(columns, "ROWS", 700)


def _query(field, out, *more):
    return run_cli("query", field, *more, "--out", out, "--views", 1)


def test_the_same_files_as_in_memory(room_run, tmp_path, forced, monkeypatch, capsys):
    run, out = room_run
    asked = out / "field.safetensors", *TEXTS, "--at", run.capture.names[1], 80, 60
    codes, told = [], []
    for name, budget in (("blocks", "1e-9"), ("memory", "1000")):
        monkeypatch.setenv("JSECON_MEMORY", budget)
        codes.append(_query(asked[0], tmp_path / name, *asked[1:]))
        told.append(capsys.readouterr().out.replace(name, ""))
    assert codes == [2, 2]  # nothing is known of tea
    assert told[0] == told[1]
    blocks, memory = ({f.name: f.read_bytes() for f in (tmp_path / n).iterdir()} for n in ("blocks", "memory"))
    assert json.loads(blocks["red.json"])["count"] > 0
    for files in (blocks, memory):
        assert files.pop("answers.html")  # whose photographs may differ in a pixel's last weight
    assert blocks == memory


def test_what_needs_all_columns_at_once_is_refused(room_run, tmp_path, forced, capsys):
    file = room_run[1] / "field.safetensors"
    assert _query(file, tmp_path / "answers", "the leftmost red") == 2
    message = capsys.readouterr().err
    assert "a relation" in message
    assert "JSECON_MEMORY=" in message
    assert not list((tmp_path / "answers").glob("*"))
    with pytest.raises(InputError, match="an outline"):
        open_scene(file).ask(Box("#1", 2, 2, 9, 9))


def test_a_damaged_field_is_refused(room_run, tmp_path, forced, capsys):
    whole = bytearray((room_run[1] / "field.safetensors").read_bytes())
    whole[len(whole) // 2] ^= 255
    (tmp_path / "field.safetensors").write_bytes(whole)
    assert _query(tmp_path / "field.safetensors", tmp_path, "red") == 2
    assert "damaged" in capsys.readouterr().err
