"""Folders of depth cameras and phones, written here as their makers lay them out, against the capture in them."""

import dataclasses
import json

import cv2
import numpy as np
import pytest
from capture_files import context_of, refused, small_capture
from scipy.spatial.transform import Rotation

from jsecon import load_capture
from jsecon.pipeline.scene_stages import plan_capture
from jsecon.read.captures.images import write_image

_RANDOM = small_capture(count=12)
_ONE = {name: np.full(12, getattr(_RANDOM.cameras, name)[0]) for name in ("fx", "fy", "cx", "cy")}
CAPTURE = dataclasses.replace(
    _RANDOM,
    cameras=dataclasses.replace(_RANDOM.cameras, **_ONE),
    depths=np.random.default_rng(1).integers(500, 6000, (12, 16, 24)).astype(np.float32) / 1000,
)
K = tuple(float(values[0]) for values in _ONE.values())
SIZE = 24, 16


def poses(axes=(1, 1, 1)) -> np.ndarray:
    """(12, 4, 4) camera to world, with these signs of the camera's axes."""
    return np.linalg.inv(CAPTURE.cameras.world_to_camera.astype(np.float64)) @ np.diag([*axes, 1])


def depth(path, n: int, unit: float = 0.001) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.round(CAPTURE.depths[n] / unit).astype(np.uint16))


def write_scannet(folder) -> None:
    """JPEG is lossy: PNGs stand for them. Frame 4 was lost by the tracker."""
    (folder / "pose").mkdir(parents=True)
    (folder / "intrinsic").mkdir()
    matrix = np.eye(4)
    matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2] = K
    for kind in ("color", "depth"):
        np.savetxt(folder / "intrinsic" / f"intrinsic_{kind}.txt", matrix)
    for n, pose in enumerate(poses()):
        write_image(folder / "color" / f"{n}.png", CAPTURE.frames[n])
        depth(folder / "depth" / f"{n}.png", n)
        np.savetxt(folder / "pose" / f"{n}.txt", np.full((4, 4), -np.inf) if n == 4 else pose)


def write_tum(folder) -> None:
    """Poses come more often than images, at other times; image 4 has none near. Names may have spaces."""
    times = 1305031102.17 + 0.1 * np.arange(12)
    lines = {"rgb": ["# color images"], "depth": ["# depth maps"], "groundtruth": ["# timestamp tx ty tz qx qy qz qw"]}
    for n, pose in enumerate(poses()):
        write_image(folder / "rgb images" / f"{times[n]:.6f}.png", CAPTURE.frames[n])
        depth(folder / "depth" / f"{times[n] + 0.007:.6f}.png", n, 1 / 5000)
        lines["rgb"].append(f"{times[n]:.6f} rgb images/{times[n]:.6f}.png")
        lines["depth"].append(f"{times[n] + 0.007:.6f} depth/{times[n] + 0.007:.6f}.png")
        numbers = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        for late, pose_then in ((0.004, numbers), (0.05, [9, 9, 9, 0, 0, 0, 1])):
            if n != 4 or late > 0.01:
                lines["groundtruth"].append(" ".join(map(str, [times[n] + late, *pose_then])))
    for name, text in lines.items():
        (folder / f"{name}.txt").write_text("\n".join(text) + "\n", encoding="utf-8-sig")
    (folder / "intrinsics.txt").write_text(" ".join(map(str, [K[0], K[1], K[2] - 0.5, K[3] - 0.5])))


def write_arkitscenes(folder) -> None:
    lines = []
    for n, pose in enumerate(np.linalg.inv(poses())):
        name = f"41069021_{100 + n / 10:.3f}"
        write_image(folder / "lowres_wide" / f"{name}.png", CAPTURE.frames[n])
        depth(folder / "lowres_depth" / f"{name}.png", n)
        near = f"41069021_{100 + n / 10 + 0.001 * (n % 3 - 1):.3f}"  # of intrinsics: up to a millisecond off
        file = folder / "lowres_wide_intrinsics" / f"{near}.pincam"
        file.parent.mkdir(exist_ok=True)
        file.write_text(" ".join(map(str, [*SIZE, *K])))
        if n != 4:
            numbers = [*Rotation.from_matrix(pose[:3, :3]).as_rotvec(), *pose[:3, 3]]
            lines.append(" ".join(map(str, [100.0012 + n / 10, *numbers])))
    (folder / "lowres_wide.traj").write_text("\n".join(lines) + "\n")


