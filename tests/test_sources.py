"""Where a field says that its model and its points are: hints of a stranger, which open nothing of themselves."""

import dataclasses
import json

import pytest

from jsecon import InputError, load_field, save_field
from jsecon.app.scene import Scene, _field_of_gaussians
from jsecon.field.field import Provenance
from jsecon.pipeline import run as pipeline
from jsecon.pipeline.model_loading import field_embedder
from jsecon.pipeline.options import Options
from jsecon.pipeline.progress import Console
from jsecon.pipeline.sources import locate_sources, provenance

CLIP = "clip-0123456789abcdef"


def told(field, **given):
    return dataclasses.replace(field, provenance=json.dumps(given))


def test_hints_are_relative_to_the_field_and_are_followed_from_its_file(field, tmp_path):
    out, model, scan = tmp_path / "runs" / "a", tmp_path / "models" / "clip", tmp_path / "scan.xyz"
    for folder in (out, model):
        folder.mkdir(parents=True)
    given = Options(tmp_path / "capture", embedder=model, points=scan)
    scan.touch()
    hints = json.loads(provenance(given, {}, out))["folders"]
    assert hints == {"points": "../../scan.xyz", "embedder": "../../models/clip"}
    own = told(field, folders=hints)
    save_field(out / "field.safetensors", own)
    assert locate_sources(load_field(out / "field.safetensors")) == (model, None, scan)
    assert locate_sources(own) == (None, None, None)  # of a field that no file was read of
    Scene(load_field(out / "field.safetensors")).save(tmp_path / "b" / "field.safetensors")
    assert locate_sources(load_field(tmp_path / "b" / "field.safetensors")) == (model, None, scan)


def test_absolute_and_impossible_hints_lead_nowhere(field, tmp_path):
    for hint in ("/etc", "//host/share", "C:\\models", "C:models", "\\\\host\\share", "a\0b", "x" * 9000):
        own = told(field, folders={"points": hint, "embedder": hint}, options={"embedder": hint})
        save_field(tmp_path / "field.safetensors", own)
        assert locate_sources(load_field(tmp_path / "field.safetensors")) == (None, None, None)


def test_the_field_of_a_splat_is_looked_for_with_its_own_model_unless_another_is_named(field, tmp_path, monkeypatch):
    """As when it was made with --embedder and is asked without. test_scene.py has a whole run (long)."""
    folder, embedders = tmp_path / "scene_field", []
    for name in (folder, tmp_path / "clip"):
        name.mkdir()
    save_field(folder / "field.safetensors", told(field, folders={"embedder": "../clip"}))
    monkeypatch.setattr(pipeline, "current_field", lambda options, out: embedders.append(options.embedder) or out)
    for embedder in (None, "siglip2"):
        _field_of_gaussians(Options(tmp_path / "scene.ply", embedder=embedder), folder, Console())
    assert embedders == [tmp_path / "clip", "siglip2"]


def test_a_model_of_another_name_is_not_opened(field, tmp_path):
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "visual.onnx").write_bytes(b"no graph")
    own = dataclasses.replace(told(field, folders={"embedder": "model"}), embedder=CLIP)
    save_field(tmp_path / "field.safetensors", own)
    with pytest.raises(InputError, match="--embedder DIR"):
        field_embedder(load_field(tmp_path / "field.safetensors"))


MALFORMED = "[]", '{"folders": 3}', '{"folders": {"embedder": 7}}', "{"


@pytest.mark.parametrize("provenance", MALFORMED)
def test_a_malformed_provenance_is_refused_in_words(field, provenance, tmp_path):
    own = dataclasses.replace(field, provenance=Provenance(provenance), embedder=CLIP)
    own.provenance.folder = tmp_path
    with pytest.raises(InputError, match="provenance is not what jsecon run writes"):
        field_embedder(own)
