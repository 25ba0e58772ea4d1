"""The point-level rendered protocol: pairs, denominators, missing answers, sizes; truths rendered from the scene."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.datasets.ovs3d import box_of
from experiments.protocols.rendered import VALA_THRESHOLD, by_masks
from jsecon import InputError, Selection, selection_mask
from jsecon.evaluate.lerf import evaluate_labels as evaluate
from jsecon.fit.resize import resize_camera
from jsecon.read.masks.labels import LabelledFrame


def members(scene):
    means = np.asarray(scene.means)
    return {"left": means[:, 0] < -0.2, "right": means[:, 0] > 0.2, "top": means[:, 1] < -0.35}


def selection(mask, similarity=None):
    mask = jnp.asarray(mask)
    similarity = jnp.where(mask, 1.0, 0.0) if similarity is None else jnp.asarray(similarity)
    return Selection(mask, similarity, jnp.asarray(3, jnp.int32), jnp.asarray(0.8))


@pytest.fixture(scope="module")
def labelled(scene, cameras):
    frames = []
    for view, queries in ((0, ("left", "right", "top")), (2, ("left", "top"))):
        objects = {}
        for query in queries:
            mask = np.asarray(selection_mask(scene, cameras[view], members(scene)[query]))
            objects[query] = mask, box_of(mask)
        frames.append(LabelledFrame(f"view_{view}", 48, 40, objects))
    return frames


@pytest.fixture(scope="module")
def views(cameras):
    return {f"view_{t}": cameras[t] for t in range(4)}


def test_a_perfect_selection_scores_one(scene, views, labelled):
    asked, calls = [], []

    def select(query):
        asked.append(query)
        return selection(members(scene)[query])

    rows, summary = evaluate(scene, views, labelled, select, progress=lambda *c: calls.append(c))
    pairs = [(frame.name, query) for frame in labelled for query in sorted(frame.objects)]
    assert [(row.frame, row.query) for row in rows] == pairs
    assert sorted(asked) == ["left", "right", "top"]  # a query is asked once a scene
    assert all(row.iou == 1 and row.located and row.region == 3 for row in rows)
    assert rows[0].selected == members(scene)["left"].sum()
    assert [summary[name] for name in ("pairs", "frames", "queries", "missing")] == [5, 2, 3, 0]
    assert [summary[name] for name in ("miou", "macc", "acc_50", "loc_acc")] == [1.0] * 4
    assert by_masks(rows, labelled)["loc_box"] == 1
    assert calls[-1] == (5, 5)


def test_missing_answers_count_as_nothing_found(scene, views, labelled):
    answers = {"left": selection(members(scene)["left"]), "right": None, "top": selection(np.zeros(64, bool))}
    rows, summary = evaluate(scene, views, labelled, answers.get)
    assert [row.iou for row in rows] == [1, 0, 0, 1, 0]
    assert summary["missing"] == 3
    assert summary["pairs"] == 5
    assert summary["miou"] == summary["macc"] == summary["loc_acc"] == pytest.approx(0.4)
    assert all(not row.mask.any() and row.point is None for row in rows if row.iou == 0)


def test_what_is_selected_is_measured_and_located_in_three_ways(scene, views, labelled):
    """Both groups selected, one ten times as similar: the peak lies on that one, the middle of the mask's bounding box
    between the two, and the mask touches the box that the largest part of it lies in."""
    left, right = members(scene)["left"], members(scene)["right"]
    predicted = np.asarray(selection_mask(scene, views["view_0"], left | right))
    for strong, query in ((left, "left"), (right, "right")):
        similarity = np.where(strong, 1.0, np.where(left | right, 0.1, 0.0)).astype(np.float32)
        answer = selection(left | right, similarity)
        rows, _ = evaluate(scene, views, labelled[:1], lambda _, answer=answer: answer)
        by_query = {row.query: row for row in rows}
        assert [name for name in ("left", "right") if by_query[name].located] == [query]
        x, y = by_query[query].point
        assert labelled[0].objects[query][0][y, x]
        told = by_masks(rows, labelled)
        assert told["loc_mask"] > 0
        assert told["loc_box"] == 0
        for row in rows:
            true = labelled[0].objects[row.query][0]
            assert row.iou == pytest.approx((predicted & true).sum() / (predicted | true).sum(), abs=1e-6)
            np.testing.assert_array_equal(row.mask, predicted)


def test_a_lower_threshold_of_the_silhouette_makes_larger_masks(scene, views, labelled):
    def areas(**options):
        rows, _ = evaluate(scene, views, labelled[:1], lambda query: selection(members(scene)[query]), **options)
        return np.array([row.mask.sum() for row in rows])

    assert (areas() < areas(alpha_threshold=VALA_THRESHOLD)).all()


def test_labels_of_another_size_are_evaluated_at_their_own(scene, views, labelled):
    camera = resize_camera(views["view_0"], 96, 80)
    mask = np.asarray(selection_mask(scene, jax.tree.map(jnp.asarray, camera), members(scene)["left"]))
    frame = LabelledFrame("view_0", 96, 80, {"left": (mask, box_of(mask))})
    rows, _ = evaluate(scene, views, [frame], lambda query: selection(members(scene)[query]))
    assert rows[0].iou == 1


def test_wrong_names_and_sizes_are_told(scene, views, labelled):
    def run(frames):
        return evaluate(scene, views, frames, lambda query: None)

    with pytest.raises(InputError, match="at least one"):
        run([])
    with pytest.raises(InputError, match="no frame of that name"):
        run([dataclasses.replace(labelled[0], name="view_9")])
    with pytest.raises(InputError, match="aspect"):
        run([dataclasses.replace(labelled[0], width=60)])
