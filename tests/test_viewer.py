"""The viewer: its states and colours, what its steps do to a field, and in a browser what a person would try."""

import dataclasses
import http.client
import itertools
import socket
import subprocess
import sys
import urllib.request
from types import SimpleNamespace

import cv2
import jax
import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra viewer is not installed")
from browser import CHROMIUM, opened, until
from small_field import colour_field, make_field

from jsecon import Camera, InputError, load_gaussians, region_at, save_field
from jsecon.app.catalogue import main_regions
from jsecon.app.pictures import palette
from jsecon.app.records import Answer, Query, Region
from jsecon.app.scene import Scene
from jsecon.app.viewer.window import (
    ANSWER_HUE,
    COLOURINGS,
    Viewer,
    ViewState,
    highlight,
    open_viewer,
    region_along,
)
from jsecon.query.pointing import region_shares_seen
from jsecon.types import Selection
from jsecon.vision.colours import BASIC, ColourEmbedder

MUG = ViewState(("red mug",))


def test_a_click_highlights_a_region_and_a_second_click_removes_it():
    state = MUG.with_question(Region(3))
    assert state.questions == (Region(3),)
    assert state.with_question(Region(3)).questions == ()
    assert MUG.with_question(Region(3), add=True).questions == ("red mug", Region(3))
    both = state.with_question(Region(4), add=True)
    assert both.questions == (Region(3), Region(4))
    assert both.with_question(Region(3), add=True).questions == (Region(4),)


def test_a_text_is_one_question_with_the_options_of_the_controls():
    assert ViewState().with_question("mug; bowl").queries == (Query("mug; bowl", threshold=0.5),)
    assert MUG.with_question("bowl").questions == ("bowl",)
    assert MUG.with_question("bowl", add=True).with_question("red mug", add=True).questions == ("bowl", "red mug")
    assert MUG.with_question("  ").questions == ()
    changed = dataclasses.replace(MUG, threshold=0.7, all_of_class=True)
    assert changed.queries == (Query("red mug", threshold=0.7, all_of_class=True),)


def test_colours_of_answers_differ_and_do_not_depend_on_their_number():
    assert palette(0, ANSWER_HUE).shape == (0, 3)
    many = palette(12, ANSWER_HUE).astype(int)
    np.testing.assert_array_equal(palette(3, ANSWER_HUE), many[:3])
    differences = np.abs(many[:, None] - many[None]).sum(-1)
    assert differences[~np.eye(12, dtype=bool)].min() > 40


def answer_of(field, mask, similarity):
    """An answer by its mask and similarities."""
    mask, zero = np.array(mask, bool), np.zeros((), np.float32)
    selection = Selection(mask, np.array(similarity, np.float32), np.zeros((), np.int32), zero)
    return Answer(Query("mug"), "votes", mask, selection, field)


def test_answers_are_tinted_and_the_rest_is_dimmed(field):
    base = np.array([[200, 100, 0]] * 4, np.uint8)
    failed, empty = InputError("query", "no words"), answer_of(field, [0, 0, 0, 0], [0, 0, 0, 0])
    assert highlight(base, [failed, empty]) is base
    first = answer_of(field, [1, 1, 0, 0], [0.9, 0.6, 0.1, 0])
    second = answer_of(field, [0, 1, 1, 0], [0, 0.8, np.nan, 0])
    colours = highlight(base, [first, failed, second]).astype(int)
    tinted = (0.45 * base[0] + 0.55 * palette(3, ANSWER_HUE)).astype(int)
    np.testing.assert_allclose(colours[:3], [tinted[0], tinted[2], tinted[2]], atol=1)
    assert 0 < colours[3].max() < 0.5 * 200
    np.testing.assert_array_equal(base, [[200, 100, 0]] * 4)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as found:
        return found.getsockname()[1]


@pytest.fixture(scope="module")
def viewer(scene, cameras):
    asked = Scene(colour_field(scene, cameras), ColourEmbedder(), name="<desk>")
    viewer = open_viewer(asked, port=free_port(), state=ViewState(("orange", "pink")))
    yield viewer
    viewer.stop()
    viewer.server.stop()


