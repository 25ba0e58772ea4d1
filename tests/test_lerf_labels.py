"""LERF labels: read as LangSplat reads them, written so that masks and boxes come back exactly."""

import json
import shutil
import tempfile

import cv2
import numpy as np
import pytest
from capture_files import refused
from hypothesis import given, settings, strategies as st

from experiments.rooms.writers import write_lerf_labels
from jsecon.errors import InputError
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
    write(tmp_path, label(), name="frame_00007.jpg")
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


def test_polygon_partly_outside(tmp_path):
    outside = label(category="spoon", segmentation=[[20, 20], [30, 20], [30, 30]])
    write(tmp_path, label(segmentation=[[-5, -5], [4, -5], [4, 30], [-5, 30]]), outside, width=10, height=8)
    (frame,) = load_lerf_labels(tmp_path)
    np.testing.assert_array_equal(frame.objects["mug"][0], np.broadcast_to(np.arange(10) <= 4, (8, 10)))
    assert not frame.objects["spoon"][0].any()


def test_excerpt(shared, tmp_path):
    """A true label file: the polygons lie within their boxes, give or take a pixel."""
    name = "lerf_label_waldo_kitchen_frame_00066_excerpt.json"
    shutil.copy(shared / "formats" / name, tmp_path / name)
    (frame,) = load_lerf_labels(tmp_path)
    assert frame.name == "frame_00066"
    assert (frame.width, frame.height) == (985, 725)
    assert "plastic ladle" in frame.objects
    for mask, boxes in frame.objects.values():
        assert mask.sum() > 100
        rows, columns = np.nonzero(mask)
        assert (np.abs(boxes.min(0)[:2] - [columns.min(), rows.min()]) <= 2).all()
        assert (np.abs(boxes.max(0)[2:] - [columns.max(), rows.max()]) <= 2).all()


def pieces(mask):
    """The mask as it is written, piece by piece, and read."""
    frame = LabelledFrame("a", mask.shape[1], mask.shape[0], {"thing": (mask, np.zeros((1, 4), np.float32))})
    with tempfile.TemporaryDirectory() as folder:
        write_lerf_labels(folder, [frame])
        return load_lerf_labels(folder)[0].objects["thing"][0]


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(1, 24), st.integers(1, 24), st.floats(0.05, 0.95), st.integers(0, 2))
def test_polygons_are_the_mask(seed, height, width, share, smooth):
    """Noise of any density: many pieces, holes, pieces within holes, touching corners, the image's edge."""
    noise = np.random.default_rng(seed).random((height, width)).astype(np.float32)
    for _ in range(smooth):
        noise = cv2.blur(noise, (3, 3))
    mask = noise <= np.quantile(noise, share)
    np.testing.assert_array_equal(pieces(mask), mask)


def test_round_trip(tmp_path):
    """Two mugs far apart, one split by an occluder and with a hole; a box that no polygon fits best."""
    mugs = np.zeros((30, 40), bool)
    mugs[4:20, 3:15] = True
    mugs[8:12, 6:9] = False
    mugs[:, 10] = False
    mugs[22:28, 30:38] = True
    boxes = np.float32([[3, 4, 14, 19], [30, 22, 37, 27], [31, 23, 32, 24]])
    ball = np.zeros((30, 40), bool)
    ball[0, 0] = True
    frame = LabelledFrame("frame_00001", 40, 30, {"mug": (mugs, boxes), "ball": (ball, np.float32([[0, 0, 0, 0]]))})
    write_lerf_labels(tmp_path, [frame])
    (loaded,) = load_lerf_labels(tmp_path)
    assert (loaded.name, loaded.width, loaded.height) == ("frame_00001", 40, 30)
    assert list(loaded.objects) == ["mug", "ball"]
    for category, (mask, expected) in frame.objects.items():
        np.testing.assert_array_equal(loaded.objects[category][0], mask)
        np.testing.assert_array_equal(sorted(map(tuple, loaded.objects[category][1])), sorted(map(tuple, expected)))
    content = json.loads((tmp_path / "frame_00001.json").read_text())
    assert content["info"]["name"] == "frame_00001.png"
    assert all(entry["iscrowd"] == 0 for entry in content["objects"])


@pytest.mark.parametrize(("entry", "info", "said"), [
    (label(segmentation=[]), {}, "segmentation is empty"), (label(segmentation=[[1, 2, 3]]), {}, "object 0"),
    (label(segmentation=[[1, "x"], [2, 3], [4, 5]]), {}, "object 0"),
    (label(segmentation=[[1, float("nan")], [2, 3], [4, 5]]), {}, "out of all range"),
    (label(bbox=[1, 2, 3]), {}, "object 0"), (label(category=7), {}, "category is 7"),
    ({"category": "mug"}, {}, "'segmentation' is missing"), ("mug", {}, "object 0"),
    (label(), {"width": "wide"}, "wide"), (label(), {"height": 0}, "20x0"),
])  # fmt: skip
def test_damage_is_told(tmp_path, entry, info, said):
    write(tmp_path, entry, **info)
    with refused("frame_00041.json", said):
        load_lerf_labels(tmp_path)


def test_no_labels_no_json_and_nothing_or_nowhere_to_write(tmp_path):
    with refused(tmp_path, "no .json file"):
        load_lerf_labels(tmp_path)
    (tmp_path / "a.json").write_text("{")
    with refused("a.json", "not JSON"):
        load_lerf_labels(tmp_path)
    with pytest.raises(InputError):
        write_lerf_labels(tmp_path / "a.json" / "deeper", [LabelledFrame("a", 5, 4, {})])
    empty = LabelledFrame("a", 5, 4, {"mug": (np.zeros((4, 5), bool), np.zeros((1, 4), np.float32))})
    with pytest.raises(ValueError, match="Leave out what the frame does not show"):
        write_lerf_labels(tmp_path, [empty])
