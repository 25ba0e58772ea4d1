"""COLMAP captures: binary and text say the same, distorted models are undone, damage is told."""

import dataclasses
import struct

import numpy as np
import pytest
from capture_files import assert_same, numbers, refused, small_capture, write_images, write_text_model

from experiments.rooms.writers import write_colmap
from jsecon import load_capture
from jsecon.read.captures.capture import read_posed_images
from jsecon.read.captures.images import write_image

CAPTURE = small_capture()


@pytest.fixture
def folder(tmp_path):
    write_colmap(CAPTURE, tmp_path / "scene")
    return tmp_path / "scene"


def test_tracks_of_all_lengths_and_observations(folder):
    records = []
    for n, (point, colour) in enumerate(zip(CAPTURE.points, CAPTURE.point_colors)):
        records.append(struct.pack("<Q3d3BdQ", n, *point, *map(int, colour), 0.5, n % 9) + bytes(8 * (n % 9)))
    (folder / "sparse/0/points3D.bin").write_bytes(struct.pack("<Q", len(records)) + b"".join(records))
    images = (folder / "sparse/0/images.bin").read_bytes()
    size = len(CAPTURE.names[0]) + 5 + 64
    heads = [images[8 + n * (size + 8) : 8 + n * (size + 8) + size] for n in range(5)]
    bodies = [head + struct.pack("<Q", n) + bytes(24 * n) for n, head in enumerate(heads)]
    bodies = bodies[3:] + bodies[:3]  # frames come by name
    (folder / "sparse/0/images.bin").write_bytes(images[:8] + b"".join(bodies))
    (folder / "sparse/0/rigs.bin").write_bytes(b"of a newer COLMAP")
    assert_same(load_capture(folder, holdout=0), CAPTURE)
    loaded = load_capture(folder, frames=3, holdout=3)
    assert loaded.names == tuple(CAPTURE.names[n] for n in (0, 2, 4))
    np.testing.assert_array_equal(loaded.held_out, [True, False, False])
    (folder / "sparse/0/points3D.bin").unlink()
    assert load_capture(folder).points.shape == (0, 3)


def test_the_split_of_inrias_training_is_kept(folder):
    (folder / "sparse/0/test.txt").write_text("frame_001.png\nframe_003.png\n")
    np.testing.assert_array_equal(load_capture(folder).held_out, [False, True, False, True, False])
    np.testing.assert_array_equal(load_capture(folder, holdout=4).held_out, [True, False, False, False, True])


def test_smaller_images_than_the_model_says(tmp_path):
    """As in a folder of images_2 renamed: intrinsics follow the files."""
    write_text_model(CAPTURE, tmp_path / "sparse/0")
    for name, frame in zip(CAPTURE.names, CAPTURE.frames):
        write_image(tmp_path / "images" / f"{name}.png", frame[::2, ::2])
    loaded = load_capture(tmp_path)
    np.testing.assert_allclose(loaded.cameras.fx, CAPTURE.cameras.fx / 2)
    write_image(tmp_path / "images" / f"{CAPTURE.names[3]}.png", np.zeros((24, 16, 3), np.uint8))
    with refused("frame_003.png", "16x24", "24x16"):
        load_capture(tmp_path)


def test_images_of_different_sizes(tmp_path):
    """The commonest size wins; the odd one keeps its geometry through unequal focal lengths."""
    lines = ["1 PINHOLE 24 16 20 20 12 8", "2 PINHOLE 16 24 20 20 8 12"]
    write_text_model(CAPTURE, tmp_path / "sparse/0", lines)
    images = (tmp_path / "sparse/0/images.txt").read_text().replace("1 frame_002.png", "2 frame_002.png")
    (tmp_path / "sparse/0/images.txt").write_text(images)
    write_images(CAPTURE, tmp_path / "images")
    write_image(tmp_path / "images/frame_002.png", np.full((24, 16, 3), 99, np.uint8))
    loaded = load_capture(tmp_path)
    assert loaded.frames.shape == (5, 16, 24, 3)
    np.testing.assert_allclose([loaded.cameras.fx[2], loaded.cameras.fy[2]], [30, 20 * 16 / 24], rtol=1e-6)
    np.testing.assert_allclose([loaded.cameras.cx[2], loaded.cameras.cy[2]], [12, 8])


def picture(x, y):
    """A smooth picture painted on the plane z = 1."""
    return 128 + 60 * np.sin(7 * x + 1) + 60 * np.cos(6 * y)


