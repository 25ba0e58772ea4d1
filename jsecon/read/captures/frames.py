"""From posed image files to a Capture, on the host: the part of loading that every capture format shares."""

from __future__ import annotations

import collections
import dataclasses
import functools
import math
import os
import re
import tempfile
from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from jsecon.errors import InputError
from jsecon.numerics import is_finite_and_bounded
from jsecon.process import cores
from jsecon.read.captures.coordinates import camera_jumps, make_rigid, normalizing_transform, transform_poses
from jsecon.read.captures.images import TRANSPOSED, ImageHeader, apply_orientation, image_header, read_depth, read_image
from jsecon.read.captures.lens import Lens, distort, resample_depth, undistorted_pinhole, undistortion_maps
from jsecon.types import Camera, Capture, ImageFile, Progress

MIN_FOCAL = 1e-3
"""px: smaller focal lengths are errors"""
ORIENTATION_SAMPLES = 4
"""images, at most, that the colours of sparse points are compared with to decide which way up their cameras are"""
MAX_SLOPE = 2.0
"""x/z and y/z up to which points are compared there"""
DEPTH_SAMPLES = 8
"""depth maps that the scene's size is estimated from"""
MAX_IN_MEMORY = 1 << 30
"""bytes of frames that stay in memory; more go to a temporary file"""


@dataclasses.dataclass(frozen=True)
class PosedImage:
    """An image file and its camera."""

    name: str
    """Path as the capture names it, with "/": frames are ordered by it, and by the numbers in it (9 before 10)."""
    image: Path
    lens: Lens
    """Lens of the image; rescaled if the file has another size of the same aspect."""
    world_to_camera: np.ndarray
    """(4, 4) float64, OpenCV axes."""
    depth: Path | None = None
    depth_unit: float = 0.001
    """World units of one count in the depth file."""
    depth_lens: Lens | None = None
    """Pinhole lens of the depth map, at the same place; None: the image's, at the map's size."""


@dataclasses.dataclass(frozen=True)
class PosedImages:
    """A capture before any pixel is read: what every format's reader gives to `build_capture`."""

    images: Sequence[PosedImage]
    where: object
    """Name of the capture for errors."""
    points: Float[np.ndarray, "p 3"] = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """Sparse points, world, float64."""
    colours: UInt8[np.ndarray, "p 3"] = dataclasses.field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    source_from_scene: Float[np.ndarray, "4 4"] = dataclasses.field(default_factory=lambda: np.eye(4))
    """From the world of the poses to that of the files that they were made from."""
    notes: tuple[str, ...] = ()


class CaptureExtent(NamedTuple):
    """Number, size and names of a capture's frames."""

    frames: int
    """Number of frames."""
    size: tuple[int, int]
    """(width, height) of the frames, px."""
    names: tuple[str, ...] = ()
    """Names of the frames; empty if they are not known yet."""
    files: tuple[ImageFile, ...] = ()
    """Image of each named frame."""


@dataclasses.dataclass(frozen=True)
class FrameOptions:
    """Which frames of a capture are loaded, and their size.

    Attributes:
      downscale: Divides width and height, at least 1.
      long_side: Longest side of the frames, px, if `downscale` is None; None: no limit.
      frames: Most frames, evenly spaced; None: all.
      holdout: k holds out the frames 0, k, 2k, ...; 0 or None holds out no frame, and 1 would leave none to fit to.
    """

    downscale: float | int | None = None
    long_side: int | None = None
    frames: int | None = None
    holdout: int | None = None

    def __post_init__(self) -> None:
        """Raises InputError if no capture can be loaded with one of the options."""
        if self.downscale is not None and not (np.isfinite(self.downscale) and self.downscale >= 1):
            raise InputError("downscale", str(self.downscale), "a number of at least 1", "2 halves width and height.")
        if self.long_side is not None and self.long_side < 1:
            raise InputError("long_side", str(self.long_side), "at least 1 px", "400 is the default.")
        if self.frames is not None and self.frames < 1:
            raise InputError("frames", str(self.frames), "at least 1", "Leave it out to take every frame.")
        if self.holdout is not None and (self.holdout < 0 or self.holdout == 1):
            remedy = "8 is the custom; 1 leaves no frame to fit to."
            raise InputError("holdout", str(self.holdout), "0 (no frame), or at least 2 (every second)", remedy)

    def size(self, size: tuple[int, int]) -> tuple[int, int]:
        """Computes the size of the frames.

        Args:
          size: (width, height) of the images, px.

        Returns:
          (width, height), px.
        """
        shrink = self.downscale or max(max(size) / (self.long_side or max(size)), 1.0)
        return max(1, round(size[0] / shrink)), max(1, round(size[1] / shrink))


