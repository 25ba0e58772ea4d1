"""Image files, read whole or not at all: RGB frames, integer label images, depth maps.

Images come upright, as their EXIF orientation asks. Poses may belong to the stored pixels instead: the readers of
captures decide that (jsecon.data.frames), and ask for those with `upright=False`.
"""

import io
import os
import struct
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile

from jsecon.errors import InputError, why
from jsecon.files import MOST_DEFLATED, UNREADABLE, map_array, written_whole

_ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".heic", ".heif")
IMAGE_ENDINGS = (*_ENDINGS, *(ending.upper() for ending in _ENDINGS))
"""endings tried, in this order, where a capture names an image without one"""
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8"
_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_START_OF_SCAN = 0xDA
_APP1 = 0xE1
_TIFF = (b"II*\0", b"MM\0*")
_HEIC = (b"ftypheic", b"ftypheix", b"ftypmif1", b"ftyphevc")
_READ_AGAIN = "Copy or export the file again."
ID_REMEDY = "Write one id per pixel as an 8 or 16 bit grey PNG without transparency, or as integers in a .npy."
_PIXELS = (b"IDAT", b"IHDR", b"PLTE", b"tRNS")
"""the chunks of a PNG that make its pixels"""
_MODES = {"1": "L", "L": "L", "I;16": "I;16", "RGB": "RGB", "RGBA": "RGBA", "P": "RGB", "PA": "RGBA", "LA": "RGBA"}
"""Pillow's mode of a file -> that of its pixels here"""
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""of a PNG, by its colour type"""
_ADAM7 = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
"""first column, first row and steps of each pass of an interlaced PNG"""
MOST_PIXELS = 1 << 27
"""of an image: 134 million"""
_SHRINKS = (1, 2, 4, 8)
"""by which a JPEG can be shrunk while it is decoded"""
_ORIENTATION = 0x0112
"""EXIF's tag; 1 is upright, 6 the commonest of a phone held upright: turn clockwise by 90 degrees"""
TRANSPOSED = (5, 6, 7, 8)
"""the orientations that swap width and height"""


def _unreadable(path: Path, problem: str) -> InputError:
    return InputError(path, problem, "a whole image", _READ_AGAIN)


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
    """(type, body) of each chunk, checked: OpenCV shows a PNG that was cut short as if its rest were black."""
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


def _png_header(path: Path, data: bytes) -> tuple[int, int, int, int]:
    """Width, height, bits and colour type; raises where no PNG of so many bytes can have as many pixels."""
    header = next(_png_chunks(path, data))[1]
    if len(header) != 13 or header[9] not in _CHANNELS or header[10:12] != b"\0\0":
        raise _unreadable(path, "the PNG has no header")
    width, height, bits, colour_type = struct.unpack_from(">IIBB", header)
    _check_pixels(path, data, width, height, bits * _CHANNELS[colour_type])
    return width, height, bits, colour_type


def _check_pixels(path: Path, data: bytes, width: int, height: int, bits: int = 8) -> None:
    """Raises InputError where an image is too large to be read, or its bytes are too few for its pixels."""
    if width * height > MOST_PIXELS:
        problem = f"the image has {width}x{height} pixels ({width * height / 1e6:.0f} million)"
        remedy = "Shrink it, for instance to half its width and height."
        raise InputError(path, problem, f"at most {MOST_PIXELS // 10**6} million", remedy)
    if not 0 < width * height * bits <= len(data) * MOST_DEFLATED * 8:
        raise _unreadable(path, f"the header announces {width}x{height} pixels, but the file has {len(data)} bytes")


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, int, int]]:
    """(marker, first byte of its body, length of its body) of each segment of a JPEG's header up to the pixels."""
    offset = 2
    while offset + 4 <= len(data) and data[offset] == 0xFF:
        marker = data[offset + 1]
        if marker == 0xFF:  # fill byte
            offset += 1
            continue
        (length,) = struct.unpack_from(">H", data, offset + 2)
        yield marker, offset + 4, length - 2
        if marker == _START_OF_SCAN:
            return
        offset += 2 + length


