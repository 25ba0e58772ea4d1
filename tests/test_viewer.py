"""The viewer: its states and colours, what its steps do to a field, and in a browser what a person would try."""

import csv
import dataclasses
import http.client
import sys
from types import SimpleNamespace

import cv2
import jax
import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra viewer is not installed")
import viser
from browser import CHROMIUM, opened, until
from small_field import answer_of, colour_field

from jsecon import Camera, Gaussians, InputError, load_gaussians, region_at
from jsecon.app.catalogue import main_regions
from jsecon.app.pictures import palette
from jsecon.app.records import Query, Region
from jsecon.app.scene import Scene
from jsecon.app.viewer.layer import MAX_STD, SplatLayer
from jsecon.app.viewer.window import (
    ANSWER_HUE,
    RAY_VIEW_SIDE,
    Viewer,
    ViewState,
    _highlight,
    _region_along,
    _view_along,
    open_viewer,
)
from jsecon.query.pointing import depth_seen, region_shares_seen
from jsecon.query.render import hide
from jsecon.vision.colours import BASIC, ColourEmbedder

MUG = ViewState(("red mug",))


def test_clicks_and_texts_change_the_questions_and_the_controls_their_options():
    state = MUG.with_click([Region(3)])
    assert state.questions == (Region(3),)
    assert state.with_click([Region(3)]).questions == ()
    assert MUG.with_click([Region(3)], add=True).questions == ("red mug", Region(3))
    assert state.with_click([Region(4)], add=True).with_click([Region(3)], add=True).questions == (Region(4),)
    above = [Region(3), Region(9)]  # the second has the first under it
    wider = state.with_click(above, add=True)
    assert wider.questions == (Region(9),)
    assert wider.with_click([Region(2), Region(9)], add=True).questions == ()
    assert state.with_question("red mug", add=True).with_click(above).questions == (Region(9),)
    assert ViewState().with_question("mug; bowl").queries == (Query("mug; bowl", threshold=0.5),)
    assert MUG.with_question("bowl", add=True).with_question("red mug", add=True).questions == ("bowl", "red mug")
    assert MUG.with_question("  ").questions == ()
    changed = dataclasses.replace(MUG, threshold=0.7, all_of_class=True)
    assert changed.queries == (Query("red mug", threshold=0.7, all_of_class=True),)


def test_a_gaussian_of_two_answers_has_the_colour_of_the_better_one(field):
    base = np.array([[200, 100, 0]] * 4, np.uint8)
    failed = InputError("query", "no words")
    assert _highlight(base, [failed, answer_of(field, "mug", [0, 0, 0, 0])]) is base
    first = answer_of(field, "mug", [1, 1, 0, 0], [0.9, 0.6, 0.1, 0])
    second = answer_of(field, "mug", [0, 1, 1, 0], [0, 0.8, np.nan, 0])
    colours = _highlight(base, [first, failed, second]).astype(int)
    tinted = (0.45 * base[0] + 0.55 * palette(3, ANSWER_HUE)).astype(int)
    np.testing.assert_allclose(colours[:3], [tinted[0], tinted[2], tinted[2]], atol=1)
    assert 0 < colours[3].max() < 0.5 * 200


@pytest.fixture(scope="module")
def viewer(scene, cameras):
    asked = Scene(colour_field(scene, cameras), ColourEmbedder(), name="<desk>")
    viewer = open_viewer(asked, port=0, state=ViewState(("orange", "pink")))
    yield viewer
    viewer.stop()
    viewer.server.stop()


@pytest.fixture(autouse=True)
def start_state(request):
    """Each test of the viewer begins without a question."""
    if "viewer" in request.fixturenames:
        show(request.getfixturevalue("viewer"), lambda _: ViewState())


def settled(viewer: Viewer, act) -> None:
    """Waits until all steps are done."""
    done = []
    act()
    viewer.then(lambda state: done.append(True) or state)
    until(lambda: done and viewer.drawn == viewer.state, "the viewer's thread comes to it")


def show(viewer: Viewer, step) -> ViewState:
    """The state after a step."""
    settled(viewer, lambda: viewer.then(step))
    return viewer.state


def ask(viewer: Viewer, *questions) -> ViewState:
    return show(viewer, lambda state: dataclasses.replace(state, questions=questions))


def mask_of(viewer: Viewer, question) -> np.ndarray:
    return viewer.scene.ask(question, threshold=0.5).mask


def word_of(viewer: Viewer) -> str:
    """A colour that selects a part of the scene."""
    return next(word for word in BASIC if 3 < mask_of(viewer, word).sum() < 30)


