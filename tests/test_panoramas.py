"""Panoramas: cut into views of the right directions, of every format, with one pose; told from wide photographs."""

import dataclasses
import json

import cv2
import numpy as np
import pytest
from capture_files import context_of, refused, small_capture, transforms, write_text_model
from conftest import cameras_of
from photo_files import apart
from scipy.spatial.transform import Rotation

from jsecon.pipeline.scene_stages import plan_capture
from jsecon.poses.sfm import find_poses
from jsecon.read.captures.capture import load_capture, unposed_photographs
from jsecon.read.captures.images import write_image

WIDTH, HEIGHT = 384, 192
COUNT = 3


def pixel_directions(width=WIDTH, height=HEIGHT):
    """(H, W, 3) directions of a panorama's pixels: x right, y down, its middle along z."""
    longitude = 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    latitude = np.pi * ((np.arange(height) + 0.5) / height - 0.5)[:, None]
    flat = np.cos(latitude)
    return np.stack([flat * np.sin(longitude), np.sin(latitude) + 0 * longitude, flat * np.cos(longitude)], axis=-1)


def colours(directions):
    """A colour for each direction."""
    return 127.5 + 127.5 * directions / np.linalg.norm(directions, axis=-1, keepdims=True)


@pytest.fixture(scope="module")
def poses():
    """(COUNT, 4, 4) world-to-camera."""
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    poses[:, :3, :3] = Rotation.random(COUNT, random_state=1).as_matrix()
    poses[:, :3, 3] = np.random.default_rng(1).normal(0, 1, (COUNT, 3))
    return poses


def write_images(folder):
    image = np.round(colours(pixel_directions())).astype(np.uint8)
    for n in range(COUNT):
        write_image(folder / "images" / f"pano_{n:03d}.png", image)


def panoramas(poses):
    """A capture of photographs as wide as panoramas at these poses; its frames are none."""
    cameras = cameras_of(poses, (HEIGHT, HEIGHT, WIDTH / 2, HEIGHT / 2), WIDTH, HEIGHT)
    return dataclasses.replace(
        small_capture(COUNT), cameras=cameras, names=tuple(f"pano_{n:03d}" for n in range(COUNT))
    )


def write_nerfstudio(folder, poses, model="EQUIRECTANGULAR"):
    (folder / "transforms.json").write_text(json.dumps(transforms(panoramas(poses), camera_model=model)))


def write_colmap(folder, poses):
    lens = f"1 EQUIRECTANGULAR {WIDTH} {HEIGHT} {WIDTH} {HEIGHT}"
    write_text_model(panoramas(poses), folder / "sparse" / "0", [lens])


def write_opensfm(folder, poses):
    shots = {}
    for n, pose in enumerate(poses):
        turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec().tolist()
        place = {"rotation": turn, "translation": pose[:3, 3].tolist(), "camera": "v2 theta", "orientation": 1}
        shots[f"pano_{n:03d}.png"] = place
    cameras = {"v2 theta": {"projection_type": "spherical", "width": WIDTH, "height": HEIGHT}}
    points = {"7": {"color": [255.0, 12.0, 0.0], "coordinates": [0.1, -0.2, 0.3]}}
    models = [{"cameras": cameras, "shots": {}}, {"cameras": cameras, "shots": shots, "points": points}]
    (folder / "reconstruction.json").write_text(json.dumps(models))


WRITERS = (write_nerfstudio, write_colmap, write_opensfm)


@pytest.fixture(scope="module")
def captures(poses, tmp_path_factory):
    """The panoramas with poses, of each format."""
    loaded = []
    for write in WRITERS:
        folder = tmp_path_factory.mktemp("panoramas")
        write_images(folder)
        write(folder, poses)
        loaded.append(load_capture(folder, holdout=2))
    return loaded


