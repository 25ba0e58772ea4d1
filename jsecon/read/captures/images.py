"""Image files on the host: RGB frames, label images of integers, depth maps.

Pillow decodes them and raises on truncated files. OpenCV encodes: after `import pycolmap`, Pillow ends the process when
it saves a PNG.

Images are returned upright, as their EXIF orientation asks. If poses belong to the stored pixels
(`jsecon.read.captures.build` decides that), images are read with `upright=False`.
"""

import contextlib
import os
import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt, UInt8
from PIL import Image
from PIL.ImageFile import ImageFile

from jsecon.errors import InputError
from jsecon.files import atomic_write, map_npy, reading
from jsecon.read.registry import decoding

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".heic", ".heif", ".avif")
IMAGE_SUFFIXES += tuple(suffix.upper() for suffix in IMAGE_SUFFIXES)
"""suffixes tried, in this order, if a capture names an image without one"""
MAX_PIXELS = 1 << 27
"""pixels of an image: 134 million"""
_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "AVIF", "HEIF")
"""Pillow's names of the formats that are read"""
_UNREAD = re.compile(
    r".*\.(gif|exr|jxl|jp2|psd|hdr|tga|ppm|pgm|svg|dng|nef|cr2|cr3|arw|raf|orf|rw2)", re.IGNORECASE | re.DOTALL
)
"""names of images that are not read; a camera's raw file is a TIFF whose first image is a thumbnail"""
_PILLOW_WARNS = 2 * MAX_PIXELS
"""pixels of an image of which Pillow warns: headers of smaller ones must be read"""
_PILLOW_LIMIT = threading.Lock()
"""held while Pillow's limit, one for the whole process, is _PILLOW_WARNS"""


