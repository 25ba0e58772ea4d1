"""Image files on the host: RGB frames, label images of integers, depth maps.

Pillow decodes them and raises on truncated files; its classes are called directly, since `Image.open` warns of large
photographs. OpenCV encodes: after `import pycolmap`, Pillow ends the process when it saves a PNG.

Images are returned upright, as their EXIF orientation asks. If poses belong to the stored pixels
(`jsecon.read.captures.build` decides that), images are read with `upright=False`.
"""

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt, UInt8
from PIL import (
    AvifImagePlugin,
    BmpImagePlugin,
    Image,
    JpegImagePlugin,
    PngImagePlugin,
    TiffImagePlugin,
    WebPImagePlugin,
)
from PIL.ImageFile import ImageFile

from jsecon.errors import InputError
from jsecon.files import atomic_write, map_npy, reading

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".heic", ".heif", ".avif")
IMAGE_SUFFIXES += tuple(suffix.upper() for suffix in IMAGE_SUFFIXES)
"""suffixes tried, in this order, if a capture names an image without one"""
MAX_PIXELS = 1 << 27
"""pixels of an image: 134 million"""
_DECODERS: dict[bytes, type[ImageFile]] = {
    b"\x89PNG": PngImagePlugin.PngImageFile,
    b"\xff\xd8": JpegImagePlugin.JpegImageFile,
    b"RIFF": WebPImagePlugin.WebPImageFile,
    b"BM": BmpImagePlugin.BmpImageFile,
    b"II*\0": TiffImagePlugin.TiffImageFile,
    b"MM\0*": TiffImagePlugin.TiffImageFile,
}
"""first bytes of a file -> Pillow's decoder"""
_UNREAD = re.compile(
    r".*\.(gif|exr|jxl|jp2|psd|hdr|tga|ppm|pgm|svg|dng|nef|cr2|cr3|arw|raf|orf|rw2)", re.IGNORECASE | re.DOTALL
)
"""names of images that are not read; a camera's raw file is a TIFF whose first image is a thumbnail"""


