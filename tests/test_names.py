"""Names from texts and files: every question has files of its own, and no name is ever a path."""

import dataclasses
import json
import shutil

import cv2
import numpy as np
import pytest
from small_field import colour_field

from experiments.rooms.writers import write_colmap
from jsecon import (
    Answer,
    At,
    InputError,
    Query,
    Region,
    Scene,
    load_capture,
    load_field,
    load_gaussians,
    query_region,
    save_field,
)
from jsecon.app.cli import main
from jsecon.app.querying import file_stem, write_answer
from jsecon.files import path_within
from jsecon.query.expressions import parse_query
from jsecon.vision.colours import ColourEmbedder

HOSTILE = ("/../../evil", "..", "C:\\evil", "a/b", "a\0b", "x" * 4000, "nul", "frame 1", "Frame_1", "frame_1")


@pytest.fixture(scope="module")
def field(scene, cameras):
    return colour_field(scene, cameras)


@pytest.fixture(scope="module")
def word(field):
    """A colour that selects a part of the scene."""
    embedder = ColourEmbedder()
    return next(w for w in ("red", "green", "blue", "orange", "pink") if Scene(field, embedder).ask(w).mask.any())


def run(*arguments) -> int:
    return main([str(argument) for argument in arguments])


def answer(field, question):
    selection = query_region(field, 1)
    return Answer(Query(question), "votes", np.asarray(selection.mask), selection, field)


TEXTS = [
    *("red mug", "red mug!", "Red mug", "red-mug", "red/mug", "red  mug", " red mug", "red mug ", "red_mug"),
    *("C++", "c", "C", "c#", "c  ", "🍎", "🍏", "", "query", "?", "con", "CON", "nul", "com1"),
    *("café", "cafe\u0301", "straße", "strasse", "STRASSE", "ﬁre", "fire", "red mug--1", "..", "/etc/passwd", "a\0b"),
    *("x" * 80 + "a", "x" * 80 + "b", "x" * 300, "漢" * 80, "漢" * 81, "𐌰" * 90, "red mug " * 40, "\udce9"),
]


def test_texts_have_names_of_their_own_also_without_case(field):
    names = {text: file_stem(answer(field, text)) for text in TEXTS}
    assert (names["red mug"], names["c"], names["café"]) == ("red-mug", "c", "café")
    assert len({name.casefold() for name in names.values()}) == len(TEXTS)
    for name in names.values():
        assert len(f".{name}-{'x' * 92}.12345678.partial.png".encode()) <= 255
        assert not set('/\\:*?"<>| .\0') & set(name)
        assert name not in ("con", "nul", "com1")
    assert names == {text: file_stem(answer(field, text)) for text in TEXTS}


def test_a_text_and_a_pixel_of_one_name_do_not_share_files(field):
    at = "at frame_1 24 20"
    scene = Scene(field)
    pixel, region = scene.ask(At(1, 24, 20)), scene.ask(Region(1))
    assert str(pixel.query) == at
    assert file_stem(pixel) != file_stem(answer(field, at))
    assert file_stem(region) != file_stem(answer(field, "region 1"))
    assert file_stem(pixel) == file_stem(scene.ask(At("frame_1", 24, 20))) != file_stem(scene.ask(At(1, 24, 21)))


def test_frames_of_hostile_names_are_written_beneath_the_folder(field, tmp_path):
    for names in (HOSTILE[:4], HOSTILE[4:8], HOSTILE[6:]):
        own = dataclasses.replace(field, names=names)
        masks = {t: np.ones((4, 4), bool) for t in range(4)}
        out = tmp_path / "deep" / "out"
        told = write_answer(answer(own, "red"), Scene(own), out, masks)
        assert set(told["masks"]) == set(names)
        files = {file.name.casefold() for file in out.iterdir()}
        assert {file.casefold() for file in told["masks"].values()} < files
        assert len({file.casefold() for file in told["masks"].values()}) == 4
        assert list(tmp_path.rglob("*.png")) == list(out.glob("*.png"))
        for file in out.iterdir():
            file.unlink()
    own = dataclasses.replace(field, names=("a", "b-1", "c", "d"))
    told = write_answer(answer(own, "red"), Scene(own), tmp_path, masks)
    assert told["masks"]["a"] == "red-a.png"


def test_a_field_file_with_hostile_frames_writes_nothing_elsewhere(field, word, tmp_path):
    save_field(tmp_path / "field.safetensors", dataclasses.replace(field, names=HOSTILE[:4]))
    out = tmp_path / "a" / "b" / "out"
    cv2.imwrite(str(tmp_path / "mug.png"), np.full((40, 48), 255, np.uint8))
    (tmp_path / "other").mkdir()
    cv2.imwrite(str(tmp_path / "other" / "mug.png"), np.full((40, 48), 255, np.uint8))
    masks = [o for folder in (tmp_path, tmp_path / "other") for o in ("--mask", "#1", folder / "mug.png")]
    texts = word, f"{word}!", word.upper()
    assert run("query", tmp_path / "field.safetensors", *texts, *masks, "--out", out, "--views", 4) == 0
    answers = [json.loads(file.read_text()) for file in out.glob("*.json")]
    assert sorted(told["query"] for told in answers) == sorted((*texts, "mug", "mug"))
    for told in answers:
        assert load_gaussians(out / told["ply"]).count == told["count"] > 0
    outside = [file for file in tmp_path.rglob("*.*") if out not in file.parents]
    assert sorted(file.name for file in outside) == ["field.safetensors", "mug.png", "mug.png"]


