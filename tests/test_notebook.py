"""What a notebook shows: pictures that hold what they say, drawn by nobody's import."""

import base64
import re

import cv2
import numpy as np
import pytest
from small_field import make_field

import jsecon
from jsecon.types import Capture


@pytest.fixture(scope="module")
def field(scene, cameras):
    return make_field(scene, cameras)[0]


def picture(page):
    data = re.search(r'src="data:image/jpeg;base64,([^"]+)"', page).group(1)
    return cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)


def test_a_field_shows_its_first_view_and_its_regions(field):
    page = field._repr_html_()
    assert "LanguageField of 64 Gaussians, 5 regions and 4 frames, texts by random" in page
    assert picture(page).shape == (40, 96, 3)
    image = picture(page)
    assert image[:, :48].std() > 3
    assert np.abs(image[:, :48].astype(int) - image[:, 48:]).mean() > 3  # colours and regions are not the same picture


def test_a_capture_shows_a_few_small_frames(cameras):
    draw = np.random.default_rng(0)
    frames = draw.integers(0, 255, (4, 400, 480, 3)).astype(np.uint8)
    cameras = jsecon.Camera(cameras.world_to_camera, cameras.fx, cameras.fy, cameras.cx, cameras.cy, 480, 400)
    empty = np.zeros((0, 3), np.float32)
    capture = Capture(frames, cameras, empty, empty.astype(np.uint8), np.eye(4)[0] > 0, None, np.eye(4), tuple("abcd"))
    page = capture._repr_html_()
    assert "Capture of 4 frames of 480x400, 1 held out, 0 sparse points<" in page
    assert picture(page).shape == (200, 4 * 240, 3)
    assert len(page) < 300_000
