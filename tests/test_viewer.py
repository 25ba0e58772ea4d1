"""The viewer: what its steps do to a field, and in a browser what a person would try."""

import dataclasses
import io
import itertools
import socket
import subprocess
import sys
import time
import urllib.request
import zipfile
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra viewer is not installed")
from browser import CHROMIUM, opened, until
from small_field import colour_field

from jsecon import Camera, InputError, load_gaussians, save_field
from jsecon.app.cli import main
from jsecon.app.records import Answer
from jsecon.app.viewer import view_state
from jsecon.app.viewer.view_state import ViewState
from jsecon.app.viewer.window import Viewer, open_viewer
from jsecon.field.membership import with_overlap
from jsecon.query.pointing import region_shares_seen
from jsecon.vision.colours import BASIC, ColourEmbedder

START = "orange; pink"


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as found:
        return found.getsockname()[1]


@pytest.fixture(scope="module")
def viewer(scene, cameras):
    field = colour_field(scene, cameras)
    field = dataclasses.replace(field, votes=with_overlap(field.votes))
    port, state = free_port(), ViewState().with_texts(START)
    viewer = open_viewer(field, ColourEmbedder(), host="127.0.0.1", port=port, name="<desk>", state=state)
    yield viewer
    viewer.stop()
    viewer.server.stop()


@pytest.fixture(autouse=True)
def as_begun(viewer):
    """Each test begins with a viewer that was asked nothing."""
    settled(viewer, lambda: viewer.then(lambda _: ViewState(), update_controls=True))


def settled(viewer: Viewer, act) -> ViewState:
    """The state once all that was to be done is done."""
    done = []
    act()
    viewer.then(lambda state: done.append(True) or state)
    until(lambda: done and viewer.drawn == viewer.history.state, "the viewer's thread comes to it")
    return viewer.history.state


def word_of(viewer: Viewer) -> str:
    """A colour that selects a part of the scene."""
    masks = {word: viewer.answer(view_state.ViewQuery(word)).mask.sum() for word in BASIC}
    return next(word for word, count in masks.items() if 3 < count < 30)


def colours(viewer: Viewer) -> np.ndarray:
    """(N, 4) RGBA as the window has them."""
    count = viewer.field.gaussians.count
    told = np.zeros((count, 4), np.uint8)
    for rows, handle in viewer.scene._groups:
        told[rows] = np.ascontiguousarray(handle.buffer[:, 7]).view(np.uint8).reshape(-1, 4)
    return told


def test_a_text_lights_up(viewer):
    base, word = colours(viewer), word_of(viewer)
    before = [handle.buffer.copy() for _, handle in viewer.scene._groups]
    settled(viewer, lambda: viewer.then(lambda s: s.with_texts(word)))
    mask = viewer.answer(view_state.ViewQuery(word)).mask
    lit = colours(viewer)
    assert (lit[~mask, :3].astype(int) <= base[~mask, :3]).all()
    np.testing.assert_array_equal(lit[:, 3], base[:, 3])
    tint = 0.45 * base[mask, :3] + 0.55 * view_state.answer_colours(1)[0]
    np.testing.assert_allclose(lit[mask, :3], tint, atol=1)
    for (_, handle), was in zip(viewer.scene._groups, before, strict=True):
        np.testing.assert_array_equal(handle.buffer[:, :7], was[:, :7])


def test_a_relation_lights_up_and_says_how_it_was_read(viewer):
    word = word_of(viewer)
    settled(viewer, lambda: viewer.then(lambda s: s.with_texts(f"the largest {word}; {word} across")))
    assert viewer.answer(view_state.ViewQuery(f"the largest {word}")).mask.any()
    assert f"read as &#x27;{word}&#x27;, largest: 1 object" in viewer.panel.messages.content


def test_show_only_hide_and_undo(viewer):
    word, opacity = word_of(viewer), colours(viewer)[:, 3]
    mask = viewer.answer(view_state.ViewQuery(word)).mask
    settled(viewer, lambda: viewer.then(lambda s: s.with_texts(word)))
    settled(viewer, lambda: viewer.then(ViewState.isolate))
    np.testing.assert_array_equal(colours(viewer)[:, 3], np.where(mask, opacity, 0))
    settled(viewer, viewer.undo)
    np.testing.assert_array_equal(colours(viewer)[:, 3], opacity)
    settled(viewer, lambda: viewer.then(ViewState.hide))
    np.testing.assert_array_equal(colours(viewer)[:, 3], np.where(mask, 0, opacity))
    assert settled(viewer, lambda: viewer.then(ViewState.show_all)) == ViewState()


