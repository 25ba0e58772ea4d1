"""`--dry-run`: the stages of a run, and what it would refuse, without running it."""

import json
import shutil
import sys

import cv2
import numpy as np
import pytest

from jsecon.app import cli
from jsecon.read.captures.build import plan_frames
from jsecon.read.captures.capture import load_capture, read_posed_images
from jsecon.read.captures.frames import FrameOptions

STAGES = ["load", "gaussians", "objects", "regions", "votes", "held_out"]


def _dry(capsys, *arguments):
    assert cli.main([*map(str, arguments), "--dry-run", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    return told, {stage["name"]: stage for stage in told["stages"]}


def test_a_dry_run_lists_every_stage_writes_nothing_and_refuses_bad_options(room, tmp_path, capsys):
    told, stages = _dry(capsys, "run", room, "--out", tmp_path / "out")
    assert [stage["name"] for stage in told["stages"] if stage["status"] == "run"] == STAGES
    assert "2000 steps" in stages["gaussians"]["why"]
    _, stages = _dry(capsys, "fit", room, "--out", tmp_path / "scene.ply", "--minutes", 3)
    assert [name for name, stage in stages.items() if stage["status"] == "run"] == ["load", "gaussians", "held_out"]
    assert "3 minutes" in stages["gaussians"]["why"]
    assert list(tmp_path.iterdir()) == []
    line = ["run", str(room), "--out", str(tmp_path / "out"), "--steps", "0", "--dry-run", "--json"]
    assert cli.main(line) == 2
    assert json.loads(capsys.readouterr().out)["error"]["where"] == "--steps"


@pytest.mark.parametrize("given", [{}, {"downscale": 2.0}, {"long_side": 50, "frames": 3}])
def test_planned_frames_are_those_of_the_loaded_capture(room, given):
    capture, (frames, size) = load_capture(room, **given), plan_frames(read_posed_images(room), FrameOptions(**given))
    assert size == (capture.cameras.width, capture.cameras.height)
    assert frames == dict(zip(capture.names, capture.files))


def test_a_video_is_listed_with_the_frames_that_are_taken_of_it(tmp_path, capsys):
    writer = cv2.VideoWriter(str(tmp_path / "walk.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for _ in range(5):
        writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    _, stages = _dry(capsys, "run", tmp_path / "walk.avi", "--out", tmp_path / "out")
    assert "150 sharpest frames" in stages["poses"]["why"]


def _wrong_masks(room, folder):
    (folder / "wrong").mkdir()
    cv2.imwrite(str(folder / "wrong" / "of_no_frame.png"), np.ones((120, 160), np.uint8))
    return ["--masks", folder / "wrong"]


def _narrow_masks(room, folder):
    shutil.copytree(room / "masks", folder / "narrow")
    for path in (folder / "narrow").iterdir():
        cv2.imwrite(str(path), np.ones((100, 100), np.uint8))
    return ["--masks", folder / "narrow"]


def _broken_pose(room, folder):
    images = folder / "capture" / "sparse" / "0" / "images.bin"
    data = bytearray(images.read_bytes())
    data[12:20] = np.array(np.nan).tobytes()
    images.write_bytes(data)
    return []


WRONG = {
    "the masks are of no frame": (_wrong_masks, "wrong"),
    "the masks have another aspect": (_narrow_masks, "100x100"),
    "proposals of no frame": (lambda room, folder: ["--proposals", _wrong_masks(room, folder)[1]], "wrong"),
    "features of no frame": (lambda room, folder: ["--features", folder / "capture" / "images"], "_f.npy"),
    "no model in the folder": (lambda room, folder: ["--embedder", folder / "capture" / "images"], "images"),
    "Gaussians of no known form": (lambda room, folder: ["--gaussians", room / "sparse/0/cameras.bin"], "cameras.bin"),
    "a pose that is none": (_broken_pose, "images.bin"),
    "too few frames": (lambda room, folder: ["--frames", 2, "--holdout", 2], "1 of 2 frames"),
    "a file where the output should be": (
        lambda room, folder: ["--out", room / "sparse/0/cameras.bin/f"],
        "a directory",
    ),
    "the output is an input": (lambda room, folder: ["--out", folder / "capture/images"], "own folder"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_a_dry_run_refuses_what_a_run_would_refuse_at_once(room, tmp_path, capsys, kind):
    make, says = WRONG[kind]
    shutil.copytree(room, tmp_path / "capture")
    options = make(room, tmp_path)
    line = ["run", tmp_path / "capture", "--out", tmp_path / "out", *options]
    assert cli.main([*map(str, line), "--dry-run"]) == 2
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
    assert cli.main([*map(str, line), "--dry-run"]) == 2
    assert "jsecon[sfm]" in capsys.readouterr().err
    shutil.rmtree(tmp_path / "photos")
    (tmp_path / "photos").mkdir()
    assert cli.main([*map(str, line), "--dry-run"]) == 2
    assert "empty folder" in capsys.readouterr().err
