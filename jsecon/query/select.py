"""Which Gaussians belong to matched regions, and the short forms from a text to Gaussians. Pure functions."""

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from jsecon.errors import require_one_of, require_shape
from jsecon.field.membership import SHARE_THRESHOLD, inside_fraction
from jsecon.field.similarity import Number, UnitCodes, similarities
from jsecon.paper.codes import CODE_THRESHOLD
from jsecon.programs import stored_jit
from jsecon.query.match import ONE_REGION, RULES, RegionMatch, match_region, match_regions
from jsecon.query.rules import QueryRules
from jsecon.types import Array, LanguageField, Selection, Votes

THRESHOLDS = {"votes": SHARE_THRESHOLD, "code": CODE_THRESHOLD}
"""Default threshold of each way to choose Gaussians."""
ALL_OF_KIND = QueryRules(all_of_kind=True)
"""Rules of `query_several`."""


def query_anchored(
    field: LanguageField,
    text_embedding: Float[Array, " e"],
    *,
    rules: QueryRules = RULES,
    by: str = "votes",
    similarity_threshold: Number | None = None,
    codes: UnitCodes | None = None,
) -> Selection:
    """Selects the Gaussians of the region that matches a text best (the paper's GT-anchored query).

    The gap between a text's and an image's embedding is crossed once, among R regions, where only the order matters.
    The Gaussians are then compared with a region, so almost any threshold does.

    Args:
      field: The field; close over it to jit or vmap over texts.
      text_embedding: (E,) by the field's embedder.
      rules: How the text matches regions (`match_regions`).
      by: "votes" or "code", see `select_gaussians`.
      similarity_threshold: Smallest similarity; None takes 0.5 for votes and 0.9 for codes.
      codes: `unit_codes(field.codes)`, made once for many queries by "code".

    Returns:
      The selection. `region` is -1 and the mask is empty if the text matches no region.

    Raises:
      ValueError: The embedding has another size, or `by` is unknown.
    """
    size = field.regions.embeddings.shape[1]
    remedy = f"Embed the text with the field's embedder{f', {field.embedder}' if field.embedder else ''}."
    require_shape("text_embedding", text_embedding, (size,), remedy)
    match = match_regions(field, jnp.asarray(text_embedding)[None], rules)
    return select_gaussians(field, match, by, similarity_threshold=similarity_threshold, codes=codes)


def query_several(
    field: LanguageField,
    queries: Float[Array, "q e"],
    excluded: Float[Array, "u e"] | None = None,
    *,
    rules: QueryRules = ALL_OF_KIND,
    similarity_threshold: Number | None = None,
) -> Selection:
    """Selects the Gaussians of all regions that match any of the queries and no excluded text, by votes.

    Args:
      field: The field.
      queries: (Q, E) embeddings of the texts, Q >= 1.
      excluded: (U, E) embeddings of texts whose regions are left out (`match_regions`); None is an empty list.
      rules: How texts match regions; by default all regions of a kind match.
      similarity_threshold: Smallest share of votes; None takes 0.5.

    Returns:
      The selection.

    Raises:
      ValueError: An embedding has another size.
    """
    match = match_regions(field, queries, rules, excluded=excluded)
    return select_gaussians(field, match, similarity_threshold=similarity_threshold)


def query_region(
    field: LanguageField,
    region: int | Int[Array, ""],
    *,
    rules: QueryRules = ONE_REGION,
    by: str = "votes",
    similarity_threshold: Number | None = None,
) -> Selection:
    """Selects the Gaussians of region `region`, such as `region_at` returns, with score 1.

    Args:
      field: The field.
      region: Its id. An id that the field does not have, such as -1, selects no Gaussian.
      rules: Which regions join it; by default only that region.
      by: "votes" or "code", see `select_gaussians`.
      similarity_threshold: Smallest similarity; None takes 0.5 for votes and 0.9 for codes.

    Returns:
      The selection.

    Raises:
      ValueError: `by` is unknown.
    """
    return select_gaussians(field, match_region(field, region, rules), by, similarity_threshold=similarity_threshold)


def select_gaussians(
    field: LanguageField,
    match: RegionMatch,
    by: str = "votes",
    *,
    similarity_threshold: Number | None = None,
    codes: UnitCodes | None = None,
) -> Selection:
    """Selects the Gaussians of the matched regions.

    Args:
      field: The field of N Gaussians.
      match: Its regions, from `match_regions`.
      by: "votes": the share of all chosen regions in a Gaussian (`inside_fraction`), an estimate of the probability
        that a pixel of it belongs to them. "code": cosine of its code with that of the best region (the paper).
      similarity_threshold: Smallest similarity of a selected Gaussian; None takes 0.5 for votes and 0.9 for codes.
      codes: `unit_codes(field.codes)`, made once for many queries by "code".

    Returns:
      The selection. Gaussians that no view sees, without a code, or with numbers that are not finite stay out.

    Raises:
      ValueError: `by` is unknown.
    """
    require_one_of("select_gaussians", by, THRESHOLDS, "'votes' is the default.")
    threshold = THRESHOLDS[by] if similarity_threshold is None else similarity_threshold
    if field.regions.count == 0:
        count, dtype = field.codes.shape[0], jnp.asarray(field.codes).dtype
        return Selection(jnp.zeros(count, bool), jnp.zeros(count, dtype), *jax.tree.map(jnp.asarray, match[1:]))
    if by == "votes":
        return select_by_share(jax.tree.map(jnp.asarray, field.votes), match, threshold)
    table, views = jnp.asarray(field.region_codes), jnp.asarray(field.votes.views)
    return select_by_code(field.codes if codes is None else codes, table, views, match, threshold)


@stored_jit
def select_by_share(votes: Votes, match: RegionMatch, threshold: Number) -> Selection:
    """Selects any Gaussians by "votes", as `select_gaussians` does. Pure; each row stands for itself.

    Args:
      votes: Votes of N Gaussians.
      match: The matched regions.
      threshold: Smallest share of the regions.

    Returns:
      The selection of the N Gaussians.
    """
    share, known = inside_fraction(votes, match.chosen)
    mask = known & (share >= threshold) & (match.region >= 0)
    return Selection(mask, share, match.region, match.score, match.quantile, match.confidence)


@jax.jit
def select_by_code(
    codes: Float[Array, "n d"] | UnitCodes,
    region_codes: Float[Array, "r d"],
    views: Int[Array, " n"],
    match: RegionMatch,
    threshold: Number,
) -> Selection:
    """Selects any Gaussians by "code", as `select_gaussians` does. Pure; each row stands for itself.

    Args:
      codes: (N, d) codes of any length, or their `unit_codes`.
      region_codes: (R, d) codes of the regions.
      views: (N,) `Votes.views`; Gaussians that no view sees stay out.
      match: The matched regions, of which only the best counts.
      threshold: Smallest cosine with its code.

    Returns:
      The selection of the N Gaussians.
    """
    similarity, known = similarities(codes, region_codes[jnp.maximum(match.region, 0)])
    known &= (views > 0) & (match.region >= 0)
    mask = known & (similarity >= threshold)
    return Selection(
        mask, jnp.where(known, similarity, 0.0), match.region, match.score, match.quantile, match.confidence
    )
