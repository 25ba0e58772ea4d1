"""Spaces, umlauts and CJK in every path, and a capture with very many names: nothing is lost or takes for ever."""

import json
import os
import shutil
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import cv2
import numpy as np
import pytest
from capture_files import run_cli

from jsecon.pipeline.cache import files_digest
from jsecon.read.captures import capture as captures
from jsecon.read.captures.capture import list_photographs
from jsecon.read.splats.files import load_gaussians, save_gaussians

HOME = Path(__file__).resolve().parent.parent
PLACE = "Büro für Köln 日本 #1 %20 'é'"


@pytest.fixture(scope="module")
def ran(room, room_run, tmp_path_factory):
    """(the base folder, the field) of a run in which every path and every frame's name is odd."""
    base = tmp_path_factory.mktemp("Wege") / PLACE
    capture = base / "Aufnahme 撮影"
    shutil.copytree(room, capture)
    names = {name: f"Bild ä {name[-2:]} 図" for name in room_run[0].capture.names}
    for folder in ("images", "masks"):
        for old, new in names.items():
            (capture / folder / f"{old}.png").rename(capture / folder / f"{new}.png")
    model = (capture / "sparse" / "0" / "images.bin").read_bytes()
    for old, new in names.items():
        model = model.replace(f"{old}.png".encode() + b"\0", f"{new}.png".encode() + b"\0")
    (capture / "sparse" / "0" / "images.bin").write_bytes(model)
    save_gaussians(base / "Szene ö.ply", room_run[0].field.gaussians)
    given = "--gaussians", base / "Szene ö.ply", "--masks", capture / "masks", "--holdout", 4
    assert run_cli("run", capture, "--out", base / "Ausgabe ß 出力", *given) == 0
    return base, base / "Ausgabe ß 出力" / "field.safetensors", sorted(names.values())


def test_a_run_in_odd_folders_makes_the_field_of_plain_ones(ran, room_run):
    from jsecon.field.field import load_field

    base, file, names = ran
    field, plain = load_field(file), room_run[0].field
    assert field.names == tuple(names)
    np.testing.assert_array_equal(field.votes.weights, plain.votes.weights)
    assert json.loads(field.provenance)["options"]["capture"] == str(base / "Aufnahme 撮影")
    assert {"field.safetensors", "metrics.json", "report.html"} < {path.name for path in file.parent.iterdir()}
    assert "Bild ä" in (file.parent / "report.html").read_text(encoding="utf-8")


def test_what_is_asked_is_answered_there(ran, capsys):
    base, file, names = ran
    thing = next(iter(json.loads((base / "Aufnahme 撮影" / "scene.json").read_text())["objects"].values()))
    answers = base / "Antworten ü 答え"
    at = "--at", names[1], 80, 60
    assert run_cli("query", file, thing, *at, "--out", answers, "--views", 1, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    for answer in told["answers"]:
        assert load_gaussians(answers / answer["ply"]).count == answer["count"] > 0
        for mask in answer["masks"].values():
            assert cv2.imdecode(np.fromfile(answers / mask, np.uint8), cv2.IMREAD_UNCHANGED) is not None
    assert run_cli("view", file, thing, "--export", base / "Seite ñ 頁.html") == 0
    page = (base / "Seite ñ 頁.html").read_text(encoding="utf-8")
    assert thing in page
    assert "Ausgabe ß 出力" in page
    assert run_cli("export", file, "--out", base / "Export 輸出.glb") == 0
    assert (base / "Export 輸出.glb").read_bytes()[:4] == b"glTF"


@pytest.mark.parametrize("encoding", [pytest.param("utf-8", marks=pytest.mark.long), "latin-1"])
def test_a_server_starts_there_and_answers(ran, encoding):
    """Also where a terminal lacks some of the letters: they are then told by number."""
    _, file, names = ran
    environ = {**os.environ, "PYTHONPATH": str(HOME), "PYTHONIOENCODING": encoding}
    command = [sys.executable, "-m", "jsecon", "serve", str(file), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environ) as server:
        try:
            assert server.stdout is not None
            lines = [server.stdout.readline().decode(encoding) for _ in range(2)]
            address = next((word for word in lines[-1].split() if word.startswith("http")), None)
            assert address is not None, lines
            assert lines[0].startswith("Ausgabe ß " + ("出力" if encoding == "utf-8" else r"\u51fa\u529b")), lines
            asked = {"at": [names[1], 80, 60]}
            body = json.dumps(asked, ensure_ascii=False).encode("utf-8")
            request = urllib.request.Request(f"{address}/query", body, {"Content-Type": "application/json"})
            with urllib.request.urlopen(request, timeout=60) as answer:
                assert answer.status == 200
        finally:
            server.terminate()


MANY = 100_000


@pytest.mark.long
def test_a_hundred_thousand_frames_are_listed_in_seconds(tmp_path):
    """Their names and poses, in each format, and the digest of the files; of the pictures a few are read."""
    (tmp_path / "images").mkdir()
    names = [f"frame_{n}.png" for n in range(MANY)]
    for n, name in enumerate(names):
        if n % 50_000 == 0:  # ext4 allows 65,000 links to a file
            cv2.imwrite(str(tmp_path / "images" / name), np.zeros((16, 24, 3), np.uint8))
            original = tmp_path / "images" / name
        else:
            os.link(original, tmp_path / "images" / name)
    lens, pose = {"w": 24, "h": 16, "fl_x": 20}, np.eye(4).tolist()
    frames = [{"file_path": f"images/{name}", "transform_matrix": pose} for name in reversed(names)]
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("1 PINHOLE 24 16 20 20 12 8\n")
    (model / "images.txt").write_text("".join(f"{n + 1} 1 0 0 0 0 0 3 1 {name}\n\n" for n, name in enumerate(names)))
    (model / "points3D.txt").write_text("1 0 0 0 1 2 3 0.5\n")
    # "frame_99999" behind "frame_11111": by number, not by letter
    expected = tuple(f"frame_{n}" for n in (0, 33333, 66666, 99999))
    for file in (tmp_path, tmp_path / "transforms.json"):
        began = time.process_time()
        found = captures.load_capture(file, frames=4)
        spent = time.process_time() - began
        assert found.names == expected
        assert spent < 60, f"{file.name}: {spent:.0f} s"
    began = time.process_time()
    assert len(list_photographs(tmp_path)) == MANY
    assert len(files_digest([tmp_path])) == 16
    assert time.process_time() - began < 60