@contextlib.contextmanager
def _open(path: Path) -> Iterator[ImageFile]:
    """Opens an image; only its header is read. Errors of the decoder in the body of the `with` become InputErrors."""
    with reading(path, remedy="Copy the file again.", problem="the image cannot be read"), path.open("rb") as file:
        if remedy := unread_remedy(path):
            raise InputError(path, f"{path.suffix} images are not read", remedy=remedy)
        head = file.read(12)
        if head[4:12] in (b"ftypheic", b"ftypheix", b"ftypmif1", b"ftyphevc"):
            with decoding(path, "pillow_heif") as heif:
                heif.register_heif_opener()
        try:
            image = _open_header(file)
        except (Image.UnidentifiedImageError, Image.DecompressionBombError) as error:
            raise ValueError("it is no image of a known kind and size" if head else "the file is empty") from error
        with image:
            if image.format == "JPEG" and image.width * image.height > MAX_PIXELS:
                image.draft(None, (image.width // 2, image.height // 2))
            if image.width * image.height > MAX_PIXELS:
                limit = f"{MAX_PIXELS // 10**6} million"
                raise ValueError(f"its {image.width}x{image.height} pixels are more than {limit}: shrink it")
            yield image


def _open_header(file: IO[bytes]) -> ImageFile:
    """Opens an image by Pillow, also one of more than MAX_PIXELS; Pillow's own limit is back afterwards."""
    with _PILLOW_LIMIT:
        limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, _PILLOW_WARNS
        try:
            return Image.open(file, formats=_FORMATS)
        finally:
            Image.MAX_IMAGE_PIXELS = limit


def unread_remedy(path: Path) -> str:
    """Says how to convert an image that is named like one of a format that is not read; "" for any other file."""
    if _UNREAD.fullmatch(path.name) is None:
        return ""
    return f"Convert it to JPEG or PNG, for example: magick mogrify -format jpg '{path.parent}/*{path.suffix}'"


def _orientation(image: ImageFile) -> int:
    """EXIF's orientation, 1 to 8, of pixels that Pillow returns as they are stored: it turns TIFF and HEIC itself.

    1 is upright; 6, the commonest of a phone held upright, asks for a turn clockwise by 90 degrees. From 5 on they swap
    width and height.
    """
    tags = Image.Exif()
    if image.format in ("JPEG", "PNG", "WEBP", "AVIF"):
        with contextlib.suppress(Exception):  # damaged EXIF turns nothing
            tags.load(image.info.get("exif", b""))
    value = tags.get(0x0112, 1)
    return value if value in range(1, 9) else 1


def _apply_orientation(image: np.ndarray, orientation: int) -> np.ndarray:
    """Turns stored pixels (H, W, ...) upright, by their EXIF orientation."""
    if orientation > 4:
        image = image.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    return np.ascontiguousarray(image)


def _decode(path: Path, *, upright: bool = True, native: bool = False) -> tuple[np.ndarray, ImageFile]:
    """Decodes an image to grey, RGB or RGBA; 16 bits of colour become 8.

    `native` keeps the indices of a palette, and colours that are declared transparent. Also returns the closed image.
    """
    with _open(path) as image:
        if image.format == "PNG":
            with path.open("rb") as file, _open_header(file) as copy:
                copy.verify()  # compares the checksums, and leaves an image that cannot be decoded
        orientation = _orientation(image)
        image.load()
        is_kept = native or image.mode in ("L", "I;16", "I;16B", "I", "F")
        mode = image.mode if is_kept else "RGB"
        if image.has_transparency_data and not native:
            mode = "RGBA"
        pixels = np.asarray(image if mode == image.mode else image.convert(mode))
        pixels = pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
        return _apply_orientation(pixels, orientation) if upright else pixels, image


def without_image_suffix(name: str) -> str:
    """The name of a file without the suffix of an image; what follows another dot belongs to the name."""
    stem, suffix = os.path.splitext(name)
    return stem if suffix.lower() in IMAGE_SUFFIXES else name


def find_image(folder: Path, name: str) -> Path | None:
    """Finds the image file that a capture names, relative to `folder`.

    Backslashes are separators (of a Windows program). The suffix may be in upper or lower case; a name without the
    suffix of an image gets one.
    """
    base = name.replace("\\", "/")
    stem, suffix = os.path.splitext(base)
    added = () if suffix.lower() in IMAGE_SUFFIXES else IMAGE_SUFFIXES  # a.jpg.png is a mask of a.jpg
    for candidate in (base, stem + suffix.lower(), stem + suffix.upper(), *(base + end for end in added)):
        if os.path.isfile(folder / candidate):  # False also for a name that no file can have
            return folder / candidate
    return None


class _ImageHeader(NamedTuple):
    """Sizes (width, height), px, and EXIF orientation of an image file."""

    stored: tuple[int, int]
    upright: tuple[int, int]
    """The size once the orientation is applied."""
    orientation: int
    """1 to 8."""
    mode: str
    """Pillow's, of the kind of pixels."""


def image_header(path: Path) -> _ImageHeader:
    """Reads size, orientation and kind of an image file, from its header alone."""
    with _open(path) as image:
        orientation = _orientation(image)
        width, height = image.size
        upright = (height, width) if orientation > 4 else (width, height)
        return _ImageHeader((width, height), upright, orientation, image.mode)


def read_image(path: Path, *, upright: bool = True) -> UInt8[np.ndarray, "h w 3"]:
    """Reads an image file as RGB of 8 bits.

    Transparent pixels are blended with black, as in a render without background. A JPEG of more than MAX_PIXELS is
    decoded at half its size. `upright=False` returns the stored pixels.
    """
    image, _ = _decode(path, upright=upright)
    if image.dtype == np.uint16:
        image = cv2.convertScaleAbs(image, alpha=255 / 65535)  # rounds to nearest
    if image.dtype != np.uint8:
        raise InputError(path, f"its pixels are of type {image.dtype}", "8 or 16 bits", "Convert it to PNG or JPEG.")
    if image.ndim == 2:
        return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
    rgb, alpha = image[..., :3], image[..., 3:]
    if (alpha == 255).all():
        return np.ascontiguousarray(rgb)
    return ((rgb.astype(np.uint16) * alpha + 127) // 255).astype(np.uint8)


def write_image(path: str | Path, image: UInt8[np.ndarray, "h w 3"] | UInt[np.ndarray, "h w"]) -> None:
    """Writes RGB, or grey values of 8 or 16 bits, atomically; the suffix, .png or .jpg, chooses the format."""
    path, image = Path(path), np.asarray(image)
    _, data = cv2.imencode(path.suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image)
    with atomic_write(path) as temporary:
        temporary.write_bytes(data.tobytes())


def encode_jpeg(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, " b"]:
    """Encodes RGB as a JPEG of quality 90."""
    return cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 90])[1].ravel()


def whole_numbers(array: np.ndarray) -> Int[np.ndarray, "..."]:
    """Makes integers of numbers, which must be whole."""
    with np.errstate(invalid="ignore"):
        integers = array.astype(np.int64)
    if (integers != array).any():
        raise ValueError("its numbers are no whole numbers")
    return np.asarray(integers)


def read_label_image(path: Path) -> Int[np.ndarray, "h w"]:
    """Reads the ids of a label image (.png or .npy).

    A grey PNG of 8 or 16 bits has its values as ids; a palette PNG the indices into it, never its colours; an RGB PNG
    of 8 bits R*65536 + G*256 + B. A .npy has whole numbers or booleans (H, W), negative where there is no label.
    """
    expected = "ids (H, W) as grey values of 8 or 16 bits, palette indices or 8 bit colours, or whole numbers in a .npy"
    with reading(path, expected, "Write one id per pixel, a file for each frame.", problem="the mask cannot be read"):
        if path.suffix.lower() == ".npy":
            ids = whole_numbers(map_npy(path))
            if ids.ndim != 2 or not ids.size:
                raise ValueError(f"its shape is {ids.shape}")
            return ids
        image, decoder = _decode(path, native=True)
        if decoder.format != "PNG":
            raise ValueError("it is not a PNG")
        if image.ndim == 2:
            return image.astype(np.int32)
        bits = path.read_bytes()[24]
        if bits > 8 or image.shape[2] != 3:
            raise ValueError(f"it has {image.shape[2]} channels of {bits} bits")
        return image.astype(np.int32) @ np.array([65536, 256, 1], np.int32)


def read_depth(path: Path, unit: float) -> Float[np.ndarray, "h w"]:
    """Reads a depth map, float32 z-depth in world units, 0 = unknown, of a 16 bit PNG or a .npy of shape (H, W).

    `unit` is that of one count in world units (nerfstudio: 0.001, from millimetres).
    """
    expected = "one channel of 16 bits (PNG), or a .npy of shape (H, W)"
    remedy = "Write the depth in millimetres as a 16 bit PNG."
    with reading(path, expected, remedy, problem="the depth map cannot be read"):
        is_array = path.suffix.lower() == ".npy"
        depth = map_npy(path) if is_array else _decode(path)[0]
        depth = depth[..., 0] if depth.ndim == 3 and depth.shape[2] == 1 else depth
        if depth.ndim != 2 or not depth.size or not (is_array or depth.dtype == np.uint16):
            raise ValueError(f"it has shape {depth.shape} of {depth.dtype}")
    if not is_array:
        depth = np.where(depth == 65535, np.uint16(0), depth)  # RGB-D cameras write it where they see nothing
    with np.errstate(over="ignore", invalid="ignore"):  # infinite: unknown
        depth = depth.astype(np.float32) * np.float32(unit)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
