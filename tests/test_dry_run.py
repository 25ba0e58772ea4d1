"""`--dry-run`: the stages of a run, and what it would refuse, without running it."""

import json
import shutil
import sys

import cv2
import numpy as np
import pytest
from capture_files import run_cli

from jsecon.read.captures.build import plan_frames
from jsecon.read.captures.capture import load_capture, read_posed_images
from jsecon.read.captures.frames import FrameOptions

STAGES = ["load", "gaussians", "objects", "regions", "parts", "votes", "held_out"]


def _dry(capsys, *arguments):
    assert run_cli(*arguments, "--dry-run", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    return told, {stage["name"]: stage for stage in told["stages"]}


def test_a_dry_run_lists_every_stage_and_writes_nothing(room, tmp_path, capsys):
    told, stages = _dry(capsys, "run", room, "--out", tmp_path / "out")
    assert [stage["name"] for stage in told["stages"] if stage["status"] == "run"] == STAGES
    assert "2000 steps" in stages["gaussians"]["why"]
    _, stages = _dry(capsys, "fit", room, "--out", tmp_path / "scene.ply", "--minutes", 3)
    assert [name for name, stage in stages.items() if stage["status"] == "run"] == ["load", "gaussians", "held_out"]
    assert "3 minutes" in stages["gaussians"]["why"]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("given", [{}, {"downscale": 2.0}, {"long_side": 50, "frames": 3}])
def test_planned_frames_are_those_of_the_loaded_capture(room, given):
    capture = load_capture(room, **given)
    frames, size, held_out = plan_frames(read_posed_images(room), FrameOptions(**given))
    np.testing.assert_array_equal(held_out, capture.held_out)
    assert size == (capture.cameras.width, capture.cameras.height)
    assert frames == dict(zip(capture.names, capture.files))


def _wrong_masks(room, folder):
    (folder / "wrong").mkdir()
    cv2.imwrite(str(folder / "wrong" / "of_no_frame.png"), np.ones((120, 160), np.uint8))
    return ["--masks", folder / "wrong"]


WRONG = {
    "no Gaussians": (lambda room, folder: ["--gaussians", "nowhere.ply"], "nowhere.ply"),
    "the masks are of no frame": (_wrong_masks, "wrong"),
    "proposals of no frame": (lambda room, folder: ["--proposals", _wrong_masks(room, folder)[1]], "wrong"),
    "no model in the folder": (lambda room, folder: ["--embedder", folder / "capture" / "images"], "images"),
    "Gaussians of no known form": (lambda room, folder: ["--gaussians", room / "sparse/0/cameras.bin"], "cameras.bin"),
    "too few frames": (lambda room, folder: ["--frames", 2, "--holdout", 2], "1 of 2 frames"),
    "the output lies in a file": (lambda room, folder: ["--out", room / "sparse/0/cameras.bin/f"], "a directory"),
    "the output is an input": (lambda room, folder: ["--out", folder / "capture/images"], "own folder"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_a_dry_run_refuses_what_a_run_would_refuse_at_once(room, tmp_path, capsys, kind):
    make, says = WRONG[kind]
    shutil.copytree(room, tmp_path / "capture")
    options = make(room, tmp_path)
    line = ["run", tmp_path / "capture", "--out", tmp_path / "out", *options]
    assert run_cli(*line, "--dry-run") == 2
    told = capsys.readouterr().err
    assert says in told
    assert "Traceback" not in told
    assert not (tmp_path / "out").exists()


def test_a_dry_run_on_photographs_lists_their_poses_and_needs_what_finds_them(room, tmp_path, capsys, monkeypatch):
    shutil.copytree(room / "images", tmp_path / "photos")
    line = ["run", tmp_path / "photos", "--out", tmp_path / "out"]
    _, stages = _dry(capsys, *line, "--masks", room / "masks")
    assert stages["poses"]["status"] == stages["gaussians"]["status"] == "run"
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert run_cli(*line, "--dry-run") == 2
    assert "jsecon[sfm]" in capsys.readouterr().err
