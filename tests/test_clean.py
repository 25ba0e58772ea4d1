"""What cleaning takes from a wall with things before it and behind it, and the file and the words of it."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from capture_files import inria, run_cli, small_capture
from conftest import cameras_of, gaussians_at, look_at

from jsecon import load_gaussians, save_gaussians
from jsecon.views import clean
from jsecon.views.clean import KINDS, find_litter

EYES = [(x, y, -3.0) for x, y in ((-0.8, 0.0), (0.8, 0.0), (0.0, -0.8), (0.0, 0.8))]
CAMERAS = cameras_of([look_at(eye) for eye in EYES], (70, 70, 32, 24), 64, 48)
FRONT, AIR = [(-0.3, 0.1, -1.0), (0.4, -0.2, -0.7)], [(0.0, 0.2, -1.2), (-0.2, -0.4, -0.8)]


@pytest.fixture(scope="module")
def littered():
    """A wall of 900 Gaussians at z = 0, a knob on it, floaters, haze, two behind the wall, one that no pixel shows."""
    side = np.linspace(-0.9, 0.9, 30)
    wall = np.stack([*np.meshgrid(side, side), np.zeros((30, 30))], axis=-1).reshape(-1, 3)
    parts = [
        gaussians_at(wall, (0.05, 0.05, 0.01), logit=4.0),
        gaussians_at([(0.2, 0.3, -0.06)], 0.03),
        gaussians_at(FRONT, 0.06, logit=1.0, sh=((1.5, -1.5, 0),)),
        gaussians_at(AIR, 0.15, logit=-3.5),
        gaussians_at([(0.0, 0.0, 1.0), (0.3, 0.2, 1.5)], 0.05),
        gaussians_at([(0.5, 0.5, 0.0)], 0.03, logit=-7.0),
    ]
    scene = jax.tree.map(lambda *columns: np.concatenate(columns), *parts)
    return scene, np.repeat([0, 0, 4, 3, 2, 1], [part.count for part in parts])


def test_each_kind_is_told_from_the_wall(littered, monkeypatch):
    scene, kinds = littered
    np.testing.assert_array_equal(find_litter(scene, CAMERAS), kinds)
    monkeypatch.setattr(clean, "MAX_WHOLE", 100)  # one view after the other, of what it sees
    np.testing.assert_array_equal(find_litter(scene, CAMERAS), kinds)


def test_a_clean_scene_is_written_bit_for_bit_and_counted(littered, tmp_path, capsys):
    scene, kinds = littered
    save_gaussians(tmp_path / "scene.ply", scene)
    (tmp_path / "poses.json").write_text(json.dumps(inria(dataclasses.replace(small_capture(4), cameras=CAMERAS))))
    out = tmp_path / "clean.ply"
    options = ["--cameras", tmp_path / "poses.json", "--json"]
    assert run_cli("clean", tmp_path / "scene.ply", "--out", out, *options) == 0
    said = json.loads(capsys.readouterr().out)
    assert list(said["gaussians"].values()) == np.bincount(kinds).tolist()
    assert list(said["gaussians"]) == list(KINDS)
    assert 10 < said["psnr_between"] < 60
    left = load_gaussians(out)
    np.testing.assert_array_equal(left.means, scene.means[kinds == 0])
    np.testing.assert_array_equal(left.opacity_logits, scene.opacity_logits[kinds == 0])
    assert run_cli("clean", out, "--out", out) == 2
    assert "it is the scene itself" in capsys.readouterr().err
