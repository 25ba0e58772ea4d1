"""What a run leaves out by name: which masks a name fits, which pixels are ignored, and the files that say so."""

import dataclasses

import cv2
import numpy as np
from capture_files import small_capture

from jsecon.pipeline.ignoring import ignore_named
from jsecon.read.captures.images import read_label_image
from jsecon.types import ImageFile
from jsecon.vision.classical import ClassicalSegmenter
from jsecon.vision.colours import ColourEmbedder
from jsecon.vision.protocols import Models


def test_what_is_named_is_ignored_and_its_masks_are_written(tmp_path):
    """Red and green discs before grey, of which the red ones go."""
    capture = small_capture()
    count = len(capture.names)
    frames = np.full((count, 60, 80, 3), 120, np.uint8)
    red = np.zeros((count, 60, 80), np.uint8)
    for t, frame in enumerate(frames[:-1]):
        cv2.circle(frame, (20 + 4 * t, 30), 9, (200, 20, 20), -1)
        cv2.circle(red[t], (20 + 4 * t, 30), 9, 1, -1)
        cv2.circle(frame, (60, 20), 9, (20, 150, 30), -1)
    files = tuple(ImageFile(f"{name}.png", 160, 120) for name in capture.names)
    capture = dataclasses.replace(capture, frames=frames, files=files)
    models = Models(ColourEmbedder(), ClassicalSegmenter())
    found = ignore_named(capture, ["red ball"], models, tmp_path / "masks", lambda done, total: None)
    assert found.ignored is not None
    both, either = (found.ignored & (red > 0)).sum(), (found.ignored | (red > 0)).sum()
    assert both / either > 0.85
    assert f"in {count - 1} of {count} frames" in found.notes[-1]
    none = ignore_named(capture, ["blue ball"], models, tmp_path / "none", lambda done, total: None)
    assert none.ignored is None or not none.ignored.any()
    for name, ignored in zip(capture.names, found.ignored):
        written = read_label_image(tmp_path / "masks" / f"{name}.png")
        np.testing.assert_array_equal(written[::2, ::2] == 0, ignored)
