"""Masks of single frames from disk: SAM's own JSON, LangSplat's files, PNGs, whichever a frame has."""

import json

import cv2
import numpy as np
import pytest
from test_rle import runs_of, text_of

from jsecon.data.proposals import proposals_from_disk
from jsecon.errors import InputError

SIZE = (20, 30)


@pytest.fixture
def masks():
    """Three masks, the second inside of the first."""
    found = np.zeros((3, *SIZE), bool)
    found[0, 2:12, 3:20] = found[1, 4:8, 5:9] = found[2, 14:19, 10:28] = True
    return found


def records(masks, scores=None):
    """As scripts/amg.py of segment-anything writes them."""
    found = [
        {"segmentation": {"size": list(mask.shape), "counts": text_of(runs_of(mask))}, "area": int(mask.sum())}
        for mask in masks
    ]
    for record, score in zip(found, scores or []):
        record |= {"predicted_iou": score, "stability_score": 0.9}
    return found


def test_json_of_sams_generator_may_overlap_and_is_ordered_by_score(tmp_path, masks):
    (tmp_path / "a.json").write_text(json.dumps(records(masks, [0.8, 0.95, 0.9])))
    (tmp_path / "b.json").write_text(json.dumps({"image": {"image_id": 1}, "annotations": records(masks)}))
    read, notes = proposals_from_disk(tmp_path, ("a", "b", "c"), SIZE)
    np.testing.assert_array_equal(read(0), masks[[1, 2, 0]])
    np.testing.assert_array_equal(read(1), masks)
    assert read(2).shape == (0, *SIZE)
    assert notes == ("1 of 3 frames have no masks (the first: c).",)


def test_png_and_langsplat_files_hold_one_layer(tmp_path, masks):
    ids = np.zeros(SIZE, np.uint8)
    ids[masks[0]], ids[masks[2]] = 7, 200
    cv2.imwrite(str(tmp_path / "a.png"), ids)
    levels = np.full((4, *SIZE), -1, np.float32)
    levels[3][masks[2]], levels[1][masks[1]] = 4, 0
    np.save(tmp_path / "b_s.npy", levels)
    read, notes = proposals_from_disk(tmp_path, ("a", "b.extra"), SIZE)
    np.testing.assert_array_equal(read(0), masks[[0, 2]])
    np.testing.assert_array_equal(read(1), masks[[2]])
    assert notes == ()
    read, _ = proposals_from_disk(tmp_path, ("a", "b"), SIZE, level="s")
    np.testing.assert_array_equal(read(1), masks[[1]])


def test_masks_of_larger_frames_are_resized_and_others_refused(tmp_path, masks):
    large = masks.repeat(2, 1).repeat(2, 2)
    (tmp_path / "a.json").write_text(json.dumps(records(large)))
    read, _ = proposals_from_disk(tmp_path, ("a",), SIZE)
    np.testing.assert_array_equal(read(0), masks)
    read, _ = proposals_from_disk(tmp_path, ("a",), (20, 20))
    with pytest.raises(InputError, match="60x40"):
        read(0)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("[{", "no list of masks"),
        ('[{"bbox": [1, 2, 3, 4]}]', "KeyError"),
        ('{"info": 1}', "KeyError"),
        ('[{"segmentation": [[1, 2, 3, 4]]}]', "mask 0"),
        ('[{"segmentation": {"size": [20, 30], "counts": [5]}}]', "5 of 20x30"),
    ],
)
def test_damaged_json_is_named(tmp_path, content, words):
    (tmp_path / "a.json").write_text(content)
    read, _ = proposals_from_disk(tmp_path, ("a",), SIZE)
    with pytest.raises(InputError, match=words) as caught:
        read(0)
    assert caught.value.where.startswith(str(tmp_path / "a.json"))


def test_folders_without_masks_are_refused(tmp_path):
    with pytest.raises(InputError, match="called like a frame"):
        proposals_from_disk(tmp_path, ("a",), SIZE)
    with pytest.raises(InputError, match="no such folder"):
        proposals_from_disk(tmp_path / "nowhere", ("a",), SIZE)
