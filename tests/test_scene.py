"""A scene that is asked: what it refuses, what it keeps, threads, and the field of a splat without photographs."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from balls import sphere
from capture_files import run_cli
from clip_files import write_clip
from conftest import gaussians_at
from small_field import field_of, lone_votes, unit_rows
from table_field import UP, table_field

import jsecon
from jsecon import At, Box, InputError, Mask, Query, Region, Scene
from jsecon.app import scene as scenes
from jsecon.pipeline import run as pipeline
from jsecon.pipeline.options import Options
from jsecon.pipeline.progress import Console
from jsecon.types import Regions
from jsecon.vision.unrelated_words import UNRELATED_WORDS


@pytest.fixture(scope="module")
def table():
    return Scene(*table_field(up=UP))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 5, -3])
@pytest.mark.parametrize("option", ["threshold", "min_rank"])
def test_a_number_out_of_its_range_is_refused_at_once(table, option, value):
    with pytest.raises(InputError, match=f"{option}: .*expected a number from 0 to 1"):
        table.ask("red mug", **{option: value})


def test_the_region_of_another_field_selects_nothing_with_a_word(table):
    for region in (999, -1, 6):
        answer = table.ask(Region(region))
        assert (answer.count, len(answer.rows)) == (0, 0)
        assert f"there is no region {region}: the regions are 0 to 5" in str(answer)
    assert table.ask(Region(5)).reason == ""


def test_a_field_without_harmonics_is_asked_and_measured_and_has_no_colours_to_export(tmp_path):
    turn = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 5], [0, 0, 0, 1]])  # of its world, which turns harmonics
    field, embedder = table_field(up=UP, source_from_scene=turn)
    assert field.gaussians.sh is not None
    scene, bare = (
        Scene(dataclasses.replace(field, gaussians=dataclasses.replace(field.gaussians, sh=sh)), embedder)
        for sh in (field.gaussians.sh, None)
    )
    for text in ("red mug", "the leftmost red mug"):
        np.testing.assert_array_equal(bare.ask(text).rows, scene.ask(text).rows)
    assert bare.measure("white plate", "orange ball") == scene.measure("white plate", "orange ball")
    with pytest.raises(ValueError, match="Pass spherical harmonics"):
        bare.export(tmp_path / "scene.ply")


@pytest.mark.parametrize(("question", "options", "problem"), [
    (At("nowhere", 1, 1), {}, "no such frame"), (At(0, 99, 200), {}, "outside the frame"),
    (At(0, 0, 0), {}, "no region lies under"), (Box(0, 500, 3, 600, 9), {}, "pixels of a frame of 100x80"),
    (Mask({0: np.zeros((80, 100), bool)}), {}, "no pixel inside"),
    (Mask({0: np.ones((80, 100), bool), "frame_0": np.ones((80, 100), bool)}), {}, "two masks"),
    (Box(0, 1, 1, 5, 5), {"by": "code"}, "by the outline alone"),
    ("red mug", {"by": "code"}, "has no codes"), (" ", {}, "without words"), ("a text of nothing", {}, "colour"),
])  # fmt: skip
def test_what_cannot_be_answered_ends_in_a_sentence(table, question, options, problem):
    with pytest.raises(InputError, match=problem):
        table.ask(question, **options)
    with pytest.raises(ValueError, match="'votes' or 'code'"):
        Query("red mug", by="magic")


def test_many_texts_in_many_threads_are_answered_alike_within_bounds(monkeypatch):
    """Each text is computed once, however many threads ask it, and the oldest answers are dropped."""
    field, embedder = table_field()
    embedded = []

    class Counting(type(embedder)):
        def embed_text(self, texts):
            embedded.extend(texts)
            return super().embed_text(texts)

    scene = Scene(field, Counting())
    texts = ["red mug", "dark blue box", "white plate", "the leftmost red mug"]
    expected = {text: Scene(field, embedder).ask(text).rows for text in texts}
    embedded.clear()
    with ThreadPoolExecutor(24) as pool:
        found = list(pool.map(scene.ask, texts * 6))
    for answer in found:
        np.testing.assert_array_equal(answer.rows, expected[str(answer.query)])
    assert len({id(answer) for answer in found}) == 4
    assert embedded.count("white plate") == 1
    monkeypatch.setattr(scenes, "CACHED_BYTES", 3 * 5 * field.gaussians.count)
    small = Scene(field, Counting())
    for text in texts:
        small.ask(text)
    embedded.clear()
    small.ask(texts[-1])
    assert not embedded
    small.ask(texts[0])
    assert texts[0] in embedded


def test_regions_of_few_gaussians_are_called_too_small(tmp_path, capsys):
    regions = Regions(np.eye(2, 8, dtype=np.float32), np.full((2, 1), 50, np.int32))
    words = unit_rows(np.random.default_rng(0), len(UNRELATED_WORDS), 8)  # so no model is needed
    field = field_of(lone_votes([0] * 9 + [1] * 4, 2), regions, embedder="clip-0", unrelated_words=words)
    jsecon.save_field(tmp_path / "field.safetensors", field)
    assert run_cli("objects", tmp_path / "field.safetensors") == 0
    assert "too small to be listed, with fewer than 10 Gaussians: 2 regions" in capsys.readouterr().out


@pytest.mark.long  # a whole run
def test_the_field_of_a_splat_is_kept_with_its_model(tmp_path):
    """Asked with a model first and then without, it is the field that is there; another model makes it anew."""
    draw = np.random.default_rng(0)
    means = np.concatenate([sphere(draw, centre, 0.3, 300) for centre in ((0, 0, 0), (1, 0, 0), (0, 1, 0))])
    colours = np.repeat(np.float32([[1, -1, -1], [-1, 1, -1], [-1, -1, 1]]), 300, axis=0)[:, None]
    splat = gaussians_at(means, 0.03, logit=4, sh=colours)
    jsecon.save_gaussians(tmp_path / "scene.ply", splat)
    options = Options(tmp_path / "scene.ply", views=4, long_side=64, up=(0.0, 0.0, 1.0))
    model, folder = write_clip(tmp_path / "clip", "transformers.js"), tmp_path / "scene_field"
    made = pipeline.run(dataclasses.replace(options, embedder=model), folder)
    before = (folder / "field.safetensors").read_bytes()
    path = scenes._field_of_gaussians(options, folder, Console())
    assert path.read_bytes() == before
    assert jsecon.load_field(path).embedder == made.field.embedder
    assert jsecon.open_scene(folder).name == "scene_field"
