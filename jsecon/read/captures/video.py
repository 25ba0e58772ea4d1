"""Frames of a video, on the host: the sharpest of each stretch of time, written as images."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from jsecon.errors import InputError
from jsecon.read.captures.images import write_image
from jsecon.types import Progress

DEFAULT_VIDEO_FRAMES = 150
"""frames taken by default: two or three rounds about a table top"""


def is_video(path: Path) -> bool:
    """Whether a path is a file with the suffix of a video."""
    suffixes = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".mts", ".3gp")
    return path.suffix.lower() in suffixes and path.is_file()


def write_frames(
    video: Path, folder: Path, *, frames: int | None = None, progress: Progress | None = None
) -> list[Path]:
    """Writes the sharpest frame of each stretch of a video as a JPEG, named by its number in the video.

    Sharpness is the variance of the Laplacian of the grey values (Pech-Pacheco et al., "Diatom autofocusing in
    brightfield microscopy", ICPR 2000). The video is decoded twice, a frame at a time. `frames` is the most to write.
    """
    sharpness = []
    for image, total in _decode(video):
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        shrink = min(1.0, 640 / max(grey.shape))  # at that size motion still blurs, and noise counts less
        small = cv2.resize(grey, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
        sharpness.append(cv2.Laplacian(small, cv2.CV_32F).var())
        if progress is not None:
            progress(min(len(sharpness), total), 2 * total)
    if not sharpness:
        remedy = "Copy it again, or convert it (ffmpeg -i VIDEO walk.mp4)."
        raise InputError(video, "OpenCV can read no frame of it", "a video", remedy)
    count = min(frames or DEFAULT_VIDEO_FRAMES, len(sharpness))
    edges = np.linspace(0, len(sharpness), count + 1).round().astype(int)
    chosen, written = {int(a + np.argmax(sharpness[a:b])) for a, b in itertools.pairwise(edges)}, []
    for number, (image, _) in enumerate(_decode(video)):
        if number in chosen:
            written.append(folder / f"frame_{number:06d}.jpg")
            write_image(written[-1], cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
        if progress is not None:
            progress(len(sharpness) + number + 1, 2 * len(sharpness))
    return written


def _decode(video: Path) -> Iterator[tuple[UInt8[np.ndarray, "h w 3"], int]]:
    """Yields each frame (BGR), with the number of frames by the video's header, at least 1."""
    # Other backends write errors to stderr; FFmpeg takes what stands before a colon for a protocol, but in a full path.
    reader = cv2.VideoCapture(os.path.abspath(video), cv2.CAP_FFMPEG)
    try:
        total = max(1, int(reader.get(cv2.CAP_PROP_FRAME_COUNT)))
        while True:
            read, image = reader.read()
            if not read:
                return
            yield image, total
    finally:
        reader.release()
