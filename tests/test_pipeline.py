"""A run: its plan, its cache, what it leaves out, what it never looks at, and that it survives being killed."""

import dataclasses
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from jsecon import cache, eyes, pipeline, recipe
from jsecon.data.ply import save_ply
from jsecon.errors import InputError
from jsecon.language.field import load_field
from jsecon.plan import Silent

STAGES = ("load", "gaussians", "masklets", "regions", "codes", "votes", "distil", "held_out")


class Recorder(Silent):
    """Keeps what it is told."""

    def __init__(self):
        self.planned, self.fresh, self.notes, self.told = {}, {}, [], []

    def plan(self, title, steps):
        self.planned = {step.name: step for step in steps}

    def step(self, step):
        self.told.append(step)

    def done(self, name, seconds, fresh):
        self.fresh[name] = fresh

    def note(self, text):
        self.notes.append(text)


def _again(run, out, **changes):
    reporter = Recorder()
    return pipeline.run(dataclasses.replace(run.options, **changes), out, reporter=reporter), reporter


def test_a_run_ends_in_a_field_that_can_be_read_and_asked(room_run):
    run, out = room_run
    field = load_field(out / "field.npz")
    assert field.gaussians.count == run.field.gaussians.count > 100
    assert field.names == run.capture.names
    assert field.codes.shape == (field.gaussians.count, field.region_codes.shape[1])
    assert field.votes.overlap.shape == (field.regions.count, field.regions.count)
    assert len(run.psnr) == run.capture.held_out.sum() == 2
    assert (np.asarray(field.regions.pixels)[:, run.capture.held_out] == 0).all()
    assert (np.asarray(field.regions.pixels)[:, ~run.capture.held_out].sum(1) > 0).all()
    assert set(run.seconds) == {*STAGES, "field"}
    assert run.labels.shape == (6, 120, 160)


def test_a_second_run_reads_every_stage_and_writes_the_same_bytes(room_run, tmp_path):
    run, out = room_run
    before = (out / "field.npz").read_bytes()
    again, reporter = _again(run, out)
    assert {name: fresh for name, fresh in reporter.fresh.items() if name != "field"} == dict.fromkeys(STAGES, False)
    assert all(reporter.planned[name].status == "cached" for name in STAGES)
    assert (out / "field.npz").read_bytes() == before
    assert again.seconds["gaussians"] == run.seconds["gaussians"]
    assert again.left_out == run.left_out


@pytest.mark.parametrize(
    ("changes", "rerun"),
    [
        ({"reduce": "mean"}, {"distil"}),
        ({"latent": 3}, {"codes", "distil"}),
        ({"top": 4}, {"votes", "distil"}),
    ],
)
def test_a_changed_option_reruns_only_what_depends_on_it(room_run, tmp_path, changes, rerun):
    run, out = room_run
    shutil.copytree(out, tmp_path / "out")
    _, reporter = _again(run, tmp_path / "out", **changes)
    assert {name for name, fresh in reporter.fresh.items() if fresh} - {"field"} == rerun
    assert {name for name, step in reporter.planned.items() if step.status == "run"} == rerun


def test_a_damaged_stage_is_said_and_computed_again_to_the_same_field(room_run, tmp_path):
    run, out = room_run
    shutil.copytree(out, tmp_path / "out")
    path = next((tmp_path / "out" / "cache").glob("votes-*.npz"))
    path.write_bytes(path.read_bytes()[:1000])
    _, reporter = _again(run, tmp_path / "out")
    assert {name for name, fresh in reporter.fresh.items() if fresh} == {"votes", "field"}
    assert any("votes is computed again" in note for note in reporter.notes)
    assert (tmp_path / "out" / "field.npz").read_bytes() == (out / "field.npz").read_bytes()


def test_the_plan_says_what_is_left_out_and_why(room_run, room, tmp_path):
    run, _ = room_run
    assert {"densification", "segmenter", "association"} <= set(run.left_out)
    flat = dataclasses.replace(run.options, sh_degree=0)
    assert set(recipe.left_out(flat)) - set(recipe.left_out(run.options)) == {"view-dependent colour"}
    save_ply(tmp_path / "scene.ply", run.field.gaussians)
    reporter = Recorder()
    given = pipeline.run(
        dataclasses.replace(run.options, gaussians=tmp_path / "scene.ply"), tmp_path / "out", reporter=reporter
    )
    assert "scene.ply" in given.left_out["photometric fit"]
    assert reporter.planned["photometric fit"].status == "left out"
    assert reporter.planned["gaussians"].status == "run"
    np.testing.assert_array_equal(given.field.gaussians.means, run.field.gaussians.means)
    np.testing.assert_array_equal(given.field.codes, run.field.codes)


def test_what_is_held_out_never_reaches_the_field(room_run, room, tmp_path):
    """The same run with noise in place of the held-out frames and their masks gives the same field."""
    run, _ = room_run
    shutil.copytree(room, tmp_path / "capture")
    rng = np.random.default_rng(0)
    for name, held in zip(run.capture.names, run.capture.held_out):
        if held:
            cv2.imwrite(
                str(tmp_path / "capture" / "images" / f"{name}.png"),
                rng.integers(0, 255, (120, 160, 3)).astype(np.uint8),
            )
            (tmp_path / "capture" / "masks" / f"{name}.png").unlink()
    options = dataclasses.replace(run.options, capture=tmp_path / "capture", masks=tmp_path / "capture" / "masks")
    other = pipeline.run(options, tmp_path / "out")
    assert not np.array_equal(other.capture.frames, run.capture.frames)
    for name in ("gaussians", "codes", "votes", "regions", "region_codes"):
        want, have = (cache.pack(getattr(r.field, name))[1] for r in (run, other))
        for key in want:
            np.testing.assert_array_equal(have[key], want[key], err_msg=f"{name} {key}")


