"""The renderer as it ships: its images against the brute-force float64 twin, on one device and on two.

In every run the rows of the stability table have images and gradients of one camera.
"""

import numpy as np
import pytest
from reference import render_reference

from jsecon import host_mesh, render

pytestmark = [pytest.mark.as_shipped, pytest.mark.long]


@pytest.mark.parametrize("channels", [1, 3, 16])
def test_images_are_the_brute_force_sum(scene, cameras, channels):
    features = np.random.default_rng(1).normal(size=(scene.count, channels)).astype(np.float32)
    for t in range(4):
        rendering = render(scene, cameras[t], features)
        expected, alpha = render_reference(scene, cameras[t], features)
        assert int(rendering.overflow) == 0
        error = np.abs(np.asarray(rendering.features) - expected).max(-1)
        # An alpha at the 1/255 cut may fall on the other side in float32: 1/255 of a feature, on few pixels.
        assert np.median(error) < 1e-6
        assert np.mean(error > 1e-5) < 0.01
        assert error.max() < np.abs(features).max() * 2 / 255
        assert np.abs(np.asarray(rendering.alpha) - alpha).max() < 1 / 255


@pytest.mark.parametrize("channels", [3, 16])
def test_several_devices_give_what_one_gives_to_the_last_bit(scene, camera, channels):
    """In every run test_cores has an image of three devices."""
    features = np.random.default_rng(1).normal(size=(scene.count, channels)).astype(np.float32)
    one, two = (render(scene, camera, features, mesh=mesh) for mesh in (None, host_mesh()))
    np.testing.assert_array_equal(one.features, two.features)
    np.testing.assert_array_equal(one.alpha, two.alpha)
