"""From posed image files to a Capture, on the host: the part of loading that every capture format shares."""

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
from jsecon.read.captures.coordinates import camera_jumps, make_rigid, normalizing_transform, transform_poses
from jsecon.read.captures.frames import (
    CaptureExtent,
    FrameOptions,
    PosedImage,
    PosedImages,
    evenly_spaced,
    frame_names,
    holdout_mask,
)
from jsecon.read.captures.images import TRANSPOSED, ImageHeader, apply_orientation, image_header, read_depth, read_image
from jsecon.read.captures.lens import Lens, distort, resample_depth, undistorted_pinhole, undistortion_maps
from jsecon.types import Camera, Capture, ImageFile, Progress

_MIN_FOCAL = 1e-3
"""px: smaller focal lengths are errors"""
_MAX_IN_MEMORY = 1 << 30
"""bytes of frames that stay in memory; more go to a temporary file"""


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
    the other images of the capture decide, else the colours of its sparse points, else EXIF is applied.
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
    """Whether the poses of a capture belong to stored pixels, by other images of it, else by colours of its points."""
    images = [image for image in posed.images if image.image is not None]
    fits = [_fitting_pixels(image, image_header(_path_of(image))) for image in images]
    if "upright" in fits or "stored" in fits:
        return "upright" not in fits
    undecided = [image for image, fit in zip(images, fits) if fit == "both"]
    if not len(posed.colours) or (posed.colours == posed.colours[0]).all():
        return False
    votes = 0
    for image in undecided[:: -(-len(undecided) // 4)]:  # four images are enough
        errors = [_colour_error(image, posed, upright=upright) for upright in (False, True)]
        votes += int(np.sign(errors[1] - errors[0]))
    return votes > 0


def _colour_error(image: PosedImage, posed: PosedImages, *, upright: bool) -> float:
    """Mean absolute difference between the points' colours and the pixels that show them; 255 if no point is seen."""
    pixels, _ = read_image(_path_of(image), upright=upright)
    height, width = pixels.shape[:2]
    local = np.asarray(posed.points, np.float64) @ image.world_to_camera[:3, :3].T + image.world_to_camera[:3, 3]
    is_front = local[:, 2] > 0
    directions = local[is_front, :2] / local[is_front, 2:]
    is_central = np.abs(directions).max(1, initial=0) < 2  # a polynomial lens folds back beyond its range
    places = np.floor(distort(_lens_of(image).resized(width, height), directions[is_central])).astype(int)
    is_inside = ((places >= 0) & (places < (width, height))).all(1)
    if not is_inside.any():
        return 255.0
    shown = pixels[places[is_inside, 1], places[is_inside, 0]].astype(np.float64)
    return float(np.abs(shown - posed.colours[is_front][is_central][is_inside]).mean())


def _fits(lens: Lens, width: int, height: int) -> bool:
    """Whether an image of this size has the lens's aspect, to a pixel of the coarser of the two."""
    return min(abs(lens.width * height / lens.height - width), abs(width * lens.height / height - lens.width)) <= 1


def _lens_at_size(image: PosedImage, width: int, height: int) -> Lens:
    """The lens of an image at the size that it is read at."""
    lens = _lens_of(image)
    numbers = (lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion)
    if not is_finite_and_bounded(numbers) or min(lens.fx, lens.fy) < _MIN_FOCAL:
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
    return tuple(ImageFile(frame.name, *frame.size, frame.orientation) for frame in frames)


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
    elif not _fits(lens, *depth.shape[1::-1]) and frame.orientation in TRANSPOSED:
        depth = apply_orientation(depth, frame.orientation)  # measured like the stored pixels
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
    units far from metres are changed in float64 (`normalizing_transform`), by the same for any choice of frames;
    `Capture.source_from_scene` leads back. `only` names the frames to read.
    """
    images, poses, names, notes = _in_order(posed)
    deep = [image for image in images if image.depth is not None and not len(posed.points)]
    samples = [deep[index] for index in evenly_spaced(len(deep), 8)] if deep else []
    depths = [read_depth(image.depth, image.depth_unit) for image in samples if image.depth is not None]
    world, world_notes = normalizing_transform(poses, posed.points, depths)  # of all frames, whichever are taken
    poses, from_world = transform_poses(poses, world), np.linalg.inv(world)
    if only is not None:
        missing = sorted(set(only) - set(names))
        if missing or not only:
            problem = f"there is no frame called {[*missing, '...'][0]} among the {len(names)}, {names[0]} ..."
            raise InputError(posed.where, problem, remedy="Give the capture that these names are of.")
        kept = [i for i, name in enumerate(names) if name in only]
        images, poses, names = [images[i] for i in kept], poses[kept], tuple(names[i] for i in kept)
    notes = [*notes, *posed.notes, *world_notes, *camera_jumps(poses, names)]
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
