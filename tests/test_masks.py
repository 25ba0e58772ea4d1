"""A selection's mask: only the selected Gaussians, whatever stands before them, against a rendering of them cut out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jsecon import plan_capacity, render
from jsecon.query.selection_masks import render_selection, selection_mask


def cut_out(scene, chosen):
    return jax.tree.map(lambda a: jnp.asarray(a)[np.flatnonzero(chosen)], scene)


def test_equals_rendering_the_subset_cut_out(scene, cameras):
    chosen = np.random.default_rng(0).random(64) < 0.4
    similarity = np.random.default_rng(1).uniform(0.2, 1, 64).astype(np.float32)
    subset = cut_out(scene, chosen)
    for view in range(2):
        camera = cameras[view]
        expected = render(subset, camera, jnp.asarray(similarity[chosen])[:, None])
        got = render_selection(scene, camera, chosen, similarity)
        np.testing.assert_allclose(got.alpha, expected.alpha, atol=1e-6)
        np.testing.assert_allclose(got.features[..., :1], expected.features, atol=1e-6)
        assert int(got.overflow) == 0
        for threshold in (0.7, 10 / 255):
            mask = np.asarray(selection_mask(scene, camera, chosen, threshold=threshold))
            clear = np.abs(np.asarray(expected.alpha) - threshold) > 1e-5
            assert (mask == (np.asarray(expected.alpha) > threshold))[clear].all()
    assert mask.any()
    assert not mask.all()


def test_nothing_and_everything_and_a_mask_of_another_length(scene, camera):
    assert not np.asarray(selection_mask(scene, camera, np.zeros(64, bool))).any()
    everything = render(jax.tree.map(jnp.asarray, scene), camera, jnp.ones((64, 1))).alpha
    np.testing.assert_array_equal(selection_mask(scene, camera, np.ones(64, bool)), np.asarray(everything) > 0.7)
    with pytest.raises(ValueError, match=r"expected \(64,\)"):
        selection_mask(scene, camera, np.ones(63, bool))


def test_gaussians_that_are_not_finite_leave_the_mask_alone(scene, camera):
    chosen = np.arange(64) < 20
    broken = jax.tree.map(np.array, scene)
    broken.means[5], broken.opacity_logits[6], broken.means[40] = np.nan, np.nan, np.inf
    kept = chosen & ~np.isin(np.arange(64), (5, 6))
    np.testing.assert_array_equal(selection_mask(broken, camera, chosen), selection_mask(scene, camera, kept))


def test_under_jit_and_vmap_over_selections(scene, camera):
    chosen = np.stack([np.arange(64) < 20, np.arange(64) >= 30])
    capacity = plan_capacity(scene, camera)
    scene, camera = jax.tree.map(jnp.asarray, (scene, camera))
    got = jax.jit(jax.vmap(lambda mask: selection_mask(scene, camera, mask, capacity=capacity)))(chosen)
    for row, mask in zip(got, chosen, strict=True):
        np.testing.assert_array_equal(row, selection_mask(scene, camera, mask))
