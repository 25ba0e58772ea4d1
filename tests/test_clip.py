"""CLIP: every layout and signature gives the same space, crops are LangSplat's, and what does not fit is named."""

import json
import shutil

import cv2
import numpy as np
import pytest
from clip_files import COLOURS, write_clip, write_visual
from onnx_files import node, write_graph

from jsecon.errors import InputError
from jsecon.networks.clip import ClipEmbedder, masked_crop, read_preprocessing
from jsecon.vision.protocols import CANONICAL, Embedder
from jsecon.vision.unrelated_words import UNRELATED_WORDS, cached_unrelated_words

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


@pytest.fixture(scope="module")
def masks():
    """Each quarter without its rim, and an empty mask."""
    found = np.zeros((5, 40, 60), bool)
    for n in range(4):
        found[n, 20 * (n // 2) + 2 : 20 * (n // 2) + 18, 30 * (n % 2) + 2 : 30 * (n % 2) + 28] = True
    return found


@pytest.mark.parametrize("layout", LAYOUTS)
def test_images_and_texts_meet_in_every_layout(folders, frame, masks, layout):
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
    np.testing.assert_array_equal(embedder.embed_regions(frame, masks), rows)


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
    np.testing.assert_array_equal(masked_crop(frame, mask, 64), cv2.resize(square, (64, 64)))
    dot = np.zeros_like(mask)
    dot[3, 4] = True
    assert (masked_crop(frame, dot, 8) == frame[3, 4]).all()
    with pytest.raises(ValueError, match="at least one pixel"):
        masked_crop(frame, np.zeros_like(mask), 8)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_more_masks_than_a_batch_holds_have_the_same_rows(folders, frame, masks, layout):
    embedder = ClipEmbedder(folders[layout])
    rows = embedder.embed_regions(frame, np.tile(masks, (5, 1, 1)))
    np.testing.assert_allclose(rows, np.tile(embedder.embed_regions(frame, masks), (5, 1)), atol=1e-6)


def test_embeddings_are_kept_by_content(folders, frame, masks, tmp_path, monkeypatch):
    embedder = ClipEmbedder(folders["transformers.js"], store=tmp_path)
    crops = []
    through = embedder._run_visual
    monkeypatch.setattr(embedder, "_run_visual", lambda c: crops.append(len(c)) or through(c))
    rows = embedder.embed_regions(frame, masks[:3])
    assert sum(crops) == 3
    np.testing.assert_array_equal(embedder.embed_regions(frame, masks[[2, 1, 4]]), [*rows[[2, 1]].tolist(), [0, 0, 0]])
    assert sum(crops) == 3
    embedder.embed_regions(frame, masks[2:])  # one mask more
    assert sum(crops) == 4
    embedder.embed_regions(255 - frame, masks[:1])  # another frame
    assert sum(crops) == 5
    for path in tmp_path.glob("*.safetensors"):
        path.write_bytes(path.read_bytes()[:50])
    np.testing.assert_array_equal(embedder.embed_regions(frame, masks[:3]), rows)
    assert sum(crops) == 8


def test_the_name_is_that_of_the_content(folders, tmp_path):
    names = {layout: ClipEmbedder(folder).name for layout, folder in folders.items()}
    assert len(set(names.values())) == 2
    assert ClipEmbedder(write_clip(tmp_path / "moved", "immich")).name == names["immich"]
    config = tmp_path / "moved" / "visual" / "preprocess_cfg.json"
    config.write_text(json.dumps(json.loads(config.read_text()) | {"mean": [0.5, 0.5, 0.5]}))
    assert ClipEmbedder(tmp_path / "moved").name != names["immich"]


# Folders that are no such model


@pytest.mark.parametrize(("layout", "lost", "words"), [
    ("immich", "textual/model.onnx", r"lacks textual/model\.onnx"),
    ("immich", "textual/tokenizer.json", r"lacks textual/tokenizer\.json"),
    ("transformers.js", "onnx/vision_model.onnx", r"lacks onnx/vision_model\.onnx"),
    ("transformers.js", "preprocessor_config.json", r"lacks preprocessor_config\.json"),
])  # fmt: skip
def test_what_is_missing_is_named_and_where_to_get_it(tmp_path, layout, lost, words):
    folder = write_clip(tmp_path / "clip", layout)
    (folder / lost).unlink()
    with pytest.raises(InputError, match=words) as caught:
        ClipEmbedder(folder)
    assert "huggingface.co" in str(caught.value)


def test_folders_without_a_model_and_an_empty_text_are_refused(tmp_path, folders):
    with pytest.raises(InputError, match=r"lacks onnx/vision_model\.onnx, onnx/text_model\.onnx"):
        ClipEmbedder(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        ClipEmbedder(tmp_path / "nowhere")
    with pytest.raises(InputError, match="expected a text"):
        ClipEmbedder(folders["transformers.js"]).embed_text(["red", "  "])


def test_graphs_of_another_kind_are_named_with_their_tensors(tmp_path, frame, masks):
    folder = write_clip(tmp_path / "clip", "immich")
    visual, textual = folder / "visual" / "model.onnx", folder / "textual" / "model.onnx"
    textual_bytes, visual_bytes = textual.read_bytes(), visual.read_bytes()

    visual.write_bytes(textual_bytes)  # swapped
    with pytest.raises(InputError, match=r"input 'image': no such input; the graph has text int32\[1, 77\]"):
        ClipEmbedder(folder).embed_regions(frame, masks)
    visual.write_bytes(visual_bytes)
    textual.write_bytes(visual_bytes)
    with pytest.raises(InputError, match=r"textual/model\.onnx, input 'image'"):
        ClipEmbedder(folder).embed_text(["red"])

    hidden = {"last_hidden_state": ("float32", [1, 77, 1]), "pooler_output": ("float32", [1, 77])}
    nodes = [
        node("Cast", ["text"], ["pooler_output"], to=1),
        node("Unsqueeze", ["pooler_output", "axis"], ["last_hidden_state"]),
    ]
    write_graph(textual, nodes, {"text": ("int64", [1, 77])}, hidden, {"axis": np.asarray([2])})
    with pytest.raises(
        InputError, match=r"output 'embedding': no such output; the graph has last_hidden_state.*projection"
    ):
        ClipEmbedder(folder).embed_text(["red"])

    nodes = [node("Cast", ["text"], ["embedding"], to=1)]
    write_graph(textual, nodes, {"text": ("int64", [1, 77])}, {"embedding": ("float32", [1, 77])})
    with pytest.raises(InputError, match="texts of 77 numbers, expected 3"):
        ClipEmbedder(folder).embed_text(["red"])


def test_a_size_that_the_graph_does_not_take_and_numbers_that_are_not_finite(tmp_path, folders, frame, masks):
    folder = shutil.copytree(folders["immich"], tmp_path / "clip")
    config = folder / "visual" / "preprocess_cfg.json"
    content = json.loads(config.read_text())
    config.write_text(json.dumps(content | {"size": 48}))
    with pytest.raises(InputError, match=r"image float32\[1, 3, 48, 48\].*Expected: 32"):
        ClipEmbedder(folder).embed_regions(frame, masks)
    config.write_text(json.dumps(content))
    write_visual(folder / "visual" / "model.onnx", ("image", "embedding"), 1, std=(np.nan, 1, 1))
    with pytest.raises(InputError, match=r"model\.onnx: an embedding that is zero or not finite"):
        ClipEmbedder(folder).embed_regions(frame, masks)


OPEN_CLIP = {"mean": [0, 0, 0], "std": [1, 1, 1]}
TRANSFORMERS = {"image_mean": [0, 0, 0], "image_std": [1, 1, 1]}


@pytest.mark.parametrize(("content", "expected"), [
    (OPEN_CLIP | {"size": 16}, 16), (OPEN_CLIP | {"size": [16, 16]}, 16), (OPEN_CLIP, None),
    (TRANSFORMERS | {"size": {"shortest_edge": 24}, "crop_size": 16}, 16),
    (TRANSFORMERS | {"size": {"shortest_edge": 24}}, 24), (TRANSFORMERS | {"size": {"height": 16, "width": 16}}, 16),
    (OPEN_CLIP | {"size": [16, 24]}, "not of a square"), (OPEN_CLIP | {"mean": [0, 0]}, "mean"),
    (OPEN_CLIP | {"std": [0, 1, 1]}, "std"), (OPEN_CLIP | {"std": "abc"}, "cannot be read"),
    ({"size": 16}, "cannot be read"), ([], "cannot be read"),
])  # fmt: skip
def test_preprocessing_in_all_its_spellings(tmp_path, content, expected):
    path = tmp_path / "preprocessor_config.json"
    path.write_text(json.dumps(content))
    if isinstance(expected, str):
        with pytest.raises(InputError, match=expected):
            read_preprocessing(path)
    else:
        mean, std, size = read_preprocessing(path)
        assert size == expected
        assert len(mean) == len(std) == 3


def test_unrelated_words_are_embedded_once_for_a_model(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    asked = []

    def embed_text(texts):
        asked.append(len(texts))
        return np.random.default_rng(0).standard_normal((len(texts), 5)).astype(np.float32)

    first = cached_unrelated_words("model a", embed_text)
    np.testing.assert_array_equal(cached_unrelated_words("model a", embed_text), first)
    assert asked == [len(UNRELATED_WORDS)]
    (kept,) = tmp_path.rglob("*.safetensors")
    kept.write_bytes(kept.read_bytes()[:-7])  # damaged: embedded anew
    np.testing.assert_array_equal(cached_unrelated_words("model a", embed_text), first)
    cached_unrelated_words("model b", embed_text)
    assert len(asked) == 3