def evenly_spaced(count: int, limit: int | None) -> np.ndarray:
    """Chooses frames evenly, the first and the last among them.

    Args:
      count: Number of frames.
      limit: Most frames to choose; None: all.

    Returns:
      Ascending indices.
    """
    if limit is None or limit >= count:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, limit).round().astype(int))


def holdout_mask(count: int, every: int | None) -> Bool[np.ndarray, " t"]:
    """Marks the held-out frames 0, k, 2k, ..., as in Mip-NeRF 360 and INRIA's split.

    Args:
      count: T frames.
      every: k; 0 or None holds out no frame.

    Returns:
      (T,) bool.
    """
    return np.arange(count) % every == 0 if every else np.zeros(count, bool)


def frame_names(files: Sequence[str], where: object) -> tuple[str, ...]:
    """Names frames by their files, without folder and suffix.

    Names keep their folders ("a_0001") if two would be the same, and what follows the last dot if it is a number:
    render.0001. No name holds a "/".

    Args:
      files: Paths with "/".
      where: Name of the capture for errors.

    Returns:
      The names, in the order of the files.

    Raises:
      InputError: Two files differ in their suffixes only.
    """
    paths = [PurePosixPath(file) for file in files]
    paths = [path if path.suffix[1:].isdecimal() else path.with_suffix("") for path in paths]
    folders = [[part for part in path.parts if part not in ("/", "..")] for path in paths]
    for names in ([path.name for path in paths], *([joint.join(parts) for parts in folders] for joint in ("_", "__"))):
        if len(set(names)) == len(names):
            return tuple(names)
    twice = collections.Counter(names).most_common(1)[0][0]
    first, second = [file for file, name in zip(files, names) if name == twice][:2]
    remedy = "Rename the images, or take one of the two out."
    raise InputError(where, f"two frames, {first} and {second}, differ in their suffixes only", remedy=remedy)


def _resolve_orientations(
    images: Sequence[PosedImage], posed: PosedImages | None = None
) -> tuple[list[Lens], list[int], list[str]]:
    """Decides how each image is read: its lens at its real size, the EXIF orientation to apply (1: none), and notes.

    A camera model belongs to the stored pixels or to the upright image: COLMAP ignores EXIF, other programs apply it.
    If only one of the two has the model's aspect, it is that one. If both have it (a square, or a turn by 180 degrees),
    the other images of the capture `posed` decide, else the colours of its sparse points, else EXIF is applied.
    """
    headers = [image_header(image.image) for image in images]
    fits = [_fitting_pixels(image.lens, header) for image, header in zip(images, headers)]
    stored = {n for n, fit in enumerate(fits) if fit == "stored"}
    if "both" in fits and posed is not None and _poses_ignore_exif(posed):
        stored |= {n for n, fit in enumerate(fits) if fit == "both"}
    notes = []
    if stored:
        example = f"(the first: {images[min(stored)].name})"
        notes.append(
            f"{len(stored)} images have an EXIF orientation that their camera models leave out {example}; they are "
            "taken as they are stored."
        )
    if applied := [n for n, header in enumerate(headers) if header.orientation != 1 and n not in stored]:
        example = f"(the first: {images[applied[0]].name})"
        notes.append(f"{len(applied)} images were turned upright, as their EXIF orientation says {example}.")
    lenses = [
        _lens_at_size(image, *(header.stored if n in stored else header.upright))
        for n, (image, header) in enumerate(zip(images, headers))
    ]
    return lenses, [1 if n in stored else header.orientation for n, header in enumerate(headers)], notes


def _fitting_pixels(lens: Lens, header: ImageHeader) -> str:
    """Which pixels of an image with an EXIF orientation have a lens's aspect: "stored", "upright", "both" or ""."""
    if header.orientation == 1:
        return ""
    fits = _fits(lens, *header.stored), _fits(lens, *header.upright)
    return {(True, True): "both", (True, False): "stored", (False, True): "upright"}.get(fits, "")


