"""The server: what it answers, and that odd input has an error of its own kind and nothing crashes."""

import asyncio
import dataclasses
import json
import random
import threading
import time

import cv2
import numpy as np
import pytest

pytest.importorskip("starlette", reason="the extra serve is not installed")
from small_field import make_field
from starlette.testclient import TestClient

from jsecon.app.guard import Guard, Limits
from jsecon.app.server import Scene, application, open_scenes, ready
from jsecon.errors import InputError
from jsecon.language.field import save_field
from jsecon.process import cores
from jsecon.vision.colours import ColourEmbedder

LIMITS = Limits(body=2000, seconds_to_send=0.3, waiting=4, text=80)
KINDS = {200, 400, 401, 404, 405, 408, 413, 422, 503}


@pytest.fixture(scope="module")
def scenes(scene, cameras):
    field, _ = make_field(scene, cameras, dim=ColourEmbedder().dim)
    return {name: Scene(name, field, ColourEmbedder()) for name in ("desk", "shelf")}


@pytest.fixture(scope="module")
def client(scenes):
    return TestClient(application(scenes, limits=LIMITS), raise_server_exceptions=False)


def test_a_text_and_a_pixel_are_answered(client, scenes):
    told = client.post("/query", json={"text": "red"}).json()
    assert told["field"] == "desk"
    assert told["count"] == int(scenes["desk"].ask("red").mask.sum())
    pixel = client.post("/query", json={"at": ["frame_1", 24, 20], "field": "shelf"}).json()
    assert pixel["field"] == "shelf"
    assert pixel["count"] > 0
    assert pixel["place"]["points"] == pixel["count"]
    assert len(pixel["place"]["axes"]) == 3
    assert client.post("/query", json={"at": [1, 24, 20]}).json()["count"] == pixel["count"]


def test_what_is_known_is_told_while_all_cores_are_taken(scenes):
    desk, told = scenes["desk"], []
    first = desk.tell("red")
    for _ in range(cores()):
        desk._free.acquire()
    try:
        known, new = (
            threading.Thread(target=lambda t=t: told.append(desk.tell(t)), daemon=True) for t in ("red", "blue")
        )
        new.start()
        known.start()
        known.join(20)
        assert told == [first]  # the new one waits
    finally:
        for _ in range(cores()):
            desk._free.release()
    new.join(20)
    assert len(told) == 2


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
    assert set(paths) == {"/query", "/regions", "/selection.ply", "/mask.png", "/healthz"}
    assert "/query" in client.get("/").text


@pytest.mark.parametrize(
    ("status", "body"),
    [
        (400, b"{"),
        (400, b"[1, 2]"),
        (422, b"{}"),
        (422, b'{"text": ""}'),
        (422, b'{"text": 7}'),
        (422, b'{"text": "red", "at": [0, 1, 2]}'),
        (422, b'{"at": [0, 1]}'),
        (422, b'{"at": [0, true, 2]}'),
        (422, b'{"at": [99, 1, 2]}'),
        (422, b'{"text": "red", "by": "magic"}'),
        (422, b'{"text": "red", "threshold": "a"}'),
        (422, b'{"text": "red", "threshold": NaN}'),
        (422, b'{"text": "red", "all": 1}'),
        (422, b'{"text": "red", "file": "/etc/passwd"}'),
        (422, b'{"text": "the meaning of life"}'),
        (404, b'{"text": "red", "field": "../../etc"}'),
        (404, b'{"text": "red", "field": ["desk"]}'),
        (413, b'{"text": "' + b"x" * 3000 + b'"}'),
        (400, b"[" * 1900),
    ],
)
def test_odd_questions_have_an_error_of_their_own_kind(client, status, body):
    answer = client.post("/query", content=body)
    assert answer.status_code == status, answer.text
    assert answer.json()["error"]


def test_paths_lead_nowhere(client):
    for path in ("/../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "/selection.ply/../../x", "//etc/passwd", "/query/"):
        assert client.get(path).status_code in (404, 405, 422), path
    assert client.get("/query").status_code == 405
    for frame in ("../../etc/passwd", "#99", ""):
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
        answer = client.post("/query", content=bytes(body))
        assert answer.status_code in KINDS, (bytes(body), answer.text)


def test_a_token_is_asked_for_where_one_is_set(scenes, tmp_path):
    guarded = TestClient(application(scenes, token="secret", limits=LIMITS))
    assert guarded.get("/healthz").status_code == 401
    assert guarded.get("/healthz", headers={"Authorization": "Bearer wrong"}).status_code == 401
    assert guarded.get("/healthz", headers={"Authorization": "Bearer secret"}).status_code == 200
    with pytest.raises(InputError, match="a token that clients must have"):
        ready([tmp_path / "none.npz"], host="0.0.0.0", port=0, token="", embedder=None)


def test_its_address_is_told_and_a_port_in_use_is_refused(scenes, tmp_path):
    field = dataclasses.replace(scenes["desk"].field, embedder=ColourEmbedder().name)
    save_field(tmp_path / "field.npz", field)
    given = {"host": "127.0.0.1", "token": "", "embedder": None}
    told, _ = ready([tmp_path / "field.npz"], port=0, **given)
    port = int(told["address"].removeprefix("http://127.0.0.1:"))
    assert port > 0
    assert [scene["name"] for scene in told["fields"]] == [tmp_path.name]
    with pytest.raises(InputError, match="in use"):
        ready([tmp_path / "field.npz"], port=port, **given)


def sent(receive, limits=LIMITS, app=None):
    """(status, body) that the guard lets through or not."""
    told = []

    async def reached(scope, receive, send):
        message = await receive()
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": message["body"]})

    async def send(message):
        told.append(message)

    async def run():
        await Guard(app or reached, "", limits)({"type": "http", "headers": []}, receive, send)

    asyncio.run(run())
    return told[0]["status"], told[1]["body"]


def test_a_slow_sender_and_one_that_goes_away(scenes):
    async def slow():
        await asyncio.sleep(0.1)
        return {"type": "http.request", "body": b"x", "more_body": True}

    assert sent(slow)[0] == 408

    async def gone():
        return {"type": "http.disconnect"}

    assert sent(gone)[0] == 400

    async def endless():
        return {"type": "http.request", "body": b"x" * 900, "more_body": True}

    assert sent(endless)[0] == 413

    async def whole():
        return {"type": "http.request", "body": b"abc"}

    assert sent(whole) == (200, b"abc")
    assert sent(whole, Limits(waiting=0))[0] == 503


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
    field, _ = make_field(scene, cameras, dim=ColourEmbedder().dim)
    from dataclasses import replace

    field = replace(field, embedder=ColourEmbedder().name)
    files = [tmp_path / name / "field.npz" for name in ("a", "b")]
    for file in files:
        file.parent.mkdir()
        save_field(file, field)
    assert list(open_scenes(files, None)) == ["a", "b"]
    with pytest.raises(InputError, match="a second field named 'a'"):
        open_scenes([files[0], files[0]], None)
