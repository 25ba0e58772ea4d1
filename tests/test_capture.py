"""load_capture: formats, options, EXIF, and the same scene in other units and places."""

import dataclasses
import json

import numpy as np
import pytest
from capture_files import refused, small_capture, transforms, write_images, write_text_model, write_transforms
from scipy.spatial.transform import Rotation
from test_images import stored_as, with_orientation

from experiments.rooms.writers import write_colmap
from jsecon.read.captures.capture import load_capture

CAPTURE = small_capture()


def test_formats_are_detected(tmp_path):
    write_colmap(CAPTURE, tmp_path / "colmap")
    write_transforms(CAPTURE, tmp_path / "nerfstudio")
    (tmp_path / "nerfstudio/transforms.json").rename(tmp_path / "nerfstudio/poses_left.json")
    for path in ("colmap", "nerfstudio/poses_left.json"):
        np.testing.assert_array_equal(load_capture(tmp_path / path).frames, CAPTURE.frames)
    (tmp_path / "nerfstudio/images").rename(tmp_path / "elsewhere")
    with refused("nerfstudio", "without poses", "poses_left.json"):
        load_capture(tmp_path / "nerfstudio")
    with refused("nowhere", "no such file or folder"):
        load_capture(tmp_path / "nowhere")
    write_transforms(CAPTURE, tmp_path / "colmap", {**transforms(CAPTURE), "frames": []})
    assert len(load_capture(tmp_path / "colmap").points) == len(CAPTURE.points)


@pytest.mark.parametrize(
    "options", [{"downscale": 0.5}, {"downscale": np.nan}, {"long_side": 0}, {"frames": 0}, {"holdout": 1}]
)
def test_options_are_checked(tmp_path, options):
    write_colmap(CAPTURE, tmp_path)
    with refused(*options):
        load_capture(tmp_path, **options)


def test_options_and_progress(tmp_path):
    write_colmap(CAPTURE, tmp_path)
    calls = []
    loaded = load_capture(tmp_path, downscale=1.5, frames=4, holdout=0, progress=lambda *call: calls.append(call))
    assert loaded.frames.shape == (4, 11, 16, 3)
    np.testing.assert_allclose(loaded.cameras.fx, CAPTURE.cameras.fx[[0, 1, 3, 4]] / 1.5)
    np.testing.assert_allclose(loaded.cameras.fy, CAPTURE.cameras.fy[[0, 1, 3, 4]] * 11 / 16)
    assert not loaded.held_out.any()
    assert calls == [(1, 4), (2, 4), (3, 4), (4, 4)]
    np.testing.assert_array_equal(load_capture(tmp_path, long_side=16, frames=4).frames, loaded.frames)
    assert not load_capture(tmp_path, frames=1).held_out.any()


