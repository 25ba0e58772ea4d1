"""SAM's points and crops."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from jsecon.vision.sam_prompts import Crop, crops_of, point_grid


def test_the_grid_has_the_centres_of_its_cells_and_x_runs_fastest():
    np.testing.assert_allclose(point_grid(2), [[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])
    assert point_grid(32).shape == (1024, 2)
    np.testing.assert_allclose(point_grid(32)[:2, 0], [1 / 64, 3 / 64])
    with pytest.raises(ValueError, match="at least 1"):
        point_grid(0)


def test_crops_are_those_of_the_automatic_mask_generator():
    """1500 x 1000, by hand: overlap int(512/1500 * 1000 * 2/2) = 341; lengths are half of 341 + 1500 and 341 + 1000."""
    assert crops_of(1000, 1500, 1, 512 / 1500) == [
        Crop(0, 0, 1500, 1000, 0),
        Crop(0, 0, 921, 671, 1),
        Crop(0, 330, 921, 1000, 1),
        Crop(580, 0, 1500, 671, 1),
        Crop(580, 330, 1500, 1000, 1),
    ]
    assert crops_of(1000, 1500, 0, 512 / 1500) == [Crop(0, 0, 1500, 1000, 0)]


@settings(max_examples=50, deadline=None)
@given(st.integers(8, 300), st.integers(8, 300), st.integers(0, 2))
def test_the_crops_of_each_layer_cover_the_frame(height, width, layers):
    crops = crops_of(height, width, layers, 512 / 1500)
    assert len(crops) == sum(4**k for k in range(layers + 1))
    for layer in range(layers + 1):
        seen = np.zeros((height, width), bool)
        for crop in crops:
            if crop.layer == layer:
                assert 0 <= crop.left < crop.right <= width
                assert 0 <= crop.top < crop.bottom <= height
                assert crop.area == (crop.right - crop.left) * (crop.bottom - crop.top)
                seen[crop.top : crop.bottom, crop.left : crop.right] = True
        assert seen.all()
