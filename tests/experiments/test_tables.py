"""The experiments' tables on tiny twins: files of the true form in, whole results out, a stopped run goes on."""

import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from experiments import lerf, ovs3d, replica, threshold_sweep
from experiments.datasets.feature_files import load_features
from experiments.tables import fill
from experiments.tables.setting import levels_of, prepare
from jsecon.read.masks.masks import LEVELS
from jsecon.read.splats.writing import save_gaussians
from jsecon.splat.points import gaussians_from_points


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("tables")


def small(plan, folder, name, **changes):
    """The quick plan with rows that need no training, in a folder of the test's."""
    data = dataclasses.replace(plan.data, twins=str(folder / "twins"))
    return dataclasses.replace(plan, data=data, fit_steps=20, out=str(folder / name), cells="", **changes)


def with_gaussians(plan, *levels):
    """The plan, with Gaussians beside its twins: nothing is fitted."""
    for level in levels or (plan.level,):
        for scene in plan.data.scenes:
            root = plan.data.place(scene, 0, level)
            capture = plan.data.load(root, scene).capture
            points = gaussians_from_points(capture.points, capture.point_colors, opacity=0.8, scale=0.4)
            save_gaussians(root / scene / "point_cloud.ply", points)
    return plan


def test_best_thresholds_are_those_of_single_queries():
    each = np.array([[0.2, 0.8, 0.3], [0.6, 0.6, 0.1], [0.0, 0.1, 0.9]])
    found = threshold_sweep.best_thresholds(each, (0.2, 0.4, 0.8))
    assert found == pytest.approx((3, 0.4, 0.32, 0.72, (0.8 + 0.6 + 0.9) / 3 - 0.5))


def test_levels_that_are_alike_are_learnt_once(folder, tmp_path):
    plan = with_gaussians(small(lerf.QUICK, folder, "levels"), "perfect")
    setting = prepare(plan.data, "figurines", 0, "perfect", fit_steps=20)
    assert len(setting.levels) == 1  # a twin's
    shutil.copytree(setting.folder / "language_features", tmp_path / "language_features")
    for file in tmp_path.glob("language_features/*_s.npy"):
        masks = np.load(file)
        masks[LEVELS.index("s")][masks[0] == 0] = -1
        np.save(file, masks)
    large, smaller = levels_of(setting.evidence, tmp_path, setting.names)
    np.testing.assert_array_equal(large.masks, setting.evidence.masks)
    assert len(smaller.embeddings) == len(large.embeddings) - len(setting.names)  # the first mask of each frame


def test_vision_on_disk_is_what_was_simulated(folder):
    """Perfect vision: masks are the truth, one embedding per object; nothing of the held-out frames."""
    plan = with_gaussians(small(lerf.QUICK, folder, "vision"), "perfect")
    setting = prepare(plan.data, "figurines", 0, "perfect", fit_steps=20)
    root = plan.data.place("figurines", 0, "perfect")
    told = json.loads((root / "twin.json").read_text())["scenes"]["figurines"]
    held_out = {frame.name for frame in setting.bench.frames}
    assert set(told["frames"]) == held_out
    assert not held_out & set(setting.names)
    assert not held_out & {file.stem.removesuffix("_f") for file in (root / "figurines/language_features").iterdir()}
    for t, name in enumerate(setting.names):
        truth = cv2.imread(str(root / "truth" / "figurines" / f"{name}.png"), -1).astype(int) - 1
        objects = np.unique(truth[truth >= 0])
        np.testing.assert_array_equal(setting.evidence.tracks[t] >= 0, truth >= 0)
        masks = setting.evidence.masks[t]
        assert len(np.unique(masks[masks >= 0])) == len(objects)
    assert setting.evidence.embeddings.shape[0] == len(setting.evidence.frame)
    length = np.linalg.norm(setting.tracked.embeddings, axis=1)
    np.testing.assert_allclose(length[length > 0], 1, atol=1e-5)
    found = load_features(root / "figurines/language_features", setting.names, (60, 80))
    np.testing.assert_array_equal(found.labels, setting.evidence.masks)


@pytest.mark.parametrize("table", [lerf, ovs3d, replica, threshold_sweep], ids=lambda m: m.__name__)
def test_the_committed_table_is_what_the_committed_cells_give(table, tmp_path, monkeypatch):
    """Each cell of the plan is found by its key, and nothing is computed. The ablations' cells are of the
    centred cosine, which their methods no longer ask by."""
    monkeypatch.setattr(fill, "prepare", lambda *a, **k: pytest.fail(f"no cell of {a[1:]}"))
    home = Path(table.PLAN.out)
    cells = table.PLAN.cells or str(home / "cells.jsonl")
    table.main(dataclasses.replace(table.PLAN, out=str(tmp_path), cells=cells, processes=1))
    for name in ("table.md", "metrics.json"):
        assert (tmp_path / name).read_text() == (home / name).read_text(), name
