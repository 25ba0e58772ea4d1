"""The page of a field: it holds the field within its digits, and in a browser it does what a person would try."""

import base64
import dataclasses
import json
import re

import jax
import numpy as np
import pytest
from browser import CHROMIUM, WEBGL, dumped
from small_field import make_field

from jsecon.app.catalogue import main_regions
from jsecon.app.records import Answer, Query
from jsecon.app.viewer.static_page import NO_REGION, page
from jsecon.errors import InputError
from jsecon.field.membership import vote_shares
from jsecon.splat.sh import C0
from jsecon.types import Selection


@pytest.fixture(scope="module")
def made(scene, cameras):
    field, labels = make_field(scene, cameras)
    mask, none = main_regions(field) == 1, np.zeros(64, bool)
    share = mask.astype(np.float32)
    answers = [
        Answer(
            Query("the second </script>"), "votes", mask, Selection(mask, share, np.int32(1), np.float32(0.75)), field
        ),
        Answer(Query("nothing"), "votes", none, Selection(none, 0 * share, np.int32(-1), np.float32(0.01)), field),
    ]
    return field, answers, page(field, answers, title="A <room>"), labels


def read(text):
    told = json.loads(re.search(r'id="scene-data">(.*?)</script>', text, re.S).group(1))
    data = base64.b64decode(re.search(r'id="splats">(.*?)</script>', text, re.S).group(1))
    count, columns, at = told["count"], {}, 0
    for name, kind, width in (
        ("places", "<u2", 3), ("regions", "<u2", 1), ("turns", "i1", 4), ("sizes", "u1", 3), ("colours", "u1", 3),
        ("opacity", "u1", 1),
    ):  # fmt: skip
        size = count * width * np.dtype(kind).itemsize
        columns[name] = np.frombuffer(data[at : at + size], kind).reshape(count, width)
        at += size
    assert at == len(data) == 19 * count
    return told, columns


def test_a_page_holds_the_field_within_its_digits(made):
    field, answers, text, _ = made
    told, columns = read(text)
    assert told["count"] == 64
    places = np.array(told["low"]) + columns["places"] / 65535 * np.array(told["span"])
    np.testing.assert_allclose(places, field.gaussians.means, atol=max(told["span"]) / 65535)
    sizes = told["size_low"] + columns["sizes"] / 255 * told["size_span"]
    assert np.abs(sizes - np.asarray(field.gaussians.log_scales)).max() < 0.02 + told["size_span"] / 255
    turns = np.asarray(field.gaussians.quaternions)
    turns = turns / np.linalg.norm(turns, axis=1, keepdims=True)
    np.testing.assert_allclose(columns["turns"] / 127, turns, atol=0.01)
    colours = np.clip(0.5 + C0 * np.asarray(field.gaussians.sh)[:, 0], 0, 1)
    np.testing.assert_allclose(columns["colours"] / 255, colours, atol=0.003)
    regions = main_regions(field)
    np.testing.assert_array_equal(columns["regions"][:, 0], np.where(regions < 0, NO_REGION, regions))
    for answer, kept in zip(answers, told["texts"], strict=True):
        bits = np.unpackbits(np.frombuffer(base64.b64decode(kept["mask"]), np.uint8), bitorder="little")[:64]
        np.testing.assert_array_equal(bits, answer.mask)


def test_a_region_has_at_least_half_of_what_is_its(made):
    field = made[0]
    found, share = main_regions(field), np.asarray(vote_shares(field.votes))
    regions = np.asarray(field.votes.regions)
    for n, region in enumerate(found):
        own = share[n, regions[n] == region]
        assert (region == -1 and share[n].max() < 0.5) or own[0] >= 0.5


@pytest.mark.parametrize("count", [1, 5])
def test_coincident_gaussians_and_opposite_cameras_have_a_page(made, count):
    field = made[0]
    first = np.zeros(count, int)
    gaussians = dataclasses.replace(jax.tree.map(lambda a: np.asarray(a)[first], field.gaussians))
    votes = jax.tree.map(lambda a: np.asarray(a)[first] if np.shape(a)[:1] == (64,) else a, field.votes)
    upside_down = np.array(field.cameras.world_to_camera)
    upside_down[1::2, :2] *= -1  # rolled by half a turn
    cameras = dataclasses.replace(field.cameras, world_to_camera=upside_down)
    one = dataclasses.replace(field, gaussians=gaussians, votes=votes, cameras=cameras)
    scene, columns = read(page(one, [], title="one"))
    assert scene["count"] == count
    places = np.array(scene["low"]) + columns["places"] / 65535 * np.array(scene["span"])
    np.testing.assert_allclose(places, gaussians.means, atol=max(scene["span"]) / 65535)
    numbers = *scene["eye"], *scene["target"], *scene["up"], scene["size_low"], scene["size_span"]
    assert np.isfinite(numbers).all()
    assert np.linalg.norm(scene["up"]) == pytest.approx(1)


