"""Plans of frozen geometry, and one view spread over several devices: the same image and the same gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference import project_reference, weights_reference

from jsecon import host_mesh, plan_view, render, render_depth, render_plan


def features_of(count: int, channels: int) -> jax.Array:
    return jnp.asarray(np.random.default_rng(2).normal(size=(count, channels)), jnp.float32)


@pytest.mark.parametrize("channels", [3, pytest.param(16, marks=pytest.mark.long)])
def test_a_planned_render_is_a_render(scene, camera, channels):
    features, background = features_of(scene.count, channels), jnp.arange(channels, dtype=jnp.float32)
    plan = plan_view(scene, camera)
    got, expected = render_plan(plan, features, background=background), render(scene, camera, features)
    assert int(plan.overflow) == 0
    left = (1 - expected.alpha)[..., None] * background
    np.testing.assert_allclose(got.features, expected.features + left, atol=2e-6 * channels)
    np.testing.assert_allclose(got.alpha, expected.alpha, atol=1e-6)

    def loss(features, draw):
        return (draw(features).features ** 2).sum()

    by_plan = jax.jit(jax.grad(lambda f: loss(f, lambda f: render_plan(plan, f))))(features)
    whole = jax.jit(jax.grad(lambda f: loss(f, lambda f: render(scene, camera, f))))(features)
    np.testing.assert_allclose(by_plan, whole, rtol=1e-4, atol=1e-4)


def test_a_plan_says_what_it_lacks(scene, camera):
    with pytest.raises(ValueError, match="one row"):
        render_plan(plan_view(scene, camera), features_of(scene.count + 1, 3))
    assert int(plan_view(scene, camera, capacity=32).overflow) > 0


@pytest.mark.long
@pytest.mark.parametrize("channels", [3, 16])
def test_several_devices_give_the_gradients_of_one(scene, camera, channels):
    mesh, features = host_mesh(), features_of(scene.count, channels)
    assert mesh is not None
    assert mesh.size == 2

    def loss(gaussians, features, mesh):
        rendering = render(gaussians, camera, features, mesh=mesh)
        return (rendering.features**2).sum() + rendering.alpha.sum()

    argnums = (0, 1) if channels == 3 else (1,)  # the geometry's programs are the longest to compile
    gradients = jax.jit(jax.grad(loss, argnums=argnums), static_argnums=2)
    by_one, by_two = gradients(scene, features, None), gradients(scene, features, mesh)
    for a, b in zip(jax.tree.leaves(by_one), jax.tree.leaves(by_two), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)


def test_depth_in_the_same_pass_is_the_depth_of_its_own(scene, camera):
    features = features_of(scene.count, 3)
    together = render(scene, camera, features, depth=True)
    depth, alpha = render_depth(scene, camera)
    np.testing.assert_allclose(together.depth, depth, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(together.alpha, alpha, atol=1e-6)
    np.testing.assert_allclose(together.features, render(scene, camera, features).features, atol=1e-5)
    weights = weights_reference(scene, camera)
    expected = weights @ project_reference(scene, camera)["depths"] / np.maximum(weights.sum(-1), 1e-12)
    assert np.mean(np.abs(depth - expected) > 1e-4) < 0.02
    assert render(scene, camera, features).depth is None


@pytest.mark.as_shipped
@pytest.mark.long
@pytest.mark.parametrize("channels", [3, 16])
def test_several_devices_give_what_one_gives_to_the_last_bit(scene, camera, channels):
    """In every run test_cores has an image of three devices."""
    features = features_of(scene.count, channels)
    one, two = (render(scene, camera, features, mesh=mesh) for mesh in (None, host_mesh()))
    np.testing.assert_array_equal(one.features, two.features)
    np.testing.assert_array_equal(one.alpha, two.alpha)
    assert float(jnp.abs(two.features - one.features).max()) == 0  # mixed with arrays of one device afterwards
