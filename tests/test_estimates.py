"""`--dry-run`: what a run would cost, without running it."""

import json
import shutil
import sys

import cv2
import numpy as np
import pytest

from jsecon.app import command_line
from jsecon.data.capture import capture_extent, load_capture
from jsecon.data.frames import Extent
from jsecon.data.video import size_of
from jsecon.pipeline import estimates
from jsecon.pipeline.options import Options

STAGES = ["load", "gaussians", "masklets", "regions", "codes", "votes", "distil", "held_out", "field"]


WORKLOAD = estimates.workload


@pytest.fixture(autouse=True)
def _known_machine(monkeypatch):
    """The machine's speed is not measured for every dry run."""
    monkeypatch.setattr(estimates, "workload", lambda: estimates.REFERENCE)


def _dry(capsys, *arguments):
    assert command_line.main([*map(str, arguments), "--dry-run", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    return told, {stage["name"]: stage for stage in told["stages"]}


def test_a_dry_run_tells_every_stage_and_writes_nothing(room, tmp_path, capsys):
    told, stages = _dry(capsys, "run", room, "--out", tmp_path / "out")
    assert [stage["name"] for stage in told["stages"] if stage["status"] == "run"] == STAGES
    for name in STAGES:
        assert stages[name]["seconds"] > 0
        assert stages[name]["memory_mib"] > 100
    assert told["seconds"] == pytest.approx(sum(stages[name]["seconds"] for name in STAGES))
    assert told["memory_mib"] == max(stages[name]["memory_mib"] for name in STAGES)
    assert list(tmp_path.iterdir()) == []


def test_more_work_costs_more_and_minutes_are_kept(room, tmp_path, capsys):
    seconds = {}
    for steps in (200, 2000):
        told, stages = _dry(capsys, "fit", room, "--out", tmp_path / "scene.ply", "--steps", steps)
        seconds[steps] = stages["gaussians"]["seconds"] / told["slower"]
    assert set(stages) >= {"load", "gaussians", "held_out"}
    assert "votes" not in stages
    assert seconds[2000] > 1.5 * seconds[200]
    _, stages = _dry(capsys, "fit", room, "--out", tmp_path / "scene.ply", "--minutes", 3)
    assert 180 <= stages["gaussians"]["seconds"] < 300
    assert list(tmp_path.iterdir()) == []


def test_what_was_never_measured_is_not_made_up(room, tmp_path, capsys):
    line = ["run", room, "--out", tmp_path / "out", "--masks", room / "masks"]
    assert command_line.main([*map(str, line), "--dry-run"]) == 0
    out = capsys.readouterr().out
    row = next(line for line in out.splitlines() if line.startswith("  masklets"))
    assert "not known before" in row
    assert "in all at least" in out
    _, stages = _dry(capsys, *line)
    assert stages["masklets"]["seconds"] is None


def test_bad_options_are_refused_as_in_a_run(room, tmp_path, capsys):
    line = ["run", str(room), "--out", str(tmp_path / "out"), "--steps", "0", "--dry-run", "--json"]
    assert command_line.main(line) == 2
    assert json.loads(capsys.readouterr().out)["error"]["name"] == "--steps"


@pytest.mark.parametrize("given", [{}, {"downscale": 2.0}, {"long_side": 50, "frames": 3}])
def test_the_extent_is_that_of_the_loaded_capture(room, given):
    capture, extent = load_capture(room, **given), capture_extent(room, **given)
    size = capture.cameras.width, capture.cameras.height
    assert extent == Extent(len(capture.names), size, (160, 120), len(capture.points), capture.names, capture.files)


def test_photographs_without_poses_have_an_extent_too(room, tmp_path, capsys):
    shutil.copytree(room / "images", tmp_path / "photos")
    _, stages = _dry(capsys, "run", tmp_path / "photos", "--out", tmp_path / "out")
    assert stages["poses"]["status"] == "run"
    assert stages["gaussians"]["seconds"] > 0
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


def test_a_video_has_the_extent_of_its_frames(tmp_path, capsys):
    writer = cv2.VideoWriter(str(tmp_path / "walk.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for _ in range(5):
        writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    assert size_of(tmp_path / "walk.avi") == (64, 48)
    _, stages = _dry(capsys, "run", tmp_path / "walk.avi", "--out", tmp_path / "out")
    assert stages["poses"]["seconds"] is None
    assert stages["masklets"]["seconds"] > 0


def test_costs_are_of_the_stages_that_a_run_has():
    assert set(estimates.COSTS) == set(STAGES)
    units = set(estimates.units_of(Extent(1, (1, 1), (1, 1), 0), 1, 1))
    for parts in estimates.COSTS.values():
        assert len(parts) == 4
        for by_unit in parts:
            assert set(by_unit) <= units
            assert all(value >= 0 for value in by_unit.values())


def test_the_workload_takes_the_time_that_it_is_meant_to():
    assert 0.005 < WORKLOAD() < 5


def test_a_variant_that_costs_otherwise_has_no_figure(room):
    for name, changed in {
        "regions": {"embedder": room},
        "load": {"refine": "poses"},
        "gaussians": {"start": "dense"},
    }.items():
        assert estimates._cost(name, Options(room)) is not None
        assert estimates._cost(name, Options(room, **changed)) is None


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
    "a file where the output should be": (lambda room, folder: ["--out", room / "sparse/0/cameras.bin/f"], "is a file"),
    "the output is an input": (lambda room, folder: ["--out", folder / "capture/images"], "own folder"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_a_dry_run_refuses_what_a_run_would_refuse_at_once(room, tmp_path, capsys, kind):
    make, says = WRONG[kind]
    shutil.copytree(room, tmp_path / "capture")
    options = make(room, tmp_path)
    line = ["run", tmp_path / "capture", "--out", tmp_path / "out", *options]
    assert command_line.main([*map(str, line), "--dry-run"]) == 2
    told = capsys.readouterr().err
    assert says in told
    assert "Traceback" not in told
    assert not (tmp_path / "out").exists()


def test_a_dry_run_on_photographs_needs_what_finds_their_poses(room, tmp_path, capsys, monkeypatch):
    shutil.copytree(room / "images", tmp_path / "photos")
    line = ["run", tmp_path / "photos", "--out", tmp_path / "out"]
    _dry(capsys, *line, "--masks", room / "masks")
    assert (
        command_line.main([*map(str, line), "--dry-run", *_wrong_masks(room, tmp_path)[:1], str(tmp_path / "wrong")])
        == 2
    )
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert command_line.main([*map(str, line), "--dry-run"]) == 2
    assert "jsecon[sfm]" in capsys.readouterr().err
    shutil.rmtree(tmp_path / "photos")
    (tmp_path / "photos").mkdir()
    assert command_line.main([*map(str, line), "--dry-run"]) == 2
    assert "empty folder" in capsys.readouterr().err