@pytest.mark.parametrize("paint", view_state.COLOURINGS)
def test_every_paint(viewer, paint):
    settled(viewer, lambda: viewer.then(lambda s: s.with_controls(colouring=paint)))
    told = colours(viewer)
    kinds = len(np.unique(told[:, :3], axis=0))
    assert kinds == 1 if paint == "score" else kinds > 2
    settled(viewer, lambda: viewer.then(lambda s: s.with_texts(word_of(viewer))))
    assert (colours(viewer)[:, :3] != told[:, :3]).any()


def test_part_or_whole_changes_what_a_region_takes(viewer):
    part, whole = (viewer.answer(view_state.ViewQuery(2, part_vs_whole=w)).mask for w in (0.0, 1.0))
    overlap = np.asarray(viewer.field.votes.overlap)[2]
    assert (np.delete(overlap, 2) >= 0.1).any(), "a field whose regions overlap"
    assert whole.sum() > part.sum() > 0
    assert (whole | ~part).all()


def test_odd_texts_and_links_are_told_and_change_nothing(viewer):
    state = settled(viewer, lambda: viewer.then(lambda s: s.with_texts("the meaning of life; black or ''")))
    assert len(state.queries) == 2
    told = viewer.panel.messages.content
    assert "no colour word" in told
    assert "a part without words" in told
    before = colours(viewer)
    settled(viewer, lambda: viewer.then(lambda _: view_state.from_link('{"queries": [-1]}')))
    assert viewer.panel._notice.visible
    assert "Copy the whole line" in viewer.panel._notice.content
    assert viewer.history.state == state
    np.testing.assert_array_equal(colours(viewer), before)
    settled(viewer, lambda: viewer.then(lambda s: s.with_texts("<script>alert(1)</script> red")))
    assert "<script>" not in viewer.panel.messages.content
    settled(viewer, lambda: viewer.then(lambda s: s.toggle_region(4000)))
    assert "no match" in viewer.panel.messages.content


def test_an_error_inside_is_told_and_the_viewer_goes_on(viewer, capsys):
    settled(viewer, lambda: viewer.then(lambda s: 1 / 0))
    assert "The terminal shows its trace" in viewer.panel._notice.content
    assert "ZeroDivisionError" in capsys.readouterr().err
    assert settled(viewer, lambda: viewer.then(lambda s: s.toggle_region(1))).queries == (1,)


def test_files_of_the_answers(viewer, tmp_path):
    answer = viewer.answer(view_state.ViewQuery(1))
    assert isinstance(answer, Answer)
    sent = []
    client = SimpleNamespace(send_file_download=lambda name, content, **_: sent.append((name, content)))
    settled(viewer, lambda: viewer.then(lambda _: ViewState((1,))))
    settled(viewer, lambda: viewer.export(client))
    assert sent[0][0] == "region-1.zip"
    with zipfile.ZipFile(io.BytesIO(sent[0][1])) as archive:
        names = archive.namelist()
        archive.extractall(tmp_path)
    assert {"region-1.json", "region-1.ply"} <= set(names)
    assert sum(name.endswith(".png") for name in names) == 3
    assert load_gaussians(tmp_path / "region-1.ply").count == answer.mask.sum()


def test_a_taken_port_and_a_missing_extra_are_told(viewer, monkeypatch):
    given = {"host": "127.0.0.1", "name": "x", "state": ViewState()}
    with pytest.raises(InputError, match="--port"):
        open_viewer(viewer.field, viewer.embedder, port=viewer.server.get_port(), **given)
    with pytest.raises(InputError, match="--port"):
        open_viewer(viewer.field, viewer.embedder, port=8766, **given | {"host": "no.such.host.invalid"})
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r'pip install "jsecon\[viewer\]"'):
        open_viewer(viewer.field, viewer.embedder, port=0, **given)


QUIET = ".mantine-Notifications-root { display: none }"


@pytest.mark.long
def test_the_command_says_where_it_listens(viewer, tmp_path):
    file, port = tmp_path / "run" / "field.safetensors", free_port()
    file.parent.mkdir()
    save_field(file, viewer.field)
    command = [sys.executable, "-m", "jsecon", "view", str(file), "red", "--port", str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        assert process.stdout is not None
        told = list(itertools.takewhile(lambda line: not line.startswith("http"), process.stdout))
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=20) as answer:
            assert answer.status == 200
        process.terminate()  # Ctrl-C is ignored by what a shell started in the background
        assert process.wait(20) == 130
    assert told == ["run: 64 Gaussians, 5 regions\n"]


def test_bad_arguments_end_in_one_message(viewer, tmp_path, capsys):
    save_field(tmp_path / "field.safetensors", viewer.field)
    assert main(["view", str(tmp_path / "field.safetensors"), "--link", "what"]) == 2
    assert "link: 'what'" in capsys.readouterr().err


