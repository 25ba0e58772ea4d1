"""From posed image files to a Capture, on the host: the part of loading that every capture format shares.

The world of a capture becomes one of ordinary numbers. Float32 has 24 bits: of a map projection's coordinates (5e6 m)
they leave half a metre. Later steps have constants in world units made for metres, such as the near plane, which would
cut off a scene in kilometres.
"""

from __future__ import annotations

import collections
import functools
import math
import os
import re
import tempfile
from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jsecon.errors import InputError
from jsecon.numerics import is_finite_and_bounded
from jsecon.process import cores
from jsecon.read.captures.frames import (
    CaptureExtent,
    FrameOptions,
    PosedImage,
    PosedImages,
    evenly_spaced,
    frame_names,
    holdout_mask,
    make_rigid,
    transform_poses,
)
from jsecon.read.captures.images import ImageHeader, image_header, read_depth, read_image
from jsecon.read.captures.lens import Lens, resample_depth, undistorted_pinhole, undistortion_maps
from jsecon.types import Camera, Capture, ImageFile, Progress

_MAX_IN_MEMORY = 1 << 30
"""bytes of frames that stay in memory; more go to a temporary file"""
_UNIT_STEP = 1000.0
"""units change by a power of this, as from millimetres to metres: a scene comes out the same from each unit"""
_MIN_DEPTH, _MAX_DEPTH = 0.1, 100.0
"""distance of the nearest things from the cameras, world units, within which the units are kept"""
_MAX_SPREAD = 1000.0
"""spread of the cameras, world units, up to which the units are kept if only the cameras are known"""


class _Frame(NamedTuple):
    """A frame whose image is there."""

    name: str
    image: Path
    lens: Lens
    """Lens of the pixels as they are read, at their size."""
    orientation: int
    """EXIF's that is applied; 1 if the pose belongs to the stored pixels."""
    posed: PosedImage

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the pixels as they are read."""
        return self.lens.width, self.lens.height


def _resolve_orientations(images: Sequence[PosedImage], posed: PosedImages) -> tuple[list[_Frame], list[str]]:
    """Decides how each image of a capture is read, and returns notes.

    A camera model belongs to the stored pixels or to the upright image: COLMAP ignores EXIF, other programs apply it.
    If only one of the two has the model's aspect, it is that one. If both have it (a square, or a turn by 180 degrees),
    the other images of the capture decide, else the program (`PosedImages.ignores_exif`).
    """
    headers = [image_header(_path_of(image)) for image in images]
    fits = [_fitting_pixels(image, header) for image, header in zip(images, headers)]
    if "both" in fits and _poses_ignore_exif(posed):
        fits = ["stored" if fit == "both" else fit for fit in fits]
    frames = [
        _Frame(
            image.name,
            _path_of(image),
            _lens_at_size(image, *(header.stored if fit == "stored" else header.upright)),
            1 if fit == "stored" else header.orientation,
            image,
        )
        for image, header, fit in zip(images, headers, fits)
    ]
    notes = []
    if stored := [frame.name for frame, fit in zip(frames, fits) if fit == "stored"]:
        example = f"(the first: {stored[0]})"
        notes.append(
            f"{len(stored)} images have an EXIF orientation that their camera models leave out {example}; they are "
            "taken as they are stored."
        )
    if turned := [frame.name for frame in frames if frame.orientation != 1]:
        notes.append(f"{len(turned)} images were turned upright by their EXIF orientation (the first: {turned[0]}).")
    return frames, notes


def _path_of(image: PosedImage) -> Path:
    """The image's file, which is there."""
    assert image.image is not None
    return image.image


def _lens_of(image: PosedImage) -> Lens:
    """The image's lens, which every image that is there has."""
    assert image.lens is not None
    return image.lens


def _fitting_pixels(image: PosedImage, header: ImageHeader) -> str:
    """Which pixels of an image with an EXIF orientation have its lens's aspect: "stored", "upright", "both" or ""."""
    if header.orientation == 1:
        return ""
    fits = _fits(_lens_of(image), *header.stored), _fits(_lens_of(image), *header.upright)
    return {(True, True): "both", (True, False): "stored", (False, True): "upright"}.get(fits, "")


def _poses_ignore_exif(posed: PosedImages) -> bool:
    """Whether the poses of a capture belong to stored pixels, by all its images, else by the program."""
    images = [image for image in posed.images if image.image is not None]
    fits = {_fitting_pixels(image, image_header(_path_of(image))) for image in images}
    if fits & {"stored", "upright"}:
        return "upright" not in fits
    return posed.ignores_exif


def _fits(lens: Lens, width: int, height: int) -> bool:
    """Whether an image of this size has the lens's aspect, to a pixel of the coarser of the two."""
    return min(abs(lens.width * height / lens.height - width), abs(width * lens.height / height - lens.width)) <= 1