def view_directions(camera):
    """(H, W, 3) directions of a pinhole's pixels in the world."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    x, y = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    return np.stack([x, y, np.ones_like(x)], axis=-1) @ np.asarray(camera.world_to_camera, np.float64)[:3, :3]


def test_views_show_the_right_directions_across_seam_and_poles(captures, poses):
    for capture in captures:
        for t, camera in enumerate(capture.cameras):
            of_panorama = view_directions(camera) @ poses[t // 8, :3, :3].T
            assert np.abs(capture.frames[t] - colours(of_panorama)).max() < 1.5
            down = np.degrees(np.arccos(of_panorama[..., 1] / np.linalg.norm(of_panorama, axis=-1)))
            np.testing.assert_array_equal(capture.ignored[t], down < 30)
    assert captures[0].ignored.any()


def test_every_direction_is_in_a_view_and_the_horizon_in_two(captures):
    directions, cameras = pixel_directions(180, 90).reshape(-1, 3), captures[0].cameras[:8]
    seen = np.zeros(len(directions), int)
    upright = np.asarray(cameras.world_to_camera[:, :3, :3]) @ np.asarray(cameras.world_to_camera[0, :3, :3]).T
    for camera, turn in zip(cameras, upright):
        x, y, z = turn @ directions.T
        inside = np.maximum(np.abs(x), np.abs(y)) / np.maximum(z, 1e-9) < camera.width / (2 * camera.fx)
        seen += inside & (z > 0)
    assert seen.min() >= 1
    assert np.mean(seen[np.abs(directions[:, 1]) < 0.05] >= 2) > 0.5


def test_the_views_of_a_panorama_are_one_rigid_rig(captures, poses):
    for capture in captures:
        assert capture.names[:3] == ("pano_000_0", "pano_000_1", "pano_000_2")
        views = np.asarray(capture.cameras.world_to_camera, np.float64).reshape(COUNT, 8, 4, 4)
        rig = views @ np.linalg.inv(poses)[:, None]
        np.testing.assert_allclose(rig, np.broadcast_to(rig[:1], rig.shape), atol=1e-6)
        np.testing.assert_allclose(rig[0, :, :3, 3], 0, atol=1e-6)
        assert "3 panoramas are cut into 8 views each" in " ".join(capture.notes)
        np.testing.assert_array_equal(capture.held_out, np.repeat([True, False, True], 8))
    np.testing.assert_allclose(captures[2].points, [[0.1, -0.2, 0.3]], atol=1e-6)
    np.testing.assert_array_equal(captures[2].point_colors, [[255, 12, 0]])


def test_a_limit_of_frames_takes_whole_panoramas_and_large_ones_are_shrunk(poses, tmp_path):
    write_images(tmp_path)
    write_nerfstudio(tmp_path, poses)
    capture = load_capture(tmp_path, frames=2, long_side=20)
    assert len(capture.names) == 16
    assert {name[:8] for name in capture.names} == {"pano_000", "pano_002"}
    truth = colours(view_directions(capture.cameras[13]) @ poses[2, :3, :3].T)
    assert np.abs(capture.frames[13] - truth).max() < 3


def test_wide_photographs_are_cut_only_where_their_camera_or_the_user_says_so(poses, tmp_path):
    write_images(tmp_path)
    write_nerfstudio(tmp_path, poses, model="OPENCV")
    capture = load_capture(tmp_path)
    assert len(capture.names) == COUNT
    assert capture.ignored is None
    (tmp_path / "transforms.json").unlink()
    assert "Give --panoramas" in plan_capture(context_of(tmp_path, tmp_path / "out"))[0].task
    declared = plan_capture(context_of(tmp_path, tmp_path / "out", panoramas=True))[0].task
    assert "3 of them panoramas" in declared
    assert "--panoramas" not in declared
    image = cv2.imencode(".jpg", np.zeros((HEIGHT, WIDTH, 3), np.uint8))[1].tobytes()
    xmp = b'http://ns.adobe.com/xap/1.0/\0<rdf:Description GPano:ProjectionType="equirectangular"/>'
    marked = image[:2] + b"\xff\xe1" + (len(xmp) + 2).to_bytes(2, "big") + xmp + image[2:]
    (tmp_path / "images" / "theta.jpg").write_bytes(marked)
    assert "1 of them panoramas" in plan_capture(context_of(tmp_path, tmp_path / "out"))[0].task
    write_image(tmp_path / "images" / "phone.png", np.zeros((30, 40, 3), np.uint8))
    with refused("phone.png", "40x30", "twice as wide as high"):
        plan_capture(context_of(tmp_path, tmp_path / "out", panoramas=True))
    write_nerfstudio(tmp_path, poses)
    with refused("--panoramas", "without poses"):
        plan_capture(context_of(tmp_path, tmp_path / "out", panoramas=True))


MARKS = (b"<GSpherical:ProjectionType>equirectangular</", b"sv3d\0\0\0\x1csvhd\0proj\0equi")


@pytest.mark.parametrize("mark", MARKS)
def test_a_video_of_panoramas_is_told_by_its_header(tmp_path, mark):
    def boxes(content):
        pieces = [(b"ftyp", b"isom"), (b"mdat", bytes(1 << 17)), (b"moov", content)]
        return b"".join((len(body) + 8).to_bytes(4, "big") + kind + body for kind, body in pieces)

    (tmp_path / "round.mp4").write_bytes(boxes(b"trak" + mark))
    (tmp_path / "walk.mp4").write_bytes(boxes(b"trak"))
    plans = [plan_capture(context_of(tmp_path / f"{name}.mp4", tmp_path / "out"))[0].task for name in ("round", "walk")]
    assert "the 50 sharpest panoramas of round.mp4" in plans[0]
    assert "the 150 sharpest frames of walk.mp4" in plans[1]


def test_poses_of_panoramas_are_found(tmp_path):
    pytest.importorskip("pycolmap")
    draw, count = np.random.default_rng(3), 3
    walls = [cv2.resize(draw.integers(0, 256, (32, 32, 3), np.uint8), (384, 384)) for _ in range(6)]
    true = np.tile(np.eye(4), (count, 1, 1))
    for n in range(count):
        turn, centre = Rotation.from_euler("YX", [70 * n, 5], degrees=True).as_matrix(), draw.uniform(-0.4, 0.4, 3)
        true[n, :3, :3], true[n, :3, 3] = turn, -turn @ centre
        rays = pixel_directions(400, 200) @ turn
        steps = (np.sign(rays) - centre) / rays  # to the walls of a cube from -1 to 1
        axis = steps.argmin(-1)
        points = (centre + steps.min(-1)[..., None] * rays).clip(-1, 1)
        side = 2 * axis + (np.take_along_axis(rays, axis[..., None], -1)[..., 0] > 0)
        image = np.zeros(rays.shape, np.uint8)
        for k in range(6):
            across = np.delete(points[side == k], k // 2, axis=1)
            columns, rows = ((across + 1) * 191.5).round().astype(int).T
            image[side == k] = walls[k][rows, columns]
        write_image(tmp_path / "images" / f"pano_{n}.png", image)
    photos = unposed_photographs(tmp_path)[0]
    capture, notes = find_poses(photos, tmp_path / "work", panoramas=photos)
    assert "3 of 3 photographs" in notes[0]
    cameras = load_capture(capture).cameras[::8]
    distances, degrees = apart(np.asarray(cameras.world_to_camera, np.float64), true)
    assert distances.max() < 0.01
    assert degrees.max() < 0.3