def write_polycam(folder) -> None:
    frames = folder / "keyframes"
    (frames / "corrected_cameras").mkdir(parents=True)
    for n, pose in enumerate(poses((1, -1, -1))):
        write_image(frames / "corrected_images" / f"{100 + n}.png", CAPTURE.frames[n])
        depth(frames / "depth" / f"{100 + n}.png", n)
        told = {f"t_{i}{j}": pose[i, j] for i in range(3) for j in range(4)}
        told |= dict(zip(("fx", "fy", "cx", "cy", "width", "height"), [*K, *SIZE])) | {"blur_score": 90.1}
        if n != 4:
            (frames / "corrected_cameras" / f"{100 + n}.json").write_text(json.dumps(told))


def write_record3d(folder) -> None:
    rows = [[*Rotation.from_matrix(pose[:3, :3]).as_quat(), *pose[:3, 3]] for pose in poses((1, -1, -1))]
    for n in range(13):
        write_image(folder / "rgb" / f"{n}.png", CAPTURE.frames[min(n, 11)])
    fx, fy, cx, cy = K
    told = {"w": 24, "h": 16, "K": [fx, 0, 0, 0, fy, 0, cx, cy, 1], "poses": rows}
    (folder / "metadata.json").write_text(json.dumps(told))


def write_replica(folder) -> None:
    """With the parameters of the camera in the scene; the downloads have them one folder up."""
    rows = [np.full(16, np.inf) if n == 4 else pose.ravel() for n, pose in enumerate(poses())]
    for n in range(12):
        write_image(folder / "results" / f"frame{n:06d}.png", CAPTURE.frames[n])
        depth(folder / "results" / f"depth{n:06d}.png", n, 1 / 6553.5)
    np.savetxt(folder / "traj.txt", rows)
    camera = {"w": 24, "h": 16, "fx": K[0], "fy": K[1], "cx": K[2] - 0.5, "cy": K[3] - 0.5, "scale": 6553.5}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))


WRITERS = write_scannet, write_replica, write_tum, write_arkitscenes, write_polycam, write_record3d
FORMATS = {write.__name__.removeprefix("write_"): write for write in WRITERS}


def expected(name: str) -> list[int]:
    return list(range(12)) if name == "record3d" else [n for n in range(12) if n != 4]


@pytest.mark.parametrize("name", FORMATS)
def test_the_capture_comes_back(tmp_path, name):
    FORMATS[name](tmp_path / name)
    found, kept = load_capture(tmp_path / name, holdout=0), expected(name)
    np.testing.assert_array_equal(found.frames, CAPTURE.frames[kept])  # in the order of their numbers
    np.testing.assert_allclose(found.cameras.world_to_camera, CAPTURE.cameras.world_to_camera[kept], atol=1e-5)
    for value, field in zip(K, ("fx", "fy", "cx", "cy")):
        np.testing.assert_allclose(getattr(found.cameras, field), value, rtol=1e-6)
    if name == "record3d":
        assert found.depths is None
        assert any("depth was not read" in note for note in found.notes)
    else:
        np.testing.assert_allclose(found.depths, CAPTURE.depths[kept], atol=1e-4)
    assert any("1 of 1" in note and "no pose" in note for note in found.notes)
    gravity = {"arkitscenes": (0, 0, 1), "polycam": (0, 1, 0), "record3d": (0, 1, 0)}.get(name)
    assert (found.up and found.up.axis) == gravity  # the others know none
    assert found.metres_per_unit == 1
    if name == "scannet":
        assert found.names == tuple(map(str, kept))


