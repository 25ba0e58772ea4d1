"""The server: what it answers, and that odd input has an error of its own kind and nothing crashes."""

import asyncio
import json
import random
import socket
import threading
import time

import cv2
import numpy as np
import pytest

pytest.importorskip("fastapi", reason="the extra serve is not installed")
from small_field import colour_field
from starlette.exceptions import HTTPException
from starlette.testclient import TestClient
from table_field import table_field

from jsecon import InputError, save_field
from jsecon.app.scene import Scene
from jsecon.app.server.api import application
from jsecon.app.server.guard import Limits, Workers
from jsecon.app.server.scenes import open_scenes
from jsecon.app.server.serve import prepare
from jsecon.process import cores
from jsecon.vision.colours import ColourEmbedder

LIMITS = Limits(body=2000, seconds_to_send=0.3, waiting=4)
KINDS = {200, 400, 401, 404, 405, 408, 413, 422, 503}
HERE, JSON = "http://127.0.0.1:8765", {"content-type": "application/json"}


@pytest.fixture(scope="module")
def scenes(scene, cameras):
    field = colour_field(scene, cameras)
    return {name: Scene(field, ColourEmbedder(), name=name) for name in ("desk", "shelf")}


@pytest.fixture(scope="module")
def client(scenes):
    return TestClient(application(scenes, limits=LIMITS), HERE, raise_server_exceptions=False)


def test_a_text_and_a_pixel_are_answered(client, scenes):
    told = client.post("/query", json={"text": "red"}).json()
    assert told["field"] == "desk"
    assert told["count"] == int(scenes["desk"].ask("red").mask.sum())
    pixel = client.post("/query", json={"at": ["frame_1", 24, 20], "field": "shelf"}).json()
    assert pixel["field"] == "shelf"
    assert pixel["count"] > 0
    assert len(pixel["place"]["axes"]) == 3
    assert client.post("/query", json={"at": [1, 24, 20]}).json()["count"] == pixel["count"]


def test_what_is_known_is_told_while_all_threads_are_taken_and_no_thread_is_added(scenes, monkeypatch):
    """A soak: questions that take longer than clients wait keep their places; those beyond are told to come back."""
    held, limits = threading.Event(), Limits(waiting=cores() + 3, seconds=0.05)
    desk, asked = scenes["desk"], []

    ask_in_time = desk.ask

    def slow(query):
        asked.append(str(query))
        assert held.wait(60)
        return ask_in_time("green")

    with TestClient(application({"desk": desk}, limits=limits), HERE) as client:

        def ask(text):
            return client.post("/query", json={"text": text})

        first = ask("red")
        while first.status_code == 503:  # it was computed for longer than 0.05 s
            first = ask("red")
        monkeypatch.setattr(desk, "ask", slow)
        before = threading.active_count()
        answers = [ask(f"thing {k}") for k in range(20)]
        assert {answer.status_code for answer in answers} == {503}
        assert len(asked) == cores()
        assert "wait for an answer" not in answers[0].json()["error"]
        assert threading.active_count() <= before + cores()
        assert ask("red").json() == first.json()
        texts = [client.post("/query", json={"text": f"more {k}"}).json()["error"] for k in range(3)]
        assert all("0.05 s" in text for text in texts), "those that never began have left their places"
        held.set()
        answer = ask("green")
        while answer.status_code == 503:
            answer = ask("green")
        assert answer.json()["query"] == "green"
        assert not any(text.startswith("more") for text in asked)


def test_places_are_bounded_and_given_back():
    """One thread: a running query keeps its place when its client gives up, and one that waits leaves."""

    async def soak():
        blocked = threading.Event()
        workers = Workers(1, 2)
        for _ in range(30):
            with pytest.raises(HTTPException, match=r"within 0\.002 s"):
                await workers.compute(blocked.wait, 0.002)
        waits = asyncio.ensure_future(workers.compute(lambda: "late", 20))
        await asyncio.sleep(0.01)
        with pytest.raises(HTTPException, match="Too many queries"):
            await workers.compute(lambda: 1, 1)
        blocked.set()
        assert await waits == "late"
        assert await workers.compute(lambda: 3, 20) == 3
        workers.close()

    asyncio.run(soak())


