"""SigLIP: both layouts give the same space, the padding included; what a folder leaves open is named."""

import json

import numpy as np
import pytest
from clip_files import COLOURS, write_clip
from siglip_files import LENGTH, embedded, write_json, write_siglip

from experiments.export.vocabulary import write_vocabulary
from jsecon.networks.clip import ClipEmbedder
from jsecon.networks.tokenizer import TextTokenizer, _TextRules, read_text_rules
from jsecon.vision.protocols import Embedder

LAYOUTS = ("immich", "transformers.js")
TEXTS = ["a red thing", "blue", "a a a a a a a a a a a green a a a", "yellow red blue"]


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    return {layout: write_siglip(tmp_path_factory.mktemp("siglip") / layout, layout) for layout in LAYOUTS}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_images_and_texts_meet_and_the_padding_is_read(folders, layout):
    embedder = ClipEmbedder(folders[layout])
    assert isinstance(embedder, Embedder)
    np.testing.assert_allclose(embedder.embed_text(TEXTS), embedded(TEXTS), atol=1e-6)
    assert np.abs(embedded(["blue"]) - embedded(["blue"], LENGTH - 3)).max() > 0.01  # so another padding shows
    frame = np.zeros((8, 8, 3), np.uint8)
    frame[:] = np.round(255 * np.asarray(COLOURS["red"]))
    found = embedder.embed_regions(frame, np.ones((1, 8, 8), bool))[0]
    np.testing.assert_allclose(found, np.divide(COLOURS["red"], np.linalg.norm(COLOURS["red"])), atol=0.01)


def test_texts_are_cleaned_as_the_configurations_say(folders):
    canonical = ClipEmbedder(folders["immich"])
    np.testing.assert_allclose(canonical.embed_text(["A_red, THING!"]), embedded(["a red thing"]), atol=1e-6)
    path = folders["immich"] / "textual" / "tokenizer.json"
    said = "Tea &amp; MILK,  d\u00e9j\u00e0_vu!"
    expected = {
        "canonicalize": "tea milk d\u00e9j\u00e0 vu",
        "lower": "tea & milk, d\u00e9j\u00e0_vu!",
        "whitespace": "Tea & MILK, d\u00e9j\u00e0_vu!",
    }
    for clean, text in expected.items():
        assert TextTokenizer(path, _TextRules(LENGTH, "</s>", clean))._clean(said) == text


def test_siglip_2_has_another_vocabulary_padding_and_case(tmp_path):
    path = write_vocabulary(tmp_path, "gemma", ["red mug, blue box"] * 9, tokenizer_class="GemmaTokenizerFast")
    write_siglip(tmp_path / "model", "transformers.js")
    for name in ("tokenizer.json", "tokenizer_config.json"):
        (tmp_path / "model" / name).write_bytes((tmp_path / name).read_bytes())
    rules = read_text_rules(tmp_path / "model", tmp_path / "model" / "tokenizer.json")
    assert rules == _TextRules(LENGTH, "<pad>", "lower")
    tokenizer = TextTokenizer(path, rules)
    (short, long, foreign), mask = tokenizer(["Red Mug,", "mug " * 40, "\u8336"], 8)
    numbers = json.loads(path.read_text())["model"]["vocab"]
    assert short[-1] == numbers["<pad>"] == 0
    assert 1 in short  # its end
    assert long[-1] == numbers["<eos>"] == 1  # a text that is cut keeps its end
    bytes_of_tea = [numbers[f"<0x{byte:02X}>"] for byte in "\u8336".encode()]
    np.testing.assert_array_equal(foreign[: len(bytes_of_tea) + 1], [*bytes_of_tea, 1])
    np.testing.assert_array_equal(tokenizer(["RED MUG,"], 8)[0][0], short)
    np.testing.assert_array_equal(mask, np.ones((3, 8)))


def test_the_name_follows_the_rules(folders, tmp_path):
    folder = write_siglip(tmp_path / "model", "immich")
    name = ClipEmbedder(folder).name
    assert name == ClipEmbedder(folders["immich"]).name
    config = json.loads((folder / "config.json").read_text())
    config["text_cfg"]["tokenizer_kwargs"] = {"clean": "lower"}
    write_json(folder / "config.json", config)
    assert ClipEmbedder(folder).name != name
    clip = write_clip(tmp_path / "clip", "immich")  # open_clip's configuration beside it changes nothing of it
    name = ClipEmbedder(clip).name
    write_json(clip / "config.json", {"embed_dim": 3, "text_cfg": {"context_length": 77, "vocab_size": 49408}})
    assert ClipEmbedder(clip).name == name


def test_a_length_that_is_left_out_is_transformers_own(tmp_path):
    folder = write_siglip(tmp_path / "model", "transformers.js")
    write_json(folder / "config.json", {"model_type": "siglip"})
    assert read_text_rules(folder, folder / "tokenizer.json") == _TextRules(64, "</s>", "canonicalize")
