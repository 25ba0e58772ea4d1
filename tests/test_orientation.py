"""EXIF orientation: photographs come upright, and poses keep the pixels that they were estimated on."""

import json

import numpy as np
import PIL.Image
import PIL.ImageOps
import pytest
from capture_files import small_capture, transforms, write_text_model

import jsecon


def write_turned(capture, folder, orientations, *, upright):
    """The capture's images with EXIF orientations; the frames are what is upright, or else what is stored."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, frame, orientation in zip(capture.names, capture.frames, orientations):
        tags, stored = PIL.Image.Exif(), PIL.Image.fromarray(frame)
        if upright:
            stored.getexif()[0x0112] = {6: 8, 8: 6}.get(orientation, orientation)
            stored = PIL.ImageOps.exif_transpose(stored)
        tags[0x0112] = orientation
        stored.save(folder / f"{name}.png", exif=tags)


def test_mixed_exif_orientations_come_upright(tmp_path):
    capture = small_capture(8)
    write_turned(capture, tmp_path / "images", range(1, 9), upright=True)
    (tmp_path / "transforms.json").write_text(json.dumps(transforms(capture)))
    read = jsecon.load_capture(tmp_path)
    np.testing.assert_array_equal(read.frames, capture.frames)
    assert {(file.width, file.height) for file in read.files} == {(24, 16)}
    assert any("7 images were turned upright" in note for note in read.notes)


def test_other_images_tell_that_a_program_ignored_exif(tmp_path):
    """The camera model of the first, on its side, leaves EXIF out: so does that of the second, upside down."""
    capture = small_capture(3, points=0)
    write_text_model(capture, tmp_path / "sparse/0")
    write_turned(capture, tmp_path / "images", [6, 3, 1], upright=False)
    np.testing.assert_array_equal(jsecon.load_capture(tmp_path).frames[1], capture.frames[1])


@pytest.mark.parametrize(("orientation", "upright"), [(3, False), (6, False), (6, True)])
def test_poses_of_stored_pixels_keep_them(tmp_path, orientation, upright):
    """By the size of the camera model; where that cannot tell, because COLMAP ignores EXIF."""
    capture = small_capture(3)
    write_text_model(capture, tmp_path / "sparse/0")
    write_turned(capture, tmp_path / "images", [orientation, 1, 1], upright=upright)
    read = jsecon.load_capture(tmp_path)
    np.testing.assert_array_equal(read.frames, capture.frames)
    assert any(("turned upright" if upright else "as they are stored") in note for note in read.notes)


def test_a_file_without_a_size_means_the_pixels_that_its_centre_lies_in_the_middle_of(tmp_path):
    """Of photographs that lie on their side, stored and upright; depth is measured like the stored pixels."""
    capture = small_capture(3)
    write_turned(capture, tmp_path / "images", [6, 8, 1], upright=False)
    content = transforms(capture)
    del content["w"], content["h"]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    np.testing.assert_array_equal(jsecon.load_capture(tmp_path).frames, capture.frames)
    write_turned(capture, tmp_path / "images", [6, 8, 1], upright=True)
    for n, (entry, turns) in enumerate(zip(content["frames"], (1, 3, 0))):
        depth = np.arange(24 * 16, dtype=np.uint16).reshape(16, 24) + 1000
        entry["depth_file_path"] = f"depth_{n}.npy"
        np.save(tmp_path / entry["depth_file_path"], np.rot90(depth, turns))
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    read = jsecon.load_capture(tmp_path)
    np.testing.assert_array_equal(read.frames, capture.frames)
    np.testing.assert_allclose(read.depths, np.broadcast_to(0.001 * depth, (3, 16, 24)), rtol=1e-5)
