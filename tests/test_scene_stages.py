"""Gaussians given to a run: read in every format, in whichever world they are that the frames show."""

import dataclasses
import itertools
import json

import numpy as np
import pytest
from capture_files import compute_stage, context_of, refused, small_capture
from scipy.spatial.transform import Rotation
from splat_files import scene
from test_gaussian_files import gaussians

from jsecon import load_gaussians, render_rgb, save_gaussians
from jsecon.read.captures.nerfstudio import source_from_trained
from jsecon.splat.transform import transform_gaussians

TURN = np.array([[0, 0, 1, 0.3], [1, 0, 0, -0.2], [0, 1, 0, 0.5], [0, 0, 0, 1.0]])
TRAINED = np.diag([0.4, 0.4, 0.4, 1]) @ TURN
"""from the source's world to nerfstudio's: turned and shifted, then made smaller"""


def read(capture, file, name="gaussians", **results):
    """The outcome of the stage that reads `file` (or another, given the results before it), and the stage."""
    return compute_stage(context_of(file.parent, file.parent / "out", gaussians=file), name, load=capture, **results)


@pytest.fixture
def near():
    """Gaussians in the views of the ring of cameras."""
    arrays = scene(80, 1)
    return gaussians(arrays | {"means": arrays["means"] / 10})


def photographed(scene, capture=None, background=(0, 0, 0)):
    """The capture (by default the small one) with frames that show the scene over a colour."""
    capture, colour = capture or small_capture(8), np.array(background, np.float32)
    frames = [render_rgb(scene, capture.cameras[t], background=colour).features for t in range(len(capture.names))]
    return dataclasses.replace(capture, frames=(255 * np.clip(np.stack(frames), 0, 1)).astype(np.uint8))


def test_a_scene_that_nerfstudio_trained_is_carried_back(tmp_path, near):
    """Into the world of transforms.json, which is not the source's where an applied_transform made it."""
    applied = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0.1], [0, 0, 0, 1.0]])
    capture = dataclasses.replace(photographed(near), source_from_scene=np.linalg.inv(applied))
    file = tmp_path / "scene.ply"
    save_gaussians(file, transform_gaussians(near, TRAINED @ np.linalg.inv(applied)))
    plain, before = read(capture, file)
    assert plain.notes[0].startswith("WARNING: The Gaussians of scene")
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps({"transform": TURN[:3].tolist(), "scale": 0.4}))
    found, after = read(capture, file)
    np.testing.assert_allclose(found.value.means, near.means, atol=1e-4)
    np.testing.assert_allclose(found.value.log_scales, near.log_scales, atol=0.04)
    assert "dataparser_transforms.json" in found.notes[0]
    assert before.key_options != after.key_options


BLACK, WHITE, BLUE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.2, 0.4, 0.8)


@pytest.mark.parametrize(("world", "background"), [
    ("files", BLACK), ("poses", WHITE), *itertools.product(("gsplat", "nerfstudio"), (BLACK, WHITE, BLUE)),
])  # fmt: skip
def test_the_world_is_found_that_the_frames_show(tmp_path, near, world, background):
    """The one before an applied_transform, which jsecon writes; that of the poses; and those that trainings make of it.
    The capture's points are not about the origin, so that the trainings' worlds are their own."""
    applied = np.array([[1, 0, 0, 2], [0, 0, 1, 0], [0, -1, 0, 0.1], [0, 0, 0, 1.0]])
    source_from_scene = np.linalg.inv(applied) if world in ("files", "poses") else np.eye(4)
    shown = photographed(near, background=background)
    capture = dataclasses.replace(shown, source_from_scene=source_from_scene)
    others = {"files": source_from_scene, "poses": np.eye(4)}
    others |= {"gsplat": gsplat_world(capture), "nerfstudio": nerfstudio_world(capture)}
    save_gaussians(tmp_path / "scene.ply", near, similarity=others[world])
    found, _ = read(capture, tmp_path / "scene.ply")
    np.testing.assert_allclose(found.value.means, near.means, atol=1e-5)
    assert world in found.notes[0]
    assert "WARNING" not in found.notes[0]


def up_turned_to(capture, to):
    """Camera to world, and the turn that carries the cameras' mean up onto an axis."""
    c2w = np.linalg.inv(capture.cameras.world_to_camera.astype(np.float64))
    up = -c2w[:, :3, 1].mean(0)
    up = up / np.linalg.norm(up)
    axis = np.cross(up, to)
    angle = np.arctan2(np.linalg.norm(axis), up @ to)
    return c2w, Rotation.from_rotvec(angle * axis / max(np.linalg.norm(axis), 1e-12)).as_matrix()


