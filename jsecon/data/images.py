"""Image files: RGB frames, integer label images, depth maps.

Pillow reads them, and refuses files that are cut short. OpenCV reads TIFF, of which Pillow warns and libtiff writes to
the standard error; and writes all: after `import pycolmap`, Pillow ends the process where it saves a PNG.

Images come upright, as their EXIF orientation asks. Poses may belong to the stored pixels instead: the readers of
captures decide that (jsecon.data.frames), and read those with `upright=False`.
"""

import io
import os
import struct
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image
from PIL.BmpImagePlugin import BmpImageFile
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.WebPImagePlugin import WebPImageFile

from jsecon.errors import InputError, describe_error
from jsecon.files import READ_ERRORS, atomic_write, map_npy

_ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".heic", ".heif")
IMAGE_SUFFIXES = (*_ENDINGS, *(ending.upper() for ending in _ENDINGS))
"""endings tried, in this order, where a capture names an image without one"""
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8"
_TIFF = (b"II*\0", b"MM\0*")
_HEIC = (b"ftypheic", b"ftypheix", b"ftypmif1", b"ftyphevc")
_EXIF = b"Exif\0\0"
_HIDDEN = b"unread"
"""in place of _EXIF: Pillow warns of damaged EXIF when it opens a JPEG"""
ID_REMEDY = "Write one id per pixel as an 8 or 16 bit grey PNG without transparency, or as integers in a .npy."
_PIXELS = (b"IDAT", b"IHDR", b"PLTE", b"tRNS")
"""the chunks of a PNG that make its pixels; Pillow refuses a file for a long text or a damaged colour profile"""
_MODES = {"1": "L", "L": "L"} | dict.fromkeys(("RGBA", "PA", "LA", "La", "RGBa"), "RGBA")
"""Pillow's mode of a file -> that of its pixels here; others become RGB"""
_NUMBERS = ("I;16", "I;16B", "I", "F")
"""modes of more than 8 bits, which are kept"""
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""of a PNG, by its colour type"""
MAX_PIXELS = 1 << 27
"""of an image: 134 million"""
_SHRINKS = (1, 2, 4, 8)
"""by which a JPEG can be shrunk while it is decoded"""
_ORIENTATION = 0x0112
"""EXIF's tag; 1 is upright, 6 the commonest of a phone held upright: turn clockwise by 90 degrees"""
TRANSPOSED = (5, 6, 7, 8)
"""the orientations that swap width and height"""


def _unreadable(path: Path, problem: str) -> InputError:
    return InputError(path, problem, "a whole image", "Copy or export the file again.")


def _read_bytes(path: Path) -> bytes:
    try:
        data = path.read_bytes()
    except (OSError, ValueError) as error:  # a name with a zero byte is a ValueError
        raise _unreadable(path, getattr(error, "strerror", None) or str(error)) from error
    if not data:
        raise _unreadable(path, "the file is empty")
    return data


def _png(chunks: Iterable[tuple[bytes, bytes]]) -> bytes:
    """A PNG of these chunks."""
    parts = (struct.pack(">I", len(b)) + k + b + struct.pack(">I", zlib.crc32(b, zlib.crc32(k))) for k, b in chunks)
    return _PNG + b"".join(parts) + b"\0\0\0\0IEND\xaeB`\x82"


