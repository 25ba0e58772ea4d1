"""The memberships that were measured and not kept, against their definitions."""

import dataclasses

import numpy as np
import pytest
from small_field import make_field, shares

from experiments.tables.memberships import by_lead, of_all_views
from jsecon.query.anchored import query_anchored, query_region
from jsecon.types import Regions


@pytest.fixture(scope="module")
def field(scene, cameras):
    """Regions 1 and 4 are alike."""
    field, _ = make_field(scene, cameras)
    embeddings = np.array(field.regions.embeddings)
    embeddings[4] = embeddings[1]
    return dataclasses.replace(field, regions=Regions(embeddings, field.regions.pixels))


def test_lead_is_over_the_strongest_other_region(field):
    votes = field.votes
    for region, alike, group in ((1, 0.95, [1, 4]), (1, None, [1]), (2, 0.95, [2])):
        found = by_lead(field, query_region(field, region), alike_threshold=alike)
        for n in range(64):
            cast = {r: float(w) for r, w in zip(np.asarray(votes.regions[n]), np.asarray(votes.weights[n])) if r >= 0}
            own, rival = sum(cast.get(r, 0) for r in group), max([w for r, w in cast.items() if r not in group] or [0])
            lead = own / (own + rival) if own + rival else 0.0
            labelled = float(votes.labelled[n] / votes.total[n]) if votes.total[n] > 0 else 0.0
            assert float(found.similarity[n]) == pytest.approx(min(lead, labelled), abs=1e-6)
        np.testing.assert_array_equal(found.mask, np.asarray(found.similarity) >= 0.5)
        assert np.asarray(found.mask).any()
        strict = by_lead(field, query_region(field, region), alike_threshold=alike, threshold=0.8)
        np.testing.assert_array_equal(strict.mask, np.asarray(found.similarity) >= np.float32(0.8))
    nothing = by_lead(field, query_region(field, -1))
    assert not np.asarray(nothing.mask).any()


def test_all_views_are_the_denominator_where_the_votes_do_not_say_which_show_a_region(field):
    shown = np.asarray(field.votes.total)[:, None] * np.float32(0.5) * np.ones((1, 3), np.float32)
    known = dataclasses.replace(field, votes=dataclasses.replace(field.votes, shown=shown))
    found = query_anchored(of_all_views(known), field.regions.embeddings[2])
    np.testing.assert_allclose(found.similarity, shares(field, [2]), atol=1e-6)
    assert not np.array_equal(found.mask, query_anchored(known, field.regions.embeddings[2]).mask)