def test_names_lead_out_of_no_folder(tmp_path, room):
    for name in ("../x.png", "a/../../x.png", "/etc/x.png", "a\0.png", ".."):
        with pytest.raises(InputError, match="leads out"):
            path_within(tmp_path, name)
    for name in ("a.png", "a/b.png", "..a.png", "a/../b.png", "C.png"):
        assert path_within(tmp_path, name) == tmp_path / name
    capture = load_capture(room)
    with pytest.raises(InputError, match="leads out"):
        write_colmap(dataclasses.replace(capture, names=("../../evil", *capture.names[1:])), tmp_path / "a" / "b")
    assert not list(tmp_path.rglob("evil*"))


def test_a_capture_that_names_images_outside_its_folder_is_refused(tmp_path, room):
    shutil.copytree(room, tmp_path / "capture")
    model = next((tmp_path / "capture").rglob("images.bin"))
    name = sorted(file.name for file in (room / "images").iterdir())[0]
    evil = "../" + name[3:]
    shutil.copy(room / "images" / name, tmp_path / "capture" / evil[3:])  # it is there, and an image
    model.write_bytes(model.read_bytes().replace(name.encode() + b"\0", evil.encode() + b"\0"))
    with pytest.raises(InputError, match="leads out"):
        load_capture(tmp_path / "capture")


@pytest.mark.parametrize(("question", "wanted", "unwanted"), [
    ('"tea or coffee"', ["tea or coffee"], []), ('"red mug"', ["red mug"], []),
    ("'tea or coffee' or mug", ["tea or coffee", "mug"], []),
    ("“tea or coffee” but not “a cup but not full”", ["tea or coffee"], ["a cup but not full"]),
    ('"mug" or "bowl" but not "handle" or lid', ["mug", "bowl"], ["handle", "lid"]),
    ("kid's toy or dog's bone", ["kid's toy", "dog's bone"], []),
    ("kids' toys or dogs' bones", ["kids' toys", "dogs' bones"], []),
    ("'kid's cup or mug'", ["kid's cup or mug"], []), ('the "tea or coffee" pot', ['the "tea or coffee" pot'], []),
    ('"red', ["red"], []),
])  # fmt: skip
def test_quotes_protect_and_are_removed(question, wanted, unwanted):
    assert parse_query(question) == (wanted, unwanted)


def test_a_lone_quoted_text_is_embedded_without_its_quotes(field, word):
    class Heard(ColourEmbedder):
        def embed_text(self, texts):
            heard.extend(texts)
            return super().embed_text(texts)

    for by in ("votes", "code"):
        heard: list[str] = []
        embedder = Heard()
        heard.clear()
        plain, quoted = (Scene(field, embedder).ask(text, by=by) for text in (word, f'"{word}"'))
        np.testing.assert_array_equal(plain.mask, quoted.mask)
        assert set(heard) == {word}


def test_one_centroid_in_the_world_of_a_map_projection(field, tmp_path):
    """Of the .json, of `locate` and of the server: the mean of the centres, to less than a millimetre at 5e6 m."""
    moved = np.eye(4)
    moved[:3, 3] = [500_000.125, 5_400_000.25, 120.5]
    own = dataclasses.replace(field, source_from_scene=moved)
    found = answer(own, "red")
    means = np.asarray(field.gaussians.means, np.float64)[found.mask] + moved[:3, 3]
    told = write_answer(found, Scene(own), tmp_path, {})
    np.testing.assert_allclose(told["place"]["centroid"], means.mean(0), atol=1e-5)
    np.testing.assert_allclose(told["place"]["bounding_box"]["max"], means.max(0), atol=1e-5)
    np.testing.assert_allclose(found.place.center, means.mean(0), atol=3)
    small = np.diag([1e-6, 1e-6, 1e-6, 1.0])
    own = dataclasses.replace(field, source_from_scene=small)
    told = write_answer(answer(own, "red"), Scene(own), tmp_path, {})
    np.testing.assert_allclose(told["place"]["centroid"], 1e-6 * (means - moved[:3, 3]).mean(0), rtol=1e-4, atol=1e-11)


@pytest.mark.parametrize(("scale", "shift"), [(1.0, 5_400_000.25), (1e-3, 0.0), (1000.0, 0.0)])
def test_the_centroid_is_printed_with_the_digits_that_it_needs(field, word, tmp_path, capsys, scale, shift):
    moved = np.diag([scale, scale, scale, 1.0])
    moved[:3, 3] = shift
    save_field(tmp_path / "field.safetensors", dataclasses.replace(field, source_from_scene=moved))
    assert run("query", tmp_path / "field.safetensors", word, "--out", tmp_path / "out", "--views", 0) == 0
    line = next(line for line in capsys.readouterr().out.splitlines() if line.startswith(repr(word)))
    printed = np.array(line.rpartition("(")[2].rstrip(").").split(","), float)
    told = json.loads(next((tmp_path / "out").glob("*.json")).read_text())["place"]
    size = np.linalg.norm(np.subtract(told["bounding_box"]["max"], told["bounding_box"]["min"]))
    assert np.abs(printed - told["centroid"]).max() <= 0.01 * size
    assert load_field(tmp_path / "field.safetensors").source_from_scene[0, 3] == shift