def _lens_at_size(image: PosedImage, width: int, height: int) -> Lens:
    """The lens of an image at the size that it is read at."""
    lens = _lens_of(image)
    numbers = (lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion)
    if not is_finite_and_bounded(numbers) or min(lens.fx, lens.fy) < 1e-3:
        problem = f"its camera has focal lengths {lens.fx:g}, {lens.fy:g}, centre {lens.cx:g}, {lens.cy:g}"
        problem += f" and distortion {lens.distortion}"
        raise InputError(image.image, problem, "finite pixels", "Estimate the cameras again.")
    if (width, height) == (lens.width, lens.height):
        return lens
    if not _fits(lens, width, height):
        remedy = "Use the images that the poses were estimated on (mind their rotation), or a scaled copy of them."
        expected = f"{lens.width}x{lens.height} of its camera, or that aspect"
        raise InputError(image.image, f"the image is {width}x{height}", expected, remedy)
    return lens.resized(width, height)


def _allocate_frames(shape: tuple[int, ...]) -> np.ndarray:
    """Allocates uint8 frames, from _MAX_IN_MEMORY on in a temporary file, of which the system caches what is in use."""
    if (size := math.prod(shape)) < _MAX_IN_MEMORY:
        return np.empty(shape, np.uint8)
    with tempfile.TemporaryFile() as file:
        try:
            if hasattr(os, "posix_fallocate"):  # a mapped page without a place on the disk ends the process by SIGBUS
                os.posix_fallocate(file.fileno(), 0, size)
            return np.memmap(file, np.uint8, "w+", shape=shape)
        except OSError as error:
            problem = f"{error.strerror or error} for {size / 2**30:.1f} GiB of frames"
            remedy = "Free some room, set TMPDIR to a folder that has it, or take fewer or smaller frames."
            raise InputError(tempfile.gettempdir(), problem, remedy=remedy) from error


def planned_extent(posed: PosedImages, options: FrameOptions) -> CaptureExtent:
    """Computes the extent of `build_capture`'s result; of the images, only headers are read."""
    images, _, names, _ = _in_order(posed)
    chosen = evenly_spaced(len(images), options.frames)
    frames, _ = _resolve_orientations([images[i] for i in chosen], posed)
    for lens in {frame.lens for frame in frames}:
        undistorted_pinhole(lens, posed.where)
    size = options.size(_commonest_size(frames))
    return CaptureExtent(len(frames), size, tuple(names[i] for i in chosen), _files(frames))


def _files(frames: Sequence[_Frame]) -> tuple[ImageFile, ...]:
    """The images of frames as `Capture.files` has them."""
    return tuple(ImageFile(frame.name, *frame.size) for frame in frames)


def _in_order(posed: PosedImages) -> tuple[list[PosedImage], np.ndarray, tuple[str, ...], list[str]]:
    """The images that are there in name order, their poses (T, 4, 4) made exactly rigid, the frames' names, notes."""
    images = [image for image in posed.images if image.image is not None]
    missing = [image.name for image in posed.images if image.image is None]
    first = f"(the first: {missing[0]})" if missing else ""
    if not images:
        problem = f"it has {len(missing)} frames, none of which has its image {first}" if missing else "it has no frame"
        remedy = "Copy the images to where it names them." if missing else "Estimate the poses again."
        raise InputError(posed.where, problem, remedy=remedy)
    notes = [f"{len(missing)} of {len(posed.images)} frames were left out: their images are missing {first}."]
    images.sort(key=lambda image: re.sub(r"\d+", lambda number: number[0].zfill(20), image.name))
    poses = np.stack([make_rigid(image.world_to_camera, posed.where, image.name) for image in images])
    return images, poses, frame_names([image.name for image in images], posed.where), notes if missing else []


def _commonest_size(frames: Sequence[_Frame]) -> tuple[int, int]:
    """The commonest (width, height)."""
    return collections.Counter(frame.size for frame in frames).most_common(1)[0][0]


def _read_pixels(
    frame: _Frame, maps: tuple[np.ndarray, np.ndarray] | None, size: tuple[int, int]
) -> tuple[UInt8[np.ndarray, "h w 3"], bool]:
    """The undistorted frame at `size` (width, height), and whether it had transparent pixels."""
    pixels, is_transparent = read_image(frame.image, upright=frame.orientation != 1)
    if maps is not None:
        pixels = cv2.remap(pixels, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    if pixels.shape[1::-1] == size:
        return pixels, is_transparent
    shrinks = size[0] <= pixels.shape[1] and size[1] <= pixels.shape[0]
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR), is_transparent


