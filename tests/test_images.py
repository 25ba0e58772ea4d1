"""Image files and lenses: what is read is what was stored, and damage is told."""

import struct
import sys

import cv2
import numpy as np
import PIL.features
import PIL.Image
import PIL.ImageOps
import pillow_heif
import pytest
from capture_files import png, png_chunk, refused

from jsecon import load_capture
from jsecon.errors import InputError
from jsecon.read.captures.images import MAX_PIXELS, image_header, read_depth, read_image, read_label_image, write_image
from jsecon.read.captures.lens import Lens, undistorted_pinhole, undistortion_maps

RNG = np.random.default_rng(3)
FRAME = RNG.integers(0, 256, (13, 17, 3), np.uint8)


def test_what_is_written_comes_back(tmp_path):
    write_image(tmp_path / "a.png", FRAME)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), FRAME)
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
    write_image(tmp_path / "a.jpg", corners())
    assert np.abs(read_image(tmp_path / "a.jpg").astype(int) - corners()).mean() < 6


def corners(width=48, height=32):
    """An image whose orientation shows: smooth, and different in each corner."""
    y, x = np.mgrid[:height, :width]
    return np.stack([255 * x // width, 255 * y // height, 255 * (x > y)], -1).astype(np.uint8)


def stored_as(image, orientation, path):
    """Writes an image so that `orientation` of EXIF turns it upright again."""
    image = np.asarray(with_orientation(image, {6: 8, 8: 6}.get(orientation, orientation)))
    tags = PIL.Image.Exif()
    tags[0x0112] = orientation
    lossless = {"lossless": True} if path.suffix == ".webp" else {"quality": 95}
    PIL.Image.fromarray(np.ascontiguousarray(image)).save(path, exif=tags, **lossless)


def with_orientation(image, orientation):
    """By Pillow: what viewers show of pixels with this tag."""
    shown = PIL.Image.fromarray(np.ascontiguousarray(image))
    shown.getexif()[0x0112] = orientation
    return PIL.ImageOps.exif_transpose(shown)


@pytest.mark.parametrize("ending", [".jpg", ".png", ".webp"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_images_come_upright(tmp_path, ending, orientation):
    file, image = tmp_path / f"a{ending}", corners()
    stored_as(image, orientation, file)
    assert image_header(file).upright == (48, 32)
    read = read_image(file)
    assert np.abs(read.astype(int) - image).mean() < (6 if ending == ".jpg" else 0.1)
    stored = read_image(file, upright=False)
    np.testing.assert_array_equal(with_orientation(stored, orientation), read)
    assert stored.shape[:2] == ((48, 32) if orientation > 4 else (32, 48))


@pytest.mark.parametrize("turn", [1, 6])
@pytest.mark.parametrize("name", ["a.heic", "a.avif"])
def test_a_heic_or_an_avif_is_turned_once(tmp_path, name, turn):
    """Their decoders apply the file's own rotation; EXIF's must not be applied again."""
    if name == "a.avif" and not PIL.features.check("avif"):
        pytest.skip("this Pillow has no AVIF")
    tags = PIL.Image.Exif()
    tags[0x0112] = turn
    photo = PIL.Image.fromarray(np.ascontiguousarray(np.rot90(corners(96, 64), k=int(turn == 6))))
    photo = pillow_heif.from_pillow(photo) if name == "a.heic" else photo
    photo.save(tmp_path / name, quality=95, exif=tags.tobytes())
    assert image_header(tmp_path / name).upright == (96, 64)
    assert np.abs(read_image(tmp_path / name).astype(int) - corners(96, 64)).mean() < 6


def test_damage_and_absence_of_a_heics_decoder_are_told(tmp_path, monkeypatch):
    pillow_heif.from_pillow(PIL.Image.fromarray(corners(96, 64))).save(tmp_path / "a.heic")
    data = (tmp_path / "a.heic").read_bytes()
    (tmp_path / "cut.heic").write_bytes(data[: len(data) // 2])
    with refused("cut.heic", "cannot be read"):
        read_image(tmp_path / "cut.heic")
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with refused("a.heic", "pip install 'jsecon[formats]'"):
        read_image(tmp_path / "a.heic")


def test_too_large_images_are_shrunk_or_say_the_limit(tmp_path, monkeypatch):
    """144 million pixels, as phones write them; of a JPEG beyond the limit a half is read."""
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", 16000, 9000, 8, 2, 0, 0, 0))
    rest = png_chunk(b"IDAT", bytes(99)) + png_chunk(b"IEND", b"")
    (tmp_path / "big.png").write_bytes(b"\x89PNG\r\n\x1a\n" + header + rest)
    with refused("big.png", "16000x9000", "134 million", "shrink"):
        read_image(tmp_path / "big.png")
    monkeypatch.setattr("jsecon.read.captures.images.MAX_PIXELS", 101 * 61)
    PIL.Image.fromarray(corners(201, 121)).save(tmp_path / "big.jpg", quality=95)
    limit = PIL.Image.MAX_IMAGE_PIXELS
    assert image_header(tmp_path / "big.jpg").upright == (101, 61)
    assert limit == PIL.Image.MAX_IMAGE_PIXELS < MAX_PIXELS
    image = read_image(tmp_path / "big.jpg")
    assert image.shape == (61, 101, 3)
    assert np.abs(image[:60, :100].astype(int) - corners(100, 60)).mean() < 6


def test_odd_kinds_of_images_are_read_right(tmp_path):
    """Grey, CMYK, 16 bit grey of a TIFF, colours and grey with alpha, an animation (its first frame)."""
    cv2.imwrite(str(tmp_path / "a.bmp"), corners()[..., 0])
    np.testing.assert_array_equal(read_image(tmp_path / "a.bmp"), np.repeat(corners()[..., :1], 3, -1))
    image = PIL.Image.fromarray(corners())
    image.convert("CMYK").save(tmp_path / "a.jpg", quality=95)
    assert np.abs(read_image(tmp_path / "a.jpg").astype(int) - corners()).mean() < 6
    grey = corners()[..., 0]
    PIL.Image.fromarray(grey.astype(np.uint16) * 257).save(tmp_path / "a.tif")
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), np.repeat(grey[..., None], 3, -1))
    alpha = np.where(np.arange(48) < 20, 0, 255).astype(np.uint8) * np.ones((32, 1), np.uint8)
    PIL.Image.fromarray(np.stack([grey, alpha], -1), "LA").save(tmp_path / "a.png")
    PIL.Image.fromarray(np.dstack([corners(), alpha])).save(tmp_path / "c.png")
    for name, expected in (("a.png", np.repeat(grey[..., None], 3, -1)), ("c.png", corners())):
        np.testing.assert_array_equal(read_image(tmp_path / name), expected * (alpha > 0)[..., None])
    for ending in (".webp", ".png"):
        image.save(tmp_path / f"b{ending}", save_all=True, append_images=[image.rotate(180)], lossless=True)
        np.testing.assert_array_equal(read_image(tmp_path / f"b{ending}"), corners())


@pytest.mark.parametrize("bits", [1, 2, 4, 8, 16])
def test_label_bits(tmp_path, bits):
    ids = RNG.integers(0, 2**bits, (9, 11))
    if bits not in (2, 4):  # Pillow stretches these
        (tmp_path / "grey.png").write_bytes(png(ids, bits=bits, colour_type=0))
        np.testing.assert_array_equal(read_label_image(tmp_path / "grey.png"), ids)
    if bits <= 8:
        palette = RNG.integers(0, 256, 3 * 2**bits, np.uint8).tobytes()
        (tmp_path / "palette.png").write_bytes(png(ids, bits=bits, colour_type=3, palette=palette))
        np.testing.assert_array_equal(read_label_image(tmp_path / "palette.png"), ids)


@pytest.mark.parametrize("dtype", [bool, np.uint8, np.int32, np.int64, np.float32])
def test_label_arrays(tmp_path, dtype):
    ids = RNG.integers(0, 2 if dtype is bool else 200, (9, 11)).astype(dtype)
    np.save(tmp_path / "a.npy", ids)
    np.testing.assert_array_equal(read_label_image(tmp_path / "a.npy"), ids)
    for wrong, words in ((np.zeros((3, 9, 11)), "shape"), (ids + 0.5, "no whole numbers"), (ids[0], "shape")):
        np.save(tmp_path / "a.npy", wrong)
        with refused("a.npy", words):
            read_label_image(tmp_path / "a.npy")


def test_depth(tmp_path):
    counts = RNG.integers(0, 65536, (6, 5)).astype(np.uint16)
    counts[0, 0] = 65535  # the largest number: unknown
    cv2.imwrite(str(tmp_path / "d.png"), counts)
    np.testing.assert_allclose(read_depth(tmp_path / "d.png", 0.001), counts % 65535 / 1000, rtol=1e-6)
    np.save(tmp_path / "d.npy", np.array([[1.0, np.nan, -2.0]]))
    np.testing.assert_array_equal(read_depth(tmp_path / "d.npy", 2.0), [[2, 0, 0]])


BROWN = Lens(160, 120, 130.0, 128.0, 83.0, 58.0, (-0.21, 0.06, 0.002, -0.001))
PINCUSHION = Lens(160, 120, 130.0, 128.0, 80.0, 60.0, (0.15, 0.02, 0.0, 0.0, 0.01, 0.02))
FISHEYE = Lens(160, 120, 70.0, 71.0, 79.0, 61.0, (0.02, -0.01, 0.003, 0.0), fisheye=True)


def by_opencv(lens, x, y):
    """Where OpenCV's model of the lens puts rays."""
    rays = np.stack([x, y, np.ones_like(x)], -1)
    matrix = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    padded = np.pad(lens.distortion, (0, -len(lens.distortion) % 4))
    project = cv2.fisheye.projectPoints if lens.fisheye else cv2.projectPoints
    seen, _ = project(rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), matrix, padded)
    return np.moveaxis(seen.reshape(*x.shape, 2), -1, 0)


@pytest.mark.parametrize("lens", [BROWN, PINCUSHION, FISHEYE])
def test_undistortion(lens):
    """The maps lead each pinhole pixel to where the model puts it; none lies outside."""
    pinhole = undistorted_pinhole(lens, "here")
    assert not pinhole.distorted
    map_x, map_y = undistortion_maps(lens, pinhole)
    v, u = np.mgrid[: lens.height, : lens.width] + 0.5
    x, y = by_opencv(lens, (u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy)
    np.testing.assert_allclose(map_x + 0.5, x, atol=1e-3)
    np.testing.assert_allclose(map_y + 0.5, y, atol=1e-3)
    edges = np.stack([x, y])[:, [0, -1]].reshape(2, -1), np.stack([x, y])[:, :, [0, -1]].reshape(2, -1)
    margins = [np.minimum(e, np.array([[lens.width], [lens.height]]) - e).min() for e in edges]
    assert min(margins) > 0
    assert min(margins) < 1.5, "a wider lens would still have been covered"


def test_lenses_that_cannot_be_undone():
    with refused("here", "no undistorted image"):
        undistorted_pinhole(Lens(160, 120, 130.0, 130.0, 300.0, 60.0, (0.1,)), "here")
    with pytest.raises(InputError):
        undistorted_pinhole(Lens(160, 120, 1.0, 1.0, 80.0, 60.0, (-5000.0,)), "here")
    plain = Lens(160, 120, 130.0, 130.0, 80.0, 60.0, (0.0, 0.0, 0.0, 0.0))
    assert undistorted_pinhole(plain, "here") == Lens(160, 120, 130.0, 130.0, 80.0, 60.0)


@pytest.mark.parametrize("name", ["a.gif", "c.DNG", "d.exr"])
def test_a_format_that_is_not_read_is_named(tmp_path, name):
    """A raw file is a TIFF whose first image is a thumbnail."""
    (tmp_path / name).write_bytes(b"II*\0" + bytes(200))
    for read, path in ((image_header, tmp_path / name), (load_capture, tmp_path)):
        with refused(name[1:], "not read", "magick"):
            read(path)
