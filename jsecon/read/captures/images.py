"""Image files on the host: RGB frames, label images of integers, depth maps.

Pillow decodes them and raises on truncated files. OpenCV decodes TIFF, of which Pillow warns and libtiff writes to the
standard error, and encodes: after `import pycolmap`, Pillow ends the process when it saves a PNG.

Images are returned upright, as their EXIF orientation asks. If poses belong to the stored pixels
(`jsecon.read.captures.frames` decides that), images are read with `upright=False`.
"""

import io
import os
import struct
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt, UInt8
from PIL import Image
from PIL.BmpImagePlugin import BmpImageFile
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.WebPImagePlugin import WebPImageFile

from jsecon.errors import InputError, describe_error
from jsecon.files import atomic_write, map_npy, reading

_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".heic", ".heif")
IMAGE_SUFFIXES = (*_SUFFIXES, *(suffix.upper() for suffix in _SUFFIXES))
"""suffixes tried, in this order, if a capture names an image without one"""
MAX_PIXELS = 1 << 27
"""pixels of an image: 134 million"""
TRANSPOSED = (5, 6, 7, 8)
"""EXIF orientations that swap width and height"""
ID_REMEDY = "Write one id per pixel as an 8 or 16 bit grey PNG without transparency, or as integers in a .npy."
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8"
_TIFF = (b"II*\0", b"MM\0*")
_HEIC = (b"ftypheic", b"ftypheix", b"ftypmif1", b"ftyphevc")
_EXIF, _HIDDEN_EXIF = b"Exif\0\0", b"unread"
"""Start of an EXIF block, and what replaces it in a JPEG: Pillow warns of damaged EXIF when it opens one."""
_ORIENTATION = 0x0112
"""EXIF tag: 1 is upright; 6, the commonest of a phone held upright, asks for a turn clockwise by 90 degrees"""
_MODES = {"1": "L", "L": "L"} | dict.fromkeys(("RGBA", "PA", "LA", "La", "RGBa"), "RGBA")
"""Pillow's mode of a file -> mode of the returned pixels; other modes become RGB"""
_DEEP_MODES = ("I;16", "I;16B", "I", "F")
"""Pillow's modes of more than 8 bits, which are kept"""
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""PNG colour type -> channels"""


def _unreadable(path: Path, problem: str) -> InputError:
    """The error of a file that is not a complete image."""
    return InputError(path, problem, remedy="Copy or export the file again.")


def _read_bytes(path: Path) -> bytes:
    """Reads a file that must not be empty."""
    try:
        data = path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a name with a zero byte
        raise _unreadable(path, describe_error(error)) from error
    if not data:
        raise _unreadable(path, "the file is empty")
    return data


def _open(path: Path, data: bytes, *, check: bool = False) -> tuple[Image.Image, int]:
    """Opens an image, with its EXIF orientation; `check` also compares the checksums of a PNG.

    The orientation of a HEIC is 1: its decoder applies the file's own rotation.
    """
    exif = b""
    try:
        if data.startswith(_PNG):
            if check:
                PngImageFile(io.BytesIO(data)).verify()
            image = PngImageFile(io.BytesIO(data))
            exif = image.info.get("exif", b"").removeprefix(_EXIF)
        elif data.startswith(_JPEG):
            image = JpegImageFile(io.BytesIO(data.replace(_EXIF, _HIDDEN_EXIF)))
            blocks = [body for _, body in image.applist if body.startswith(_HIDDEN_EXIF)]
            exif = blocks[0].removeprefix(_HIDDEN_EXIF) if blocks else b""
        elif data[4:12] in _HEIC:
            image = _heic_class(path)(io.BytesIO(data))
        elif data.startswith(b"RIFF"):
            image = WebPImageFile(io.BytesIO(data))
            exif = image.info.get("exif", b"").removeprefix(_EXIF)
        elif data.startswith(b"BM"):
            image = BmpImageFile(io.BytesIO(data))
        else:
            image = _decode_tiff(data)
            exif = data[: 1 << 16]
    except InputError:
        raise
    except Exception as error:  # Pillow's errors have no other common base
        raise _unreadable(path, f"the image is damaged or of an unknown kind ({describe_error(error)})") from error
    shrink = _decoder_shrink(image)
    width, height = (-(-side // shrink) for side in image.size)
    if width * height > MAX_PIXELS:
        problem = f"the image has {width}x{height} pixels ({width * height / 1e6:.0f} million)"
        remedy = "Shrink it, for instance to half its width and height."
        raise InputError(path, problem, f"at most {MAX_PIXELS // 10**6} million", remedy)
    return image, _orientation(exif)


def _decode_tiff(data: bytes) -> Image.Image:
    """Decodes a TIFF, upright."""
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if data[:4] not in _TIFF or pixels is None:
        raise ValueError("it is not a TIFF that can be read")
    if pixels.ndim == 2:
        return Image.fromarray(pixels)
    if pixels.dtype == np.uint16:
        pixels = cv2.convertScaleAbs(pixels, alpha=255 / 65535)
    return Image.fromarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB if pixels.shape[2] == 3 else cv2.COLOR_BGRA2RGBA))


def _heic_class(path: Path) -> type[ImageFile]:
    """Pillow's reader of HEIC photographs, from the extra formats."""
    try:
        from pillow_heif import HeifImageFile
    except ImportError as error:
        remedy = "Run: pip install 'jsecon[formats]' (or export the photographs as JPEG)."
        raise InputError(path, "a HEIC photograph needs pillow-heif, which is not installed", remedy=remedy) from error
    return HeifImageFile


