"""A run with SAM and CLIP from model folders, end to end: their content is in the keys, a stopped run keeps what they
found, and a field finds its model again or says what is missing."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from capture_files import compute_stage, refused, run_cli
from clip_files import COLOURS, write_clip, write_visual
from hub_server import Repository, files_in, running_hub, use_hub
from sam2_files import write_sam2
from sam_files import write_sam
from test_pipeline import Recorder, again

from jsecon import Scene, load_capture, load_field, save_gaussians
from jsecon.fit.start import starting_gaussians
from jsecon.networks.sam import SamSegmenter
from jsecon.pipeline import model_loading, run as pipeline
from jsecon.pipeline.options import Options
from jsecon.pipeline.stages import RunContext


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
    assert console.planned["gaussians"].why.endswith("scene.ply")
    field = load_field(folder / "field.safetensors")
    assert field.embedder.startswith("clip-")
    assert field.regions.count >= 4
    texts = model_loading.field_embedder(field).embed_text([f"a {name} thing" for name in COLOURS])
    frames = np.asarray(run.capture.frames)[run.vision_frames]
    for text, (name, colour) in zip(texts, COLOURS.items()):
        best = int((np.asarray(field.regions.embeddings) @ text).argmax())
        means = [frames[run.labels == r].mean(0) for r in range(field.regions.count)]
        cosines = [mean @ colour / np.linalg.norm(mean) / np.linalg.norm(colour) for mean in means]
        assert cosines[best] > np.max(cosines) - 0.03, name


def fresh_of(console):
    return {name for name, fresh in console.fresh.items() if fresh} - {"field"}


def test_regions_are_embedded_in_few_views_and_their_pixels_count_in_all(seen, tmp_path):
    run, folder, console = seen
    assert "in 5 views each" in console.planned["regions"].why
    shutil.copytree(folder / "cache", tmp_path / "out" / "cache")
    single, console = again(run, tmp_path / "out", crops=1)
    assert fresh_of(console) == {"regions", "parts"}
    pixels = np.asarray(run.field.regions.pixel_counts)
    np.testing.assert_array_equal(single.field.regions.pixel_counts, pixels)
    assert f"{len(pixels)} of {np.count_nonzero(pixels)} crops embedded" in " ".join(single.notes)
    assert not np.array_equal(single.field.regions.embeddings, run.field.regions.embeddings)


def test_the_same_models_elsewhere_are_cached_and_others_are_not(seen, models, tmp_path):
    run, folder, _ = seen
    shutil.copytree(folder, tmp_path / "out")
    sam, clip = (shutil.copytree(model, tmp_path / f"moved{n}") for n, model in enumerate(models))
    assert not fresh_of(again(run, tmp_path / "out", segmenter=sam, embedder=clip)[1])
    write_visual(clip / "onnx" / "vision_model.onnx", ("pixel_values", "image_embeds"), "batch", std=(0.1, 1, 1))
    fresh = fresh_of(again(run, tmp_path / "out", segmenter=sam, embedder=clip)[1])
    assert "regions" in fresh
    assert not fresh & {"load", "gaussians", "objects", "votes"}


def test_a_damaged_model_and_two_sources_of_masks_are_refused_before_any_work(seen, room, models, tmp_path):
    folder = shutil.copytree(models[0], tmp_path / "sam")
    decoder = folder / "onnx" / "prompt_encoder_mask_decoder.onnx"
    decoder.write_bytes(decoder.read_bytes()[:400])
    for changes, *words in (
        ({"segmenter": folder}, "prompt_encoder_mask_decoder.onnx: ONNX Runtime"),
        ({"masks": room / "masks"}, "--masks --segmenter"),
        ({"segmenter": tmp_path / "nowhere"}, "no such folder"),
    ):
        with refused(*words):
            again(seen[0], tmp_path / "out", **changes)
    assert not list(tmp_path.glob("out/cache/*.safetensors"))


def test_a_segmenter_takes_the_frames_that_number_and_time_allow(seen, tmp_path):
    run, _, _ = seen
    for limit, count in (({"vision_frames": 3}, 3), ({"vision_minutes": 1e-6}, 2)):
        options = dataclasses.replace(run.options, **limit)
        context = RunContext(*model_loading.open_models(options, tmp_path), tmp_path)
        found, _ = compute_stage(context, "objects", load=run.capture, gaussians=run.field.gaussians)
        assert len(found.value.labels) == len(found.value.frames) == count
        assert not run.capture.held_out[found.value.frames].any()
        assert f"{count} of 6 training frames: --{next(iter(limit)).replace('_', '-')} allows no more" in found.notes[0]
    with refused("--vision-minutes", "name a --segmenter"):
        again(run, tmp_path / "out", segmenter=None, vision_minutes=1.0)
    with refused("--ignore", "--models auto"):
        again(run, tmp_path / "out", segmenter=None, ignore="person")


def test_sam_2_follows_what_sam_proposes(seen, tmp_path):
    """Random weights track nothing in earnest; the run, its plan and its key are what is tested."""
    run, folder, _ = seen
    shutil.copytree(folder / "cache", tmp_path / "out" / "cache")
    followed, console = again(run, tmp_path / "out", tracker=write_sam2(tmp_path / "sam2"))
    assert console.planned["objects"].why.endswith("followed by sam2")
    assert (console.fresh["objects"], console.fresh["gaussians"]) == (True, False)
    assert not np.array_equal(followed.labels, run.labels)


def test_query_finds_the_model_by_itself_or_says_what_it_needs(seen, models, tmp_path, capsys):
    field = seen[1] / "field.safetensors"
    query = ["query", field, "red", "--views", "0", "--min-rank", "0", "--out", tmp_path]
    assert run_cli(*query) == 0
    answer, embedder = json.loads((tmp_path / "red.json").read_text()), model_loading.field_embedder(load_field(field))
    assert answer["region"] == int(Scene(load_field(field), embedder).ask("red", min_rank=0.0).selection.region)
    assert run_cli(*query, "--embedder", write_clip(tmp_path / "other", "immich")) == 2
    assert "model that the field was made with" in capsys.readouterr().err
    lost = dataclasses.replace(load_field(field), provenance=json.dumps({"options": {"embedder": "/nowhere"}}))
    with refused("--embedder DIR"):
        model_loading.field_embedder(lost)
    assert model_loading.field_embedder(lost, models[1]).name == lost.embedder
    with refused("run the capture again"):
        model_loading.field_embedder(dataclasses.replace(lost, embedder="colours-of-the-future"))


def test_proposals_are_kept_by_content(models, tmp_path):
    frame = np.zeros((60, 80, 3), np.uint8)
    frame[10:40, 10:50] = (200, 30, 30)
    stored, failing = (SamSegmenter(models[0], store=tmp_path) for _ in range(2))
    masks = stored(frame, 0)
    np.testing.assert_array_equal(masks, SamSegmenter(models[0])(frame, 0))
    failing.prompts = None  # whatever is asked of it now must come from disk
    np.testing.assert_array_equal(failing(frame, 5), masks)
    with pytest.raises(TypeError):
        failing(255 - frame, 0)


def test_models_by_name_are_fetched_once_and_found_again_for_a_moved_field(
    room, splat, hub, tmp_path, monkeypatch, capsys
):
    use_hub(hub, tmp_path / "other", monkeypatch)
    out = tmp_path / "out"
    command = ["run", room, "--gaussians", splat, "--holdout", "4", "--out", out, "--models", "auto"]
    command += ["--level", "m", "--vision-frames", "5"]
    assert run_cli(*command) == 2  # a run fetches nothing
    assert "jsecon models get edgetam" in (said := capsys.readouterr().err)
    assert "jsecon models get siglip2" in said
    assert run_cli("models", "get", "edgetam", "siglip2") == 2  # this hub has no tracker of the first name
    assert run_cli("models", "get") == 2
    use_hub(hub, tmp_path / "cache", monkeypatch)
    assert run_cli("models", "get", "auto") == 0
    assert run_cli(*command) == 0
    assert "by edgetam, what the views agree on" in capsys.readouterr().out
    asked = len(hub.requests)
    use_hub(hub, tmp_path / "cache", monkeypatch, offline=True)
    field = tmp_path / "elsewhere" / "field.safetensors"
    field.parent.mkdir()
    shutil.copy(out / "field.safetensors", field)
    assert str(tmp_path).encode() + b"/cache" not in field.read_bytes()
    query = ["query", field, "a red thing", "--out", tmp_path / "answers", "--min-rank", "0"]
    assert run_cli(*query) == 0
    assert len(hub.requests) == asked
    assert 2 <= (np.asarray(load_field(field).regions.pixel_counts).sum(0) > 0).sum() <= 5
    use_hub(hub, tmp_path / "empty", monkeypatch)
    assert run_cli(*query) == 2
    commit = hub.repositories["onnx-community/siglip2-base-patch16-224-ONNX"].commit
    address = f"hub:onnx-community/siglip2-base-patch16-224-ONNX@{commit}"
    assert f"jsecon models get {address} --role embedder" in capsys.readouterr().err
    assert run_cli("models", "get", address, "--role", "embedder") == 0
    assert run_cli(*query) == 0