def write_turned(capture, folder, orientations, *, upright):
    """The capture's images with EXIF orientations; the frames are what is upright, or else what is stored."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, frame, orientation in zip(capture.names, capture.frames, orientations):
        stored_as(frame if upright else with_orientation(frame, orientation), orientation, folder / f"{name}.png")


def test_mixed_exif_orientations_come_upright(tmp_path):
    capture = small_capture(8)
    write_turned(capture, tmp_path / "images", range(1, 9), upright=True)
    (tmp_path / "transforms.json").write_text(json.dumps(transforms(capture)))
    read = load_capture(tmp_path)
    np.testing.assert_array_equal(read.frames, capture.frames)
    assert {(file.width, file.height) for file in read.files} == {(24, 16)}


@pytest.mark.parametrize(("orientation", "upright"), [(3, False), (6, False), (6, True)])
def test_poses_of_stored_pixels_keep_them(tmp_path, orientation, upright):
    """By the size of the camera model; where that cannot tell, because COLMAP ignores EXIF."""
    capture = small_capture(3)
    write_text_model(capture, tmp_path / "sparse/0")
    write_turned(capture, tmp_path / "images", [orientation, 1, 1], upright=upright)
    read = load_capture(tmp_path)
    np.testing.assert_array_equal(read.frames, capture.frames)


SHIFT = np.array([1e7, -5411876.6, 312.25])


def moved(capture, scale, shift):
    """The capture with poses and points in float64, `scale` times as large and shifted."""
    poses = capture.cameras.world_to_camera.astype(np.float64)
    poses[:, :3, :3] = Rotation.from_matrix(poses[:, :3, :3]).as_matrix()
    poses[:, :3, 3] = scale * poses[:, :3, 3] - poses[:, :3, :3] @ shift
    cameras = dataclasses.replace(capture.cameras, world_to_camera=poses)
    return dataclasses.replace(capture, cameras=cameras, points=scale * capture.points.astype(np.float64) + shift)


def written(kind, capture, folder, scale, shift):
    """A capture folder of the kind: COLMAP, nerfstudio with depth, and nerfstudio with nothing but poses."""
    there = moved(capture, scale, shift)
    if kind == "colmap":
        write_images(capture, folder / "images")
        write_text_model(there, folder / "sparse" / "0")
        return folder
    depths = np.full(capture.frames.shape[:3], 2.5) if kind == "depth" else None
    told = transforms(there, depth_unit_scale_factor=0.001 * scale)
    write_transforms(dataclasses.replace(there, depths=depths), folder, told)
    return folder


@pytest.mark.parametrize("kind", ["colmap", "depth"])
@pytest.mark.parametrize(("scale", "shift"), [(1, SHIFT), (1e-3, 0 * SHIFT), (1e-3, SHIFT), (1e3, SHIFT), (1e6, SHIFT)])
def test_a_capture_comes_out_the_same_in_any_place_and_unit(tmp_path, kind, scale, shift):
    plain = load_capture(written(kind, small_capture(), tmp_path / "plain", 1, 0 * SHIFT))
    there = load_capture(written(kind, small_capture(), tmp_path / "there", scale, shift))
    np.testing.assert_array_equal(plain.source_from_scene, np.eye(4))
    offset = there.cameras.centres[0] - plain.cameras.centres[0]
    assert np.abs(offset).max() < 11
    np.testing.assert_allclose(there.cameras.centres, plain.cameras.centres + offset, atol=2e-5)
    if kind == "colmap":
        np.testing.assert_allclose(there.points, plain.points + offset, atol=2e-5)
    if kind == "depth":
        np.testing.assert_allclose(np.asarray(there.depths), np.asarray(plain.depths), rtol=1e-6)
    back = there.cameras.centres.astype(np.float64) @ there.source_from_scene[:3, :3].T + there.source_from_scene[:3, 3]
    np.testing.assert_allclose(back, scale * plain.cameras.centres.astype(np.float64) + shift, atol=3e-6 * scale)


def test_a_capture_from_one_place_keeps_its_unit(tmp_path):
    """A tripod's poses, which differ by rounding, tell no size; large coordinates are centred all the same."""
    capture = small_capture()
    capture.cameras.world_to_camera[:, :3, 3] = 1e-9 * np.arange(15).reshape(5, 3)
    found = load_capture(written("poses", capture, tmp_path, 1, SHIFT))
    np.testing.assert_allclose(found.source_from_scene[:3, :3], np.eye(3))
    assert np.abs(found.cameras.centres).max() < 1
    np.testing.assert_allclose(found.source_from_scene[:3, 3] + found.cameras.centres[0], SHIFT, atol=1e-3)


def test_the_world_of_a_capture_is_that_of_all_its_frames(tmp_path):
    """However many are loaded: a field of some of them goes with the capture of others."""
    folder = written("colmap", small_capture(), tmp_path, 1e-3, SHIFT)
    whole, some = load_capture(folder), load_capture(folder, frames=3)
    np.testing.assert_array_equal(some.source_from_scene, whole.source_from_scene)