def _jpeg_size(path: Path, data: bytes) -> tuple[int, int]:
    """Width and height as it is read, at most MOST_PIXELS; raises where the end marker is missing (OpenCV fills the
    rest of such a file with grey)."""
    size, scan = None, 0
    for marker, start, _ in _jpeg_segments(data):
        if marker in _FRAME_MARKERS and start + 5 <= len(data):
            height, width = struct.unpack_from(">HH", data, start + 1)
            size = width, height
        scan = start if marker == _START_OF_SCAN else 0
    if not scan:
        raise _unreadable(path, f"the JPEG breaks off in its header, after {len(data)} bytes")
    # A thumbnail within the header has an end marker too: look behind the start of the scan only.
    if size is None or data.rfind(b"\xff\xd9") < scan - 4:
        raise _unreadable(path, f"the JPEG breaks off after {len(data)} bytes")
    shrink = _shrink(*size)
    width, height = (-(-side // shrink) for side in size)
    _check_pixels(path, data, width, height)
    return width, height


def _shrink(width: int, height: int) -> int:
    """The least number by which a JPEG is shrunk on decoding so that MOST_PIXELS hold it, else 1."""
    return next((n for n in _SHRINKS if -(-width // n) * -(-height // n) <= MOST_PIXELS), 1)


def exif_orientation(data: bytes) -> int:
    """The EXIF orientation, 1 to 8, of an image file's bytes: JPEG, PNG (eXIf), WebP or TIFF; 1 where it has none.

    HEIC has 1: its decoder applies the file's own rotation, and EXIF's does not count there.
    """
    block = _exif_block(data)
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


def _exif_block(data: bytes) -> bytes:
    """EXIF's records, a TIFF of their own, within an image file; empty where there are none."""
    if data.startswith(_JPEG):
        bodies = (data[a : a + size] for marker, a, size in _jpeg_segments(data) if marker == _APP1)
        return next((body[6:] for body in bodies if body.startswith(b"Exif\0\0")), b"")
    if data.startswith(_PNG):
        return next((body for kind, body in _chunks(data, len(_PNG), ">I4s", 12, 1) if kind == b"eXIf"), b"")
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        found = next((body for kind, body in _chunks(data, 12, "<4sI", 8, 2) if kind == b"EXIF"), b"")
        return found.removeprefix(b"Exif\0\0")
    return data[: 1 << 16] if data[:4] in _TIFF else b""


def _chunks(data: bytes, offset: int, head: str, extra: int, align: int) -> Iterator[tuple[bytes, bytes]]:
    """(type, body) of the chunks of a PNG or WebP, unchecked; `extra` bytes of each are not its body."""
    while offset + 8 <= len(data):
        fields = struct.unpack_from(head, data, offset)
        kind, size = fields if isinstance(fields[0], bytes) else fields[::-1]
        yield kind, data[offset + 8 : offset + 8 + size]
        offset += extra + size + size % align


def turned(image: np.ndarray, orientation: int) -> np.ndarray:
    """The upright image (H, W, ...) of stored pixels with this EXIF orientation."""
    if orientation in TRANSPOSED:
        image = image.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    return np.ascontiguousarray(image)


def _decode(path: Path, data: bytes) -> np.ndarray:
    """Pixels as stored, grey, RGB or RGBA; of TIFF and HEIC upright, by the decoders themselves.

    PNG and JPEG by Pillow: the same pixels as OpenCV's, as fast, and it writes nothing to stderr. For 16 bits of colour
    and CMYK it has no mode: those are read once more by OpenCV.
    """
    if data[4:12] in _HEIC:
        return _decode_heic(path, data)
    kind = PngImageFile if data.startswith(_PNG) else JpegImageFile if data.startswith(_JPEG) else None
    try:
        deep = kind is PngImageFile and data[24] == 16 and data[25] > 0
        if deep:
            _check_deep(list(_png_chunks(path, data)))
        if kind is not None:
            with kind(io.BytesIO(data)) as image:
                if kind is JpegImageFile and (shrink := _shrink(*image.size)) > 1:
                    image.draft(None, (image.width // shrink, image.height // shrink))
                mode = "RGBA" if "transparency" in image.info else _MODES.get(image.mode, "RGB")
                pixels = np.asarray(image if mode == image.mode else image.convert(mode))
            if image.mode in _MODES and not deep:
                return pixels
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise ValueError(f"its {len(data)} bytes are no image")
        order = {3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}
        return image if image.ndim == 2 else cv2.cvtColor(image, order[image.shape[2]])
    except Exception as error:  # Pillow's and OpenCV's own kinds have no common base but this
        raise _unreadable(path, f"the image cannot be decoded ({why(error)})") from error


def _check_deep(chunks: list[tuple[bytes, bytes]]) -> None:
    """Raises where libpng, by which OpenCV reads 16 bits of colour, would say on stderr what is wrong."""
    kinds = [kind for kind, _ in chunks]
    first, behind = kinds[: kinds.index(b"IDAT")], kinds[kinds.index(b"IDAT") :]
    for kind, size in ((b"tRNS", {6}), (b"PLTE", range(3, 769, 3))):
        if kind in behind or first.count(kind) > 1 or any(len(b) not in size for k, b in chunks if k == kind):
            raise ValueError(f"its chunk {kind.decode()} is out of place")
    width, height, bits, colour_type, _, _, woven = struct.unpack(">IIBBBBB", chunks[0][1])
    passes = _ADAM7 if woven else ((0, 0, 1, 1),)
    sizes = [(-((x - width) // across), -((y - height) // down)) for x, y, across, down in passes]
    needed = sum(rows * (1 + columns * _CHANNELS[colour_type] * bits // 8) for columns, rows in sizes if columns > 0)
    found = len(zlib.decompress(b"".join(body for kind, body in chunks if kind == b"IDAT")))
    if found != needed:
        raise ValueError(f"it has {found} bytes of pixels, {width}x{height} of {bits} bits need {needed}")


def _open_heic(path: Path, data: bytes) -> Any:
    try:
        import pillow_heif
    except ImportError as error:
        remedy = "Run: pip install 'jsecon[formats]' (or export the photographs as JPEG)."
        raise InputError(
            path, "a HEIC photograph cannot be read without pillow-heif", "it installed", remedy
        ) from error
    try:
        return pillow_heif.open_heif(io.BytesIO(data), convert_hdr_to_8bit=True)
    except (ValueError, OSError, EOFError, SyntaxError) as error:
        raise _unreadable(path, f"the HEIC cannot be decoded: {error}") from error


def _decode_heic(path: Path, data: bytes) -> np.ndarray:
    image = _open_heic(path, data)
    try:
        return np.ascontiguousarray(np.asarray(image)[..., :3])
    except (ValueError, OSError, EOFError, SyntaxError) as error:
        raise _unreadable(path, f"the HEIC cannot be decoded: {error}") from error


def _checked_bytes(path: Path, data: bytes) -> bytes:
    """The bytes that a decoder is given: checked to be whole, without what doesn't bear on the pixels."""
    if data.startswith(_PNG):
        _png_header(path, data)
        return _png(own for own in _png_chunks(path, data) if own[0] in _PIXELS)
    if data.startswith(_JPEG):
        _jpeg_size(path, data)
        return data.replace(b"Exif\0\0", b"unread")  # of which Pillow would warn
    return data


def existing_image(folder: Path, name: str) -> Path | None:
    """Returns the image file that a capture names, or None.

    Tried are the name itself, with "\\" as a separator (where a Windows program wrote it), with its ending in upper or
    lower case, and, where it has none of an image, with an ending added.
    """
    for base in dict.fromkeys((name, name.replace("\\", "/"))):
        stem, ending = os.path.splitext(base)
        added = () if ending.lower() in IMAGE_ENDINGS else IMAGE_ENDINGS  # a.jpg.png is a mask of a.jpg
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
    """Size and orientation of an image file. Raises InputError where it is missing, empty or cut short."""
    path = Path(path)
    data = _read_bytes(path)
    orientation = exif_orientation(data)
    if data.startswith(_PNG):
        return ImageHeader(_png_header(path, data)[:2], orientation)
    if data.startswith(_JPEG):
        return ImageHeader(_jpeg_size(path, data), orientation)
    if data[4:12] in _HEIC:
        return ImageHeader(_open_heic(path, data).size, orientation)
    height, width = _decode(path, data).shape[:2]
    turned_already = data[:4] in _TIFF and orientation in TRANSPOSED
    return ImageHeader((height, width) if turned_already else (width, height), orientation)


def image_size(path: str | Path) -> tuple[int, int]:
    """(width, height) in pixels of an image file as it is read, upright. Raises InputError as `image_header` does."""
    return image_header(path).upright


def read_stored(path: Path, *, upright: bool = True) -> np.ndarray:
    """The values of an image file as they are stored: grey (H, W), RGB or RGBA (H, W, C), upright or not. Raises
    InputError where it is damaged."""
    data = _read_bytes(path)
    orientation = exif_orientation(data)
    image = _decode(path, _checked_bytes(path, data))
    if orientation == 1 or (data[:4] in _TIFF) == upright:
        return image
    return turned(image, orientation if upright else {6: 8, 8: 6}.get(orientation, orientation))


def read_image(path: str | Path, *, upright: bool = True) -> tuple[UInt8[np.ndarray, "h w 3"], bool]:
    """RGB, and whether any pixel was transparent: such pixels are laid over black, as in a render of nothing.

    Grey becomes RGB, 16 bits become 8. A JPEG of more than MOST_PIXELS is read at a half, a quarter or an eighth of its
    size.

    Args:
      path: An image file.
      upright: Apply the EXIF orientation, as every viewer does; False has the stored pixels.

    Raises:
      InputError: The file is missing, empty, cut short, too large, or no image.
    """
    path = Path(path)
    image = read_stored(path, upright=upright)
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
    with written_whole(path) as temporary:
        temporary.write_bytes(data.tobytes())


def read_ids(path: str | Path) -> tuple[Int[np.ndarray, "h w"], bool]:
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
    _, _, bits, colour_type = _png_header(path, data)
    (kind, header), *others = _png_chunks(path, data)
    if colour_type == 3:  # as grey, whose values are the indices
        header, colour_type = header[:9] + b"\0" + header[10:], 0
    image = _decode(path, _png([(kind, header), *(own for own in others if own[0] == b"IDAT")]))
    image = turned(image, exif_orientation(data))
    if colour_type == 0 and image.ndim == 2:
        ids = image.astype(np.int32)
        return ids if bits >= 8 else ids // (255 // (2**bits - 1)), False  # fewer than 8 come stretched to 0..255
    if bits > 8 or image.ndim != 3:
        raise InputError(
            path, f"the mask has {bits} bits in each of {_CHANNELS[colour_type]} channels", expected, ID_REMEDY
        )
    red, green, blue = (image[..., channel].astype(np.int32) for channel in range(3))
    grey = colour_type == 4
    ids = red if grey else red * 65536 + green * 256 + blue
    if image.shape[2] == 4:
        opaque = image[..., 3] == 255
        if not (opaque | (image[..., 3] == 0)).all():
            raise InputError(path, "the mask has pixels that are half transparent (4 channels)", expected, ID_REMEDY)
        ids = np.where(opaque, ids, 0) if ids.any() else opaque.astype(np.int32)
    return ids, not grey


def _read_id_array(path: Path) -> np.ndarray:
    """The ids (H, W) int64 of a .npy."""
    expected = "whole numbers of shape (H, W)"
    try:
        image = map_array(path)
    except UNREADABLE as error:
        raise InputError(path, f"the array cannot be read: {why(error)}", expected, "Write the mask again.") from error
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
            depth = map_array(path)
        except UNREADABLE as error:
            raise InputError(path, f"the depth map cannot be read: {why(error)}", expected, remedy) from error
        depth = depth[..., 0] if depth.ndim == 3 and depth.shape[2] == 1 else depth
        if depth.ndim != 2 or not depth.size:
            raise InputError(path, f"the depth map has shape {depth.shape}", expected, remedy)
    else:
        depth = read_stored(path)
        if depth.dtype != np.uint16 or depth.ndim != 2:
            raise InputError(path, f"the depth map has shape {depth.shape} of {depth.dtype}", expected, remedy)
    with np.errstate(over="ignore", invalid="ignore"):  # infinite is unknown
        depth = depth.astype(np.float32) * np.float32(unit)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
