"""Masks from disk: matched by name, compacted over the frames, every change said, every misfit told."""

import json

import cv2
import numpy as np
import pytest
from capture_files import png, refused

from experiments.datasets.feature_files import load_text_features, write_features, write_text_features
from jsecon.data.images import write_image
from jsecon.data.langsplat import embedding_size, load_features
from jsecon.data.masks import LEVELS, load_labels
from jsecon.errors import InputError
from jsecon.vision.protocols import CANONICAL

NAMES = ("b", "a", "c")
SIZE = (12, 18)
RNG = np.random.default_rng(11)
IDS = RNG.choice([0, 3, 7, 200], (3, *SIZE))


def write_masks(folder, images, names=NAMES, dtype=np.uint8):
    for name, image in zip(names, images):
        assert cv2.imwrite(str(folder / f"{name}.png"), np.asarray(image, dtype))


def slow(images, none=0):
    """Regions by sorted ids over all frames."""
    ids = sorted({int(value) for image in images for value in image.ravel()} - {none})
    table = {value: index for index, value in enumerate(ids)}
    labels = [[[table.get(int(value), -1) for value in row] for row in image] for image in images]
    return np.array(labels, np.int16), tuple(ids)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_integers(tmp_path, dtype):
    images = IDS * (1 if dtype == np.uint8 else 250)
    write_masks(tmp_path, images, dtype=dtype)
    labels, ids, notes = load_labels(tmp_path, NAMES, SIZE)
    expected, expected_ids = slow(images)
    np.testing.assert_array_equal(labels, expected)
    assert labels.dtype == np.int16
    assert ids == expected_ids
    assert notes == ()


def test_order_on_disk_does_not_matter(tmp_path):
    write_masks(tmp_path, IDS)
    swapped, _, _ = load_labels(tmp_path, ("a", "c", "b"), SIZE)
    np.testing.assert_array_equal(swapped, slow(IDS)[0][[1, 2, 0]])


def test_palette_indices_not_colours(tmp_path):
    """As DAVIS and its trackers write them; the palette repeats colours on purpose."""
    indices = RNG.integers(0, 4, (3, *SIZE))
    for name, image in zip(NAMES, indices):
        (tmp_path / f"{name}.png").write_bytes(png(image, bits=2, colour_type=3, palette=bytes([0, 0, 0, 9, 9, 9] * 2)))
    labels, ids, _ = load_labels(tmp_path, NAMES, SIZE)
    np.testing.assert_array_equal(labels, slow(indices)[0])
    assert ids == (1, 2, 3)


def test_colours_are_ids(tmp_path):
    palette = np.array([[0, 0, 0], [255, 0, 0], [0, 0, 255], [1, 2, 3]], np.uint8)
    indices = RNG.integers(0, 4, (3, *SIZE))
    for name, image in zip(NAMES, indices):
        write_image(tmp_path / f"{name}.png", palette[image])
    labels, ids, notes = load_labels(tmp_path, NAMES, SIZE)
    np.testing.assert_array_equal(labels, slow(palette[indices].astype(int) @ [65536, 256, 1])[0])
    assert ids == (255, 66051, 16711680)
    assert any("colour" in note for note in notes)
    write_masks(tmp_path, IDS[:1])
    with refused(tmp_path, "2 colour images among 3"):
        load_labels(tmp_path, NAMES, SIZE)


def test_colmap_names_and_precedence(tmp_path):
    write_masks(tmp_path, IDS, ("b.jpg", "a.JPG", "c"))
    write_masks(tmp_path, IDS[:1] * 0 + 5, ("c.jpg",))
    labels, _, _ = load_labels(tmp_path, NAMES, SIZE)
    np.testing.assert_array_equal(labels, slow(IDS)[0])


def test_missing_masks_leave_their_frames_unlabelled(tmp_path):
    write_masks(tmp_path, IDS[[0, 2]], ("b", "c"))
    labels, _, notes = load_labels(tmp_path, NAMES, SIZE)
    assert (labels[1] == -1).all()
    np.testing.assert_array_equal(labels[[0, 2]], slow(IDS[[0, 2]])[0])
    assert len(notes) == 1
    assert "1 of 3 frames have no mask (the first: a)" in notes[0]


def test_no_mask_at_all(tmp_path):
    with refused(tmp_path, "0 masks", "b.png"):
        load_labels(tmp_path, NAMES, SIZE)
    write_masks(tmp_path, IDS, ("0000", "0001", "0002"))
    with refused(tmp_path, "3 masks, none of which is called like a frame"):
        load_labels(tmp_path, NAMES, SIZE)
    with refused("nowhere", "no such folder"):
        load_labels(tmp_path / "nowhere", NAMES, SIZE)


