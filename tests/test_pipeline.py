"""A run: its plan, its cache, what it leaves out, what it never looks at, and that it survives being killed."""

import dataclasses
import json
import re
import shutil
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest
from capture_files import refused, transforms
from mask_overlaps import iou_matrix

import jsecon
from jsecon import InputError, load_field, save_gaussians
from jsecon.app import cli
from jsecon.field import field as field_file
from jsecon.files import write_arrays
from jsecon.paper import autoencoder
from jsecon.pipeline import cache, model_loading, run as pipeline
from jsecon.pipeline.progress import Console
from jsecon.process import peak_memory_mib

STAGES = ("load", "gaussians", "objects", "regions", "votes", "held_out")


class Recorder(Console):
    """Keeps what it is told."""

    def __init__(self):
        super().__init__()
        self.planned, self.fresh, self.notes = {}, {}, []

    def step(self, step):
        self.planned.setdefault(step.name, step)

    def done(self, name, seconds, fresh):
        self.fresh[name] = fresh

    def note(self, text):
        self.notes.append(text)


def skipped(run):
    """The parts that a run did not need, each with the reason."""
    return {step.name: step.why for step in run.steps if step.status == "skipped"}


def _again(run, out, **changes):
    console = Recorder()
    return pipeline.run(dataclasses.replace(run.options, **changes), out, console=console), console


def test_a_run_ends_in_a_field_that_can_be_read_and_asked(room_run):
    run, out = room_run
    field = load_field(out / "field.safetensors")
    assert field.gaussians.count == run.field.gaussians.count > 100
    assert field.names == run.capture.names
    assert field.codes is None
    assert field.votes.overlap.shape == (field.regions.count, field.regions.count)
    assert len(run.held_out.psnr) == run.capture.held_out.sum() == 2
    assert (np.asarray(field.regions.pixel_counts)[:, run.capture.held_out] == 0).all()
    assert (np.asarray(field.regions.pixel_counts)[:, ~run.capture.held_out].sum(1) > 0).all()
    assert set(run.seconds) == {*STAGES, "field"}
    assert run.labels.shape == (6, 120, 160)


def test_a_second_run_reads_every_stage_and_writes_the_same_bytes(room_run, tmp_path):
    run, out = room_run
    before = (out / "field.safetensors").read_bytes()
    again, console = _again(run, out)
    assert {name: fresh for name, fresh in console.fresh.items() if name != "field"} == dict.fromkeys(STAGES, False)
    assert all(console.planned[name].status == "cached" for name in STAGES)
    assert (out / "field.safetensors").read_bytes() == before
    assert again.seconds["gaussians"] == run.seconds["gaussians"]
    assert skipped(again) == skipped(run)


@pytest.mark.parametrize(("changes", "rerun"), [
    ({"paper": True}, {"codes"}), ({"centre_pixel_weight": 1.0}, {"votes"}),
])  # fmt: skip
def test_a_changed_option_reruns_only_what_depends_on_it(room_run, tmp_path, monkeypatch, changes, rerun):
    monkeypatch.setattr(autoencoder, "MIN_STEPS", 1)  # it is enough that one is trained, by LangSplat's 100 epochs
    run, out = room_run
    shutil.copytree(out, tmp_path / "out")
    _, console = _again(run, tmp_path / "out", **changes)
    assert {name for name, fresh in console.fresh.items() if fresh} - {"field"} == rerun
    assert {name for name, step in console.planned.items() if step.status == "run"} == rerun


def test_a_damaged_stage_is_said_and_computed_again_to_the_same_field(room_run, tmp_path):
    run, out = room_run
    shutil.copytree(out, tmp_path / "out")
    path = next((tmp_path / "out" / "cache").glob("votes-*.safetensors"))
    path.write_bytes(path.read_bytes()[:1000])
    _, console = _again(run, tmp_path / "out")
    assert {name for name, fresh in console.fresh.items() if fresh} == {"votes", "field"}
    assert any("votes is computed again" in note for note in console.notes)
    assert (tmp_path / "out" / "field.safetensors").read_bytes() == (out / "field.safetensors").read_bytes()