def colours(layer: SplatLayer) -> np.ndarray:
    """(N, 4) RGBA of the 64 Gaussians as the window has them."""
    rgba = np.zeros((64, 4), np.uint8)
    for rows, handle in layer._groups:
        rgba[rows] = np.ascontiguousarray(handle.buffer[:, 7]).view(np.uint8).reshape(-1, 4)
    return rgba


def words_of(viewer: Viewer) -> str:
    return viewer._messages.content


def test_a_text_is_highlighted(viewer):
    base, word = colours(viewer.layer), word_of(viewer)
    ask(viewer, word)
    mask, lit = mask_of(viewer, word), colours(viewer.layer)
    assert (lit[~mask, :3].astype(int) <= base[~mask, :3]).all()
    np.testing.assert_array_equal(lit[:, 3], base[:, 3])
    np.testing.assert_allclose(lit[mask, :3], 0.45 * base[mask, :3] + 0.55 * palette(1, ANSWER_HUE)[0], atol=1)
    assert f"{int(mask.sum())} of 64 Gaussians" in words_of(viewer)


def test_only_the_selection(viewer):
    word, opacity = word_of(viewer), colours(viewer.layer)[:, 3]
    mask = mask_of(viewer, word)
    ask(viewer, word)
    show(viewer, lambda state: dataclasses.replace(state, only_selected=True))
    np.testing.assert_array_equal(colours(viewer.layer)[:, 3], np.where(mask, opacity, 0))
    show(viewer, lambda state: state.with_question(""))
    np.testing.assert_array_equal(colours(viewer.layer)[:, 3], opacity)


def test_odd_texts_and_faults_are_reported_and_the_viewer_goes_on(viewer, capsys):
    ask(viewer, "the meaning of life", "black or ''", "<script>alert(1)</script> red")
    assert "no colour word" in words_of(viewer)
    assert "a part without words" in words_of(viewer)
    assert "<script>" not in words_of(viewer)
    ask(viewer, Region(4000))
    assert "there is no region 4000" in words_of(viewer)
    show(viewer, lambda state: 1 / 0)
    assert "The terminal shows its trace" in viewer._notice.content
    assert "ZeroDivisionError" in capsys.readouterr().err
    assert ask(viewer, Region(1)).questions == (Region(1),)


def test_the_file_of_the_selection(viewer, tmp_path):
    sent = []
    client = SimpleNamespace(send_file_download=lambda name, content, **_: sent.append((name, content)))
    settled(viewer, lambda: viewer.then(lambda _: viewer._export(client)))
    assert "no Gaussian is selected" in viewer._notice.content
    ask(viewer, Region(1))
    settled(viewer, lambda: viewer.then(lambda _: viewer._export(client)))
    ((name, content),) = sent
    assert name == "region-1.ply"
    (tmp_path / name).write_bytes(content)
    assert load_gaussians(tmp_path / name).count == mask_of(viewer, Region(1)).sum()


def test_two_clicks_measure_a_length(viewer):
    field, sent = viewer.scene.field, []
    client = SimpleNamespace(send_file_download=lambda name, content, **_: sent.append((name, content.decode())))
    camera = jax.tree.map(np.asarray, field.cameras)[0]
    start, focal, points = np.asarray(camera.centres), float(camera.fx), []
    for x, y in ((24, 20), (18, 28)):
        direction = camera.world_to_camera[:3, :3].T @ [(x + 0.5 - camera.cx) / focal, (y + 0.5 - camera.cy) / focal, 1]
        ray = SimpleNamespace(ray_origin=start * viewer.layer.scale, ray_direction=direction)
        settled(viewer, lambda ray=ray: viewer.then(lambda _: viewer._measure(ray, focal)))
        points.append(start + direction * depth_seen(field.gaussians, camera, x, y))
    length = np.linalg.norm(points[1] - points[0])
    assert f"{length:.2g}"[:3] in viewer._notice.content
    settled(viewer, lambda: viewer.then(lambda _: viewer._export(client)))
    ((name, text),) = sent
    (row,) = csv.DictReader(text.splitlines())
    assert (name, row["unit"]) == ("lengths.csv", "capture units")
    assert float(row["centers"]) == pytest.approx(length, rel=0.02)
    away = SimpleNamespace(ray_origin=start * viewer.layer.scale, ray_direction=-camera.world_to_camera[2, :3])
    settled(viewer, lambda: viewer.then(lambda _: viewer._measure(away, focal)))
    assert "nothing is there" in viewer._notice.content
    viewer._lengths.clear()


