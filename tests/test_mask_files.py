"""Masks from disk: matched by name, compacted over the frames, every change said; which folders are cameras and which
objects."""

import json

import cv2
import numpy as np
import pytest
from capture_files import refused, write_mask

from jsecon.read.masks.masks import load_labels, load_nested_labels, load_proposals
from jsecon.types import ImageFile

NAMES = ("b", "a ä 図", "c")
SIZE = (12, 18)
RNG = np.random.default_rng(11)
IDS = RNG.choice([0, 3, 7, 200], (3, *SIZE))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_integers(tmp_path, dtype):
    """Frames are in another order than their files."""
    images = IDS * (1 if dtype == np.uint8 else 250)
    for name, image in zip(NAMES, images):
        write_mask(tmp_path / f"{name}.png", image)
    calls = []
    found = load_nested_labels(tmp_path, NAMES, SIZE, progress=lambda *call: calls.append(call))
    (labels, ids, notes), parent = found
    assert (parent == -1).all()
    none, *expected = np.unique(images).tolist()
    np.testing.assert_array_equal(np.array([*expected, none])[labels], images)
    assert (labels.dtype, ids, notes) == (np.int16, tuple(expected), ())
    assert calls == [(1, 3), (2, 3), (3, 3)]


@pytest.mark.parametrize(("row", "level"), [*enumerate(("default", "s", "m", "l"))])
def test_langsplat_levels(tmp_path, row, level):
    levels = RNG.integers(-1, 4, (3, 4, *SIZE)) + np.arange(4)[:, None, None] * 4
    levels = np.where(levels % 4 == 3, -1, levels).astype(np.float32)
    for name, image in zip(NAMES, levels):
        np.save(tmp_path / f"{name}_s.npy", image)
        np.save(tmp_path / f"{name}_f.npy", np.zeros((16, 512), np.float32))
    read, notes = load_proposals(tmp_path, NAMES, SIZE, level=level)
    for t, image in enumerate(levels[:, row]):
        np.testing.assert_array_equal(read(t), [image == number for number in np.unique(image[image >= 0])])
    assert notes == ()
    with refused("_s.npy", "single frame"):
        load_labels(tmp_path, NAMES, SIZE)


def test_too_many_regions(tmp_path):
    np.save(tmp_path / "b_s.npy", np.tile(np.arange(200 * 200, dtype=np.float32).reshape(200, 200), (4, 1, 1)))
    with refused("b_s.npy", "40000 ids"):
        load_proposals(tmp_path, ("b",), (200, 200))[0](0)
    (tmp_path / "b_s.npy").unlink()
    for number, name in enumerate(NAMES):
        np.save(tmp_path / f"{name}.npy", np.arange(12000).reshape(100, 120) + 12000 * number)
    with refused("35999 regions", "fewer frames"):
        load_labels(tmp_path, NAMES, (100, 120))


FRAME = (12, 16)


def ids_image():
    return RNG.choice([0, 1, 2, 3, 4], FRAME)


def photographs(*paths, size=(16, 12)):
    """Frames of a capture, named as `load_capture` names them."""
    names = [path.removesuffix(".jpg") for path in paths]
    stems = [name.rpartition("/")[2] for name in names]
    names = stems if len(set(stems)) == len(stems) else [name.replace("/", "_") for name in names]
    return {name: ImageFile(path, *size) for name, path in zip(names, paths)}