def test_a_field_of_a_request_that_is_wrong_is_named(client):
    for body, field in (({"at": [True, 1, 2]}, "at"), ({"text": "caf\udce9 red"}, "text"), ({"at": [0, 99, 2]}, "at")):
        error = client.post("/query", content=json.dumps(body), headers=JSON).json()["error"]
        assert error.startswith(f'Field "{field}": ')
    error = client.get("/mask.png", params={"text": "red", "frame": "#99"}).json()["error"]
    assert error.startswith('Field "frame": ')


@pytest.mark.parametrize(("status", "headers"), [
    (200, {"host": "localhost", **JSON}),
    (200, {"host": "[::1]:8765", "content-type": "Application/JSON; charset=utf-8"}),
    (200, {"host": "box.lan", **JSON}), (403, {"host": "evil.example:8765", **JSON}), (403, {"host": "", **JSON}),
    (415, {"content-type": "text/plain"}), (415, {"content-type": ""}),
    (415, {"content-type": "application/x-www-form-urlencoded"}),
])  # fmt: skip
def test_a_page_of_another_site_cannot_ask(scenes, status, headers):
    client = TestClient(application(scenes, limits=LIMITS, hosts=("box.lan",)), HERE)
    assert client.post("/query", content=b'{"text": "red"}', headers=headers).status_code == status


def test_get_takes_what_it_lists_and_nothing_else(client):
    paths = client.get("/openapi.json").json()["paths"]
    for path in ("/regions", "/selection.ply", "/mask.png", "/healthz"):
        listed = [parameter["name"] for parameter in paths[path]["get"].get("parameters", [])]
        usual = {"text": "red", "field": "desk", "by": "votes", "frame": "#0"}
        found = client.get(path, params={name: usual[name] for name in listed})
        assert found.status_code == 200 or "selects nothing" in found.text, found.text
        if listed:
            for other in {"at", "threshold", "all", "frame"} - set(listed):
                found = client.get(path, params={"text": "red", other: "1"})
                assert found.status_code == 422
                assert f"takes {', '.join(listed)}." in found.json()["error"]


def test_what_it_knows_and_files_of_the_answer(client, scenes):
    health = client.get("/healthz").json()
    assert [field["name"] for field in health["fields"]] == ["desk", "shelf"]
    assert health["fields"][0]["gaussians"] == 64
    regions = client.get("/regions").json()["regions"]
    assert len(regions) == 5
    assert regions[0]["frame"].startswith("frame_")
    words = next(w for w in ("red", "green", "blue", "white", "black", "brown") if scenes["desk"].ask(w).mask.any())
    ply = client.get("/selection.ply", params={"text": words})
    assert ply.content.startswith(b"ply\n")
    image = client.get("/mask.png", params={"text": words, "frame": "#2"})
    assert image.headers["x-frame"] == "frame_2"
    assert cv2.imdecode(np.frombuffer(image.content, np.uint8), cv2.IMREAD_UNCHANGED).shape == (40, 48)
    paths = client.get("/openapi.json").json()["paths"]
    answers = {"/query", "/relation", "/measure", "/objects", "/regions", "/selection.ply", "/mask.png", "/healthz"}
    assert set(paths) == answers
    assert "/query" in client.get("/").text


