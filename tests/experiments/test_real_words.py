"""ConSE with a labeller of three colours and vectors that the test writes, the real labeller, and rules on small
arrays."""

import cv2
import numpy as np
import pytest
from small_field import unit_rows

from experiments.words import rules
from experiments.words.absent import absent_names
from experiments.words.conse import Conse, Crop, TextVectors, class_weights, conse, cut_out
from jsecon.paper.queries import _relevancies
from jsecon.query.match import region_similarities
from jsecon.vision.protocols import CANONICAL, Embedder

NAMES = ("red", "green", "blue")


class MeanColour:
    """Stands for a labeller: its scores are the means of a picture's channels."""

    names = NAMES

    def __init__(self, file):
        self.file = file

    def __call__(self, picture):
        return picture.mean((0, 1)).astype(np.uint8)


def test_conse_is_the_weighted_mean_of_the_most_probable_classes():
    rng = np.random.default_rng(0)
    weights, vectors = rng.random((5, 30)), rng.normal(size=(30, 8))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    found = conse(weights, vectors, top=10)
    for row, own in zip(found, weights):
        kept = sorted(range(30), key=lambda k: -own[k])[:10]
        total = sum((own[k] * vectors[k] for k in kept), np.zeros(8))
        np.testing.assert_allclose(row, total / np.linalg.norm(total), atol=1e-6)
    assert not conse(np.zeros((1, 30)), vectors).any()


def test_weights_are_probabilities_or_log_odds_above_the_least():
    scores = np.array([[0, 1, 128, 255]], np.uint8)
    np.testing.assert_allclose(class_weights(scores)[0], [0, 1 / 256, 0.5, 255 / 256])

    def odds(p):
        return np.log(p / (1 - p))

    least = odds(1 / 512)
    expected = [0, odds(1 / 256) - least, -least, odds(255 / 256) - least]
    np.testing.assert_allclose(class_weights(scores, "log-odds")[0], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("crop", "shape", "outside"),
    [
        (Crop(0.0), (10, 20), None),
        (Crop(0.5), (17, 40), 7),  # the box ends 5 px below the frame's upper edge and 2 px above the lower
        (Crop(0.0, "square"), (17, 20), 7),
        (Crop(0.1, "stretched", "greyed"), (12, 24), 128),
        (Crop(0.1, "stretched", "masked"), (12, 24), 0),
        (Crop(0.0, "padded", "kept"), (20, 20), 0),
    ],
)
def test_a_crop_is_the_box_with_its_margin_within_the_frame(crop, shape, outside):
    frame, mask = np.full((17, 60, 3), 7, np.uint8), np.zeros((17, 60), bool)
    mask[5:15, 20:40] = True
    frame[mask] = 200
    found = cut_out(frame, mask, crop)
    assert found.shape == (*shape, 3)
    assert (found == 200).all(-1).sum() == mask.sum()
    rest = found[~(found == 200).all(-1)]
    assert set(np.unique(rest)) == (set() if outside is None else {outside})


def test_it_is_an_embedder_of_regions_and_texts(tmp_path):
    """The three classes are axes, the canonical phrases lie between them."""
    names = [*NAMES, *CANONICAL, "dark ink"]
    vectors = np.array([[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], *[[1, 1, 1, 1]] * 4, [0, 0, 1, 1]], np.float16)
    file = tmp_path / "vectors.npz"
    np.savez(file, names=np.array(names), vectors=vectors)
    embedder = Conse(MeanColour(file), TextVectors(file), crop=Crop(margin=0.0), top=2)
    assert isinstance(embedder, Embedder)
    assert embedder.dim == 4
    np.testing.assert_allclose(embedder.canonical_phrases, 0.5, atol=1e-6)
    frame, masks = np.zeros((20, 30, 3), np.uint8), np.zeros((3, 20, 30), bool)
    masks[0, 2:6, 2:6] = masks[1, 10:18, 10:18] = True
    frame[masks[0]] = 250, 10, 120  # red and blue are the two most probable: green is left out
    frame[masks[1]] = 0, 200, 0
    found = embedder.embed_regions(frame, masks)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found[0], np.array([250, 0, 120, 0]) / np.hypot(250, 120), atol=5e-3)
    np.testing.assert_allclose(found[1:], [[0, 1, 0, 0], [0, 0, 0, 0]], atol=5e-3)
    texts = embedder.embed_text(["Red", "dark-ink"])
    np.testing.assert_allclose(texts, [[1, 0, 0, 0], [0, 0, 0.5**0.5, 0.5**0.5]], atol=1e-6)
    assert absent_names(embedder.texts, "", ("red",)) == ("green", "blue", "dark ink")
    assert absent_names(embedder.texts, "", ("blue",)) == ("red", "green")  # dark ink is near to blue


