"""Masks from disk: matched by name, compacted over the frames, every change said, every misfit told."""

import json

import cv2
import numpy as np
import pytest
from capture_files import png, refused

from experiments.datasets.feature_files import load_text_features, write_features, write_text_features
from jsecon.read.captures.images import write_image
from jsecon.read.masks.masks import LEVELS, embedding_size, load_features, load_labels
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
    """Frames are in another order than their files."""
    images = IDS * (1 if dtype == np.uint8 else 250)
    write_masks(tmp_path, images, dtype=dtype)
    calls = []
    labels, ids, notes = load_labels(tmp_path, NAMES, SIZE, progress=lambda *call: calls.append(call))
    expected, expected_ids = slow(images)
    np.testing.assert_array_equal(labels, expected)
    assert labels.dtype == np.int16
    assert ids == expected_ids
    assert notes == ()
    assert calls == [(1, 3), (2, 3), (3, 3)]


def test_colours_are_ids_and_indices_of_a_palette_are_too(tmp_path):
    """Palettes as DAVIS and its trackers write them; this one repeats colours on purpose."""
    indices = RNG.integers(0, 4, (3, *SIZE))
    for name, image in zip(NAMES, indices):
        (tmp_path / f"{name}.png").write_bytes(png(image, bits=2, colour_type=3, palette=bytes([0, 0, 0, 9, 9, 9] * 2)))
    labels, ids, _ = load_labels(tmp_path, NAMES, SIZE)
    np.testing.assert_array_equal(labels, slow(indices)[0])
    assert ids == (1, 2, 3)
    palette = np.array([[0, 0, 0], [255, 0, 0], [0, 0, 255], [1, 2, 3]], np.uint8)
    for name, image in zip(NAMES, indices):
        write_image(tmp_path / f"{name}.png", palette[image])
    labels, ids, _ = load_labels(tmp_path, NAMES, SIZE)
    np.testing.assert_array_equal(labels, slow(palette[indices].astype(int) @ [65536, 256, 1])[0])
    assert ids == (255, 66051, 16711680)


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
    assert "1 of 3 frames have no masks (the first: a)" in notes[0]


def test_no_mask_at_all_and_a_damaged_one(tmp_path):
    with refused(tmp_path, "0 masks", "b.png"):
        load_labels(tmp_path, NAMES, SIZE)
    write_masks(tmp_path, IDS, ("0000", "0001", "0002"))
    with refused(tmp_path, "3 masks, none of which is called like a frame"):
        load_labels(tmp_path, NAMES, SIZE)
    with refused("nowhere", "no such folder"):
        load_labels(tmp_path / "nowhere", NAMES, SIZE)
    write_masks(tmp_path, IDS)
    (tmp_path / "a.png").write_bytes((tmp_path / "a.png").read_bytes()[:-20])
    with refused("a.png", "cannot be read"):
        load_labels(tmp_path, NAMES, SIZE)


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
    # 1000x667 shrunk to a tenth is 100x67: off by a pixel of the smaller, by five of the larger.
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
    labels, ids, notes = load_labels(tmp_path, NAMES, SIZE, level=level)
    first = 0
    for found, image in zip(labels, chosen):
        expected, expected_ids = slow(image[None], -1)
        np.testing.assert_array_equal(found, np.where(expected[0] >= 0, expected[0] + first, -1))
        first += len(expected_ids)
    assert ids == tuple(range(first))
    assert len(notes) == 1


def test_langsplat_misfits(tmp_path):
    path = tmp_path / "b_s.npy"
    np.save(path, np.zeros((3, *SIZE)))
    with refused("b_s.npy", "shape is (3, 12, 18)"):
        load_labels(tmp_path, NAMES, SIZE)
    np.save(path, np.full((4, *SIZE), 0.5))
    with refused("b_s.npy", "no integers"):
        load_labels(tmp_path, NAMES, SIZE)
    np.save(path, np.zeros((4, *SIZE)))
    with refused("level", "'xl'"):
        load_labels(tmp_path, NAMES, SIZE, level="xl")
    for length in (300, 0):
        path.write_bytes(path.read_bytes()[:length])
        with refused("b_s.npy", "cannot be read"):
            load_labels(tmp_path, NAMES, SIZE)
    write_masks(tmp_path, IDS)
    with refused("there are both"):
        load_labels(tmp_path, NAMES, SIZE)


def test_too_many_regions(tmp_path):
    np.save(tmp_path / "b_s.npy", np.tile(np.arange(200 * 200, dtype=np.float32).reshape(200, 200), (4, 1, 1)))
    with refused("b_s.npy", "40000 ids"):
        load_labels(tmp_path, ("b",), (200, 200))
    for name in NAMES:
        np.save(tmp_path / f"{name}_s.npy", np.tile(np.arange(12000.0).reshape(100, 120), (4, 1, 1)))
    with refused("36000 regions", "coarser level"):
        load_labels(tmp_path, NAMES, (100, 120))


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
    with refused("frame_2_s.npy", "no such file"):
        load_features(folder, ["frame_0", "frame_2"], (12, 16))
    assert embedding_size(folder) == 5
    for wrong, said in ((rows[1][:2], "(2, 5) for ids up to 2"), (rows[1][:, :4], "rows of 4 numbers")):
        np.save(folder / "frame_1_f.npy", wrong)
        with refused("frame_1_f.npy", said):
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
