"""Questions of all kinds through every door: command line, export, HTTP, tools, viewer's page, evaluation and Python
give the same Gaussians, to the bit."""

import base64
import json
import re
from concurrent.futures import Future

import numpy as np
import pytest
from capture_files import run_cli
from starlette.testclient import TestClient
from table_field import THINGS, table_field
from test_mcp import call

from jsecon import At, Box, InputError, Mask, Region, Scene, load_gaussians, open_scene, save_field
from jsecon.app.evaluation import evaluate
from jsecon.app.mcp_server import make_server
from jsecon.app.server import application, page_application
from jsecon.pipeline.progress import Console
from jsecon.read.masks.labels import LabelledFrame

TEXTS = (
    *("red mug", "dark green bottle", "white plate", "orange ball", "dark blue box", "green", "blue", "purple vase"),
    *("red mug or orange ball", '"red mug" or "white plate" but not "orange ball"', "blue but not dark blue"),
    *("the red mug left of the dark green bottle", "the red mug right of the dark green bottle"),
    *("the leftmost red mug", "the largest blue thing"),
    *("the orange ball on the white plate", "the white plate under the orange ball"),
    *("the second red mug from the left", "two red mugs", "how many red mugs", "the red mug near the dark blue box"),
    *("the dark green bottle between the red mugs", "the dark blue box behind the dark green bottle"),
    *("the left red mug", "the right red mug", "the red mug closer to the white plate", "the smaller of the red mugs"),
    *("the red mug within 60 units of the dark blue box", "what is on the white plate?"),
    "what is left of the dark green bottle",
    *("the orange ball directly above the white plate", "where is the white plate", "is there a red mug"),
    *("the orange ball on the dark blue box", "'red mug left of green'", "all red mugs"),
    "red mug; white plate",  # one question, also on a page
)
REFUSED = {"the second red mug": "'second'", "the red mug opposite the white plate": "'opposite'",
           "the red mug 5 m left of the white plate": "'5 m left of'", "the other red mug": "'other'"}  # fmt: skip
"""text -> the word that its refusal names"""
OUTLINE = np.pad(np.ones((30, 40), bool), ((20, 30), (30, 30)))
POINTED = (At("frame_0", 36, 36), At(0, 45, 33), Mask({"#0": OUTLINE}), Box("#0", 30, 20, 70, 60), Region(4))


@pytest.fixture(scope="module")
def door(tmp_path_factory):
    """The scene of the table, its file, and question -> rows of the answer in Python."""
    things = (*THINGS, ("light grey floor", (0.0, 0.0, -0.02), (1.5, 1.5, 0.001)))
    folder = tmp_path_factory.mktemp("table")
    save_field(folder / "field.safetensors", table_field(things)[0])
    scene = open_scene(folder)
    return scene, folder / "field.safetensors", {text: scene.ask(text).rows for text in TEXTS}


def rows_of(scene, file) -> np.ndarray:
    """The Gaussians that a .ply holds: every centre of the table occurs once."""
    place = {mean.tobytes(): row for row, mean in enumerate(np.asarray(scene.field.gaussians.means, np.float32))}
    return np.sort([place[mean.tobytes()] for mean in np.asarray(load_gaussians(file).means, np.float32)]).astype(int)


def rows_of_mask(packed) -> list[int]:
    """The Gaussians of a mask as the pages have it."""
    bits = np.unpackbits(np.frombuffer(base64.b64decode(packed), np.uint8), bitorder="little")
    return np.flatnonzero(bits).tolist()


def content_of(page) -> dict:
    """What a page has of its scene."""
    return json.loads(re.search(r'id="scene-data">(.*?)</script>', page)[1])


@pytest.fixture(scope="module")
def client(door):
    """Asks over HTTP."""
    return TestClient(application({"table": door[0]}), "http://127.0.0.1:8765")


@pytest.fixture(scope="module")
def find(door):
    """Gives the results of the tool `find` for texts."""
    opened = Future()
    opened.set_result(door[0])

    server = make_server({"table": opened})
    return lambda *texts: [call(server, "find", text=text) for text in texts]


def test_they_are_of_all_kinds(door):
    answers = [door[0].ask(question) for question in (*TEXTS, *POINTED)]
    assert {answer.by for answer in answers} == {"votes", "relation", "outline"}
    assert len({answer.rows.tobytes() for answer in answers}) >= 10


def test_the_command_line(door, tmp_path, capsys):
    scene, file, _ = door
    options = ["--at", "frame_0", 36, 36, "--at", "#0", 45, 33]
    texts = (*TEXTS, TEXTS[0])  # one of them twice
    assert run_cli("query", file, *texts, *options, "--views", 0, "--out", tmp_path, "--json") == 0
    records = json.loads(capsys.readouterr().out)["answers"]
    questions = (*texts, *POINTED[:2])
    assert len(records) == len(questions)
    for question, record in zip(questions, records):
        answer = scene.ask(question)
        assert record == json.loads(json.dumps(answer.as_dict())) | {"ply": record["ply"], "masks": {}}
        if len(answer.rows):
            np.testing.assert_array_equal(rows_of(scene, tmp_path / record["ply"]), answer.rows)
        else:
            assert record["ply"] is None


