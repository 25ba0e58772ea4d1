"""The server: what it answers, and that odd input has an error of its own kind and nothing crashes."""

import json
import random
import socket

import cv2
import numpy as np
import pytest

pytest.importorskip("fastapi", reason="the extra serve is not installed")
from small_field import colour_field
from starlette.testclient import TestClient
from table_field import table_field

from jsecon import InputError, save_field
from jsecon.app.scene import Scene, open_scenes
from jsecon.app.server import MAX_BODY, application, prepare
from jsecon.vision.colours import ColourEmbedder

KINDS = {200, 400, 404, 413, 422}
HERE, JSON = "http://127.0.0.1:8765", {"content-type": "application/json"}


@pytest.fixture(scope="module")
def scenes(scene, cameras):
    field = colour_field(scene, cameras)
    return {name: Scene(field, ColourEmbedder(), name=name) for name in ("desk", "shelf")}


@pytest.fixture(scope="module")
def client(scenes):
    return TestClient(application(scenes), HERE, raise_server_exceptions=False)


def test_a_text_and_a_pixel_are_answered(client, scenes):
    told = client.post("/query", json={"text": "red"}).json()
    assert told["field"] == "desk"
    assert told["count"] == int(scenes["desk"].ask("red").mask.sum())
    pixel = client.post("/query", json={"at": ["frame_1", 24, 20], "field": "shelf"}).json()
    assert pixel["field"] == "shelf"
    assert pixel["count"] > 0
    assert len(pixel["place"]["axes"]) == 3
    assert client.post("/query", json={"at": [1, 24, 20]}).json()["count"] == pixel["count"]


def test_what_is_wrong_in_a_request_is_named(client):
    for body, problem in (
        ({"at": [True, 1, 2]}, 'Field "at": '),
        ({"text": "caf\udce9 red"}, 'Field "text": '),
        ({"at": [0, 99, 2]}, "column 99"),
        ({"text": "red", "field": "attic"}, "there is no such field"),
    ):
        answer = client.post("/query", content=json.dumps(body), headers=JSON)
        assert answer.status_code == 422
        assert problem in answer.json()["error"]
    error = client.get("/mask.png", params={"text": "red", "frame": "#99"}).json()["error"]
    assert "frame #99" in error


@pytest.mark.parametrize(("status", "headers"), [
    (200, {"host": "localhost", **JSON}),
    (200, {"host": "[::1]:8765", "content-type": "Application/JSON; charset=utf-8"}),
    (403, {"host": "box.lan", **JSON}), (403, {"host": "evil.example:8765", **JSON}), (403, {"host": "", **JSON}),
    (415, {"content-type": "text/plain"}), (415, {"content-type": ""}),
    (415, {"content-type": "application/x-www-form-urlencoded"}),
])  # fmt: skip
def test_a_page_of_another_site_cannot_ask(scenes, status, headers):
    client = TestClient(application(scenes), HERE)
    assert client.post("/query", content=b'{"text": "red"}', headers=headers).status_code == status


def test_get_takes_what_it_lists_and_nothing_else(client):
    paths = client.get("/openapi.json").json()["paths"]
    for path in ("/objects", "/selection.ply", "/mask.png", "/healthz"):
        listed = [parameter["name"] for parameter in paths[path]["get"].get("parameters", [])]
        usual = {"text": "red", "field": "desk", "by": "votes", "frame": "#0"}
        found = client.get(path, params={name: usual[name] for name in listed})
        assert found.status_code == 200 or "selects nothing" in found.text, found.text
        if listed:
            for other in {"at", "threshold", "all", "frame"} - set(listed):
                found = client.get(path, params={name: usual[name] for name in listed} | {other: "1"})
                assert found.status_code == 422
                assert f'"{other}"' in found.json()["error"]


def test_what_it_knows_and_files_of_the_answer(client, scenes):
    health = client.get("/healthz").json()
    assert [field["name"] for field in health["fields"]] == ["desk", "shelf"]
    assert health["fields"][0]["gaussians"] == 64
    words = next(w for w in ("red", "green", "blue", "white", "black", "brown") if scenes["desk"].ask(w).mask.any())
    ply = client.get("/selection.ply", params={"text": words})
    assert ply.content.startswith(b"ply\n")
    image = client.get("/mask.png", params={"text": words, "frame": "#2"})
    assert image.headers["x-frame"] == "frame_2"
    assert cv2.imdecode(np.frombuffer(image.content, np.uint8), cv2.IMREAD_UNCHANGED).shape == (40, 48)
    paths = client.get("/openapi.json").json()["paths"]
    assert set(paths) == {"/query", "/measure", "/objects", "/selection.ply", "/mask.png", "/healthz"}


