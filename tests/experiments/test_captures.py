"""The adapters of the real captures: layouts that are one of a kind, and what the captures show of conventions."""

import dataclasses

import cv2
import jax
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


@pytest.fixture
def apc_folder(tmp_path):
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
    return tmp_path


def test_apc_scene_is_read_as_documented(apc_folder):
    capture, labels = apc_bin.load_apc(apc_folder, held_out_every=2, nearest_m=0.2)
    assert capture.names == ("frame-000000", "frame-000001")
    np.testing.assert_array_equal(capture.held_out, [False, True])
    np.testing.assert_array_equal(capture.frames[0, 0, 0], [200, 0, 0])
    np.testing.assert_allclose(capture.depths[:, 4:], 1.2345, atol=1e-4)
    assert not capture.depths[:, :4].any()  # nearer than the sensor measures
    np.testing.assert_allclose(capture.cameras.centres, [[0.5, 0, -1], [2, 0, 0]], atol=1e-6)
    np.testing.assert_allclose([capture.cameras.cx[0], capture.cameras.cy[0]], [32, 24])  # integer centres become + 0.5
    assert (labels[0, 10:20, 5:9] == list(apc_bin.OBJECTS).index(114)).all()
    assert (labels == 4).sum() == 2 * (48 * 64 - 40)


def test_apc_depth_survives_its_encoding():
    metres = np.random.default_rng(0).uniform(0, 6.5, 1000)
    np.testing.assert_allclose(apc_bin.decode_depth(encode_depth(metres)), metres, atol=6e-5)


def test_apc_scene_without_cameras_or_images_is_refused(apc_folder):
    with pytest.raises(InputError, match="intrinsic"):
        apc_bin.parse_cameras("# Color camera intrinsic matrix\n 1 0 0\n")
    (apc_folder / "frame-000001.depth.png").unlink()
    with pytest.raises(InputError, match="depth"):
        apc_bin.load_apc(apc_folder, held_out_every=2, nearest_m=0.2)
    with pytest.raises(InputError, match=r"cam\.info"):
        apc_bin.load_apc(apc_folder / "nowhere", held_out_every=2, nearest_m=0.2)


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


def test_replica_views_agree_on_depth_and_label(shared):
    """Half a pixel, the sign of an axis or the order of a quaternion would show here."""
    folder = shared / "captures" / "replica_apartment_0"
    poses = np.load(folder / "GT_pose.npy")
    few = np.array([0, 3, 6])
    w2c = replica.world_to_camera(poses[few]).astype(np.float64)
    depth = [cv2.imread(str(folder / "depth" / f"{t + 1}.png"), -1) / 25.5 for t in few]
    labels = [replica.ids_of_colors(cv2.imread(str(folder / "semantic" / f"{t + 1}.png"))[..., ::-1], t) for t in few]
    row, column = np.divmod(np.arange(0, 512 * 512, 37), 512)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        z = depth[a][row, column]
        camera = np.stack([(column + 0.5 - 256) / 256 * z, (row + 0.5 - 256) / 256 * z, z], axis=1)
        world = (camera - w2c[a, :3, 3]) @ w2c[a, :3, :3]
        seen = world @ w2c[b, :3, :3].T + w2c[b, :3, 3]
        x, y = (256 * seen[:, i] / np.maximum(seen[:, 2], 1e-9) + 256 for i in (0, 1))
        inside = (z > 0) & (seen[:, 2] > 0.1) & (x >= 0) & (x < 512) & (y >= 0) & (y < 512)
        x, y = x[inside].astype(int), y[inside].astype(int)
        near = np.abs(depth[b][y, x] - seen[inside, 2]) < 0.05
        assert inside.sum() > 500
        assert near.mean() > 0.9
        assert (labels[b][y, x] == labels[a][row, column][inside])[near].mean() > 0.97


@pytest.mark.long
def test_apc_small_voxels_select_an_object(shared):
    """The whole chain on five views of the real bin, coarse enough to be quick; the figure itself is the
    experiment's."""
    options = apc_bin.Options(voxel_m=0.008, scale=0.8)
    folder = shared / "captures" / "apc_bin" / "scene-0000"
    capture, labels = apc_bin.load_apc(folder, held_out_every=options.held_out_every, nearest_m=options.nearest_m)
    few = np.array([5, 6, 7, 8, 9])
    capture = dataclasses.replace(
        capture,
        frames=capture.frames[few],
        cameras=capture.cameras[few],
        depths=capture.depths[few],
        held_out=few == 7,
        names=tuple(capture.names[t] for t in few),
    )
    gaussians = apc_bin.build_gaussians(capture, options)
    field = apc_bin.build_field(gaussians, capture, labels[few])
    rows = apc_bin.evaluate(field, capture, labels[few], options, ways=("votes",))
    assert [r["object"] for r in rows] == list(apc_bin.OBJECTS.values())
    assert np.mean([r["iou"] for r in rows]) > 0.5
    assert all(bool(np.isfinite(leaf).all()) for leaf in jax.tree.leaves(gaussians))