def test_relations_measures_and_objects():
    field, embedder = table_field()
    client = TestClient(application({"table": Scene(field, embedder, name="table")}, limits=LIMITS), HERE)
    told = client.post("/relation", json={"text": "the red mug left of the dark green bottle", "frame": 0}).json()
    assert told["count"] == 1
    assert told["objects"][0]["center"] == pytest.approx([-0.5, 0, 0.05], abs=0.02)
    assert told["viewpoint"] == "as seen from frame_0"
    two = client.post("/relation", json={"text": "the red mug"}).json()
    assert two["ambiguous"]
    assert two["question"].endswith("?")
    way = client.post("/measure", json={"a": "dark blue box", "b": "dark green bottle"}).json()
    assert way["centers"] == pytest.approx(0.6, rel=0.05)
    listed = client.get("/objects", params={"field": "table"}).json()["objects"]
    assert len(listed) == 6
    for path, body, word in (
        ("/relation", {"text": "mug across from the bottle"}, "'across'"),
        ("/relation", {"text": "red mug left of the bottle"}, "colour"),
        ("/relation", {"text": "leftmost red mug", "frame": "no"}, "no such frame"),
        ("/relation", {"text": "red mug", "frame": 1.5}, "frame"),
        ("/measure", {"a": "red mug", "b": "dark blue box"}, "names 2 objects"),
        ("/measure", {"a": "red mug"}, '"b"'),
        ("/relation", {"text": "red mug", "from": "x"}, "takes field, text, frame"),
    ):
        answer = client.post(path, json=body)
        assert answer.status_code == 422
        assert word in answer.json()["error"]


@pytest.mark.parametrize(("status", "body"), [
    (400, b"{"), (400, b"[1, 2]"), (422, b"{}"), (422, b'{"text": ""}'), (422, b'{"text": 7}'),
    (422, b'{"text": "red", "at": [0, 1, 2]}'), (422, b'{"at": [0, 1]}'), (422, b'{"at": [0, true, 2]}'),
    (422, b'{"at": [true, 1, 2]}'), (422, b'{"at": ["frame_1", 1e400, 2]}'), (422, b'{"at": ["frame_1", NaN, 2]}'),
    (422, b'{"at": ["\\udce9", 1, 2]}'), (422, b'{"at": ["#99999999999999999999", 1, 2]}'),
    (422, b'{"at": ["#\xc2\xb2", 1, 2]}'), (422, b'{"at": [0, 1' + b"0" * 200 + b", 2]}"),
    (422, b'{"at": [0, 1, 2], "by": "one_step"}'), (422, b'{"at": [0, 1, 2], "all": true}'),
    (422, b'{"text": "caf\\udce9 red"}'), (422, b'{"text": null}'), (422, b'{"text": "red", "by": ["votes"]}'),
    (422, b'{"text": "red", "by": {}}'), (422, b'{"text": "red", "frame": "#0"}'),
    (422, b'{"text": "red", "\\udce9": 1}'), (404, b'{"text": "red", "field": "\\udce9"}'),
    (422, b'{"at": [99, 1, 2]}'), (422, b'{"text": "red", "by": "magic"}'),
    (422, b'{"text": "red", "threshold": "a"}'), (422, b'{"text": "red", "threshold": NaN}'),
    (422, b'{"text": "red", "all": 1}'), (422, b'{"text": "red", "file": "/etc/passwd"}'),
    (422, b'{"text": "the meaning of life"}'), (404, b'{"text": "red", "field": "../../etc"}'),
    (404, b'{"text": "red", "field": ["desk"]}'), (413, b'{"text": "' + b"x" * 3000 + b'"}'), (400, b"[" * 1900),
])  # fmt: skip
def test_odd_questions_have_an_error_of_their_own_kind(client, status, body):
    answer = client.post("/query", content=body, headers=JSON)
    assert answer.status_code == status, answer.text
    assert answer.json()["error"]
    assert "--" not in answer.json()["error"]