@pytest.fixture(autouse=True)
def start_state(request):
    """Each test of the viewer begins without a question."""
    if "viewer" in request.fixturenames:
        viewer = request.getfixturevalue("viewer")
        settled(viewer, lambda: viewer.then(lambda _: ViewState()))


def settled(viewer: Viewer, act) -> ViewState:
    """The state once all steps are done."""
    done = []
    act()
    viewer.then(lambda state: done.append(True) or state)
    until(lambda: done and viewer.drawn == viewer.state, "the viewer's thread comes to it")
    return viewer.state


def ask(viewer: Viewer, *questions) -> ViewState:
    return settled(viewer, lambda: viewer.then(lambda state: dataclasses.replace(state, questions=questions)))


def mask_of(viewer: Viewer, question) -> np.ndarray:
    return viewer.scene.ask(question, threshold=0.5).mask


def word_of(viewer: Viewer) -> str:
    """A colour that selects a part of the scene."""
    return next(word for word in BASIC if 3 < mask_of(viewer, word).sum() < 30)


def colours(viewer: Viewer) -> np.ndarray:
    """(N, 4) RGBA as the window has them."""
    rgba = np.zeros((viewer.scene.field.gaussians.count, 4), np.uint8)
    for rows, handle in viewer.layer._groups:
        rgba[rows] = np.ascontiguousarray(handle.buffer[:, 7]).view(np.uint8).reshape(-1, 4)
    return rgba


def words_of(viewer: Viewer) -> str:
    return viewer.panel._messages.content


def test_a_text_is_highlighted(viewer):
    base, word = colours(viewer), word_of(viewer)
    ask(viewer, word)
    mask, lit = mask_of(viewer, word), colours(viewer)
    assert (lit[~mask, :3].astype(int) <= base[~mask, :3]).all()
    np.testing.assert_array_equal(lit[:, 3], base[:, 3])
    np.testing.assert_allclose(lit[mask, :3], 0.45 * base[mask, :3] + 0.55 * palette(1, ANSWER_HUE)[0], atol=1)
    assert f"{int(mask.sum())} of 64 Gaussians" in words_of(viewer)


def test_a_relation_says_how_it_was_read(viewer):
    word = word_of(viewer)
    ask(viewer, f"the largest {word}", f"{word} across")
    assert mask_of(viewer, f"the largest {word}").any()
    assert f"read as &#x27;{word}&#x27;, largest: 1 object" in words_of(viewer)


def test_only_the_selection(viewer):
    word, opacity = word_of(viewer), colours(viewer)[:, 3]
    mask = mask_of(viewer, word)
    ask(viewer, word)
    settled(viewer, lambda: viewer.then(lambda state: dataclasses.replace(state, only_selected=True)))
    np.testing.assert_array_equal(colours(viewer)[:, 3], np.where(mask, opacity, 0))
    settled(viewer, lambda: viewer.then(lambda state: state.with_question("")))
    np.testing.assert_array_equal(colours(viewer)[:, 3], opacity)


@pytest.mark.parametrize("colouring", COLOURINGS)
def test_every_colouring(viewer, colouring):
    settled(viewer, lambda: viewer.then(lambda state: dataclasses.replace(state, colouring=colouring)))
    before = colours(viewer)
    kinds = len(np.unique(before[:, :3], axis=0))
    assert kinds > 2
    ask(viewer, word_of(viewer))
    assert (colours(viewer)[:, :3] != before[:, :3]).any()


def test_odd_texts_and_faults_are_reported_and_the_viewer_goes_on(viewer, capsys):
    ask(viewer, "the meaning of life", "black or ''", "<script>alert(1)</script> red")
    assert "no colour word" in words_of(viewer)
    assert "a part without words" in words_of(viewer)
    assert "<script>" not in words_of(viewer)
    ask(viewer, Region(4000))
    assert "there is no region 4000" in words_of(viewer)
    settled(viewer, lambda: viewer.then(lambda state: 1 / 0))
    assert "The terminal shows its trace" in viewer.panel._notice.content
    assert "ZeroDivisionError" in capsys.readouterr().err
    assert ask(viewer, Region(1)).questions == (Region(1),)


