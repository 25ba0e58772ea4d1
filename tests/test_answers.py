"""Answers and whole fields as files of every format, from the command line, against the field that they come from."""

import dataclasses
import json
import os

import cv2
import numpy as np
import pytest
from capture_files import refused, run_cli
from small_field import answer_of, colour_field

from jsecon import Scene, load_gaussians, save_field
from jsecon.app.querying import _write_answers
from jsecon.pipeline.options import Options
from jsecon.pipeline.progress import Console
from jsecon.pipeline.sources import provenance
from jsecon.vision.colours import ColourEmbedder


@pytest.fixture(scope="module")
def saved(scene, cameras, tmp_path_factory):
    """A small field whose source lies 2 units to the side of its world, and its file."""
    moved = np.eye(4)
    moved[0, 3] = 2
    field = dataclasses.replace(colour_field(scene, cameras), source_from_scene=moved)
    file = tmp_path_factory.mktemp("field") / "field.safetensors"
    save_field(file, field)
    return field, file


def test_a_field_is_exported_in_the_world_of_its_source(saved, tmp_path):
    field, file = saved
    assert run_cli("export", file, "--out", tmp_path / "scene.ply") == 0
    found, means = load_gaussians(tmp_path / "scene.ply").means, np.add(field.gaussians.means, [2, 0, 0])
    np.testing.assert_allclose(found, means, atol=2**-16)


@pytest.mark.parametrize("embedder", ["colours-1", "clip-of-nowhere"])
def test_a_scene_is_exported_without_names_where_they_cannot_be_had(saved, tmp_path, monkeypatch, capsys, embedder):
    """The model of the names is not on this machine, or the field is larger than memory."""
    field, _ = saved
    save_field(tmp_path / "field.safetensors", dataclasses.replace(field, embedder=embedder))
    if embedder == "colours-1":
        monkeypatch.setenv("JSECON_MEMORY", "1e-9")
        monkeypatch.setattr("jsecon.field.field.MAPPED", 1)
    assert run_cli("export", tmp_path / "field.safetensors", "--out", tmp_path / "scene.ply") == 0
    assert "no labels.json is written: " in capsys.readouterr().out
    assert load_gaussians(tmp_path / "scene.ply").count == field.gaussians.count
    assert not (tmp_path / "labels.json").exists()
    if embedder != "colours-1":
        assert run_cli("export", tmp_path / "field.safetensors", "--objects", tmp_path / "objects") == 2


def test_a_selection_is_written_with_its_masks(saved, tmp_path):
    field, file = saved
    word = next(word for word in ("red", "green", "blue", "orange", "pink") if Scene(field).ask(word).mask.any())
    assert run_cli("query", file, word, "--out", tmp_path, "--views", 1) == 0
    told = json.loads(next(tmp_path.glob("*.json")).read_text())
    means = np.asarray(load_gaussians(tmp_path / told["ply"]).means, np.float64)
    assert len(means) == told["count"] > 0
    np.testing.assert_allclose(means.mean(0), told["place"]["centroid"], atol=1e-4)
    (mask,) = (cv2.imread(str(tmp_path / name), cv2.IMREAD_UNCHANGED) for name in told["masks"].values())
    assert mask.shape == (field.cameras.height, field.cameras.width)
    assert set(np.unique(mask)) == {0, 255}
    assert {path.suffix for path in tmp_path.iterdir()} == {".ply", ".json", ".png", ".html"}


@pytest.mark.parametrize("verb", ["export", "fit"])
def test_an_ending_that_cannot_be_written_is_refused_before_anything_is_read(tmp_path, capsys, verb):
    assert run_cli(verb, tmp_path / "nowhere", "--out", tmp_path / "scene.sog") == 2
    told = capsys.readouterr().err
    assert "scene.sog" in told
    assert "npx @playcanvas/splat-transform" in told


def test_answers_without_a_region_or_gaussians_and_a_text_that_is_not_utf8(saved, tmp_path, capsys):
    field, file = saved
    odd = os.fsdecode(b"caf\xe9 red")
    asked = "query", file, "red but not red", odd, "red", "--out", tmp_path, "--views", 1
    assert run_cli(*asked, "--json") == 2
    told = json.loads(capsys.readouterr().out)
    assert "is not UTF-8" in told["error"]["message"]
    assert [answer["region"] is None for answer in told["answers"]] == [True, False]
    assert run_cli(*asked) == 2
    out, err = capsys.readouterr()
    assert next(line for line in err.splitlines() if line.startswith("jsecon: ")).isascii()
    assert "0 of 64 Gaussians" in out
    assert "no region matches it" in (tmp_path / "answers.html").read_text()
    for by in ("votes", "code"):
        with refused("not UTF-8"):
            Scene(field, ColourEmbedder()).ask(odd, by=by)


def test_an_answer_of_nothing_repeats_what_the_run_warned_of(saved, tmp_path):
    warning = "9 of 12 views show hardly any detail."
    told = provenance(Options(tmp_path), {}, tmp_path, [f"{warning} Give others."])
    scene = Scene(dataclasses.replace(saved[0], provenance=told), ColourEmbedder())
    absent, present = scene.ask("red but not red"), scene.ask("red", min_rank=0)
    assert f"no region matches it; the run warned: {warning[:-1]}, no Gaussian is selected" in str(absent)
    assert absent.as_dict()["reason"].endswith(warning[:-1])
    assert "warned" not in str(present)
    assert present.as_dict()["reason"] == ""


@pytest.mark.parametrize(("first", "second"), [(["--views", 4], ["--views", 1]), (["--views", 2], ["--views", 0])])
def test_an_answer_replaces_the_files_of_the_last_one_to_the_same_text(saved, tmp_path, first, second):
    """Fewer masks, and no match: what stays is what the record lists, and what others wrote."""
    field, file = saved
    others = ["pink-frame_0-notes.png", "pink.txt", "blue.ply"]
    for name in others:
        (tmp_path / name).write_text("mine")
    assert run_cli("query", file, "pink", "pink or red", "--out", tmp_path, *first) == 0
    beside = {path.name for path in tmp_path.glob("pink-or-red*")}
    assert run_cli("query", file, "pink", "--out", tmp_path, *second) == 0
    told = json.loads((tmp_path / "pink.json").read_text())
    own = {"pink.json", "pink.ply", *told["masks"].values()}
    page = {"answers.html"} if second[-1] else set()  # without views nothing is rendered
    assert {path.name for path in tmp_path.iterdir()} == {*page, *others, *beside, *own}
    found = Scene(field).ask("pink")
    _write_answers(Scene(field), [answer_of(field, "pink", 0 * found.mask)], tmp_path, Console(), 3)
    assert {path.name for path in tmp_path.iterdir()} == {"answers.html", *others, *beside, "pink.json"}


def test_a_text_that_fails_leaves_no_answer_of_an_earlier_field(saved, tmp_path):
    _, file = saved
    assert run_cli("query", file, "pink", "--out", tmp_path) == 0
    words = {"query": "mug", "ply": "mug.ply", "masks": {"a": "mug-a.png", "b": "../mug-b.png", "c": "pink.json"}}
    (tmp_path / "mug.json").write_text(json.dumps(words))
    for name in ("mug.ply", "mug-a.png", "../mug-b.png"):
        (tmp_path / "x" / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("of a field with a model")
    assert run_cli("query", file, "mug", "--out", tmp_path) == 2
    assert not list(tmp_path.glob("mug*"))
    assert not (tmp_path / "answers.html").exists()
    assert (tmp_path / "pink.json").exists()
    assert (tmp_path.parent / "mug-b.png").exists()
