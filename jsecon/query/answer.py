"""From the embedding of a text to Gaussians: the whole path of a question, on one page.

    match_regions      embedding of the text -> the region that matches best, unless the rules refuse the text, with the
                       regions that belong to it: scores of regions, and the rule of what belongs together (query/match)
    select_gaussians   regions -> the Gaussians of which these regions hold at least half (field/membership)
    trim               Gaussians -> without those that lie apart from the rest (query/outliers)

`answer_question` does all three; thresholds are `QueryRules`. A region, as under a pixel, can stand in place of a text.
The gap between a text's and an image's embedding is crossed once, among R regions, where only the order matters (the
paper's GT-anchored query). Gaussians are then compared with regions, so almost any threshold does.

All but `trim` and `answer_question` can be traced: jit them, or vmap them over texts.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy import sparse  # loads csgraph on its first use

from jsecon.errors import require
from jsecon.field.columns import is_mapped
from jsecon.field.membership import inside_fraction, inside_fraction_of_regions
from jsecon.field.similarity import Number, similarities
from jsecon.field.tree import node_members
from jsecon.numerics import array_module, is_traced
from jsecon.paper.queries import select_by_code
from jsecon.programs import stored_jit
from jsecon.query.match import MIN_FRAGMENT_OVERLAP, NO_REGIONS, RegionMatch, compare_words, regions_with, score_text
from jsecon.query.outliers import split_outliers
from jsecon.query.rules import ABSENT, ALL_OF_CLASS, ONE_REGION, RULES, QueryRules
from jsecon.types import Array, LanguageField, Selection, Votes


def answer_question(
    field: LanguageField,
    query: Float[Array, "q e"] | int,
    rules: QueryRules = RULES,
    *,
    excluded: Float[Array, "u e"] | None = None,
    outliers: bool = True,
) -> tuple[Selection, Bool[np.ndarray, " n"], int]:
    """Answers a question by the path of this page. Host code.

    `query` has the embeddings of one text or several, or is the id of a region that stands in place of a text, or of a
    node of `LanguageField.tree` for the Gaussians under it.
    `outliers` drops the Gaussians that lie apart; regions of the `excluded` texts are left out.

    Returns:
      The Gaussians of the regions that match, their mask without outliers, and the number of separate objects: groups
      of regions that overlap, at most as many as there are clusters.
    """
    is_node = False
    if isinstance(query, int | np.integer):
        match = match_region(field, query, rules)
        is_node = several = field.tree is not None and field.regions.count <= query < len(field.tree)
    else:
        match = match_regions(field, query, rules, excluded=excluded)
        several = rules.all_of_class or len(query) > 1 or (excluded is not None and len(excluded) > 0)
    if is_node:
        members = node_members(np.asarray(field.tree), np.asarray(field.leaf), int(query))
        score = np.asarray(1.0, np.float32)
        selection = Selection(members, members.astype(np.float32), np.asarray(query, np.int32), score)
    else:
        selection = select_gaussians(field, match, rules)
    mask, clusters = trim(field, selection, ("all" if several else "supported") if outliers else None)
    count, overlap = 1, field.votes.overlap
    if overlap is not None and not is_node and rules.code_threshold is None:
        chosen = np.flatnonzero(match.chosen)
        linked = np.asarray(overlap)[np.ix_(chosen, chosen)] >= MIN_FRAGMENT_OVERLAP
        count = max(1, min(sparse.csgraph.connected_components(linked, directed=False)[0], clusters))
    return selection, mask, count


def match_regions(
    field: LanguageField,
    queries: Float[Array, "q e"],
    rules: QueryRules = RULES,
    *,
    excluded: Float[Array, "u e"] | None = None,
) -> RegionMatch:
    """Finds the regions that match any of the texts and none of the excluded ones. Pure.

    A text matches the region with the largest similarity times `view_count_weight`, unless the rules refuse it, and the
    regions that belong to that one (`regions_with`). A region that matches a text and an excluded text belongs to the
    one that it is more similar to, so "mug but not handle" keeps a mug whose handle has no region.

    Args:
      field: Field of R regions with embeddings of E numbers.
      queries: (Q, E) embeddings of the texts, Q >= 1.
      rules: How texts match.
      excluded: (U, E) embeddings of texts whose regions are left out; None is an empty list.

    Returns:
      The match.

    Raises:
      ValueError: An embedding has another size.
    """
    size = field.regions.embeddings.shape[1]
    excluded = np.zeros((0, size), np.float32) if excluded is None else excluded
    fit = all(texts.ndim == 2 and texts.shape[1] == size for texts in (queries, excluded)) and len(queries) >= 1
    remedy = f"Embed the text with the field's embedder{f', {field.embedder}' if field.embedder else ''}."
    shapes = f"queries {queries.shape}, excluded {excluded.shape}"
    require(fit, "match_regions", shapes, f"(Q >= 1, {size}) and (U, {size})", remedy)
    if field.regions.count == 0:
        return NO_REGIONS
    regions = field.regions.embeddings, field.regions.pixel_counts, field.votes.overlap
    return _match((*regions, queries, excluded, field.unrelated_words), rules)


def _numpy_outside_traces(function: Callable) -> Callable:
    """Gives a function of a tuple of arrays and of rules NumPy's arrays outside of a trace: it compiles no program."""
    compiled = jax.jit(lambda arrays, rules: function(*arrays, rules))

    @functools.wraps(function)
    def call(arrays: tuple, rules: Any) -> Any:
        if is_traced((arrays, rules)):
            return compiled(arrays, rules)
        with np.errstate(invalid="ignore"):
            return function(*jax.tree.map(np.asarray, arrays), rules)

    return call


