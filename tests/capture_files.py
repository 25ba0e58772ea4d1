"""Small captures on disk, for the tests of the data room."""

import contextlib
import json
import struct
import zlib

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jsecon import Camera, Capture, InputError
from jsecon.app import cli
from jsecon.pipeline.options import Options
from jsecon.pipeline.run import _run_stages
from jsecon.pipeline.stages import Checkpoint, Results, RunContext, Stage, StageInput, StageResult
from jsecon.vision.colours import ColourEmbedder
from jsecon.vision.protocols import Models


def run_cli(*arguments) -> int:
    """The exit code of `jsecon` with these words."""
    return cli.main([str(argument) for argument in arguments])


@contextlib.contextmanager
def refused(*parts):
    """A context in which an InputError must be raised that names each of `parts`, and a remedy."""
    with pytest.raises(InputError) as info:
        yield
    for part in parts:
        assert str(part) in str(info.value)
    assert info.value.problem
    assert info.value.remedy


def context_of(capture, out, **options) -> RunContext:
    """What the stages of a run without models share."""
    return RunContext(Options(capture, **options), Models(ColourEmbedder()), out)


def compute_stage(work: RunContext, name: str, **results) -> tuple[StageResult, Stage]:
    """The outcome of a stage of a run, given the results of others, and the stage."""
    stage = next(stage for stage in _run_stages(work) if stage.name == name)
    return stage.compute(StageInput(work, Results(**results), lambda done, total: None, Checkpoint(work.out))), stage


ROOM_FIT = {"holdout": 4, "steps": 110}
"""options of the fixture `room_run`: two chunks of steps and a part of a third, one growth"""


def ring_poses(count: int, radius: float = 3.0) -> np.ndarray:
    """(count, 4, 4) float64 world-to-camera around the origin, looking at it, each with a roll of its own."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    angles = np.stack([0.3 * np.arange(count), np.linspace(0, 2 * np.pi, count, endpoint=False)], 1)
    poses[:, :3, :3] = Rotation.from_euler("ZY", angles).as_matrix()
    poses[:, 2, 3] = radius
    return poses


def small_capture(count: int = 5, width: int = 24, height: int = 16, points: int = 50) -> Capture:
    """Random images of a ring of cameras, two intrinsics among them."""
    rng = np.random.default_rng(7)
    half = np.arange(count) % 2
    lenses = ((value + half).astype(np.float32) for value in (20.25, 21.5))
    centre = (np.full(count, value, np.float32) for value in (11.75, 8.5))
    cameras = Camera(ring_poses(count).astype(np.float32), *lenses, *centre, width=width, height=height)
    return Capture(
        frames=rng.integers(0, 256, (count, height, width, 3), np.uint8),
        cameras=cameras,
        points=rng.normal(0, 0.3, (points, 3)).astype(np.float32),
        point_colors=rng.integers(0, 256, (points, 3), np.uint8),
        held_out=np.zeros(count, bool),
        depths=None,
        source_from_scene=np.eye(4),
        names=tuple(f"frame_{index:03d}" for index in range(count)),
    )


def assert_same(loaded, expected):
    np.testing.assert_array_equal(loaded.frames, expected.frames)
    np.testing.assert_array_equal(loaded.points, expected.points)
    np.testing.assert_array_equal(loaded.point_colors, expected.point_colors)
    assert loaded.names == expected.names
    assert (loaded.cameras.width, loaded.cameras.height) == (expected.cameras.width, expected.cameras.height)
    for field in ("world_to_camera", "fx", "fy", "cx", "cy"):
        np.testing.assert_allclose(getattr(loaded.cameras, field), getattr(expected.cameras, field), atol=1e-6)


def write_images(capture: Capture, folder, ending: str = ".png") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, frame in zip(capture.names, capture.frames):
        assert cv2.imwrite(str(folder / (name + ending)), frame[..., ::-1])


def write_text_model(capture: Capture, folder, cameras: list[str] | None = None) -> None:
    """The capture as a COLMAP text model; `cameras` replaces the lines of cameras.txt (camera 1 takes them all)."""
    folder.mkdir(parents=True, exist_ok=True)

    def words(numbers):
        return " ".join(repr(float(number)) for number in numbers)

    lenses = np.stack([capture.cameras.fx, capture.cameras.fy, capture.cameras.cx, capture.cameras.cy], -1)
    size = f"{capture.cameras.width} {capture.cameras.height}"
    lines = cameras or [f"{n} PINHOLE {size} {words(lens)}" for n, lens in enumerate(lenses, start=1)]
    (folder / "cameras.txt").write_text("\n".join(["# CAMERA_ID, MODEL, ...", *lines, ""]))
    lines = ["# two lines an image"]
    for n, (name, pose) in enumerate(zip(capture.names, capture.cameras.world_to_camera.astype(np.float64)), start=1):
        turn = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
        # One image has observations, the next an empty line, as COLMAP writes them.
        lines += [f"{n} {words((*turn, *pose[:3, 3]))} {1 if cameras else n} {name}.png"]
        lines += ["1.5 2.5 -1 3 4 17" if n % 2 else ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    lines = ["# POINT3D_ID ..."]
    for n, (point, (red, green, blue)) in enumerate(zip(capture.points, capture.point_colors), start=1):
        lines.append(f"{n} {words(point)} {red} {green} {blue} 0.5 1 2 2 3")
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n")


def write_mask(path, image) -> None:
    """Numbers of pixels as a PNG, of 16 bits where 8 do not hold them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.asarray(image, np.uint8 if np.max(image) < 256 else np.uint16))


