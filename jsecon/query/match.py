"""How well each region of a field matches one text, and which regions belong to the match.

In a space such as CLIP's all texts lie in one narrow cone and all images in another, so the cosine of a text and an
image is mostly that of the cones. What a text has in common with all texts is therefore subtracted before it is
compared: the mean of unrelated words (`LanguageField.unrelated_words`). Those words also say how similar a text must be
to the scene: it is refused unless it beats most of them (`QueryRules.min_rank`).

A tracker may break an object into two regions, a mask may cut it into pieces, and a text may mean all objects of a
class. `regions_with` has the rule. Relative scores are 0 at the median region and 1 at the best:

    same class   its relative score reaches `same_class_score`: another object of that class (only on request)
    fragment     its relative score reaches `fragment_score`, and it overlaps one of those in its Gaussians: another
                 piece of the object. A second object of the class is as similar, but has Gaussians of its own
    duplicate    cos(d, d_best) >= `duplicate_cosine`, d the embedding minus the mean: the same object seen twice

Pure functions.
"""

from typing import NamedTuple

import numpy as np
from jax import export
from jaxtyping import Bool, Float, Int, Shaped

from jsecon.field.regions import mean_residuals
from jsecon.field.similarity import Number, similarities
from jsecon.numerics import array_module, cosine_matrix, inline_jit, normalize
from jsecon.query.rules import ABSENT, FOUND, QueryRules
from jsecon.types import Array

HEIGHT_WEIGHT = 0.5
"""Weight of the heights in the margin of a text among unrelated words: so many deviations of heights as of similarities
are reached by absent colours in ray-traced rooms, and more by what is present with simulated CLIP at high noise."""
MIN_FRAGMENT_OVERLAP = 0.1
"""Smallest soft IoU of the Gaussians of two fragments. In twins of two scenes 106 of 115 pieces reach it, and 4 of 58
other regions."""


class RegionMatch(NamedTuple):
    """The regions of a field, R of them, that match a question."""

    chosen: Bool[Array, " r"]
    """Regions that match."""
    region: Int[Array, ""]
    """The best of them; -1 if there is none."""
    score: Float[Array, ""]
    """Similarity of the best region, whether it is chosen or not; 0 without regions."""
    rank: Float[Array, ""] | np.ndarray = np.asarray(np.nan, np.float32)
    """Share of unrelated words that match the scene less than the text does; NaN without such words."""
    state: Int[Array, ""] | np.ndarray = np.asarray(FOUND, np.int32)
    """Index of `rules.STATES`: whether the scene has what the text names."""


export.register_namedtuple_serialization(RegionMatch, serialized_name="jsecon.RegionMatch")  # for `stored_jit`
NO_REGIONS = RegionMatch(
    np.zeros(0, bool), np.asarray(-1, np.int32), np.asarray(0.0, np.float32), state=np.asarray(ABSENT)
)
"""The match of a field without regions."""


class _TextScores(NamedTuple):
    """How well R regions match one text."""

    similarity: Float[Array, " r"]
    """Cosine, in [-1, 1]; 0 where it is not known."""
    known: Bool[Array, " r"]
    """Regions with an embedding, if the text has one."""
    best: Int[Array, ""]
    """The best region: largest similarity times `view_count_weight`."""
    state: Int[Array, ""]
    """Whether the scene has what the text names, an index of `rules.STATES`."""
    rank: Float[Array, ""]
    """Share of unrelated words that match the scene less than the text does; NaN without such words."""


class _WordScores(NamedTuple):
    """W unrelated words, compared with the regions once for all texts."""

    mean: Float[Array, " e"]
    """Mean of the unit words."""
    apart: Float[Array, "w e"]
    """Unit words minus the mean."""
    similarity: Float[Array, "w r"]
    """Cosine of each word with each region, as a text has it; NaN if unknown."""


def compare_words(
    embeddings: Float[Array, "r e"], words: Float[Array, "w e"] | None, retrieval: str
) -> _WordScores | None:
    """Compares regions with unrelated words, as `region_similarities` does with a text; None without words."""
    if words is None or not len(words):
        return None
    units = normalize(words.astype(embeddings.dtype))
    mean = _mean(units)
    apart = units - mean
    directions = units if retrieval == "cosine" else apart
    # As one product of matrices: W queries of their own would walk all regions W times.
    known = (directions != 0).any(axis=1)[:, None] & (embeddings != 0).any(axis=1)
    cosines = cosine_matrix(directions, embeddings)
    return _WordScores(mean, apart, array_module(cosines).where(known, cosines, np.nan))


