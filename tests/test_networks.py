"""A run with SAM and CLIP from model folders, end to end: their content is in the keys, a stopped run keeps what they
found, and a field finds its model again or says what is missing."""

import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from clip_files import COLOURS, write_clip, write_visual
from hub_server import Repository, files_in, running_hub, use_hub
from sam2_files import write_sam2
from sam_files import write_sam
from test_pipeline import Recorder

from experiments.datasets.feature_files import write_features
from jsecon import InputError, load_capture, load_field, load_gaussians, save_field, save_gaussians
from jsecon.app import cli
from jsecon.fit.start import starting_gaussians
from jsecon.networks.hub import catalogue
from jsecon.networks.sam import SamSegmenter
from jsecon.networks.sam2 import Sam2Tracker
from jsecon.pipeline import model_loading, run as pipeline
from jsecon.pipeline.options import Options
from jsecon.pipeline.results import Checkpoint, Results, RunContext, StageInput
from jsecon.pipeline.stages import run_stages
from jsecon.query.scores import view_count_weight
from jsecon.vision.protocols import Segmenter
from jsecon.vision.stores import StoredSegmenter


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    base = tmp_path_factory.mktemp("models")
    return write_sam(base / "sam"), write_clip(base / "clip", "transformers.js")


@pytest.fixture
def hub(models):
    """A hub that has the recommended models: the small ones of this file in their repositories' layouts."""
    sam = {f"onnx/{Path(path).name}" if path.endswith(".onnx") else path: x for path, x in files_in(models[0]).items()}
    with running_hub() as running:
        running.repositories = {
            "onnx-community/EdgeTAM-ONNX": Repository(sam),
            "onnx-community/siglip2-base-patch16-224-ONNX": Repository(files_in(models[1])),
        }
        yield running


@pytest.fixture(scope="module")
def splat(room, tmp_path_factory):
    """The room's sparse points as Gaussians: a scene that is given, so that nothing is fitted."""
    start, _ = starting_gaussians(load_capture(room, holdout=4), sh_degree=1)
    path = tmp_path_factory.mktemp("splat") / "scene.ply"
    save_gaussians(path, start)
    return path


@pytest.fixture(scope="module")
def seen(room, splat, models, tmp_path_factory):
    """A run with both: the run, its folder, and what it told."""
    folder, console = tmp_path_factory.mktemp("seen"), Recorder()
    options = Options(room, gaussians=splat, holdout=4, segmenter=models[0], embedder=models[1], level="m")
    return pipeline.run(options, folder, console=console), folder, console


def test_a_run_with_sam_and_clip_finds_things_by_their_names(seen):
    run, folder, console = seen
    assert "proposals of level m by sam" in console.planned["objects"].why
    field = load_field(folder / "field.safetensors")
    assert field.embedder.startswith("clip-")
    assert field.regions.embeddings.shape[1] == 3
    assert field.regions.count >= 4
    texts = model_loading.field_embedder(field).embed_text([f"a {name} thing" for name in COLOURS])
    frames = np.asarray(run.capture.frames)[~run.capture.held_out]
    for text, (name, colour) in zip(texts, COLOURS.items()):
        best = int((np.asarray(field.regions.embeddings) @ text).argmax())
        means = [frames[run.labels == r].mean(0) for r in range(field.regions.count)]
        cosines = [mean @ colour / np.linalg.norm(mean) / np.linalg.norm(colour) for mean in means]
        assert cosines[best] > np.max(cosines) - 0.03, name


def test_the_same_models_elsewhere_are_cached_and_others_are_not(seen, models, tmp_path):
    run, folder, _ = seen
    shutil.copytree(folder, tmp_path / "out")
    moved = [shutil.copytree(model, tmp_path / f"moved{n}") for n, model in enumerate(models)]
    options = dataclasses.replace(run.options, segmenter=moved[0], embedder=moved[1])
    console = Recorder()
    pipeline.run(options, tmp_path / "out", console=console)
    assert not any(fresh for name, fresh in console.fresh.items() if name != "field")

    write_visual(moved[1] / "onnx" / "vision_model.onnx", ("pixel_values", "image_embeds"), "batch", std=(0.1, 1, 1))
    console = Recorder()
    pipeline.run(options, tmp_path / "out", console=console)
    fresh = {name for name, value in console.fresh.items() if value}
    assert "regions" in fresh
    assert not fresh & {"load", "gaussians", "objects", "votes"}