def test_the_export_of_one_thing(door, tmp_path):
    scene, file, rows = door
    for text in TEXTS:
        code = run_cli("export", file, "--only", text, "--out", tmp_path / "only.ply")
        assert code == (0 if len(rows[text]) else 2), text
        if code == 0:
            np.testing.assert_array_equal(rows_of(scene, tmp_path / "only.ply"), rows[text])
    text = "the left red mug"
    assert run_cli("export", file, "--without", text, "--out", tmp_path / "rest.ply") == 0
    rest = np.setdiff1d(np.arange(scene.field.gaussians.count), rows[text])
    np.testing.assert_array_equal(rows_of(scene, tmp_path / "rest.ply"), rest)


def test_every_door_names_the_word_that_it_does_not_understand(door, client, find, tmp_path, capsys):
    _, file, _ = door
    for text, word in REFUSED.items():
        for verb in (["query", file, text], ["export", file, "--only", text], ["export", file, "--without", text]):
            assert run_cli(*verb, "--out", tmp_path / "out.ply") == 2
            assert word in capsys.readouterr().err
        replies = [client.post("/query", json={"text": text}), client.get("/selection.ply", params={"text": text})]
        assert [(reply.status_code, word in reply.text) for reply in replies] == [(422, True)] * 2
        (told,) = find(text)
        assert told.is_error
        assert word in told.content[0].text
    assert not (tmp_path / "out.ply").is_file()


def test_http(door, client, tmp_path):
    scene, _, rows = door
    for text in TEXTS:
        record = client.post("/query", json={"text": text}).json()
        assert {k: v for k, v in record.items() if k != "field"} == json.loads(json.dumps(scene.ask(text).as_dict()))
        found = client.get("/selection.ply", params={"text": text})
        if len(rows[text]):
            (tmp_path / "selection.ply").write_bytes(found.content)
            np.testing.assert_array_equal(rows_of(scene, tmp_path / "selection.ply"), rows[text])
        else:
            assert found.status_code == 422
    pixel = client.post("/query", json={"at": ["frame_0", 36, 36]}).json()
    assert pixel["region"] == scene.ask(POINTED[0]).as_dict()["region"]


def test_tools_of_language_models(door, find):
    for text, told in zip(TEXTS, find(*TEXTS), strict=True):
        record, expected = told.structured_content, json.loads(json.dumps(door[0].ask(text).as_dict()))
        assert {name: record[name] for name in expected} == expected


def test_the_viewers_page(door, tmp_path):
    scene, file, rows = door
    assert run_cli("view", file, *TEXTS, "--export", tmp_path / "page.html") == 0
    content = content_of((tmp_path / "page.html").read_text())
    assert content["count"] == scene.field.gaussians.count
    assert [*content["texts"]] == [*TEXTS]
    for text, shown in content["texts"].items():
        assert rows_of_mask(shown["mask"]) == rows[text].tolist()


def test_the_served_page(door):
    asked = TestClient(page_application(door[0], TEXTS), "http://127.0.0.1:8766")
    assert [*content_of(asked.get("/").text)["texts"]] == [*TEXTS]
    for texts in (TEXTS[:20], TEXTS[20:]):
        answers = asked.post("/ask", json={"questions": texts}).json()["answers"]
        for text, shown in zip(texts, answers, strict=True):
            assert rows_of_mask(shown["mask"]) == door[2][text].tolist()


def test_the_evaluation(door):
    scene, _, rows = door
    outline = np.ones((80, 100), bool), np.array([[0, 0, 100, 80]], np.float32)
    labels = [LabelledFrame("frame_0", 100, 80, dict.fromkeys(TEXTS, outline))]
    measured = evaluate(scene, labels, Console())[0]
    assert {row.query: row.selected for row in measured} == {text: len(rows[text]) for text in TEXTS}


def test_texts_come_back_in_order(door):
    scene = Scene(door[0].field, door[0].embedder)
    texts = ["the leftmost red mug", "white plate", "the leftmost red mug", "nothing known", "white plate"]
    answers = scene.ask_all(texts)
    assert [isinstance(found, InputError) for found in answers] == [False, False, False, True, False]
    assert [str(found.query) for found in answers[:3]] == texts[:3]


def test_a_mask_that_changes_is_asked_anew(door):
    outline = OUTLINE.copy()
    before = door[0].ask(Mask({"#0": outline})).mask
    outline[:] = False
    outline[:20, :20] = True
    assert not np.array_equal(door[0].ask(Mask({"#0": outline})).mask, before)
