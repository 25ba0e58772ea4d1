"""The page and its pictures: self-contained, escaped, colours that stay the same from view to view."""

import base64
import re
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
from browser import CHROMIUM, dumped

from jsecon.app import pictures, report


class _Reader(HTMLParser):
    VOID = ("meta", "img", "input", "br")

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
            report.section(
                "Frames",
                "words",
                report.grid([report.figure(_image(), "<b>x</b>", strong="<i>mug</i>", sharp=True)], 2),
            ),
            report.grid(
                report.card(_image(), name, "words", report.grid([report.figure(_image(), "view")], 3))
                for name in ("red <mug>", "blue mug")
            ),
            report.table(["a", "<b>fit</b>"], [[1, "<script>"]]),
        ],
    )


def test_the_page_is_well_formed_and_holds_all_it_shows(page):
    reader = _Reader()
    reader.feed(page)
    assert reader.open == []
    assert not re.search(r"href|url\(|@import|https?:", re.sub(r"base64,[^\"]*", "", page))
    assert reader.seen.count("script") == 1
    assert all(image["src"].startswith("data:image/") and image["alt"] for image in reader.images)


def test_words_from_outside_are_escaped(page):
    assert "A &lt;title&gt; &amp; more" in page
    assert page.count("<script>") == 1
    assert "&lt;script&gt;" in page
    assert "red &lt;mug&gt;" in page
    assert "&lt;i&gt;mug&lt;/i&gt;" in page
    assert "&lt;b&gt;fit&lt;/b&gt;" in page
    assert "&lt;b&gt;x&lt;/b&gt;" in page


@pytest.mark.parametrize("sharp", [True, False])
def test_pictures_inside_the_page_are_the_pictures_given(sharp):
    image = np.repeat(np.repeat(_image()[:6, :8], 8, 0), 8, 1)
    kind, data = report._data_uri(image, sharp=sharp).split(",")
    back = cv2.cvtColor(
        cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB
    )
    assert kind == ("data:image/png;base64" if sharp else "data:image/jpeg;base64")
    assert np.abs(back.astype(int) - image).mean() <= (0 if sharp else 25)


PILOT = """
<script>
const found = {};
const side = selector => document.querySelector(selector).getBoundingClientRect();
const wait = ms => new Promise(done => setTimeout(done, ms));
(async () => {
  await wait(100);
  document.querySelector(".grid figure > img").click();
  found.enlarged = [large.open, large.firstChild.src === document.querySelector(".grid figure > img").src];
  large.firstChild.click(); found.closed = large.open;
  document.querySelectorAll(".card")[1].querySelector("summary").click(); await wait(50);
  found.opened = side(".card[open] .grid").height > 0;
  found.overflow = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  found.requests = performance.getEntriesByType("resource").filter(e => !e.name.startsWith("data:")).length;
  const out = document.createElement("pre"); out.id = "found"; out.textContent = JSON.stringify(found);
  document.body.append(out);
})();
</script></body>"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_in_a_browser_pictures_are_enlarged_and_cards_open(page, tmp_path):
    file = tmp_path / "page.html"
    file.write_text(page.replace("</body>", PILOT))
    found = dumped(f"file://{file}", tmp_path, "--window-size=500,800", "--virtual-time-budget=5000")
    assert found["enlarged"] == [True, True]
    assert found["closed"] is False
    assert found["opened"]
    assert found["overflow"] <= 0  # nothing makes a narrow page scroll sideways
    assert found["requests"] == 0


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
    assert (image.reshape(-1, 3) == 255).all(1).any()
    assert not (pictures.selection_overlay(frame, mask).reshape(-1, 3) == 255).all(1).any()


def test_a_picture_is_cut_to_a_mask():
    image, mask = _image(), np.zeros((24, 32), bool)
    np.testing.assert_array_equal(pictures.crop(image, mask), image)
    mask[10:13, 2:4] = True
    part = pictures.crop(image, mask)
    np.testing.assert_array_equal(part, image[: part.shape[0], : part.shape[1]])
    assert part.shape[1] < 32
    mask = np.zeros((240, 320), bool)
    mask[100:150, 200:220] = True
    rows, columns = np.mgrid[:240, :320]
    part = pictures.crop(np.stack([rows, columns, mask], axis=-1).astype(np.uint8), mask)
    assert part[..., 2].sum() == mask.sum()
    assert part[..., 2].mean() > 0.15