def gsplat_world(capture):
    """As examples/datasets/normalize.py of gsplat has it, for cameras whose up is not +y."""
    c2w, turn = up_turned_to(capture, np.array([0, -1.0, 0]))
    ahead, places = c2w[:, :3, 2] @ turn.T, c2w[:, :3, 3] @ turn.T
    middle = np.median(places - (ahead * places).sum(1)[:, None] * ahead, axis=0)
    size = np.median(np.linalg.norm(places - middle, axis=1))
    points = (capture.points @ turn.T - middle) / size
    axes = np.linalg.svd(points - np.median(points, axis=0) - (points - np.median(points, axis=0)).mean(0))[2]
    axes[0] *= np.sign(np.linalg.det(axes))
    world = np.eye(4)
    world[:3, :3] = axes @ turn / size
    world[:3, 3] = axes @ (-middle / size - np.median(points, axis=0))
    return world


def nerfstudio_world(capture):
    """As auto_orient_and_center_poses of nerfstudio has it: up to z, the mean to the origin, the largest to 1."""
    c2w, turn = up_turned_to(capture, np.array([0, 0, 1.0]))
    places = (c2w[:, :3, 3] - c2w[:, :3, 3].mean(0)) @ turn.T
    world = np.eye(4)
    world[:3, :3] = turn / np.abs(places).max()
    world[:3, 3] = -world[:3, :3] @ c2w[:, :3, 3].mean(0)
    return world


def crude(scene):
    """The scene with places and colours that are a bit off."""
    rng = np.random.default_rng(3)
    means = scene.means + rng.normal(0, 0.01, scene.means.shape).astype(np.float32)
    return dataclasses.replace(scene, means=means, sh=scene.sh + rng.normal(0, 0.2, scene.sh.shape).astype(np.float32))


@pytest.mark.parametrize("frames", [4, 8])
@pytest.mark.parametrize(("background", "over"), [(BLACK, None), (WHITE, "white"), (BLUE, "the colour (")])
def test_a_scene_may_be_trained_over_any_colour(tmp_path, near, background, over, frames):
    """It is read in its world, and its held-out frames are compared over the colour; turned, it gets a warning."""
    capture, file = photographed(near, small_capture(frames), background), tmp_path / "scene.ply"
    capture = dataclasses.replace(capture, held_out=np.arange(frames) == 1)
    save_gaussians(file, crude(near))
    found, _ = read(capture, file)
    np.testing.assert_allclose(found.value.means, crude(near).means, atol=1e-5)
    assert "WARNING" not in found.notes[0]
    assert ("over" in found.notes[0]) == (over is not None)
    assert f"show them over {over}" in found.notes[0] or over is None
    quality, _ = read(capture, file, "held_out", gaussians=found.value)
    image = render_rgb(crude(near), capture.cameras[1], background=np.array(background, np.float32)).features
    error = np.mean((np.clip(image, 0, 1) - capture.frames[1] / 255) ** 2)
    np.testing.assert_allclose(quality.value.psnr, -10 * np.log10(error), atol=1)
    if frames == 8 or over:  # four views over black do not tell it from a crude scene
        save_gaussians(file, transform_gaussians(near, TURN @ np.diag([3.0, 3, 3, 1])))
        assert read(capture, file)[0].notes[0].startswith("WARNING")


def test_a_thing_of_one_colour_is_recognised_by_its_outline(tmp_path, near):
    """Its colours within the outline tell nothing."""
    red = dataclasses.replace(near, sh=np.tile(np.array([1.0, -1.5, -1.5], np.float32), (near.count, 1, 1)))
    save_gaussians(tmp_path / "scene.ply", red)
    found, _ = read(photographed(red, background=WHITE), tmp_path / "scene.ply")
    assert "over white" in found.notes[0]


def test_a_file_far_from_the_origin_is_read_in_double_precision(tmp_path, near):
    world = np.eye(4)
    world[:3, 3] = 455123.4, 5411876.6, 1e7  # of a map projection
    capture = dataclasses.replace(photographed(near), source_from_scene=world, poses_from_scene=world)
    save_gaussians(tmp_path / "scene.ply", near, similarity=world)
    found, _ = read(capture, tmp_path / "scene.ply")
    np.testing.assert_allclose(found.value.means, near.means, atol=1e-5)
    assert len(found.notes) == 1
    with refused("scene.ply", "float32"):
        load_gaussians(tmp_path / "scene.ply")


@pytest.mark.parametrize(("told", "says"), [
    ({"scale": 1.0}, "'transform' is missing"), ({"transform": TURN[:3].tolist(), "scale": 0}, "its world is 0"),
    ({"transform": (2 * TURN[:3]).tolist(), "scale": 1.0}, "not rigid"),
    ({"transform": [[1, 2]], "scale": 1.0}, "shape (1, 2)"),
])  # fmt: skip
def test_what_a_trained_world_must_be(tmp_path, told, says):
    file = tmp_path / "dataparser_transforms.json"
    file.write_text(json.dumps(told))
    with refused(file.name, says):
        source_from_trained(file)