@_numpy_outside_traces
def _match(embeddings, pixels, overlap, queries, excluded, words, rules: QueryRules) -> RegionMatch:
    xp = array_module(embeddings, queries, rules.min_rank)
    word_scores = compare_words(embeddings, words, rules.retrieval)

    def match_each(texts):
        def match_text(text):
            scores = score_text(embeddings, text, pixels, word_scores, rules)
            chosen = regions_with(scores.best, scores.similarity, scores.known, embeddings, overlap, rules)
            return scores, chosen & scores.known & (scores.state > ABSENT)

        rows = [match_text(text) for text in texts] if xp is np else []
        scores, chosen = jax.tree.map(lambda *row: np.stack(row), *rows) if rows else jax.vmap(match_text)(texts)
        return scores, chosen.any(0), xp.where(chosen, scores.similarity, -xp.inf).max(axis=0)

    scores, chosen, similarity = match_each(queries)
    if len(excluded):
        _, rejected, against = match_each(excluded)
        # Equal up to rounding: a text that is both included and excluded matches nothing.
        chosen &= ~(rejected & (against >= similarity - 1e-5))
    # The best region of a text is before those that join it, whose similarity may be larger: similarities span 2.
    is_best = ((xp.arange(len(embeddings)) == scores.best[:, None]) & (scores.state > ABSENT)[:, None]).any(axis=0)
    best = xp.argmax(xp.where(chosen, similarity + 4.0 * is_best, -xp.inf))
    matches = chosen.any()

    def at_best(rows):
        return xp.take_along_axis(rows, scores.best[:, None], axis=1)[:, 0]

    known = at_best(scores.known)
    nearest = xp.where(known.any(), xp.where(known, at_best(scores.similarity), -xp.inf).max(), 0.0)
    ranked = known & ~xp.isnan(scores.rank)
    return RegionMatch(
        xp.asarray(chosen),
        xp.where(matches, best, -1).astype(np.int32),
        xp.where(matches, similarity[best], nearest),
        xp.where(ranked.any(), xp.where(ranked, scores.rank, -xp.inf).max(), xp.nan).astype(similarity.dtype),
        xp.where(matches, scores.state.max(), ABSENT),
    )


def match_region(field: LanguageField, region: Number, rules: QueryRules = ONE_REGION) -> RegionMatch:
    """Matches a region in place of a text, with score 1, and by other rules those that belong to it. Pure.

    An id that the field does not have, such as -1, has region -1 and score 0; one that is no integer is a ValueError.
    """
    integral = jnp.issubdtype(jnp.result_type(region), jnp.integer)
    require(integral, "match_region", region, "the id of a region, an integer", "region_at finds the one of a pixel.")
    if field.regions.count == 0:
        return NO_REGIONS
    return _match_one((field.regions.embeddings, field.votes.overlap, region), rules)