def _decoder_shrink(image: Image.Image) -> int:
    """The least factor, of those that a JPEG decoder can shrink by, that brings a JPEG to MAX_PIXELS; else 1."""
    factors = (1, 2, 4, 8) if isinstance(image, JpegImageFile) else ()
    return next((n for n in factors if -(-image.width // n) * -(-image.height // n) <= MAX_PIXELS), 1)


def _orientation(exif: bytes) -> int:
    """The orientation, 1 to 8, of an EXIF block, which is a TIFF; 1 if it has none."""
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(exif[:4])
    if order is None or len(exif) < 8:
        return 1
    (start,) = struct.unpack_from(f"{order}I", exif, 4)
    count = struct.unpack_from(f"{order}H", exif, start)[0] if start + 2 <= len(exif) else 0
    for entry in range(start + 2, min(start + 2 + 12 * count, len(exif) - 11), 12):
        tag, kind, values, value = struct.unpack_from(f"{order}HHIH", exif, entry)
        if (tag, kind, values) == (_ORIENTATION, 3, 1):  # one 16-bit integer
            return value if 1 <= value <= 8 else 1
    return 1


def apply_orientation(image: np.ndarray, orientation: int) -> np.ndarray:
    """Turns stored pixels upright.

    Args:
      image: (H, W, ...) stored pixels.
      orientation: Their EXIF orientation, 1 to 8.

    Returns:
      The upright image, contiguous.
    """
    if orientation in TRANSPOSED:
        image = image.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    return np.ascontiguousarray(image)


def _decode(path: Path, image: Image.Image, *, native: bool = False) -> np.ndarray:
    """Decodes to grey, RGB or RGBA, upright for TIFF and HEIC; 16 bits of colour become 8.

    `native` keeps the indices of a palette, and colours that are declared transparent.
    """
    try:
        shrink = _decoder_shrink(image)
        if isinstance(image, JpegImageFile) and shrink > 1:
            image.draft(None, (image.width // shrink, image.height // shrink))
        image.load()
        mode = image.mode if native or image.mode in _DEEP_MODES else _MODES.get(image.mode, "RGB")
        if mode in ("L", "RGB") and "transparency" in image.info and not native:
            mode = "RGBA"
        pixels = np.asarray(image if mode == image.mode else image.convert(mode))
        return pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
    except Exception as error:  # Pillow's errors have no other common base
        raise _unreadable(path, f"the image cannot be decoded ({describe_error(error)})") from error


def find_image(folder: Path, name: str) -> Path | None:
    """Finds the image file that a capture names.

    Tried are the name itself, with backslashes as separators (of a Windows program), with its suffix in upper or lower
    case, and, if it has no suffix of an image, with one added.

    Args:
      folder: Folder that the name is relative to.
      name: The name in the capture.

    Returns:
      The file, or None.
    """
    for base in dict.fromkeys((name, name.replace("\\", "/"))):
        stem, suffix = os.path.splitext(base)
        added = () if suffix.lower() in IMAGE_SUFFIXES else IMAGE_SUFFIXES  # a.jpg.png is a mask of a.jpg
        for candidate in (base, stem + suffix.lower(), stem + suffix.upper(), *(base + end for end in added)):
            if os.path.isfile(folder / candidate):  # False also for a name that no file can have
                return folder / candidate
    return None


class ImageHeader(NamedTuple):
    """Size and orientation of an image file."""

    stored: tuple[int, int]
    """(width, height) of the stored pixels, px."""
    orientation: int
    """EXIF's, 1 to 8."""

    @property
    def upright(self) -> tuple[int, int]:
        """(width, height) once the orientation is applied, px."""
        width, height = self.stored
        return (height, width) if self.orientation in TRANSPOSED else (width, height)

    def closest_to_centre(self, cx: object, cy: object) -> tuple[int, int]:
        """Chooses the size, stored or upright, that a principal point fits better.

        Args:
          cx: Its x, px; anything but a number means that it is not known.
          cy: Its y, px.

        Returns:
          (width, height), px: the one whose middle is nearer to the point; the upright size if that is not known.
        """
        if not isinstance(cx, int | float) or not isinstance(cy, int | float):
            return self.upright
        return min(self.upright, self.stored, key=lambda size: abs(2 * cx - size[0]) + abs(2 * cy - size[1]))


def image_header(path: str | Path) -> ImageHeader:
    """Reads size and orientation of an image file; decodes no pixels unless it is a TIFF.

    Args:
      path: An image file.

    Returns:
      Its header.

    Raises:
      InputError: The file is missing, empty, too large, or not an image.
    """
    data = _read_bytes(Path(path))
    image, orientation = _open(Path(path), data)
    width, height = image.size
    if data[:4] in _TIFF and orientation in TRANSPOSED:
        width, height = height, width
    shrink = _decoder_shrink(image)
    return ImageHeader((-(-width // shrink), -(-height // shrink)), orientation)


def read_pixels(path: Path, *, upright: bool = True) -> np.ndarray:
    """Reads an image file without a conversion of its values.

    Args:
      path: An image file.
      upright: Apply the EXIF orientation; False returns the stored pixels.

    Returns:
      Grey (H, W), RGB or RGBA (H, W, C).

    Raises:
      InputError: The file is missing, damaged, too large, or not an image.
    """
    data = _read_bytes(path)
    image, orientation = _open(path, data, check=True)
    pixels = _decode(path, image)
    if orientation == 1 or (data[:4] in _TIFF) == upright:
        return pixels
    return apply_orientation(pixels, orientation if upright else {6: 8, 8: 6}.get(orientation, orientation))


def read_image(path: str | Path, *, upright: bool = True) -> tuple[UInt8[np.ndarray, "h w 3"], bool]:
    """Reads an image file as RGB of 8 bits.

    Transparent pixels are blended with black, as in a render without background. A JPEG of more than MAX_PIXELS is
    decoded at a half, a quarter or an eighth of its size.

    Args:
      path: An image file.
      upright: Apply the EXIF orientation, as viewers do; False returns the stored pixels.

    Returns:
      The image, and whether it had transparent pixels.

    Raises:
      InputError: The file is missing, damaged, too large, or not an image.
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
    """Writes an image atomically.

    Args:
      path: The file; its suffix chooses the format.
      image: (H, W, 3) uint8 RGB, or (H, W) grey values of 8 or 16 bits.

    Raises:
      InputError: The suffix is not that of an image format, or the folder cannot be written.
    """
    path, image = Path(path), np.asarray(image)
    try:
        encoded, data = cv2.imencode(path.suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image)
    except cv2.error:
        encoded = False
    if not encoded:
        raise InputError(path, f"no image format has the suffix {path.suffix!r}", remedy="Use .png or .jpg.")
    with atomic_write(path) as temporary:
        temporary.write_bytes(data.tobytes())


def read_label_image(path: str | Path) -> tuple[Int[np.ndarray, "h w"], bool]:
    """Reads a label image as integers.

    A grey PNG of 1 to 16 bits has its values as ids; a palette PNG the indices into it, never its colours; an RGB PNG
    of 8 bits R*65536 + G*256 + B. Fully transparent pixels are 0; if all colours are black, the opaque pixels are the
    mask. A .npy has whole numbers or booleans (H, W), negative where there is no label.

    Args:
      path: A .png or .npy file.

    Returns:
      (H, W) ids, and whether they are colours.

    Raises:
      InputError: The file is of another kind, or damaged.
    """
    path = Path(path)
    if path.suffix.lower() == ".npy":
        return _read_id_array(path), False
    data = _read_bytes(path)
    expected = "ids as grey values (8 or 16 bits), palette indices or 8 bit colours"
    if not data.startswith(_PNG):
        raise InputError(path, "the mask is not a PNG", expected, ID_REMEDY)
    opened, orientation = _open(path, data, check=True)
    bits, colour_type = data[24], data[25]
    image = apply_orientation(_decode(path, opened, native=True), orientation)
    if colour_type in (0, 3):
        ids = image.astype(np.int32)
        return ids // (255 // (2**bits - 1)) if opened.mode == "L" else ids, False  # Pillow stretches 2 and 4 bits
    if bits > 8 or image.ndim != 3:
        problem = f"the mask has {bits} bits in each of {_PNG_CHANNELS[colour_type]} channels"
        raise InputError(path, problem, expected, ID_REMEDY)
    is_grey = colour_type == 4
    colours = image.astype(np.int32)
    ids = colours[..., 0] if is_grey else colours[..., :3] @ np.array([65536, 256, 1], np.int32)
    if image.shape[2] in (2, 4):
        alpha = image[..., -1]
        opaque = alpha == 255
        if not (opaque | (alpha == 0)).all():
            raise InputError(path, "the mask has half transparent pixels (4 channels)", expected, ID_REMEDY)
        ids = np.where(opaque, ids, 0) if ids.any() else opaque.astype(np.int32)
    return ids, not is_grey


def _read_id_array(path: Path) -> Int[np.ndarray, "h w"]:
    """Reads the ids of a .npy."""
    expected, remedy = "whole numbers of shape (H, W)", "Write the mask again."
    with reading(path, expected, remedy, problem="the array cannot be read"):
        image = map_npy(path)
    image = np.asarray(image.squeeze() if image.ndim == 3 and 1 in (image.shape[0], image.shape[2]) else image)
    if image.ndim == 3:
        remedy = "Give such stacks with --proposals, or write one image of ids for each frame."
        raise InputError(path, f"the array is a stack of shape {image.shape}", expected, remedy)
    if image.ndim != 2 or not image.size:
        raise InputError(path, f"the array has shape {image.shape}", expected, remedy)
    with np.errstate(invalid="ignore"):
        whole = image.dtype.kind in "biu" or bool((image == np.floor(image)).all())
        whole = whole and bool((image < 1 << 62).all() and (image > -(1 << 62)).all())
    if not whole:
        raise InputError(path, "the array has numbers that are not ids", expected, remedy)
    return image.astype(np.int64)


def read_depth(path: str | Path, unit: float) -> Float[np.ndarray, "h w"]:
    """Reads a depth map.

    Args:
      path: A PNG of one channel of 16 bits, or a .npy of shape (H, W).
      unit: World units of one count (nerfstudio: 0.001, from millimetres).

    Returns:
      (H, W) float32 z-depth in world units, 0 = unknown.

    Raises:
      InputError: The file is damaged or of another kind.
    """
    path = Path(path)
    expected = "one channel of 16 bits (PNG), or a .npy of shape (H, W)"
    remedy = "Write the depth in millimetres as a 16 bit PNG."
    if path.suffix.lower() == ".npy":
        with reading(path, expected, remedy, problem="the depth map cannot be read"):
            depth = map_npy(path)
        depth = depth[..., 0] if depth.ndim == 3 and depth.shape[2] == 1 else depth
        valid = depth.ndim == 2 and depth.size > 0
    else:
        depth = read_pixels(path)
        valid = depth.ndim == 2 and depth.dtype == np.uint16
    if not valid:
        raise InputError(path, f"the depth map has shape {depth.shape} of {depth.dtype}", expected, remedy)
    with np.errstate(over="ignore", invalid="ignore"):  # infinite: unknown
        depth = depth.astype(np.float32) * np.float32(unit)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