def score_text(
    embeddings: Float[Array, "r e"],
    text: Float[Array, " e"],
    pixels: Shaped[Array, "r t"],
    words: _WordScores | None,
    rules: QueryRules,
) -> _TextScores:
    """Compares one text with all regions, and with unrelated words (`compare_words`) if there are any."""
    similarity, known = similarities(embeddings, _text_direction(text, words and words.mean, rules.retrieval))
    xp = array_module(similarity)
    weight = view_count_weight(pixels).astype(similarity.dtype)
    weighted = similarity
    if rules.retrieval != "cosine" and words is not None:  # the plain cosine is the paper's, without weights
        weighted = xp.where(similarity > 0, similarity * weight, similarity)
    best = xp.argmax(xp.where(known, weighted, -xp.inf))
    rank_and_margin = None
    rank = xp.asarray(xp.nan, similarity.dtype)
    if words is not None:
        weight = xp.where(known, weight, 0.0)
        reach = xp.max(xp.where(known, similarity, -xp.inf)), _height(similarity, weight)
        rank_and_margin = _rank_and_margin(reach, text, words, weight)
        rank = rank_and_margin[0]
    state = rules.judge(rank_and_margin, similarity[best])
    return _TextScores(similarity, known, best, state, rank)


def rank_among_words(similarity: Float[Array, " r"], words: _WordScores) -> Float[Array, " r"]:
    """Computes the share of unrelated words that match each region less than `similarity`; 1 if none is known."""
    xp = array_module(similarity, words.similarity)
    count = xp.isfinite(words.similarity).sum(axis=0)
    below = (words.similarity < similarity).sum(axis=0, dtype=similarity.dtype)
    return xp.where(count > 0, below / xp.maximum(count, 1), 1.0)


def region_similarities(
    embeddings: Float[Array, "r e"], text: Float[Array, " e"], words: Float[Array, "w e"] | None, retrieval: str
) -> tuple[Float[Array, " r"], Bool[Array, " r"]]:
    """Compares regions with a text: their cosines (R,), and whether they are known (R,); 0 if not.

    "contrast" subtracts the mean of the unrelated words from the text; "cosine" does not.
    """
    mean = None if words is None or not len(words) else _mean(normalize(words.astype(text.dtype)))
    return similarities(embeddings, _text_direction(text, mean, retrieval))


def _mean(units: Float[Array, "w e"]) -> Float[Array, " e"]:
    """Returns the mean of the rows, by NumPy in float64: equal words have no direction of their own."""
    return units.mean(axis=0, dtype=np.float64 if array_module(units) is np else None).astype(units.dtype)


def _text_direction(text: Float[Array, " e"], mean: Float[Array, " e"] | None, retrieval: str) -> Float[Array, " e"]:
    """Returns a unit text, by "contrast" minus the mean of the unit unrelated words if there are any."""
    return normalize(text) if retrieval == "cosine" or mean is None else normalize(text) - mean


