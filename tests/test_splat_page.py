"""The page of a field: it holds the field within its digits, and in a browser it does what a person would try."""

import base64
import dataclasses
import json
import re

import jax
import numpy as np
import pytest
from browser import CHROMIUM, driven
from small_field import answer_of, make_field

from jsecon.app.catalogue import main_regions
from jsecon.app.viewer.static_page import NO_REGION, page
from jsecon.errors import InputError
from jsecon.splat.sh import C0


@pytest.fixture(scope="module")
def made(scene, cameras):
    field, mask = make_field(scene, cameras)[0], main_regions(make_field(scene, cameras)[0]) == 1
    first = answer_of(field, "the second </script>", mask, region=1, score=0.75)
    answers = [first, answer_of(field, "nothing", 0 * mask, region=-1, score=0.01)]
    return field, answers, page(field, answers, title="A <room>")


def read(text):
    told = json.loads(re.search(r'id="scene-data">(.*?)</script>', text, re.S).group(1))
    data = base64.b64decode(re.search(r'id="splats">(.*?)</script>', text, re.S).group(1))
    columns, at = {}, 0
    for name, kind, width in (
        ("places", "<u2", 3), ("regions", "<u2", 1), ("turns", "i1", 4), ("sizes", "u1", 3), ("colours", "u1", 3),
        ("opacity", "u1", 1),
    ):  # fmt: skip
        columns[name] = np.frombuffer(data, kind, told["count"] * width, at).reshape(-1, width)
        at += columns[name].nbytes
    assert at == len(data)
    return told, columns


def test_a_page_holds_the_field_within_its_digits(made):
    field, answers, text = made
    told, columns = read(text)
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


def test_coincident_gaussians_and_opposite_cameras_have_a_page(made):
    field, first = made[0], np.zeros(5, int)
    gaussians = jax.tree.map(lambda a: np.asarray(a)[first], field.gaussians)
    votes = jax.tree.map(lambda a: np.asarray(a)[first] if np.shape(a)[:1] == (64,) else a, field.votes)
    upside_down = np.array(field.cameras.world_to_camera)
    upside_down[1::2, :2] *= -1  # rolled by half a turn
    cameras = dataclasses.replace(field.cameras, world_to_camera=upside_down)
    one = dataclasses.replace(field, gaussians=gaussians, votes=votes, cameras=cameras)
    scene, columns = read(page(one, [], title="one"))
    places = np.array(scene["low"]) + columns["places"] / 65535 * np.array(scene["span"])
    np.testing.assert_allclose(places, gaussians.means, atol=max(scene["span"]) / 65535)
    assert np.isfinite([*scene["eye"], *scene["target"], scene["size_low"], scene["size_span"]]).all()
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
const pixels = () => { draw(); const p = new Uint8Array(4 * canvas.width * canvas.height);
  gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, p); return p; };
const apart = (a, b) => a.reduce((n, v, i) => n + (Math.abs(v - b[i]) > 8), 0) / a.length;
const send = (kind, x, y, more = {}) => canvas.dispatchEvent(new PointerEvent(kind,
  { clientX: x, clientY: y, pointerId: 1, bubbles: true, ...more }));
canvas.setPointerCapture = () => {};
const words = () => document.getElementById("message").textContent;
found.opened = words();
if (chosen.kind !== "none") choose(chosen);
const start = pixels(), [button, none] = document.querySelectorAll("#texts button");
found.colours = new Set(Array.from({ length: start.length / 4 }, (_, i) => start[4 * i] >> 4)).size;
button.click(); found.text = words(); found.lit = apart(start, pixels()); found.pressed = button.ariaPressed;
none.click(); found.nothing = words(); none.click(); found.back = apart(start, pixels());
send("pointerdown", 200, 150); send("pointermove", 260, 160, { buttons: 1 }); send("pointerup", 260, 160);
found.turned = apart(start, pixels()); found.link = decodeURIComponent(location.hash);
document.getElementById("home").click(); found.home = apart(start, pixels());
found.clicks = [];
for (const [x, y] of [[320, 240], [2, 470]]) {
  send("pointerdown", x, y); send("pointerup", x, y); found.clicks.push(words());
  if (chosen.kind !== "none") choose(chosen);
}
document.getElementById("regions").click(); found.byRegion = apart(start, pixels());
found.requests = performance.getEntriesByType("resource").length;
"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_in_a_browser_it_does_what_a_person_tries(made, tmp_path):
    _, answers, text = made
    found = driven(text, PILOT, tmp_path, width=640, height=480)
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
