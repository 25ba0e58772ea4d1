"""The page and its pictures: self-contained, escaped, colours that stay the same from view to view."""

import base64
import html
import re
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
from browser import CHROMIUM, driven

from jsecon.app import report
from jsecon.app.exports import crop


class _Reader(HTMLParser):
    VOID = ("meta", "img", "input", "br")

    def __init__(self):
        super().__init__()
        self.open, self.images = [], []

    def handle_starttag(self, tag, attrs):
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
    figures = report.grid([report.figure(_image(), "<b>x</b>", strong="<i>mug</i>", sharp=True)], 2)
    view = report.grid([report.figure(_image(), "view")], 3)
    cards = report.grid(report.card(_image(), name, "words", view) for name in ("red <mug>", "blue mug"))
    return report.page("A <title> & more", "lead", [report.section("<b>fit</b>", "<script>", figures), cards])


def picture(page, kind):
    data = re.search(rf'src="data:image/{kind};base64,([^"]+)"', page).group(1)
    return cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)


def test_the_page_is_well_formed_and_holds_all_it_shows_and_words_from_outside_are_escaped(page):
    reader = _Reader()
    reader.feed(page)
    assert reader.open == []
    assert not re.search(r"href|url\(|@import|https?:", re.sub(r"base64,[^\"]*", "", page))
    assert all(image["src"].startswith("data:image/") and image["alt"] for image in reader.images)
    assert page.count("<script>") == 1
    for text in ("A <title> & more", "<script>", "red <mug>", "<i>mug</i>", "<b>fit</b>", "<b>x</b>"):
        assert html.escape(text) in page
    np.testing.assert_array_equal(picture(page, "png")[..., ::-1], _image())  # a sharp one is the image given


PILOT = """
const side = selector => document.querySelector(selector).getBoundingClientRect();
const wait = ms => new Promise(done => setTimeout(done, ms));
await wait(100);
document.querySelector(".grid figure > img").click();
found.enlarged = [large.open, large.firstChild.src === document.querySelector(".grid figure > img").src];
large.firstChild.click(); found.closed = large.open;
document.querySelectorAll(".card")[1].querySelector("summary").click(); await wait(50);
found.opened = side(".card[open] .grid").height > 0;
found.overflow = document.documentElement.scrollWidth - document.documentElement.clientWidth;
found.requests = performance.getEntriesByType("resource").filter(e => !e.name.startsWith("data:")).length;
"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_in_a_browser_pictures_are_enlarged_and_cards_open(page, tmp_path):
    found = driven(page, PILOT, tmp_path, width=500, height=800)
    assert found["enlarged"] == [True, True]
    assert found["closed"] is False
    assert found["opened"]
    assert found["overflow"] <= 0  # nothing makes a narrow page scroll sideways
    assert found["requests"] == 0


def test_a_picture_is_cut_to_a_mask():
    np.testing.assert_array_equal(crop(_image(), np.zeros((24, 32), bool)), _image())
    mask = np.zeros((240, 320), bool)
    mask[100:150, 200:220] = True
    rows, columns = np.mgrid[:240, :320]
    part = crop(np.stack([rows, columns, mask], axis=-1).astype(np.uint8), mask)
    assert part[..., 2].sum() == mask.sum()
    assert part[..., 2].mean() > 0.15
