"""transforms.json: axes, intrinsics in every spelling, missing images, depth, points; damage is told."""

import dataclasses
import json

import cv2
import numpy as np
import pytest
from capture_files import assert_same, small_capture, transforms, write_images, write_transforms
from splat_files import write_ply

from jsecon.read.captures.capture import load_capture
from jsecon.read.captures.images import write_image

CAPTURE = small_capture()


def load_changed(tmp_path, change, **options):
    """Loads the capture after `change(content)` on its transforms.json."""
    content = transforms(CAPTURE)
    change(content)
    write_transforms(CAPTURE, tmp_path, content)
    return load_capture(tmp_path, **options)


def test_round_trip(tmp_path):
    loaded = load_changed(tmp_path, lambda content: None, holdout=0)
    assert_same(loaded, dataclasses.replace(CAPTURE, points=CAPTURE.points[:0], point_colors=CAPTURE.point_colors[:0]))
    assert loaded.notes == ()
    np.testing.assert_array_equal(loaded.source_from_scene, np.eye(4))


def test_camera_angle_and_sizes_from_the_images(tmp_path):
    def change(content):
        for record in (content, *content["frames"]):
            for key in ("w", "h", "fl_x", "fl_y", "cx", "cy"):
                record.pop(key, None)
        content["camera_angle_x"] = 2 * np.arctan(0.5 * 24 / 30)

    cameras = load_changed(tmp_path, change).cameras
    np.testing.assert_allclose([cameras.fx, cameras.fy], 30, rtol=1e-6)
    np.testing.assert_array_equal(cameras.cx, 12)
    np.testing.assert_array_equal(cameras.cy, 8)


def test_missing_images_are_said(tmp_path):
    write_transforms(CAPTURE, tmp_path)
    (tmp_path / "images/frame_001.png").unlink()
    (tmp_path / "images/frame_002.png").unlink()
    loaded = load_capture(tmp_path, holdout=2)
    assert loaded.names == ("frame_000", "frame_003", "frame_004")
    np.testing.assert_array_equal(loaded.frames, CAPTURE.frames[[0, 3, 4]])
    np.testing.assert_array_equal(loaded.held_out, [True, False, True])
    assert "2 of 5" in loaded.notes[0]
    assert "frame_001" in loaded.notes[0]


@pytest.mark.parametrize("size", [(16, 24), (32, 48)])
def test_black_pixels_of_a_mask_are_ignored(tmp_path, size):
    kept = np.full(size, 255, np.uint8)
    kept[: size[0] // 2, : size[1] // 4] = 0
    cv2.imwrite(str(tmp_path / "m.png"), kept)
    loaded = load_changed(tmp_path, lambda content: content["frames"][1].update(mask_path="m.png"), holdout=0)
    expected = np.zeros((5, 16, 24), bool)
    expected[1, :8, :6] = True
    np.testing.assert_array_equal(loaded.ignored, expected)


def test_applied_transform_and_scale_are_undone(tmp_path):
    """nerfstudio: world = scale * (applied_transform source)."""
    applied = [[1.0, 0, 0, 2.0], [0, 0, 1, 3.0], [0, -1, 0, 4.0]]
    loaded = load_changed(tmp_path, lambda content: content.update(applied_transform=applied, applied_scale=2.0))
    source = np.array([0.3, -0.4, 0.5, 1.0])
    world = np.append(2.0 * (np.array(applied) @ source), 1.0)
    np.testing.assert_allclose(loaded.source_from_scene @ world, source, atol=1e-12)


def test_depth_maps(tmp_path):
    """Millimetres to metres to the scaled world; resized to the frames by nearest; 0 where a frame has none."""
    counts = np.random.default_rng(0).integers(0, 5000, (16, 24)).astype(np.uint16)
    assert cv2.imwrite(str(tmp_path / "d.png"), counts)

    def change(content):
        content["frames"][1]["depth_file_path"] = "d.png"
        content["applied_scale"] = 2.0

    loaded = load_changed(tmp_path, change)
    np.testing.assert_allclose(loaded.depths[1], counts / 500, rtol=1e-6)
    assert not loaded.depths[[0, 2, 3, 4]].any()
    small = load_capture(tmp_path, downscale=2).depths[1]
    assert np.isin(small, loaded.depths[1]).all()


def test_points_from_a_ply(tmp_path):
    rows = np.array([[1, 2, 3, 4, 5, 6], [-1, 0.5, 0, 7, 8, 9]])
    colours = ("red", "green", "blue")
    columns = dict(zip((*"xyz", *colours), rows.T))
    write_ply(tmp_path / "sparse.ply", columns, "ascii", dict.fromkeys(colours, "uchar"))
    loaded = load_changed(tmp_path, lambda content: content.update(ply_file_path="sparse.ply"))
    np.testing.assert_array_equal(loaded.points, np.array([[1, 2, 3], [-1, 0.5, 0]], np.float32))
    np.testing.assert_array_equal(loaded.point_colors, [[4, 5, 6], [7, 8, 9]])


def test_distortion_keys(tmp_path):
    loaded = load_changed(tmp_path, lambda content: content.update(k1=0.1, k2=-0.02, p1=0.001, p2=0.0, k3=0.0, k4=0.0))
    assert "5 images were undistorted" in loaded.notes[0]
    fisheye = load_changed(tmp_path, lambda content: content.update(camera_model="OPENCV_FISHEYE", k1=0.1))
    assert not np.allclose(fisheye.cameras.fx, loaded.cameras.fx)


def test_names_with_dots_with_windows_separators_and_without_ending(tmp_path):
    """The ending is that of the file; what follows another dot belongs to the name."""
    write_images(CAPTURE, tmp_path / "images", ".PNG")
    content = transforms(CAPTURE, "")
    for n, entry in enumerate(content["frames"]):
        (tmp_path / f"images/frame_{n:03d}.PNG").rename(tmp_path / f"images/render.{n:04d}.PNG")
        entry["file_path"] = f".\\images\\render.{n:04d}" + (".png" if n == 3 else "")
    (tmp_path / "scene.JSON").write_text(json.dumps(content))
    loaded = load_capture(tmp_path / "scene.JSON", holdout=0)
    assert loaded.names == tuple(f"render.{n:04d}" for n in range(5))
    np.testing.assert_array_equal(loaded.frames, CAPTURE.frames)


def test_fox(shared):
    """67 entries, 17 of which have no image."""
    loaded = load_capture(shared / "captures/fox", downscale=2)
    assert loaded.frames.shape == (50, 960, 540, 3)
    assert "17 of 67" in loaded.notes[0]


@pytest.mark.parametrize("change", [{"frames": 1}, {"frames": 2, "shift": 1.0}], ids=["again", "elsewhere"])
def test_a_frame_that_is_listed_twice_is_taken_once(tmp_path, change):
    def twice(content):
        again = json.loads(json.dumps(content["frames"][change["frames"]]))
        again["file_path"] = f"./{again['file_path']}"
        again["transform_matrix"][0][3] += change.get("shift", 0.0)
        content["frames"].append(again)

    loaded = load_changed(tmp_path, twice, holdout=0)
    assert loaded.names == CAPTURE.names
    np.testing.assert_allclose(loaded.cameras.world_to_camera, CAPTURE.cameras.world_to_camera, atol=1e-6)
    assert "1 frames are listed twice" in loaded.notes[0]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e30, None, "zeros", "null"])
