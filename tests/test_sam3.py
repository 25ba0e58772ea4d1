"""SAM 3 asked by phrases over small graphs of each decoder: the same masks as a plain twin, and a message that names
the tensor for a graph of another kind."""

import shutil

import cv2
import numpy as np
import onnx
import pytest
from onnx_files import node, write_graph
from PIL import Image
from sam3_files import (
    CHANNELS,
    KINDS,
    LENGTH,
    LOGITS,
    PRESENCE,
    SHARPNESS,
    SIDE,
    TRUE,
    WIDTH,
    colour_of,
    places,
    write_sam3,
)
from sam_files import write_sam
from scipy.special import expit

from jsecon.errors import InputError
from jsecon.networks.sam3 import MASK_IOU, SCORE_THRESHOLD, Sam3
from jsecon.networks.session import Graph


@pytest.fixture(scope="module")
def frame():
    image = np.full((60, 80, 3), 200, np.uint8)
    image[10:30, 8:33] = image[30:55, 48:70] = (230, 26, 26)
    image[38:55, 10:30] = (26, 51, 230)
    return image


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    base = tmp_path_factory.mktemp("sam3")
    return {kind: write_sam3(base / kind, kind) for kind in KINDS}


@pytest.fixture
def folder(folders, tmp_path):
    """A copy of the published layout, to be damaged."""
    return shutil.copytree(folders["samexporter"], tmp_path / "sam3")


def by_definition(frame, phrase, kind):
    """What the graphs find, from the frame itself: (M, H, W) and (M,), best first."""
    square = np.asarray(Image.fromarray(frame).resize((SIDE, SIDE), Image.Resampling.BILINEAR), np.float64)
    rows = SIDE // 7
    cells = (square * 2 / 255 - 1).reshape(rows, 7, rows, 7, 3).mean((1, 3)).repeat(2, 0).repeat(2, 1)
    near = SHARPNESS * (WIDTH - ((cells - colour_of(phrase)) ** 2).sum(-1))
    maps = np.minimum(near, np.where(places(2 * rows), 99, -99))
    logits = np.minimum(maps.max((1, 2)), LOGITS)
    scores = expit(logits) * expit(min(100 * logits.max(), PRESENCE))
    level = 0.0
    if kind != "samexporter":
        maps, level = expit(maps), 0.5
    masks, told = [], []
    for n in np.argsort(-scores, kind="stable"):
        mask = cv2.resize(maps[n].astype(np.float32), frame.shape[1::-1]) > level
        repeats = any((mask & other).sum() > MASK_IOU * (mask | other).sum() for other in masks)
        if scores[n] > SCORE_THRESHOLD and mask.any() and not repeats:
            masks.append(mask)
            told.append(scores[n])
    return np.reshape(masks, (-1, *frame.shape[:2])).astype(bool), np.asarray(told)


@pytest.mark.parametrize("kind", KINDS)
def test_a_phrase_finds_every_thing_that_it_names(folders, frame, kind):
    sam3 = Sam3(folders[kind])
    seen = sam3.encode(frame)
    counts = []
    for phrase in ("a red mug", "Blue", "green", "thing"):
        found = sam3.masks(seen, sam3.read(phrase))
        masks, scores = by_definition(frame, phrase.lower(), kind)
        assert found.masks.shape == masks.shape
        assert (found.masks != masks).sum() <= 2  # of a pixel on the threshold
        np.testing.assert_allclose(found.scores, scores, atol=1e-5)
        counts.append(len(masks))
    assert counts == [3, 1, 0, 0]
    again = sam3(frame, "a red mug")
    assert np.argmax([mask[20, 20] for mask in again.masks]) == 1  # the right one's query is the surer
    sam3.close()
    np.testing.assert_array_equal(sam3(frame, "a red mug").masks, again.masks)


def test_the_published_sizes_are_read_from_the_graphs(tmp_path, frame):
    sam3 = Sam3(write_sam3(tmp_path, **TRUE))
    found = sam3(frame, "red mug")
    assert found.masks.sum((1, 2)).tolist() == pytest.approx([550, 500, 1050], abs=60)
    assert sam3.summary == "masks of what a phrase of 32 tokens names; raw decoder, images of 1008 px"
    image = Graph(sam3._image_path, optimise=False)
    assert str(image.inputs["image"]) == "image uint8[3, 1008, 1008]"
    assert image.outputs["backbone_fpn_0"].shape == (1, 256, 288, 288)


def test_phrases_that_cannot_be_asked(folders, frame):
    sam3 = Sam3(folders["samexporter"])
    with pytest.raises(InputError, match="expected a noun phrase"):
        sam3.read(" ")
    with pytest.raises(InputError, match="at most 32, start and end among them"):
        sam3.read("red " * 31)
    assert sam3.read("red " * 30)["language_mask"].shape == (1, LENGTH)
    with pytest.raises(ValueError, match="Give an RGB image"):
        sam3.encode(frame[:0])


