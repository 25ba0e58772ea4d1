import numpy as np
import pytest
from balls import HEIGHT, VIEWS, WIDTH, ious, ring_of_balls

from jsecon.language.consensus import consensus_masklets, mask_signatures
from jsecon.vision.views import SceneViews, claim_atoms


@pytest.fixture(scope="module")
def world():
    return ring_of_balls()


def scene_of(world, proposals, atoms=60):
    return SceneViews(world[0], world[1], proposals, atoms_per_frame=atoms)


@pytest.fixture(scope="module")
def scene(world):
    return scene_of(world, world[4])


def as_truth(labels, truth):
    """labels renumbered so that each of the floor and the three balls is its most frequent label; others 9."""
    names = [np.bincount(labels[(truth == k) & (labels >= 0)]).argmax() for k in range(4)]
    assert len(set(names)) == 4
    table = np.full(labels.max() + 2, 9)
    table[names] = np.arange(4)
    table[-1] = -1
    return table[labels]


def test_finds_the_three_balls_and_the_floor(world, scene):
    _, _, frames, truth, _ = world
    calls = []
    labels = consensus_masklets(frames, scene, progress=lambda *row: calls.append(row))
    assert labels.shape == truth.shape
    assert labels.dtype == np.int16
    assert labels.max() == 3
    assert np.nanmin(ious(as_truth(labels, truth) - 1, truth, 3)) > 0.9
    assert calls[-1] == (VIEWS, VIEWS)


def test_frames_that_merge_cut_or_propose_nothing_are_outvoted(world):
    _, _, frames, truth, proposals = world
    worse = list(proposals)
    for t in (2, 9, 16):
        worse[t] = (truth[t] >= 0)[None]  # everything is one region
    left = np.arange(WIDTH) < WIDTH // 2
    for t in (5, 12):
        worse[t] = np.concatenate([proposals[t] & left, proposals[t] & ~left])
    worse[20] = np.zeros((0, HEIGHT, WIDTH), bool)
    labels = as_truth(consensus_masklets(frames, scene_of(world, worse, atoms=300)), truth)
    scores = ious(labels - 1, truth, 3)
    assert np.nanmean(scores) > 0.85
    assert np.nanmean(scores[[2, 9, 16, 20]]) > 0.6  # and there, too, the Gaussians tell the balls apart


def test_masks_that_lie_over_each_other_have_one_vote(world, scene):
    _, _, frames, _, proposals = world
    twice = [np.concatenate([masks, masks]) for masks in proposals]
    once = mask_signatures(scene.all(frames), scene.count)
    both = scene_of(world, twice)
    double = mask_signatures(both.all(frames), both.count)
    for a, b in ((once[0], double[0]), (once[1], double[1])):
        a, b = (a @ a.T)[:50, :50].toarray(), (b @ b.T)[:50, :50].toarray()
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)
    assert np.asarray(once[0].sum(1)).max() <= VIEWS + 1e-3


def test_nothing_proposed_anywhere_gives_one_thing_or_none(world):
    _, _, frames, _, _ = world
    nothing = [np.zeros((0, HEIGHT, WIDTH), bool)] * VIEWS
    labels = consensus_masklets(frames, scene_of(world, nothing))
    assert labels.shape == frames.shape[:3]


def test_claims_without_a_class_or_a_proposal(world, scene):
    view = scene.all(world[2])[0]
    atoms = view.votes.shape[1]
    total = view.on_atoms(np.ones((len(view.seen), 1), np.float32))
    unknown = claim_atoms(view, np.zeros((atoms, 2), np.float32), np.zeros((atoms, 1), np.float32))
    assert (unknown == -1).all()
    covered = total[:, 0] > 0.2 * np.bincount(view.atoms.ravel())
    assert (claim_atoms(view, total, total)[covered] == 0).all()


def test_frames_of_other_cameras_are_refused(world, scene):
    with pytest.raises(ValueError, match="frames"):
        consensus_masklets(world[2][1:], scene)