def _rank_and_margin(
    reach: tuple[Number, Number],
    text: Float[Array, " e"],
    words: _WordScores,
    weight: Float[Array, " r"],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Compares how well a text and unrelated words match a scene: the rank of the text, and its margin.

    The rank is the share of the words whose largest similarity with a region is smaller; 1 if no word is left. The
    margin is in standard deviations d of the words, with s their largest similarities and h their heights (`_height`):

        max((s - mean_w s_w) / d(s_w), HEIGHT_WEIGHT (h - mean_w h_w) / d(h_w))

    The first suits colours, whose similarities mean the same in all scenes. The second suits CLIP, where some texts are
    more similar to all regions than others are. In a scene of few things the words differ more.

    The tenth of the words that is nearest to the text is left out: the scene often has what is like it. `reach` has the
    largest similarity of the text and its height.
    """
    xp, scores = array_module(text, words.similarity), words.similarity
    largest = xp.where(xp.isfinite(scores), scores, -xp.inf).max(axis=1)
    near = cosine_matrix((normalize(text) - words.mean)[None], words.apart)[0]
    others = xp.argsort(-near, stable=True)[int(0.1 * len(scores)) :]
    known = xp.isfinite(largest)[others]
    count = xp.maximum(known.sum(dtype=text.dtype), 1)

    def deviations(value, of_words):
        of_words = xp.where(known, of_words[others], 0.0)
        level = of_words.sum() / count
        spread = xp.sqrt((xp.where(known, of_words - level, 0.0) ** 2).sum() / count)
        return (value - level) / xp.maximum(spread, 1e-6)

    heights = _height(scores, weight)
    margin = xp.maximum(deviations(reach[0], largest), HEIGHT_WEIGHT * deviations(reach[1], heights))
    below = (known & (largest[others] < reach[0])).sum(dtype=text.dtype) / count
    return xp.where(known.any(), below, 1.0), xp.where(known.any(), margin, xp.inf)


@inline_jit
def view_count_weight(pixels: Shaped[Array, "r t"]) -> Float[Array, " r"]:
    """Weights each region by the number of views that show it; 1 everywhere if no pixels are known.

        v / (v + 2) over its largest value,  v = sum_t min(pixels_t / 400, 1)

    So 400 pixels make a full view: a crop of 20 x 20 pixels shows an image encoder little. A sliver that few views show
    has one colour, so its embedding is purer than that of the object that it belongs to.
    """
    xp = array_module(pixels)
    views = xp.minimum(pixels / 400.0, 1.0).sum(axis=-1)
    weight = views / (views + 2.0)
    largest = weight.max(initial=0.0)
    return xp.where(largest > 0, weight / xp.where(largest > 0, largest, 1.0), 1.0)


def _height(similarity: Float[Array, "*batch r"], weight: Float[Array, " r"]) -> Number:
    """How far the best region's similarity is above the weighted mean; regions of no weight do not count."""
    xp = array_module(similarity, weight)
    counted = (weight > 0) & xp.isfinite(similarity)
    similarity = xp.where(counted, similarity, 0.0)
    weight = xp.where(counted, weight, 0.0)
    weighted = xp.where(similarity > 0, similarity * weight, similarity)
    row = xp.where(counted, weighted, -xp.inf).argmax(axis=-1)
    best = xp.take_along_axis(similarity, row[..., None], axis=-1)[..., 0]
    total = weight.sum(axis=-1)
    return best - (weight * similarity).sum(axis=-1) / xp.where(total > 0, total, 1.0)


def regions_with(
    best: Number,
    similarity: Float[Array, " r"],
    known: Bool[Array, " r"],
    embeddings: Float[Array, "r e"],
    overlap: Float[Array, "r r"] | None,
    rules: QueryRules,
) -> Bool[Array, " r"]:
    """Finds the regions that answer with the best one, by the rule of this module. Pure.

    `similarity` is that of each region with the question, where `known` it means something. Without `Votes.overlap` no
    fragments are joined.
    """
    xp = array_module(similarity, embeddings)
    chosen = xp.arange(embeddings.shape[0]) == best
    if rules.all_of_class:
        chosen |= _reaches(similarity, known, rules.same_class_score)
    if rules.fragment_score is not None and overlap is not None:
        overlaps = xp.where(chosen[:, None], overlap, 0.0).max(axis=0) >= MIN_FRAGMENT_OVERLAP
        chosen |= overlaps & _reaches(similarity, known, rules.fragment_score)
    if rules.duplicate_cosine is not None:
        residuals, usable = mean_residuals(embeddings)
        cosines, comparable = similarities(residuals, residuals[best])
        chosen |= usable & comparable & (cosines >= rules.duplicate_cosine)
    return chosen


def _reaches(similarity: Float[Array, " r"], known: Bool[Array, " r"], relative_score: Number) -> Bool[Array, " r"]:
    """Finds regions with a similarity of at least m + `relative_score` (b - m), m the median and b > m the largest."""
    xp = array_module(similarity, known)
    if not len(similarity):
        return known
    ordered, count = xp.sort(xp.where(known, similarity, xp.inf)), known.sum()
    median = 0.5 * ordered[xp.maximum(count - 1, 0) // 2] + 0.5 * ordered[count // 2]
    largest = xp.where(known, similarity, -xp.inf).max()
    reach = xp.where(largest > median, largest - median, 0.0)
    return known & (similarity >= median + relative_score * reach) & (largest > median)