def _png_chunks(path: Path, data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """(type, body) of each chunk, checked: Pillow does not compare the checksums of pixels."""
    offset = len(_PNG)
    while True:
        kind = data[offset + 4 : offset + 8]
        end = offset + 8 + int.from_bytes(data[offset : offset + 4])
        if end + 4 > len(data):
            raise _unreadable(path, f"the PNG breaks off after {len(data)} bytes")
        if zlib.crc32(data[offset + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            raise _unreadable(path, f"chunk {kind.decode('latin1')} at byte {offset} of the PNG fails its checksum")
        if (kind == b"IHDR") != (offset == len(_PNG)):
            raise _unreadable(path, "the PNG has no header, or two")
        yield kind, data[offset + 8 : end]
        if kind == b"IEND":
            return
        offset = end + 4


def _opened(path: Path, data: bytes) -> tuple[Image.Image, int]:
    """The image of a file's bytes, of which only the header is read (but of a TIFF), and its EXIF orientation, 1 to 8.

    A HEIC has 1: its decoder applies the file's own rotation, and EXIF's does not count there.
    """
    block = b""
    try:
        if data.startswith(_PNG):
            chunks = list(_png_chunks(path, data))
            image = PngImageFile(io.BytesIO(_png(chunk for chunk in chunks if chunk[0] in _PIXELS)))
            block = next((body for kind, body in chunks if kind == b"eXIf"), b"")
        elif data.startswith(_JPEG):
            image = JpegImageFile(io.BytesIO(data.replace(_EXIF, _HIDDEN)))
            block = next((body for _, body in image.applist if body.startswith(_HIDDEN)), b"").removeprefix(_HIDDEN)
        elif data[4:12] in _HEIC:
            image = _heic_class(path)(io.BytesIO(data))
        elif data.startswith(b"RIFF"):
            image = WebPImageFile(io.BytesIO(data))
            block = image.info.get("exif", b"").removeprefix(_EXIF)
        elif data.startswith(b"BM"):
            image = BmpImageFile(io.BytesIO(data))
        else:
            image = _tiff(data)
            block = data[: 1 << 16]
    except InputError:
        raise
    except Exception as error:  # Pillow's own kinds have no common base but this
        raise _unreadable(path, f"its {len(data)} bytes are no image ({describe_error(error)})") from error
    shrink = _shrink(*image.size) if isinstance(image, JpegImageFile) else 1
    width, height = (-(-side // shrink) for side in image.size)
    if width * height > MAX_PIXELS:
        problem = f"the image has {width}x{height} pixels ({width * height / 1e6:.0f} million)"
        remedy = "Shrink it, for instance to half its width and height."
        raise InputError(path, problem, f"at most {MAX_PIXELS // 10**6} million", remedy)
    return image, _orientation(block)


def _tiff(data: bytes) -> Image.Image:
    """A TIFF, upright."""
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if data[:4] not in _TIFF or pixels is None:
        raise ValueError("it is of another kind, or damaged")
    if pixels.ndim == 2:
        return Image.fromarray(pixels)
    if pixels.dtype == np.uint16:
        pixels = cv2.convertScaleAbs(pixels, alpha=255 / 65535)
    return Image.fromarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB if pixels.shape[2] == 3 else cv2.COLOR_BGRA2RGBA))


def _heic_class(path: Path) -> type[ImageFile]:
    try:
        from pillow_heif import HeifImageFile
    except ImportError as error:
        remedy = "Run: pip install 'jsecon[formats]' (or export the photographs as JPEG)."
        found = "a HEIC photograph cannot be read without pillow-heif"
        raise InputError(path, found, "it installed", remedy) from error
    return HeifImageFile


def _shrink(width: int, height: int) -> int:
    """The least number by which a JPEG is shrunk on decoding so that MAX_PIXELS hold it, else 1."""
    return next((n for n in _SHRINKS if -(-width // n) * -(-height // n) <= MAX_PIXELS), 1)


def _orientation(block: bytes) -> int:
    """The orientation, 1 to 8, of an EXIF block, which is a TIFF; 1 where it has none."""
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(block[:4])
    if order is None or len(block) < 8:
        return 1
    (start,) = struct.unpack_from(f"{order}I", block, 4)
    count = struct.unpack_from(f"{order}H", block, start)[0] if start + 2 <= len(block) else 0
    for entry in range(start + 2, min(start + 2 + 12 * count, len(block) - 11), 12):
        tag, kind, values, value = struct.unpack_from(f"{order}HHIH", block, entry)
        if (tag, kind, values) == (_ORIENTATION, 3, 1):  # one 16-bit integer
            return value if 1 <= value <= 8 else 1
    return 1


def apply_orientation(image: np.ndarray, orientation: int) -> np.ndarray:
    """The upright image (H, W, ...) of stored pixels with this EXIF orientation."""
    if orientation in TRANSPOSED:
        image = image.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    return np.ascontiguousarray(image)


def _decoded(path: Path, image: Image.Image, *, native: bool = False) -> np.ndarray:
    """Pixels: grey, RGB or RGBA, of TIFF and HEIC upright. Of 16 bits of colour, Pillow has the upper 8.

    `native`: the indices of a palette, and colours that are declared transparent.
    """
    try:
        if isinstance(image, JpegImageFile) and (shrink := _shrink(*image.size)) > 1:
            image.draft(None, (image.width // shrink, image.height // shrink))
        image.load()
        mode = image.mode if native or image.mode in _NUMBERS else _MODES.get(image.mode, "RGB")
        if mode in ("L", "RGB") and "transparency" in image.info and not native:
            mode = "RGBA"
        pixels = np.asarray(image if mode == image.mode else image.convert(mode))
        return pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
    except Exception as error:  # Pillow's own kinds have no common base but this
        raise _unreadable(path, f"the image cannot be decoded ({describe_error(error)})") from error


def find_image(folder: Path, name: str) -> Path | None:
    """Returns the image file that a capture names, or None.

    Tried are the name itself, with "\\" as a separator (where a Windows program wrote it), with its ending in upper or
    lower case, and, where it has none of an image, with an ending added.
    """
    for base in dict.fromkeys((name, name.replace("\\", "/"))):
        stem, ending = os.path.splitext(base)
        added = () if ending.lower() in IMAGE_SUFFIXES else IMAGE_SUFFIXES  # a.jpg.png is a mask of a.jpg
        for candidate in (base, stem + ending.lower(), stem + ending.upper(), *(base + end for end in added)):
            if os.path.isfile(folder / candidate):  # False also for a name that no file can have
                return folder / candidate
    return None


class ImageHeader(NamedTuple):
    """What an image file says of its size."""

    stored: tuple[int, int]
    """(width, height) px of the stored pixels."""
    orientation: int
    """EXIF's, 1 to 8."""

    @property
    def upright(self) -> tuple[int, int]:
        """(width, height) px once the orientation is applied."""
        width, height = self.stored
        return (height, width) if self.orientation in TRANSPOSED else (width, height)

    def about(self, cx: object, cy: object) -> tuple[int, int]:
        """`upright`, unless a principal point (px) lies nearer to the middle of the stored pixels."""
        if not all(isinstance(value, int | float) for value in (cx, cy)):
            return self.upright
        away = lambda size: abs(2 * cx - size[0]) + abs(2 * cy - size[1])  # type: ignore[operator]
        return min(self.upright, self.stored, key=away)


def image_header(path: str | Path) -> ImageHeader:
    """Reads the size and the orientation of an image file, not its pixels.

    Args:
      path: An image file.

    Raises:
      InputError: The file is missing, empty, too large, or no image.
    """
    path = Path(path)
    data = _read_bytes(path)
    image, orientation = _opened(path, data)
    width, height = image.size
    if data[:4] in _TIFF and orientation in TRANSPOSED:
        width, height = height, width
    shrink = _shrink(width, height) if isinstance(image, JpegImageFile) else 1
    return ImageHeader((-(-width // shrink), -(-height // shrink)), orientation)


def image_size(path: str | Path) -> tuple[int, int]:
    """(width, height) in pixels of an image file as it is read, upright. Raises InputError as `image_header` does."""
    return image_header(path).upright


def read_pixels(path: Path, *, upright: bool = True) -> np.ndarray:
    """Reads the values of an image file as they are stored.

    Args:
      path: An image file.
      upright: Apply the EXIF orientation; False has the stored pixels.

    Returns:
      Grey (H, W), RGB or RGBA (H, W, C).

    Raises:
      InputError: The file is missing, damaged, too large, or no image.
    """
    data = _read_bytes(path)
    image, orientation = _opened(path, data)
    pixels = _decoded(path, image)
    if orientation == 1 or (data[:4] in _TIFF) == upright:
        return pixels
    return apply_orientation(pixels, orientation if upright else {6: 8, 8: 6}.get(orientation, orientation))


def read_image(path: str | Path, *, upright: bool = True) -> tuple[UInt8[np.ndarray, "h w 3"], bool]:
    """RGB, and whether any pixel was transparent: such pixels are laid over black, as in a render of nothing.

    Grey becomes RGB, 16 bits become 8. A JPEG of more than MAX_PIXELS is read at a half, a quarter or an eighth of its
    size.

    Args:
      path: An image file.
      upright: Apply the EXIF orientation, as every viewer does; False has the stored pixels.

    Raises:
      InputError: The file is missing, empty, cut short, too large, or no image.
    """
    path = Path(path)
    image = read_pixels(path, upright=upright)
    if image.dtype == np.uint16:
        image = cv2.convertScaleAbs(image, alpha=255 / 65535)  # rounded to the nearest
    if image.dtype != np.uint8:
        problem = f"its pixels are of type {image.dtype}"
        raise InputError(path, problem, "8 or 16 bits a channel", "Convert it to PNG or JPEG.")
    if image.ndim == 2:
        return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), False
    rgb, alpha = image[..., :3], image[..., 3:]
    if (alpha == 255).all():
        return np.ascontiguousarray(rgb), False
    return ((rgb.astype(np.uint16) * alpha + 127) // 255).astype(np.uint8), True


def write_image(path: str | Path, image: UInt8[np.ndarray, "h w 3"]) -> None:
    """Writes RGB to `path`, whole or not at all; its ending says the format."""
    path = Path(path)
    bgr = cv2.cvtColor(np.asarray(image), cv2.COLOR_RGB2BGR)
    try:
        done, data = cv2.imencode(path.suffix, bgr)
    except cv2.error:
        done = False
    if not done:
        raise InputError(path, f"no image format has the ending {path.suffix!r}", ".png or .jpg", "Choose another.")
    with atomic_write(path) as temporary:
        temporary.write_bytes(data.tobytes())


def read_label_image(path: str | Path) -> tuple[Int[np.ndarray, "h w"], bool]:
    """A label image as integers (H, W), and whether they are colours.

    PNG: grey of 1 to 16 bits has its values; a palette the indices into it, never its colours; RGB of 8 bits
    R*65536 + G*256 + B, with True beside it. Pixels that are wholly transparent are 0; where all colours are black, the
    mask is what is opaque. .npy: whole numbers or booleans (H, W), negative = none.

    Raises:
      InputError: The file is none of these, or damaged.
    """
    path = Path(path)
    if path.suffix.lower() == ".npy":
        return _read_id_array(path), False
    data = _read_bytes(path)
    expected = "ids as grey values (8 or 16 bits), palette indices or 8 bit colours"
    if not data.startswith(_PNG):
        raise InputError(path, "the mask is no PNG", expected, ID_REMEDY)
    opened, orientation = _opened(path, data)
    bits, colour_type = data[24], data[25]
    image = apply_orientation(_decoded(path, opened, native=True), orientation)
    if colour_type in (0, 3):
        ids = image.astype(np.int32)
        return ids // (255 // (2**bits - 1)) if opened.mode == "L" else ids, False  # Pillow stretches 2 and 4 bits
    if bits > 8 or image.ndim != 3:
        raise InputError(
            path, f"the mask has {bits} bits in each of {_CHANNELS[colour_type]} channels", expected, ID_REMEDY
        )
    grey = colour_type == 4
    colours = image.astype(np.int32)
    ids = colours[..., 0] if grey else colours[..., :3] @ np.array([65536, 256, 1], np.int32)
    if image.shape[2] in (2, 4):
        alpha = image[..., -1]
        opaque = alpha == 255
        if not (opaque | (alpha == 0)).all():
            raise InputError(path, "the mask has pixels that are half transparent (4 channels)", expected, ID_REMEDY)
        ids = np.where(opaque, ids, 0) if ids.any() else opaque.astype(np.int32)
    return ids, not grey


def _read_id_array(path: Path) -> np.ndarray:
    """The ids (H, W) int64 of a .npy."""
    expected = "whole numbers of shape (H, W)"
    try:
        image = map_npy(path)
    except READ_ERRORS as error:
        raise InputError(
            path, f"the array cannot be read: {describe_error(error)}", expected, "Write the mask again."
        ) from error
    image = np.asarray(image.squeeze() if image.ndim == 3 and 1 in (image.shape[0], image.shape[2]) else image)
    if image.ndim == 3:
        remedy = "Give such stacks with --proposals, or write one image of ids for each frame."
        raise InputError(path, f"the array is a stack of shape {image.shape}", expected, remedy)
    if image.ndim != 2 or not image.size:
        raise InputError(path, f"the array has shape {image.shape}", expected, "Write the mask again.")
    with np.errstate(invalid="ignore"):
        whole = image.dtype.kind in "biu" or bool((image == np.floor(image)).all())
        whole = whole and bool((image < 1 << 62).all() and (image > -(1 << 62)).all())
    if not whole:
        raise InputError(path, "the array holds numbers that are no ids", expected, "Write the mask again.")
    return image.astype(np.int64)


def read_depth(path: str | Path, unit: float) -> Float[np.ndarray, "h w"]:
    """A depth map times `unit` (nerfstudio: 0.001, from millimetres), float32, 0 = unknown. A PNG of 16 bits, or .npy.

    Raises InputError where the file is damaged or of another kind.
    """
    path = Path(path)
    expected = "one channel of 16 bits (PNG), or a .npy of shape (H, W)"
    remedy = "Write the depth in millimetres as a 16 bit PNG."
    if path.suffix.lower() == ".npy":
        try:
            depth = map_npy(path)
        except READ_ERRORS as error:
            raise InputError(
                path, f"the depth map cannot be read: {describe_error(error)}", expected, remedy
            ) from error
        depth = depth[..., 0] if depth.ndim == 3 and depth.shape[2] == 1 else depth
        if depth.ndim != 2 or not depth.size:
            raise InputError(path, f"the depth map has shape {depth.shape}", expected, remedy)
    else:
        depth = read_pixels(path)
        if depth.dtype != np.uint16 or depth.ndim != 2:
            raise InputError(path, f"the depth map has shape {depth.shape} of {depth.dtype}", expected, remedy)
    with np.errstate(over="ignore", invalid="ignore"):  # infinite is unknown
        depth = depth.astype(np.float32) * np.float32(unit)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