def test_a_field_without_a_visible_gaussian_has_no_page(made):
    field = made[0]
    invisible = dataclasses.replace(field.gaussians, opacity_logits=np.full(64, -50, np.float32))
    with pytest.raises(InputError, match="no visible Gaussian"):
        page(dataclasses.replace(field, gaussians=invisible), [], title="none")


def test_a_page_asks_for_nothing_from_outside_and_no_text_breaks_it(made):
    text = made[2]
    assert not re.search(r"https?://|src=|@import|url\(", text)
    assert text.count("</script>") == 3
    assert "A &lt;room&gt;" in text


PILOT = """
<script>
const sleep = ms => new Promise(done => setTimeout(done, ms)), found = {};
const pixels = () => { draw(); const p = new Uint8Array(4 * canvas.width * canvas.height);
  gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, p); return p; };
const apart = (a, b) => a.reduce((n, v, i) => n + (Math.abs(v - b[i]) > 8), 0) / a.length;
const send = (kind, x, y, more = {}) => canvas.dispatchEvent(new PointerEvent(kind,
  { clientX: x, clientY: y, pointerId: 1, bubbles: true, ...more }));
canvas.setPointerCapture = () => {};
(async () => {
  try {
    const words = () => document.getElementById("message").textContent;
    found.opened = words();
    if (chosen.kind !== "none") choose(chosen);
    const start = pixels();
    found.colours = new Set(Array.from({ length: start.length / 4 }, (_, i) => start[4 * i] >> 4)).size;
    const button = document.querySelector("#texts button");
    button.click(); found.text = words(); found.lit = apart(start, pixels()); found.pressed = button.ariaPressed;
    document.querySelectorAll("#texts button")[1].click(); found.nothing = words();
    document.querySelectorAll("#texts button")[1].click(); found.back = apart(start, pixels());
    send("pointerdown", 200, 150); send("pointermove", 260, 160, { buttons: 1 }); send("pointerup", 260, 160);
    found.turned = apart(start, pixels()); found.link = decodeURIComponent(location.hash);
    document.getElementById("home").click(); found.home = apart(start, pixels());
    for (const [x, y] of SPOTS) {
      send("pointerdown", x, y); send("pointerup", x, y);
      (found.clicks ||= []).push(words());
      if (chosen.kind !== "none") choose(chosen);
    }
    document.getElementById("regions").click(); found.byRegion = apart(start, pixels());
    found.requests = performance.getEntriesByType("resource").length;
  } catch (error) { found.error = String(error); }
  const out = document.createElement("pre"); out.id = "found"; out.textContent = JSON.stringify(found);
  document.body.append(out);
})();
</script></body>"""


def driven(text, spots, folder, link=""):
    """What a page says after a person's steps in headless Chromium."""
    file = folder / "page.html"
    file.write_text(text.replace("</body>", PILOT.replace("SPOTS", json.dumps(spots))))
    return dumped(f"file://{file}{link}", folder, *WEBGL, "--window-size=640,480", "--virtual-time-budget=20000")


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_in_a_browser_it_does_what_a_person_tries(made, tmp_path):
    _, answers, text, _ = made
    found = driven(text, [[320, 240], [2, 470]], tmp_path)
    assert "error" not in found, found
    assert found["opened"] == found["text"]  # the first text is lit from the start
    assert found["colours"] > 3  # the canvas is not blank
    assert found["text"] == f"the second </script>: {int(answers[0].mask.sum())} Gaussians, score 0.75."
    assert found["pressed"] == "true"
    assert found["lit"] > 0.02
    assert "no match" in found["nothing"]
    assert found["back"] == 0
    assert found["turned"] > 0.02
    assert '"yaw"' in found["link"]
    assert found["home"] == 0
    assert any(words.startswith("Region ") for words in found["clicks"]), found["clicks"]
    assert found["byRegion"] > 0.02
    assert found["requests"] == 0
    restored = driven(text, [], tmp_path, link=found["link"].replace(" ", "%20"))
    assert restored["turned"] > 0
