"""Spaces, umlauts and CJK in every path: nothing is lost."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from capture_files import run_cli

from jsecon.field.field import load_field
from jsecon.read.splats.files import load_gaussians, save_gaussians

HOME = Path(__file__).resolve().parent.parent
PLACE = "Büro für Köln 日本 #1 %20 'é'"


def command(base) -> list:
    """Words of a run on given Gaussians, beneath a folder."""
    capture = base / "Aufnahme 撮影"
    given = ["--gaussians", base / "Szene ö.ply", "--masks", capture / "masks", "--holdout", 4]
    return ["run", capture, "--out", base / "Ausgabe ß 出力", *given]


@pytest.fixture(scope="module")
def ran(room, room_run, tmp_path_factory):
    """(the base folder, the field) of a run in which every path and every frame's name is odd."""
    base = tmp_path_factory.mktemp("Wege") / PLACE
    capture = base / "Aufnahme 撮影"
    shutil.copytree(room, capture)
    names = {name: f"Bild ä {name[-2:]} 図" for name in room_run[0].capture.names}
    model = (capture / "sparse" / "0" / "images.bin").read_bytes()
    for old, new in names.items():
        for folder in ("images", "masks"):
            (capture / folder / f"{old}.png").rename(capture / folder / f"{new}.png")
        model = model.replace(f"{old}.png".encode() + b"\0", f"{new}.png".encode() + b"\0")
    (capture / "sparse" / "0" / "images.bin").write_bytes(model)
    save_gaussians(base / "Szene ö.ply", room_run[0].field.gaussians)
    assert run_cli(*command(base)) == 0
    return base, base / "Ausgabe ß 出力" / "field.safetensors", sorted(names.values())


def test_a_run_in_odd_folders_makes_the_field_of_plain_ones_and_leaves_out_the_fit(ran, room_run, capsys):
    base, file, names = ran
    field, plain = load_field(file), room_run[0].field
    assert field.names == tuple(names)
    np.testing.assert_array_equal(field.gaussians.means, plain.gaussians.means)
    np.testing.assert_array_equal(field.votes.weights, plain.votes.weights)
    assert json.loads(field.provenance)["options"]["capture"] == str(base / "Aufnahme 撮影")
    assert {"field.safetensors", "metrics.json", "report.html"} < {path.name for path in file.parent.iterdir()}
    assert "Bild ä" in (file.parent / "report.html").read_text(encoding="utf-8")
    metrics = json.loads((file.parent / "metrics.json").read_text())
    assert metrics["held_out_psnr"] == pytest.approx(room_run[0].held_out.psnr.mean(), abs=0.1)
    assert run_cli(*command(base), "--dry-run", "--json") == 0
    stages = {stage["name"]: stage for stage in json.loads(capsys.readouterr().out)["stages"]}
    assert (stages["photometric fit"]["status"], stages["gaussians"]["status"]) == ("skipped", "cached")
    assert "Szene ö.ply" in stages["photometric fit"]["why"]


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
    assert run_cli("export", file, "--out", base / "Export 輸出.ply") == 0
    assert load_gaussians(base / "Export 輸出.ply").count > 0


def test_a_terminal_that_lacks_some_of_the_letters_shows_them_by_number(ran):
    _, file, _ = ran
    environ = {**os.environ, "PYTHONPATH": str(HOME), "PYTHONIOENCODING": "latin-1"}
    command = [sys.executable, "-m", "jsecon", "export", str(file), "--out", str(file.with_name("a.ply"))]
    done = subprocess.run(command, capture_output=True, env=environ, check=True)
    assert r"Ausgabe ß \u51fa\u529b" in done.stdout.decode("latin-1")
