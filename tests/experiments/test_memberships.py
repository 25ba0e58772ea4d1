"""The memberships that were measured and not kept, against their definitions."""

import dataclasses

import numpy as np
import pytest
from small_field import make_field, shares

from experiments.tables.ours import of_all_views
from jsecon.query.select import query_anchored
from jsecon.types import Regions


@pytest.fixture(scope="module")
def field(scene, cameras):
    """Regions 1 and 4 are alike."""
    field, _ = make_field(scene, cameras)
    embeddings = np.array(field.regions.embeddings)
    embeddings[4] = embeddings[1]
    return dataclasses.replace(field, regions=Regions(embeddings, field.regions.pixels))


def test_all_views_are_the_denominator_where_the_votes_do_not_say_which_show_a_region(field):
    shown = np.asarray(field.votes.total)[:, None] * np.float32(0.5) * np.ones((1, 3), np.float32)
    known = dataclasses.replace(field, votes=dataclasses.replace(field.votes, shown=shown))
    found = query_anchored(of_all_views(known), field.regions.embeddings[2])
    np.testing.assert_allclose(found.similarity, shares(field, [2]), atol=1e-6)
    assert not np.array_equal(found.mask, query_anchored(known, field.regions.embeddings[2]).mask)