def test_rules_on_a_table():
    table = np.array([[0.9, 0.7, 0.1, 0.2], [0.8, 0.3, 0.7, -np.inf]])
    assert rules.best_of(table).tolist() == [[True, False, False, False], [True, False, False, False]]
    assert rules.near_best(table, 0.4).tolist() == [[True, True, False, False], [True, False, False, False]]
    assert rules.best_text(table).tolist() == [[True, True, False, True], [False, False, True, False]]
    scaled = rules.standardised(table)
    np.testing.assert_allclose(scaled[1, :3], (table[1, :3] - 0.6) / table[1, :3].std())
    assert scaled[1, 3] == -np.inf
    truth, asked = np.array([0, 0, 1, 2, -1]), np.array([0, 1])
    chosen = np.array([[1, 0, 1, 0, 1], [0, 0, 1, 0, 1]], bool)
    np.testing.assert_allclose(rules.ious(chosen, truth, asked), [1 / 3, 1])
    scores = np.array([[5, 4, 3, 2, 9], [0, 0, 4, 0, 9.0]])
    level, found = rules.best_threshold(scores, truth, asked, np.array([1.0, 4.0, 5.0]))
    assert (level, found.tolist()) == (4.0, [1.0, 1.0])
    assert rules.auc(np.array([2.0, 1.0]), np.array([1.0, 0.0])) == 0.875
    low, high = rules.interval(np.array([0.0, 1.0] * 50))
    assert (low, high) == pytest.approx((0.4, 0.6), abs=0.02)


def test_scores_of_all_texts_are_those_of_the_library():
    rng = np.random.default_rng(0)

    regions, texts, canonical, words = (unit_rows(rng, count, 12) for count in (6, 3, 4, 9))
    pixels = rng.integers(0, 500, (6, 5)).astype(np.int32)
    regions[2] = 0
    found = {kind: rules.scores(regions, texts, canonical, words, pixels, kind) for kind in rules.SCORES}
    assert all((table[:, 2] == -np.inf).all() for table in found.values())
    known = np.arange(6) != 2
    for q, text in enumerate(texts):
        apart = np.asarray(region_similarities(regions, text, words, "contrast")[0])
        relevancy = np.asarray(_relevancies(regions, text, canonical)[0])
        np.testing.assert_allclose(found["contrast"][q, known], apart[known], atol=1e-5)
        np.testing.assert_allclose(found["relevancy"][q, known], relevancy[known], atol=1e-5)
        np.testing.assert_allclose(found["cosine"][q, known], (regions @ text)[known], atol=1e-5)
    moved = rules.scores(regions, rules.unit(texts + canonical.mean(0)), canonical, words, pixels, "centred")
    np.testing.assert_allclose(moved[:, known], found["centred"][:, known], atol=1e-5)  # phrases say nothing


def test_the_real_labeller_knows_a_bonsai(shared):
    """The middle of a photograph, with the bonsai, is a houseplant to it; the whole picture is furniture."""
    pytest.importorskip("ai_edge_litert")
    real = Conse()
    assert (len(real.labeller.names), real.dim) == (631, 384)
    picture = cv2.imread(str(shared / "captures/bonsai/images/DSCF5725.JPG"))[..., ::-1]
    height, width = picture.shape[:2]
    masks = np.zeros((2, height, width), bool)
    masks[0, height // 4 : 3 * height // 4, width // 4 : 3 * width // 4] = True
    masks[1] = True
    best = [real.labeller.names[int(np.argmax(row))] for row in real.scores(picture, masks)]
    assert best == ["houseplant", "furniture"]
