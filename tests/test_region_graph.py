"""Merging over the region graph: connected regions, atoms never cut, whatever they are called."""

import cv2
import numpy as np
from hypothesis import given, settings, strategies as st

from jsecon.vision.classical import oversegment
from jsecon.vision.region_graph import merge_regions, region_borders


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 2**32 - 1))
def test_merging_leaves_connected_regions_whatever_the_atoms_are_called(seed):
    rng = np.random.default_rng(seed)
    picture = cv2.resize(rng.uniform(0, 60, (4, 5, 3)).astype(np.float32), (30, 24), interpolation=cv2.INTER_NEAREST)
    features = picture + rng.normal(0, 1, picture.shape).astype(np.float32)
    atoms = oversegment(features, min_size=4)
    results = []
    for name in (np.arange(atoms.max() + 1), rng.permutation(atoms.max() + 1)):
        named = name[atoms].astype(np.int32)
        edges = region_borders(named, features, None)
        assert (edges.pairs[:, 0] < edges.pairs[:, 1]).all()
        assert (edges.colour >= 0).all()
        assert not edges.shape.any()
        merged = merge_regions(named, features, edges, distance=10.0, min_area=8.0)
        for region in range(merged.max() + 1):
            assert cv2.connectedComponents((merged == region).astype(np.uint8), connectivity=8)[0] == 2
        for atom in range(named.max() + 1):
            assert len(np.unique(merged[named == atom])) == 1  # atoms are never cut
        results.append(merged)
    pairs = np.unique(np.stack([r.ravel() for r in results]), axis=1)
    assert pairs.shape[1] == results[0].max() + 1 == results[1].max() + 1  # the same partition
