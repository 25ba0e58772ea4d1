"""The adapters of the real captures: layouts that are one of a kind, and what the captures show of conventions."""

import cv2
import numpy as np
import pytest

from experiments import apc_bin, replica_apartment_0 as replica
from jsecon.errors import InputError

CAMERAS = """# Environment: shelf
# Color camera intrinsic matrix
 600 0 31.5
 0 601 23.5
 0 0 1

# Depth camera intrinsic matrix
 1 0 0
 0 1 0
 0 0 1

# Camera-to-world extrinsic matrix (camera pose) for frame-000000
 1 0 0 0.5
 0 1 0 0
 0 0 1 -1
 0 0 0 1

# Camera-to-world extrinsic matrix (camera pose) for frame-000001
 0 0 1 2
 0 1 0 0
 -1 0 0 0
 0 0 0 1
"""


def encode_depth(metres):
    value = np.rint(np.asarray(metres) * 10_000).astype(np.uint16)
    return ((value << 3) | (value >> 13)).astype(np.uint16)


def test_apc_scene_is_read_as_documented(tmp_path):
    (tmp_path / "segm").mkdir()
    (tmp_path / "cam.info.txt").write_text(CAMERAS)
    for t in range(2):
        name = f"frame-{t:06d}"
        color = np.zeros((48, 64, 3), np.uint8)
        color[..., 2] = 200  # red, as OpenCV writes it
        segment = np.zeros((48, 64), np.uint8)
        segment[10:20, 5:9] = 114
        depth = np.full((48, 64), 1.2345)
        depth[:4] = 0.1
        cv2.imwrite(str(tmp_path / f"{name}.color.png"), color)
        cv2.imwrite(str(tmp_path / f"{name}.depth.png"), encode_depth(depth))
        cv2.imwrite(str(tmp_path / "segm" / f"{name}.segm.png"), segment)
    capture, labels = apc_bin.load_apc(tmp_path, held_out_every=2, nearest_m=0.2)
    assert capture.names == ("frame-000000", "frame-000001")
    np.testing.assert_array_equal(capture.held_out, [False, True])
    np.testing.assert_array_equal(capture.frames[0, 0, 0], [200, 0, 0])
    np.testing.assert_allclose(capture.depths[:, 4:], 1.2345, atol=1e-4)
    assert not capture.depths[:, :4].any()  # nearer than the sensor measures
    np.testing.assert_allclose(capture.cameras.centres, [[0.5, 0, -1], [2, 0, 0]], atol=1e-6)
    np.testing.assert_allclose([capture.cameras.cx[0], capture.cameras.cy[0]], [32, 24])  # integer centres become + 0.5
    assert (labels[0, 10:20, 5:9] == list(apc_bin.OBJECTS).index(114)).all()
    assert (labels == 4).sum() == 2 * (48 * 64 - 40)


def test_palette_is_forty_colours_read_back_exactly():
    assert len(set(replica.PALETTE)) == 40
    ids = np.random.default_rng(0).integers(0, 40, (30, 40))
    rgb = np.stack([replica.PALETTE[ids] >> 16, replica.PALETTE[ids] >> 8 & 255, replica.PALETTE[ids] & 255], -1)
    np.testing.assert_array_equal(replica.ids_of_colors(rgb.astype(np.uint8), "x"), ids)
    rgb[3, 4] = [1, 2, 3]
    with pytest.raises(InputError, match="010203"):
        replica.ids_of_colors(rgb.astype(np.uint8), "x")


def test_replica_poses_turn_from_opengl_to_opencv():
    half = np.sqrt(0.5)
    poses = np.array([[1.0, 2, 3, 1, 0, 0, 0], [1, 2, 3, half, 0, half, 0]])  # the second turned 90 degrees about y
    w2c = replica.world_to_camera(poses)
    ahead = np.array([[1.0, 2, 1, 1], [-1, 2, 3, 1]])  # an OpenGL camera looks along -z; turned about y, along -x
    for matrix, point in zip(w2c, ahead, strict=True):
        np.testing.assert_allclose(matrix @ point, [0, 0, 2, 1], atol=1e-6)
        np.testing.assert_allclose((matrix @ (point + np.array([0, 1, 0, 0])))[:3], [0, -1, 2], atol=1e-6)  # up is -y
