"""Frames of a video, on the host: the sharpest of each stretch of time, written as images."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from jsecon.files import reading
from jsecon.read.captures.images import write_image
from jsecon.types import Progress

_MARK = re.compile(rb"ProjectionType\s*(?:=\s*[\"']|>)\s*equirectangular|sv3d.{0,200}?equi", re.DOTALL)
"""of a panorama: of XMP (GPano), and of Google's spherical video, versions 1 and 2"""
DEFAULT_VIDEO_FRAMES = 150
"""frames taken by default: two or three rounds about a table top"""
_COUNTED = (".mp4", ".mov", ".m4v", ".avi", ".3gp")
"""containers whose headers count frames; others have a duration, of which the count is an estimate"""


def is_video(path: Path) -> bool:
    """Whether a path is a file with the suffix of a video."""
    suffixes = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".mts", ".3gp")
    return path.suffix.lower() in suffixes and path.is_file()


def write_frames(
    video: Path, folder: Path, frames: int, progress: Progress = lambda done, total: None
) -> tuple[list[Path], tuple[str, ...]]:
    """Writes the sharpest frame of each stretch of a video as a JPEG, named by its number in the video; adds notes.

    Frames that cannot be decoded are passed over and counted. Sharpness is the variance of the Laplacian of the grey
    values (Pech-Pacheco et al., "Diatom autofocusing in brightfield microscopy", ICPR 2000). The video is decoded
    twice, a frame at a time. `frames` is the most to write.
    """
    sharpness: dict[int, float] = {}
    total = 1
    for number, image, total in _decode(video):
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        shrink = min(1.0, 640 / max(grey.shape))  # at that size motion still blurs, and noise counts less
        small = cv2.resize(grey, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
        sharpness[number] = float(cv2.Laplacian(small, cv2.CV_32F).var())
        progress(min(number + 1, total), 2 * total)
    if not sharpness:
        with reading(video, remedy="Copy it again, or convert it (ffmpeg -i VIDEO walk.mp4)."):
            raise ValueError("OpenCV can read no frame of it")
    numbers, values = np.array([*sharpness]), np.array([*sharpness.values()])
    end = int(numbers[-1]) + 1
    edges = np.linspace(0, end, min(frames, end) + 1).round().astype(int)
    places = np.searchsorted(numbers, edges)
    chosen = {int(numbers[a + np.argmax(values[a:b])]) for a, b in itertools.pairwise(places) if b > a}
    written = []
    for number, image, _ in _decode(video):
        if number in chosen:
            written.append(folder / f"frame_{number:06d}.jpg")
            write_image(written[-1], cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
        progress(end + number + 1, 2 * end)
    return written, (*_missing_notes(video, len(numbers), end, total), *_colour_notes(video))


def _missing_notes(video: Path, count: int, end: int, total: int) -> tuple[str, ...]:
    """Says how many of `total` frames by the header cannot be decoded, `end` is the number behind the last of them."""
    is_cut = total - end > (0 if video.suffix.lower() in _COUNTED else max(2, total // 50))
    failed = (total if is_cut else end) - count
    place = f", {total - end} of them at its end: it may be cut short" if is_cut else ""
    note = f"{failed} of {count + failed} frames of {video.name} cannot be decoded{place}."
    return (f"{note} The others are used; copy the video again to have all.",) if failed else ()


def has_panorama_mark(path: Path) -> bool:
    """Whether an image or a video says that it is equirectangular."""
    return _MARK.search(_read_header(path)) is not None


def _read_header(video: Path) -> bytes:
    """The first and the last bytes of a video or an image: what describes it lies before or behind the pixels."""
    with video.open("rb") as file:
        head = file.read(1 << 18)
        file.seek(max(len(head), os.path.getsize(video) - (1 << 24)))
        return head + file.read()


def _colour_notes(video: Path) -> tuple[str, ...]:
    """Says that colours are off if a video is HDR, which OpenCV decodes as if it were not."""
    # Of ISO/IEC 23091-2's transfer characteristics, 16 is PQ (HDR10, Dolby Vision) and 18 is HLG.
    header = _read_header(video)
    boxes, matroska = rb"colr(?:nclx|nclc)..\0[\x10\x12]", rb"\x55\xba\x81[\x10\x12]"
    if not re.search(boxes, header, re.DOTALL) and not re.search(matroska, header[: 1 << 16]):
        return ()
    sdr = "zscale=t=linear:npl=100,tonemap=hable,zscale=p=bt709:t=bt709:m=bt709,format=yuv420p"
    remedy = f"Convert it first: ffmpeg -i {video.name} -vf {sdr} walk.mp4"
    return (f"{video.name} is an HDR video, which is decoded without tone mapping: colours are off. {remedy}",)


def _decode(video: Path) -> Iterator[tuple[int, UInt8[np.ndarray, "h w 3"], int]]:
    """Yields each frame that can be decoded: its number, BGR, and the number of frames by the header, at least 1."""
    # Other backends write errors to stderr; FFmpeg takes what stands before a colon for a protocol, but in a full path.
    reader = cv2.VideoCapture(os.path.abspath(video), cv2.CAP_FFMPEG)
    try:
        total = max(1, int(reader.get(cv2.CAP_PROP_FRAME_COUNT)))
        number = failures = 0
        while failures == 0 or (number < total and failures < 1000):  # a header may promise any number
            read, image = reader.read()
            failures = 0 if read else failures + 1
            if read:
                yield number, image, total
            number += 1
    finally:
        reader.release()