def test_a_damaged_model_is_said_before_any_work(seen, models, tmp_path):
    run, _, _ = seen
    folder = shutil.copytree(models[0], tmp_path / "sam")
    decoder = folder / "onnx" / "prompt_encoder_mask_decoder.onnx"
    decoder.write_bytes(decoder.read_bytes()[:400])
    console = Recorder()
    with pytest.raises(InputError, match=r"prompt_encoder_mask_decoder\.onnx: ONNX Runtime"):
        pipeline.run(dataclasses.replace(run.options, segmenter=folder), tmp_path / "out", console=console)
    assert console.fresh == {}


def test_sam_2_follows_what_sam_proposes(seen, tmp_path):
    """Random weights track nothing in earnest; the run, its plan and its key are what is tested."""
    run, folder, _ = seen
    shutil.copytree(folder / "cache", tmp_path / "out" / "cache")
    console = Recorder()
    options = dataclasses.replace(run.options, tracker=write_sam2(tmp_path / "sam2"))
    followed = pipeline.run(options, tmp_path / "out", console=console)
    assert console.planned["objects"].why.endswith("followed by sam2")
    assert console.fresh["objects"]
    assert not console.fresh["gaussians"]
    assert not np.array_equal(followed.labels, run.labels)


@pytest.mark.long
def test_a_run_that_is_stopped_while_sam_2_tracks_goes_on_at_its_frame(room, splat, tmp_path, monkeypatch):
    options = Options(room, gaussians=splat, holdout=4, tracker=write_sam2(tmp_path / "sam2"), granularity="coarse")
    monkeypatch.setattr("jsecon.pipeline.results.CHECKPOINT_SECONDS", 0.0)
    own, called, stop = Sam2Tracker.__call__, [], []

    def counted(self, frames, index, prompts):
        called.append(index)
        if index in stop:
            raise KeyboardInterrupt
        return own(self, frames, index, prompts)

    def tracked(folder):
        called.clear()
        work, results = RunContext(options, model_loading.open_models(options, folder), folder), Results()
        for stage in run_stages(work)[:3]:
            checkpoint = Checkpoint(folder / f"{stage.name}.safetensors")
            given = StageInput(work, results, lambda done, total: None, checkpoint)
            setattr(results, stage.name, stage.compute(given).value)
        return results.objects

    monkeypatch.setattr(Sam2Tracker, "__call__", counted)
    whole, everywhere = tracked(tmp_path / "whole"), called.copy()
    assert len(everywhere) > 2  # frames that showed something new
    stop.append(everywhere[1])
    with pytest.raises(KeyboardInterrupt):
        tracked(tmp_path / "out")
    stop.clear()
    np.testing.assert_array_equal(tracked(tmp_path / "out"), whole)
    assert called == everywhere[1:]


def test_query_finds_the_model_by_itself_or_says_what_it_needs(seen, models, tmp_path, capsys):
    _, folder, _ = seen
    field = folder / "field.safetensors"
    query = ["query", str(field), "red", "--out", str(tmp_path / "a"), "--views", "0"]
    assert cli.main([*query, "--min-rank", "0"]) == 0
    answer, found = json.loads((tmp_path / "a" / "red.json").read_text()), load_field(field)
    embedder = model_loading.field_embedder(found)
    text, words = embedder.embed_text(["red"])[0], embedder.unrelated_words
    similar = (
        np.asarray(found.regions.embeddings) @ (text - words.mean(axis=0)) / np.linalg.norm(text - words.mean(axis=0))
    )
    standing = np.asarray(view_count_weight(found.regions.pixel_counts))
    assert answer["region"] == int(np.where(similar > 0, similar * standing, similar).argmax())
    assert answer["score"] == pytest.approx(float(similar[answer["region"]]), abs=2e-3)
    other = write_clip(tmp_path / "other", "immich")
    assert cli.main(["query", str(field), "red", "--out", str(tmp_path / "b"), "--embedder", str(other)]) == 2
    assert "model that the field was made with" in capsys.readouterr().err
    lost = dataclasses.replace(load_field(field), provenance=json.dumps({"options": {"embedder": "/nowhere"}}))
    with pytest.raises(InputError, match=r"--embedder DIR"):
        model_loading.field_embedder(lost)
    assert model_loading.field_embedder(lost, models[1]).name == lost.embedder