@contextlib.contextmanager
def _open(path: Path) -> Iterator[ImageFile]:
    """Opens an image; only its header is read. Errors of the decoder in the body of the `with` become InputErrors."""
    again = "Copy or export the file again."
    with reading(path, remedy=again, problem="the image cannot be read"), path.open("rb") as file:
        head = file.read(32)
        file.seek(0)
        if not head:
            raise ValueError("the file is empty")
        decoder = next((kind for magic, kind in _DECODERS.items() if head.startswith(magic)), None)
        if decoder is None and head[4:8] == b"ftyp" and b"avi" in head[8:]:
            decoder = AvifImagePlugin.AvifImageFile
        if decoder is None and head[4:12] in (b"ftypheic", b"ftypheix", b"ftypmif1", b"ftyphevc"):
            decoder = _heic_decoder(path)
        if remedy := unread_remedy(path):
            raise InputError(path, f"{path.suffix} images are not read", remedy=remedy)
        if decoder is None:
            raise ValueError("it is not an image of a known kind")
        with decoder(file) as image:
            if image.format == "JPEG" and image.width * image.height > MAX_PIXELS:
                image.draft(None, (image.width // 2, image.height // 2))
            if image.width * image.height > MAX_PIXELS:
                problem = f"the image has {image.width}x{image.height} pixels"
                remedy = "Shrink it, for instance to half its width and height."
                raise InputError(path, problem, f"at most {MAX_PIXELS // 10**6} million", remedy)
            yield image


def unread_remedy(path: Path) -> str:
    """Says how to convert an image that is named like one of a format that is not read; "" for any other file."""
    if _UNREAD.fullmatch(path.name) is None:
        return ""
    return f"Convert it to JPEG or PNG, for example: magick mogrify -format jpg '{path.parent}/*{path.suffix}'"


def _heic_decoder(path: Path) -> type[ImageFile]:
    """Pillow's decoder of HEIC photographs, from the extra formats."""
    try:
        from pillow_heif import HeifImageFile
    except ImportError as error:
        remedy = "Run: pip install 'jsecon[formats]' (or export the photographs as JPEG)."
        raise InputError(path, "a HEIC photograph needs pillow-heif, which is not installed", remedy=remedy) from error
    return HeifImageFile


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


def apply_orientation(image: np.ndarray, orientation: int) -> np.ndarray:
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
            with PngImagePlugin.PngImageFile(path) as copy:
                copy.verify()  # compares the checksums, and leaves an image that cannot be decoded
        orientation = _orientation(image)
        image.load()
        is_kept = native or image.mode in ("L", "I;16", "I;16B", "I", "F")
        mode = image.mode if is_kept else "RGB"
        if image.has_transparency_data and not native:
            mode = "RGBA"
        pixels = np.asarray(image if mode == image.mode else image.convert(mode))
        pixels = pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
        return apply_orientation(pixels, orientation) if upright else pixels, image


def find_image(folder: Path, name: str) -> Path | None:
    """Finds the image file that a capture names, relative to `folder`.

    Tried are the name itself, with backslashes as separators (of a Windows program), with its suffix in upper or lower
    case, and, if it has no suffix of an image, with one added.
    """
    for base in dict.fromkeys((name, name.replace("\\", "/"))):
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


def image_header(path: str | Path) -> _ImageHeader:
    """Reads size, orientation and kind of an image file, from its header alone."""
    with _open(Path(path)) as image:
        orientation = _orientation(image)
        width, height = image.size
        upright = (height, width) if orientation > 4 else (width, height)
        return _ImageHeader((width, height), upright, orientation, image.mode)


def size_around(path: Path, cx: object, cy: object) -> tuple[int, int]:
    """Reads (width, height), px, of an image, stored or upright: of which a principal point lies nearer to the middle.

    It is the upright size if the point is not known, that is not of numbers.
    """
    header = image_header(path)
    if not isinstance(cx, int | float) or not isinstance(cy, int | float):
        return header.upright
    return min(header.upright, header.stored, key=lambda size: abs(2 * cx - size[0]) + abs(2 * cy - size[1]))


def read_pixels(path: Path, *, upright: bool = True) -> np.ndarray:
    """Reads an image file without a conversion of its values: grey (H, W), RGB or RGBA (H, W, C)."""
    return _decode(path, upright=upright)[0]


def read_image(path: str | Path, *, upright: bool = True) -> tuple[UInt8[np.ndarray, "h w 3"], bool]:
    """Reads an image file as RGB of 8 bits, and whether it had transparent pixels.

    Transparent pixels are blended with black, as in a render without background. A JPEG of more than MAX_PIXELS is
    decoded at half its size. `upright=False` returns the stored pixels.
    """
    path = Path(path)
    image = read_pixels(path, upright=upright)
    if image.dtype == np.uint16:
        image = cv2.convertScaleAbs(image, alpha=255 / 65535)  # rounds to nearest
    if image.dtype != np.uint8:
        problem = f"its pixels are of type {image.dtype}"
        raise InputError(path, problem, "8 or 16 bits a channel", "Convert it to PNG or JPEG.")
    if image.ndim == 2:
        return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), False
    rgb, alpha = image[..., :3], image[..., 3:]
    if (alpha == 255).all():
        return np.ascontiguousarray(rgb), False
    return ((rgb.astype(np.uint16) * alpha + 127) // 255).astype(np.uint8), True


def write_image(path: str | Path, image: UInt8[np.ndarray, "h w 3"] | UInt[np.ndarray, "h w"]) -> None:
    """Writes RGB, or grey values of 8 or 16 bits, atomically; the suffix chooses the format."""
    path, image = Path(path), np.asarray(image)
    if not cv2.haveImageWriter(path.name):
        raise InputError(path, f"no image format has the suffix {path.suffix!r}", remedy="Use .png or .jpg.")
    _, data = cv2.imencode(path.suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image)
    with atomic_write(path) as temporary:
        temporary.write_bytes(data.tobytes())


def encode_jpeg(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, " b"]:
    """Encodes RGB as a JPEG of quality 90."""
    return cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 90])[1].ravel()


