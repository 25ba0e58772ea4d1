"""Regions from labels: who holds which pixels of which mask, what that makes of the embeddings; and shared work."""

import dataclasses

import numpy as np

from experiments.baselines.evidence import Evidence, unit
from experiments.tables.association import ROWS, associated, overlaps
from jsecon.types import Camera


def test_overlaps_count_every_pixel():
    rng = np.random.default_rng(0)
    tracks, masks = rng.integers(-1, 3, (2, 5, 6)), rng.integers(-1, 4, (2, 5, 6))
    found = overlaps(tracks, masks, 4)
    for r in range(3):
        for m in range(4):
            assert found[r, m] == ((tracks == r) & (masks == m)).sum()


def test_a_region_is_the_mean_of_its_masks_by_pixels_or_by_views(scene):
    masks = np.full((2, 2, 5), -1, np.int32)
    masks[0, 0], masks[0, 1, :2], masks[1, 0, :3], masks[1, 1, :2] = 0, 1, 2, 2
    labels = np.full(masks.shape, -1, np.int32)
    labels[0, 0], labels[1, 0] = 0, 0  # five pixels of mask 0; three of mask 2 and two of none
    labels[0, 1], labels[1, 1] = 1, 2  # two of five pixels in a mask: hardly seen, twice
    embeddings = np.eye(3, 4, dtype=np.float32)
    one = np.ones(2, np.float32)
    cameras = Camera(np.tile(np.eye(4, dtype=np.float32), (2, 1, 1)), one, one, one, one, 5, 2)
    evidence = Evidence(scene, cameras, masks, embeddings, np.array([0, 0, 1]), labels)
    found = associated([evidence], labels)
    assert found.embeddings.shape == (ROWS, 4)
    np.testing.assert_array_equal(found.pixel_counts[:3], [[5, 5], [5, 0], [0, 5]])
    np.testing.assert_allclose(found.embeddings[0], unit(np.array([5.0, 0, 3, 0])), atol=1e-6)
    np.testing.assert_allclose(found.uniform_embeddings[0], unit(np.array([1.0, 0, 1, 0])), atol=1e-6)
    assert not found.embeddings[1:].any()
    assert not found.uniform_embeddings[1:].any()
    assert not found.pixel_counts[3:].any()
    once = np.array([0])
    upper = dataclasses.replace(evidence, masks=np.where(masks == 0, 0, -1), embeddings=np.eye(4)[3:], frame=once)
    both = associated([evidence, upper], labels)
    np.testing.assert_allclose(
        both.embeddings[0], unit(np.array([5.0, 0, 0, 5])), atol=1e-6
    )  # not the 3 of 10 in view 1
    assert not both.embeddings[1].any()  # two of ten pixels of the two levels
