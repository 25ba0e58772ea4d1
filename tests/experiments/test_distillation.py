"""The paths to the Gaussians' codes on a problem small enough for a test."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_field import REGIONS, labels_of, true_regions, unit_rows

from experiments import distillation
from experiments.codes import paths
from jsecon.pipeline import cache
from jsecon.types import Regions


@pytest.fixture(scope="module")
def task(scene, cameras):
    scene, cameras = jax.tree.map(jnp.asarray, (scene, cameras))
    members = true_regions(scene)
    labels = jnp.asarray(labels_of(scene, cameras, members))
    codes = jnp.asarray(unit_rows(np.random.default_rng(1), REGIONS, 3))
    pixels = np.stack([(np.asarray(labels) == r).sum((1, 2)) for r in range(REGIONS)])
    regions, texts = Regions(np.eye(REGIONS, 8, dtype=np.float32), pixels), np.eye(REGIONS, 8, dtype=np.float32)
    return paths.Task("small", scene, cameras, labels, codes, regions, texts, np.arange(REGIONS), members)


@pytest.mark.long
def test_the_solver_is_below_the_votes_it_starts_from(task):
    rows = {row["path"]: row for row in paths.votes_paths(task, loyalties=(0.1,), sweeps=(8,))}
    assert len(rows) == 5
    solver = next(row for name, row in rows.items() if name.startswith("solver"))
    assert solver["l1"] < min(row["l1"] for name, row in rows.items() if name.startswith("votes"))
    assert all(row["accuracy"] > 0.4 for row in rows.values())
    assert rows["votes, mode"]["anchored_by_votes"] > 0.4
    assert rows["votes, mode"]["anchored"] > 0.4


@pytest.mark.long
def test_a_stopped_descent_ends_as_a_whole_one(task, tmp_path, monkeypatch):
    monkeypatch.setattr(paths, "RESTS", 3)
    way = {"steps": 8, "looks": (0.5, 1.0)}
    whole = paths.adam_path(task, "random", tmp_path / "none.npz", **way)
    monkeypatch.setattr(paths, "CHECKPOINT_SECONDS", 0.0)
    real, calls = cache.save, []

    def stopping(path, value):
        real(path, value)
        calls.append(path)
        if len(calls) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(cache, "save", stopping)
    with pytest.raises(KeyboardInterrupt):
        paths.adam_path(task, "random", tmp_path / "kept.npz", **way)
    again = paths.adam_path(task, "random", tmp_path / "kept.npz", **way)
    drop = lambda rows: [{k: v for k, v in row.items() if k != "seconds"} for row in rows]
    assert drop(again) == drop(whole)
    assert [row["steps"] for row in whole] == [4, 8]


def test_geometric_median_has_the_least_distance(task):
    rng = np.random.default_rng(0)
    weights = rng.exponential(size=(50, 3)).astype(np.float32)
    votes = dataclasses.make_dataclass("V", ["regions", "weights"])(
        jnp.asarray(np.stack([rng.permutation(REGIONS)[:3] for _ in range(50)])), jnp.asarray(weights)
    )
    found = np.asarray(paths.geometric_median(votes, task.codes, rounds=200))
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
