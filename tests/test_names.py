"""Names from texts and files: every question has files of its own, and no name is ever a path."""

import dataclasses
import json

import numpy as np
import pytest
from capture_files import run_cli
from small_field import answer_of, colour_field

from jsecon import At, InputError, Region, Scene, load_gaussians, save_field
from jsecon.app.querying import write_answer
from jsecon.files import path_within
from jsecon.vision.colours import ColourEmbedder

HOSTILE = ("/../../evil", "..", "C:\\evil", "a/b", "a\0b", "x" * 4000, "nul", "Bild ä 図", "Frame_1", "frame_1")


@pytest.fixture(scope="module")
def field(scene, cameras):
    return colour_field(scene, cameras)


@pytest.fixture(scope="module")
def word(field):
    """A colour that selects a part of the scene."""
    scene = Scene(field, ColourEmbedder())
    return next(word for word in ("red", "green", "blue", "orange", "pink") if scene.ask(word).mask.any())


TEXTS = [
    *("red mug", "red mug!", "Red mug", "red-mug", "red/mug", "red  mug", " red mug", "red mug ", "red_mug"),
    *("C++", "c", "C", "c#", "c  ", "🍎", "🍏", "", "query", "?", "con", "CON", "nul", "com1"),
    *("café", "cafe\u0301", "straße", "strasse", "STRASSE", "ﬁre", "fire", "red mug--1", "..", "/etc/passwd", "a\0b"),
    *("x" * 80 + "a", "x" * 80 + "b", "x" * 300, "漢" * 80, "漢" * 81, "𐌰" * 90, "red mug " * 40, "\udce9"),
]


def stem_of(answer, out) -> str:
    """What the files of an answer are called."""
    return write_answer(answer, Scene(answer.field), out, {})["ply"].removesuffix(".ply")


def test_texts_have_names_of_their_own_also_without_case(field, tmp_path):
    names = {text: stem_of(answer_of(field, text, np.arange(64) < 2), tmp_path) for text in TEXTS}
    assert (names["red mug"], names["c"], names["café"]) == ("red-mug", "c", "café")
    assert len({name.casefold() for name in names.values()}) == len(TEXTS)
    for name in names.values():
        assert len(f".{name}-{'x' * 92}.12345678.partial.png".encode()) <= 255
        assert not set('/\\:*?"<>| .\0') & set(name)
        assert name not in ("con", "nul", "com1")


def test_a_text_and_a_pixel_of_one_name_do_not_share_files(field, tmp_path):
    asked = At(1, 24, 20), At("frame_1", 24, 20), At(1, 24, 21), Region(1)
    answers = [Scene(field).ask(question) for question in asked]
    answers += [answer_of(field, text, np.arange(64) < 2) for text in ("at frame_1 24 20", "region 1")]
    pixel, same, *others = (stem_of(answer, tmp_path) for answer in answers)
    assert pixel == same
    assert len({pixel, *others}) == 5


@pytest.mark.parametrize("names", [HOSTILE[:4], HOSTILE[4:8], HOSTILE[6:]], ids=["paths", "long", "alike"])
def test_a_field_file_with_hostile_frames_writes_nothing_elsewhere(field, word, tmp_path, names):
    save_field(tmp_path / "field.safetensors", dataclasses.replace(field, names=names))
    out = tmp_path / "a" / "b" / "out"
    texts = word, f"{word}!", word.upper()
    assert run_cli("query", tmp_path / "field.safetensors", *texts, "--out", out, "--views", 4) == 0
    answers = [json.loads(file.read_text()) for file in out.glob("*.json")]
    assert sorted(told["query"] for told in answers) == sorted(texts)
    for told in answers:
        assert load_gaussians(out / told["ply"]).count == told["count"] > 0
        assert set(told["masks"]) == set(names)
        written = {file.casefold() for file in told["masks"].values()}
        assert len(written) == 4
        assert written < {file.name.casefold() for file in out.iterdir()}
    outside = [file for file in tmp_path.rglob("*.*") if out not in file.parents]
    assert [file.name for file in outside] == ["field.safetensors"]


def test_names_lead_out_of_no_folder(tmp_path):
    for name in ("../x.png", "a/../../x.png", "/etc/x.png", "a\0.png", ".."):
        with pytest.raises(InputError, match="leads out"):
            path_within(tmp_path, name)
    for name in ("a.png", "a/b.png", "..a.png", "a/../b.png", "C.png"):
        assert path_within(tmp_path, name) == tmp_path / name


@pytest.mark.parametrize(("scale", "shift"), [(1.0, 5_400_000.25), (1e-3, 0.0), (1000.0, 0.0), (1e-6, 0.0)])
def test_the_centroid_in_the_world_of_a_map_projection(field, word, tmp_path, capsys, scale, shift):
    """Of the .json to less than a millimetre at 5e6 m, and printed with the digits that it needs."""
    moved = np.diag([scale, scale, scale, 1.0])
    moved[:3, 3] = shift
    save_field(tmp_path / "field.safetensors", dataclasses.replace(field, source_from_scene=moved))
    assert run_cli("query", tmp_path / "field.safetensors", word, "--out", tmp_path / "out", "--views", 0) == 0
    line = next(line for line in capsys.readouterr().out.splitlines() if line.startswith(repr(word)))
    printed = np.array(line.rpartition("(")[2].rstrip(").").split(","), float)
    told = json.loads(next((tmp_path / "out").glob("*.json")).read_text())["place"]
    size = np.linalg.norm(np.subtract(told["bounding_box"]["max"], told["bounding_box"]["min"]))
    assert np.abs(printed - told["centroid"]).max() <= 0.01 * size
    chosen = Scene(field, ColourEmbedder()).ask(word).mask
    means = scale * np.asarray(field.gaussians.means, np.float64)[chosen] + shift
    np.testing.assert_allclose(told["centroid"], means.mean(0), rtol=1e-12, atol=1e-5 * scale)
    np.testing.assert_allclose(told["bounding_box"]["max"], means.max(0), rtol=1e-12, atol=1e-5 * scale)
