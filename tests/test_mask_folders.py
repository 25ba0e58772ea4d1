"""Folders of masks: which are cameras and which objects, how files may be called."""

import json

import cv2
import numpy as np
import pytest
from capture_files import refused

from jsecon.read.masks.masks import load_features, load_labels, load_proposals
from jsecon.types import ImageFile

SIZE = (12, 16)
RNG = np.random.default_rng(5)


def write(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.asarray(image, np.uint8 if np.max(image) < 256 else np.uint16))


def ids_image():
    return RNG.choice([0, 1, 2, 3, 4], SIZE)


def black_and_white():
    return 255 * (RNG.random(SIZE) < 0.5)


def photographs(*paths, size=(16, 12)):
    """Frames of a capture, named as `load_capture` names them."""
    stems = [path.rsplit("/")[-1].removesuffix(".jpg") for path in paths]
    whole = [path.removesuffix(".jpg").replace("/", "_") for path in paths]
    names = stems if len(set(stems)) == len(stems) else whole
    return {name: ImageFile(path, *size) for name, path in zip(names, paths)}


def expected(*images):
    """Labels of ids 1 to 4 that all occur."""
    return np.stack(images).astype(int) - 1


@pytest.mark.parametrize("folders", [("0", "1"), ("cam0", "cam1"), ("rig/left", "rig/right")])
@pytest.mark.parametrize("alike", [False, True])
@pytest.mark.parametrize("prefix", ["", "images/"])
def test_folders_like_those_of_the_images_are_cameras(tmp_path, folders, alike, prefix):
    paths = [f"{folders[n % 2]}/v{n // 2 if alike else n}" for n in range(4)]
    images = [ids_image() for _ in paths]
    for path, image in zip(paths, images):
        write(tmp_path / f"{path}.png", image)
    files = photographs(*(f"{prefix}{path}.jpg" for path in paths))
    labels, ids, notes = load_labels(tmp_path, tuple(files), SIZE, frames=files)
    np.testing.assert_array_equal(labels, expected(*images))
    assert ids == (1, 2, 3, 4)
    assert notes == ()
    read, _ = load_proposals(tmp_path, tuple(files), SIZE, frames=files)
    for t, image in enumerate(images):
        np.testing.assert_array_equal(read(t), [image == id for id in range(1, 5)])
    images = [black_and_white() for _ in paths]  # one object
    for path, image in zip(paths, images):
        write(tmp_path / f"{path}.png", image)
    labels, ids, _ = load_labels(tmp_path, tuple(files), SIZE, frames=files)
    np.testing.assert_array_equal(labels, np.stack(images) // 255 - 1)
    assert ids == (255,)


@pytest.mark.parametrize(
    ("paths", "pattern"),
    [
        (("a.jpg", "b.jpg"), "{object}/{name}"),
        (("cam0/a.jpg", "cam1/a.jpg"), "{object}/{camera}/{name}"),
        (("cam0/a.jpg", "cam1/a.jpg"), "{camera}/{object}/{name}"),
    ],
)
def test_other_folders_of_black_and_white_masks_are_objects(tmp_path, paths, pattern):
    files = photographs(*paths)
    masks = np.array([[black_and_white() for _ in files] for _ in range(2)])
    for number, frames in enumerate(masks):
        for file, mask in zip(files.values(), frames):
            camera, _, name = file.path.removesuffix(".jpg").rpartition("/")
            write(tmp_path / (pattern.format(object=number, camera=camera, name=name) + ".png"), mask)
    labels, ids, notes = load_labels(tmp_path, tuple(files), SIZE, frames=files)
    assert ids == (1, 2)
    np.testing.assert_array_equal(labels, np.where(masks[0] > 0, 0, np.where(masks[1] > 0, 1, -1)))
    assert any("objects" in note for note in notes)
    read, _ = load_proposals(tmp_path, tuple(files), SIZE, frames=files)
    np.testing.assert_array_equal(read(1), [masks[0, 1] > 0, (masks[1, 1] > 0) & (masks[0, 1] == 0)])


def test_objects_called_by_words_are_numbered_and_those_of_many_values_refused(tmp_path):
    masks = {"mug": np.eye(12, 16), "bowl": 1 - np.eye(12, 16)}
    for folder, mask in masks.items():
        write(tmp_path / folder / "a.png", 255 * mask)
    labels, ids, notes = load_labels(tmp_path, ("a",), SIZE)
    assert ids == (1, 2)
    np.testing.assert_array_equal(labels[0], masks["mug"])
    assert any("bowl, mug" in note for note in notes)
    write(tmp_path / "mug" / "a.png", ids_image())
    with refused("a.png", "4 values", "mug"):
        load_labels(tmp_path, ("a",), SIZE)


def test_objects_are_in_some_of_the_frames_and_the_lower_id_lies_on_top(tmp_path):
    low, high = np.zeros((2, *SIZE), bool)
    low[1:8, 2:9] = high[5:11, 6:14] = True
    for name in "bce":
        write(tmp_path / "002" / f"{name}.png", 255 * low)
    write(tmp_path / "010" / "c.png", 255 * high)
    (tmp_path / "other").mkdir()
    (tmp_path / "011").mkdir()
    labels, ids, notes = load_labels(tmp_path, tuple("bcef"), SIZE)
    assert ids == (1, 2)
    np.testing.assert_array_equal(labels[1], np.where(low, 0, np.where(high, 1, -1)))
    np.testing.assert_array_equal(labels[0] == 0, low)
    assert (labels[3] == -1).all()
    assert "1 of 4 frames" in notes[0]
    write(tmp_path / "010" / "b.png", 255 * high[:6])
    with refused("b.png", "16x12"):
        load_labels(tmp_path, tuple("bcef"), SIZE)


def test_objects_keep_their_order_whichever_frame_shows_them_first(tmp_path):
    for frame, folder in (("a", "obj_10"), ("b", "obj_9"), ("b", "obj_10")):
        write(tmp_path / folder / f"{frame}.png", np.full(SIZE, 255))
    labels, ids, _ = load_labels(tmp_path, ("a", "b"), SIZE)
    assert ids == (1, 2)
    assert (labels[0] == 1).all()
    assert (labels[1] == 0).all()


@pytest.mark.parametrize("width", [5, 16, 23, 31, 32, 47, 80])
def test_resizing_takes_the_value_at_each_centre(tmp_path, width):
    image = RNG.integers(1, 9, (12 * width // 16 or 1, width))
    write(tmp_path / "a.png", image)
    labels, ids, _ = load_labels(tmp_path, ("a",), SIZE)
    rows = np.floor((np.arange(12) + 0.5) * len(image) / 12).astype(int)
    columns = np.floor((np.arange(16) + 0.5) * width / 16).astype(int)
    np.testing.assert_array_equal(np.array(ids)[labels[0]], image[rows[:, None], columns])


@pytest.mark.parametrize(("frame", "file"), [
    ("a", "a.PNG"), ("frame.0001", "frame.0001.png"), ("frame.0001", "frame.0001.jpg.png"), ("a", "a.JPG.Png"),
    ("a", "a_mask.png"), ("frame.0001", "frame.0001_masks.png"), ("0001", "mask_0001.png"), ("a", "a.jpg_mask.png"),
    ("cam0_a", "cam0/a.png"), ("cam0_a", "cam0_a.png"),
])  # fmt: skip
def test_what_a_mask_may_be_called(tmp_path, frame, file):
    image = ids_image()
    write(tmp_path / file, image)
    write(tmp_path / "b.png", image)
    files = photographs("cam0/a.jpg", "cam1/a.jpg", "b.jpg") if frame == "cam0_a" else {}
    labels, _, notes = load_labels(tmp_path, (frame, "b"), SIZE, frames=files or None)
    np.testing.assert_array_equal(labels, expected(image, image))
    assert not notes


def test_masks_of_no_frame_are_told(tmp_path):
    for name in "abc":
        write(tmp_path / f"{name}.png", ids_image())
    _, _, notes = load_labels(tmp_path, ("b",), SIZE, frames=dict.fromkeys("ab"))
    assert len(notes) == 1
    assert "1 of the .png files" in notes[0]
    assert "c.png" in notes[0]
    with refused(tmp_path, "none of the 1 frames"):
        (tmp_path / "b.png").unlink()
        load_labels(tmp_path, ("b",), SIZE, frames=dict.fromkeys("ab"))


def test_kinds_that_are_not_read_are_named(tmp_path):
    write(tmp_path / "a.jpg", ids_image())
    with refused("a.jpg", ".jpg", "PNG"):
        load_labels(tmp_path, ("a",), SIZE)
    (tmp_path / "a.jpg").rename(tmp_path / "a.tif")
    with refused("a.tif", ".tif"):
        load_labels(tmp_path, ("a",), SIZE)
    with refused("a.tif", "file"):
        load_labels(tmp_path / "a.tif", ("a",), SIZE)


def test_arrays_of_ids(tmp_path):
    image = ids_image()
    np.save(tmp_path / "a.npy", image)
    np.save(tmp_path / "b.npy", image.astype(np.uint16)[None])
    labels, ids, notes = load_labels(tmp_path, ("a", "b"), SIZE)
    np.testing.assert_array_equal(labels, expected(image, image))
    assert (ids, notes) == ((1, 2, 3, 4), ())
    np.save(tmp_path / "b.npy", image - 1)  # -1 = none: then 0 is an id, in all
    labels, ids, notes = load_labels(tmp_path, ("a", "b"), SIZE)
    np.testing.assert_array_equal(labels, [image, image - 1])
    assert ids == (0, 1, 2, 3, 4)
    assert "negative" in notes[0]


def test_masks_of_stored_pixels_are_turned_like_their_photographs(tmp_path):
    """A lies on its side (6: its stored pixels are turned clockwise), b stands on its head, c is upright."""
    upright = [ids_image() for _ in range(3)]
    files = {name: ImageFile(f"{name}.jpg", 16, 12, turn) for name, turn in zip("abc", (6, 3, 1))}
    for name, image in zip("abc", upright):
        write(tmp_path / f"{name}.png", image)
    labels, _, notes = load_labels(tmp_path, tuple("abc"), SIZE, frames=files)
    np.testing.assert_array_equal(labels, expected(*upright))
    assert notes == ()
    for name, image in zip("abc", (np.rot90(upright[0]), upright[1][::-1, ::-1], upright[2])):
        write(tmp_path / f"{name}.png", image.repeat(2, 0).repeat(2, 1))
    labels, _, notes = load_labels(tmp_path, tuple("abc"), SIZE, frames=files)
    np.testing.assert_array_equal(labels, expected(*upright))
    assert any("2 masks were of the stored pixels" in note for note in notes)
    read, _ = load_proposals(tmp_path, tuple("abc"), SIZE, frames=files)
    np.testing.assert_array_equal(read(1), [upright[1] == id for id in range(1, 5)])


def test_masks_of_photographs_of_another_aspect_follow_them(tmp_path):
    """Frames have one size: a portrait photograph is squeezed into it, and so is its mask."""
    image = ids_image().T
    write(tmp_path / "a.png", image)
    labels, _, _ = load_labels(tmp_path, ("a",), SIZE, frames={"a": ImageFile("a.jpg", 12, 16)})
    rows, columns = ((2 * np.arange(12) + 1) * 16 // 24), ((2 * np.arange(16) + 1) * 12 // 32)
    np.testing.assert_array_equal(labels[0], image[rows[:, None], columns] - 1)
    with refused("a.png", "12x16", "16x12"):
        load_labels(tmp_path, ("a",), SIZE)


SQUARE = [1, 1, 9, 1, 9, 9, 1, 9]
HOLE = [3, 3, 7, 3, 7, 7, 3, 7]
APART = [11, 2, 14, 2, 14, 6, 11, 6]
OVER = [8, 4, 12, 4, 12, 5, 8, 5]


def filled(*boxes):
    mask = np.zeros(SIZE, bool)
    for value, (x, y, _, _, right, below, *_) in boxes:
        mask[y : below + 1, x : right + 1] = value
    return mask


@pytest.mark.parametrize(
    ("polygons", "boxes"),
    [
        ([SQUARE], [(True, SQUARE)]),
        ([SQUARE, APART], [(True, SQUARE), (True, APART)]),
        ([SQUARE, APART, OVER], [(True, SQUARE), (True, APART), (True, OVER)]),
        ([SQUARE, SQUARE], [(True, SQUARE)]),
        ([HOLE, SQUARE], [(True, SQUARE)]),  # they add up, as in COCO's own tools
    ],
)
def test_polygons_are_filled(tmp_path, polygons, boxes):
    (tmp_path / "a.json").write_text(json.dumps([{"segmentation": polygons}, {"segmentation": [APART]}]))
    read, _ = load_proposals(tmp_path, ("a",), SIZE)
    np.testing.assert_array_equal(read(0), [filled(*boxes), filled((True, APART))])


def test_one_coco_file_of_all_frames(tmp_path):
    names, shapes = ("a", "b", "other"), ((7, SQUARE), (7, APART), (9, SQUARE))
    images = [{"id": 7 + n, "file_name": f"{name}.jpg", "height": 24, "width": 32} for n, name in enumerate(names)]
    annotations = [{"image_id": image, "segmentation": [shape], "category_id": 1} for image, shape in shapes]
    content = {"images": images, "annotations": annotations, "categories": [{"id": 1, "name": "thing"}]}
    (tmp_path / "instances.json").write_text(json.dumps(content))
    for place in (tmp_path, tmp_path / "instances.json"):
        read, notes = load_proposals(place, ("a", "b", "c"), SIZE)
        assert read(0).shape == (2, *SIZE)
        mask = np.zeros((24, 32), np.uint8)
        cv2.fillPoly(mask, [np.array(SQUARE).reshape(-1, 2)], 1)
        np.testing.assert_array_equal(read(0)[0], mask[1::2, 1::2])
        assert read(1).shape == read(2).shape == (0, *SIZE)
        assert notes == ("1 of 3 frames have no masks (the first: c).",)
    with refused("instances.json", "none of its 3 images"):
        load_proposals(tmp_path, ("x",), SIZE)
    del content["annotations"][0]["image_id"]
    (tmp_path / "instances.json").write_text(json.dumps(content))
    with refused("instances.json", "'image_id' is missing"):
        load_proposals(tmp_path, ("a",), SIZE)


def test_embeddings_lie_in_the_cameras_folders(tmp_path):
    files = photographs("cam0/a.jpg", "cam1/a.jpg")
    rows = RNG.normal(size=(2, 2, 3)).astype(np.float32)
    for n, camera in enumerate(("cam0", "cam1")):
        (tmp_path / camera).mkdir()
        np.save(tmp_path / camera / "a_s.npy", np.tile(np.arange(16) // 8, (4, 12, 1)).astype(np.float32))
        np.save(tmp_path / camera / "a_f.npy", rows[n])
    found = load_features(tmp_path, tuple(files), SIZE, frames=files)
    np.testing.assert_array_equal(found.frame, [0, 0, 1, 1])
    np.testing.assert_array_equal(found.embeddings, rows.reshape(4, 3))
    np.testing.assert_array_equal(found.labels[1, 0], np.arange(16) // 8 + 2)