@pytest.mark.parametrize("folders", [("0", "1"), ("cam0", "cam1"), ("rig/left", "rig/right")])
@pytest.mark.parametrize("alike", [False, True])
@pytest.mark.parametrize("prefix", ["", "images/"])
def test_folders_like_those_of_the_images_are_cameras(tmp_path, folders, alike, prefix):
    paths = [f"{folders[n % 2]}/v{n // 2 if alike else n}" for n in range(4)]
    images = [ids_image() for _ in paths]
    for path, image in zip(paths, images):
        write_mask(tmp_path / f"{path}.png", image)
    files = photographs(*(f"{prefix}{path}.jpg" for path in paths))
    labels, ids, notes = load_labels(tmp_path, tuple(files), FRAME, frames=files)
    np.testing.assert_array_equal(labels, np.stack(images) - 1)
    assert (ids, notes) == ((1, 2, 3, 4), ())
    read, _ = load_proposals(tmp_path, tuple(files), FRAME, frames=files)
    np.testing.assert_array_equal(read(3), [images[3] == id for id in range(1, 5)])
    images = [255 * (RNG.random(FRAME) < 0.5) for _ in paths]  # one object
    for path, image in zip(paths, images):
        write_mask(tmp_path / f"{path}.png", image)
    labels, ids, _ = load_labels(tmp_path, tuple(files), FRAME, frames=files)
    np.testing.assert_array_equal(labels, np.stack(images) // 255 - 1)
    assert ids == (255,)


@pytest.mark.parametrize(("paths", "pattern"), [
    (("a.jpg", "b.jpg"), "{object}/{name}"), (("cam0/a.jpg", "cam1/a.jpg"), "{object}/{camera}/{name}"),
])  # fmt: skip
def test_other_folders_of_black_and_white_masks_are_objects(tmp_path, paths, pattern):
    files = photographs(*paths)
    masks = np.array([[255 * (RNG.random(FRAME) < 0.5) for _ in files] for _ in range(2)])
    for number, frames in enumerate(masks):
        for file, mask in zip(files.values(), frames):
            camera, _, name = file.path.removesuffix(".jpg").rpartition("/")
            write_mask(tmp_path / (pattern.format(object=number, camera=camera, name=name) + ".png"), mask)
    (labels, ids, notes), parent = load_nested_labels(tmp_path, tuple(files), FRAME, frames=files)
    assert ids == (1, 2)
    assert (parent == -1).all()  # of objects that overlap by chance
    np.testing.assert_array_equal(labels, np.where(masks[0] > 0, 0, np.where(masks[1] > 0, 1, -1)))
    assert any("objects" in note for note in notes)
    read, _ = load_proposals(tmp_path, tuple(files), FRAME, frames=files)
    np.testing.assert_array_equal(read(1), masks[:, 1] > 0)


def test_objects_are_in_some_of_the_frames_in_their_order_and_the_lower_id_lies_on_top(tmp_path):
    low, high = np.zeros((2, *FRAME), bool)
    low[1:8, 2:9] = high[5:11, 6:14] = True
    for frame, folder, mask in (("b", "obj_10", high), ("c", "obj_09", low), ("c", "obj_10", high)):
        write_mask(tmp_path / folder / f"{frame}.png", 255 * mask)
    (tmp_path / "other").mkdir()
    labels, ids, notes = load_labels(tmp_path, tuple("bcf"), FRAME)
    assert ids == (1, 2)
    np.testing.assert_array_equal(labels[0] == 1, high)
    np.testing.assert_array_equal(labels[1], np.where(low, 0, np.where(high, 1, -1)))
    assert (labels[2] == -1).all()
    assert "1 of 3 frames" in notes[0]
    assert any("obj_09, obj_10" in note for note in notes)


@pytest.mark.parametrize("width", [5, 16, 23, 31, 32, 47, 80])
def test_resizing_takes_the_value_at_each_centre(tmp_path, width):
    image = RNG.integers(1, 9, (12 * width // 16 or 1, width))
    write_mask(tmp_path / "a.png", image)
    labels, ids, _ = load_labels(tmp_path, ("a",), FRAME)
    rows = np.floor((np.arange(12) + 0.5) * len(image) / 12).astype(int)
    columns = np.floor((np.arange(16) + 0.5) * width / 16).astype(int)
    np.testing.assert_array_equal(np.array(ids)[labels[0]], image[rows[:, None], columns])


@pytest.mark.parametrize(("frame", "file"), [
    ("a", "a.PNG"), ("frame.0001", "frame.0001.png"), ("frame.0001", "frame.0001.jpg.png"), ("a", "a.JPG.Png"),
    ("cam0_a", "cam0/a.png"), ("cam0_a", "cam0_a.png"),
])  # fmt: skip
def test_what_a_mask_may_be_called(tmp_path, frame, file):
    image = ids_image()
    write_mask(tmp_path / file, image)
    write_mask(tmp_path / "b.png", image)
    files = photographs(*(("cam0/a.jpg", "cam1/a.jpg") if frame == "cam0_a" else (f"{frame}.jpg",)), "b.jpg")
    labels, _, notes = load_labels(tmp_path, (frame, "b"), FRAME, frames=files)
    np.testing.assert_array_equal(labels, np.stack([image, image]) - 1)
    assert not notes


def test_masks_of_no_frame_and_kinds_that_are_not_read_are_named(tmp_path):
    for name in "abc":
        write_mask(tmp_path / f"{name}.png", ids_image())
    with refused(tmp_path, "no mask called like a frame"):
        load_labels(tmp_path, ("d",), FRAME, frames=dict.fromkeys("abd"))
    for name in ("d.jpg", "d.tif"):
        write_mask(tmp_path / name[2:] / name, ids_image())
        with refused(f"{name} is no PNG"):
            load_labels(tmp_path / name[2:], ("d",), FRAME)


def test_arrays_with_negative_numbers(tmp_path):
    """-1 = none: then 0 is an id, in all."""
    image = ids_image()
    np.save(tmp_path / "a.npy", image)
    np.save(tmp_path / "b.npy", image - 1)
    labels, ids, _ = load_labels(tmp_path, ("a", "b"), FRAME)
    np.testing.assert_array_equal(labels, [image, image - 1])
    assert ids == (0, 1, 2, 3, 4)


SQUARE = [1, 1, 9, 1, 9, 9, 1, 9]
HOLE = [3, 3, 7, 3, 7, 7, 3, 7]
APART = [11, 2, 14, 2, 14, 6, 11, 6]
OVER = [8, 4, 12, 4, 12, 5, 8, 5]


@pytest.mark.parametrize("polygons", [[SQUARE], [SQUARE, APART, OVER], [SQUARE, SQUARE], [HOLE, SQUARE]])
def test_polygons_are_filled_and_add_up(tmp_path, polygons):
    """As in COCO's own tools: a hole within is none."""
    (tmp_path / "a.json").write_text(json.dumps([{"segmentation": polygons}, {"segmentation": [APART]}]))
    read, _ = load_proposals(tmp_path, ("a",), FRAME)
    expected = np.zeros((2, *FRAME), bool)
    for mask, boxes in zip(expected, (polygons, [APART])):
        for x, y, _, _, right, below, *_ in boxes:
            mask[y : below + 1, x : right + 1] = True
    np.testing.assert_array_equal(read(0), expected)


def test_one_coco_file_of_all_frames(tmp_path):
    names, shapes = ("a", "b", "other"), ((7, SQUARE), (7, APART), (9, SQUARE))
    images = [{"id": 7 + n, "file_name": f"{name}.jpg", "height": 24, "width": 32} for n, name in enumerate(names)]
    annotations = [{"image_id": image, "segmentation": [shape], "category_id": 1} for image, shape in shapes]
    content = {"images": images, "annotations": annotations, "categories": [{"id": 1, "name": "thing"}]}
    (tmp_path / "instances.json").write_text(json.dumps(content))
    mask = np.zeros((24, 32), np.uint8)
    cv2.fillPoly(mask, [np.array(SQUARE).reshape(-1, 2)], 1)
    for place in (tmp_path, tmp_path / "instances.json"):
        read, notes = load_proposals(place, ("a", "b", "c"), FRAME)
        assert read(0).shape == (2, *FRAME)
        np.testing.assert_array_equal(read(0)[0], mask[1::2, 1::2])
        assert read(1).shape == read(2).shape == (0, *FRAME)
        assert notes == ("1 of 3 frames have no masks (the first: c).",)
    with refused("instances.json", "none of its 3 images"):
        load_proposals(tmp_path, ("x",), FRAME)


def things(shift=0):
    """(60, 80) ids 0 to 4: three discs and a bar on a background."""
    image = np.zeros((60, 80), np.int32)
    for number, centre in enumerate([(15, 20), (40, 18), (62, 22)], start=1):
        cv2.circle(image, (centre[0] + shift, centre[1]), 9, number, -1)
    image[40:52, 10:70] = 4
    return image


def outlined(image):
    """Where neighbours differ."""
    small = image.astype(np.uint8)
    return cv2.dilate(small, np.ones((3, 3))) != cv2.erode(small, np.ones((3, 3)))


@pytest.mark.parametrize("kind", ["8 bits", "16 bits", "around", "in one frame"])
def test_an_id_to_ignore_is_no_region(tmp_path, kind):
    """The largest of its type: on outlines, or on all that is no thing."""
    names, plain = ("a", "b", "c"), [things(shift) for shift in range(3)]
    for name, ids in zip(names, plain):
        void = 65535 if kind == "16 bits" else 255
        marked = np.where(ids == 0 if kind == "around" else outlined(ids), void, ids.astype(np.int64))
        marked = ids if kind == "in one frame" and name != "b" else marked
        cv2.imwrite(str(tmp_path / f"{name}.png"), marked.astype(np.uint16 if void > 255 else np.uint8))
    labels, ids, notes = load_labels(tmp_path, names, (60, 80))
    assert len(ids) == 4
    assert len(notes) == 1
    assert "counts as unlabelled" in notes[0]
    inner = ~np.stack([outlined(image) for image in plain])
    assert ((labels >= 0) == (np.stack(plain) > 0))[inner].all()
    assert len(load_proposals(tmp_path, names, (60, 80))[0](2)) == 4


@pytest.mark.parametrize("kind", ["alone", "far", "even steps", "a thing"])
def test_the_largest_number_may_be_a_thing(tmp_path, kind):
    tables = {"alone": [0, 0, 0, 0, 255], "even steps": [0, 64, 128, 192, 255], "far": [0, 1, 2, 3, 255]}
    for name in "ab":
        image = things()
        ids = np.array(tables.get(kind, [0, 1, 2, 3, 255]))[image]
        if kind == "a thing":
            ids[26:41, 38:44] = 255  # touches one of three
        cv2.imwrite(str(tmp_path / f"{name}.png"), ids.astype(np.uint8))
    _, ids, notes = load_labels(tmp_path, ("a", "b"), (60, 80))
    assert ids[-1] == 255
    assert notes == ()


def test_many_more_ids_than_things_are_hinted_at(tmp_path):
    """Ids that are numbered anew in each frame."""
    names = tuple(f"f{n:02d}" for n in range(14))
    for number, name in enumerate(names):
        ids = things()
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.where(ids, ids + 4 * number, 0).astype(np.uint8))
    _, ids, notes = load_labels(tmp_path, names, (60, 80))
    assert len(ids) == 56
    assert "--proposals" in notes[0]
