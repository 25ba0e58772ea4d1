"""From posed image files to a Capture, on the host: the part of loading that every capture format shares.

The world of a capture becomes one of ordinary numbers. Float32 has 24 bits: of a map projection's coordinates (5e6 m)
they leave half a metre. Later steps have constants in world units made for metres, such as the near plane, which would
cut off a scene in kilometres.
"""

from __future__ import annotations

import collections
import dataclasses
import functools
import re
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jsecon.errors import InputError
from jsecon.files import scratch_array
from jsecon.numerics import MAX_COORDINATE
from jsecon.process import cores
from jsecon.read.captures.frames import (
    FrameOptions,
    PosedImage,
    PosedImages,
    evenly_spaced,
    frame_names,
    same_aspect,
    transform_poses,
    usable_images,
)
from jsecon.read.captures.images import image_header, read_depth, read_image
from jsecon.read.captures.lens import Lens, operator_mask, undistorted_pinhole, undistortion_maps
from jsecon.types import Camera, Capture, ImageFile, Progress

_MIN_DEPTH, _UNIT_STEP = 0.1, 1000.0
"""Units change by a power of the second, as from millimetres to metres, so that the near things are from 0.1 to 100
world units away: a scene comes out the same from each unit."""


class _Frame(NamedTuple):
    """A frame whose image is there."""

    name: str
    posed: PosedImage
    image: Path
    lens: Lens
    """Lens of the pixels as they are read, at their size; until the header is read, as the capture has it."""
    orientation: int = 1
    """EXIF's that is applied; 1 if the pose belongs to the stored pixels."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the lens."""
        return self.lens.width, self.lens.height


def _resolve_orientations(frames: Sequence[_Frame], posed: PosedImages) -> list[_Frame]:
    """Decides how the image of each frame is read, by its header.

    A camera model belongs to the stored pixels or to the upright image: COLMAP ignores EXIF, other programs apply it.
    If only one of the two has the model's aspect, it is that one. If both have it (a square, or a turn by 180 degrees),
    the program decides (`PosedImages.ignores_exif`).
    """
    result = []
    for frame in frames:
        header = image_header(frame.image)
        fits_stored, fits_upright = (same_aspect(frame.size, size) for size in (header.stored, header.upright))
        orientation = 1 if fits_stored and (posed.ignores_exif or not fits_upright) else header.orientation
        size = header.upright if orientation != 1 else header.stored
        if not same_aspect(frame.size, size):
            remedy = "Use the images that the poses were estimated on (mind their rotation), or a scaled copy of them."
            expected = f"{frame.lens.width}x{frame.lens.height} of its camera, or that aspect"
            raise InputError(frame.image, f"the image is {size[0]}x{size[1]}", expected, remedy)
        lens = frame.lens if size == frame.size else frame.lens.resized(*size)
        result.append(frame._replace(lens=lens, orientation=orientation))
    return result


def plan_frames(
    posed: PosedImages, options: FrameOptions
) -> tuple[dict[str, ImageFile], tuple[int, int], Bool[np.ndarray, " t"]]:
    """Plans `build_capture`'s result: its frames by name, their (width, height), px, and which are held out.

    Of the images, only headers are read.
    """
    frames, _ = _in_order(posed)
    frames = _resolve_orientations(_choose(frames, options), posed)
    for lens in {frame.lens for frame in frames}:
        undistorted_pinhole(lens, posed.where)
    files = {frame.name: _file(frame) for frame in frames}
    return files, options.size(_commonest_size(frames)), _hold_out(frames, options)[0]


def _photographs(frames: Sequence[_Frame]) -> tuple[Int[np.ndarray, " t"], int]:
    """The number of the photograph that each frame is from, which views of a panorama share, and how many there are."""
    numbers: dict[Path, int] = {}
    return np.array([numbers.setdefault(frame.image, len(numbers)) for frame in frames]), len(numbers)


def _choose(frames: Sequence[_Frame], options: FrameOptions) -> list[_Frame]:
    """The frames of evenly spaced photographs, as many as the options allow."""
    photographs, count = _photographs(frames)
    chosen = np.isin(photographs, evenly_spaced(count, options.frames))
    return [frame for frame, is_chosen in zip(frames, chosen) if is_chosen]