def _read_depth(
    file: Path, frame: _Frame, maps: tuple[np.ndarray, np.ndarray] | None, size: tuple[int, int], unit: float
) -> Float[np.ndarray, "h w"]:
    """The undistorted depth map at `size` (width, height), with `unit` for a world unit of the file."""
    lens, depth = frame.lens, read_depth(file, frame.posed.depth_unit * unit)
    if frame.posed.depth_lens is not None:
        depth = resample_depth(depth, frame.posed.depth_lens, lens)
    if abs(depth.shape[1] * lens.height / depth.shape[0] - lens.width) > 1:
        problem = f"the depth map is {depth.shape[1]}x{depth.shape[0]}"
        expected = f"the aspect of its image, {lens.width}x{lens.height}"
        raise InputError(file, problem, expected, "Register it to the image.")
    # Nearest throughout: the mean of two depths lies on neither surface.
    if maps is not None:
        depth = cv2.resize(depth, frame.size, interpolation=cv2.INTER_NEAREST_EXACT)
        depth = cv2.remap(depth, *maps, cv2.INTER_NEAREST)
    return cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT)


def build_capture(
    posed: PosedImages,
    options: FrameOptions,
    *,
    only: Collection[str] | None = None,
    progress: Progress | None = None,
) -> Capture:
    """Reads the images of a capture: in name order, undistorted, at one size.

    Distorted images are resampled (bilinear) to the widest pinhole lens without empty pixels, then shrunk (area
    average). Images of other sizes than the commonest are resized to it, focal lengths with them. Large coordinates and
    units far from metres are changed in float64 (`_normalizing_transform`), by the same for any choice of frames;
    `Capture.source_from_scene` leads back. `only` names the frames to read.
    """
    images, poses, names, notes = _in_order(posed)
    deep = [image for image in images if image.depth is not None and not len(posed.points)]
    samples = [deep[index] for index in evenly_spaced(len(deep), 8)] if deep else []
    depths = [read_depth(image.depth, image.depth_unit) for image in samples if image.depth is not None]
    world, world_notes = _normalizing_transform(poses, posed.points, depths)  # of all frames, whichever are taken
    poses, from_world = transform_poses(poses, world), np.linalg.inv(world)
    if only is not None:
        missing = sorted(set(only) - set(names))
        if missing or not only:
            problem = f"there is no frame called {[*missing, '...'][0]} among the {len(names)}, {names[0]} ..."
            raise InputError(posed.where, problem, remedy="Give the capture that these names are of.")
        kept = [i for i, name in enumerate(names) if name in only]
        images, poses, names = [images[i] for i in kept], poses[kept], tuple(names[i] for i in kept)
    notes = [*notes, *posed.notes, *world_notes, *_camera_jumps(poses, names)]
    chosen = evenly_spaced(len(images), options.frames)
    if len(chosen) < len(images):
        notes.append(f"{len(chosen)} of {len(images)} frames were taken, evenly spaced.")
    poses, names = poses[chosen], tuple(names[i] for i in chosen)
    frames, orientation_notes = _resolve_orientations([images[i] for i in chosen], posed)
    notes += orientation_notes
    if rescaled := sum(frame.size != (_lens_of(frame.posed).width, _lens_of(frame.posed).height) for frame in frames):
        notes.append(f"{rescaled} images have another size than their camera model; its intrinsics were scaled.")
    pinholes = {lens: undistorted_pinhole(lens, posed.where) for lens in {frame.lens for frame in frames}}
    if bent := sum(frame.lens.distorted for frame in frames):
        notes.append(f"{bent} images were undistorted; masks and labels must be of the undistorted images.")
    width, height = _commonest_size(frames)
    if odd := sum(frame.size != (width, height) for frame in frames):
        notes.append(f"{odd} images were resized to {width}x{height}, the commonest size, with their intrinsics.")
    width, height = options.size((width, height))

    pixels = _allocate_frames((len(frames), height, width, 3))
    has_depth = any(frame.posed.depth for frame in frames)
    depth_maps = np.zeros((len(frames), height, width), np.float32) if has_depth else None
    cached_maps = functools.lru_cache(maxsize=4)(undistortion_maps)

    def read(index: int) -> bool:
        frame = frames[index]
        maps = cached_maps(frame.lens, pinholes[frame.lens]) if frame.lens.distorted else None
        pixels[index], is_transparent = _read_pixels(frame, maps, (width, height))
        if frame.posed.depth is not None and depth_maps is not None:
            depth_maps[index] = _read_depth(frame.posed.depth, frame, maps, (width, height), world[0, 0])
        return is_transparent

    transparent = 0
    with ThreadPoolExecutor(cores()) as pool:
        try:
            for done, is_transparent in enumerate(pool.map(read, range(len(frames))), start=1):
                transparent += is_transparent
                if progress is not None:
                    progress(done, len(frames))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    if transparent:
        notes.append(f"{transparent} images have transparent pixels; they were laid over black.")
    held_out = holdout_mask(len(frames), options.holdout)
    if held_out.all():
        held_out[:] = False
        notes.append("No frame was held out, since there is only one.")
    final = [pinholes[frame.lens].resized(width, height) for frame in frames]
    fx, fy, cx, cy = np.array([(lens.fx, lens.fy, lens.cx, lens.cy) for lens in final], np.float32).T
    return Capture(
        frames=pixels,
        cameras=Camera(poses.astype(np.float32), fx, fy, cx, cy, width, height),
        points=(np.asarray(posed.points, np.float64) @ world[:3, :3] + world[:3, 3]).astype(np.float32),
        point_colors=np.asarray(posed.colours, np.uint8),
        held_out=held_out,
        depths=depth_maps,
        source_from_scene=np.asarray(posed.source_from_poses, np.float64) @ from_world,
        names=names,
        notes=tuple(notes),
        files=_files(frames),
        poses_from_scene=from_world,
    )