def test_a_lost_pose_is_left_out_and_counted(tmp_path, value):
    def lose(content):
        content["frames"][1]["transform_matrix"][2][3] = value
        if isinstance(value, str):
            content["frames"][1]["transform_matrix"] = None if value == "null" else np.zeros((4, 4)).tolist()

    loaded = load_changed(tmp_path, lose, holdout=0)
    assert loaded.names == (CAPTURE.names[0], *CAPTURE.names[2:])
    assert "1 of 5 frames were left out: they have no pose" in loaded.notes[0]


@pytest.mark.parametrize(("key", "value", "axis"), [
    ("orientation_override", "none", (0, 0, 1)), ("up", [0, -3.0, 0], (0, -1, 0)), ("orientation_override", "up", None),
])  # fmt: skip
def test_up_is_what_the_file_says(tmp_path, key, value, axis):
    loaded = load_changed(tmp_path, lambda content: content.update({key: value, "depth_unit_scale_factor": 0.001}))
    assert (loaded.up and loaded.up.axis) == axis
    assert loaded.metres_per_unit is None  # depth in any unit is no promise


@pytest.mark.parametrize("count", [1, 2])
def test_the_layout_of_nerf_is_read_and_its_test_images_are_held_out(tmp_path, count):
    """A file of poses for each part, with images of the same names in a folder of each."""
    content = transforms(CAPTURE)
    names = [f"./train/r_{n}" for n in range(5 - count)] + [f"./test/r_{n}" for n in range(count)]
    for name, entry, image in zip(names, content["frames"], CAPTURE.frames):
        write_image(tmp_path / f"{name}.png", image)
        entry["file_path"] = name
    for part, frames in (("train", content["frames"][:-count]), ("test", content["frames"][-count:])):
        (tmp_path / f"transforms_{part}.json").write_text(json.dumps(content | {"frames": frames}))
    loaded = load_capture(tmp_path)
    assert len(loaded.names) == 5
    assert [name for name, tested in zip(loaded.names, loaded.held_out) if tested] == [
        f"test_r_{n}" for n in range(count)
    ]


NAMES = [f"images/{name}.png" for name in CAPTURE.names]


def _by_lists(content):
    """Without suffix and with Windows' separators too; validation frames are kept from training like test frames."""
    content["train_filenames"] = ["./" + NAMES[0], NAMES[2].replace("/", "\\")]
    content["val_filenames"], content["test_filenames"] = [NAMES[1]], [NAMES[4].removesuffix(".png")]


def _by_training_list(content):
    content["train_filenames"] = [NAMES[0], NAMES[2], NAMES[3]]


def _by_frames(content):
    content["test_frames"] = [content["frames"].pop(4), content["frames"].pop(1)]


@pytest.mark.parametrize(("change", "left"), [(_by_lists, [0, 1, 2, 4]), (_by_training_list, 5), (_by_frames, 5)])
def test_the_captures_own_split_is_kept_unless_a_holdout_is_given(tmp_path, change, left):
    loaded = load_changed(tmp_path, change)
    kept = [*range(left)] if isinstance(left, int) else left
    assert loaded.names == tuple(CAPTURE.names[n] for n in kept)  # frame 3 is in none of the lists
    np.testing.assert_array_equal(loaded.held_out, [n in (1, 4) for n in kept])
    assert any("own split" in note for note in loaded.notes)
    other = load_capture(tmp_path, holdout=2)
    np.testing.assert_array_equal(other.held_out, np.arange(len(kept)) % 2 == 0)
    assert any("not used: a holdout is given" in note for note in other.notes)


def test_keys_that_change_what_numbers_mean_are_named(tmp_path):
    loaded = load_changed(tmp_path, lambda content: content["frames"][1].update(is_bad=True, depth_path="depth/1.png"))
    assert "depth_path, is_bad" in " ".join(loaded.notes)
