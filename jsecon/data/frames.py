"""From posed image files to a Capture: the part of loading that every capture format shares."""

from __future__ import annotations

import collections
import dataclasses
import functools
import math
import os
import re
import tempfile
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from jsecon.data.coordinates import normalizing_transform, transform_poses
from jsecon.data.images import TRANSPOSED, ImageHeader, apply_orientation, image_header, read_depth, read_image
from jsecon.data.lens import Lens, distort, resample_depth, undistorted_pinhole, undistortion_maps
from jsecon.data.poses import camera_jumps, make_rigid
from jsecon.errors import InputError
from jsecon.numerics import is_finite_and_bounded
from jsecon.types import Camera, Capture, ImageFile

Progress = Callable[[int, int], None] | None

LEAST_FOCAL = 1e-3
"""px: the least focal length that is one"""
EXIF_LOOKS = 4
"""images, at most, that the colours of sparse points are compared with to tell which way up their cameras are"""
WIDE = 2.0
"""x/z and y/z up to which points are looked at there"""
DEPTHS_SEEN = 8
"""depth maps that the scene's size is read off"""
IN_MEMORY = 1 << 30
"""bytes of frames that are kept in memory; more are kept in a temporary file"""


@dataclasses.dataclass(frozen=True)
class PosedImage:
    """One image file and where it was taken."""

    name: str
    """path as the capture names it, with "/": frames are ordered by it, and by the numbers in it (9 before 10)."""
    image: Path
    lens: Lens
    """of the image; rescaled where the file has another size of the same aspect."""
    world_to_camera: np.ndarray
    """(4, 4) float64, OpenCV axes."""
    depth: Path | None = None
    depth_unit: float = 0.001
    """world units of one count in the depth file."""
    depth_lens: Lens | None = None
    """of the depth map, a pinhole at the same place; None: the image's, at the map's size."""


@dataclasses.dataclass(frozen=True)
class PosedImages:
    """A capture before any pixel is read: what every format's reader gives to `build_capture`."""

    shots: Sequence[PosedImage]
    where: object
    """names the capture in errors."""
    points: Float[np.ndarray, "p 3"] = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """sparse points, world, float64."""
    colours: UInt8[np.ndarray, "p 3"] = dataclasses.field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    to_source: Float[np.ndarray, "4 4"] = dataclasses.field(default_factory=lambda: np.eye(4))
    """from the world of the poses to that of the files that they were made from."""
    notes: tuple[str, ...] = ()


def check_capture_options(
    downscale: float | int | None, frames: int | None, holdout: int | None, long_side: int | None = None
) -> None:
    """Raises InputError on options that no capture can be loaded with."""
    if downscale is not None and not (np.isfinite(downscale) and downscale >= 1):
        raise InputError("downscale", str(downscale), "a number of at least 1", "2 halves width and height.")
    if long_side is not None and long_side < 1:
        raise InputError("long_side", str(long_side), "at least 1 px", "400 is the default.")
    if frames is not None and frames < 1:
        raise InputError("frames", str(frames), "at least 1", "Leave it out to take every frame.")
    if holdout is not None and (holdout < 0 or holdout == 1):
        expected, remedy = "0 (none), or at least 2 (every second)", "8 is the custom; 1 leaves no frame to fit to."
        raise InputError("holdout", str(holdout), expected, remedy)


def evenly_spaced(count: int, wanted: int | None) -> np.ndarray:
    """Indices of at most `wanted` of `count` frames, evenly spaced, the first and the last among them."""
    if wanted is None or wanted >= count:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, wanted).round().astype(int))


def holdout_mask(count: int, every: int | None) -> Bool[np.ndarray, " t"]:
    """The frames 0, k, 2k, ... in name order, as in Mip-NeRF 360 and INRIA's split; none for 0 or None."""
    return np.arange(count) % every == 0 if every else np.zeros(count, bool)


