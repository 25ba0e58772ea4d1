"""A run: its plan, its cache, what it leaves out, what it never looks at, and that it survives being killed."""

import dataclasses
import shutil
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest
from capture_files import small_capture
from mask_overlaps import iou_matrix

from jsecon import InputError, load_field, save_gaussians
from jsecon.field import field as field_file
from jsecon.field.tree import part_objects
from jsecon.files import write_arrays
from jsecon.paper import autoencoder
from jsecon.pipeline import cache, run as pipeline
from jsecon.pipeline.objects import _TrainingView
from jsecon.pipeline.options import Options
from jsecon.pipeline.progress import Console, Step

STAGES = ("load", "gaussians", "objects", "regions", "parts", "votes", "held_out")


class Recorder(Console):
    """Keeps what it is told."""

    def __init__(self):
        super().__init__()
        self.planned, self.fresh, self.notes = {}, {}, []

    def print_line(self, text):
        if text.startswith("  "):
            step = Step(*text.split(maxsplit=2))
            self.planned.setdefault(step.name, step)

    def done(self, name, seconds, fresh):
        self.fresh[name] = fresh

    def note(self, text):
        self.notes.append(text)


def again(run, out, **changes):
    console = Recorder()
    return pipeline.run(dataclasses.replace(run.options, **changes), out, console=console), console


def test_a_run_ends_in_a_field_that_can_be_read_and_asked(room_run):
    run, out = room_run
    field = load_field(out / "field.safetensors")
    assert field.gaussians.count == run.field.gaussians.count > 100
    assert field.names == run.capture.names
    assert len(run.held_out.psnr) == run.capture.held_out.sum() == 2
    pixels = np.asarray(field.regions.pixel_counts)
    assert (pixels[:, run.capture.held_out] == 0).all()
    assert (pixels[:, ~run.capture.held_out].sum(1) > 0).all()
    assert set(run.seconds) == {*STAGES, "field"}
    assert run.labels.shape == (6, 120, 160)


def test_a_second_run_reads_every_stage_and_writes_the_same_bytes(room_run, tmp_path):
    run, out = room_run
    before = (out / "field.safetensors").read_bytes()
    second, console = again(run, out)
    assert {name: fresh for name, fresh in console.fresh.items() if name != "field"} == dict.fromkeys(STAGES, False)
    assert all(console.planned[name].status == "cached" for name in STAGES)
    assert (out / "field.safetensors").read_bytes() == before
    assert second.seconds["gaussians"] == run.seconds["gaussians"]


def test_a_changed_option_reruns_only_what_depends_on_it(room_run, tmp_path):
    run, out = room_run
    shutil.copytree(out, tmp_path / "out")
    _, console = again(run, tmp_path / "out", centre_pixel_weight=1.0)
    assert {name for name, fresh in console.fresh.items() if fresh} == {"votes", "field"}
    assert {name for name, step in console.planned.items() if step.status == "run"} == {"votes"}


def test_votes_of_a_scene_larger_than_memory_are_cast_in_blocks_to_the_same_field(room_run, tmp_path, monkeypatch):
    run, out = room_run
    shutil.copytree(out, tmp_path / "out")
    next((tmp_path / "out" / "cache").glob("votes-*.safetensors")).write_bytes(b"damaged")
    monkeypatch.setattr(autoencoder, "MIN_STEPS", 1)  # it is enough that one is trained, by LangSplat's 100 epochs
    monkeypatch.setenv("JSECON_MEMORY", "1e-6")
    monkeypatch.setattr(cache, "MAPPED", 1000)  # what is kept of them is mapped, as were it larger
    _, console = again(run, tmp_path / "out", paper=True)
    assert {name for name, fresh in console.fresh.items() if fresh} == {"votes", "codes", "field"}
    for words in ("stage votes is computed again", "votes are kept on disk: "):
        assert any(words in note for note in console.notes)
    assert {path.suffix for path in (tmp_path / "out" / "cache").iterdir()} == {".TAG", ".safetensors"}
    blocks, memory = (load_field(folder / "field.safetensors").votes for folder in (tmp_path / "out", out))
    np.testing.assert_allclose(blocks.weights, memory.weights, rtol=1e-4, atol=0.02)
    for name in ("weights", "total", "weight_where_region_visible", "overlap"):
        own, other = (np.asarray(getattr(votes, name), np.float64) for votes in (blocks, memory))
        assert np.linalg.norm(own - other) <= 1e-4 * np.linalg.norm(other)
    assert (np.asarray(blocks.regions) != np.asarray(memory.regions)).mean() < 1e-3


