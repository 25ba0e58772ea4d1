"""CLIP: every layout and signature gives the same space, crops are LangSplat's, and tokens are open_clip's."""

import json

import cv2
import numpy as np
import pytest
from capture_files import refused
from clip_files import COLOURS, END, START, fixture, vocabulary, write_clip, write_tokenizer
from hypothesis import given, settings, strategies as st
from tokenizers import decoders

from jsecon.networks.clip import ClipEmbedder, _masked_crop, read_preprocessing
from jsecon.networks.tokenizer import CLIP_LENGTH, TextTokenizer
from jsecon.vision.protocols import CANONICAL, Embedder
from jsecon.vision.unrelated_words import UNRELATED_WORDS

LAYOUTS = ("immich", "transformers.js")


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    return {layout: write_clip(tmp_path_factory.mktemp("clip") / layout, layout) for layout in LAYOUTS}


@pytest.fixture(scope="module")
def frame():
    """Four quarters, a colour each."""
    image = np.zeros((40, 60, 3), np.uint8)
    for n, colour in enumerate(COLOURS.values()):
        image[20 * (n // 2) :, 30 * (n % 2) :] = np.round(255 * np.asarray(colour))
    return image


@pytest.mark.parametrize("layout", LAYOUTS)
def test_images_and_texts_meet_in_every_layout(folders, frame, layout):
    """Of each quarter without its rim, and of an empty mask."""
    masks = np.zeros((5, 40, 60), bool)
    for n in range(4):
        masks[n, 20 * (n // 2) + 2 : 20 * (n // 2) + 18, 30 * (n % 2) + 2 : 30 * (n % 2) + 28] = True
    embedder = ClipEmbedder(folders[layout])
    assert isinstance(embedder, Embedder)
    assert embedder.dim == 3
    rows, texts = embedder.embed_regions(frame, masks), embedder.embed_text([f"a {name} thing" for name in COLOURS])
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), [1, 1, 1, 1, 0], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(texts, axis=1), 1, atol=1e-6)
    true = np.asarray(list(COLOURS.values()))
    np.testing.assert_allclose(rows[:4], true / np.linalg.norm(true, axis=1, keepdims=True), atol=0.01)
    assert ((rows[:4] @ texts.T).argmax(1) == np.arange(4)).all()
    assert embedder.canonical_phrases.shape == (len(CANONICAL), 3)
    embedder.close()
    many = embedder.embed_regions(frame, np.tile(masks, (5, 1, 1)))  # more than a batch holds
    np.testing.assert_allclose(many, np.tile(rows, (5, 1)), atol=1e-6)


def test_crops_are_those_of_langsplat(frame):
    """Against the definition, step by step, of a mask with a ragged outline, higher than wide."""
    rng = np.random.default_rng(0)
    mask = np.zeros(frame.shape[:2], bool)
    mask[5:33, 20:31] = rng.random((28, 11)) < 0.7
    mask[5, 20] = mask[32, 30] = True
    zeroed = frame.copy()
    zeroed[~mask] = 0
    inside = zeroed[5 : 5 + (32 - 5), 20 : 20 + (30 - 20)]  # width and height are differences: the last are lost
    square = np.zeros((27, 27, 3), np.uint8)
    square[:, (27 - 10) // 2 : (27 - 10) // 2 + 10] = inside
    np.testing.assert_array_equal(_masked_crop(frame, mask, 64), cv2.resize(square, (64, 64)))
    dot = np.zeros_like(mask)
    dot[3, 4] = True
    assert (_masked_crop(frame, dot, 8) == frame[3, 4]).all()


def test_the_name_is_that_of_the_content(folders, tmp_path):
    names = {layout: ClipEmbedder(folder).name for layout, folder in folders.items()}
    assert len(set(names.values())) == 2
    assert ClipEmbedder(write_clip(tmp_path / "moved", "immich")).name == names["immich"]
    config = tmp_path / "moved" / "visual" / "preprocess_cfg.json"
    config.write_text(json.dumps(json.loads(config.read_text()) | {"mean": [0.5, 0.5, 0.5]}))
    assert ClipEmbedder(tmp_path / "moved").name != names["immich"]


OPEN_CLIP = {"mean": [0, 0, 0], "std": [1, 1, 1]}
TRANSFORMERS = {"image_mean": [0, 0, 0], "image_std": [1, 1, 1]}


@pytest.mark.parametrize(("content", "expected"), [
    (OPEN_CLIP | {"size": 16}, 16), (OPEN_CLIP | {"size": [16, 16]}, 16), (OPEN_CLIP, None),
    (TRANSFORMERS | {"size": {"shortest_edge": 24}, "crop_size": 16}, 16),
    (TRANSFORMERS | {"size": {"shortest_edge": 24}}, 24), (TRANSFORMERS | {"size": {"height": 16, "width": 16}}, 16),
    ({"do_normalize": False, "do_rescale": True, "rescale_factor": 1 / 255, "crop_size": 16}, 16),  # MobileCLIP's
    (OPEN_CLIP | {"size": [16, 24]}, "not of a square"), (OPEN_CLIP | {"mean": [0, 0]}, "mean"),
    (OPEN_CLIP | {"std": [0, 1, 1]}, "std"), ({"size": 16}, "cannot be read"), ([], "cannot be read"),
])  # fmt: skip
def test_preprocessing_in_all_its_spellings(tmp_path, content, expected):
    path = tmp_path / "preprocessor_config.json"
    path.write_text(json.dumps(content))
    if isinstance(expected, str):
        with refused(expected):
            read_preprocessing(path)
    else:
        mean, std, size = read_preprocessing(path)
        assert size == expected
        assert (mean, std) == ((0.0,) * 3, (1.0,) * 3)


def test_unrelated_words_are_embedded_once_for_a_model(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    asked = []

    class Words(ClipEmbedder):
        def __init__(self, name):
            self.name = name

        def embed_text(self, texts):
            asked.append(len(texts))
            return np.random.default_rng(0).standard_normal((len(texts), 5)).astype(np.float32)

    first = Words("model a").unrelated_words
    for model, count in (("model a", 1), ("model a", 2), ("model b", 3)):
        np.testing.assert_array_equal(Words(model).unrelated_words, first)
        assert asked == [len(UNRELATED_WORDS)] * count
        for kept in tmp_path.rglob("*.safetensors"):
            kept.write_bytes(kept.read_bytes()[:-7])  # damaged: embedded anew


# Texts


@pytest.fixture(scope="module")
def tokenizer(tmp_path_factory) -> TextTokenizer:
    return TextTokenizer(write_tokenizer(tmp_path_factory.mktemp("clip") / "tokenizer.json"), None)


def test_ids_are_those_of_open_clip(tokenizer):
    """Without the repair of mis-decoded characters, which the fixture leaves out."""
    texts, expected = zip(*fixture()["cases"])
    assert len(texts) > 90
    for text, row, ids in zip(texts, tokenizer(texts, CLIP_LENGTH)[0], expected):
        assert row.tolist() == ids, text


def test_typographic_quotes_are_straight_ones_and_half_a_character_is_no_error(tokenizer):
    pairs = ("the mug\u2019s \u201chandle\u201d", 'the mug\'s "handle"'), ("red \ud83d mug", "red \ufffd mug")
    for text, same in pairs:
        np.testing.assert_array_equal(tokenizer([text], 32)[0], tokenizer([same], 32)[0])


def test_a_long_text_is_cut_and_keeps_its_end(tokenizer):
    start, end = (vocabulary()[token] for token in (START, END))
    row = tokenizer(["mug " * 200], 16)[0][0]
    assert row[0] == start
    assert row[-1] == end
    assert (row[1:-1] != end).all()
    ids, mask = tokenizer(["mug"], 16)
    short = ids[0].tolist()
    assert short[short.index(end) + 1 :] == [0] * (15 - short.index(end))
    np.testing.assert_array_equal(mask[0], np.arange(16) <= short.index(end))


@settings(max_examples=200, deadline=None)
@given(st.text(max_size=40))
def test_the_ids_spell_the_cleaned_text(tokenizer, text):
    name_of = {number: token for token, number in vocabulary().items()}
    ids, mask = tokenizer([text], 1000)
    spelled = "".join(name_of[id] for id in ids[0, 1 : mask[0].sum() - 1]).replace("</w>", "")
    assert decoders.ByteLevel().decode([spelled]) == "".join(tokenizer._clean(text).lower().split())
