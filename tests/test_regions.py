import jax
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from jsecon.field.regions import join_views, region_embeddings


def embed(frame, masks):
    """Mean colour and a constant, as unit vectors: an embedder simple enough to check by hand."""
    rows = [np.append(frame[m].mean(0), 50.0) if m.any() else np.zeros(4) for m in masks]
    rows = np.asarray(rows, np.float64).reshape(-1, 4)
    return (rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)).astype(np.float32)


def slow(frames, labels, count):
    """The definition, in float64 loops."""
    result = np.zeros((count, 4))
    for r in range(count):
        sizes = [(image == r).sum() for image in labels]
        for t, size in enumerate(sizes):
            if size:
                result[r] += size / sum(sizes) * embed(frames[t], (labels[t] == r)[None])[0].astype(np.float64)
        if any(sizes):
            result[r] /= np.linalg.norm(result[r])
    return result


def sequence(seed, count=5, frames=4):
    rng = np.random.default_rng(seed)
    return (
        rng.integers(0, 256, (frames, 6, 7, 3)).astype(np.uint8),
        rng.integers(-1, count, (frames, 6, 7)).astype(np.int16),
    )


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_equals_the_definition(seed):
    frames, labels = sequence(seed)
    regions = region_embeddings(frames, labels, embed, num_regions=7)
    np.testing.assert_allclose(regions.embeddings, slow(frames, labels, 7), atol=1e-6)
    np.testing.assert_array_equal(regions.pixel_counts, [[(image == r).sum() for image in labels] for r in range(7)])


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int64])
def test_invariant_to_the_order_of_frames_and_to_the_type_of_labels_and_equivariant_to_renaming(dtype):
    frames, labels = sequence(3)
    labels, told = np.maximum(labels, 0), []
    plain = region_embeddings(frames, labels, embed, progress=lambda done, total: told.append((done, total)))
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]
    turned = region_embeddings(frames[::-1], labels[::-1].astype(dtype), embed)
    np.testing.assert_allclose(turned.embeddings, plain.embeddings, atol=1e-6)
    np.testing.assert_array_equal(turned.pixel_counts[:, ::-1], plain.pixel_counts)
    name = np.random.default_rng(0).permutation(5)
    renamed = region_embeddings(frames, name[labels].astype(np.int16), embed)
    np.testing.assert_allclose(renamed.embeddings[name], plain.embeddings, atol=1e-6)


def test_views_that_are_not_chosen_are_not_embedded_and_their_pixels_still_count():
    frames, labels = sequence(5)
    views = np.random.default_rng(5).random((7, 4)) < 0.5
    views[3] = False
    crops = []
    found = region_embeddings(
        frames, labels, lambda f, m: crops.append(len(m)) or embed(f, m), num_regions=7, views=views
    )
    left = np.where(views[np.maximum(labels, 0), np.arange(4)[:, None, None]], labels, -1)
    np.testing.assert_allclose(found.embeddings, slow(frames, left, 7), atol=1e-6)
    np.testing.assert_array_equal(
        found.pixel_counts, region_embeddings(frames, labels, embed, num_regions=7).pixel_counts
    )
    assert sum(crops) == (views & (found.pixel_counts > 0)).sum()
    rest = region_embeddings(frames, labels, embed, num_regions=7, views=~views)
    every = region_embeddings(frames, labels, embed, num_regions=7)
    for joined, expected in zip(jax.tree.leaves(join_views(rest, found)), jax.tree.leaves(every), strict=True):
        np.testing.assert_array_equal(joined, expected)
    with pytest.raises(ValueError, match="views"):
        region_embeddings(frames, labels, embed, views=views)


def test_what_is_never_seen_is_zero_and_counts_nowhere():
    frames, labels = sequence(1)
    labels[labels == 2] = -1
    regions = region_embeddings(frames, labels, embed)
    assert not regions.embeddings[2].any()
    nothing = region_embeddings(frames, np.full_like(labels, -1), embed, num_regions=3)
    np.testing.assert_array_equal(nothing.embeddings, np.zeros((3, 4)))
    assert region_embeddings(frames, np.full_like(labels, -1), embed).embeddings.shape == (0, 4)
    none = region_embeddings(frames[:0], labels[:0], embed)
    assert (none.embeddings.shape, none.pixel_counts.shape) == ((0, 0), (0, 0))
    with pytest.raises(ValueError, match="num_regions"):
        region_embeddings(frames, labels, embed, num_regions=2)
    with pytest.raises(ValueError, match="labels"):
        region_embeddings(frames, labels[:, 1:], embed)
