"""Image files, read whole or not at all: RGB frames, integer label images, depth maps."""

import io
import struct
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int32, UInt8
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile

from jsecon.errors import InputError
from jsecon.files import MOST_DEFLATED, UNREADABLE, map_array, written_whole

IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG", ".webp", ".tif", ".tiff", ".bmp", ".heic", ".HEIC")
"""endings tried, in this order, where a capture names an image without one"""
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8"
_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_START_OF_SCAN = 0xDA
_HEIC = (b"ftypheic", b"ftypheix", b"ftypmif1", b"ftyphevc")
_READ_AGAIN = "Copy or export the file again."
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


def _unreadable(path: Path, found: str) -> InputError:
    return InputError(path, found, "a whole PNG, JPEG or other image that OpenCV reads", _READ_AGAIN)


def _read_bytes(path: Path) -> bytes:
    try:
        data = path.read_bytes()
    except (OSError, ValueError) as error:  # a name with a zero byte is a ValueError
        raise _unreadable(path, getattr(error, "strerror", None) or str(error)) from error
    if not data:
        raise _unreadable(path, "an empty file")
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
            raise _unreadable(path, f"a PNG that breaks off after {len(data)} bytes")
        if zlib.crc32(data[offset + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            raise _unreadable(path, f"a PNG whose chunk {kind.decode('latin1')} at byte {offset} fails its checksum")
        if (kind == b"IHDR") != (offset == len(_PNG)):
            raise _unreadable(path, "a PNG without header, or with two")
        yield kind, data[offset + 8 : end]
        if kind == b"IEND":
            return
        offset = end + 4


def _png_header(path: Path, data: bytes) -> tuple[int, int, int, int]:
    """Width, height, bits and colour type; raises where no PNG of so many bytes can have as many pixels."""
    header = next(_png_chunks(path, data))[1]
    if len(header) != 13 or header[9] not in _CHANNELS or header[10:12] != b"\0\0":
        raise _unreadable(path, "a PNG without header")
    width, height, bits, colour_type = struct.unpack_from(">IIBB", header)
    _check_pixels(path, data, width, height, bits * _CHANNELS[colour_type])
    return width, height, bits, colour_type


def _check_pixels(path: Path, data: bytes, width: int, height: int, bits: int = 8) -> None:
    if not 0 < width * height * bits <= min(MOST_PIXELS * bits, len(data) * MOST_DEFLATED * 8):
        raise _unreadable(path, f"an image that claims {width}x{height} pixels in {len(data)} bytes")


def _jpeg_size(path: Path, data: bytes) -> tuple[int, int]:
    """Width and height; raises where the end marker is missing (OpenCV fills the rest of such a file with grey)."""
    offset, size = 2, None
    while offset + 4 <= len(data) and data[offset] == 0xFF:
        marker = data[offset + 1]
        if marker == 0xFF:  # fill byte
            offset += 1
            continue
        if marker in _FRAME_MARKERS and offset + 9 <= len(data):
            height, width = struct.unpack_from(">HH", data, offset + 5)
            size = width, height
        if marker == _START_OF_SCAN:
            break
        offset += 2 + struct.unpack_from(">H", data, offset + 2)[0]
    else:
        raise _unreadable(path, f"a JPEG that breaks off in its header, after {len(data)} bytes")
    # A thumbnail within the header has an end marker too: look behind the start of the scan only.
    if size is None or data.rfind(b"\xff\xd9") < offset:
        raise _unreadable(path, f"a JPEG that breaks off after {len(data)} bytes")
    _check_pixels(path, data, *size)
    return size


def _decode(path: Path, data: bytes) -> np.ndarray:
    """Pixels as stored, grey, RGB or RGBA (EXIF orientation ignored: poses are estimated on the stored pixels).

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
                mode = "RGBA" if "transparency" in image.info else _MODES.get(image.mode, "RGB")
                pixels = np.asarray(image if mode == image.mode else image.convert(mode))
            if image.mode in _MODES and not deep:
                return pixels
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise ValueError(f"{len(data)} bytes that are no image")
        order = {3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}
        return image if image.ndim == 2 else cv2.cvtColor(image, order[image.shape[2]])
    except Exception as error:  # Pillow's and OpenCV's own kinds have no common base but this
        raise _unreadable(path, f"what cannot be decoded ({error or type(error).__name__})") from error


def _check_deep(chunks: list[tuple[bytes, bytes]]) -> None:
    """Raises where libpng, by which OpenCV reads 16 bits of colour, would say on stderr what is wrong."""
    kinds = [kind for kind, _ in chunks]
    first, behind = kinds[: kinds.index(b"IDAT")], kinds[kinds.index(b"IDAT") :]
    for kind, size in ((b"tRNS", {6}), (b"PLTE", range(3, 769, 3))):
        if kind in behind or first.count(kind) > 1 or any(len(b) not in size for k, b in chunks if k == kind):
            raise ValueError(f"a {kind.decode()} out of place")
    width, height, bits, colour_type, _, _, woven = struct.unpack(">IIBBBBB", chunks[0][1])
    passes = _ADAM7 if woven else ((0, 0, 1, 1),)
    sizes = [(-((x - width) // across), -((y - height) // down)) for x, y, across, down in passes]
    needed = sum(rows * (1 + columns * _CHANNELS[colour_type] * bits // 8) for columns, rows in sizes if columns > 0)
    found = len(zlib.decompress(b"".join(body for kind, body in chunks if kind == b"IDAT")))
    if found != needed:
        raise ValueError(f"{found} bytes of pixels, where {width}x{height} of {bits} bits have {needed}")


def _decode_heic(path: Path, data: bytes) -> np.ndarray:
    try:
        import pillow_heif
    except ImportError as error:
        remedy = "Run: pip install 'jsecon[formats]' (or export the photographs as JPEG)."
        raise InputError(path, "a HEIC photograph", "pillow-heif, which reads them", remedy) from error
    try:
        image = pillow_heif.open_heif(io.BytesIO(data), convert_hdr_to_8bit=True)
        return np.ascontiguousarray(np.asarray(image)[..., :3])
    except (ValueError, OSError, EOFError, SyntaxError) as error:
        raise _unreadable(path, f"a HEIC that pillow-heif refuses ({error})") from error


def _checked_bytes(path: Path) -> bytes:
    data = _read_bytes(path)
    if data.startswith(_PNG):
        _png_header(path, data)
        return _png(own for own in _png_chunks(path, data) if own[0] in _PIXELS)
    if data.startswith(_JPEG):
        _jpeg_size(path, data)
        return data.replace(b"Exif\0\0", b"unread")  # of which Pillow would warn; the pixels don't depend on it
    return data


def image_size(path: str | Path) -> tuple[int, int]:
    """(width, height) in pixels, from the header of a PNG or JPEG. Raises InputError on a cut or empty file."""
    path = Path(path)
    data = _read_bytes(path)
    if data.startswith(_PNG):
        return _png_header(path, data)[:2]
    if data.startswith(_JPEG):
        return _jpeg_size(path, data)
    height, width = _decode(path, data).shape[:2]
    return width, height


def read_stored(path: Path) -> np.ndarray:
    """The pixels of an image file as they are stored: grey (H, W), RGB or RGBA (H, W, C). Raises InputError where it is
    damaged."""
    return _decode(path, _checked_bytes(path))


def read_image(path: str | Path) -> tuple[UInt8[np.ndarray, "h w 3"], bool]:
    """RGB, and whether any pixel was transparent: such pixels are laid over black, as in a render of nothing.

    Grey becomes RGB, 16 bits become 8. EXIF orientation is ignored, as by COLMAP and nerfstudio. Raises InputError
    where the file is missing, empty, cut short, or no image.
    """
    path = Path(path)
    image = read_stored(path)
    if image.dtype == np.uint16:
        image = cv2.convertScaleAbs(image, alpha=255 / 65535)  # rounded to the nearest
    if image.dtype != np.uint8:
        raise InputError(path, f"pixels of type {image.dtype}", "8 or 16 bits a channel", "Convert it to PNG or JPEG.")
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
        raise InputError(path, f"ending {path.suffix!r}", "one of .png .jpg", "Choose another format.")
    with written_whole(path) as temporary:
        temporary.write_bytes(data.tobytes())


def read_ids(path: str | Path) -> tuple[Int32[np.ndarray, "h w"], bool]:
    """A label PNG as integers, and whether they are colours.

    Grey of 1 to 16 bits: the values. A palette: the indices into it, never its colours. RGB of 8 bits:
    R*65536 + G*256 + B, with True beside it. Raises InputError where it is none of these, or damaged.
    """
    path = Path(path)
    data = _read_bytes(path)
    expected = "a PNG of integers: grey (1 to 16 bits), palette, or RGB of 8 bits per channel"
    remedy = "Write one id per pixel as an 8 or 16 bit grey PNG (lossless, no transparency)."
    if not data.startswith(_PNG):
        raise InputError(path, "a file that is no PNG", expected, remedy)
    _, _, bits, colour_type = _png_header(path, data)
    (kind, header), *others = _png_chunks(path, data)
    if colour_type == 3:  # as grey, whose values are the indices
        header, colour_type = header[:9] + b"\0" + header[10:], 0
    image = _decode(path, _png([(kind, header), *(own for own in others if own[0] == b"IDAT")]))
    if colour_type == 0 and image.ndim == 2:
        step = 255 // (2**bits - 1) if bits < 8 else 1  # fewer than 8 bits come stretched to 0..255
        return image.astype(np.int32) // step, False
    if colour_type == 2 and image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == 3:
        red, green, blue = (image[..., channel].astype(np.int32) for channel in range(3))
        return red * 65536 + green * 256 + blue, True
    channels = 1 if image.ndim == 2 else image.shape[2]
    raise InputError(path, f"a PNG of {channels} channels, {bits} bits, colour type {colour_type}", expected, remedy)


def read_depth(path: str | Path, unit: float) -> Float[np.ndarray, "h w"]:
    """A depth map times `unit` (nerfstudio: 0.001, from millimetres), float32, 0 = unknown. A PNG of 16 bits, or .npy.

    Raises InputError where the file is damaged or of another kind.
    """
    path = Path(path)
    expected = "one channel of 16 bits (PNG), or a .npy of shape (H, W)"
    remedy = "Write the depth in millimetres as a 16 bit PNG."
    if path.suffix == ".npy":
        try:
            depth = map_array(path)
        except UNREADABLE as error:
            raise InputError(path, str(error), expected, remedy) from error
        depth = depth[..., 0] if depth.ndim == 3 and depth.shape[2] == 1 else depth
        if depth.ndim != 2 or not depth.size:
            raise InputError(path, f"shape {depth.shape}", expected, remedy)
    else:
        depth = read_stored(path)
        if depth.dtype != np.uint16 or depth.ndim != 2:
            raise InputError(path, f"shape {depth.shape} of {depth.dtype}", expected, remedy)
    with np.errstate(over="ignore", invalid="ignore"):  # infinite is unknown
        depth = depth.astype(np.float32) * np.float32(unit)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