def test_paths_lead_nowhere(client):
    for path in ("/../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "/selection.ply/../../x", "//etc/passwd", "/query/"):
        assert client.get(path).status_code in (404, 405, 422), path
    assert client.get("/query").status_code == 405
    for frame in ("../../etc/passwd", ""):
        assert client.get("/mask.png", params={"text": "red", "frame": frame}).status_code == 422


def test_mutated_requests_never_crash_it(client):
    """Seeded; a second in the suite, 10,000 by hand (`benchmarks/serve.py`)."""
    draw = random.Random(0)
    seeds = [b'{"text": "red mug", "by": "votes", "all": true}', b'{"at": ["frame_1", 3, 4], "threshold": 0.5}']
    for _ in range(300):
        body = bytearray(draw.choice(seeds))
        for _ in range(draw.randint(1, 6)):
            place = draw.randrange(len(body))
            body[place : place + draw.randint(0, 3)] = bytes(draw.randrange(256) for _ in range(draw.randint(0, 3)))
        answer = client.post("/query", content=bytes(body), headers=JSON)
        assert answer.status_code in KINDS, (bytes(body), answer.text)


def test_a_token_is_asked_for_where_one_is_set(scenes, tmp_path):
    guarded = TestClient(application(scenes, token="secret", limits=LIMITS), "http://any.name")
    assert guarded.get("/healthz").status_code == 401
    assert guarded.get("/healthz", headers={"Authorization": "Bearer wrong"}).status_code == 401
    assert guarded.get("/healthz", headers={"Authorization": "Bearer secret"}).status_code == 200
    with pytest.raises(InputError, match="a token that clients must have"):
        prepare([tmp_path / "none.safetensors"], host="0.0.0.0", port=0, token="", embedder=None)


def test_its_address_is_told_and_a_port_in_use_is_refused(scenes, tmp_path):
    save_field(tmp_path / "field.safetensors", scenes["desk"].field)
    given = {"host": "127.0.0.1", "token": "", "embedder": None}
    told, _ = prepare([tmp_path / "field.safetensors"], port=0, **given)
    port = int(told["address"].removeprefix("http://127.0.0.1:"))
    assert port > 0
    assert [scene["name"] for scene in told["fields"]] == [tmp_path.name]
    if has_ipv6():
        six, _run = prepare([tmp_path / "field.safetensors"], port=0, **given | {"host": "::1"})
        assert six["address"].startswith("http://[::1]:")
    with pytest.raises(InputError, match="in use"):
        prepare([tmp_path / "field.safetensors"], port=port, **given)


def has_ipv6() -> bool:
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        return False
    return True


def sent(scenes, receive, limits=LIMITS):
    """Status of the answer to a request whose body comes from `receive`."""
    told = []
    headers = [(b"host", b"localhost"), (b"content-type", b"application/json")]
    scope = {"type": "http", "method": "POST", "path": "/query", "query_string": b"", "headers": headers}

    async def send(message):
        told.append(message)

    asyncio.run(application(scenes, limits=limits)(scope, receive, send))
    return told[0]["status"]


def test_a_slow_sender_and_one_that_goes_away(scenes):
    async def slow():
        await asyncio.sleep(0.1)
        return {"type": "http.request", "body": b"x", "more_body": True}

    async def gone():
        return {"type": "http.disconnect"}

    async def endless():
        return {"type": "http.request", "body": b"x" * 900, "more_body": True}

    async def complete():
        return {"type": "http.request", "body": b'{"text": "red"}'}

    assert sent(scenes, slow) == 408
    assert sent(scenes, gone) == 400
    assert sent(scenes, endless) == 413
    assert sent(scenes, complete) == 200


def test_clients_at_once_get_the_same_answers(client):
    texts, found = ["red", "green", "blue"], {}

    def ask(k):
        for text in texts:
            answer = client.post("/query", json={"text": text})
            while answer.status_code == 503:  # LIMITS.waiting
                time.sleep(0.01)
                answer = client.post("/query", json={"text": text})
            found.setdefault(text, []).append(answer.json())

    threads = [threading.Thread(target=ask, args=(k,)) for k in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for answers in found.values():
        assert len(answers) == 8
        assert all(json.dumps(a) == json.dumps(answers[0]) for a in answers)


def test_fields_are_opened_by_their_folders_names(scene, cameras, tmp_path):
    files = [tmp_path / name / "field.safetensors" for name in ("a", "b")]
    for file in files:
        file.parent.mkdir()
        save_field(file, colour_field(scene, cameras))
    assert list(open_scenes(files, None)) == ["a", "b"]
    with pytest.raises(InputError, match="a second field named 'a'"):
        open_scenes([files[0], files[0]], None)
