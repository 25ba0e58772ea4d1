"""Frames of a video: the sharpest of each stretch of time."""

import cv2
import numpy as np
import pytest

from jsecon.pipeline.options import Options
from jsecon.pipeline.results import RunContext
from jsecon.pipeline.scene import plan_capture
from jsecon.read.captures.video import write_frames
from jsecon.vision.colours import ColourEmbedder
from jsecon.vision.protocols import Models

SHARP = (2, 7, 12, 16, 20, 29)
"""of 30 frames, one in each stretch of five"""


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """30 frames of 128x96 that slide over noise, all but SHARP blurred."""
    path = tmp_path_factory.mktemp("video") / "walk.avi"
    wide = cv2.resize(np.random.default_rng(0).integers(0, 255, (24, 60, 3), np.uint8), (240, 96))
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (128, 96))
    assert writer.isOpened()
    for number in range(30):
        frame = np.ascontiguousarray(wide[:, 2 * number : 2 * number + 128])
        writer.write(frame if number in SHARP else cv2.GaussianBlur(frame, (0, 0), 2.5))
    writer.release()
    return path


def test_the_sharpest_frame_of_each_stretch_is_taken(video, tmp_path):
    told = []
    written = write_frames(video, tmp_path / "frames", frames=6, progress=lambda *at: told.append(at))
    assert [path.name for path in written] == [f"frame_{number:06d}.jpg" for number in SHARP]
    assert sorted((tmp_path / "frames").iterdir()) == written
    assert cv2.imread(str(written[0])).shape == (96, 128, 3)
    assert told[-1] == (60, 60)
    assert sorted(told) == told
    assert len(write_frames(video, tmp_path / "all")) == 30  # a short one gives each of its frames


def test_a_run_on_a_video_takes_as_many_frames_as_it_is_told(video, tmp_path):
    keys = []
    for frames in (None, 20, 30):
        work = RunContext(Options(video, frames=frames), Models(ColourEmbedder()), tmp_path)
        poses, load = plan_capture(work)
        assert f"the {frames or 150} sharpest frames of walk.avi" in poses.how
        assert load.after == ("poses",)
        keys.append(poses.key({}, work.out))
    assert len(set(keys)) == 3
