"""The same scene in other units and places: a capture comes out the same, and what is written leads back."""

import dataclasses
import json

import cv2
import numpy as np
import pytest
from capture_files import small_capture, transforms, write_images, write_text_model

import jsecon

SHIFT = np.array([1e7, -5411876.6, 312.25])


def moved(capture, scale, shift):
    """The capture with poses and points in float64, `scale` times as large and shifted."""
    poses = capture.cameras.world_to_camera.astype(np.float64)
    left, _, right = np.linalg.svd(poses[:, :3, :3])
    poses[:, :3, :3] = left @ right
    poses[:, :3, 3] = scale * poses[:, :3, 3] - poses[:, :3, :3] @ shift
    cameras = dataclasses.replace(capture.cameras, world_to_camera=poses)
    return dataclasses.replace(capture, cameras=cameras, points=scale * capture.points.astype(np.float64) + shift)


def written(kind, capture, folder, scale, shift):
    """A capture folder of the kind: COLMAP, nerfstudio with depth, and nerfstudio with nothing but poses."""
    there = moved(capture, scale, shift)
    write_images(capture, folder / "images")
    if kind == "colmap":
        write_text_model(there, folder / "sparse" / "0")
        return folder
    told = transforms(there, depth_unit_scale_factor=0.001 * scale)
    if kind == "depth":
        (folder / "depth").mkdir()
        for frame, name in zip(told["frames"], capture.names):
            frame["depth_file_path"] = f"depth/{name}.png"
            depth = np.full(capture.frames.shape[1:3], 2500, np.uint16)
            cv2.imwrite(str(folder / frame["depth_file_path"]), depth)
    (folder / "transforms.json").write_text(json.dumps(told))
    return folder


@pytest.mark.parametrize("kind", ["colmap", "depth", "poses"])
@pytest.mark.parametrize(("scale", "shift"), [(1, SHIFT), (1e-3, 0 * SHIFT), (1e-3, SHIFT), (1e3, SHIFT), (1e6, SHIFT)])
def test_a_capture_comes_out_the_same_in_any_place_and_unit(tmp_path, kind, scale, shift):
    plain = jsecon.load_capture(written(kind, small_capture(), tmp_path / "plain", 1, 0 * SHIFT))
    there = jsecon.load_capture(written(kind, small_capture(), tmp_path / "there", scale, shift))
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


@pytest.mark.parametrize("shift", [0 * SHIFT, SHIFT])
def test_a_capture_from_one_place_keeps_its_unit(tmp_path, shift):
    """A tripod's poses, which differ by rounding, tell no size; large coordinates are centred all the same."""
    capture = small_capture()
    poses = capture.cameras.world_to_camera.copy()
    poses[:, :3, 3] = 1e-9 * np.arange(15).reshape(5, 3)
    capture = dataclasses.replace(capture, cameras=dataclasses.replace(capture.cameras, world_to_camera=poses))
    found = jsecon.load_capture(written("poses", capture, tmp_path, 1, shift))
    np.testing.assert_allclose(found.source_from_scene[:3, :3], np.eye(3))
    assert np.abs(found.cameras.centres).max() < 1
    np.testing.assert_allclose(found.source_from_scene[:3, 3] + found.cameras.centres[0], shift, atol=1e-3)


def test_the_world_of_a_capture_is_that_of_all_its_frames(tmp_path):
    """However many are loaded: a field of some of them goes with the capture of others."""
    folder = written("colmap", small_capture(), tmp_path, 1e-3, SHIFT)
    whole = jsecon.load_capture(folder)
    some = jsecon.load_capture(folder, frames=3)
    np.testing.assert_array_equal(some.source_from_scene, whole.source_from_scene)
    assert len(some.names) == 3


def test_a_spz_refuses_coordinates_that_it_cannot_hold(tmp_path, scene):
    """Fixed-point numbers of 24 bits: 2^-4 units at 455123, which is larger than Gaussians of 0.02."""
    small = dataclasses.replace(scene, log_scales=np.full_like(scene.log_scales, np.log(0.02)))
    source_from_scene = np.eye(4)
    source_from_scene[0, 3] = 455123.4
    with pytest.raises(jsecon.InputError, match=r"a\.spz.*positions"):
        jsecon.save_gaussians(tmp_path / "a.spz", small, similarity=source_from_scene)


def test_an_ordinary_scene_is_written_in_single_precision(tmp_path, scene):
    """As INRIA's readers expect it, whatever turns and moves it a little."""
    jsecon.save_gaussians(tmp_path / "a.ply", scene, similarity=np.diag([2.0, 2.0, 2.0, 1.0]) + np.eye(4, k=3))
    assert b"property double" not in (tmp_path / "a.ply").read_bytes()