def _hold_out(frames: Sequence[_Frame], options: FrameOptions) -> tuple[Bool[np.ndarray, " t"], list[str]]:
    """Chooses held-out frames: by the options, by the capture's own split, or every eighth photograph's; adds notes."""
    split = np.array([bool(frame.posed.held_out) for frame in frames])
    has_split = any(frame.posed.held_out is not None for frame in frames)
    if has_split and options.holdout is None:
        held_out = split
        notes = [f"{split.sum()} of {len(split)} frames are held out, those that the capture's own split sets aside."]
    else:
        every = 8 if options.holdout is None else options.holdout  # as in Mip-NeRF 360 and INRIA's split
        held_out = _photographs(frames)[0] % every == 0 if every else np.zeros(len(frames), bool)
        notes = ["The capture's own split is not used: a holdout is given."] if has_split else []
    if held_out.all():
        held_out[:] = False
        notes.append("No frame was held out, since none would be left to fit to.")
    return held_out, notes


def _file(frame: _Frame) -> ImageFile:
    """The image of a frame as `Capture.files` has it."""
    return ImageFile(frame.posed.name, *frame.lens.undistorted_size, frame.orientation)


def _in_order(posed: PosedImages) -> tuple[list[_Frame], list[str]]:
    """The frames whose images are there in name order, and notes."""
    placed, notes = usable_images(posed)
    images = [image for image in placed if image.image is not None]
    missing = [image.name for image in placed if image.image is None]
    first = f"(the first: {missing[0]})" if missing else ""
    if not images:
        problem = " ".join([f"of its {len(placed)} frames with a pose, none has its image {first}".strip(), *notes])
        raise InputError(
            posed.where, problem, remedy="Copy the images to where it names them, or estimate poses again."
        )
    if missing:
        notes.append(f"{len(missing)} of {len(placed)} frames were left out: their images are missing {first}.")
    images.sort(key=lambda image: re.sub(r"\d+", lambda number: number[0].zfill(20), image.name))
    frames = [
        _Frame(name, image, image.image, image.lens)
        for name, image in zip(frame_names([image.name for image in images], posed.where), images)
        if image.image and image.lens
    ]
    return frames, notes


def _commonest_size(frames: Sequence[_Frame]) -> tuple[int, int]:
    """The commonest (width, height)."""
    return collections.Counter(frame.lens.undistorted_size for frame in frames).most_common(1)[0][0]