def test_a_taken_port_and_a_missing_extra_are_refused(viewer, monkeypatch):
    with pytest.raises(InputError, match="--port"):
        open_viewer(viewer.scene, port=viewer.server.get_port(), state=ViewState())
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r'pip install "jsecon\[viewer\]"'):
        open_viewer(viewer.scene, port=0, state=ViewState())


SOCKET = {
    "Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
    "Sec-WebSocket-Version": "13", "Sec-WebSocket-Protocol": "viser-v1.0.0",
}  # fmt: skip


def test_the_page_is_shown_to_who_names_this_machine(viewer):
    port = viewer.server.get_port()
    others = [({**SOCKET, "Origin": origin}, 403) for origin in ("https://evil.example", "null", "http://localhost:1")]
    for headers, status in (
        ({}, 200), ({"Host": f"localhost:{port}"}, 200), ({"Host": "evil.example"}, 403),
        ({"Origin": f"http://127.0.0.1:{port}"}, 200), *others,
    ):  # fmt: skip
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
        connection.request("GET", "/", headers=headers)
        assert connection.getresponse().status == status, headers
        connection.close()


@pytest.fixture(scope="module")
def field(scene, cameras):
    return colour_field(scene, cameras)


def hidden(field, mask):
    return dataclasses.replace(field, gaussians=hide(field.gaussians, mask))