@_numpy_outside_traces
def _match_one(embeddings, overlap, region, rules: QueryRules) -> RegionMatch:
    xp = array_module(embeddings, region)
    valid, row = (region >= 0) & (region < len(embeddings)), xp.clip(region, 0, len(embeddings) - 1)
    similarity, known = similarities(embeddings, embeddings[row])
    chosen = regions_with(row, similarity, known, embeddings, overlap, rules)
    return RegionMatch(chosen & valid, xp.where(valid, region, -1).astype(np.int32), valid.astype(embeddings.dtype))


def select_gaussians(field: LanguageField, match: RegionMatch, rules: QueryRules = RULES) -> Selection:
    """Selects the Gaussians in which the matched regions have a share of at least `rules.min_share`. Pure.

    The share (`inside_fraction`) estimates the probability that a pixel of the Gaussian belongs to the regions.
    Gaussians that no view sees, or with votes that are not finite, stay out. Mapped votes stay on disk. With
    `rules.code_threshold` the codes decide in place of the votes (`select_by_code`).
    """
    if rules.code_threshold is not None:
        return select_by_code(field, match, rules.code_threshold)
    few = len(field.votes.views) <= 1 << 17  # of so few NumPy selects in 10 ms; to compile a program takes a second
    if is_traced((field.votes, match, rules)) or not (few or is_mapped(field.votes)):
        return _select_from_votes(jax.tree.map(jnp.asarray, field.votes), match, rules.min_share)
    share, known = inside_fraction_of_regions(field.votes, np.flatnonzero(match.chosen))
    return Selection(known & (share >= rules.min_share) & (np.asarray(match.region) >= 0), share, *match[1:])


@stored_jit
def _select_from_votes(votes: Votes, match: RegionMatch, min_share: Number) -> Selection:
    """Selects any Gaussians as `select_gaussians` does: each row of the votes stands for itself. Pure."""
    share, known = inside_fraction(votes, match.chosen)
    mask = known & (share >= min_share) & (match.region >= 0)
    return Selection(mask, share, *match[1:])


def trim(field: LanguageField, selection: Selection, keep: str | None) -> tuple[Bool[np.ndarray, " n"], int]:
    """Drops the selected Gaussians that lie apart, as `split_outliers` does; None in `keep` drops none. Host code."""
    if keep is None:
        return np.asarray(selection.mask), 0
    weight = np.clip(np.asarray(selection.similarity), 0.0, 1.0) * np.asarray(field.votes.total)
    return split_outliers(field.gaussians.means, selection.mask, keep=keep, weight=weight)


def query_anchored(field: LanguageField, text_embedding: Float[Array, " e"], *, rules: QueryRules = RULES) -> Selection:
    """Selects the Gaussians of the region that matches a text best, with the regions that belong to it. Pure.

    Args:
      field: The field; close over it to jit or vmap over texts.
      text_embedding: (E,) by the field's embedder.
      rules: How the text matches regions, and regions Gaussians.

    Returns:
      The selection. `region` is -1 and the mask is empty if the text matches no region.

    Raises:
      ValueError: The embedding has another size.
    """
    return query_several(field, text_embedding[None], rules=rules)


def query_region(field: LanguageField, region: Number, *, rules: QueryRules = ONE_REGION) -> Selection:
    """Selects the Gaussians of a region, such as `region_at` returns, as `match_region` matches it. Pure."""
    return select_gaussians(field, match_region(field, region, rules), rules)


def query_several(
    field: LanguageField,
    queries: Float[Array, "q e"],
    excluded: Float[Array, "u e"] | None = None,
    *,
    rules: QueryRules = ALL_OF_CLASS,
) -> Selection:
    """Selects the Gaussians of all regions that match any of several texts and no excluded text. Pure.

    Args:
      field: The field.
      queries: (Q, E) embeddings of the texts, Q >= 1.
      excluded: (U, E) embeddings of texts whose regions are left out (`match_regions`); None is an empty list.
      rules: How texts match regions, by default all regions of a class.

    Returns:
      The selection.

    Raises:
      ValueError: An embedding has another size.
    """
    return select_gaussians(field, match_regions(field, queries, rules, excluded=excluded), rules)
