"""Answers and whole fields as files of every format, from the command line, against the field that they come from."""

import dataclasses
import json

import numpy as np
import pytest
from capture_files import run_cli
from small_field import colour_field, make_field
from test_gltf import read_glb

from jsecon import Answer, Query, QueryRules, Scene, load_gaussians, objects, query_region, save_field
from jsecon.app.querying import write_answers
from jsecon.pipeline.progress import Console


@pytest.fixture(scope="module")
def saved(scene, cameras, tmp_path_factory):
    """A small field whose source lies 2 units to the side of its world, and its file."""
    moved = np.eye(4)
    moved[0, 3] = 2
    field = dataclasses.replace(colour_field(scene, cameras), source_from_scene=moved)
    file = tmp_path_factory.mktemp("field") / "field.safetensors"
    save_field(file, field)
    return field, file


def test_a_field_is_exported_in_every_format(saved, tmp_path, capsys):
    field, file = saved
    means = np.add(field.gaussians.means, [2, 0, 0])
    for ending in ("ply", "spz"):
        assert run_cli("export", file, "--out", tmp_path / f"scene.{ending}") == 0
        np.testing.assert_allclose(load_gaussians(tmp_path / f"scene.{ending}").means, means, atol=2**-16)
    assert run_cli("export", file, "--out", tmp_path / "scene.glb", "--with-labels") == 0
    assert f"{len(means)} Gaussians" in capsys.readouterr().out
    _, found = read_glb(tmp_path / "scene.glb")
    np.testing.assert_allclose(found["POSITION"], means * [-1, -1, 1], atol=1e-6)
    np.testing.assert_array_equal(found["_OBJECT_ID"][:, 0], objects(field).labels)


@pytest.mark.parametrize("ending", ["ply", "spz", "glb"])
def test_a_selection_is_written_in_every_format(saved, tmp_path, ending):
    field, file = saved
    size = field.cameras.width, field.cameras.height
    asked = "query", file, "--box", "#0", 0, 0, *size, "--out", tmp_path, "--format", ending, "--views", 1
    assert run_cli(*asked) == 0
    told = json.loads(next(tmp_path.glob("*.json")).read_text())
    assert told["count"] > 0
    chosen = tmp_path / told[ending]
    if ending == "glb":
        assert len(read_glb(chosen)[1]["POSITION"]) == told["count"]
    else:
        means = np.asarray(load_gaussians(chosen).means, np.float64)
        np.testing.assert_allclose(means.mean(0), told["place"]["centroid"], atol=1e-4)
    assert {path.suffix for path in tmp_path.iterdir()} == {f".{ending}", ".json", ".png", ".html"}


@pytest.mark.parametrize("verb", ["export", "fit"])
def test_an_ending_that_cannot_be_written_is_refused_before_anything_is_read(tmp_path, capsys, verb):
    assert run_cli(verb, tmp_path / "nowhere", "--out", tmp_path / "scene.sog") == 2
    told = capsys.readouterr().err
    assert "scene.sog" in told
    assert "npx @playcanvas/splat-transform" in told


class Told(Console):
    def __init__(self):
        super().__init__()
        self.lines = []

    def print_line(self, text):
        self.lines.append(text)


def test_an_answer_without_a_region_says_so_and_one_without_gaussians_differs(scene, cameras, tmp_path):
    field, _ = make_field(scene, cameras)
    nothing = np.zeros(field.gaussians.count, bool)
    none = Answer(Query("unicorn"), "votes", nothing, query_region(field, -1), field, count=0)
    faint = query_region(field, 1, rules=QueryRules(min_share=2.0))
    empty = Answer(Query("faint"), "votes", nothing, faint, field, count=0)
    told = Told()
    write_answers(Scene(field), [none, empty], tmp_path, told, views=1)
    first, second, pictures = told.lines
    assert first.startswith("'unicorn': 0 of 64 Gaussians")
    assert first.endswith("no region matches it, no Gaussian is selected")
    assert second.endswith("region 1, no Gaussian is selected")
    assert pictures.endswith("answers.html")
    assert "no region matches it" in (tmp_path / "answers.html").read_text()
    written = [json.loads(file.read_text()) for file in sorted(tmp_path.rglob("*.json"))]
    assert sorted((w["query"], w["region"]) for w in written) == [("faint", 1), ("unicorn", None)]