def test_a_depth_camera_of_its_own_is_seen_through_the_colour_camera(tmp_path):
    """ScanNet's depth has another size, shape and focal length than its colour images."""
    write_scannet(tmp_path)
    matrix = np.eye(4)
    matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2] = 30, 30, 20, 15
    np.savetxt(tmp_path / "intrinsic" / "intrinsic_depth.txt", matrix)
    ramp = np.tile(np.arange(40, dtype=np.uint16) * 100 + 1000, (30, 1))  # rises with the ray's x / z
    for n in range(12):
        cv2.imwrite(str(tmp_path / "depth" / f"{n}.png"), ramp)
    found = load_capture(tmp_path, holdout=0)
    rays = (np.arange(24) + 0.5 - K[2]) / K[0]
    columns = rays * 30 + 20
    seen = np.where((columns >= 0) & (columns < 40), np.floor(columns) / 10 + 1, 0)
    np.testing.assert_allclose(found.depths[0, 8], seen, atol=1e-5)


@pytest.mark.parametrize(("camera", "fx", "bent"), [("freiburg1", 517.3, True), ("fr3", 535.4, False)])
def test_the_benchmarks_own_cameras_are_known_by_name(tmp_path, camera, fx, bent):
    folder = tmp_path / f"rgbd_dataset_{camera}_desk"
    write_tum(folder)
    (folder / "intrinsics.txt").unlink()
    for file in (folder / "rgb images").iterdir():
        cv2.imwrite(str(file), np.zeros((480, 640, 3), np.uint8))
    for file in (folder / "depth").iterdir():
        cv2.imwrite(str(file), np.full((480, 640), 5000, np.uint16))
    found = load_capture(folder, holdout=0, frames=2)
    assert any("undistorted" in note for note in found.notes) == bent
    if not bent:
        np.testing.assert_allclose([found.cameras.fx[0], found.cameras.cx[0]], [fx, 320.6], rtol=1e-6)


def test_polycam_without_sizes(tmp_path):
    """Recent corrected_cameras/ name none: then they are those of the images, which the numbers must fit."""
    write_polycam(tmp_path)
    frames = tmp_path / "keyframes"
    for file in (frames / "corrected_cameras").iterdir():
        told = json.loads(file.read_text())
        del told["width"], told["height"]
        file.unlink()
        file.with_suffix(".JSON").write_text(json.dumps(told))
    found = load_capture(tmp_path, holdout=0)
    assert (found.cameras.width, found.cameras.height) == SIZE
    np.testing.assert_allclose(found.cameras.cy, K[3], rtol=1e-6)
    assert len(found.names) == 11
    for n in range(12):
        cv2.imwrite(str(frames / "corrected_images" / f"{100 + n}.png"), CAPTURE.frames[n, ::2, ::2])
    with refused("cameras", "12x8", "centre"):
        load_capture(tmp_path)


def test_record3d_as_its_archive_unpacks(tmp_path):
    write_record3d(tmp_path)
    (tmp_path / "rgb").rename(tmp_path / "rgbd")
    told = json.loads((tmp_path / "metadata.json").read_text())
    (tmp_path / "metadata.json").unlink()
    (tmp_path / "metadata").write_text(json.dumps({name: told[name] for name in ("K", "poses")}))
    found = load_capture(tmp_path, holdout=0)
    np.testing.assert_array_equal(found.frames, CAPTURE.frames)
    np.testing.assert_allclose(found.cameras.cx, K[2], rtol=1e-6)


def test_replicas_parameters_lie_in_the_scene_or_above(tmp_path):
    folder = tmp_path / "inner" / "scene"
    write_replica(folder)
    expected = load_capture(folder)
    (folder / "cam_params.json").rename(folder.parent / "cam_params.json")
    np.testing.assert_array_equal(load_capture(folder).cameras.cx, expected.cameras.cx)
    (folder.parent / "cam_params.json").unlink()
    with refused("cam_params.json", "intrinsics", "transforms.json"):
        load_capture(folder)
    (folder / "results" / "frame000007.png").unlink()
    with refused("traj.txt", "12 poses for 11 images"):
        load_capture(folder)


@pytest.mark.parametrize(("write", "inner"), [
    (write_polycam, "keyframes"), (write_scannet, "color"), (write_replica, "results"), (write_tum, "rgb images"),
])  # fmt: skip
def test_a_part_of_a_capture_names_the_whole(tmp_path, write, inner):
    write(tmp_path / "scan")
    with refused(inner, "part of a", tmp_path / "scan"):
        plan_capture(context_of(tmp_path / "scan" / inner, tmp_path / "out"))