def test_the_file_of_the_selection(viewer, tmp_path):
    sent = []
    client = SimpleNamespace(send_file_download=lambda name, content, **_: sent.append((name, content)))
    settled(viewer, lambda: viewer.then(lambda _: viewer._export(client)))
    assert "no Gaussian is selected" in viewer.panel._notice.content
    ask(viewer, Region(1))
    settled(viewer, lambda: viewer.then(lambda _: viewer._export(client)))
    name, content = sent[0]
    assert name == "region-1.ply"
    (tmp_path / name).write_bytes(content)
    assert load_gaussians(tmp_path / name).count == mask_of(viewer, Region(1)).sum()


def test_a_taken_port_and_a_missing_extra_are_refused(viewer, monkeypatch):
    with pytest.raises(InputError, match="--port"):
        open_viewer(viewer.scene, port=viewer.server.get_port(), state=ViewState())
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r'pip install "jsecon\[viewer\]"'):
        open_viewer(viewer.scene, port=0, state=ViewState())


def asked(port, **headers):
    """Status of the page; a header's name has _ for -."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request("GET", "/", headers={name.replace("_", "-"): value for name, value in headers.items()})
    answer = connection.getresponse()
    answer.read()
    connection.close()
    return answer.status


SOCKET = {
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
    "Sec_WebSocket_Version": "13",
    "Sec_WebSocket_Protocol": "viser-v1.0.0",
}


def test_the_page_is_shown_to_who_names_this_machine(viewer):
    port = viewer.server.get_port()
    assert asked(port) == 200
    assert asked(port, Host=f"localhost:{port}") == 200
    assert asked(port, Host="evil.example") == 403
    assert asked(port, Origin=f"http://127.0.0.1:{port}") == 200
    for origin in ("https://evil.example", "null", "http://localhost:1"):
        assert asked(port, **SOCKET, Origin=origin) == 403, origin


@pytest.fixture(scope="module")
def field(scene, cameras):
    return make_field(scene, cameras, dim=ColourEmbedder().dim)[0]


@pytest.mark.parametrize("frame", [0, 2])
def test_a_ray_meets_the_region_of_its_pixel(field, frame):
    """Against the pixel's own region in the field's frame: the same ray, seen by another camera."""
    camera = jax.tree.map(np.asarray, field.cameras)[frame]
    turn, seen = camera.world_to_camera[:3, :3], np.ones(64, bool)
    agree = []
    for x, y in ((24, 20), (18, 14), (30, 26), (20, 28), (28, 12), (24, 30)):
        ray = turn.T @ [(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, 1]
        found = region_along(field, np.asarray(camera.centres), ray, focal=float(camera.fx), visible=seen)
        agree.append(found == region_at(field, frame, x, y))
    assert sum(agree) >= 5, agree  # the frame's own Jacobian differs off its axis


def test_a_ray_passes_what_is_hidden(field):
    camera = jax.tree.map(np.asarray, field.cameras)[0]
    ahead, centre = camera.world_to_camera[2, :3], np.asarray(camera.centres)
    everything = np.ones(64, bool)
    first = region_along(field, centre, ahead, focal=45.0, visible=everything)
    assert first >= 0
    behind = region_along(field, centre, ahead, focal=45.0, visible=main_regions(field) != first)
    assert behind != first
    assert region_along(field, centre, ahead, focal=45.0, visible=~everything) == -1
    assert region_along(field, centre, -ahead, focal=45.0, visible=everything) == -1


@pytest.mark.long
def test_the_command_prints_where_it_listens(viewer, tmp_path):
    file, port = tmp_path / "run" / "field.safetensors", free_port()
    file.parent.mkdir()
    save_field(file, viewer.scene.field)
    command = [sys.executable, "-m", "jsecon", "view", str(file), "red", "--port", str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        assert process.stdout is not None
        printed = list(itertools.takewhile(lambda line: not line.startswith("http"), process.stdout))
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=20) as answer:
            assert answer.status == 200
        process.terminate()  # Ctrl-C is ignored by what a shell started in the background
        assert process.wait(20) == 130
    assert printed == ["run: 64 Gaussians, 5 regions\n"]


CANVAS = "[...document.querySelectorAll('canvas')].sort((a, b) => b.width - a.width)[0]"
QUIET = ".mantine-Notifications-root { display: none }"


def scene_of(page) -> np.ndarray:
    """(H, W, 3) what is seen of the scene, without the panel."""
    image = cv2.imdecode(np.frombuffer(page.png(), np.uint8), cv2.IMREAD_COLOR)
    return image[60:, : image.shape[1] * 2 // 5].astype(int)


def after_change(page, before: np.ndarray) -> np.ndarray:
    def changed():
        return (np.abs(scene_of(page) - before).max(-1) > 12).mean() > 0.005

    until(changed, "the picture changes")
    return scene_of(page)


def input_of(label: str) -> str:
    """The input beside a label."""
    return f"""[...document.querySelectorAll('input')].find(e => {{
        for (let p = e, k = 0; k < 6 && p; k++, p = p.parentElement) if (p.innerText?.trim() === '{label}') return true;
        }})"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_in_a_browser_a_text_lights_up_and_a_click_selects(viewer, tmp_path):
    word, address = word_of(viewer), f"http://127.0.0.1:{viewer.server.get_port()}/"
    with opened(address, tmp_path, width=640, height=360) as page:
        first = begun(page)
        page.type(input_of("find"), word)
        until(lambda: viewer.state.questions == (word,), "the text arrives")
        after_change(page, first)
        count = int(mask_of(viewer, word).sum())
        page.until(f"document.body.innerText.includes('{word}: {count} of 64 Gaussians')")
        click_a_region(viewer, page)
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
    """(region, its camera, left, top, width, height): clicks the region below the middle; the canvas's place, px."""
    width, height = page.js(f"(() => {{ const c = {CANVAS}; return [c.clientWidth, c.clientHeight]; }})()")
    x, y = round(0.4 * width), round(0.55 * height)
    focal = height / 2 / np.tan(viewer.layer.fovs[0] / 2)
    lens = (np.float32(v) for v in (focal, focal, width / 2, height / 2))
    seen_from = Camera(viewer.scene.field.cameras.world_to_camera[0], *lens, width=width, height=height)
    region = int(region_shares_seen(viewer.scene.field, seen_from, x, y).argmax())
    left, top = page.js(f"(() => {{ const r = {CANVAS}.getBoundingClientRect(); return [r.x, r.y]; }})()")
    page.click(left + x, top + y)
    until(lambda: viewer.state.questions == (Region(region),), f"region {region} is clicked")
    return region, seen_from, left, top, width, height


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_in_a_browser_it_does_what_a_person_tries(viewer, tmp_path):
    """Sliders, shift and clicks, downloads, frames. What each does to the field is tested above."""
    address = f"http://127.0.0.1:{viewer.server.get_port()}/"
    with opened(address, tmp_path, width=800, height=420) as page:
        begun(page)
        page.js("document.querySelectorAll('[role=slider]')[0].focus()")
        page.key("ArrowRight", 39)
        until(lambda: viewer.state.threshold == 0.51, "the threshold moves")

        region, seen_from, left, top, width, height = click_a_region(viewer, page)
        other = next(
            (u, v)
            for v in range(60, height - 40, 7)
            for u in range(20, width // 2, 7)
            if int(region_shares_seen(viewer.scene.field, seen_from, u, v).argmax()) != region
            and region_shares_seen(viewer.scene.field, seen_from, u, v).max() > 0.3
        )
        page.click(left + other[0], top + other[1], shift=True)
        until(lambda: len(viewer.state.questions) == 2, "a second region beside it")
        page.click(left + other[0], top + other[1], shift=True)
        until(lambda: viewer.state.questions == (Region(region),), "and away again")

        page.press("export")
        until(lambda: list((tmp_path / "downloads").glob(f"region-{region}.ply")), "the file arrives")

        clicked = scene_of(page)
        page.js(f"{input_of('only the selection')}.click()")
        until(lambda: viewer.state.only_selected, "the rest is hidden")
        after_change(page, clicked)
        client = next(iter(viewer.server.get_clients().values()))
        viewer.then(lambda _: viewer.layer.go_to(client, 2))
        centre = viewer.layer._centers[2]
        until(lambda: np.allclose(client.camera.position, centre, atol=1e-3), "at the frame")
