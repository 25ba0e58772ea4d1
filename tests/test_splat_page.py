"""The page of a field as a file: it holds the field within its digits, and in a browser it does what a person tries."""

import base64
import dataclasses
import json
import re

import jax
import numpy as np
import pytest
from browser import CHROMIUM, driven
from small_field import answer_of, make_field

from jsecon import region_at
from jsecon.app.catalogue import main_regions
from jsecon.app.viewer.page import NO_REGION, field_page
from jsecon.errors import InputError
from jsecon.splat.sh import C0
from jsecon.types import Gaussians

TREE = np.array([5, 5, -1, 6, 6, -1, -1])
"""parents of the five regions, of which 0 and 1 belong to 5, and 3 and 4 to 6"""


@pytest.fixture(scope="module")
def made(scene, cameras):
    field = dataclasses.replace(make_field(scene, cameras)[0], tree=TREE, metres_per_unit=2.0)
    mask = main_regions(field) == 1
    first = answer_of(field, "the second </script>", mask, region=1, score=0.75)
    answers = [first, answer_of(field, "nothing", 0 * mask, region=-1, score=0.01)]
    return field, answers, field_page(field, {str(answer.query): answer for answer in answers}, title="A <room>")


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


def with_gaussians(field, **changes):
    return dataclasses.replace(field, gaussians=dataclasses.replace(field.gaussians, **changes))


@pytest.mark.parametrize("size", [1e-4, 1, 300])
def test_a_page_holds_the_field_within_its_digits_at_any_size(made, size):
    field, answers, _ = made
    means = np.asarray(field.gaussians.means) * np.float32(size)
    logs = np.asarray(field.gaussians.log_scales) + np.float32(np.log(size))
    field = with_gaussians(field, means=means, log_scales=logs)
    told, columns = read(field_page(field, {str(answer.query): answer for answer in answers}, title="room"))
    places = np.array(told["low"]) + columns["places"] / 65535 * np.array(told["span"])
    np.testing.assert_allclose(places, means, atol=max(told["span"]) / 65535)
    sizes = told["size_low"] + columns["sizes"] / 255 * told["size_span"]
    assert np.abs(sizes - logs).max() < 0.02 + told["size_span"] / 255
    turns = np.asarray(field.gaussians.quaternions)
    turns = turns / np.linalg.norm(turns, axis=1, keepdims=True)
    np.testing.assert_allclose(columns["turns"] / 127, turns, atol=0.01)
    colours = np.clip(0.5 + C0 * np.asarray(field.gaussians.sh)[:, 0], 0, 1)
    np.testing.assert_allclose(columns["colours"] / 255, colours, atol=0.003)
    regions = main_regions(field)
    np.testing.assert_array_equal(columns["regions"][:, 0], np.where(regions < 0, NO_REGION, regions))
    for answer, (text, kept) in zip(answers, told["texts"].items(), strict=True):
        bits = np.unpackbits(np.frombuffer(base64.b64decode(kept["mask"]), np.uint8), bitorder="little")[:64]
        np.testing.assert_array_equal(bits, answer.mask)
        assert (text, kept["words"]) == (str(answer.query), answer.describe())


@pytest.mark.parametrize("count", [1, 5])
def test_coincident_gaussians_and_opposite_cameras_have_a_page(made, count):
    field, first = made[0], np.zeros(count, int)
    gaussians = jax.tree.map(lambda a: np.asarray(a)[first], field.gaussians)
    votes = jax.tree.map(lambda a: np.asarray(a)[first] if np.shape(a)[:1] == (64,) else a, field.votes)
    upside_down = np.array(field.cameras.world_to_camera)
    upside_down[1::2, :2] *= -1  # rolled by half a turn
    cameras = dataclasses.replace(field.cameras, world_to_camera=upside_down)
    one = dataclasses.replace(field, gaussians=gaussians, votes=votes, cameras=cameras)
    scene, columns = read(field_page(one, {}, title="one"))
    places = np.array(scene["low"]) + columns["places"] / 65535 * np.array(scene["span"])
    np.testing.assert_allclose(places, gaussians.means, atol=max(scene["span"]) / 65535)
    assert np.isfinite([scene["size_low"], scene["size_span"]]).all()
    assert np.linalg.norm(scene["up"]) == pytest.approx(1)


def test_what_is_huge_or_not_finite_is_left_out_and_without_a_visible_gaussian_there_is_no_page(made):
    logs, means = (np.array(getattr(made[0].gaussians, name)) for name in ("log_scales", "means"))
    logs[0], logs[1], means[3] = 20, -40, np.nan
    told, _ = read(field_page(with_gaussians(made[0], log_scales=logs, means=means), {}, title="odd"))
    assert told["count"] == 62
    with pytest.raises(InputError, match="no visible Gaussian"):
        field_page(with_gaussians(made[0], opacity_logits=np.full(64, -50, np.float32)), {}, title="none")


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
const press = async (x, y, more) => {
  send("pointerdown", x, y, more); send("pointerup", x, y, more); await 0; await 0; };
