"""Triangulation on pictures of a textured scene whose geometry is known."""

import dataclasses

import numpy as np
import pytest
from conftest import cameras_of, capture_of, look_at
from photo_files import FOCAL, HEIGHT, WIDTH, photo_images

from jsecon import InputError
from jsecon.fit.start import starting_gaussians
from jsecon.fit.triangulate import triangulated_points

PLANE = (((-1, -1, 0), (2, 0, 0), (0, 2, 0)),)
"""a board of 2 x 2 in the plane z = 0"""


def plane_capture(count=5, textured=True):
    """Views of the plane, the third held out."""
    angles = np.linspace(-0.5, 0.5, count)
    poses = [look_at((0.9 * np.sin(a), 0.1 * np.cos(3 * a), -2 * np.cos(a)), dtype=float) for a in angles]
    frames = photo_images(poses, PLANE) if textured else np.full((count, HEIGHT, WIDTH, 3), 90)
    cameras = cameras_of(poses, (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2), WIDTH, HEIGHT)
    return capture_of(frames, cameras, np.arange(count) == 2)


def test_points_of_a_textured_plane_lie_on_it():
    capture = plane_capture()
    points, _ = triangulated_points(capture)
    assert len(points) > 150
    off = np.abs(points[:, 2])
    assert np.median(off) < 0.01
    assert np.quantile(off, 0.95) < 0.05
    assert np.abs(points[:, :2]).max() < 1.1
    capture.frames[2] = 0  # held out, so nobody looks at it
    gaussians, sentence = starting_gaussians(capture)
    np.testing.assert_allclose(gaussians.means, points, atol=1e-6)
    assert "triangulated" in sentence


def test_views_without_texture_or_with_foreign_poses_are_refused():
    with pytest.raises(InputError, match="overlap"):
        triangulated_points(plane_capture(textured=False))
    capture = plane_capture(3)  # two views and a held-out one
    turned = np.array(capture.cameras.world_to_camera)
    turned[1] = np.diag([-1.0, 1, -1, 1]) @ turned[1]
    wrong = dataclasses.replace(capture, cameras=dataclasses.replace(capture.cameras, world_to_camera=turned))
    with pytest.raises(InputError, match="poses"):
        triangulated_points(wrong)
