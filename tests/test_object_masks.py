"""SAM 2's folders of masks: one PNG a frame for each object, or numbered palette PNGs."""

import cv2
import numpy as np
import pytest

from jsecon.data.labels import load_labels
from jsecon.data.object_masks import object_folders
from jsecon.errors import InputError

NAMES = ("b", "c", "e")
SIZE = (12, 16)


def write(path, mask):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), mask.astype(np.uint8))


@pytest.fixture
def masks():
    """Object 2 lies under object 10 in places."""
    found = np.zeros((2, *SIZE), bool)
    found[0, 1:8, 2:9] = found[1, 5:11, 6:14] = True
    return found


def test_objects_in_folders_of_their_own(tmp_path, masks):
    for name in NAMES:
        write(tmp_path / "002" / f"{name}.png", 255 * masks[0])
    write(tmp_path / "010" / "c.png", 255 * masks[1])
    (tmp_path / "other").mkdir()
    (tmp_path / "011").mkdir()
    assert [path.name for path in object_folders(tmp_path)] == ["002", "010"]
    labels, ids, notes = load_labels(tmp_path, (*NAMES, "f"), SIZE)
    assert ids == (2, 10)
    expected = np.where(masks[0], 0, np.where(masks[1], 1, -1))  # the lower id lies on top
    np.testing.assert_array_equal(labels[1], expected)
    np.testing.assert_array_equal(labels[0] == 0, masks[0])
    assert (labels[3] == -1).all()
    assert "1 of 4 frames" in notes[0]


def test_masks_of_unlike_sizes_are_refused(tmp_path, masks):
    write(tmp_path / "1" / "b.png", masks[0])
    write(tmp_path / "2" / "b.png", masks[1][:6])
    with pytest.raises(InputError, match="16x12"):
        load_labels(tmp_path, NAMES, SIZE)


def test_numbered_masks_are_taken_in_order_where_they_are_as_many_as_the_frames(tmp_path, masks):
    order = ("a", "b", "c", "d", "e")  # a and d are held out
    for n in range(5):
        write(tmp_path / f"{n:05}.png", (n + 1) * masks[0])
    labels, ids, notes = load_labels(tmp_path, NAMES, SIZE, order=order)
    assert ids == (2, 3, 5)
    for t in range(3):
        np.testing.assert_array_equal(labels[t] == t, masks[0])
    assert notes == ("The masks are numbered, and taken in the order of the frames: 00001.png is b.",)
    with pytest.raises(InputError, match="none of which"):
        load_labels(tmp_path, NAMES, SIZE)
    (tmp_path / "00003.png").unlink()
    with pytest.raises(InputError, match="a PNG for each number from 0 to 4"):
        load_labels(tmp_path, NAMES, SIZE, order=order)