def test_other_sizes(tmp_path):
    """The same aspect is resized by nearest; another one is told."""
    large = np.kron(IDS, np.ones((1, 4, 4), int))
    write_masks(tmp_path, large)
    labels, _, notes = load_labels(tmp_path, NAMES, SIZE)
    np.testing.assert_array_equal(labels, slow(IDS)[0])
    assert "3 masks were resized to 18x12" in notes[0]
    enlarged, _, _ = load_labels(tmp_path, NAMES, (96, 144))
    np.testing.assert_array_equal(enlarged, np.kron(slow(IDS)[0], np.ones((1, 8, 8), int)))
    write_masks(tmp_path, IDS.transpose(0, 2, 1))
    with refused("b.png", "12x18", "18x12"):
        load_labels(tmp_path, NAMES, SIZE)


def test_rounded_sizes_agree(tmp_path):
    """1000x667 shrunk to a tenth is 100x67: off by a pixel of the smaller, by five of the larger."""
    write_masks(tmp_path, np.ones((1, 67, 100)), ("b",))
    assert (load_labels(tmp_path, ("b",), (667, 1000)).labels == 0).all()


@pytest.mark.parametrize("level", LEVELS)
def test_langsplat_levels(tmp_path, level):
    levels = RNG.integers(-1, 4, (3, 4, *SIZE)) + np.arange(4)[:, None, None] * 4
    levels = np.where(levels % 4 == 3, -1, levels).astype(np.float32)
    for name, image in zip(NAMES, levels):
        np.save(tmp_path / f"{name}_s.npy", image)
        np.save(tmp_path / f"{name}_f.npy", np.zeros((16, 512), np.float32))
    chosen = levels[:, LEVELS.index(level)]
    labels, ids, notes = load_labels(tmp_path, NAMES, SIZE, level=level, shared=True)
    expected, expected_ids = slow(chosen, -1)
    np.testing.assert_array_equal(labels, expected)
    assert ids == expected_ids
    assert notes == ()


def test_langsplat_ids_are_a_frames_own(tmp_path):
    """Unless said otherwise, id 0 of one frame is not id 0 of another."""
    for name in NAMES:
        np.save(tmp_path / f"{name}_s.npy", np.tile(np.float32([0, 1, -1]), (4, 12, 6)))
    labels, ids, notes = load_labels(tmp_path, NAMES, SIZE)
    np.testing.assert_array_equal(labels[:, 0, :3], [[0, 1, -1], [2, 3, -1], [4, 5, -1]])
    assert ids == (0, 1, 0, 1, 0, 1)
    assert "regions of their own" in notes[0]


def test_langsplat_cuts_names_at_the_first_dot(tmp_path):
    np.save(tmp_path / "view_s.npy", np.zeros((4, *SIZE), np.float32))
    assert (load_labels(tmp_path, ("view.001",), SIZE).labels == 0).all()


def test_langsplat_misfits(tmp_path):
    path = tmp_path / "b_s.npy"
    np.save(path, np.zeros((3, *SIZE)))
    with refused("b_s.npy", "shape (3, 12, 18)"):
        load_labels(tmp_path, NAMES, SIZE)
    np.save(path, np.full((4, *SIZE), 0.5))
    with refused("b_s.npy", "no integers"):
        load_labels(tmp_path, NAMES, SIZE)
    np.save(path, np.zeros((4, *SIZE)))
    with refused("level", "'xl'"):
        load_labels(tmp_path, NAMES, SIZE, level="xl")
    path.write_bytes(path.read_bytes()[:300])
    with refused("b_s.npy", "damaged or missing"):
        load_labels(tmp_path, NAMES, SIZE)
    path.write_bytes(b"")
    with refused("b_s.npy", "damaged or missing"):
        load_labels(tmp_path, NAMES, SIZE)
    write_masks(tmp_path, IDS)
    with refused("both .png and _s.npy"):
        load_labels(tmp_path, NAMES, SIZE)


def test_too_many_regions(tmp_path):
    np.save(tmp_path / "b_s.npy", np.tile(np.arange(200 * 200, dtype=np.float32).reshape(200, 200), (4, 1, 1)))
    with refused("b_s.npy", "40000 ids"):
        load_labels(tmp_path, ("b",), (200, 200))
    for name in NAMES:
        np.save(tmp_path / f"{name}_s.npy", np.tile(np.arange(12000.0).reshape(100, 120), (4, 1, 1)))
    with refused("36000 regions", "shared=True"):
        load_labels(tmp_path, NAMES, (100, 120))
    assert len(load_labels(tmp_path, NAMES, (100, 120), shared=True).ids) == 12000


def test_damaged_mask_and_progress(tmp_path):
    write_masks(tmp_path, IDS)
    calls = []
    load_labels(tmp_path, NAMES, SIZE, progress=lambda *call: calls.append(call))
    assert calls == [(1, 3), (2, 3), (3, 3)]
    (tmp_path / "a.png").write_bytes((tmp_path / "a.png").read_bytes()[:-20])
    with refused("a.png", "damaged"):
        load_labels(tmp_path, NAMES, SIZE)