def test_regions_take_their_embeddings_from_langsplat_s_files(room, splat, models, tmp_path):
    capture, folder, rows = load_capture(room, holdout=4), tmp_path / "language_features", []
    for t, name in enumerate(capture.names):
        ids = cv2.imread(str(room / "masks" / f"{name}.png"), cv2.IMREAD_UNCHANGED).astype(int)
        labels = np.unique(ids, return_inverse=True)[1].reshape(ids.shape) - (0 in ids)
        vectors = np.random.default_rng(t).normal(size=(labels.max() + 1, 3))
        write_features(folder, name, labels, vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
        rows += [] if capture.held_out[t] else list(np.load(folder / f"{name}_f.npy"))
    options = Options(room, gaussians=splat, holdout=4, masks=folder, features=folder, parts=True)
    work = RunContext(options, model_loading.open_models(options, tmp_path), tmp_path)
    assert work.models.embedder.name == "given-3"
    planned, results = {s.name: s for s in run_stages(work)}, Results(load=capture, gaussians=load_gaussians(splat))
    stage = planned["regions"]
    given = StageInput(work, results, lambda done, total: None, Checkpoint(tmp_path / "none.safetensors"))
    assert "read from language_features, level l" in stage.how
    assert "embedder" in stage.skipped
    results.objects = planned["objects"].compute(given).value
    found = stage.compute(given)
    np.testing.assert_allclose(found.value.embeddings, rows, atol=1e-6)
    assert found.notes == (f"{len(rows)} embeddings in the files",)
    of_masks = planned["parts"].compute(given).value
    seen = of_masks.weight > 0
    np.testing.assert_allclose(np.linalg.norm(of_masks.embeddings[seen], axis=1), 1, atol=1e-5)
    assert of_masks.embeddings.shape[1] == 3
    assert seen.sum() > len(found.value.embeddings)
    for name in capture.names:
        write_features(folder, name, np.full((120, 160), -1), np.zeros((0, 3)))
    with pytest.raises(InputError, match="no mask of level l"):
        stage.compute(given)
    with_clip = model_loading.open_models(dataclasses.replace(options, embedder=models[1]), tmp_path).embedder
    assert with_clip.name.startswith("clip-")


def test_texts_need_the_model_of_embeddings_from_files(seen, models, tmp_path, capsys):
    known = load_field(seen[1] / "field.safetensors")
    given = dataclasses.replace(
        known, embedder="given-3", canonical_phrases=np.zeros((0, 3), np.float32), provenance="{}"
    )
    save_field(tmp_path / "field.safetensors", given)
    ask = ["query", str(tmp_path / "field.safetensors"), "red", "--views", "0", "--out", str(tmp_path / "answers")]
    assert cli.main(ask) == 2
    assert "came from files, 3 numbers each" in capsys.readouterr().err
    assert cli.main([*ask, "--embedder", str(models[1]), "--min-rank", "0"]) == 0
    assert 0 < json.loads((tmp_path / "answers" / "red.json").read_text())["score"] < 1
    with pytest.raises(InputError, match="5, as those from files have"):
        model_loading._open_embedder("given-5", folder=models[1])


def test_two_sources_of_masks_are_refused(room, models, tmp_path):
    with pytest.raises(InputError, match="--masks --segmenter"):
        pipeline.run(Options(room, masks=room / "masks", segmenter=models[0]), tmp_path)
    with pytest.raises(InputError, match=r"no such folder\. .*EdgeTAM-ONNX"):
        pipeline.run(Options(room, segmenter=tmp_path / "nowhere"), tmp_path)


def test_proposals_are_kept_by_content(models, tmp_path):
    frame = np.zeros((60, 80, 3), np.uint8)
    frame[10:40, 10:50] = (200, 30, 30)
    stored, failing = (StoredSegmenter(SamSegmenter(models[0]), tmp_path) for _ in range(2))
    assert isinstance(stored, Segmenter)
    masks = stored(frame, 0)
    assert len(masks) >= 1
    failing._segmenter = None  # whatever is asked of it now must come from disk
    np.testing.assert_array_equal(failing(frame, 5), masks)
    with pytest.raises(TypeError):
        failing(255 - frame, 0)
    path = next(tmp_path.glob("*.safetensors"))
    path.write_bytes(path.read_bytes()[:60])
    np.testing.assert_array_equal(stored(frame, 0), masks)
    assert SamSegmenter(models[0], level="m").name != stored.name


def test_models_by_name_are_fetched_once_and_found_again_for_a_moved_field(
    room, splat, hub, tmp_path, monkeypatch, capsys
):
    use_hub(hub, tmp_path / "cache", monkeypatch)
    out = tmp_path / "out"
    command = ["run", str(room), "--gaussians", str(splat), "--holdout", "4", "--out", str(out), "--models", "auto"]
    command += ["--level", "m", "--vision-frames", "5"]
    assert cli.main(command) == 2  # a run fetches nothing
    assert "jsecon models get edgetam" in (said := capsys.readouterr().err)
    assert "jsecon models get siglip2" in said
    assert cli.main(["models", "get", "auto"]) == 0
    assert cli.main(command) == 0
    planned = capsys.readouterr().out
    asked = len(hub.requests)
    use_hub(hub, tmp_path / "cache", monkeypatch, offline=True)
    assert cli.main(command) == 0
    field = tmp_path / "elsewhere" / "field.safetensors"
    field.parent.mkdir()
    shutil.copy(out / "field.safetensors", field)
    assert str(tmp_path).encode() + b"/cache" not in field.read_bytes()
    query = ["query", str(field), "a red thing", "--out", str(tmp_path / "answers"), "--min-rank", "0"]
    assert cli.main(query) == 0
    assert len(hub.requests) == asked
    assert "by edgetam, what the views agree on" in planned
    assert (np.asarray(load_field(field).regions.pixel_counts).sum(0) > 0).sum() == 5
    use_hub(hub, tmp_path / "empty", monkeypatch)
    capsys.readouterr()
    assert cli.main(query) == 2
    commit = hub.repositories["onnx-community/siglip2-base-patch16-224-ONNX"].commit
    address = f"hub:onnx-community/siglip2-base-patch16-224-ONNX@{commit}"
    assert f"jsecon models get {address} --role embedder" in capsys.readouterr().err
    assert cli.main(["models", "get", address, "--role", "embedder"]) == 0
    assert cli.main(query) == 0


def test_models_of_masks_stay_in_full_precision_where_there_is_no_other(room, hub, tmp_path, monkeypatch):
    files = hub.repositories["onnx-community/siglip2-base-patch16-224-ONNX"].files
    for name in ("onnx/vision_model.onnx", "onnx/text_model.onnx"):
        files[name.replace(".onnx", "_quantized.onnx")] = files.pop(name)
    use_hub(hub, tmp_path / "cache", monkeypatch)
    command = ["run", str(room), "--out", str(tmp_path / "out"), "--models", "auto", "--dry-run"]
    assert cli.main(["models", "get", "auto", "--precision", "int8"]) == 0
    assert cli.main([*command, "--precision", "int8"]) == 0
    fetched = {path.name for path in (tmp_path / "cache").rglob("*.onnx")}
    assert {"vision_model_quantized.onnx", "vision_encoder.onnx"} <= fetched
    assert cli.main([*command, "--precision", "fp16"]) == 2  # of the embedder, whose repository has no such graphs


def test_models_are_listed_fetched_and_checked_by_name(hub, tmp_path, monkeypatch, capsys):
    use_hub(hub, tmp_path / "cache", monkeypatch)
    assert cli.main(["models", "get", "edgetam", "siglip2"]) == 2  # this hub has no tracker of the first name
    assert "has no such repository" in capsys.readouterr().err
    assert cli.main(["models", "list", "--json"]) == 0
    rows = {
        row["name"]: row["cached"] for row in json.loads(capsys.readouterr().out)["models"] if row["role"] == "embedder"
    }
    assert rows == {"clip": [], "siglip2": ["fp32"], "mobileclip": []}
    assert cli.main(["models", "list"]) == 0
    assert "s/frame" in (listed := capsys.readouterr().out)
    assert all(row.purpose in listed for row in catalogue())
    assert cli.main(["models", "check", "siglip2"]) == 0
    assert "CLIP: usable" in capsys.readouterr().out
    assert cli.main(["models", "check", "clip"]) == 2
    assert "jsecon models get clip" in capsys.readouterr().err
    assert cli.main(["models", "get", "auto"]) == 0
    assert cli.main(["models", "get", "clap"]) == 2
    assert cli.main(["models", "get"]) == 2
