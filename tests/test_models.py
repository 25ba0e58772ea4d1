"""`jsecon models check`: what a folder holds, what of it can be used, and what is missing."""

import pytest
from clip_files import write_clip
from sam2_files import write_sam2
from sam_files import write_sam

from jsecon.app import cli
from jsecon.errors import InputError
from jsecon.pipeline.model_loading import inspect_models


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    base = tmp_path_factory.mktemp("models")
    return {
        "CLIP": write_clip(base / "clip", "immich"),
        "SAM": write_sam(base / "sam"),
        "SAM 2": write_sam2(base / "sam2"),
    }


@pytest.mark.parametrize(("model", "words"), [
    ("CLIP", ["images of 32x32 px", "3 numbers", "--embedder"]),
    ("SAM", ["decoder of SAM, 4 prompts per run", "images of 256 px", "--segmenter"]),
    ("SAM 2", ["images of 64 px", "--tracker"]),
])  # fmt: skip
def test_what_a_folder_is_good_for(folders, model, words):
    findings = inspect_models(folders[model])
    assert list(findings["usable"]) == [model]
    for word in words:
        assert word in findings["usable"][model]
    for problem in findings["unusable"].values():
        assert "since it lacks onnx/" in problem
        assert "huggingface.co" in problem


def test_every_graph_is_told_with_its_tensors(folders, capsys):
    assert cli.main(["models", "check", str(folders["CLIP"])]) == 0
    told = capsys.readouterr().out
    for line in (
        "  textual/model.onnx",
        "    in   text int32[1, 77]",
        "    out  embedding float32[1, 3]",
        "    in   image float32[1, 3, 32, 32]",
        "CLIP: usable",
        "SAM: not usable",
    ):
        assert line in told.splitlines()
    findings = inspect_models(folders["SAM"])
    assert len(findings["graphs"]) == 2
    assert any("input_points float32[1, batch, points, 2]" in graph for graph in findings["graphs"].values())


def test_damage_and_emptiness_end_in_exit_code_2(tmp_path, capsys):
    folder = write_clip(tmp_path / "clip", "immich")
    graph = folder / "visual" / "model.onnx"
    graph.write_bytes(graph.read_bytes()[:100])
    assert cli.main(["models", "check", str(folder)]) == 2
    told = capsys.readouterr()
    assert "cannot be opened: ONNX Runtime" in told.out
    assert "no model that can be used" in told.err
    (tmp_path / "empty").mkdir()
    assert cli.main(["models", "check", str(tmp_path / "empty")]) == 2
    assert "0 graphs" in capsys.readouterr().out
    with pytest.raises(InputError, match="no such folder"):
        inspect_models(tmp_path / "nowhere")
