"""SAM's automatic mask generator over small graphs of each dialect: the same masks as a plain twin, whatever the batch,
and a message that names the tensor for a graph of another kind."""

import json
import shutil

import numpy as np
import pytest
from sam_files import MEAN, STD, write_sam
from scipy import ndimage

from jsecon.networks.hub import find_files
from jsecon.networks.sam import TOKENS, SamSegmenter, _box_nms, _box_of, _GuidedPrompts, _langsplat_nms, _SamGraphs

KINDS = [("sam", 1), ("sam", "batch"), ("sam2", "batch")]


@pytest.fixture(scope="module")
def frame():
    image = np.full((120, 160, 3), 200, np.uint8)
    image[20:70, 20:80] = (200, 30, 30)
    image[60:110, 90:150] = (30, 160, 40)
    image[75:95, 105:130] = (30, 40, 200)
    return image


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    base = tmp_path_factory.mktemp("sam")
    return {(kind, batch): write_sam(base / f"{kind}-{batch}", kind, batch=batch) for kind, batch in KINDS}


class GridPrompts:
    """An 8 x 8 grid of points, in one round."""

    def __init__(self, frame, levels):
        line = (np.arange(8, dtype=np.float32) + 0.5) / 8
        self.points = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2) * np.float32(frame.shape[1::-1])

    def next_points(self):
        points, self.points = self.points, self.points[:0]
        return points

    def explain(self, level, point, mask):
        pass


class GridSam(SamSegmenter):
    prompts = GridPrompts


def graphs_of(folder) -> _SamGraphs:
    return _SamGraphs(*find_files(folder, "segmenter"))


def by_definition(folder, frame, token_of_level):
    """SAM's automatic mask generator with LangSplat's levels, one point a call: masks and scores of one level."""
    graphs = graphs_of(folder)
    found, encoded = [], graphs.encode(frame)
    for point in GridPrompts(frame, 1).points:
        logits, ious = graphs.decode(encoded, point)
        for token in token_of_level:
            full = graphs.to_frame(logits[token], encoded)
            stable = (full > 1).sum() / max((full > -1).sum(), 1)
            if ious[token] > 0.7 and stable >= 0.85:
                found.append((full > 0, ious[token], stable))
    boxes = np.asarray([_box_of(mask) for mask, *_ in found], float)
    found = [found[i] for i in _box_nms(boxes, np.asarray([iou for _, iou, _ in found]), 0.7)]
    clean = []
    for mask, *_ in found:
        for hole in (True, False):
            labels, count = ndimage.label(mask ^ hole, np.ones((3, 3)))
            areas = np.bincount(labels.ravel(), minlength=count + 1)[1:]
            small = np.flatnonzero(areas < 100) + 1
            if hole:
                mask = mask | np.isin(labels, small)
            elif len(small) == count and count:
                mask = labels == 1 + areas.argmax()
            else:
                mask = mask & ~np.isin(labels, small)
        clean.append(mask)
    unchanged = np.asarray([float((a == b[0]).all()) for a, b in zip(clean, found)])
    kept = sorted(_box_nms(np.asarray([_box_of(m) for m in clean], float), unchanged, 0.7))
    masks = np.stack([clean[i] for i in kept])
    scores = np.asarray([float(found[i][1]) * found[i][2] for i in kept])
    order = _langsplat_nms(masks, scores)
    return masks[order], scores[order]


@pytest.mark.parametrize("level", ["s", "l", "default"])
def test_masks_are_those_of_the_definition(folders, frame, level):
    masks, scores = GridSam(folders["sam", "batch"], level=level)._segment(frame)
    expected, expected_scores = by_definition(folders["sam", "batch"], frame, TOKENS[level])
    assert len(masks) >= 3
    np.testing.assert_array_equal(masks, expected)
    np.testing.assert_allclose(scores, expected_scores, rtol=1e-6)
    assert (np.diff(scores) <= 0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_every_dialect_and_batch_finds_the_same_things(folders, frame, kind):
    segmenter = GridSam(folders[kind])
    masks = segmenter(frame, 0)
    red, green = frame[..., 0] == 200, frame[..., 1] == 160
    for true in (red & (frame[..., 1] == 30), green):
        inner = ndimage.binary_erosion(true, iterations=12)
        assert any((inner & mask).sum() == inner.sum() and (mask & ~true).sum() < 0.3 * mask.sum() for mask in masks)
    if "sam2" not in kind[0]:  # which sees the frame stretched to a square
        np.testing.assert_array_equal(masks, GridSam(folders["sam", "batch"])(frame, 0))
    segmenter.close()
    np.testing.assert_array_equal(segmenter(frame, 1), masks)


def test_guided_prompts_find_the_things_of_the_grid_with_fewer_points(folders, frame):
    asked = []

    class Counted(_GuidedPrompts):
        def next_points(self):
            asked.append(len(points := super().next_points()))
            return points

    class CountedSam(SamSegmenter):
        prompts = Counted

    guided = CountedSam(folders["sam", "batch"])(frame, 0)
    assert 0 < sum(asked) <= 64 / 4
    for mask in GridSam(folders["sam", "batch"])(frame, 0):
        assert max((mask & other).sum() / (mask | other).sum() for other in guided) > 0.9


def test_sam_2_takes_a_frame_stretched_to_a_square(folders, frame, tmp_path):
    graphs = graphs_of(folders["sam2", "batch"])
    assert (graphs.side, graphs.stretched) == (256, True)
    encoded = graphs.encode(frame)
    assert encoded.scaled == (256, 256)
    cell = encoded.features["image_embeddings.2"][0, :3, 5, 5]
    np.testing.assert_allclose(255 * (cell * STD + MEAN), frame[40, 50], atol=1)  # (5.5 / 16) of height and width
    masks, scores = graphs.decode(encoded, np.float32([40, 40]))
    assert (masks.shape, scores.shape) == ((3, 64, 64), (3,))
    folder = shutil.copytree(folders["sam2", "batch"], tmp_path / "other")
    config = folder / "preprocessor_config.json"
    config.write_text(json.dumps(json.loads(config.read_text()) | {"image_mean": [0.5] * 3, "image_std": [0.5] * 3}))
    assert SamSegmenter(folder).name != SamSegmenter(folders["sam2", "batch"]).name
    other = graphs_of(folder).encode(frame).features["image_embeddings.2"][0, :3, 5, 5]
    np.testing.assert_allclose(other, (cell * STD + MEAN - 0.5) / 0.5, atol=1e-5)


def test_a_frame_without_anything_good_gives_no_masks(folders, frame, monkeypatch):
    decode = _SamGraphs.decode

    def decode_poorly(*given):
        masks, ious = decode(*given)
        return masks, 0.7 * ious

    monkeypatch.setattr(_SamGraphs, "decode", decode_poorly)
    assert SamSegmenter(folders["sam", "batch"])(frame, 0).shape == (0, 120, 160)
