"""A picture composited band after band is the one in memory, up to the last weight of a few pixels."""

import dataclasses

import numpy as np
import pytest

from jsecon.splat import bands
from jsecon.splat.banded import render_in_blocks
from jsecon.splat.render import render_rgb


@pytest.mark.parametrize("opaque", [0.0, 8.0])
def test_equal_to_the_render_in_memory(scene, camera, monkeypatch, opaque):
    """In a dozen bands; opaque, most lies behind what stopped the pixel."""
    monkeypatch.setattr(bands, "BAND", 8)
    scene = dataclasses.replace(scene, opacity_logits=scene.opacity_logits + np.float32(opaque))
    expected = np.asarray(render_rgb(scene, camera).features)
    for most_held in (20, 64):
        apart = np.abs(render_in_blocks(scene, camera, most_held=most_held) - expected).max(-1)
        assert (apart > 1e-5).sum() <= 2
        assert apart.max() < 0.02
