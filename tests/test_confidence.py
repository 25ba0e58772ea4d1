"""The probability that an answer is right."""

import jax
import numpy as np

from experiments.calibration import Bin, calibration_error
from jsecon.query import match
from jsecon.query.match import OFFSET, SLOPE

answer_confidence = jax.jit(match.answer_confidence)


def case(seed: int = 0, regions: int = 7, words: int = 20):
    draw = np.random.default_rng(seed)
    similarity = draw.normal(0.1, 0.1, regions).astype(np.float32)
    evidence = draw.uniform(0.2, 1, regions).astype(np.float32)
    return similarity, np.ones(regions, bool), evidence, draw.normal(0, 0.1, (words, regions)).astype(np.float32)


def height(similarity, evidence):
    weighed = np.where(similarity > 0, similarity * evidence, similarity)
    return similarity[weighed.argmax()] - np.average(similarity, weights=evidence)


def test_it_is_a_logistic_curve_of_how_far_the_answer_stands_out():
    similarity, known, evidence, words = case()
    ratio = height(similarity, evidence) / np.mean([height(word, evidence) for word in words])
    expected = 1 / (1 + np.exp(-(OFFSET + SLOPE * ratio)))
    found = answer_confidence(similarity, known, evidence, words)
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    np.testing.assert_allclose(match.answer_confidence(similarity, known, evidence, words), found, rtol=1e-5)
    np.testing.assert_allclose(answer_confidence(3 * similarity, known, evidence, 3 * words), expected, rtol=1e-4)


def test_regions_and_words_that_mean_nothing_do_not_count():
    similarity, known, evidence, words = case(2)
    expected = answer_confidence(similarity, known, evidence, words)
    more = np.append(similarity, 9.0), np.append(known, False), np.append(evidence, 1.0)
    silent = np.concatenate([words, np.full((20, 1), np.nan)], axis=1)
    silent = np.concatenate([silent, np.full((3, 8), np.nan)]).astype(np.float32)
    np.testing.assert_allclose(answer_confidence(*more, silent), expected, rtol=1e-5)
    assert np.isnan(answer_confidence(similarity, known, evidence, words[:0]))
    assert np.isnan(answer_confidence(similarity, ~known, evidence, words))


def test_the_calibration_error_is_the_mean_distance_of_confidence_and_share_of_right_answers():
    confidence, right = np.full(10, 0.8), np.arange(10) < 8
    assert calibration_error(confidence, right, np.ones(10))[0] < 1e-12
    error, curve = calibration_error(np.append(confidence, 0.2), np.append(right, True), np.append(np.ones(10), 10.0))
    np.testing.assert_allclose(error, 0.4)
    assert curve == [Bin(0.2, 1.0, 10.0), Bin(0.8, 0.8, 10.0)]
