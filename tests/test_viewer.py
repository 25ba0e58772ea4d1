"""The served page: what its routes answer, who may see it, and in a browser what a person would try."""

import base64
import csv
import dataclasses
import json
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("fastapi", reason="the extra serve is not installed")
import uvicorn
from browser import CHROMIUM, opened, until
from capture_files import refused
from small_field import colour_field
from starlette.testclient import TestClient

from jsecon import load_gaussians, save_field
from jsecon.app import verbs
from jsecon.app.catalogue import main_regions
from jsecon.app.records import Query, Region
from jsecon.app.scene import Scene
from jsecon.app.server import listen, page_application
from jsecon.app.viewer.view import _view
from jsecon.change.history import change_object
from jsecon.pipeline.progress import Console
from jsecon.vision.colours import BASIC, ColourEmbedder

HERE = "http://127.0.0.1:8766"
TREE = np.array([5, 5, -1, -1, -1, -1], np.int32)


@pytest.fixture(scope="module")
def asked(scene, cameras):
    field = colour_field(scene, cameras)
    leaf = main_regions(field).astype(np.int32)
    field = dataclasses.replace(field, tree=TREE, leaf=leaf, metres_per_unit=0.5)
    mask, event = np.arange(64) < 9, {"kind": "moved", "name": "ball", "date": "2026-11-02", "region": 0}
    return Scene(change_object(field, mask, event, motion=np.eye(4)), ColourEmbedder(), name="<desk>")


@pytest.fixture(scope="module")
def word(asked):
    """A colour that selects a part of the scene."""
    return next(word for word in BASIC if 3 < asked.ask(word, threshold=0.5).mask.sum() < 30)


@pytest.fixture(scope="module")
def client(asked):
    return TestClient(page_application(asked), HERE, raise_server_exceptions=False)


def bits_of(record) -> np.ndarray:
    return np.unpackbits(np.frombuffer(base64.b64decode(record["mask"]), np.uint8), bitorder="little")[:64].astype(bool)


def test_answers_are_those_of_the_scene_and_each_error_has_its_place(asked, client, word):
    body = {"questions": [word, "the meaning of life", 1, 5, 4000, "what moved"], "threshold": 0.4}
    found = client.post("/ask", json=body).json()["answers"]
    for record, question in zip(found, (word, None, Region(1), Region(5), Region(4000), "what moved"), strict=True):
        if question is None:
            assert "no colour word" in record["words"]
            assert "dark green bottle" in record["remedy"]
            continue
        answer = asked.ask(Query(question, threshold=0.4))
        np.testing.assert_array_equal(bits_of(record), answer.mask)
        assert record["words"] == answer.describe()
    assert "there is no region 4000" in found[4]["words"]
    assert bits_of(found[5]).sum() == 9


@pytest.mark.parametrize("body", [
    {}, {"questions": [" "]}, {"questions": [1.5]}, {"questions": ["red"], "threshold": 2},
    {"questions": ["red"] * 33}, {"questions": ["red"], "path": "/etc/passwd"},
])  # fmt: skip
def test_odd_requests_are_refused(client, body):
    reply = client.post("/ask", json=body)
    assert reply.status_code == 422
    assert reply.json()["error"]


def test_the_export_has_the_gaussians_of_all_answers(asked, client, word, tmp_path):
    for questions in ([], ["the meaning of life"]):
        nothing = client.post("/selection.ply", json={"questions": questions})
        assert (nothing.status_code, "no Gaussian is selected" in nothing.json()["error"]) == (422, True)
    reply = client.post("/selection.ply", json={"questions": [word, 1, "the meaning of life"]})
    (tmp_path / "selection.ply").write_bytes(reply.content)
    masks = [asked.ask(question, threshold=0.5).mask for question in (word, Region(1))]
    means = np.asarray(asked.field.gaussians.means)[masks[0] | masks[1]]
    np.testing.assert_array_equal(load_gaussians(tmp_path / "selection.ply").means, means)


def test_the_page_is_shown_to_who_names_this_machine_and_asks_in_json(client):
    for host, status in (("127.0.0.1:8766", 200), ("localhost:8766", 200), ("evil.example", 403)):
        assert client.get("/", headers={"host": host}).status_code == status
    assert client.post("/ask", content=b'{"questions": []}', headers={"content-type": "text/plain"}).status_code == 415


