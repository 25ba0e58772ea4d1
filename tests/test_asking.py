"""A field larger than memory is asked in blocks, to the same answers and the same files."""

import dataclasses
import json

import numpy as np
import pytest

from jsecon import Scene
from jsecon.app import cli
from jsecon.field import columns, field as field_file
from jsecon.field.field import load_field, save_field
from jsecon.types import Parts
from jsecon.vision.colours import ColourEmbedder

TEXTS = ("red", "blue or green but not red", "tea")


@pytest.fixture
def forced(monkeypatch):
    """No room in memory, every column on disk, a handful of blocks."""
    monkeypatch.setenv("JSECON_MEMORY", "1e-9")
    monkeypatch.setattr(field_file, "MAPPED", 0)
    monkeypatch.setattr(columns, "ROWS", 700)


def _query(field, out, *more):
    return cli.main([str(word) for word in ("query", field, *more, "--out", out, "--views", 1)])


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
    files = sorted(file.name for file in (tmp_path / "memory").iterdir())
    assert {"red.json", "answers.html"} < set(files)
    assert sorted(file.name for file in (tmp_path / "blocks").iterdir()) == files
    assert json.loads((tmp_path / "blocks" / "red.json").read_text())["count"] > 0
    for name in set(files) - {"answers.html"}:  # whose photographs may differ in a pixel's last weight
        assert (tmp_path / "blocks" / name).read_bytes() == (tmp_path / "memory" / name).read_bytes(), name


def test_parts_and_what_no_text_names(room_run, tmp_path, forced):
    """The parts of a field of `--parts` divide an answer alike; an answer of nothing is one in blocks too."""
    _, out = room_run
    rng, field = np.random.default_rng(0), load_field(out / "field.safetensors")
    rows = rng.normal(size=(20, field.canonical_phrases.shape[1])).astype(np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    parts = Parts(rng.integers(-1, 20, field.gaussians.count).astype(np.int32), rows, np.ones(20, np.float32))
    field = dataclasses.replace(field, parts=parts)
    save_field(tmp_path / "field.safetensors", field)
    mapped = load_field(tmp_path / "field.safetensors", mapped=True)
    assert isinstance(mapped.parts.part, np.memmap)
    for threshold in (None, 1.0):
        options = {"all_of_class": True, "threshold": threshold}
        answers, blocks = (Scene(f, ColourEmbedder()).ask_all(("red", "magenta"), **options) for f in (field, mapped))
        for memory, block in zip(answers, blocks, strict=True):
            np.testing.assert_array_equal(block.mask, memory.mask)
            rows = memory.rows
            np.testing.assert_array_equal(block.selection.similarity[rows], memory.selection.similarity[rows])
            assert block.as_dict() == memory.as_dict()


@pytest.mark.parametrize("more", [("--box", "#1", 2, 2, 9, 9), ("the leftmost red",)])
def test_what_needs_all_columns_at_once_is_refused(room_run, tmp_path, forced, capsys, more):
    _, out = room_run
    assert _query(out / "field.safetensors", tmp_path / "answers", *more) == 2
    message = capsys.readouterr().err
    assert ("an outline" if len(more) > 1 else "a relation") in message
    assert "JSECON_MEMORY=" in message
    assert not list((tmp_path / "answers").glob("*"))


def test_a_damaged_field_and_a_budget_that_is_none(room_run, tmp_path, forced, monkeypatch, capsys):
    _, out = room_run
    whole = bytearray((out / "field.safetensors").read_bytes())
    whole[len(whole) // 2] ^= 255
    (tmp_path / "field.safetensors").write_bytes(whole)
    assert _query(tmp_path / "field.safetensors", tmp_path, "red") == 2
    assert "damaged" in capsys.readouterr().err
    monkeypatch.setenv("JSECON_MEMORY", "much")
    assert _query(out / "field.safetensors", tmp_path, "red") == 2
    assert "JSECON_MEMORY: 'much', expected GiB" in capsys.readouterr().err