CANVAS = "[...document.querySelectorAll('canvas')].sort((a, b) => b.width - a.width)[0]"


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
        until(lambda: viewer.history.state.queries == (word,), "the text arrives")
        after_change(page, first)
        count = int(viewer.answer(view_state.ViewQuery(word)).mask.sum())
        page.until(f"document.body.innerText.includes('{word}: {count} Gaussians')")
        page.until("document.querySelectorAll('figure img').length >= 3")
        click_a_region(viewer, page)
        outside = [url for url in page.asked if not url.startswith((address, "data:", "blob:", "ws://127.0.0.1"))]
        assert not outside


def begun(page) -> np.ndarray:
    """The picture once the scene is shown."""
    page.until(f"{input_of('find')} && {input_of('link')} && true")
    page.js("document.head.append(Object.assign(document.createElement('style'), { textContent: '" + QUIET + "' }))")
    first = after_change(page, np.full_like(scene_of(page), scene_of(page)[-1, 0]))
    assert len(np.unique(first.reshape(-1, 3) // 16, axis=0)) > 8, "the canvas is blank"
    return first


def click_a_region(viewer, page):
    """(region, its camera, left, top, width, height): clicks the region below the middle; the canvas's place, px."""
    width, height = page.js(f"(() => {{ const c = {CANVAS}; return [c.clientWidth, c.clientHeight]; }})()")
    x, y = round(0.4 * width), round(0.55 * height)
    focal = height / 2 / np.tan(viewer.scene.fovs[0] / 2)
    lens = (np.float32(v) for v in (focal, focal, width / 2, height / 2))
    seen_from = Camera(viewer.field.cameras.world_to_camera[0], *lens, width=width, height=height)
    region = int(region_shares_seen(viewer.field, seen_from, x, y).argmax())
    left, top = page.js(f"(() => {{ const r = {CANVAS}.getBoundingClientRect(); return [r.x, r.y]; }})()")
    page.click(left + x, top + y)
    until(lambda: viewer.history.state.queries == (region,), f"region {region} is clicked")
    return region, seen_from, left, top, width, height


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_in_a_browser_it_does_what_a_person_tries(viewer, tmp_path):
    """Sliders, shift and clicks, downloads, links, undo, frames. What each does to the field is tested above."""
    address = f"http://127.0.0.1:{viewer.server.get_port()}/"
    with opened(address, tmp_path, width=800, height=420) as page:
        begun(page)
        page.js("document.querySelectorAll('[role=slider]')[0].focus()")
        page.key("ArrowRight", 39)
        until(lambda: viewer.history.state.threshold == 0.51, "the threshold moves")

        region, seen_from, left, top, width, height = click_a_region(viewer, page)
        other = next(
            (u, v)
            for v in range(60, height - 40, 7)
            for u in range(20, width // 2, 7)
            if int(region_shares_seen(viewer.field, seen_from, u, v).argmax()) != region
            and region_shares_seen(viewer.field, seen_from, u, v).max() > 0.3
        )
        page.click(left + other[0], top + other[1], shift=True)
        until(lambda: len(viewer.history.state.queries) == 2, "a second region beside it")
        page.click(left + other[0], top + other[1], shift=True)
        until(lambda: viewer.history.state.queries == (region,), "and away again")

        page.press("export")
        packed = until(lambda: list((tmp_path / "downloads").glob("*.zip")), "the files arrive")[0]
        assert f"region-{region}.ply" in zipfile.ZipFile(packed).namelist()

        link = page.until(f"(() => {{ const e = {input_of('link')}; return e.value.includes('camera') && e.value }})()")
        clicked = scene_of(page)
        page.press("hide")
        until(lambda: viewer.history.state.hidden, "the region is hidden")
        after_change(page, clicked)
        page.type(input_of("link"), link)
        until(lambda: viewer.history.state.queries == (region,) and not viewer.history.state.hidden, "the link is back")
        until(lambda: (np.abs(scene_of(page) - clicked).max(-1) > 12).mean() < 0.005, "and looks the same")

        page.press("undo")
        until(lambda: viewer.history.state.hidden, "one step back")
        client = next(iter(viewer.server.get_clients().values()))
        viewer.go_to_frame(client, 2)
        centre = viewer.scene._centers[2]
        until(lambda: np.allclose(client.camera.position, centre, atol=1e-3), "at the frame")
        page.until("document.querySelectorAll('img').length > 0")
        viewer.scene.show_frames(True)
        time.sleep(1)
        near = viewer.scene._centers[0] + 0.04 * viewer.scene.scale * viewer.scene._rotations[0].as_matrix()[:, 2]
        place = viewer.scene._rotations[2].inv().apply(near - centre)
        focal = height / 2 / np.tan(viewer.scene.fovs[2] / 2)
        things = viewer.history.state.queries
        page.click(left + width / 2 + focal * place[0] / place[2], top + height / 2 + focal * place[1] / place[2])
        until(lambda: viewer.panel._frame.value == "frame_0", "the camera of another frame is clicked")
        assert viewer.history.state.queries == things
