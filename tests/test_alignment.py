"""Cameras of RGB-D frames aligned by colour and depth: what is known is found again, and what is right stays."""

import dataclasses

import jax
import numpy as np
import pytest
from conftest import cameras_of, capture_of, look_at
from test_corrections import hat_exp
from test_fit import same

from jsecon.poses.alignment import align_cameras
from jsecon.poses.refine import refine_capture
from jsecon.types import Capture

VIEWS, WIDTH, HEIGHT, FOCAL = 10, 120, 90, 110.0


def in_a_corner() -> Capture:
    """Views of three textured walls, 3 m wide, that meet in a corner, with their depth; the last is held out."""
    sides = [(1.0 + 0.15 * k, 2.6 - 0.1 * k, 1.4 + 0.4 * np.sin(k)) for k in range(VIEWS)]
    poses = np.stack([look_at(side, (0.2, 0.1, 0.3)) for side in sides]).astype(np.float64)
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones_like(u)], axis=-1)
    frames, depths = [], []
    for pose in poses:
        centre, directions = -pose[:3, :3].T @ pose[:3, 3], rays @ pose[:3, :3]
        with np.errstate(divide="ignore"):
            reach = -centre / directions
        depth = np.where(reach > 0, reach, np.inf).min(axis=-1)
        point = centre + depth[..., None] * directions
        shades = [np.sin(point @ wave + phase) for wave, phase in (((5, 3, 7), 0), ((-4, 8, 2), 1), ((9, -6, 5), 2))]
        frames.append(np.rint(110 + 60 * np.stack(shades, axis=-1)))
        depths.append(depth)
    cameras = cameras_of(poses, (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2), WIDTH, HEIGHT)
    return capture_of(frames, cameras, np.arange(VIEWS) == VIEWS - 1, np.float32(depths))


def moved(capture: Capture, centimetres: float, degrees: float) -> Capture:
    """The capture with poses off by so much along and about each of the camera's axes (normal)."""
    draw, poses = np.random.default_rng(3), np.asarray(capture.cameras.world_to_camera, np.float64)
    twists = np.repeat([np.radians(degrees), centimetres / 100], 3) * draw.normal(size=(VIEWS, 6))
    return posed(capture, np.stack([hat_exp(twist) @ pose for twist, pose in zip(twists, poses)]))


def posed(capture: Capture, poses: np.ndarray) -> Capture:
    return dataclasses.replace(capture, cameras=dataclasses.replace(capture.cameras, world_to_camera=np.float32(poses)))


def off(poses: np.ndarray, truth: Capture) -> tuple[float, float]:
    """Largest distance, cm, and turn, degrees, from the true poses, in the first frame's axes."""
    true = np.asarray(truth.cameras.world_to_camera, np.float64)
    motions = (poses @ np.linalg.inv(poses[0])) @ np.linalg.inv(true @ np.linalg.inv(true[0]))
    cosine = (np.trace(motions[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    distances = np.linalg.norm(motions[:, :3, 3], axis=1)
    return 100 * float(distances.max()), float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).max())


@pytest.mark.parametrize(("noise", "unknown"), [(0.0, 0.0), (0.01, 0.2)])
def test_poses_off_by_centimetres_and_degrees_are_found_again(noise, unknown):
    """Whatever the frames' gains, with noise in the depth and holes, and of a frame held out by itself."""
    truth, draw = in_a_corner(), np.random.default_rng(5)
    gains = draw.uniform(0.8, 1.2, (VIEWS, 1, 1, 1))
    depths = truth.depths * (1 + noise * draw.normal(size=truth.depths.shape))
    depths[draw.uniform(size=depths.shape) < unknown] = 0
    rough = dataclasses.replace(truth, frames=np.uint8(np.rint(truth.frames * gains)), depths=np.float32(depths))
    rough = moved(rough, 2.0, 1.0)
    before, train = off(np.float64(rough.cameras.world_to_camera), truth), ~truth.held_out
    poses = align_cameras(rough, train)
    assert np.array_equal(np.float32(poses[-1]), rough.cameras.world_to_camera[-1])
    poses = align_cameras(posed(rough, poses), truth.held_out, train)
    after = off(poses, truth)
    assert before[0] > 10
    assert before[1] > 5
    assert after[0] < 0.4
    assert after[1] < 0.15


def test_exact_poses_stay_and_frames_that_share_nothing_have_none():
    truth = in_a_corner()
    assert align_cameras(truth, ~truth.held_out) is None
    assert align_cameras(dataclasses.replace(truth, depths=np.zeros_like(truth.depths)), ~truth.held_out) is None


def test_frames_that_depth_aligns_need_no_proof_and_keep_it_where_no_time_is_left_for_a_probe():
    truth, given = in_a_corner(), {"key": jax.random.key(0), "visits": 1}
    alone, limited, whole = (refine_capture(moved(truth, 2.0, 1.0), max_fit_steps=n, **given) for n in (1.0, 1e9, None))
    assert off(np.float64(alone.cameras.world_to_camera), truth)[0] < 0.6
    assert same(whole, limited)
    other = dataclasses.replace(truth, depths=1.25 * truth.depths)  # another unit
    assert same(refine_capture(other, max_fit_steps=1.0, **given).cameras, truth.cameras)
