"""The experiments on distillation, autoencoder and ablations: their parts on problems small enough for a test."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import sparse
from small_field import REGIONS, labels_of, true_regions, unit_rows

from experiments import ablations, autoencoder, code_paths, distillation, retrieval, scenes
from jsecon import cache
from jsecon.splat.tiles import plan_capacity
from jsecon.types import Regions
from jsecon.vision.simulated import SimulatedMasks, made_text_space


@pytest.fixture(scope="module")
def task(scene, cameras):
    scene, cameras = jax.tree.map(jnp.asarray, (scene, cameras))
    members = true_regions(scene)
    labels = jnp.asarray(labels_of(scene, cameras, members))
    codes = jnp.asarray(unit_rows(np.random.default_rng(1), REGIONS, 3))
    capacity = plan_capacity(scene, cameras, margin=1.0)
    pixels = np.stack([(np.asarray(labels) == r).sum((1, 2)) for r in range(REGIONS)])
    regions, texts = Regions(np.eye(REGIONS, 8, dtype=np.float32), pixels), np.eye(REGIONS, 8, dtype=np.float32)
    return code_paths.Task(
        "small", scene, cameras, labels, codes, regions, texts, np.arange(REGIONS), members, capacity
    )


@pytest.mark.slow
def test_the_solver_is_below_the_votes_it_starts_from(task):
    rows = {row["path"]: row for row in code_paths.votes_paths(task, loyalties=(0.1,), sweeps=(8,))}
    assert len(rows) == 5
    solver = next(row for name, row in rows.items() if name.startswith("solver"))
    assert solver["l1"] < min(row["l1"] for name, row in rows.items() if name.startswith("votes"))
    assert all(row["accuracy"] > 0.4 and row["seconds"] > 0 for row in rows.values())
    assert rows["votes, mode"]["anchored_by_votes"] > 0.4
    assert rows["votes, mode"]["anchored"] > 0.4


def test_a_stopped_descent_ends_as_a_whole_one(task, tmp_path, monkeypatch):
    monkeypatch.setattr(code_paths, "RESTS", 3)
    way = {"steps": 8, "looks": (0.5, 1.0)}
    whole = code_paths.adam_path(task, "random", tmp_path / "none.npz", **way)
    monkeypatch.setattr(code_paths, "CHECKPOINT_SECONDS", 0.0)
    real, calls = cache.save, []

    def stopping(path, value):
        real(path, value)
        calls.append(path)
        if len(calls) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(cache, "save", stopping)
    with pytest.raises(KeyboardInterrupt):
        code_paths.adam_path(task, "random", tmp_path / "kept.npz", **way)
    again = code_paths.adam_path(task, "random", tmp_path / "kept.npz", **way)
    drop = lambda rows: [{k: v for k, v in row.items() if k != "seconds"} for row in rows]
    assert drop(again) == drop(whole)
    assert [row["steps"] for row in whole] == [4, 8]


def test_geometric_median_has_the_least_distance(task):
    rng = np.random.default_rng(0)
    weights = rng.exponential(size=(50, 3)).astype(np.float32)
    votes = dataclasses.make_dataclass("V", ["regions", "weights"])(
        jnp.asarray(np.stack([rng.permutation(REGIONS)[:3] for _ in range(50)])), jnp.asarray(weights)
    )
    found = np.asarray(code_paths.geometric_median(votes, task.codes, rounds=200))
    values = np.asarray(task.codes)[np.asarray(votes.regions)]

    def cost(points):
        return (weights * np.linalg.norm(values - points[:, None], axis=-1)).sum(1)

    # on the ray of the unit code found some point is at least as good as every region's own code and the mean
    best = np.min([cost(found * s) for s in np.linspace(0.05, 1, 96)], axis=0)
    mean = (weights[..., None] * values).sum(1) / weights.sum(1, keepdims=True)
    assert (best <= np.min([cost(values[:, k]) for k in range(3)] + [cost(mean)], axis=0) * (1 + 2e-3)).all()


def test_speed_names_the_first_path_that_is_as_low():
    rows = [
        {"scene": "a", "path": "Adam from zero", "steps": 5, "seconds": 90.0, "l1": 0.2},
        {"scene": "a", "path": "Adam from zero", "steps": 9, "seconds": 100.0, "l1": 0.1},
        {"scene": "a", "path": "votes, mode", "seconds": 1.0, "l1": 0.15},
        {"scene": "a", "path": "solver", "seconds": 4.0, "l1": 0.09},
        {"scene": "b", "path": "Adam from zero", "steps": 9, "seconds": 100.0, "l1": 0.01},
    ]
    first, second = distillation.speed(rows)
    assert (first["path"], first["times"]) == ("solver", 25.0)
    assert second["path"] is None


@pytest.mark.slow
def test_autoencoder_experiment_runs_and_a_rotation_of_full_rank_loses_nothing(tmp_path):
    options = dataclasses.replace(autoencoder.QUICK, texts=str(tmp_path), regions=(6,), latents=(6,), epochs=4)
    rows = autoencoder.main(dataclasses.replace(options, out=str(tmp_path / "out")))["rows"]
    by_kind = {row["coder"]: row for row in rows}
    assert set(by_kind) == {"none", "autoencoder", "rotation", "spread"}
    assert by_kind["rotation"]["reconstruction"] == pytest.approx(1, abs=1e-4)
    assert by_kind["rotation"]["retrieval"] >= by_kind["none"]["retrieval"] - 1e-9
    assert {f.name for f in (tmp_path / "out").iterdir()} == {"config.json", "metrics.json", "table.md", "figure.png"}
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["rows"] == rows


def test_embeddings_are_of_classes_of_their_own():
    space = made_text_space([f"word {i}" for i in range(30)])
    images, texts = autoencoder.embeddings_of(space, 10, 0, autoencoder.QUICK)
    assert images.shape == texts.shape == (10, 512)
    own = np.diag(images @ texts.T)
    assert own.mean() > (images @ texts.T).mean() + 0.05


def test_ablated_parts_change_what_they_should():
    """Two objects in six views; the tracker swaps their ids in the last one, where the masks are small."""
    truth = np.repeat([0, 1, -1], [30, 30, 20])
    votes, pixels = np.zeros((80, 12)), np.full((6, 2), 100)
    pixels[5] = 10
    embeddings = np.zeros((6, 2, 8), np.float32)
    for t in range(6):
        for k, r in enumerate((1, 0) if t == 5 else (0, 1)):
            votes[truth == k, 2 * t + r] = 1
            embeddings[t, r] = np.eye(8)[k]
    masks = SimulatedMasks(np.zeros((6, 1, 1), np.int16), np.arange(2))
    sight = scenes.Sight(masks, embeddings, pixels, np.eye(8, dtype=np.float32)[:2], np.eye(8, dtype=np.float32)[4:])
    proof = scenes.Evidence(sparse.csr_matrix(votes), np.ones((80, 6)), np.ones(80), 0.0)
    options = ablations.Options(latent=16)
    whole = ablations.built(sight, proof, options)
    even = ablations.built(sight, proof, options, weighting=False)
    apart = ablations.built(sight, proof, options, tracking=False)
    assert whole.table.shape == (2, 8)
    assert apart.table.shape == (12, 8)
    assert (whole.table @ whole.table.T)[0, 1] < (even.table @ even.table.T)[0, 1]  # the bad view weighs less
    means = np.random.default_rng(0).normal(size=(80, 3)).astype(np.float32)
    for way in ablations.QUERIES:
        found = ablations.selections(
            whole, sight.texts, way, dataclasses.replace(options, code_threshold=0.8, canonical_threshold=0.95)
        )
        assert ablations.scored(found, truth, means, dbscan=False) == (1.0, 1.0), way
    assert ablations.scored([np.zeros(80, bool)] * 2, truth, means, dbscan=True) == (0.0, 0.0)


def test_every_rule_of_retrieval_is_asked_for_what_is_there_and_what_is_not(task):
    labels, shape = np.asarray(task.labels), task.labels.shape
    frames = np.random.default_rng(0).integers(0, 255, (*shape, 3), dtype=np.uint8)
    scene = scenes.Scene(
        "small", task.gaussians, task.cameras, frames, labels, REGIONS, seed=0, truth=np.asarray(task.truth)
    )
    space = made_text_space([f"word {i}" for i in range(40)])
    options = retrieval.Options(levels=("low",), absent=30)
    asked = retrieval.ask(scene, "low", space, options)
    assert [(a.regions, a.rule) for a in asked] == [
        (r, rule) for r in ("tracks", "consensus") for rule in retrieval.RULES
    ]
    assert all(len(a.right) == len(a.best) == len(a.iou) == REGIONS and 25 <= len(a.absent) <= 30 for a in asked)
    rules, thresholds = retrieval.rows_of(asked, options)
    found = {(row["regions"], row["rule"]): row for row in rules}
    assert found["tracks", "contrast"]["low texts"] >= 0.8
    assert 1 == found["tracks", "contrast"]["low there or not"] >= found["tracks", "relevancy"]["low there or not"]
    for rule in retrieval.RULES:
        own = [row for row in thresholds if (row["regions"], row["rule"]) == ("tracks", rule)]
        refused = [row["low not there, refused"] for row in own]
        assert refused == sorted(refused)
        assert refused[-1] > 0
        assert own[0]["mIoU"] >= own[-1]["mIoU"]
