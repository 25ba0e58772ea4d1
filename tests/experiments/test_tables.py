"""The experiments' tables on tiny twins: files of the true form in, whole results out, a stopped run goes on."""

import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from experiments import lerf, ovs3d, replica, threshold_sweep
from experiments.datasets.replica import REPLICA_SCENES
from experiments.tables import fill, layout, published
from experiments.tables.methods import METHODS, RECOMMENDED
from experiments.tables.setting import levels_of, prepare
from jsecon.fit.start import gaussians_from_points
from jsecon.read.masks.masks import LEVELS, load_features
from jsecon.read.splats.files import load_gaussians, save_gaussians

TRACKED = "ours, tracks"
CHEAP = ("VALA", TRACKED)


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


def read(folder, name):
    place = folder / name
    assert {file.name for file in place.iterdir()} >= {"config.json", "metrics.json", "table.md", "figure.webp"}
    assert (place / "figure.webp").stat().st_size > 1000
    return json.loads((place / "metrics.json").read_text()), (place / "table.md").read_text()


@pytest.mark.long
def test_table_1_and_its_resumption(folder, monkeypatch):
    """.ci/run fills all tables; test_cells has what a cut line costs."""
    plan = with_gaussians(small(lerf.QUICK, folder, "lerf", methods=CHEAP, level="perfect"))
    lerf.main(plan)
    metrics, text = read(folder, "lerf")
    assert {(c["method"], c["level"]) for c in metrics["cells"]} == {(name, "perfect") for name in CHEAP}
    assert all(c["twin"] and c["pairs"] > 0 for c in metrics["cells"])
    assert "made-up twins" in text
    assert "published, measured on the real data" in text
    assert "| VALA | 60.38 / 89.29" in text
    perfect = {c["method"]: c["miou"] for c in metrics["cells"]}
    # 80x60 px, points as Gaussians: they are rough, the masks true.
    assert perfect[TRACKED] > 0.3
    file = folder / "lerf" / "cells.jsonl"
    first, last = file.read_text().splitlines(keepends=True)
    file.write_text(first + last[: len(last) // 2])  # as a process leaves it that is killed within the line
    calls, measure = [], fill.measure
    monkeypatch.setattr(fill, "measure", lambda *a: calls.append(1) or measure(*a))
    with pytest.warns(UserWarning, match="incomplete last line"):
        lerf.main(plan)
    assert len(calls) == 1  # the lost cell alone was computed again
    again, _ = read(folder, "lerf")

    def strip(cells):
        return [{k: v for k, v in c.items() if k not in ("seconds", "peak_memory_mib")} for c in cells]

    assert strip(again["cells"]) == strip(metrics["cells"])


@pytest.mark.long
def test_levels_of_noise_share_a_fit(folder):
    data = dataclasses.replace(lerf.QUICK.data, twins=str(folder / "fits"))
    for level in ("perfect", "medium"):
        setting = prepare(data, "figurines", 0, level, fit_steps=20)
        (file,) = (folder / "fits" / "fitted").iterdir()
        np.testing.assert_array_equal(setting.evidence.gaussians.means, load_gaussians(file).means)
    prepare(dataclasses.replace(data, seeds=(1,)), "figurines", 1, "medium", fit_steps=20)
    assert len(list((folder / "fits" / "fitted").iterdir())) == 2  # another room


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


def test_twins_of_two_sizes_lie_side_by_side(folder):
    data = small(lerf.QUICK, folder, "sizes").data
    fewer = dataclasses.replace(data, size=tuple({**dict(data.size), "views": 6, "width": 40, "height": 30}.items()))
    roots = [each.place("figurines", 0, "perfect") for each in (data, fewer, data)]
    assert roots[0] == roots[2] != roots[1]
    for each, root, views in zip((data, fewer), roots, (8, 6)):
        assert len(each.load(root, "figurines").capture.names) == views
        assert not list(root.glob("*.lock"))


def test_tables_say_where_ours_does_not_lead():
    cells = [
        {"scene": "a", "seed": 0, "level": "medium", "method": name, "miou": value, "seconds": 1.0}
        for name, value in (("VALA", 0.6), (RECOMMENDED, 0.5), ("ours, another", 0.9))
    ]
    told = layout.leaders(cells, ("a",), "medium", ours=RECOMMENDED, why="Because.")
    assert "VALA leads with 0.600" in told
    assert "0.500" in told
    assert told.endswith("Because.")
    cells[1]["miou"] = 0.7
    told = layout.leaders(cells, ("a",), "medium", ours=RECOMMENDED, why="Because.")
    assert told == f'miou: the row "{RECOMMENDED}" leads on every scene.'
    cells = [cell | {"macc": 1 - cell["miou"]} for cell in cells]
    told = layout.leaders(cells, ("a",), "medium", ours=RECOMMENDED, figure="macc")
    assert told.startswith(f'macc: the row "{RECOMMENDED}" does not lead')
    assert "VALA leads with 0.400" in told


def test_the_noise_table_says_at_which_levels_ours_does_not_lead(tmp_path):
    values = {"low": (0.6, 0.5, 0.9), "medium": (0.6, 0.7, 0.2)}
    names = ("VALA", RECOMMENDED, "ours, another")
    plan = dataclasses.replace(lerf.PLAN, methods=names, out=str(tmp_path))
    common = {"scene": plan.data.scenes[0], "seed": plan.data.seeds[0]}
    cells = [
        common | {"level": level, "method": name, "miou": value}
        for level, row in values.items()
        for name, value in zip(names, row)
    ]
    told = layout.noise(cells, plan, RECOMMENDED)
    assert told.endswith(f"\n\n* noise low: VALA leads with 0.6000 ({RECOMMENDED}: 0.5000).")
    assert told.startswith(layout.noise(cells, plan))
    assert "leads" not in layout.noise(cells, plan)


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


def test_published_rows_have_an_entry_per_scene_and_the_mean():
    assert all(len(row) == len(published.LERF_SCENES) + 1 for row in published.LERF.values())
    assert all(len(row) == len(REPLICA_SCENES) + 1 for row in published.REPLICA.values())
    assert all(len(row) == len(published.OVS3D_SCENES) + 1 for row in published.OVS3D.values())
    for mine in (published.LERF, published.OVS3D, published.REPLICA):  # the paper's own tables have no holes
        assert all(None not in cell for name, row in mine.items() if "(seconGS)" in name for cell in row)
    assert RECOMMENDED in METHODS
