"""Rendering against the brute-force float64 twin, its gradients against central differences, and its manners."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import MANY, gaussians_at, look_at
from reference import project_reference, render_reference

from jsecon import Camera, Gaussians, project, render, render_depth, render_rgb
from jsecon.splat.sh import colours_from_sh


def to64(tree):
    return jax.tree.map(
        lambda a: jnp.asarray(a, jnp.float64) if jnp.issubdtype(jnp.asarray(a).dtype, jnp.floating) else a, tree
    )


def random_features(count, channels, seed=1):
    return np.random.default_rng(seed).normal(size=(count, channels)).astype(np.float32)


def test_jit_is_eager_and_vmap_is_a_loop(scene, cameras):
    sets = random_features(scene.count, 3) * np.float32([1, 2])[:, None, None]

    def one(camera, features):
        return render(scene, camera, features).features

    together = jax.jit(jax.vmap(jax.vmap(one, (None, 0)), (0, None)))(cameras, sets)
    looped = np.stack([one(cameras[t], sets[0]) for t in range(4)])
    np.testing.assert_allclose(together[:, 0], looped, atol=5e-6)
    np.testing.assert_allclose(together[:, 1], 2 * looped, atol=1e-5)


def test_shapes_that_disagree_raise(scene, camera, cameras):
    with pytest.raises(ValueError, match="features"):
        render(scene, camera, np.zeros((3, 2), np.float32))
    with pytest.raises(ValueError, match="single camera"):
        render(scene, cameras, random_features(scene.count, 2))


def test_features_need_no_spherical_harmonics(scene, camera):
    features = random_features(scene.count, 3)
    bare = dataclasses.replace(scene, sh=None)
    np.testing.assert_array_equal(render(bare, camera, features).features, render(scene, camera, features).features)
    with pytest.raises(ValueError, match="sh"):
        render_rgb(bare, camera)


def test_forward_mode_is_refused(scene, camera):
    features = random_features(scene.count, 2)
    with pytest.raises(TypeError, match="forward-mode"):
        jax.jvp(lambda f: render(scene, camera, f).features, (features,), (features,))


def squares(features, gaussians, camera):
    return (render(gaussians, camera, features).features ** 2).sum()


slope = jax.jit(jax.grad(squares))


def test_float64_is_the_definition_to_rounding_and_every_gradient_equals_central_differences(x64, scene, camera):
    few = jax.tree.map(lambda a: a[:24], scene)
    scene64, camera64 = to64(few), to64(camera)
    cotangent = jnp.asarray(np.random.default_rng(2).normal(size=(40, 48, 4)))
    arguments = (
        *(scene64.means, scene64.log_scales, scene64.quaternions, scene64.opacity_logits),
        camera64.world_to_camera,
        jnp.asarray(random_features(24, 3), jnp.float64),
    )

    @jax.jit
    @functools.partial(jax.value_and_grad, has_aux=True)
    def loss(arguments):
        *parts, pose, features = arguments
        c = Camera(pose, camera64.fx, camera64.fy, camera64.cx, camera64.cy, 48, 40)
        r = render(Gaussians(*parts, scene64.sh), c, features)
        return (r.features * cotangent[..., :3]).sum() + (r.alpha * cotangent[..., 3]).sum(), r

    (_, rendering), gradients = loss(arguments)
    assert rendering.features.dtype == jnp.float64
    for found, expected in zip((rendering.features, rendering.alpha), render_reference(few, camera, arguments[-1])):
        np.testing.assert_allclose(found, expected, atol=1e-12)

    def agrees(k, index, step, **tolerance):
        """Whether there is a derivative: none where an alpha crosses a cut inside the step."""

        def value(moved):
            changed = arguments[k].at[index].add(moved)
            return loss((*arguments[:k], changed, *arguments[k + 1 :]))[0][0]

        near, far = ((value(h) - value(-h)) / (2 * h) for h in (step, 2 * step))
        if abs(near - far) > 1e-4 * (1 + abs(near)):
            return False
        np.testing.assert_allclose(gradients[k][index], near, **tolerance, err_msg=f"argument {k} at {index}")
        return True

    rng = np.random.default_rng(3)
    checked = sum(
        agrees(k, tuple(rng.integers(0, s) for s in arguments[k].shape), 1e-6, rtol=1e-6, atol=1e-6)
        for k in range(4)
        for _ in range(6)
    )
    checked += sum(agrees(4, index, 1e-7, rtol=1e-5) for index in [(0, 1), (1, 3), (2, 2), (2, 3)])
    assert checked >= 16
    assert all(agrees(5, index, 1e-4, rtol=1e-8, atol=1e-9) for index in [(0, 0), (5, 2), (23, 1)])


def test_the_gradient_of_features_alone_is_that_of_a_linear_rendering_of_any_width(scene, camera):
    features = jnp.asarray(random_features(scene.count, 3))
    alone = slope(features, scene, camera)
    wide = jnp.concatenate([features, *jnp.asarray(np.random.default_rng(4).normal(size=(3, scene.count, 3)))], 1)
    np.testing.assert_allclose(slope(wide, scene, camera)[:, :3], alone, rtol=1e-4, atol=1e-4)
    # <W f, W f> has the gradient 2 W^T W f
    other = jnp.asarray(random_features(scene.count, 3, seed=9))
    along = (alone * other).sum()
    expected = 2 * (render(scene, camera, features).features * render(scene, camera, other).features).sum()
    np.testing.assert_allclose(along, expected, rtol=1e-4)


def colours_twin(scene, camera):
    """(N, 3) colours of harmonics of degree 1, float64."""
    away = scene.means - np.asarray(camera.centres, np.float64)
    x, y, z = away.T / np.linalg.norm(away, axis=1)
    basis = np.stack([0.28209479 * np.ones_like(x), *(0.48860251 * np.stack([-y, z, -x]))])
    return np.maximum(0.5 + np.einsum("kn,nkc->nc", basis, scene.sh), 0)


@pytest.mark.parametrize("count", [64, MANY])
def test_projection_and_colours_equal_their_twins(scene, cameras, camera, count):
    rows = np.arange(count) % 64
    many = jax.tree.map(lambda a: a[rows], scene)
    np.testing.assert_allclose(jax.jit(colours_from_sh)(many, camera), colours_twin(many, camera), atol=2e-6)
    got = jax.tree.map(lambda a: a[0], jax.jit(jax.vmap(project, (None, 0)))(many, cameras))
    expected = {name: column[rows] for name, column in project_reference(scene, camera).items()}
    np.testing.assert_allclose(got.means_px, expected["means_px"], rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(got.depths, expected["depths"], rtol=1e-5)
    l11, l21, l22 = np.asarray(got.whitening).T
    inverse = np.stack([l11 * l11, l11 * l21, l21 * l21 + l22 * l22], axis=-1)
    np.testing.assert_allclose(inverse, expected["conics"], rtol=1e-3, atol=1e-5)
    assert bool(got.visible.any())


def test_colour_follows_the_view_and_depth_is_that_of_the_surface(scene, cameras):
    for t in (0, 2):
        expected, _ = render_reference(scene, cameras[t], colours_twin(scene, cameras[t]))
        np.testing.assert_allclose(render_rgb(scene, cameras[t]).features, expected, atol=1 / 255)
    side = np.linspace(-2, 2, 30)
    wall = gaussians_at(np.stack(np.meshgrid(side, side, [0.0]), -1).reshape(-1, 3), 0.08, logit=6)
    camera = Camera(look_at((0, 0, -2.0), up=(0, -1, 0)), *(np.float32(v) for v in (45, 45, 24, 20)), 48, 40)
    depth, alpha = render_depth(wall, camera)
    assert float(alpha[10:30, 12:36].min()) > 0.95
    np.testing.assert_allclose(depth[10:30, 12:36], 2.0, atol=0.02)


def test_an_image_size_that_no_tile_divides(scene):
    camera = Camera(look_at((0, 0, -2.5)), *(np.float32(v) for v in (40, 40, 4.5, 3.5)), 9, 7)
    features = random_features(scene.count, 3)
    expected, _ = render_reference(scene, camera, features)
    np.testing.assert_allclose(render(scene, camera, features).features, expected, atol=np.abs(features).max() / 255)
