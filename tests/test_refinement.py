"""`--refine` of a run: which captures it looks at by default, what it decides, and what a dry run tells of it."""

import dataclasses
import json

import cv2
import jax
import numpy as np
import pytest
from capture_files import transforms, write_images
from test_corrections import (
    capture as capture,  # fixtures
    errors,
    rough,
    truth as truth,
)

from jsecon.app import cli
from jsecon.pipeline.options import Options
from jsecon.pipeline.results import RunContext
from jsecon.pipeline.run import compute_stages
from jsecon.pipeline.scene import plan_capture
from jsecon.poses import refine
from jsecon.vision.colours import ColourEmbedder
from jsecon.vision.protocols import Models


def write(capture, folder, *, depth=True):
    """As nerfstudio lays out an RGB-D capture."""
    write_images(capture, folder / "images")
    scene = transforms(capture)
    if depth:
        (folder / "depth").mkdir()
        for frame, name, image in zip(scene["frames"], capture.names, capture.depths):
            assert cv2.imwrite(str(folder / "depth" / f"{name}.png"), np.rint(image * 1000).astype(np.uint16))
            frame["depth_file_path"] = f"depth/{name}.png"
    (folder / "transforms.json").write_text(json.dumps(scene))
    return folder


def load(folder, out, **options):
    """What the first stage of a run makes of a capture, and what it told."""
    given = Options(capture=folder, holdout=6, steps=2000, **options)
    work = RunContext(given, Models(ColourEmbedder()), out)
    done = compute_stages(work, plan_capture(work))
    return done.results.load, " ".join(done.notes), done.steps[0].status


def alike(a, b):
    a, b = (dataclasses.replace(c, notes=()) for c in (a, b))
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


@pytest.fixture
def _small(monkeypatch, truth):
    """Frames of one size, and a start of the probes that few views can correct."""
    monkeypatch.setattr(refine, "FINE_SIZE", 1.0)
    monkeypatch.setattr(refine, "MIN_ASIDE", 1)
    monkeypatch.setattr(refine, "starting_gaussians", lambda capture, **_: (truth, ""))


@pytest.mark.long
@pytest.mark.usefixtures("_small")
def test_by_default_a_rough_capture_with_depth_is_corrected_once(capture, tmp_path):
    told = write(rough(capture, **errors()), tmp_path / "rough")
    as_it_is, _, _ = load(told, tmp_path / "none", refine="never")
    better, notes, status = load(told, tmp_path / "out")
    assert status == "run"
    assert "are corrected" in notes
    assert not alike(better, as_it_is)
    again, notes, status = load(told, tmp_path / "out")
    assert status == "cached"
    assert "are corrected" in notes
    assert alike(again, better)


@pytest.mark.long
@pytest.mark.usefixtures("_small")
def test_by_default_an_exact_capture_stays_as_its_files_say(capture, tmp_path):
    exact = write(capture, tmp_path / "exact")
    kept, notes, _ = load(exact, tmp_path / "out")
    assert "stay as they are" in notes
    assert alike(kept, load(exact, tmp_path / "none", refine="never")[0])


def test_without_depth_or_with_gaussians_nothing_is_tried(capture, tmp_path):
    def how(folder, **options):
        return plan_capture(RunContext(Options(folder, **options), Models(ColourEmbedder()), tmp_path / "out"))[-1]

    plain = write(capture, tmp_path / "plain", depth=False)
    deep = write(capture, tmp_path / "deep")
    for one, other in (
        (how(plain), how(plain, refine="never")),
        (how(deep, gaussians=plain), how(deep, refine="never")),
    ):
        assert one.how == other.how
        assert one.key_options == other.key_options
    assert how(deep).key_options != how(deep, steps=300).key_options
    _, notes, _ = load(plain, tmp_path / "none")
    assert "stay as they are" not in notes


def test_a_dry_run_lists_the_refinement(capture, tmp_path, capsys):
    folder = write(capture, tmp_path / "deep")

    def load_stage(*options):
        line = ["fit", str(folder), "--out", str(tmp_path / "out.ply"), *options, "--dry-run", "--json"]
        assert cli.main(line) == 0
        return next(stage for stage in json.loads(capsys.readouterr().out)["stages"] if stage["name"] == "load")

    assert "corrected by short fits in about half" in load_stage()["why"]
    assert load_stage("--refine", "always")["why"].endswith("corrected by short fits")
    assert "corrected" not in load_stage("--refine", "never")["why"]