def _shrink_panorama(frame: _Frame, side: int) -> _Frame:
    """Shrinks a panorama to what its views need, twice the `side` of the frames: many are of 20 megapixels or more."""
    width = min(6 * side, frame.lens.width)
    return frame if frame.lens.view is None else frame._replace(lens=frame.lens.resized(width, width // 2))


def _undistort(
    pixels: UInt8[np.ndarray, "h w 3"], lens: Lens, maps: tuple[np.ndarray, np.ndarray] | None, size: tuple[int, int]
) -> UInt8[np.ndarray, "p q 3"]:
    """The undistorted image at `size` (width, height)."""
    if maps is not None:
        border = cv2.BORDER_REPLICATE if lens.view is None else cv2.BORDER_WRAP
        pixels = cv2.remap(pixels, *maps, cv2.INTER_LINEAR, borderMode=border)
    if pixels.shape[1::-1] == size:
        return pixels
    shrinks = size[0] <= pixels.shape[1] and size[1] <= pixels.shape[0]
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def _resample_depth(depth: Float[np.ndarray, "h w"], lens: Lens, other: Lens) -> Float[np.ndarray, "p q"]:
    """Resamples a z-depth map for another pinhole lens at the same place: the nearest pixel, 0 outside."""
    columns = np.floor((np.arange(other.width) + 0.5 - other.cx) / other.fx * lens.fx + lens.cx).astype(int)
    rows = np.floor((np.arange(other.height) + 0.5 - other.cy) / other.fy * lens.fy + lens.cy).astype(int)
    height, width = depth.shape
    inside = ((rows >= 0) & (rows < height))[:, None] & ((columns >= 0) & (columns < width))
    return np.where(inside, depth[np.clip(rows, 0, height - 1)[:, None], np.clip(columns, 0, width - 1)], 0)


def _read_depth(
    file: Path, frame: _Frame, maps: tuple[np.ndarray, np.ndarray] | None, size: tuple[int, int], unit: float
) -> Float[np.ndarray, "h w"]:
    """The undistorted depth map at `size` (width, height), with `unit` for a world unit of the file."""
    lens, depth = frame.lens, read_depth(file, frame.posed.depth_unit * unit)
    if frame.posed.depth_lens is not None:
        depth = _resample_depth(depth, frame.posed.depth_lens, lens)
    height, width = depth.shape
    if not same_aspect(frame.size, (width, height)):
        expected = f"the aspect of its image, {lens.width}x{lens.height}"
        raise InputError(file, f"the depth map is {width}x{height}", expected, "Register it to the image.")
    # Nearest throughout: the mean of two depths lies on neither surface.
    if maps is not None:
        depth = cv2.resize(depth, frame.size, interpolation=cv2.INTER_NEAREST_EXACT)
        depth = cv2.remap(depth, *maps, cv2.INTER_NEAREST)
    return cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT)


def build_capture(posed: PosedImages, options: FrameOptions, *, progress: Progress | None = None) -> Capture:
    """Reads the images of a capture: in name order, undistorted, at one size.

    Distorted images are resampled (bilinear) to the widest pinhole lens without empty pixels, then shrunk (area
    average). Images of other sizes than the commonest are resized to it, focal lengths with them. Large coordinates and
    units far from metres are changed in float64 (`_normalizing_transform`), by the same for any choice of frames;
    `Capture.source_from_scene` leads back.
    """
    frames, notes = _in_order(posed)
    known = (np.abs(np.asarray(posed.points, np.float64)) <= MAX_COORDINATE).all(1)
    if not known.all():
        notes.append(f"{int((~known).sum())} sparse points were left out: their coordinates are no ordinary numbers.")
        posed = dataclasses.replace(posed, points=posed.points[known], colours=posed.colours[known])
    deep = [(frame.posed.depth, frame.posed.depth_unit) for frame in frames if not len(posed.points)]
    deep = [(depth, unit) for depth, unit in deep if depth is not None]
    depths = [read_depth(*deep[index]) for index in evenly_spaced(len(deep), 8)]
    poses = np.stack([frame.posed.world_to_camera for frame in frames])
    world = _normalizing_transform(poses, posed.points, depths)  # of all frames, whichever are taken
    notes += posed.notes
    frames = _resolve_orientations(_choose(frames, options), posed)
    if bent := sum(frame.lens.distorted and frame.lens.view is None for frame in frames):
        notes.append(f"{bent} images were undistorted; masks and labels must be of the undistorted images.")
    width, height = _commonest_size(frames)
    width, height = options.size((width, height))
    files = tuple(map(_file, frames))
    frames = [_shrink_panorama(frame, width) for frame in frames]
    pinholes = {lens: undistorted_pinhole(lens, posed.where) for lens in {frame.lens for frame in frames}}

    pixels = scratch_array((len(frames), height, width, 3), np.uint8)
    has_depth = any(frame.posed.depth for frame in frames)
    depth_maps = np.zeros((len(frames), height, width), np.float32) if has_depth else None
    cached_maps = functools.lru_cache(maxsize=8)(undistortion_maps)

    has_ignored = any(frame.lens.view is not None or frame.posed.mask for frame in frames)
    ignored = scratch_array(pixels.shape[:3], bool) if has_ignored else None
    photographs, count = _photographs(frames)

    def read(photograph: int) -> None:
        rows = np.flatnonzero(photographs == photograph)
        first = frames[rows[0]]
        image = read_image(first.image, upright=first.orientation != 1)
        if image.shape[1::-1] != first.size:
            image = cv2.resize(image, first.size, interpolation=cv2.INTER_AREA)
        for t in rows:
            lens, depth = frames[t].lens, frames[t].posed.depth
            maps = cached_maps(lens, pinholes[lens]) if lens.distorted else None
            pixels[t] = _undistort(image, lens, maps, (width, height))
            if ignored is not None:
                ignored[t] = lens.view is not None and operator_mask(lens, pinholes[lens].resized(width, height))
            if (mask := frames[t].posed.mask) is not None and ignored is not None:
                kept = read_image(mask, upright=first.orientation != 1)
                kept = cv2.resize(kept, first.size, interpolation=cv2.INTER_NEAREST_EXACT)
                ignored[t] |= (_undistort(kept, lens, maps, (width, height)) < 128).all(axis=-1)
            if depth is not None and depth_maps is not None:
                depth_maps[t] = _read_depth(depth, frames[t], maps, (width, height), world[0, 0])

    with ThreadPoolExecutor(cores()) as pool:
        for done, _ in enumerate(pool.map(read, range(count)), start=1):  # cancels the others if one fails
            if progress is not None:
                progress(done, count)
    held_out, split_notes = _hold_out(frames, options)
    notes += split_notes
    final = [pinholes[frame.lens].resized(width, height) for frame in frames]
    fx, fy, cx, cy = np.array([(lens.fx, lens.fy, lens.cx, lens.cy) for lens in final], np.float32).T
    poses = transform_poses(np.stack([frame.posed.world_to_camera for frame in frames]), world)
    from_world = np.linalg.inv(world)
    return Capture(
        frames=pixels,
        cameras=Camera(poses.astype(np.float32), fx, fy, cx, cy, width, height),
        points=(np.asarray(posed.points, np.float64) @ world[:3, :3] + world[:3, 3]).astype(np.float32),
        point_colors=np.asarray(posed.colours, np.uint8),
        held_out=held_out,
        depths=depth_maps,
        source_from_scene=np.asarray(posed.source_from_poses, np.float64) @ from_world,
        names=tuple(frame.name for frame in frames),
        notes=tuple(notes),
        ignored=ignored,
        files=files,
        poses_from_scene=from_world,
        up=posed.up,
        metres_per_unit=posed.metres_per_unit,
    )


def _normalizing_transform(
    poses: Float[np.ndarray, "t 4 4"], points: Float[np.ndarray, "p 3"], depths: Sequence[np.ndarray] = ()
) -> Float[np.ndarray, "4 4"]:
    """Finds the similarity (shift and scale, no rotation) from a capture's world to one of ordinary numbers.

    That is near the origin, and of the size of metres; for most captures it is the identity. A scene that is moved, or
    scaled by a power of 1000, comes out in the same world up to a shift of its own size. Depth maps of a few views, in
    world units with 0 where unknown, stand in for missing points; without either, the spread of the cameras counts.
    """
    centres = -np.einsum("tji,tj->ti", poses[:, :3, :3], poses[:, :3, 3])
    middle = np.median(centres, axis=0)
    spread = float(np.median(np.linalg.norm(centres - middle, axis=1)))
    near = _near_depth(poses, np.asarray(points, np.float64), depths) or spread
    if near < max(1e-6, 1e-12 * np.abs(middle).max()):  # rounding: the cameras stand in one place
        near = 1.0
    origin, size = np.zeros(3), max(near, spread)
    if np.abs(middle).max() > 100 * size:
        step = 10.0 ** np.ceil(np.log10(size))
        origin = np.round(middle / step) * step
    factor = _UNIT_STEP ** np.ceil(np.log(_MIN_DEPTH / near) / np.log(_UNIT_STEP) - 1e-9)
    result = np.diag([factor, factor, factor, 1.0])
    result[:3, 3] = -factor * origin
    return result


def _near_depth(poses: np.ndarray, points: np.ndarray, depths: Sequence[np.ndarray]) -> float | None:
    """Distance of the near things from the cameras, in the median view; None if neither points nor depths are known."""
    if len(points):
        chosen = points[evenly_spaced(len(points), 20000)]
        depths = []
        for pose in poses[evenly_spaced(len(poses), 64)]:
            x, y, z = pose[:3, :3] @ chosen.T + pose[:3, 3:]
            depths.append(z[(z > 0) & (np.maximum(np.abs(x), np.abs(y)) <= z)])
    else:
        depths = [depth[depth > 0] for depth in depths]
    near = [np.quantile(depth, 0.1) for depth in depths if len(depth)]
    return float(np.median(near)) if near else None