def test_a_taken_port_and_a_missing_extra_are_refused(asked, tmp_path, monkeypatch):
    save_field(tmp_path / "field.safetensors", asked.field)
    with listen("127.0.0.1", 0)[0] as taken, refused("--port"):
        _view(verbs.View(field=tmp_path, texts=[], port=taken.getsockname()[1]), Console())
    monkeypatch.delitem(sys.modules, "jsecon.app.server")
    monkeypatch.setitem(sys.modules, "fastapi", None)
    with refused("fastapi is missing"):
        _view(verbs.View(field=tmp_path, texts=[], port=0), Console())


@pytest.fixture(scope="module")
def address(asked):
    socket, url = listen("127.0.0.1", 0)
    with socket:
        server = uvicorn.Server(uvicorn.Config(page_application(asked, ["pink"]), log_level="warning"))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [socket]})
        thread.start()
        yield f"{url}/"
        server.should_exit = True
        thread.join()


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_in_a_browser_texts_and_clicks_light_up_and_controls_act(asked, address, word, tmp_path):
    with opened(address, tmp_path, width=900, height=700) as page:
        folder = str(tmp_path)
        page.send("Browser.setDownloadBehavior", behavior="allow", downloadPath=folder)
        page.until(f"element('answers').innerText.includes({json.dumps(asked.ask('pink', threshold=0.5).describe())})")
        assert page.js("[...element('texts').children].map(chip => chip.innerText)") == [
            "pink",
            "what moved",
            "what is new",
        ]
        page.type("element('text')", f" {word} ;;<script>alert(1)</script> red; {word}")
        count = int(asked.ask(word, threshold=0.5).mask.sum())
        page.until(f"element('answers').innerText.includes('{word}: {count} of 64 Gaussians')")
        assert page.js("asked") == [word, "<script>alert(1)</script> red"]
        x, y = page.js("[canvas.width / 2, canvas.height / 2]")
        own = page.js(f"pick({x}, {y}).region")
        page.click(x, y)
        region = asked.ask(Region(own), threshold=0.5)
        page.until(f"element('answers').innerText === {json.dumps(f'region {own}: {region.describe()}')}")
        page.js("""[...element('texts').children].find(chip => chip.innerText === 'what moved').click()""")
        page.until("element('answers').innerText.includes('ball moved 2026-11-02')")
        page.js("element('threshold').focus()")
        page.key("ArrowRight", 39)
        moved = asked.ask(Region(own), threshold=0.51).describe()
        page.until(f"shown.threshold === 0.51 && element('answers').innerText.includes({json.dumps(moved)})")
        page.js("element('only').click(); element('frame').value = 2")
        page.js("element('frame').onchange({ target: element('frame') })")
        page.until("hides() && !element('answers').innerText.includes('…')")
        page.js("lengths.push([[0, 0, 0], [0, 3, 4]]); element('export').click()")
        until(lambda: Path(folder, "selection.ply").exists(), "the export is there")
        (row,) = csv.DictReader(Path(folder, "lengths.csv").read_text().splitlines())
        assert (float(row["length"]), row["unit"], float(row["to_z"])) == (pytest.approx(2.5), "m", pytest.approx(4))
        page.until("decodeURIComponent(location.hash.slice(1)) === JSON.stringify({ view, asked, shown })")
        before = page.js("JSON.stringify([view, asked, shown])")
        page.send("Page.reload")
        page.until(
            f"document.readyState === 'complete' && JSON.stringify([view, asked, shown]) === {json.dumps(before)}"
        )
        page.until("anyLit")
        assert [url for url in page.asked if not url.startswith((address, "data:", "blob:"))] == []


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_in_a_browser_a_server_that_is_gone_is_told(asked, tmp_path):
    file = tmp_path / "page.html"
    file.write_text(TestClient(page_application(asked), HERE).get("/").text)
    with opened(f"file://{file}", tmp_path) as page:
        page.until("document.readyState === 'complete'")
        page.type("element('text')", "red")
        page.until("element('answers').innerText.includes('The server does not answer')")
