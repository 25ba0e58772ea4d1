"""Models by name, from a hub on this machine (hub_server)."""

import errno
import json
import os
from pathlib import Path

import pytest
from capture_files import refused, run_cli
from hub_server import Hub, Repository, files_in, running_hub, use_hub
from huggingface_hub import constants

from jsecon.networks import hub

GRAPH = bytes(range(256)) * 40
SLIMSAM = {
    "onnx/vision_encoder.onnx": GRAPH,
    "onnx/vision_encoder_fp16.onnx": GRAPH[: len(GRAPH) // 2],
    "onnx/prompt_encoder_mask_decoder.onnx": GRAPH[::-1],
    "preprocessor_config.json": b"{}",
    "README.md": b"# SlimSAM",
}
NAME = "Xenova/slimsam-77-uniform"
NEEDED = {"onnx/vision_encoder.onnx", "onnx/prompt_encoder_mask_decoder.onnx", "preprocessor_config.json"}


@pytest.fixture(scope="module")
def server():
    with running_hub() as running:
        yield running


@pytest.fixture
def local(server: Hub, tmp_path, monkeypatch) -> Hub:
    """An empty cache in front of a hub that has SlimSAM."""
    server.repositories = {NAME: Repository(dict(SLIMSAM), licence="apache-2.0")}
    server.requests.clear()
    use_hub(server, tmp_path / "cache", monkeypatch)
    return server


def slimsam() -> hub.HubModel:
    model = hub.parse_model("slimsam", "segmenter")
    assert isinstance(model, hub.HubModel)
    return model


def get(model) -> set[str]:
    return set(files_in(hub.fetch(model, print)))


def test_a_name_brings_its_files_and_no_others(local, capsys):
    model = slimsam()
    assert model.cached_folder is None
    lines: list[str] = []
    folder = hub.fetch(model, lines.append)
    assert lines == [f"hub:{NAME}@main (1 MB, licence: apache-2.0)"]
    assert set(files_in(folder)) == NEEDED
    assert (folder / "onnx/vision_encoder.onnx").read_bytes() == GRAPH
    assert hub.cached_address(folder) == f"hub:{NAME}@{local.repositories[NAME].commit}"
    assert run_cli("models", "list", "--json") == 0
    rows = json.loads(capsys.readouterr().out)["models"]
    cached = {(row["name"], row["role"]): row["cached"] for row in rows}
    assert cached["slimsam", "segmenter"] is True
    assert cached["sam2", "tracker"] is False
    assert run_cli("models", "get", f"hub:{NAME}") == 2
    assert "--role" in capsys.readouterr().err


def test_a_model_in_the_cache_is_used_without_a_request(local, monkeypatch):
    get(slimsam())
    local.requests.clear()
    for offline in (False, True):
        monkeypatch.setattr(constants, "HF_HUB_OFFLINE", offline)
        folder = slimsam().cached_folder
        assert folder is not None
        assert hub.parse_model(hub.cached_address(folder), "segmenter").cached_folder == folder
    assert local.requests == []


def test_a_file_of_another_content_is_refused_and_removed(local):
    local.repositories[NAME].corrupt = frozenset({"onnx/vision_encoder.onnx"})
    with refused("hash"):
        get(slimsam())
    assert slimsam().cached_folder is None
    local.repositories[NAME].corrupt = frozenset()
    assert get(slimsam()) == NEEDED


@pytest.mark.parametrize(("change", "clause"), [
    (lambda local, patch: setattr(local.repositories[NAME], "gated", 401), "HF_TOKEN"),
    (lambda local, patch: local.repositories[NAME].files.pop("onnx/vision_encoder.onnx"), "onnx/vision_encoder.onnx"),
    (lambda local, patch: patch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9"), "Check the network"),
    (lambda local, patch: patch.setattr(constants, "HF_HUB_OFFLINE", True), "jsecon models get slimsam"),
    (lambda local, patch: patch.setattr("huggingface_hub.snapshot_download", full_disk), "No space left on device"),
], ids=["no token", "incomplete", "no network", "offline", "full disk"])  # fmt: skip
def test_what_the_hub_or_the_disk_refuses_is_said_in_a_sentence(local, monkeypatch, change, clause):
    change(local, monkeypatch)
    with refused(clause):
        get(slimsam())


def full_disk(*args, **options):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_branch_that_moved_keeps_the_cached_commit_until_it_is_fetched(local):
    get(slimsam())
    first = slimsam().cached_folder
    with refused("@v9", "no such repository or revision"):
        get(hub.parse_model(f"hub:{NAME}@v9", "segmenter"))
    local.repositories[NAME].files["preprocessor_config.json"] = b'{"size": 1024}'
    assert slimsam().cached_folder == first
    get(slimsam())
    second = slimsam().cached_folder
    assert second != first
    assert hub.parse_model(hub.cached_address(first), "segmenter").cached_folder == first


@pytest.mark.parametrize(("text", "role", "clause"), [
    ("hub:owner", "embedder", "hub:owner/name"), ("clip", "segmenter", "Known names: edgetam, slimsam, sam2"),
    ("auto", "tracker", "no folder and no known tracker"), ("", "embedder", "no folder and no known embedder"),
])  # fmt: skip
def test_what_is_no_model_is_refused(text, role, clause):
    with refused(clause):
        hub.parse_model(text, role)


def test_a_name_comes_before_a_folder_that_is_called_so(tmp_path, monkeypatch):
    (tmp_path / "clip").mkdir()
    monkeypatch.chdir(tmp_path)
    assert hub.parse_model("clip", "embedder").name == "clip"
    for folder in ("./clip", str(tmp_path / "clip"), Path("clip")):
        assert hub.parse_model(folder, "embedder") == Path(folder)
    assert hub.parse_model("clip", "tracker") == Path("clip")  # no tracker has this name


@pytest.mark.parametrize("place", ["constants.json", "onnx/constants.json", None])
def test_a_tracker_needs_its_constants_in_either_place(local, place):
    parts = ("vision_encoder", "mask_decoder", "memory_attention", "memory_encoder", "pointer_tpos")
    paths = {f"onnx/{part}.onnx" for part in parts} | ({place} if place else set())
    local.repositories[NAME].files = dict.fromkeys([*paths, "README.md"], GRAPH)
    model = hub.HubModel("tracker", NAME)
    if place is None:
        with refused("it lacks constants.json"):
            get(model)
    else:
        assert get(model) == paths


def test_external_data_comes_with_its_graph(local):
    data = {"onnx/vision_encoder.onnx_data", "onnx/vision_encoder.onnx_data_1"}
    local.repositories[NAME].files |= dict.fromkeys([*data, "onnx/other.onnx_data"], GRAPH)
    assert get(slimsam()) == NEEDED | data
