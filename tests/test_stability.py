"""Every row of tests/stability within its stated bound, no bound wider than float32 needs, and what happens to
numbers that are none beyond those rows."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference import weights_reference
from stability.case import GRADIENT, VALUE, ordinary
from stability.cases import CANCELS, cases
from stability.measure import evaluate
from stability.render import engine

from jsecon.splat.project import count_non_finite, is_usable
from jsecon.splat.render import render, render_depth, render_rgb

CAPACITY = 64 * 30
CASES = cases()
COMPILED_TOGETHER = len(ordinary().gaussians.means), 48, 40
"""rows of this many Gaussians and pixels share their programs, which are compiled as users run them; others are long"""
SIZES = [(case.gaussians.count, case.camera.width, case.camera.height) for case in CASES]
MARKS = [pytest.mark.as_shipped if size == COMPILED_TOGETHER else pytest.mark.long for size in SIZES]
ROWS = [pytest.param(case, marks=mark, id=case.name) for case, mark in zip(CASES, MARKS, strict=True)]


@pytest.mark.parametrize("case", ROWS)
def test_row(case):
    row = evaluate(case, ulp=bool(case.bounds))
    assert row.overflow == 0
    assert row.value_finite
    assert row.contained
    assert row.gradient_finite
    allowed = case.bounds.get("value", VALUE)
    assert row.value_error <= allowed
    assert row.doubtful_error <= allowed
    for name, error in row.gradient_errors.items():
        assert error <= case.bounds.get(name, GRADIENT), name
    assert int(count_non_finite(case.gaussians, case.features)) == case.bad
    # A wider bound must be owed to the scene: no more than four times what one rounding of its numbers does. One row
    # is a sum that cancels, which the rounding of its inputs does not show.
    assert bool(case.bounds) == bool(case.why)
    for name, bound in case.bounds.items() if case.why != CANCELS else ():
        assert bound <= 4 * max(row.value_ulp if name == "value" else row.gradient_ulps[name], VALUE), name


def test_the_rows_are_what_they_claim():
    names = [case.name for case in CASES]
    assert len(set(names)) == len(names)
    for case in CASES:
        arrays = jax.tree.leaves((case.gaussians, case.camera, case.features))
        assert {a.dtype for a in arrays if hasattr(a, "dtype")} == {np.dtype(np.float32)}
        assert case.gaussians.count in (0, 1, 64, 10_000)


@pytest.fixture(scope="module")
def touched():
    """A scene, and bool (H, W) the pixels that its sixth Gaussian touches, by brute force."""
    case = ordinary()
    covered = weights_reference(case.gaussians, case.camera)[..., 5] > 0
    assert 20 < covered.sum() < covered.size / 2
    return case, covered


def nan_pixels(image) -> np.ndarray:
    """(H, W) pixels that are NaN, which must be so in all channels or in none."""
    wrong = np.isnan(np.asarray(image))
    np.testing.assert_array_equal(wrong.any(-1), wrong.all(-1))
    return wrong.any(-1)


@pytest.mark.long
def test_a_bad_feature_stays_where_it_is_seen_however_wide_and_in_its_own_set_under_vmap(touched):
    case, covered = touched
    sets = np.random.default_rng(0).normal(size=(2, 64, 12)).astype(np.float32)
    broken = sets.copy()
    broken[1, 5, 0] = np.nan

    def draw(f):
        return render(case.gaussians, case.camera, f, capacity=CAPACITY).features

    def loss(f):
        return (jnp.nan_to_num(draw(f)).sum(), draw(f))

    compiled = jax.jit(jax.vmap(jax.value_and_grad(loss, has_aux=True)))
    ((_, clean), _), ((_, image), gradient) = compiled(sets), compiled(broken)
    np.testing.assert_array_equal(image[0], clean[0])
    np.testing.assert_array_equal(nan_pixels(image[1]), covered)
    np.testing.assert_array_equal(np.asarray(image[1])[~covered], np.asarray(clean[1])[~covered])
    assert bool(jnp.isfinite(gradient).all())


@pytest.mark.long
def test_colour_and_depth_of_bad_gaussians(touched):
    """In every run the rows have features of such Gaussians."""
    case, covered = touched
    coefficients = np.random.default_rng(1).normal(scale=0.2, size=(64, 4, 3)).astype(np.float32)
    means, sh = case.gaussians.means.copy(), coefficients.copy()
    means[7], sh[5, 2, 1] = np.nan, np.nan
    broken = dataclasses.replace(case.gaussians, means=means, sh=sh)

    def loss(gaussians, camera):
        image = render_rgb(gaussians, camera, capacity=CAPACITY).features
        return jnp.nansum(image), image

    compiled = jax.jit(jax.value_and_grad(loss, argnums=(0, 1), has_aux=True))
    (_, image), gradients = compiled(broken, case.camera)
    assert all(bool(jnp.isfinite(g).all()) for g in jax.tree.leaves(gradients))
    assert not (nan_pixels(image) & ~covered).any()
    logits = np.where(np.arange(64) == 7, -50, case.gaussians.opacity_logits).astype(np.float32)
    (_, expected), _ = compiled(
        dataclasses.replace(broken, opacity_logits=logits, means=case.gaussians.means, sh=coefficients), case.camera
    )
    np.testing.assert_array_equal(np.asarray(image)[~nan_pixels(image)], np.asarray(expected)[~nan_pixels(image)])
    assert bool(jnp.isfinite(render_depth(broken, case.camera)[0]).all())
    np.testing.assert_array_equal(np.flatnonzero(~np.asarray(is_usable(broken))), [7])
    assert int(count_non_finite(broken)) == 2
    assert int(count_non_finite(dataclasses.replace(broken, sh=None))) == 1


@pytest.mark.as_shipped  # so are the rows whose program it shares
@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_a_camera_that_is_not_finite_sees_nan_and_has_no_gradient(number):
    case = ordinary()
    pose = case.camera.world_to_camera.copy()
    pose[1, 2] = number
    camera = dataclasses.replace(case.camera, world_to_camera=pose)
    image, _, gradients = engine(dataclasses.replace(case, camera=camera), np.ones((40, 48, 4)))
    assert np.isnan(image).all()
    for name, gradient in gradients.items():
        np.testing.assert_array_equal(gradient, 0, err_msg=name)
