"""Every method by every reading: what a cell holds, who is compared with whom, and what a reading does to a score."""

import numpy as np
import pytest
from experiments.test_tables import folder, small, with_gaussians  # noqa: F401

from experiments import fair, lerf, shared_errors
from experiments.baselines.lifting import smoothed
from experiments.tables.readings import as_share


def test_a_share_is_one_half_where_the_readout_cuts():
    similarity = np.linspace(0, 1, 101)
    share = as_share(similarity)
    assert (np.diff(share) > 0).all()
    np.testing.assert_allclose(share[[0, 60, 100]], [0, 0.5, 1], atol=1e-6)
    sharp = as_share(similarity, sharp=True)
    np.testing.assert_allclose(sharp[[0, 40, 50, 60, 80, 100]], [0, 0, 0.25, 0.5, 1, 1], atol=1e-6)
    np.testing.assert_allclose(as_share(similarity, 0.9, sharp=True)[[80, 90, 95]], [0, 0.5, 1], atol=1e-6)


def test_smoothing_fills_the_range_and_leaves_out_what_is_unknown():
    rng = np.random.default_rng(0)
    means, score = rng.normal(size=(60, 3)), rng.normal(size=60)
    score[7] = np.nan
    found = smoothed(means, score)
    assert found[7] == 0
    assert found.max() == 1
    np.testing.assert_allclose(smoothed(means, 3 * score + 5), found, atol=1e-5)  # the scale of a score means nothing


def cell(method, seed, value, lenient):
    texts = {"a": [[value, value], [lenient]], "b": [[value], [lenient]]}
    told = {"scene": "s", "seed": seed, "level": "medium", "method": method, "texts": texts}
    return told | {"miou": value, "miou_vala": lenient, "macc": 1.0}


def test_each_method_is_read_as_suits_each_figure_and_ours_also_by_one_reading():
    cells = []
    for seed in (0, 10):
        cells += [cell("VALA: cosine", seed, 0.6, 0.2), cell("VALA: centred", seed, 0.5, 0.4)]
        cells.append(cell("VALA: as published", seed, 0.4, 0.1))
        cells += [cell("ours, consensus: x", seed, 0.8, 0.3), cell("ours, consensus: y", seed, 0.7, 0.5)]
    best = fair.chosen(cells, (0,), ("miou", "miou_vala"))
    assert best["VALA"] == {"miou": "VALA: cosine", "miou_vala": "VALA: centred"}
    assert best["ours, consensus"] == {"miou": "ours, consensus: x", "miou_vala": "ours, consensus: y"}
    assert set(best["ours, consensus" + fair.ONE_READING].values()) == {"ours, consensus: y"}
    options = fair.Options(seeds=(10,), choosing=(0,))
    text, told = fair.report("lerf", "medium", cells, options)
    assert told["VALA, miou"]["ahead"] == pytest.approx((0.2, 0.2, 0.2))
    assert told["VALA, miou_vala"]["ahead"] == pytest.approx((0.1, 0.1, 0.1))
    assert "| VALA | 0.400 | 0.600 | 1.000 | cosine | 0.800 | +0.200 [+0.200, +0.200] |" in text


def test_ours_is_compared_with_a_method_on_the_scenes_and_seeds_that_it_has():
    cells = [cell("VALA: cosine", seed, 0.5, 0.4) for seed in (0, 10)]
    cells += [cell("ours, consensus: x", seed, value, 0.5) for seed, value in ((0, 0.7), (10, 0.7), (11, 0.9))]
    cells += [cell("ours, consensus: x", 10, 0.1, 0.5) | {"scene": "another"}]
    options = fair.Options(seeds=(10, 11), choosing=(0,), seeds_trained=(10,))
    _, told = fair.report("lerf", "medium", cells, options)
    assert told["VALA, miou"]["ours there"] == pytest.approx(0.7)
    assert told["VALA, miou"]["scenes"] == ["s"]
    assert told["VALA, miou"]["seeds"] == [10]
    assert told["ours, consensus, miou"]["mean"] == pytest.approx((0.1 + 0.8) / 2)


def test_shared_errors_are_measured_on_a_twin(folder):  # noqa: F811
    """At full strength fewer regions have their own text as the best, and no figure moves at strength 0."""
    data = small(lerf.QUICK, folder, "shared").data
    root = data.place("figurines", 0, "perfect")
    bench = data.load(root, "figurines")
    plain, off, full = (
        shared_errors.pooled(bench, root, level, 0) for level in ("perfect", "perfect+shared=0", "perfect+shared=1")
    )
    np.testing.assert_array_equal(off.masks, plain.masks)
    told = {name: shared_errors.figures_of(found) for name, found in (("plain", plain), ("full", full))}
    assert set(told["full"]) == set(shared_errors.REAL)
    own = "own text is the best, by cosine"
    assert told["plain"][own] == 1
    assert told["full"][own] < 0.8
    assert told["full"]["mask to its own text"] < told["plain"]["mask to its own text"] - 0.01
    assert told["full"]["same region, another view"] == pytest.approx(1, abs=1e-5)