def test_votes_of_a_scene_larger_than_memory_are_cast_in_blocks_to_the_same_field(room_run, tmp_path, monkeypatch):
    run, out = room_run
    shutil.copytree(out, tmp_path / "out")
    for file in (tmp_path / "out" / "cache").glob("votes-*"):
        file.unlink()
    monkeypatch.setenv("JSECON_MEMORY", "1e-6")
    monkeypatch.setattr(cache, "MAPPED", 1000)  # what is kept of them is mapped, as were it larger
    _, console = _again(run, tmp_path / "out", paper=True)  # codes are made of them too
    assert any("votes are kept on disk: " in note for note in console.notes)
    assert {path.suffix for path in (tmp_path / "out" / "cache").iterdir()} == {".TAG", ".safetensors"}
    blocks, memory = (load_field(folder / "field.safetensors").votes for folder in (tmp_path / "out", out))
    np.testing.assert_allclose(blocks.weights, memory.weights, rtol=1e-4, atol=0.02)
    for name in ("weights", "total", "weight_where_region_visible", "overlap"):
        own, other = (np.asarray(getattr(votes, name), np.float64) for votes in (blocks, memory))
        assert np.linalg.norm(own - other) <= 1e-4 * np.linalg.norm(other)
    assert (np.asarray(blocks.regions) != np.asarray(memory.regions)).mean() < 1e-3


@pytest.fixture(scope="module")
def on_given_gaussians(room_run, tmp_path_factory):
    """The run on its own Gaussians given as a file, and what was told."""
    folder, console = tmp_path_factory.mktemp("given"), Recorder()
    save_gaussians(folder / "scene.ply", room_run[0].field.gaussians)
    options = dataclasses.replace(room_run[0].options, gaussians=folder / "scene.ply")
    return pipeline.run(options, folder / "out", console=console), console


def test_the_plan_says_what_is_left_out_and_why(room_run, on_given_gaussians, tmp_path):
    run, _ = room_run
    given, console = on_given_gaussians
    assert {"segmenter", "association"} <= set(skipped(run))
    assert "scene.ply" in skipped(given)["photometric fit"]
    assert console.planned["photometric fit"].status == "skipped"
    assert console.planned["gaussians"].status == "run"
    np.testing.assert_array_equal(given.field.gaussians.means, run.field.gaussians.means)


def test_the_same_scene_far_away_in_another_world_and_unit_gives_the_same_answers(room, on_given_gaussians, tmp_path):
    """In kilometres of a map projection, as nerfstudio's poses with an applied_transform, on Gaussians as `jsecon fit`
    writes them: in the world before that transform."""
    given, scale = on_given_gaussians[0], 1e-3
    shift, turn = np.array([1e7, 5411876.6, 312.25]), np.eye(4)
    turn[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    source_from_scene = np.diag([scale, scale, scale, 1.0])
    source_from_scene[:3, 3] = scale * shift
    told = transforms(given.capture, applied_transform=turn[:3].tolist())
    for frame in told["frames"]:
        pose = np.array(frame["transform_matrix"])
        pose[:3, 3] = scale * (pose[:3, 3] + shift)
        frame["transform_matrix"] = (turn @ pose).tolist()
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / "images").symlink_to(room / "images")
    (tmp_path / "capture" / "transforms.json").write_text(json.dumps(told))
    scene, out = tmp_path / "scene.ply", tmp_path / "out"
    jsecon.save_gaussians(scene, given.field.gaussians, similarity=source_from_scene)
    options = dataclasses.replace(given.options, capture=tmp_path / "capture", gaussians=scene)
    there = pipeline.run(options, out)
    assert not [note for note in there.notes if "WARNING" in note]
    np.testing.assert_allclose(there.held_out.psnr, given.held_out.psnr, atol=0.1)
    text = next(iter(json.loads((room / "scene.json").read_text())["objects"].values()))
    place = jsecon.Scene(given.field).locate(text)
    assert cli.main(["query", str(out / "field.safetensors"), text, "--out", str(out), "--views", "1"]) == 0
    answer = json.loads(next(out.glob("*.json")).read_text())
    chosen = jsecon.load_gaussians(out / answer["ply"], similarity=np.linalg.inv(source_from_scene))
    assert chosen.count == answer["count"] == len(place.points)
    np.testing.assert_allclose(chosen.means, place.points, atol=1e-4)
    found = jsecon.open_scene(out).locate(text)
    np.testing.assert_allclose(found.points.mean(0) / scale - shift, place.points.mean(0), atol=1e-3)
    box = answer["place"]["bounding_box"]
    np.testing.assert_allclose(np.array(box["min"]) / scale - shift, place.points.min(0), atol=1e-3)


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