def test_frames_can_come_from_an_adapter(room_run, room, tmp_path):
    run, _ = room_run
    adapted = pipeline.run(run.options, tmp_path / "out", load=lambda: run.capture)
    np.testing.assert_array_equal(adapted.field.codes, run.field.codes)


def test_default_vision_finds_regions_by_itself(room, room_run, tmp_path):
    """Segmenter, tracker and colours on the tiny room: the whole default path, on the Gaussians of the other run."""
    run, out = room_run
    shutil.copytree(out / "cache", tmp_path / "cache")
    reporter = Recorder()
    found = pipeline.run(dataclasses.replace(run.options, masks=None), tmp_path, reporter=reporter)
    assert not reporter.fresh["gaussians"]
    assert reporter.fresh["masklets"]
    assert found.field.regions.count >= 1  # at this size; the figures are for the demo's full size (.ci/run)
    assert "segmenter" not in found.left_out


@pytest.mark.parametrize(
    ("changes", "where"),
    [
        ({"capture": Path("nowhere")}, "nowhere"),
        ({"gaussians": Path("nowhere.ply")}, "nowhere.ply"),
        ({"masks": Path("nowhere")}, "nowhere"),
        ({"steps": 0}, "--steps"),
        ({"frames": 1}, "--frames"),
        ({"downscale": 0.5}, "--downscale"),
        ({"latent": 0}, "--latent"),
    ],
)
def test_what_cannot_be_is_refused_before_any_work(room_run, tmp_path, changes, where):
    run, _ = room_run
    reporter = Recorder()
    with pytest.raises(InputError) as caught:
        pipeline.run(dataclasses.replace(run.options, **changes), tmp_path / "out", reporter=reporter)
    assert where in caught.value.where
    assert reporter.fresh == {}


def test_gaussians_of_another_world_are_refused(room_run, tmp_path):
    run, _ = room_run
    far = dataclasses.replace(run.field.gaussians, means=np.asarray(run.field.gaussians.means) + np.float32(1000))
    save_ply(tmp_path / "far.ply", far)
    with pytest.raises(InputError, match="belong"):
        pipeline.run(dataclasses.replace(run.options, gaussians=tmp_path / "far.ply"), tmp_path / "out")


def test_too_few_frames_to_work_with_are_refused(room_run, tmp_path):
    run, _ = room_run
    one = run.capture
    held = np.ones(len(one.names), bool)
    held[0] = False
    with pytest.raises(InputError, match="at least 2"):
        pipeline.run(run.options, tmp_path / "out", load=lambda: dataclasses.replace(one, held_out=held))


def test_peak_memory_is_measured():
    assert 100 < pipeline.peak_memory_mib() < 20_000


def test_embedders_of_other_versions_are_refused():
    with pytest.raises(InputError, match="Run the capture again"):
        eyes.embedder_named("colours-of-the-future")


DRIVER = """
import os, signal, sys
from pathlib import Path
import numpy as np
from jsecon import pipeline, recipe
from jsecon.options import Options

room, out, victim, nth = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], int(sys.argv[4])
recipe.CHECKPOINT_SECONDS = 0.0
savez, seen = np.savez, 0

def savez_or_die(file, **arrays):
    global seen
    name = Path(file.name).name  # .<stage>-<key>[.checkpoint].<random>.partial.npz
    if name.startswith("." + victim.split()[0]) and ("checkpoint" in victim) == (".checkpoint." in name):
        seen += 1
        if seen == nth:
            savez(file, **dict(list(arrays.items())[:1]))  # a part of it reaches the disk
            file.flush()
            os.kill(os.getpid(), signal.SIGKILL)
    savez(file, **arrays)

np.savez = savez_or_die
pipeline.run(Options(room, holdout=4, steps=120), out)
"""


def test_a_run_killed_in_each_stage_and_started_again_ends_in_the_same_bytes(room, tmp_path):
    environ = os.environ | {"PYTHONPATH": str(Path(pipeline.__file__).parent.parent)}

    def start(out, victim="nobody", nth=1):
        return subprocess.run(
            [sys.executable, "-c", DRIVER, str(room), str(out), victim, str(nth)],
            env=environ,
            capture_output=True,
            text=True,
        ).returncode

    assert start(tmp_path / "straight") == 0
    out = tmp_path / "killed"
    for victim, nth in [("load", 1), ("gaussians checkpoint", 2), *((stage, 1) for stage in STAGES[1:]), ("field", 1)]:
        assert start(out, victim, nth) == -signal.SIGKILL, victim
        for path in (out / "cache").glob("[!.]*.npz"):  # whatever has its final name is whole
            cache.load(path)
        assert not (out / "field.npz").exists()
    assert start(out) == 0
    assert (out / "field.npz").read_bytes() == (tmp_path / "straight" / "field.npz").read_bytes()
    assert not list(out.rglob("*.checkpoint.npz"))