def _poses_ignore_exif(posed: PosedImages) -> bool:
    """Whether the poses of a capture belong to stored pixels, by other images of it, else by colours of its points."""
    fits = [_fitting_pixels(image.lens, image_header(image.image)) for image in posed.images]
    if "upright" in fits or "stored" in fits:
        return "upright" not in fits
    images = [image for image, fit in zip(posed.images, fits) if fit == "both"]
    if not len(posed.colours) or (posed.colours == posed.colours[0]).all():
        return False
    votes = 0
    for image in images[:: -(-len(images) // ORIENTATION_SAMPLES)]:
        errors = [_colour_error(image, posed, upright=upright) for upright in (False, True)]
        votes += int(np.sign(errors[1] - errors[0]))
    return votes > 0


def _colour_error(image: PosedImage, posed: PosedImages, *, upright: bool) -> float:
    """Mean absolute difference between the points' colours and the pixels that show them; 255 if no point is seen."""
    pixels, _ = read_image(image.image, upright=upright)
    height, width = pixels.shape[:2]
    seen = np.asarray(posed.points, np.float64) @ image.world_to_camera[:3, :3].T + image.world_to_camera[:3, 3]
    front = seen[:, 2] > 0
    directions = seen[front, :2] / seen[front, 2:]
    near = np.abs(directions).max(1, initial=0) < MAX_SLOPE  # a polynomial lens folds back beyond its range
    places = np.floor(distort(image.lens.resized(width, height), directions[near])).astype(int)
    inside = ((places >= 0) & (places < (width, height))).all(1)
    if not inside.any():
        return 255.0
    shown = pixels[places[inside, 1], places[inside, 0]].astype(np.float64)
    return float(np.abs(shown - posed.colours[front][near][inside]).mean())


def _fits(lens: Lens, width: int, height: int) -> bool:
    """Whether an image of this size has the lens's aspect, to a pixel of the coarser of the two."""
    return min(abs(lens.width * height / lens.height - width), abs(width * lens.height / height - lens.width)) <= 1


def _lens_at_size(image: PosedImage, width: int, height: int) -> Lens:
    """The lens of an image at the size that it is read at."""
    lens = image.lens
    numbers = (lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion)
    if not is_finite_and_bounded(numbers) or min(lens.fx, lens.fy) < MIN_FOCAL:
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
    """Allocates uint8 frames, from MAX_IN_MEMORY on in a temporary file, of which the system caches what is in use."""
    if (size := math.prod(shape)) < MAX_IN_MEMORY:
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
    """Computes the extent of `build_capture`'s result; of the images, only headers are read.

    Args:
      posed: The posed images.
      options: Options of the frames.

    Returns:
      Number, size and names of the frames.

    Raises:
      InputError: As in `build_capture`, but for damaged pixels.
    """
    images, _, names = _in_order(posed)
    chosen = evenly_spaced(len(images), options.frames)
    images = [images[i] for i in chosen]
    lenses, orientations, _ = _resolve_orientations(images)
    for lens in set(lenses):
        undistorted_pinhole(lens, posed.where)
    size = options.size(_commonest_size(lenses))
    return CaptureExtent(len(images), size, tuple(names[i] for i in chosen), _files(images, lenses, orientations))


def _files(images: Sequence[PosedImage], lenses: Sequence[Lens], orientations: Sequence[int]) -> tuple[ImageFile, ...]:
    """The images of frames as `Capture.files` has them."""
    return tuple(
        ImageFile(image.name, lens.width, lens.height, orientation)
        for image, lens, orientation in zip(images, lenses, orientations)
    )


def _in_order(posed: PosedImages) -> tuple[list[PosedImage], np.ndarray, tuple[str, ...]]:
    """The images in name order, their poses (T, 4, 4) made exactly rigid, and the frames' names."""
    if not posed.images:
        raise InputError(posed.where, "it has no frame", "at least one posed image", "Estimate the poses again.")
    images = sorted(posed.images, key=lambda image: re.sub(r"\d+", lambda number: number[0].zfill(20), image.name))
    poses = np.stack([make_rigid(image.world_to_camera, posed.where, image.name) for image in images])
    return images, poses, frame_names([image.name for image in images], posed.where)


def _commonest_size(lenses: Sequence[Lens]) -> tuple[int, int]:
    """The commonest (width, height)."""
    return collections.Counter((lens.width, lens.height) for lens in lenses).most_common(1)[0][0]


Maps: TypeAlias = tuple[np.ndarray, np.ndarray]
"""of `undistortion_maps`"""


def _read_pixels(
    image: PosedImage, orientation: int, maps: Maps | None, size: tuple[int, int]
) -> tuple[UInt8[np.ndarray, "h w 3"], bool]:
    """The undistorted frame at `size` (width, height), and whether it had transparent pixels."""
    pixels, transparent = read_image(image.image, upright=orientation != 1)
    if maps is not None:
        pixels = cv2.remap(pixels, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    if pixels.shape[1::-1] == size:
        return pixels, transparent
    shrinks = size[0] <= pixels.shape[1] and size[1] <= pixels.shape[0]
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR), transparent


def _read_depth(
    file: Path, image: PosedImage, lens: Lens, orientation: int, maps: Maps | None, size: tuple[int, int], unit: float
) -> Float[np.ndarray, "h w"]:
    """The undistorted depth map at `size` (width, height), with `unit` for a world unit of the file."""
    depth = read_depth(file, image.depth_unit * unit)
    if image.depth_lens is not None:
        depth = resample_depth(depth, image.depth_lens, lens)
    elif not _fits(lens, *depth.shape[1::-1]) and orientation in TRANSPOSED:
        depth = apply_orientation(depth, orientation)  # measured like the stored pixels
    if abs(depth.shape[1] * lens.height / depth.shape[0] - lens.width) > 1:
        problem = f"the depth map is {depth.shape[1]}x{depth.shape[0]}"
        raise InputError(
            file, problem, f"the aspect of its image, {lens.width}x{lens.height}", "Register it to the image."
        )
    # Nearest throughout: the mean of two depths lies on neither surface.
    if maps is not None:
        depth = cv2.resize(depth, (lens.width, lens.height), interpolation=cv2.INTER_NEAREST_EXACT)
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
    `Capture.source_from_scene` leads back.

    Args:
      posed: The posed images.
      options: Options of the frames.
      only: Names of the frames to read; None: all.
      progress: Called with (frames done, frames).

    Returns:
      The capture; its notes say what was skipped or changed.

    Raises:
      InputError: Images are missing, damaged or of another aspect, or poses are not finite and rigid.
    """
    images, poses, names = _in_order(posed)
    deep = [image for image in images if image.depth is not None and not len(posed.points)]
    samples = [deep[index] for index in evenly_spaced(len(deep), DEPTH_SAMPLES)] if deep else []
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
    notes = [*posed.notes, *world_notes, *camera_jumps(poses, names)]
    chosen = evenly_spaced(len(images), options.frames)
    if len(chosen) < len(images):
        notes.append(f"{len(chosen)} of {len(images)} frames were taken, evenly spaced.")
    images, poses, names = [images[i] for i in chosen], poses[chosen], tuple(names[i] for i in chosen)

    lenses, orientations, orientation_notes = _resolve_orientations(images, posed)
    notes += orientation_notes
    sizes = [(lens.width, lens.height) for lens in lenses]
    if rescaled := sum(size != (image.lens.width, image.lens.height) for size, image in zip(sizes, images)):
        notes.append(f"{rescaled} images have another size than their camera model; its intrinsics were scaled.")
    pinholes = {lens: undistorted_pinhole(lens, posed.where) for lens in set(lenses)}
    if bent := sum(lens.distorted for lens in lenses):
        notes.append(f"{bent} images were undistorted; masks and labels must be of the undistorted images.")
    width, height = _commonest_size(lenses)
    if odd := sum(size != (width, height) for size in sizes):
        notes.append(f"{odd} images were resized to {width}x{height}, the commonest size, with their intrinsics.")
    width, height = options.size((width, height))

    pixels = _allocate_frames((len(images), height, width, 3))
    has_depth = any(image.depth for image in images)
    depth_maps = np.zeros((len(images), height, width), np.float32) if has_depth else None
    cached_maps = functools.lru_cache(maxsize=4)(undistortion_maps)

    def read(index: int) -> bool:
        image, lens, orientation, size = images[index], lenses[index], orientations[index], (width, height)
        maps = cached_maps(lens, pinholes[lens]) if lens.distorted else None
        pixels[index], is_transparent = _read_pixels(image, orientation, maps, size)
        if image.depth is not None and depth_maps is not None:
            depth_maps[index] = _read_depth(image.depth, image, lens, orientation, maps, size, world[0, 0])
        return is_transparent

    transparent = 0
    with ThreadPoolExecutor(cores()) as pool:
        try:
            for done, is_transparent in enumerate(pool.map(read, range(len(images))), start=1):
                transparent += is_transparent
                if progress is not None:
                    progress(done, len(images))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    if transparent:
        notes.append(f"{transparent} images have transparent pixels; they were laid over black.")
    held_out = holdout_mask(len(images), options.holdout)
    if held_out.all():
        held_out[:] = False
        notes.append("No frame was held out, since there is only one.")
    final = [pinholes[lens].resized(width, height) for lens in lenses]
    fx, fy, cx, cy = np.array([(lens.fx, lens.fy, lens.cx, lens.cy) for lens in final], np.float32).T
    return Capture(
        frames=pixels,
        cameras=Camera(poses.astype(np.float32), fx, fy, cx, cy, width, height),
        points=(np.asarray(posed.points, np.float64) @ world[:3, :3] + world[:3, 3]).astype(np.float32),
        point_colors=np.asarray(posed.colours, np.uint8),
        held_out=held_out,
        depths=depth_maps,
        source_from_scene=np.asarray(posed.source_from_scene, np.float64) @ from_world,
        names=names,
        notes=tuple(notes),
        files=_files(images, lenses, orientations),
        poses_from_scene=from_world,
    )
