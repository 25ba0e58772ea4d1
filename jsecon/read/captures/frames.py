"""Frames of a capture, on the host: their records before pixels are read, choice, names, rigid poses and worlds."""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import jax
import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from jsecon.errors import InputError
from jsecon.numerics import is_finite_and_bounded
from jsecon.read.captures.lens import Lens
from jsecon.types import Array, Capture, UpAxis


@dataclasses.dataclass(frozen=True)
class PosedImage:
    """A camera and its image file."""

    name: str
    """Path as the capture names it, with "/": frames are ordered by it, and by the numbers in it (9 before 10)."""
    image: Path | None
    """None if the capture names an image that is not there."""
    lens: Lens | None
    """Lens of the image; rescaled if the file has another size of the same aspect. None if no file names its size."""
    world_to_camera: np.ndarray
    """(4, 4) float64, OpenCV axes."""
    depth: Path | None = None
    depth_unit: float = 0.001
    """World units of one count in the depth file."""
    depth_lens: Lens | None = None
    """Pinhole lens of the depth map, at the same place; None: the image's, at the map's size."""
    held_out: bool | None = None
    """Whether the capture's own split keeps it from training; None if it has no split."""
    mask: Path | None = None
    """Image whose black pixels are to be ignored."""


@dataclasses.dataclass(frozen=True)
class PosedImages:
    """A capture before any pixel is read: what the reader of every format returns."""

    images: Sequence[PosedImage]
    where: object
    """Name of the capture for errors."""
    points: Float[np.ndarray, "p 3"] = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """Sparse points, world, float64."""
    colours: UInt8[np.ndarray, "p 3"] = dataclasses.field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    source_from_poses: Float[np.ndarray, "4 4"] = dataclasses.field(default_factory=lambda: np.eye(4))
    """Similarity from the world of the poses to that of the files that they were made from."""
    notes: tuple[str, ...] = ()
    ignores_exif: bool = False
    """Whether the program that found the poses takes images as they are stored, as COLMAP does."""
    up: UpAxis | None = None
    """Which way is up in the world of the poses, where the format knows gravity."""
    metres_per_unit: float | None = None
    """Metres of one unit of the world of the source files, where the format guarantees them."""


@dataclasses.dataclass(frozen=True)
class FrameOptions:
    """Which frames of a capture are loaded, and their size.

    Attributes:
      downscale: Divides width and height, at least 1.
      long_side: Longest side of the frames, px, if `downscale` is None; None: no limit.
      frames: Most frames, evenly spaced, the views of a panorama together one; None: all.
      holdout: k holds out the frames 0, k, 2k, ..., and 0 no frame; None: the capture's own split, or else 8.
    """

    downscale: float | int | None = None
    long_side: int | None = None
    frames: int | None = None
    holdout: int | None = None

    def __post_init__(self) -> None:
        """Raises InputError if no capture can be loaded with one of the options."""
        for name in ("downscale", "long_side", "frames"):
            value = getattr(self, name)
            if value is not None and not 1 <= value < np.inf:
                raise InputError(name, str(value), "a number of at least 1", "Leave it out for no limit.")
        if self.holdout is not None and (self.holdout < 0 or self.holdout == 1):
            raise InputError("holdout", str(self.holdout), "0 (no frame), or at least 2", "8 is the custom.")

    def size(self, size: tuple[int, int]) -> tuple[int, int]:
        """Computes (width, height) of the frames of images of a size, px."""
        shrink = self.downscale or max(max(size) / (self.long_side or max(size)), 1.0)
        return max(1, round(size[0] / shrink)), max(1, round(size[1] / shrink))


def evenly_spaced(count: int, limit: int | None) -> np.ndarray:
    """Chooses up to `limit` of `count` frames evenly, the first and the last among them: ascending indices."""
    if limit is None or limit >= count:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, limit).round().astype(int))


def same_aspect(size: tuple[int, ...], other: tuple[int, ...]) -> bool:
    """Whether two sizes (width, height) have one aspect, to a pixel of the coarser of the two, which was rounded."""
    (width, height), (columns, rows) = size, other
    return min(abs(columns * height / rows - width), abs(width * rows / height - columns)) <= 1


def frame_names(files: Sequence[str], where: object) -> tuple[str, ...]:
    """Names frames by their files, paths with "/", without folder and suffix.

    Names keep their folders ("a_0001") if two would be the same, and what follows the last dot if it is a number:
    render.0001. No name holds a "/".
    """
    paths = [PurePosixPath(file) for file in files]
    paths = [path if path.suffix[1:].isdecimal() else path.with_suffix("") for path in paths]
    folders = [[part for part in path.parts if part not in ("/", "..")] for path in paths]
    for names in ([path.name for path in paths], *([joint.join(parts) for parts in folders] for joint in ("_", "__"))):
        if len(set(names)) == len(names):
            return tuple(names)
    twice = collections.Counter(names).most_common(1)[0][0]
    first, second = [file for file, name in zip(files, names) if name == twice][:2]
    raise InputError(where, f"two frames, {first} and {second}, differ in their suffixes only", remedy="Rename one.")