canvas.setPointerCapture = () => {};
const words = () => element("answers").textContent;
const chips = () => element("texts").children;
found.opened = words(); found.pressed = chips()[0].ariaPressed;
const lit = pixels();
await select([]);
const start = pixels();
found.colours = new Set(Array.from({ length: start.length / 4 }, (_, i) => start[4 * i] >> 4)).size;
found.lit = apart(start, lit);
await chips()[0].onclick(); found.text = words(); found.again = apart(lit, pixels());
element("only").click(); found.only = apart(lit, pixels()); element("only").click();
await chips()[0].onclick(); await chips()[1].onclick(); found.nothing = words();
await select([]); found.back = apart(start, pixels());
send("pointerdown", 200, 150); send("pointermove", 260, 160, { buttons: 1 }); send("pointerup", 260, 160);
found.turned = apart(start, pixels()); found.link = decodeURIComponent(location.hash);
element("home").click(); found.home = apart(start, pixels());
element("frame").value = "1"; element("frame").onchange({ target: element("frame") });
found.frame = apart(start, pixels());
element("home").click();
const at = (x, y) => [focal() / scene.focals[0] * (x + 0.5 - scene.size[0] / 2) + canvas.width / 2,
  focal() / scene.focals[0] * (y + 0.5 - scene.size[1] / 2) + canvas.height / 2];
found.picked = PIXELS.map(([x, y]) => pick(...at(x, y)).region);
found.clicks = [];
const spot = PIXELS[found.picked.indexOf(0)];
for (let k = 0; k < 3; k++) { await press(...at(...spot)); found.clicks.push([...asked]); }
await press(...at(...spot)); await press(...at(...PIXELS.find((_, k) => found.picked[k] === 4)), { shiftKey: true });
found.both = [...asked];
await press(2, canvas.height - 2); found.background = [...asked];
element("regions").click(); found.byRegion = apart(start, pixels()); element("regions").click();
element("measure").click(); await press(...at(24, 20)); await press(...at(18, 28));
found.ends = [pick(...at(24, 20)).point, pick(...at(18, 28)).point];
draw(); found.length = element("lengths").textContent; found.told = words();
await press(2, canvas.height - 2); found.nowhere = words();
found.hidden = ["find", "share", "export"].every(id => element(id).hidden);
found.requests = performance.getEntriesByType("resource").length;
"""
PIXELS = [(x, y) for x in range(14, 36, 3) for y in range(10, 34, 3)]


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_in_a_browser_it_does_what_a_person_tries(made, tmp_path):
    field, answers, text = made
    found = driven(text, PILOT.replace("PIXELS", json.dumps(PIXELS)), tmp_path, width=800, height=600)
    assert found["colours"] > 3  # the canvas is not blank
    assert found["opened"].startswith(f"the second </script>: {answers[0].describe()}")  # lit from the start
    assert found["pressed"] == "true"
    assert found["text"] == f"the second </script>: {answers[0].describe()}"
    assert found["lit"] > 0.02
    assert found["again"] == 0
    assert found["only"] > 0.02
    assert "no Gaussian is selected" in found["nothing"]
    assert found["back"] == 0
    assert found["turned"] > 0.02
    assert '"yaw"' in found["link"]
    assert found["home"] == 0
    assert found["frame"] > 0.02
    assert found["clicks"] == [[0], [5], []]
    assert found["both"] == [0, 4]
    assert found["background"] == []
    assert found["byRegion"] > 0.02
    length = 2 * np.linalg.norm(np.subtract(*found["ends"]))
    assert found["length"] == f"{length:.4g} m" == found["told"].partition(" m")[0] + " m"
    assert "Nothing is there" in found["nowhere"]
    assert found["hidden"]
    assert found["requests"] == 0
    agree = [region == region_at(field, 0, *pixel) for region, pixel in zip(found["picked"], PIXELS)]
    assert sum(agree) >= 0.75 * len(agree), agree  # the page has one region of each Gaussian


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_a_pixel_is_as_deep_as_half_of_what_it_shows(made, tmp_path):
    """One opaque Gaussian, and others before it, of which the page hides what is not selected."""
    field = made[0]
    opacities, means = np.array([0.95, 0.2, 0.8], np.float32), np.array([[0, 0, 4], [0, 0, 2], [1, 0, 2]], np.float32)
    logits = np.log(opacities / (1 - opacities))
    turns = np.array([[1, 0, 0, 0]] * 3, np.float32)
    sh = np.asarray(field.gaussians.sh)[:3]
    votes = jax.tree.map(lambda a: np.asarray(a)[:3] if np.shape(a)[:1] == (64,) else a, field.votes)
    cameras = dataclasses.replace(field.cameras, world_to_camera=np.tile(np.eye(4, dtype=np.float32), (4, 1, 1)))
    few = Gaussians(means, np.full((3, 3), -2, np.float32), turns, logits, sh)
    field = dataclasses.replace(field, gaussians=few, votes=votes, cameras=cameras, tree=None)
    script = """frameView(0); const right = view.focal * canvas.height / scene.size[1] / 2;
    found.depths = [0, right, -right].map(x => pick(canvas.width / 2 + x, canvas.height / 2).point?.[2]);
    answers.set("faint", { words: "", bits: new Uint8Array([2]) });
    await select(["faint"]); shown.only = true; found.alone = pick(canvas.width / 2, canvas.height / 2).point[2];"""
    found = driven(field_page(field, {}, title="three"), script, tmp_path, width=800, height=600)
    assert found["depths"] == [pytest.approx(4, rel=1e-3), pytest.approx(2, rel=1e-3), None]
    assert found["alone"] == pytest.approx(2, rel=1e-3)