OBJECT_NAMES = ("b", "c", "e")
OBJECT_SIZE = (12, 16)


def write(path, mask):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), mask.astype(np.uint8))


@pytest.fixture
def masks():
    """Object 2 lies under object 10 in places."""
    found = np.zeros((2, *OBJECT_SIZE), bool)
    found[0, 1:8, 2:9] = found[1, 5:11, 6:14] = True
    return found


def test_objects_in_folders_of_their_own(tmp_path, masks):
    for name in OBJECT_NAMES:
        write(tmp_path / "002" / f"{name}.png", 255 * masks[0])
    write(tmp_path / "010" / "c.png", 255 * masks[1])
    (tmp_path / "other").mkdir()
    (tmp_path / "011").mkdir()
    labels, ids, notes = load_labels(tmp_path, (*OBJECT_NAMES, "f"), OBJECT_SIZE)
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
        load_labels(tmp_path, OBJECT_NAMES, OBJECT_SIZE)


def test_numbered_masks_are_taken_in_order_where_they_are_as_many_as_the_frames(tmp_path, masks):
    order = ("a", "b", "c", "d", "e")  # a and d are held out
    for n in range(5):
        write(tmp_path / f"{n:05}.png", (n + 1) * masks[0])
    labels, ids, notes = load_labels(tmp_path, OBJECT_NAMES, OBJECT_SIZE, order=order)
    assert ids == (2, 3, 5)
    for t in range(3):
        np.testing.assert_array_equal(labels[t] == t, masks[0])
    assert notes == ("The masks are numbered, and taken in the order of the frames: 00001.png is b.",)
    with pytest.raises(InputError, match="none of which"):
        load_labels(tmp_path, OBJECT_NAMES, OBJECT_SIZE)
    (tmp_path / "00003.png").unlink()
    with pytest.raises(InputError, match="a PNG for each number from 0 to 4"):
        load_labels(tmp_path, OBJECT_NAMES, OBJECT_SIZE, order=order)


@pytest.fixture
def written(tmp_path):
    rng = np.random.default_rng(0)
    labels = rng.integers(-1, 3, (2, 12, 16)).astype(np.int16)
    labels[1][labels[1] == 1] = 0  # mask 1 of the second frame is nowhere
    rows = rng.normal(size=(2, 3, 5)).astype(np.float32)
    for t in range(2):
        write_features(tmp_path, f"frame_{t}", labels[t], rows[t])
    return tmp_path, labels, rows


def test_masks_come_back_with_their_own_rows(written):
    folder, labels, rows = written
    for level in ("default", "l"):
        found = load_features(folder, ["frame_0", "frame_1"], (12, 16), level=level)
        np.testing.assert_array_equal(found.frame, [0, 0, 0, 1, 1])
        np.testing.assert_array_equal(found.labels >= 0, labels >= 0)
        for t in range(2):
            given = rows[t][labels[t]]
            shown = labels[t] >= 0
            np.testing.assert_array_equal(found.embeddings[found.labels[t]][shown], given[shown])
    assert not set(np.unique(found.labels[0])) & set(np.unique(found.labels[1])) - {-1}


def test_what_is_missing_or_disagrees_is_told(written):
    folder, _, rows = written
    with refused("frame_2_f.npy", "cannot be read"):
        load_features(folder, ["frame_0", "frame_2"], (12, 16))
    np.save(folder / "frame_1_f.npy", rows[1][:2])
    with refused("frame_1_f.npy", "(2, 5) for ids up to 2"):
        load_features(folder, ["frame_0", "frame_1"], (12, 16))


def test_frames_of_two_models_are_refused(written):
    folder, _, rows = written
    assert embedding_size(folder) == 5
    np.save(folder / "frame_1_f.npy", rows[1][:, :4])
    with refused("frame_1_f.npy", "rows of 4 numbers"):
        load_features(folder, ["frame_0", "frame_1"], (12, 16))


def test_a_folder_without_embeddings_is_refused(tmp_path):
    with refused(tmp_path, "no _f.npy"):
        embedding_size(tmp_path)
    (tmp_path / "a_f.npy").write_bytes(b"no array")
    with refused("a_f.npy", "cannot be read"):
        embedding_size(tmp_path)


def test_texts(tmp_path):
    vectors = np.random.default_rng(1).normal(size=(6, 4)).astype(np.float32)
    file = tmp_path / "text_features.json"
    write_text_features(file, ["mug", "ball", *CANONICAL], vectors)
    queries, canonical = load_text_features(file, ["ball", "mug"])
    np.testing.assert_allclose(queries, vectors[[1, 0]], atol=1e-6)
    np.testing.assert_allclose(canonical, vectors[2:], atol=1e-6)
    with refused(file, "no vector of spoon"):
        load_text_features(file, ["mug", "spoon"])
    table = json.loads(file.read_text())
    del table["texture"]
    file.write_text(json.dumps(table))
    with refused("texture"):
        load_text_features(file, ["mug"])
