"""Frames of a video: the sharpest of each stretch of time."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from jsecon.read.captures.video import write_frames

SHARP = (2, 7, 12, 16, 20, 29)
"""of 30 frames, one in each stretch of five"""


def written(path, code, frames):
    """A video of frames of 128x96."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), 10, (128, 96))
    assert writer.isOpened()
    for frame in frames:
        writer.write(frame)
    writer.release()
    return path


def test_the_sharpest_frame_of_each_stretch_is_taken(tmp_path):
    """Of a video that slides over noise, of which all but SHARP are blurred."""
    wide, told = cv2.resize(np.random.default_rng(0).integers(0, 255, (24, 60, 3), np.uint8), (240, 96)), []
    frames = (np.ascontiguousarray(wide[:, 2 * n : 2 * n + 128]) for n in range(30))
    blurred = (frame if n in SHARP else cv2.GaussianBlur(frame, (0, 0), 2.5) for n, frame in enumerate(frames))
    video = written(tmp_path / "walk.avi", "MJPG", blurred)
    found, notes = write_frames(video, tmp_path / "frames", 6, lambda *at: told.append(at))
    assert notes == ()
    assert [path.name for path in found] == [f"frame_{number:06d}.jpg" for number in SHARP]
    assert sorted((tmp_path / "frames").iterdir()) == found
    assert cv2.imread(str(found[0])).shape == (96, 128, 3)
    assert told[-1] == (60, 60)
    assert sorted(told) == told
    assert len(write_frames(video, tmp_path / "all", 150)[0]) == 30  # a short one gives each of its frames


def moving(path, code, count=30):
    """A video of noise that moves."""
    noise = np.random.default_rng(0).integers(0, 255, (count, 24, 32, 3), np.uint8)
    return written(path, code, (cv2.resize(frame, (128, 96)) for frame in noise))


@pytest.mark.parametrize(("name", "code"), [("a.mp4", "mp4v"), ("b.avi", "MJPG"), ("c.avi", "XVID")])
def test_a_damaged_stretch_does_not_end_a_video(tmp_path, name, code):
    path = moving(tmp_path / name, code)
    whole = len(write_frames(path, tmp_path / "whole", 150)[0])
    data = bytearray(path.read_bytes())
    start = len(data) // 2
    data[start : start + 3000] = bytes(3000)
    path.write_bytes(data)
    found, notes = write_frames(path, tmp_path / "frames", 150)
    assert 20 <= len(found) <= whole == 30
    assert found[-1].name >= "frame_000025.jpg"
    assert len(found) == 30 or f"{30 - len(found)} of 30 frames of {name} cannot be decoded" in notes[0]


@pytest.mark.parametrize("code", ["MJPG", "XVID"])
def test_a_video_that_is_cut_short_says_so(tmp_path, code):
    path = moving(tmp_path / "a.avi", code)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    found, notes = write_frames(path, tmp_path / "frames", 150)
    assert 8 <= len(found) <= 22
    assert f"{30 - len(found)} of 30 frames" in notes[0]
    assert "cut short" in notes[0]


@pytest.mark.parametrize("name", ["walk 12:30:15.avi", "http:walk.avi"])
def test_a_name_may_have_colons(tmp_path, monkeypatch, name):
    moving(tmp_path / "a.avi", "MJPG", 4).rename(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    assert len(write_frames(Path(name), tmp_path / "frames", 150)[0]) == 4


@pytest.mark.parametrize(("name", "mark"), [
    ("a.mp4", b"\0\0\0\x1bmoov\0\0\0\x13colrnclx\0\x09\0\x12\0\x09\0"), ("b.mkv", b"\x55\xb0\x84\x55\xba\x81\x10"),
])  # fmt: skip
def test_high_dynamic_range_is_noted(tmp_path, name, mark):
    path = moving(tmp_path / name, "mp4v", 4)
    assert write_frames(path, tmp_path / "frames", 150)[1] == ()
    path.write_bytes(path.read_bytes() + mark)
    assert "HDR" in write_frames(path, tmp_path / "frames", 150)[1][-1]
