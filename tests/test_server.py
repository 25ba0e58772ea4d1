"""The server: that odd input has an error of its own kind and nothing crashes. test_doors.py has its answers."""

import socket

import pytest

pytest.importorskip("fastapi", reason="the extra serve is not installed")
from capture_files import refused
from small_field import colour_field
from starlette.testclient import TestClient
from table_field import table_field

from jsecon import save_field
from jsecon.app import verbs
from jsecon.app.scene import Scene
from jsecon.app.server import MAX_BODY, _serve, application, listen
from jsecon.pipeline.progress import Console
from jsecon.vision.colours import ColourEmbedder

HERE, JSON = "http://127.0.0.1:8765", {"content-type": "application/json"}


@pytest.fixture(scope="module")
def scenes(scene, cameras):
    field = colour_field(scene, cameras)
    return {name: Scene(field, ColourEmbedder(), name=name) for name in ("desk", "shelf")}


@pytest.fixture(scope="module")
def client(scenes):
    return TestClient(application(scenes), HERE, raise_server_exceptions=False)


def test_a_field_is_chosen_by_its_name_and_a_frame_by_its_place(client):
    assert client.post("/query", json={"text": "red"}).json()["field"] == "desk"
    named, placed = (client.post("/query", json={"at": [t, 24, 20], "field": "shelf"}).json() for t in ("frame_1", 1))
    assert named["field"] == "shelf"
    assert named["count"] == placed["count"] > 0
    assert [field["name"] for field in client.get("/healthz").json()["fields"]] == ["desk", "shelf"]


@pytest.mark.parametrize(("status", "headers"), [
    (200, {"host": "localhost", **JSON}),
    (200, {"host": "[::1]:8765", "content-type": "Application/JSON; charset=utf-8"}),
    *((200, {"host": name, **JSON}) for name in ("127.9.9.9", "LOCALHOST.:80")),
    *((403, {"host": name, **JSON}) for name in (
        *("box.lan:1", "[fe80::2]:5", "evil.example:8765", "localhost.evil.example", "127.0.0.1.evil.example"),
        *("evil.example@", "", "[::1", "0.0.0.0"),
    )),
    (415, {"content-type": "text/plain"}), (415, {"content-type": ""}),
    (415, {"content-type": "application/x-www-form-urlencoded"}),
])  # fmt: skip
def test_a_page_of_another_site_cannot_ask(scenes, status, headers):
    client = TestClient(application(scenes), HERE)
    assert client.post("/query", content=b'{"text": "red"}', headers=headers).status_code == status


def test_get_takes_what_it_lists_and_nothing_else(client):
    paths = client.get("/openapi.json").json()["paths"]
    for path in ("/objects", "/selection.ply"):
        usual = {"text": "red", "field": "desk", "by": "votes"}
        given = {parameter["name"]: usual[parameter["name"]] for parameter in paths[path]["get"]["parameters"]}
        found = client.get(path, params=given)
        assert found.status_code == 200 or "selects nothing" in found.text, found.text
        for other in {"at", "threshold", "all", "frame"} - set(given):
            found = client.get(path, params=given | {other: "1"})
            assert found.status_code == 422
            assert f'"{other}"' in found.json()["error"]


def test_measures_and_objects():
    client = TestClient(application({"table": Scene(*table_field(), name="table")}), HERE)
    way = client.post("/measure", json={"a": "dark blue box", "b": "dark green bottle"}).json()
    assert way["centers"] == pytest.approx(0.6, rel=0.05)
    assert len(client.get("/objects", params={"field": "table"}).json()["objects"]) == 6
    for path, body, word in (
        ("/query", {"text": "leftmost red mug", "frame": "no"}, "no such frame"),
        ("/query", {"text": "red mug", "frame": 1.5}, "frame"), ("/measure", {"a": "red mug"}, '"b"'),
        ("/measure", {"a": "red mug", "b": "dark blue box"}, "names 2 objects"),
    ):  # fmt: skip
        answer = client.post(path, json=body)
        assert answer.status_code == 422
        assert word in answer.json()["error"]


