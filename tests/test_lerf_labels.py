"""LERF labels: read as LangSplat reads them, written so that masks and boxes come back exactly."""

import json
import shutil

import numpy as np
import pytest

from experiments.rooms.writers import write_lerf_labels
from jsecon.read.masks.labels import LabelledFrame, load_lerf_labels

SQUARE = [[2.9, 3.0], [8.0, 3.0], [8.0, 6.7], [2.0, 6.0]]


def label(**changes):
    shape = {"segmentation": SQUARE, "area": 1.0, "bbox": [2.0, 3.0, 8.0, 6.0]}
    return {"category": "mug", "group": 1, **shape, "iscrowd": False, **changes}


def write(folder, *objects, name="frame_00041.jpg", **info):
    info = {"name": name, "width": 20, "height": 14, "depth": 3, "note": "", **info}
    (folder / (name.split(".")[0] + ".json")).write_text(json.dumps({"info": info, "objects": list(objects)}))


def test_reading(tmp_path):
    """Corners cut to integers, edges filled; two mugs OR-ed, their boxes side by side; frames by name."""
    other = label(segmentation=[[12, 1], [15, 1], [15, 4]], bbox=[12, 1, 15, 4], iscrowd=0)
    write(tmp_path, label(), other, label(category="spoon"))
    outside = label(category="bowl", segmentation=[[20, 20], [30, 20], [30, 30]])
    write(tmp_path, label(), outside, name="frame_00007.jpg")
    first, second = load_lerf_labels(tmp_path)
    assert (first.name, second.name) == ("frame_00007", "frame_00041")
    assert (second.width, second.height) == (20, 14)
    mask, boxes = second.objects["mug"]
    expected = np.zeros((14, 20), bool)
    expected[3:7, 2:9] = True
    for row in range(1, 5):
        expected[row, 11 + row : 16] = True
    np.testing.assert_array_equal(mask, expected)
    np.testing.assert_array_equal(boxes, [[2, 3, 8, 6], [12, 1, 15, 4]])
    assert boxes.dtype == np.float32
    np.testing.assert_array_equal(second.objects["spoon"][0], first.objects["mug"][0])
    assert not first.objects["bowl"][0].any()


def test_excerpt(shared, tmp_path):
    """A true label file: the polygons lie within their boxes, give or take a pixel."""
    name = "lerf_label_waldo_kitchen_frame_00066_excerpt.json"
    shutil.copy(shared / "formats" / name, tmp_path / name)
    (frame,) = load_lerf_labels(tmp_path)
    assert (frame.name, frame.width, frame.height) == ("frame_00066", 985, 725)
    for mask, boxes in frame.objects.values():
        assert mask.sum() > 100
        rows, columns = np.nonzero(mask)
        assert (np.abs(boxes.min(0)[:2] - [columns.min(), rows.min()]) <= 2).all()
        assert (np.abs(boxes.max(0)[2:] - [columns.max(), rows.max()]) <= 2).all()


def test_nothing_to_write(tmp_path):
    empty = LabelledFrame("a", 5, 4, {"mug": (np.zeros((4, 5), bool), np.zeros((1, 4), np.float32))})
    with pytest.raises(ValueError, match="Leave out what the frame does not show"):
        write_lerf_labels(tmp_path, [empty])
