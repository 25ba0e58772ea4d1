"""The page and its pictures: self-contained, escaped, colours that stay the same from view to view."""

import base64
import re
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from jsecon.app import pictures, report
from jsecon.app.progress import Step


class _Reader(HTMLParser):
    VOID = ("meta", "img")

    def __init__(self):
        super().__init__()
        self.open, self.images, self.seen = [], [], []

    def handle_starttag(self, tag, attrs):
        self.seen.append(tag)
        if tag not in self.VOID:
            self.open.append(tag)
        if tag == "img":
            self.images.append(dict(attrs))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def _image(seed=0):
    return np.random.default_rng(seed).integers(0, 255, (24, 32, 3)).astype(np.uint8)


@pytest.fixture(scope="module")
def page():
    return report.page(
        "A <title> & more",
        "lead",
        [
            report.tiles({"mIoU": "0.712"}),
            report.section(
                "Frames", "words", report.grid([report.figure(_image(), "<b>x</b>", strong="IoU 0.5", sharp=True)], 2)
            ),
            report.section("Plan", "", report.steps([Step("photometric fit", "left out", "a .ply is given")])),
            report.section("Seconds", "", report.bars({"load": 1.0, "fit": 3.0})),
            report.table(["a", "b"], [[1, "<script>"]]),
            report.preformatted("{}"),
        ],
    )


def test_the_page_is_well_formed_and_holds_all_it_shows(page):
    reader = _Reader()
    reader.feed(page)
    assert reader.open == []
    assert not re.search(r"href|url\(|@import|https?:", re.sub(r"base64,[^\"]*", "", page))
    assert "script" not in reader.seen
    assert all(image["src"].startswith("data:image/") and image["alt"] for image in reader.images)


def test_words_from_outside_are_escaped(page):
    assert "A &lt;title&gt; &amp; more" in page
    assert "<script>" not in page
    assert "&lt;b&gt;x&lt;/b&gt;" in page


def test_the_page_is_legible_in_light_and_dark(page):
    assert "prefers-color-scheme: dark" in page
    assert "color-scheme: light dark" in page


@pytest.mark.parametrize("sharp", [True, False])
def test_pictures_inside_the_page_are_the_pictures_given(sharp):
    image = np.repeat(np.repeat(_image()[:6, :8], 8, 0), 8, 1)
    kind, data = report.data_uri(image, sharp=sharp).split(",")
    back = cv2.cvtColor(
        cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB
    )
    assert kind == ("data:image/png;base64" if sharp else "data:image/jpeg;base64")
    assert np.abs(back.astype(int) - image).mean() <= (0 if sharp else 25)


def test_bars_are_as_long_as_their_seconds():
    widths = [float(w) for w in re.findall(r"width:([\d.]+)%", report.bars({"a": 1.0, "b": 4.0, "c": 0.0}))]
    assert widths == [25.0, 100.0, 0.0]
    assert "5.0 s" in report.bars({"a": 1.0, "b": 4.0})
    assert "0.0 s" in report.bars({})


def test_a_regions_colour_does_not_depend_on_how_many_there_are():
    np.testing.assert_array_equal(pictures.palette(5), pictures.palette(40)[:5])
    few = pictures.palette(12).astype(float)
    apart = np.linalg.norm(few[:, None] - few[None], axis=-1) + 1e3 * np.eye(12)
    assert apart.min() > 30


def test_labels_are_drawn_in_their_colours_and_unlabelled_pixels_stay_grey():
    labels = np.full((24, 32), -1)
    labels[4:20, 4:20] = 3
    image = pictures.label_overlay(_image(), labels)
    inside, outside = image[8:16, 8:16].reshape(-1, 3).astype(float), image[:, 24:].reshape(-1, 3)
    assert (outside.max(1) == outside.min(1)).all()
    assert np.corrcoef(inside.mean(0), pictures.palette(4)[3])[0, 1] > 0.99


def test_a_selection_is_brighter_than_what_it_leaves_and_the_truth_is_outlined():
    mask, truth = np.zeros((24, 32), bool), np.zeros((24, 32), bool)
    mask[6:18, 6:18] = truth[6:18, 12:26] = True
    frame = np.full((24, 32, 3), 100, np.uint8)
    image = pictures.selection_overlay(frame, mask, truth)
    assert image[9, 9, 0] > image[2, 2, 0]
    assert (image.reshape(-1, 3) == pictures.TRUE).all(1).any()
    assert not (pictures.selection_overlay(frame, mask).reshape(-1, 3) == pictures.TRUE).all(1).any()
