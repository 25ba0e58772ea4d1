"""Gaussians carried into another world: a camera that is carried along sees the same image."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jsecon import Gaussians, render_rgb
from jsecon.splat.transform import transform_gaussians

TURN = Rotation.from_euler("ZXY", [20, -70, 130], degrees=True).as_matrix()


def _similarity(scale=2.5):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = scale * TURN, (0.3, -4.0, 1.5)
    return matrix


@pytest.mark.parametrize("bands", [1, 4, 16])
def test_a_camera_carried_along_sees_the_same_image(scene, camera, bands):
    sh = (0.2 * np.random.default_rng(1).normal(size=(scene.count, bands, 3))).astype(np.float32)
    scene = Gaussians(scene.means, scene.log_scales, scene.quaternions, scene.opacity_logits, sh)
    matrix, scale = _similarity(), 2.5
    pose = np.asarray(camera.world_to_camera, np.float64) @ np.linalg.inv(matrix)
    pose[:3] *= scale  # camera coordinates grow with the world, the rotation stays a rotation
    moved = dataclasses.replace(camera, world_to_camera=pose.astype(np.float32))
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6)
    want = render_rgb(scene, camera)
    have = render_rgb(transform_gaussians(scene, matrix), moved)
    # A pixel may differ where an alpha sits on the 1/255 border: compare all but a few in a thousand exactly.
    assert np.quantile(np.abs(np.asarray(have.features) - np.asarray(want.features)), 0.995) < 1e-4
    assert float(np.abs(np.asarray(have.alpha) - np.asarray(want.alpha)).max()) < 0.01


def test_the_identity_changes_nothing_and_means_become_float64(scene):
    same = transform_gaussians(jax.tree.map(jnp.asarray, scene), np.eye(4))
    assert same.means.dtype == np.float64
    for name, column in vars(same).items():
        assert isinstance(column, np.ndarray)
        np.testing.assert_array_equal(column, getattr(scene, name))


@pytest.mark.parametrize("matrix", [np.diag([1.0, 2.0, 1.0, 1.0]), np.diag([-1.0, 1.0, 1.0, 1.0]), np.zeros((4, 4))])
def test_what_is_no_similarity_is_refused(scene, matrix):
    with pytest.raises(ValueError, match="rotation, one positive scale"):
        transform_gaussians(scene, matrix)