def test_what_is_held_out_never_reaches_the_field(room_run, room, tmp_path):
    """The same short run with noise in place of the held-out frames and their masks gives the same field."""
    run, _ = room_run
    shutil.copytree(room, tmp_path / "noise")
    rng = np.random.default_rng(0)
    for name, held in zip(run.capture.names, run.capture.held_out):
        if held:
            noise = rng.integers(0, 255, (120, 160, 3)).astype(np.uint8)
            cv2.imwrite(str(tmp_path / "noise" / "images" / f"{name}.png"), noise)
            (tmp_path / "noise" / "masks" / f"{name}.png").unlink()
    short = dataclasses.replace(run.options, steps=6)
    noisy = dataclasses.replace(short, capture=tmp_path / "noise", masks=tmp_path / "noise" / "masks")
    one, other = (pipeline.run(options, tmp_path / f"out{n}") for n, options in enumerate((short, noisy)))
    assert not np.array_equal(other.capture.frames, one.capture.frames)
    for name in ("gaussians", "votes", "regions"):
        want, have = (jax.tree.leaves(getattr(r.field, name)) for r in (one, other))
        for a, b in zip(have, want, strict=True):
            np.testing.assert_array_equal(a, b, err_msg=name)


def test_the_frames_in_which_masks_are_found_are_the_captures_own_or_one_copy():
    capture = small_capture(5)
    all_frames, four = (_TrainingView(capture, Options(Path("room")), np.arange(count)) for count in (5, 4))
    assert np.shares_memory(all_frames.frames, capture.frames)
    assert four.frames is four.frames


def test_default_vision_finds_regions_by_itself(room, room_run, tmp_path):
    """Segmenter, tracker and colours on the tiny room: the whole default path, on the Gaussians of the other run."""
    run, out = room_run
    shutil.copytree(out / "cache", tmp_path / "cache")
    console = Recorder()
    found = pipeline.run(dataclasses.replace(run.options, masks=None), tmp_path, console=console)
    assert not console.fresh["gaussians"]
    assert console.fresh["objects"]
    overlap = iou_matrix(
        *(labels.ravel() == np.arange(labels.max() + 1)[:, None] for labels in (run.labels, found.labels))
    )
    found_as = np.sort(overlap.max(1))  # of each object of the room, over all views
    assert len(found_as) >= 10
    assert found_as[1] > 0.8
    assert found_as[0] > 0.4
    field = load_field(tmp_path / "field.safetensors")
    assert field.part_regions.count == len(field.part_nodes) > 0
    assert (part_objects(field) >= 0).all()
    shown = (np.asarray(field.part_regions.pixel_counts) > 0).any(1)
    np.testing.assert_allclose(np.linalg.norm(field.part_regions.embeddings[shown], axis=1), 1, rtol=1e-4)
    assert {stage.name for stage in found.steps} >= {"parts"}


def test_a_tracker_without_a_model_follows_proposals_through_the_gaussians(room_run, tmp_path):
    run, out = room_run
    shutil.copytree(out / "cache", tmp_path / "out" / "cache")
    found, console = again(run, tmp_path / "out", masks=None, tracker="geometric")
    assert console.planned["objects"].why.endswith("followed through the Gaussians")
    assert not console.fresh["gaussians"]
    assert len(found.labels) == (~run.capture.held_out).sum()
    assert found.labels.max() >= 10
    assert found.field.tree is None


def test_gaussians_of_another_world_are_refused(room_run, tmp_path):
    run, _ = room_run
    far = dataclasses.replace(run.field.gaussians, means=np.asarray(run.field.gaussians.means) + np.float32(1000))
    save_gaussians(tmp_path / "far.ply", far)
    with pytest.raises(InputError, match="belong"):
        pipeline.run(dataclasses.replace(run.options, gaussians=tmp_path / "far.ply"), tmp_path / "out")


class Killed(Exception):
    """In place of a process that ends."""


def writer_that_stops(path, arrays, description):
    """`write_arrays`, but of the result of the stage "votes", and of the field, only a part reaches the disk."""
    if Path(path).name.startswith((".votes-", ".field.")):
        write_arrays(path, dict(list(arrays.items())[:1]), description)
        raise Killed
    write_arrays(path, arrays, description)


def test_a_run_stopped_while_it_writes_goes_on_to_the_same_bytes(room_run, tmp_path, monkeypatch):
    run, straight = room_run
    out = shutil.copytree(straight, tmp_path / "out", ignore=shutil.ignore_patterns("votes-*", "field.safetensors"))
    for module in (cache, field_file):
        with monkeypatch.context() as patch:
            patch.setattr(module, "write_arrays", writer_that_stops)
            with pytest.raises(Killed):
                pipeline.run(run.options, out)
        assert not (out / "field.safetensors").exists()
    pipeline.run(run.options, out)
    assert (out / "field.safetensors").read_bytes() == (straight / "field.safetensors").read_bytes()