@pytest.mark.parametrize(("model", "parameters"), [
    ("SIMPLE_PINHOLE", (90.0, 59.0, 46.0)), ("SIMPLE_RADIAL", (108.0, 59.0, 46.0, -0.12)),
    ("RADIAL", (108.0, 59.0, 46.0, 0.1, 0.05)), ("OPENCV", (108.0, 105.0, 59.0, 46.0, -0.1, 0.03, 0.004, -0.003)),
    ("FULL_OPENCV", (108.0, 105.0, 59.0, 46.0, 0.2, 0.05, 0.001, 0.002, 0.01, 0.25, 0.02, 0.005)),
    ("OPENCV_FISHEYE", (90.0, 88.0, 59.0, 46.0, 0.03, -0.01, 0.002, 0.001)),
    ("SIMPLE_RADIAL_FISHEYE", (90.0, 59.0, 46.0, 0.05)), ("RADIAL_FISHEYE", (90.0, 59.0, 46.0, 0.04, -0.02)),
    ("SIMPLE_FISHEYE", (90.0, 59.0, 46.0)), ("FISHEYE", (90.0, 88.0, 59.0, 46.0)),
])  # fmt: skip
def test_every_model_is_undistorted_as_colmap_projects_it(tmp_path, model, parameters):
    """A binary model that pycolmap writes, and images as pycolmap's camera sees the plane z = 1."""
    colmap = pytest.importorskip("pycolmap")
    width, height = 120, 90
    camera = colmap.Camera(model=model, width=width, height=height, params=parameters, camera_id=1)
    v, u = np.mgrid[:height, :width] + 0.5
    seen = camera.cam_from_img(np.stack([u, v], -1).reshape(-1, 2)).reshape(height, width, 2)
    image = np.repeat(picture(seen[..., 0], seen[..., 1]).round().astype(np.uint8)[..., None], 3, -1)
    capture = small_capture(2, width, height)
    write_colmap(dataclasses.replace(capture, frames=np.stack([image, image])), tmp_path)
    head = struct.pack("<iQQ", getattr(colmap.CameraModelId, model).value, width, height)
    cameras = (struct.pack("<i", n) + head + np.array(parameters, "<f8").tobytes() for n in (1, 2))
    (tmp_path / "sparse/0/cameras.bin").write_bytes(struct.pack("<Q", 2) + b"".join(cameras))
    loaded = load_capture(tmp_path, holdout=0)
    pinhole = loaded.cameras[0]
    expected = picture((u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy)
    error = np.abs(loaded.frames[0, ..., 0] - expected)
    # Bilinear sampling and two roundings of a picture whose second difference is below one level; half a pixel of
    # misplacement would cost over 1 on average.
    assert error.max() < 3
    assert error.mean() < 0.5
    assert loaded.notes == () if model == "SIMPLE_PINHOLE" else "2 images were undistorted" in loaded.notes[0]
    # Each pixel looks along its own direction: the focal length is one that the image covers.
    assert 0.8 < pinhole.fx / parameters[0] < 1.2


def test_the_largest_of_several_models_is_taken_and_the_others_are_named(tmp_path):
    write_colmap(CAPTURE, tmp_path)
    (tmp_path / "sparse/0").rename(tmp_path / "sparse/10")
    small = small_capture(2)
    write_colmap(small, tmp_path / "other")
    (tmp_path / "other/sparse/0").rename(tmp_path / "sparse/0")
    write_text_model(small, tmp_path / "sparse/2")
    loaded = load_capture(tmp_path, holdout=0)
    assert_same(loaded, CAPTURE)
    assert "Of 3 models the largest, sparse/10 with 5 images" in loaded.notes[0]


@pytest.mark.parametrize("place", ["sparse/1", "sparse", "colmap/sparse/0", "colmap_text", ""])
def test_places_where_programs_put_a_model(tmp_path, place):
    write_text_model(CAPTURE, tmp_path / place)
    write_images(CAPTURE, tmp_path if place == "" else tmp_path / "images")
    assert_same(load_capture(tmp_path, holdout=0), CAPTURE)


NAMES = ["ä 図 1.png", "1 2 3.png", "0001.png", "cam a/p.png", "cam b/p.png"]
SECONDS = {
    "none": 5 * [[]],
    "empty": 5 * [[""]],
    "observations": 5 * [["1.5 2.5 -1 3 4 17 1e2 2 3 nan -inf 6"]],
    "mixed": [[], [""], ["12 13 14"], [], ["1.5 2.5 -1"]],
}


@pytest.mark.parametrize(("second", "encoding"), [*zip(SECONDS, ("utf-8", "utf-8-sig", "utf-8", "utf-8"))])
def test_images_txt_with_and_without_its_second_lines(tmp_path, second, encoding):
    """What follows a first line is a second one only where it is a list of triples."""
    write_text_model(CAPTURE, tmp_path / "sparse")
    lines = [line for line in (tmp_path / "sparse/images.txt").read_text().split("\n") if ".png" in line]
    lines = [line.rpartition(" ")[0] + " " + name for line, name in zip(lines, NAMES)]
    lines = ["# a comment", *(line for own, more in zip(lines, SECONDS[second]) for line in (own, *more))]
    (tmp_path / "sparse/images.txt").write_text("\n".join(lines))
    for file in (tmp_path / "sparse").iterdir():
        file.write_bytes(file.read_text().replace("\n", "\r\n").encode(encoding))
    for name, frame in zip(NAMES, CAPTURE.frames):
        write_image(tmp_path / "images" / name, frame)
    loaded = load_capture(tmp_path, holdout=0)
    place = [loaded.names.index(name) for name in ("ä 図 1", "1 2 3", "0001", "cam a_p", "cam b_p")]
    np.testing.assert_array_equal(loaded.frames[place], CAPTURE.frames)
    np.testing.assert_allclose(loaded.cameras.world_to_camera[place], CAPTURE.cameras.world_to_camera, atol=1e-6)
    assert len(loaded.points) == len(CAPTURE.points)


def test_names_that_clash(tmp_path):
    """Folders tell them apart; endings alone do not."""
    write_text_model(CAPTURE, tmp_path / "sparse")
    path = tmp_path / "sparse/images.txt"
    path.write_text(path.read_text().replace("frame_001.png", "left/a.png").replace("frame_003.png", "right/a.png"))
    names = "frame_000", "left/a", "frame_002", "right/a", "frame_004"
    for name, frame in zip(names, CAPTURE.frames):
        write_image(tmp_path / "images" / f"{name}.png", frame)
    assert load_capture(tmp_path).names == ("frame_000", "frame_002", "frame_004", "left_a", "right_a")
    path.write_text(path.read_text().replace("right/a.png", "left/a.jpg"))
    (tmp_path / "images/right/a.png").rename(tmp_path / "images/left/a.jpg")
    with refused("left/a.png", "left/a.jpg"):
        load_capture(tmp_path)


def test_bonsai(shared):
    """The real model: what COLMAP's tracks say it saw is where the loaded cameras see it."""
    loaded = load_capture(shared / "captures/bonsai", frames=4, downscale=4)
    assert loaded.frames.shape == (4, 133, 200, 3)
    assert loaded.points.shape == (35058, 3)
    assert len(read_posed_images(shared / "captures/bonsai/").images) == 125
    np.testing.assert_allclose(loaded.cameras.fx, 205.4657, atol=0.01)
    seen = np.einsum("tij,pj->tpi", loaded.cameras.world_to_camera[:, :3, :3], loaded.points)
    assert ((seen + loaded.cameras.world_to_camera[:, None, :3, 3])[..., 2] > 0).mean(1).min() > 0.5


@pytest.mark.parametrize(("place", "pose", "value"), [(44, [np.nan], np.nan), (12, [0.0] * 4, -np.inf)])
def test_lost_poses_and_points_are_left_out_and_counted(folder, place, pose, value):
    """A pose with a number that is not finite, and one whose quaternion is 0."""
    numbers("sparse/0/images.bin", place, f"<{len(pose)}d", *pose)(folder)
    numbers("sparse/0/points3D.bin", 8 + 3 * 51 + 16, "<d", value)(folder)  # y of the point 3
    loaded = load_capture(folder)
    assert len(loaded.names) == len(CAPTURE.names) - 1
    assert len(loaded.points) == len(CAPTURE.points) - 1
    assert "1 of 5 frames were left out: they have no pose" in loaded.notes[0]
    assert any("1 sparse points were left out" in note for note in loaded.notes)


@pytest.mark.parametrize("inner", ["sparse/0", "sparse"])
def test_a_model_given_without_its_capture_has_the_images_above_it(folder, inner):
    if inner == "sparse":
        for file in (folder / "sparse/0").iterdir():
            file.rename(folder / "sparse" / file.name)
    assert load_capture(folder / inner).names == CAPTURE.names
