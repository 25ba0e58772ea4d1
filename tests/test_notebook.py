"""What a notebook shows: pictures that hold what they say, drawn by nobody's import; and `show`."""

import base64
import re
import sys

import cv2
import numpy as np
import pytest
from small_field import KnownTexts, make_field

import jsecon
from jsecon.app import notebook
from jsecon.types import Capture, Selection


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
    png = cv2.imdecode(np.frombuffer(field._repr_png_(), np.uint8), cv2.IMREAD_COLOR)
    assert png.shape == (40, 96, 3)
    assert png[:, :48].std() > 3
    assert np.abs(png[:, :48].astype(int) - png[:, 48:]).mean() > 3  # colours and regions are not the same picture


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


def test_a_selection_shows_how_far_the_selected_are_from_the_others():
    similarity = np.concatenate([np.full(900, 0.1), np.full(100, 0.9)]).astype(np.float32)
    selection = Selection(similarity > 0.5, similarity, np.int32(3), np.float32(0.42))
    page = selection._repr_html_()
    assert "Selection of 100 of 1,000 Gaussians, score 0.420, region 3" in page
    image = cv2.imdecode(np.frombuffer(selection._repr_png_(), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    pink = (image == notebook.pictures.SELECTED).all(-1)
    grey = (image == 190).all(-1)
    assert pink.any()
    assert np.flatnonzero(pink.any(0)).min() > np.flatnonzero(grey.any(0)).max()
    empty = Selection(np.zeros(0, bool), np.zeros(0, np.float32), np.int32(-1), np.float32(0))
    assert "Selection of 0 of 0" in empty._repr_html_()


def test_show_draws_each_frame_and_what_is_selected_in_it(field, monkeypatch):
    pytest.importorskip("matplotlib").use("Agg")
    known = KnownTexts({"the first": np.asarray(field.regions.embeddings)[0]})
    scene = jsecon.Scene(field, known)
    axes = jsecon.show(scene, "the first", views=2)
    assert axes.shape == (2, 2)
    above, below = (axis.images[0].get_array() for axis in axes[:, 0])
    assert above.shape == below.shape == (40, 48, 3)
    assert (above != below).any()
    assert axes[0, 0].get_title() in field.names
    assert re.match(r"the first: \d+ Gaussians, score [01]\.\d\d", axes[0, 0].figure.get_suptitle())
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(jsecon.InputError, match=r"pip install 'jsecon\[figures\]'"):
        jsecon.show(scene, "the first")