def run_lengths(mask: np.ndarray) -> dict:
    """COCO's uncompressed run lengths: down the columns, of 0 first."""
    flat = np.concatenate([[False], mask.T.ravel()])
    return {"size": list(mask.shape), "counts": np.diff([0, *np.flatnonzero(np.diff(flat)), mask.size]).tolist()}


def transforms(capture: Capture, ending: str = ".png", **more) -> dict:
    """The capture as a transforms.json with intrinsics a frame."""
    cameras, frames = capture.cameras, []
    for index, name in enumerate(capture.names):
        pose = np.linalg.inv(cameras.world_to_camera[index].astype(np.float64)) @ np.diag([1, -1, -1, 1])
        lens = {"fl_x": float(cameras.fx[index]), "fl_y": float(cameras.fy[index])}
        frames.append({"file_path": f"images/{name}{ending}", "transform_matrix": pose.tolist(), **lens})
    shared = {"w": cameras.width, "h": cameras.height, "cx": float(cameras.cx[0]), "cy": float(cameras.cy[0])}
    return {**shared, "aabb_scale": 4, **more, "frames": frames}


def write_transforms(capture: Capture, folder, content: dict | None = None) -> None:
    """The capture as nerfstudio lays it out, with its depth in thousandths; `content` in place of its own."""
    write_images(capture, folder / "images")
    content = transforms(capture) if content is None else content
    for n, entry in enumerate(content["frames"] if capture.depths is not None else ()):
        entry["depth_file_path"] = f"depth/depth{n}.png"
        (folder / "depth").mkdir(exist_ok=True)
        assert cv2.imwrite(str(folder / f"depth/depth{n}.png"), np.rint(capture.depths[n] * 1000).astype(np.uint16))
    (folder / "transforms.json").write_text(json.dumps(content))


def edit(name, change):
    """Damage: what `change` makes of the bytes of the file `name` of a folder."""
    return lambda folder: (folder / name).write_bytes(change((folder / name).read_bytes()))


def numbers(name, offset, code, *values):
    """Damage: binary numbers at an offset."""
    new = struct.pack(code, *values)
    return edit(name, lambda data: data[:offset] + new + data[offset + len(new) :])


def inria(capture: Capture, turn=None) -> list[dict]:
    """The cameras of a capture as INRIA's cameras.json, their poses times `turn`."""
    rows, cameras = [], capture.cameras
    for name, camera in zip(capture.names, cameras):
        pose = np.linalg.inv(np.asarray(camera.world_to_camera, np.float64)) @ (np.eye(4) if turn is None else turn)
        row = {"img_name": f"{name}.png", "width": cameras.width, "height": cameras.height, "fx": float(camera.fx)}
        rows.append(row | {"fy": float(camera.fy), "position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist()})
    return rows


def png_chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(rows: np.ndarray, *, bits: int, colour_type: int, palette: bytes = b"") -> bytes:
    """A PNG of one channel, packed here by hand: OpenCV writes no palettes and no 2 or 4 bit files."""
    height, width = rows.shape
    binary = (rows[..., None] >> np.arange(bits)[::-1]) & 1
    packed = np.packbits(binary.reshape(height, width * bits).astype(np.uint8), axis=1)
    scanlines = b"".join(b"\0" + row.tobytes() for row in packed)
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, colour_type, 0, 0, 0))
    colours = png_chunk(b"PLTE", palette) if palette else b""
    pixels = png_chunk(b"IDAT", zlib.compress(scanlines))
    return b"\x89PNG\r\n\x1a\n" + header + colours + pixels + png_chunk(b"IEND", b"")