def test_folders_that_lack_something(folder, tmp_path):
    write_sam(tmp_path / "sam")
    for other, told in ((tmp_path / "nowhere", "no such folder"), (tmp_path / "sam", "no .onnx file")):
        with pytest.raises(InputError, match=rf"{told}.*expected SAM 3's graphs, one \*image_encoder.onnx"):
            Sam3(other)
    (folder / "tokenizer.json").rename(folder / "vocabulary.json")
    with pytest.raises(InputError, match=r"without a tokenizer, expected CLIP's tokenizer\.json"):
        Sam3(folder)
    (folder / "vocabulary.json").rename(folder / "tokenizer.json")
    shutil.copy(folder / "sam3_decoder.onnx", folder / "second_decoder.onnx")
    with pytest.raises(InputError, match=r"one \*decoder.onnx"):
        Sam3(folder)


def _edited(path, edit):
    model = onnx.load(path)
    edit(model.graph)
    onnx.save(model, path)


def _renamed(old, new):
    def edit(graph):
        for value in (*graph.input, *graph.output):
            value.name = new if value.name == old else value.name
        for own in graph.node:
            own.input[:] = [new if name == old else name for name in own.input]
            own.output[:] = [new if name == old else name for name in own.output]

    return edit


def _sized(name, axis, size):
    def edit(graph):
        for value in (*graph.input, *graph.output):
            if value.name == name:
                value.type.tensor_type.shape.dim[axis].dim_value = size

    return edit


@pytest.mark.parametrize(("file", "edit", "says"), [
    ("sam3_image_encoder.onnx", _renamed("image", "pixels"), "image_encoder.onnx, input 'image'"),
    ("sam3_image_encoder.onnx", _sized("image", 1, 1 << 40), "an input 'image' of"),
    ("sam3_image_encoder.onnx", _renamed("backbone_fpn_1", "fpn"), "image_encoder.onnx, output 'backbone_fpn_1'"),
    ("sam3_language_encoder.onnx", _renamed("tokens", "ids"), "language_encoder.onnx, input 'tokens'"),
    ("sam3_language_encoder.onnx", _renamed("text_memory", "memory"), "output 'text_memory'"),
    ("sam3_language_encoder.onnx", _sized("tokens", 1, 1 << 30), "an input 'tokens' of"),
    ("sam3_decoder.onnx", _renamed("box_masks", "boxes_masks"), "decoder.onnx, input 'box_masks'"),
    ("sam3_decoder.onnx", _renamed("language_features", "words"), "input 'language_features'"),
    ("sam3_decoder.onnx", _renamed("vision_pos_enc_2", "where"), "image_encoder.onnx, output 'where'"),
    ("sam3_decoder.onnx", _renamed("presence_logit_dec", "there_at_all"), "output 'presence_logit_dec'"),
    ("sam3_decoder.onnx", _renamed("pred_logits", "logits"), "output 'scores'"),
    ("sam3_decoder.onnx", _sized("backbone_fpn_2", 1, CHANNELS + 1), "output 'backbone_fpn_2'"),
])  # fmt: skip
def test_graphs_of_another_kind_are_refused_by_the_tensor(folder, file, edit, says):
    _edited(folder / file, edit)
    with pytest.raises(InputError, match=says):
        Sam3(folder).check()


def test_an_encoder_that_scales_no_colours_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"image float32\[3, 112, 112\], expected image uint8"):
        Sam3(write_sam3(tmp_path, image="float32")).check()


def test_damaged_files_are_refused(folder, frame):
    Sam3(folder).check()
    for name in ("sam3_decoder.onnx", "tokenizer.json"):
        whole = (folder / name).read_bytes()
        (folder / name).write_bytes(whole[: len(whole) // 2])
        with pytest.raises(InputError, match=name):
            Sam3(folder).check()
        (folder / name).write_bytes(whole)


@pytest.mark.parametrize(("scores", "masks", "says"), [
    (np.float32([0.9]), np.full((1, 1, 4, 4), np.nan, np.float32), "not finite"),
    (np.float32([0.9, 0.8]), np.ones((1, 1, 4, 4), np.float32), "a score and a mask of each query"),
    (np.float32([np.inf]), np.ones((1, 1, 4, 4), np.float32), "not finite"),
    (np.float32([0.9]), np.ones((1, 1, 0, 4), np.float32), "a score and a mask of each query"),
])  # fmt: skip
def test_what_a_decoder_gives_is_not_trusted(folder, frame, scores, masks, says):
    given = {"language_mask": ("bool", [1, LENGTH]), "language_features": ("float32", [LENGTH, 1, CHANNELS])}
    given |= {"box_coords": ("float32", [1, 1, 4]), "box_labels": ("int64", [1, 1]), "box_masks": ("bool", [1, 1])}
    nodes = [node("Identity", ["these"], ["scores"]), node("Identity", ["those"], ["masks"])]
    told = {"scores": ("float32", ["n"]), "masks": ("float32", ["m", 1, "h", "w"])}
    write_graph(folder / "sam3_decoder.onnx", nodes, given, told, {"these": scores, "those": masks})
    with pytest.raises(InputError, match=says):
        Sam3(folder)(frame, "red")