@pytest.mark.parametrize(("status", "body"), [
    (400, b"[" * 1900), (413, b'{"text": "' + b"x" * MAX_BODY + b'"}'), (422, b"{"), (422, b"[1, 2]"), (422, b"{}"),
    (422, b'{"text": ""}'), (422, b'{"text": 7}'), (422, b'{"text": null}'), (422, b'{"text": "red", "at": [0, 1, 2]}'),
    (422, b'{"at": [0, 1]}'), (422, b'{"at": [true, 1, 2]}'), (422, b'{"at": ["frame_1", NaN, 2]}'),
    (422, b'{"at": ["\\udce9", 1, 2]}'), (422, b'{"at": ["#99999999999999999999", 1, 2]}'),
    (422, b'{"at": ["#\xc2\xb2", 1, 2]}'), (422, b'{"at": [0, 1' + b"0" * 200 + b", 2]}"), (422, b'{"at": [99, 1, 2]}'),
    (422, b'{"at": [0, 99, 2]}'), (422, b'{"at": [0, 1, 2], "all": true}'), (422, b'{"text": "caf\\udce9 red"}'),
    (422, b'{"text": "red", "by": ["votes"]}'), (422, b'{"text": "red", "by": "magic"}'),
    (422, b'{"text": "red", "\\udce9": 1}'), (422, b'{"text": "red", "threshold": NaN}'),
    (422, b'{"text": "red", "all": 1}'), (422, b'{"text": "red", "file": "/etc/passwd"}'),
    (422, b'{"text": "the meaning of life"}'), (422, b'{"text": "red", "field": "../../etc"}'),
    (422, b'{"text": "red", "field": "\\udce9"}'), (422, b'{"text": "red", "field": ["desk"]}'),
])  # fmt: skip
def test_odd_questions_have_an_error_of_their_own_kind(client, status, body):
    answer = client.post("/query", content=body, headers=JSON)
    assert answer.status_code == status, answer.text
    assert answer.json()["error"]
    assert "--" not in answer.json()["error"]


def test_paths_lead_nowhere(client):
    for path in ("/../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "/selection.ply/../../x", "//etc/passwd", "/query"):
        assert client.get(path).status_code in (404, 405, 422), path


def test_a_token_is_asked_for_where_one_is_set(scenes):
    guarded = TestClient(application(scenes, token="secret"), "http://any.name")
    for key, status in (("", 401), ("Bearer wrong", 401), ("Bearer secret", 200)):
        assert guarded.get("/healthz", headers={"Authorization": key}).status_code == status


def test_fields_are_opened_by_their_folders_names_and_the_address_is_told(scenes, tmp_path):
    files = [tmp_path / name / "desk" / "field.safetensors" for name in ("a", "b")]
    for file in files:
        file.parent.mkdir(parents=True)
        save_field(file, scenes["desk"].field)
    told = _serve(verbs.Serve(fields=[files[0].parent, files[1]], port=0), Console())
    assert int(told["address"].removeprefix("http://127.0.0.1:")) > 0
    assert [scene["name"] for scene in told["fields"]] == ["a/desk", "b/desk"]


def test_beyond_loopback_a_token_is_needed(monkeypatch):
    monkeypatch.delenv("JSECON_TOKEN", raising=False)
    for host in ("0.0.0.0", "::", "192.168.0.3", "box"):
        with refused("--token"):
            _serve(verbs.Serve(fields=[], host=host, port=0), Console())
    monkeypatch.setenv("JSECON_TOKEN", "b")
    assert _serve(verbs.Serve(fields=[], host="0.0.0.0", port=0), Console())["address"]


def test_addresses_of_both_families_are_listened_on():
    four, url = listen("127.0.0.1", 0)
    with four:
        assert four.family == socket.AF_INET
        assert url == f"http://127.0.0.1:{four.getsockname()[1]}"
        with refused("in use"):
            listen("127.0.0.1", four.getsockname()[1])
    for host, port in (("no.such.host.invalid", 0), ("a\0b", 0), ("x" * 300, 0), ("127.0.0.1", 70000)):
        with refused("cannot listen"):
            listen(host, port)