def decode_jpeg(data: UInt8[np.ndarray, " b"]) -> UInt8[np.ndarray, "h w 3"]:
    """Decodes what `encode_jpeg` encoded; ValueError if it is damaged."""
    image = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    if image is None:
        raise ValueError("a picture is no JPEG")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def read_label_image(path: str | Path) -> Int[np.ndarray, "h w"]:
    """Reads the ids of a label image (.png or .npy).

    A grey PNG of 1 to 16 bits has its values as ids; a palette PNG the indices into it, never its colours; an RGB PNG
    of 8 bits R*65536 + G*256 + B. A
    .npy has whole numbers or booleans (H, W), negative where there is no label.
    """
    path = Path(path)
    if path.suffix.lower() == ".npy":
        return _read_id_array(path)
    expected = "ids as grey values (8 or 16 bits), palette indices or 8 bit colours"
    remedy = "Write one id per pixel as an 8 or 16 bit grey PNG, or as integers in a .npy."
    image, decoder = _decode(path, native=True)
    if decoder.format != "PNG":
        raise InputError(path, "the mask is not a PNG", expected, remedy)
    bits = path.read_bytes()[24]
    if image.ndim == 2:
        ids = image.astype(np.int32)
        is_stretched = decoder.mode == "L"  # Pillow stretches 2 and 4 bits
        return ids // (255 // (2**bits - 1)) if is_stretched else ids
    if bits > 8:
        raise InputError(path, f"the mask has {bits} bits in each of its channels", expected, remedy)
    if image.shape[2] != 3:
        raise InputError(path, "the mask has a channel of transparency", expected, remedy)
    return image.astype(np.int32) @ np.array([65536, 256, 1], np.int32)


def _read_id_array(path: Path) -> Int[np.ndarray, "h w"]:
    """Reads the ids of a .npy."""
    expected, remedy = "whole numbers of shape (H, W)", "Write one array of ids for each frame."
    with reading(path, expected, remedy, problem="the array cannot be read"):
        image = map_npy(path)
    image = np.asarray(image)
    if image.ndim != 2 or not image.size:
        raise InputError(path, f"the array has shape {image.shape}", expected, remedy)
    with np.errstate(invalid="ignore"):
        ids = image.astype(np.int64)
    if (ids != image).any():
        raise InputError(path, "the array has numbers that are not ids", expected, remedy)
    return ids


def read_depth(path: str | Path, unit: float) -> Float[np.ndarray, "h w"]:
    """Reads a depth map, float32 z-depth in world units, 0 = unknown, of a 16 bit PNG or a .npy of shape (H, W).

    `unit` is that of one count in world units (nerfstudio: 0.001, from millimetres).
    """
    path = Path(path)
    expected = "one channel of 16 bits (PNG), or a .npy of shape (H, W)"
    remedy = "Write the depth in millimetres as a 16 bit PNG."
    if path.suffix.lower() == ".npy":
        with reading(path, expected, remedy, problem="the depth map cannot be read"):
            depth = map_npy(path)
        depth = depth[..., 0] if depth.ndim == 3 and depth.shape[2] == 1 else depth
        is_depth = depth.ndim == 2 and depth.size > 0
    else:
        depth = read_pixels(path)
        is_depth = depth.ndim == 2 and depth.dtype == np.uint16
        depth = np.where(depth == 65535, depth.dtype.type(0), depth)  # RGB-D cameras write it where they see nothing
    if not is_depth:
        raise InputError(path, f"the depth map has shape {depth.shape} of {depth.dtype}", expected, remedy)
    with np.errstate(over="ignore", invalid="ignore"):  # infinite: unknown
        depth = depth.astype(np.float32) * np.float32(unit)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
