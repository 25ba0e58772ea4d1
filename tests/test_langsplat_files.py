"""Per-frame masks with embeddings, and texts, as LangSplat and OpenGaussian keep them."""

import json

import numpy as np
import pytest
from capture_files import refused

from experiments.datasets.feature_files import load_text_features, write_features, write_text_features
from jsecon.data.langsplat import (
    embedding_size,
    load_features,
)
from jsecon.vision.protocols import CANONICAL


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