def test_parts_of_the_scene_are_a_stage_of_their_own(room_run, tmp_path):
    run, out = room_run
    shutil.copytree(out, tmp_path / "out")
    _, console = _again(run, tmp_path / "out", parts=True)
    assert {name for name, fresh in console.fresh.items() if fresh} == {"parts", "field"}
    field = load_field(tmp_path / "out" / "field.safetensors")
    part, units = np.asarray(field.parts.part), np.asarray(field.parts.embeddings)
    assert part.shape == (field.gaussians.count,)
    assert part.max() + 1 == len(units) > field.regions.count
    # A part looks like the region that most of what is seen of it lies in.
    votes, own = field.votes, (np.asarray(field.votes.views) > 0) & (part >= 0)
    weight = np.zeros((len(units), field.regions.count))
    for regions, weights in zip(np.asarray(votes.regions)[own].T, np.asarray(votes.weights)[own].T):
        np.add.at(weight, (part[own][regions >= 0], regions[regions >= 0]), weights[regions >= 0])
    clear = weight.max(1) > 0.8 * np.asarray(field.parts.weight)
    assert clear.mean() > 0.3
    nearest = (units @ np.asarray(field.regions.embeddings).T).argmax(1)
    assert (nearest == weight.argmax(1))[clear].mean() > 0.9
    np.testing.assert_array_equal(field.votes.weights, run.field.votes.weights)
    assert run.field.parts is None


def test_default_vision_finds_regions_by_itself(room, room_run, tmp_path):
    """Segmenter, tracker and colours on the tiny room: the whole default path, on the Gaussians of the other run."""
    run, out = room_run
    shutil.copytree(out / "cache", tmp_path / "cache")
    console = Recorder()
    found = pipeline.run(dataclasses.replace(run.options, masks=None), tmp_path, console=console)
    assert not console.fresh["gaussians"]
    assert console.fresh["objects"]
    assert "segmenter" not in skipped(found)
    overlap = iou_matrix(
        *(labels.ravel() == np.arange(labels.max() + 1)[:, None] for labels in (run.labels, found.labels))
    )
    found_as = np.sort(overlap.max(1))  # of each object of the room, over all views
    assert len(found_as) >= 10
    assert found_as[1] > 0.8
    assert found_as[0] > 0.4


@pytest.mark.parametrize(("changes", "where"), [
    ({"capture": Path("nowhere")}, "nowhere"), ({"gaussians": Path("nowhere.ply")}, "nowhere.ply"),
    ({"masks": Path("nowhere")}, "nowhere"), ({"steps": 0}, "--steps"),
])  # fmt: skip
def test_what_cannot_be_is_refused_before_any_work(room_run, tmp_path, changes, where):
    run, _ = room_run
    console = Recorder()
    with refused(where):
        pipeline.run(dataclasses.replace(run.options, **changes), tmp_path / "out", console=console)
    assert console.fresh == {}


def test_gaussians_of_another_world_are_refused(room_run, tmp_path):
    run, _ = room_run
    far = dataclasses.replace(run.field.gaussians, means=np.asarray(run.field.gaussians.means) + np.float32(1000))
    save_gaussians(tmp_path / "far.ply", far)
    with pytest.raises(InputError, match="belong"):
        pipeline.run(dataclasses.replace(run.options, gaussians=tmp_path / "far.ply"), tmp_path / "out")


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="Linux tells it there")
def test_peak_memory_is_in_mebibytes():
    (peak,) = re.findall(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert peak_memory_mib() == pytest.approx(int(peak) / 2**10, rel=0.01)


def test_embedders_of_other_versions_are_refused():
    with pytest.raises(InputError, match="Run the capture again"):
        model_loading._open_embedder("colours-of-the-future")


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
