"""Gaussians given to a run: read in every format, and carried back from the world that nerfstudio trained in."""

import dataclasses
import json

import numpy as np
import pytest
import splat_files
from capture_files import refused, small_capture
from splat_files import scene
from test_gaussian_files import gaussians

from jsecon.data.gaussian_files import save_gaussians
from jsecon.data.nerfstudio import trained_to_source
from jsecon.pipeline.options import Options
from jsecon.pipeline.scene_stages import gaussians as stage_of
from jsecon.pipeline.stages import Record, Work
from jsecon.splat.transform import transform_gaussians
from jsecon.vision.colours import ColourEmbedder
from jsecon.vision.protocols import Networks

TURN = np.array([[0, 0, 1, 0.3], [1, 0, 0, -0.2], [0, 1, 0, 0.5], [0, 0, 0, 1.0]])
TRAINED = np.diag([0.4, 0.4, 0.4, 1]) @ TURN
"""from the source's world to nerfstudio's: turned and shifted, then made smaller"""


def read(capture, file):
    """The outcome of the stage that reads `file`, and the stage."""
    work = Work(Options(capture=file.parent, gaussians=file), Networks(ColourEmbedder()), file.parent / "out")
    stage = stage_of(work)
    return stage.compute({"load": capture}, lambda done, total: None, Record(work.out)), stage


@pytest.fixture
def near():
    """Gaussians in the views of the ring of cameras."""
    arrays = scene(80, 1)
    return gaussians(arrays | {"means": arrays["means"] / 10})


@pytest.mark.parametrize("name", ["scene.ply", "scene.spz", "scene.glb"])
def test_a_scene_that_nerfstudio_trained_is_carried_back(tmp_path, near, name):
    """Into the world of transforms.json, which is not the source's where an applied_transform made it."""
    applied = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0.1], [0, 0, 0, 1.0]])
    capture = dataclasses.replace(small_capture(), to_source=np.linalg.inv(applied))
    save_gaussians(tmp_path / name, transform_gaussians(near, TRAINED @ np.linalg.inv(applied)))
    plain, before = read(capture, tmp_path / name)
    assert plain.notes == ()
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps({"transform": TURN[:3].tolist(), "scale": 0.4}))
    found, after = read(capture, tmp_path / name)
    np.testing.assert_allclose(found.value.means, near.means, atol=1e-4)
    np.testing.assert_allclose(found.value.log_scales, near.log_scales, atol=0.04)
    assert "dataparser_transforms.json" in found.notes[0]
    assert before.given != after.given


def test_a_compressed_ply_is_read(tmp_path, near):
    arrays = scene(80, 1)
    (tmp_path / "a.ply").write_bytes(splat_files.compressed_ply(arrays | {"means": arrays["means"] / 10}))
    found, _ = read(small_capture(), tmp_path / "a.ply")
    np.testing.assert_allclose(found.value.means, near.means, atol=1e-3)


def test_what_a_trained_world_must_be(tmp_path):
    file = tmp_path / "dataparser_transforms.json"
    for told, says in (
        ({"scale": 1.0}, "no key 'transform'"),
        ({"transform": TURN[:3].tolist(), "scale": 0}, "scale = 0"),
        ({"transform": (2 * TURN[:3]).tolist(), "scale": 1.0}, "not rigid"),
        ({"transform": [[1, 2]], "scale": 1.0}, "shape (1, 2)"),
    ):
        file.write_text(json.dumps(told))
        with refused(file.name, says):
            trained_to_source(file)
    file.write_text("{")
    with refused(file.name, "not JSON"):
        trained_to_source(file)