def frame_names(files: Sequence[str], where: object) -> tuple[str, ...]:
    """File names without folder or ending; with their folders ("a_0001") where two would be the same.

    What follows the last dot is no ending where it is a number: render.0001 keeps it. No name holds a "/". Raises
    InputError, at `where`, where two files differ in nothing but their endings.
    """
    paths = [_without_ending(PurePosixPath(file)) for file in files]
    folders = [[part for part in path.parts if part not in ("/", "..")] for path in paths]
    for names in ([path.name for path in paths], *([joint.join(parts) for parts in folders] for joint in ("_", "__"))):
        if len(set(names)) == len(names):
            return tuple(names)
    twice = collections.Counter(names).most_common(1)[0][0]
    first, second = [file for file, name in zip(files, names) if name == twice][:2]
    expected, remedy = "names that differ in more than their endings", "Rename the images, or take one of the two out."
    raise InputError(where, f"two frames called {first} and {second}", expected, remedy)


def _without_ending(path: PurePosixPath) -> PurePosixPath:
    return path if path.suffix[1:].isdecimal() else path.with_suffix("")


def _as_read(shots: Sequence[PosedImage], posed: PosedImages | None = None) -> tuple[list[Lens], list[int], list[str]]:
    """How each shot's image is read: the lens at the size that it really has (a folder of smaller images is common),
    the EXIF orientation that is applied to its pixels, 1 where they are taken as stored; and notes.

    A camera model belongs to the stored pixels or to the upright image: COLMAP ignores EXIF, other programs apply it.
    Where only one of the two has the model's aspect, it is that one. Where both have it (a square, or a turn by 180
    degrees), the other images of the capture `posed` decide, else the colours of its sparse points, else EXIF is
    applied.
    """
    headers = [image_header(shot.image) for shot in shots]
    kept = {n for n, header in enumerate(headers) if _belongs(shots[n].lens, header) == "stored"}
    unsure = {n for n, header in enumerate(headers) if _belongs(shots[n].lens, header) == "either"}
    if unsure and posed is not None and _exif_ignored(posed):
        kept |= unsure
    notes = []
    if kept:
        told = f"{len(kept)} images have an EXIF orientation that their camera models leave out"
        notes.append(f"{told} (the first: {shots[min(kept)].name}); they are taken as they are stored.")
    if applied := [n for n, header in enumerate(headers) if header.orientation != 1 and n not in kept]:
        first = f"the first: {shots[applied[0]].name}"
        notes.append(f"{len(applied)} images were turned upright, as their EXIF orientation says ({first}).")
    lenses = [
        _true_lens(shot, *(header.stored if n in kept else header.upright))
        for n, (shot, header) in enumerate(zip(shots, headers))
    ]
    return lenses, [1 if n in kept else header.orientation for n, header in enumerate(headers)], notes


def _belongs(lens: Lens, header: ImageHeader) -> str:
    """Which pixels of an image that EXIF turns have the aspect of a camera model: "stored", "upright", "either"; empty
    where it turns none, or neither fits."""
    if header.orientation == 1:
        return ""
    stored, upright = _fits(lens, *header.stored), _fits(lens, *header.upright)
    return {(True, True): "either", (True, False): "stored", (False, True): "upright"}.get((stored, upright), "")


def _exif_ignored(posed: PosedImages) -> bool:
    """Whether the poses of a capture belong to stored pixels, by its images whose aspect tells, else by the colours of
    its points."""
    belongs = [_belongs(shot.lens, image_header(shot.image)) for shot in posed.shots]
    if "upright" in belongs or "stored" in belongs:
        return "upright" not in belongs
    either = [shot for shot, pixels in zip(posed.shots, belongs) if pixels == "either"]
    return _stored_explains(either, posed.points, posed.colours)


def _fits(lens: Lens, width: int, height: int) -> bool:
    """Whether an image of this size has the lens's aspect, to a pixel of the coarser of the two."""
    return min(abs(lens.width * height / lens.height - width), abs(width * lens.height / height - lens.width)) <= 1


