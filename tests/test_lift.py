"""From an outline to Gaussians: what is seen follows the outline, what is not the field's regions."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_field import REGIONS, true_regions

from jsecon import InputError, region_votes
from jsecon.query.pointing import OUTSIDE, PRIOR_PX, UNKNOWN, lift


def seen(field, t):
    gaussians, camera = jax.tree.map(jnp.asarray, (field.gaussians, field.cameras[t : t + 1]))
    blank = jnp.zeros((1, field.cameras.height, field.cameras.width), jnp.int32)
    return np.asarray(region_votes(gaussians, camera, blank, 1).total)


def test_a_mask_finds_its_region_and_what_the_frame_does_not_see_of_it(made):
    field, labels = made
    own = true_regions(field.gaussians)
    hidden = seen(field, 0) == 0
    for region in range(REGIONS):
        found = lift(field, np.where(labels[:1] < 0, UNKNOWN, labels[:1] == region), [0])
        assert int(found.region) == region
        assert 0.5 < float(found.score) <= 1
        share = np.asarray(found.similarity)
        assert share[own == region].mean() > share[own != region].mean() + 0.2
        if (hidden & (own == region)).any():
            assert share[hidden & (own == region)].max() > 0.3
    assert int(lift(field, np.where(labels[:3] < 0, UNKNOWN, labels[:3] == 2), [field.names[0], 1, 2]).region) == 2


def test_the_share_is_that_of_the_weights_and_the_regions_word(made):
    field, labels = made
    mask = labels[:1] == 1
    found = lift(field, mask, [0])
    gaussians, camera = jax.tree.map(jnp.asarray, (field.gaussians, field.cameras[:1]))
    votes = np.asarray(region_votes(gaussians, camera, jnp.asarray(mask.astype(np.int32)), 2, top=2).dense())
    low = votes[:, 1] / (votes.sum(1) + PRIOR_PX)
    high = (votes[:, 1] + PRIOR_PX) / (votes.sum(1) + PRIOR_PX)
    share = np.asarray(found.similarity)
    assert (share >= low - 1e-5).all()
    assert (share <= high + 1e-5).all()
    np.testing.assert_array_equal(np.asarray(found.mask), share >= 0.5)


def test_without_a_region_there_the_outline_alone_decides(made):
    field, labels = made
    half = (labels[:1] == 0) & (np.arange(labels.shape[2]) < 20)  # part of a region
    found = lift(field, half, [0])
    share = np.asarray(found.similarity)
    assert int(found.region) == -1
    assert share.max() > 0.3
    assert not share[seen(field, 0) == 0].any()


def test_of_a_box_only_the_outside_is_known(made):
    field, labels = made
    rows, columns = np.nonzero(labels[0] == 1)
    box = np.full(labels[0].shape, OUTSIDE)
    box[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1] = UNKNOWN
    found = lift(field, box[None], [0])
    assert np.asarray(found.mask).any()


def test_odd_input_is_refused(made):
    field, labels = made
    with pytest.raises(InputError, match="no pixel inside"):
        lift(field, np.zeros_like(labels[:1]), [0])
    with pytest.raises(ValueError, match="of the frames as the run used them"):
        lift(field, labels[:1, :5] == 0, [0])
    with pytest.raises(ValueError, match="with 2 frames"):
        lift(field, labels[:1] == 0, [0, 1])
    for frame in (99, -1, "nowhere"):
        with pytest.raises(InputError, match="no such frame"):
            lift(field, labels[:1] == 0, [frame])
    blind = dataclasses.replace(field, votes=dataclasses.replace(field.votes, weights=field.votes.weights * jnp.nan))
    assert np.isfinite(np.asarray(lift(blind, labels[:1] == 0, [0]).similarity)).all()