def usable_images(posed: PosedImages) -> tuple[list[PosedImage], list[str]]:
    """Chooses the images of a capture that have a pose, each once, with exactly rigid poses; says what was left out."""
    placed = [image for image in posed.images if _is_known(image.world_to_camera)]
    once = list({image.name: image for image in reversed(placed)}.values())[::-1]
    count, lost, twice = len(posed.images), len(posed.images) - len(placed), len(placed) - len(once)
    notes = [f"{lost} of {count} frames were left out: they have no pose, or one of absurd numbers."] if lost else []
    notes += [f"{twice} frames are listed twice; the first of each was taken."] if twice else []
    rigid = [make_rigid(image.world_to_camera, posed.where, image.name) for image in once]
    return [dataclasses.replace(image, world_to_camera=pose) for image, pose in zip(once, rigid)], notes


def _is_known(pose: np.ndarray) -> bool:
    """Whether a pose is of ordinary numbers; some programs write zeros for a lost one."""
    return is_finite_and_bounded(pose) and bool(np.asarray(pose)[:3, :3].any())


def make_rigid(pose: Float[np.ndarray, "4 4"], where: object, name: str) -> Float[np.ndarray, "4 4"]:
    """Makes the rotation of a (4, 4) pose exactly orthonormal; `where` and `name` are its file and frame for errors.

    A pose that is lost becomes NaN, which `usable_images` leaves out: numbers that are not finite, or zeros.
    """
    pose = np.asarray(pose, np.float64)
    rotation = pose[:3, :3]
    if not _is_known(pose):
        return np.full((4, 4), np.nan)
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if error > 1e-3 or np.linalg.det(rotation) < 0 or not np.allclose(pose[3], [0, 0, 0, 1], atol=1e-6):
        expected = "a rotation and a translation, without scale, shear or mirror"
        remedy = "Estimate the poses again, or take this frame out of the capture."
        raise InputError(where, f"the pose of {name} is not rigid (R R^T is off by {error:.2g})", expected, remedy)
    left, _, right = np.linalg.svd(rotation)
    result = pose.copy()
    result[:3, :3] = left @ right
    return result


def pose_matrix(rotation: Rotation, translation: Sequence[float] | np.ndarray) -> Float[np.ndarray, "4 4"]:
    """Makes the (4, 4) matrix of a rotation and a translation."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.as_matrix(), translation
    return pose


def transform_poses(
    poses: Float[np.ndarray, "... 4 4"], world: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "... 4 4"]:
    """Moves world-to-camera poses by a similarity of the world: the cameras see the same."""
    if np.array_equal(world, np.eye(4)):
        return poses
    moved = np.asarray(poses, np.float64) @ np.linalg.inv(world)
    moved[..., :3, :] *= np.cbrt(np.linalg.det(world[:3, :3]))
    return moved


def move_capture(capture: Capture, source_from_scene: Float[Array, "4 4"]) -> Capture:
    """Moves the cameras and depths of a capture to another world of the same source."""
    world = np.linalg.inv(np.asarray(source_from_scene, np.float64)) @ np.asarray(capture.source_from_scene)
    cameras = jax.tree.map(np.asarray, capture.cameras)
    poses = transform_poses(cameras.world_to_camera, world).astype(np.float32)
    cameras = dataclasses.replace(cameras, world_to_camera=poses)
    depths = None if capture.depths is None else capture.depths * np.float32(np.cbrt(np.linalg.det(world[:3, :3])))
    return dataclasses.replace(capture, cameras=cameras, depths=depths, source_from_scene=np.asarray(source_from_scene))


def take_frames(capture: Capture, rows: Sequence[int]) -> Capture:
    """Takes some frames of a capture."""
    arrays = capture.frames, capture.cameras, capture.held_out, capture.depths, capture.ignored
    frames, cameras, held_out, depths, ignored = jax.tree.map(lambda column: np.asarray(column)[list(rows)], arrays)
    columns = {"frames": frames, "cameras": cameras, "held_out": held_out, "depths": depths, "ignored": ignored}
    files = tuple(capture.files[t] for t in rows) if capture.files else ()
    return dataclasses.replace(capture, **columns, names=tuple(capture.names[t] for t in rows), files=files)