def _stored_explains(shots: Sequence[PosedImage], points: np.ndarray, colours: np.ndarray) -> bool:
    """Whether the colours of the sparse points agree better with the stored pixels than with the upright images, in
    most of EXIF_LOOKS shots; False where there are no colours to compare."""
    if not len(colours) or (colours == colours[0]).all():
        return False
    better = 0
    for shot in shots[:: -(-len(shots) // EXIF_LOOKS)]:
        errors = [_colour_error(shot, points, colours, upright=upright) for upright in (False, True)]
        better += int(np.sign(errors[1] - errors[0]))
    return better > 0


def _colour_error(shot: PosedImage, points: np.ndarray, colours: np.ndarray, *, upright: bool) -> float:
    """Mean absolute difference between the points' colours and the pixels that they are seen at; 255 of none."""
    image, _ = read_image(shot.image, upright=upright)
    seen = np.asarray(points, np.float64) @ shot.world_to_camera[:3, :3].T + shot.world_to_camera[:3, 3]
    front = seen[:, 2] > 0
    directions = seen[front, :2] / seen[front, 2:]
    # A wide view only: a polynomial lens folds back beyond its range.
    near = np.abs(directions).max(1, initial=0) < WIDE
    pixels = np.floor(distort(shot.lens.resized(image.shape[1], image.shape[0]), directions[near])).astype(int)
    inside = ((pixels >= 0) & (pixels < image.shape[1::-1])).all(1)
    if not inside.any():
        return 255.0
    shown = image[pixels[inside, 1], pixels[inside, 0]].astype(np.float64)
    return float(np.abs(shown - colours[front][near][inside]).mean())


def _true_lens(shot: PosedImage, width: int, height: int) -> Lens:
    """The lens of a shot at the size that its image is read at."""
    lens = shot.lens
    if (
        not is_finite_and_bounded((lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion))
        or min(lens.fx, lens.fy) < LEAST_FOCAL
    ):
        problem = f"its camera has focal lengths {lens.fx:g}, {lens.fy:g}, centre {lens.cx:g}, {lens.cy:g}"
        problem += f" and distortion {lens.distortion}"
        raise InputError(shot.image, problem, "finite pixels", "Estimate the cameras again.")
    if (width, height) == (lens.width, lens.height):
        return lens
    if not _fits(lens, width, height):
        remedy = "Use the images that the poses were estimated on (mind their rotation), or a scaled copy of them."
        wanted = f"{lens.width}x{lens.height} of its camera, or that aspect"
        raise InputError(shot.image, f"the image is {width}x{height}", wanted, remedy)
    return lens.resized(width, height)


def _some_depths(posed: PosedImages, shots: Sequence[PosedImage]) -> list[np.ndarray]:
    """A few depth maps, where there are no points to tell how far things are."""
    deep = [shot for shot in shots if shot.depth is not None and not len(posed.points)]
    chosen = [deep[index] for index in evenly_spaced(len(deep), DEPTHS_SEEN)] if deep else []
    return [read_depth(shot.depth, shot.depth_unit) for shot in chosen if shot.depth is not None]


def _resize(image: np.ndarray, width: int, height: int) -> np.ndarray:
    if image.shape[:2] == (height, width):
        return image
    shrinks = width <= image.shape[1] and height <= image.shape[0]
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def allocate_frames(shape: tuple[int, ...]) -> np.ndarray:
    """Uninitialised uint8; from IN_MEMORY on in a file without a name, from which the system holds what is in use.
    Raises InputError where the disk has no room for it."""
    if (size := math.prod(shape)) < IN_MEMORY:
        return np.empty(shape, np.uint8)
    with tempfile.TemporaryFile() as file:
        try:
            if hasattr(os, "posix_fallocate"):  # a mapped page without a place on the disk ends the process by SIGBUS
                os.posix_fallocate(file.fileno(), 0, size)
            return np.memmap(file, np.uint8, "w+", shape=shape)
        except OSError as error:
            found = f"{error.strerror or error} for {size / 2**30:.1f} GiB of frames"
            remedy = "Free some room, set TMPDIR to a folder that has it, or take fewer or smaller frames."
            raise InputError(tempfile.gettempdir(), found, "room on the disk of temporary files", remedy) from error


class CaptureExtent(NamedTuple):
    """Number, size and names of a capture's frames.

    Attributes:
      frames: Number of frames.
      size: (width, height) of the frames, px.
      names: Names of the frames; empty if they are not known yet.
      files: Image of each named frame.
    """

    frames: int
    size: tuple[int, int]
    names: tuple[str, ...] = ()
    files: tuple[ImageFile, ...] = ()


def planned_extent(
    posed: PosedImages, downscale: float | int | None, long_side: int | None, frames: int | None
) -> CaptureExtent:
    """What `build_capture` would make of it; of the images, only the headers are read.

    Raises InputError where `build_capture` would, but for what only the images' pixels tell.
    """
    shots, _, names = _in_order(posed)
    chosen = evenly_spaced(len(shots), frames)
    shots = [shots[i] for i in chosen]
    lenses, orientations, _ = _as_read(shots)
    for lens in set(lenses):
        undistorted_pinhole(lens, posed.where)
    files = tuple(
        ImageFile(shot.name, lens.width, lens.height, orientation)
        for shot, lens, orientation in zip(shots, lenses, orientations)
    )
    size = downscaled_size(_commonest(lenses), downscale, long_side)
    return CaptureExtent(len(shots), size, tuple(names[i] for i in chosen), files)


def _in_order(posed: PosedImages) -> tuple[list[PosedImage], np.ndarray, tuple[str, ...]]:
    """The shots in name order, their poses (t, 4, 4) made exactly rigid, and the frames' names."""
    if not posed.shots:
        raise InputError(posed.where, "no frame", "at least one posed image", "Estimate the poses again.")
    shots = sorted(posed.shots, key=lambda shot: re.sub(r"\d+", lambda number: number[0].zfill(20), shot.name))
    poses = np.stack([make_rigid(shot.world_to_camera, posed.where, shot.name) for shot in shots])
    return shots, poses, frame_names([shot.name for shot in shots], posed.where)


def _commonest(lenses: Sequence[Lens]) -> tuple[int, int]:
    return collections.Counter((lens.width, lens.height) for lens in lenses).most_common(1)[0][0]


def downscaled_size(size: tuple[int, int], downscale: float | int | None, long_side: int | None) -> tuple[int, int]:
    """(width, height) of the frames made of images of `size`, see `build_capture`."""
    if downscale is None:
        downscale = max(max(size) / long_side, 1.0) if long_side is not None else 1.0
    return max(1, round(size[0] / downscale)), max(1, round(size[1] / downscale))


def build_capture(
    posed: PosedImages,
    *,
    downscale: float | int | None = None,
    long_side: int | None = None,
    frames: int | None = None,
    holdout: int | None = 8,
    only: Collection[str] | None = None,
    progress: Progress = None,
) -> Capture:
    """Reads the images and makes the Capture: name order, lenses undistorted, one size, some frames held out.

    Distorted images are resampled (bilinear) to the widest pinhole lens without empty pixels, then shrunk by
    `downscale` (area average), or where that is None so that the longer side is at most `long_side`. Where the sizes
    differ, the commonest is taken and the others are resized to it, focal lengths with them. `only`: frames of these
    names alone. Large coordinates and units far from metres are changed in float64 (`normalizing_transform`), by the
    same for any choice of frames; `Capture.to_source` leads back. Raises InputError on images that are missing, damaged
    or of another aspect, and on poses that are not finite and rigid.
    """
    check_capture_options(downscale, frames, holdout, long_side)
    where = posed.where
    shots, poses, names = _in_order(posed)
    world, changed = normalizing_transform(poses, posed.points, _some_depths(posed, shots))  # of all, whatever is taken
    poses, from_world = transform_poses(poses, world), np.linalg.inv(world)
    if only is not None:
        missing = sorted(set(only) - set(names))
        if missing or not only:
            told, wanted = f"{len(names)} frames, {names[0]} ... {names[-1]}", f"one called {[*missing, '...'][0]}"
            raise InputError(where, told, wanted, "Give the capture that these names are of.")
        kept = [i for i, name in enumerate(names) if name in only]
        shots, poses, names = [shots[i] for i in kept], poses[kept], tuple(names[i] for i in kept)
    notes = [*posed.notes, *changed, *camera_jumps(poses, names)]
    chosen = evenly_spaced(len(shots), frames)
    if len(chosen) < len(shots):
        notes.append(f"{len(chosen)} of {len(shots)} frames were taken, evenly spaced.")
    shots, poses, names = [shots[i] for i in chosen], poses[chosen], tuple(names[i] for i in chosen)

    lenses, orientations, told = _as_read(shots, posed)
    notes += told
    rescaled = sum(
        (lens.width, lens.height) != (shot.lens.width, shot.lens.height) for lens, shot in zip(lenses, shots)
    )
    if rescaled:
        notes.append(f"{rescaled} images have another size than their camera model; its intrinsics were scaled.")
    pinholes = {lens: undistorted_pinhole(lens, where) for lens in set(lenses)}
    bent = sum(lens.distorted for lens in lenses)
    if bent:
        notes.append(f"{bent} images were undistorted; masks and labels must be of the undistorted images.")

    width, height = _commonest(lenses)
    odd = sum((lens.width, lens.height) != (width, height) for lens in lenses)
    if odd:
        notes.append(f"{odd} images were resized to {width}x{height}, the commonest size, with their intrinsics.")
    width, height = downscaled_size((width, height), downscale, long_side)
    final = [pinholes[lens].resized(width, height) for lens in lenses]

    result = allocate_frames((len(shots), height, width, 3))
    depths = np.zeros((len(shots), height, width), np.float32) if any(shot.depth for shot in shots) else None
    maps = functools.lru_cache(maxsize=4)(undistortion_maps)

    def read(index: int) -> bool:
        shot, lens = shots[index], lenses[index]
        image, transparent = read_image(shot.image, upright=orientations[index] != 1)
        if lens.distorted:
            image = cv2.remap(image, *maps(lens, pinholes[lens]), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        result[index] = _resize(image, width, height)
        if shot.depth is not None and depths is not None:
            depth = read_depth(shot.depth, shot.depth_unit * world[0, 0])
            if shot.depth_lens is not None:
                depth = resample_depth(depth, shot.depth_lens, lens)
            elif not _fits(lens, *depth.shape[1::-1]) and orientations[index] in TRANSPOSED:
                depth = apply_orientation(depth, orientations[index])  # measured like the stored pixels
            if abs(depth.shape[1] * lens.height / depth.shape[0] - lens.width) > 1:
                problem = f"the depth map is {depth.shape[1]}x{depth.shape[0]}"
                wanted = f"the aspect of its image, {lens.width}x{lens.height}"
                raise InputError(shot.depth, problem, wanted, "Register it to the image.")
            # Nearest throughout: the mean of two depths lies on neither surface.
            if lens.distorted:
                depth = cv2.resize(depth, (lens.width, lens.height), interpolation=cv2.INTER_NEAREST_EXACT)
                depth = cv2.remap(depth, *maps(lens, pinholes[lens]), cv2.INTER_NEAREST)
            depths[index] = cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
        return transparent

    transparent = 0
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        try:
            for done, see_through in enumerate(pool.map(read, range(len(shots))), start=1):
                transparent += see_through
                if progress is not None:
                    progress(done, len(shots))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    if transparent:
        notes.append(f"{transparent} images have transparent pixels; they were laid over black.")
    out = holdout_mask(len(shots), holdout)
    if out.all():
        out[:] = False
        notes.append("No frame was held out, since there is only one.")
    fx, fy, cx, cy = np.array([(lens.fx, lens.fy, lens.cx, lens.cy) for lens in final], np.float32).T
    return Capture(
        frames=result,
        cameras=Camera(poses.astype(np.float32), fx, fy, cx, cy, width, height),
        points=(np.asarray(posed.points, np.float64) @ world[:3, :3] + world[:3, 3]).astype(np.float32),
        point_colors=np.asarray(posed.colours, np.uint8),
        held_out=out,
        depths=depths,
        to_source=np.asarray(posed.to_source, np.float64) @ from_world,
        names=names,
        notes=tuple(notes),
        files=tuple(
            ImageFile(shot.name, lens.width, lens.height, orientation)
            for shot, lens, orientation in zip(shots, lenses, orientations)
        ),
        to_poses=from_world,
    )