def test_a_ray_meets_the_region_of_its_pixel_and_passes_what_is_hidden(field):
    """Against the pixel's own region in the field's frame: the same ray, seen by another camera."""
    camera = jax.tree.map(np.asarray, field.cameras)[0]
    turn, centre, everything = camera.world_to_camera[:3, :3], np.asarray(camera.centres), np.ones(64, bool)
    agree = []
    for x, y in ((24, 20), (18, 14), (30, 26), (20, 28), (28, 12), (24, 30)):
        ray = turn.T @ [(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, 1]
        found = _region_along(field, _view_along(centre, ray, float(camera.fx)))
        agree.append(found == region_at(field, 0, x, y))
    assert sum(agree) >= 5, agree  # the frame's own Jacobian differs off its axis
    first, *others = (
        _region_along(hidden(field, ~visible), _view_along(centre, ray, 45.0))
        for ray, visible in ((turn[2], everything), (turn[2], ~everything), (-turn[2], everything))
    )
    assert first >= 0
    assert others == [-1, -1]
    ahead = _view_along(centre, turn[2], 45.0)
    assert _region_along(hidden(field, main_regions(field) == first), ahead) != first


@pytest.mark.parametrize(("faint", "depth"), [(0.2, 4.0), (0.8, 2.0)])
def test_a_pixel_is_as_deep_as_half_of_what_it_shows(faint, depth):
    """One opaque Gaussian, and another before it."""
    opacities = np.array([0.95, faint])
    means = np.array([[0, 0, 4.0], [0, 0, 2.0]])
    turns = np.array([[1.0, 0, 0, 0]] * 2)
    gaussians = Gaussians(means, np.full((2, 3), -2.0), turns, np.log(opacities / (1 - opacities)), None)
    camera = _view_along(np.zeros(3), np.array([0, 0, 1.0]), 500.0)
    assert depth_seen(gaussians, camera, RAY_VIEW_SIDE // 2, RAY_VIEW_SIDE // 2) == pytest.approx(depth)
    assert depth_seen(gaussians, camera, 0, 0) is None


@pytest.fixture(scope="module")
def server():
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    yield server
    server.stop()


def with_gaussians(field, **changes):
    return dataclasses.replace(field, gaussians=dataclasses.replace(field.gaussians, **changes))


@pytest.mark.parametrize("size", [1e-4, 1, 300])
def test_the_window_holds_the_field_at_any_size(field, server, size):
    logs = np.asarray(field.gaussians.log_scales) + np.float32(np.log(size))
    layer = SplatLayer(server, with_gaussians(field, means=np.asarray(field.gaussians.means) * size, log_scales=logs))
    seen = np.zeros(64, int)
    for rows, handle in layer._groups:
        seen[rows] += 1
        centres = np.asarray(field.gaussians.means)[rows] * size
        np.testing.assert_allclose(handle.centers / layer.scale, centres, rtol=1e-5)
        spread = handle.covariances.astype(np.float64) / layer.scale**2
        sizes = np.sort(np.exp(2 * logs[rows].astype(np.float64)), axis=1)
        np.testing.assert_allclose(np.linalg.eigvalsh(spread), sizes, rtol=0.03, atol=2e-5 * size**2)
    assert (seen == 1).all()


def test_huge_and_tiny_gaussians_stay_within_what_viser_holds_and_those_not_finite_are_left_out(field, server):
    logs, means = np.array(field.gaussians.log_scales), np.array(field.gaussians.means)
    logs[0], logs[1], means[3] = 20, -40, np.nan
    layer = SplatLayer(server, with_gaussians(field, log_scales=logs, means=means))
    for _, handle in layer._groups:
        assert np.isfinite(handle.centers).all()
        assert np.abs(handle.covariances).max() <= 1.001 * MAX_STD**2
    np.testing.assert_array_equal(np.flatnonzero(colours(layer)[:, 3] == 0), [3])


def test_the_window_starts_at_the_first_frame(field, server):
    layer = SplatLayer(server, field)
    centre = np.asarray(field.cameras.centres)[0] * layer.scale
    assert server.initial_camera.fov == pytest.approx(2 * np.arctan(20 / 43))
    np.testing.assert_allclose(server.initial_camera.position, centre, rtol=1e-5)


CANVAS = "[...document.querySelectorAll('canvas')].sort((a, b) => b.width - a.width)[0]"
QUIET = ".mantine-Notifications-root { display: none }"


def scene_of(page) -> np.ndarray:
    """(H, W, 3) what is seen of the scene, without the panel."""
    image = cv2.imdecode(np.frombuffer(page.png(), np.uint8), cv2.IMREAD_COLOR)
    return image[60:, : image.shape[1] * 2 // 5].astype(int)


def after_change(page, before: np.ndarray) -> np.ndarray:
    until(lambda: (np.abs(scene_of(page) - before).max(-1) > 12).mean() > 0.005, "the picture changes")
    return scene_of(page)


def input_of(label: str) -> str:
    """The input beside a label."""
    return f"""[...document.querySelectorAll('input')].find(e => {{
        for (let p = e, k = 0; k < 9 && p; k++, p = p.parentElement) if (p.innerText?.trim() === '{label}') return true;
        }})"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_in_a_browser_a_text_lights_up_a_click_selects_and_controls_act(viewer, tmp_path):
    word, address = word_of(viewer), f"http://127.0.0.1:{viewer.server.get_port()}/"
    with opened(address, tmp_path, width=640, height=360) as page:
        first = begun(page)
        page.type(input_of("find"), word)
        until(lambda: viewer.state.questions == (word,), "the text arrives")
        after_change(page, first)
        count = int(mask_of(viewer, word).sum())
        page.until(f"document.body.innerText.includes('{word}: {count} of 64 Gaussians')")
        click_a_region(viewer, page)
        page.js(f"{input_of('only the selection')}.click()")
        until(lambda: viewer.state.only_selected, "the rest is hidden")
        page.js("document.querySelectorAll('[role=slider]')[0].focus()")
        page.key("ArrowRight", 39)
        until(lambda: viewer.state.threshold == 0.51, "the threshold moves")
        outside = [url for url in page.asked if not url.startswith((address, "data:", "blob:", "ws://127.0.0.1"))]
        assert not outside


def begun(page) -> np.ndarray:
    """The picture once the scene is shown."""
    page.until(f"{input_of('find')} && true")
    page.js("document.head.append(Object.assign(document.createElement('style'), { textContent: '" + QUIET + "' }))")
    first = after_change(page, np.full_like(scene_of(page), scene_of(page)[-1, 0]))
    assert len(np.unique(first.reshape(-1, 3) // 16, axis=0)) > 8, "the canvas is blank"
    return first


def click_a_region(viewer, page):
    """Clicks the region below the middle."""
    width, height = page.js(f"(() => {{ const c = {CANVAS}; return [c.clientWidth, c.clientHeight]; }})()")
    x, y = round(0.4 * width), round(0.55 * height)
    focal = height / 2 / np.tan(viewer.layer.fovs[0] / 2)
    lens = (np.float32(v) for v in (focal, focal, width / 2, height / 2))
    seen_from = Camera(viewer.scene.field.cameras.world_to_camera[0], *lens, width=width, height=height)
    region = int(region_shares_seen(viewer.scene.field, seen_from, x, y).argmax())
    left, top = page.js(f"(() => {{ const r = {CANVAS}.getBoundingClientRect(); return [r.x, r.y]; }})()")
    page.click(left + x, top + y)
    until(lambda: viewer.state.questions == (Region(region),), f"region {region} is clicked")