def test_relations_measures_and_objects():
    field, embedder = table_field()
    client = TestClient(application({"table": Scene(field, embedder, name="table")}), HERE)
    answer = client.post("/query", json={"text": "the red mug left of the dark green bottle", "frame": 0}).json()
    assert answer["objects"] == 1
    assert answer["relation"]["objects"][0]["center"] == pytest.approx([-0.5, 0, 0.05], abs=0.02)
    assert answer["relation"]["viewpoint"] == "as seen from frame_0"
    way = client.post("/measure", json={"a": "dark blue box", "b": "dark green bottle"}).json()
    assert way["centers"] == pytest.approx(0.6, rel=0.05)
    listed = client.get("/objects", params={"field": "table"}).json()["objects"]
    assert len(listed) == 6
    for path, body, word in (
        ("/query", {"text": "red mug left of the bottle"}, "colour"),
        ("/query", {"text": "leftmost red mug", "frame": "no"}, "no such frame"),
        ("/query", {"text": "red mug", "frame": 1.5}, "frame"),
        ("/measure", {"a": "red mug", "b": "dark blue box"}, "names 2 objects"),
        ("/measure", {"a": "red mug"}, '"b"'),
        ("/query", {"text": "red mug", "from": "x"}, '"from"'),
    ):
        answer = client.post(path, json=body)
        assert answer.status_code == 422
        assert word in answer.json()["error"]


@pytest.mark.parametrize(("status", "body"), [
    (422, b"{"), (422, b"[1, 2]"), (422, b"{}"), (422, b'{"text": ""}'), (422, b'{"text": 7}'),
    (422, b'{"text": "red", "at": [0, 1, 2]}'), (422, b'{"at": [0, 1]}'), (422, b'{"at": [0, true, 2]}'),
    (422, b'{"at": [true, 1, 2]}'), (422, b'{"at": ["frame_1", 1e400, 2]}'), (422, b'{"at": ["frame_1", NaN, 2]}'),
    (422, b'{"at": ["\\udce9", 1, 2]}'), (422, b'{"at": ["#99999999999999999999", 1, 2]}'),
    (422, b'{"at": ["#\xc2\xb2", 1, 2]}'), (422, b'{"at": [0, 1' + b"0" * 200 + b", 2]}"),
    (422, b'{"at": [0, 1, 2], "by": "one_step"}'), (422, b'{"at": [0, 1, 2], "all": true}'),
    (422, b'{"text": "caf\\udce9 red"}'), (422, b'{"text": null}'), (422, b'{"text": "red", "by": ["votes"]}'),
    (422, b'{"text": "red", "by": {}}'),
    (422, b'{"text": "red", "\\udce9": 1}'), (422, b'{"text": "red", "field": "\\udce9"}'),
    (422, b'{"at": [99, 1, 2]}'), (422, b'{"text": "red", "by": "magic"}'),
    (422, b'{"text": "red", "threshold": "a"}'), (422, b'{"text": "red", "threshold": NaN}'),
    (422, b'{"text": "red", "all": 1}'), (422, b'{"text": "red", "file": "/etc/passwd"}'),
    (422, b'{"text": "the meaning of life"}'), (422, b'{"text": "red", "field": "../../etc"}'),
    (422, b'{"text": "red", "field": ["desk"]}'), (413, b'{"text": "' + b"x" * MAX_BODY + b'"}'), (400, b"[" * 1900),
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
    guarded = TestClient(application(scenes, token="secret"), "http://any.name")
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


def test_fields_are_opened_by_their_folders_names(scene, cameras, tmp_path):
    files = [tmp_path / name / "field.safetensors" for name in ("a", "b")]
    for file in files:
        file.parent.mkdir()
        save_field(file, colour_field(scene, cameras))
    assert list(open_scenes(files, None)) == ["a", "b"]
    with pytest.raises(InputError, match="a second field named 'a'"):
        open_scenes([files[0], files[0]], None)