def _camera_jumps(poses: Float[np.ndarray, "t 4 4"], names: Sequence[str]) -> list[str]:
    """Reports places where neighbouring world-to-camera poses lie more than ten median steps apart: a note, or none.

    A reconstruction of 125 photographs with five errors had steps of 11 to 20 there; when right, its largest was 2.2,
    and that of a walk with one cut 9.9.
    """
    centres = _centres(poses)
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    median = float(np.median(steps)) if len(steps) else 0.0
    far = np.flatnonzero(steps > 10 * median)
    if median == 0 or not len(far):
        return []
    places = ", ".join(f"{names[t]} to {names[t + 1]}" for t in far[:5]) + (" ..." if len(far) > 5 else "")
    return [
        f"The camera jumps in {len(far)} places, by up to {steps.max() / median:.0f} of its usual steps ({places}). "
        "If the frames are one walk, poses there are wrong: check them before you trust the fit."
    ]


def _centres(poses: np.ndarray) -> np.ndarray:
    """(T, 3) camera centres of world-to-camera poses."""
    return -np.einsum("tji,tj->ti", poses[:, :3, :3], poses[:, :3, 3])


def _normalizing_transform(
    poses: Float[np.ndarray, "t 4 4"], points: Float[np.ndarray, "p 3"], depths: Sequence[Float[np.ndarray, "h w"]] = ()
) -> tuple[Float[np.ndarray, "4 4"], tuple[str, ...]]:
    """Finds the similarity (shift and scale, no rotation) from a capture's world to one of ordinary numbers, and notes.

    That is near the origin, and of the size of metres; for most captures it is the identity. A scene that is moved, or
    scaled by a power of 1000, comes out in the same world up to a shift of its own size. Depth maps of a few views, in
    world units with 0 where unknown, stand in for missing points.
    """
    centres = _centres(poses)
    middle = np.median(centres, axis=0)
    spread = float(np.median(np.linalg.norm(centres - middle, axis=1)))
    near = _near_depth(poses, np.asarray(points, np.float64), depths)
    size = max(near or 0.0, spread)
    if near is None and size < max(1e-6, 1e-12 * np.abs(middle).max()):  # rounding: the cameras stand in one place
        size = 1.0
        near = size
    origin, notes = np.zeros(3), []
    if np.abs(middle).max() > 100 * size:
        step = 10.0 ** np.ceil(np.log10(size))
        origin = np.round(middle / step) * step
        place = ", ".join(f"{number:.10g}" for number in origin)
        notes.append(f"The coordinates are large. jsecon works relative to ({place}) and adds it to what it writes.")
    factor = _UNIT_STEP ** _power(size if near is None else near, _MAX_SPREAD if near is None else _MAX_DEPTH)
    if factor != 1:
        notes.append(
            f"The units are far from metres: the near things are {size if near is None else near:.3g} away. "
            f"jsecon works at {factor:g} times the size and writes the units of the files."
        )
    result = np.diag([factor, factor, factor, 1.0])
    result[:3, 3] = -factor * origin
    return result, tuple(notes)


def _power(size: float, limit: float) -> int:
    """Power of _UNIT_STEP that brings `size` into [_MIN_DEPTH, limit)."""
    if _MIN_DEPTH <= size < limit:
        return 0
    low = int(np.ceil(np.log(_MIN_DEPTH / size) / np.log(_UNIT_STEP) - 1e-9))
    return low if size < _MIN_DEPTH else int(np.floor(np.log(limit / size) / np.log(_UNIT_STEP) - 1e-9))


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
