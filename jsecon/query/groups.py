"""Regions that are one object, regions that are parts of another, and the object of each Gaussian. Pure functions."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from jsecon.field.membership import SHARE_THRESHOLD, ratio, vote_columns
from jsecon.programs import stored_jit
from jsecon.query.match import RULES, match_embedding
from jsecon.query.rules import MIN_PIECE_OVERLAP, QueryRules
from jsecon.types import Array, LanguageField, Votes


class SameObject(NamedTuple):
    """Which pairs of R regions may show one object. Both are symmetric, and true on the diagonal."""

    joined: Bool[Array, "r r"]
    """A query with either region as its text would add the other (`match_region`), and they overlap."""
    alike: Bool[Array, "r r"]
    """They look the same, as two pieces or two objects of a kind do (`alike_threshold`)."""


def same_object(field: LanguageField) -> SameObject:
    """Finds the pairs of regions that show one object by the rules of queries, and those that look as if they did.

    Args:
      field: Field of R regions.

    Returns:
      The pairs. Without `Votes.overlap` no two regions are joined.
    """
    if not field.regions.count:
        return SameObject(jnp.zeros((0, 0), bool), jnp.zeros((0, 0), bool))
    overlap = None if field.votes.overlap is None else jnp.asarray(field.votes.overlap)
    return SameObject(*_same_object(jnp.asarray(field.regions.embeddings), overlap))


@stored_jit
def _same_object(embeddings: Array, overlap: Array | None) -> tuple[Array, Array]:
    """Returns the pairs of `same_object` of regions by their embeddings and overlap."""
    ids = jnp.arange(len(embeddings))
    itself = ids[:, None] == ids

    def matched(rules: QueryRules) -> Array:
        chosen = jax.vmap(lambda region: match_embedding(embeddings, overlap, region, rules).chosen)(ids)
        return chosen & chosen.T

    alike = itself | matched(dataclasses.replace(RULES, piece_threshold=None))
    if overlap is None:
        return itself, alike
    return itself | (matched(RULES) & (overlap >= MIN_PIECE_OVERLAP)), alike


@stored_jit
def containment(overlap: Float[Array, "r r"], size: Float[Array, " r"]) -> Float[Array, "r r"]:
    """Computes how much of a region lies in another: sum_n min(p_nr, p_ns) / sum_n p_nr, with p the shares.

    Args:
      overlap: (R, R) soft IoU (`Votes.overlap`).
      size: (R,) sum of each region's shares.

    Returns:
      (R, R) of each region in row r, its part in region s; 0 for a region without votes.
    """
    both = overlap * (size[:, None] + size) / (1 + overlap)
    return jnp.where(size[:, None] > 0, both / jnp.where(size > 0, size, 1.0)[:, None], 0.0)


@stored_jit
def objects_of_gaussians(votes: Votes, objects: Int[Array, " r"]) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
    """Assigns each Gaussian to the object with the largest share in it.

    The share is that of all regions of the object together (`inside_fraction`), so a query for exactly these regions
    selects the same Gaussians, and those that belong to another object even more.

    Args:
      votes: Votes of N Gaussians on R regions.
      objects: (R,) object of each region, -1 for no object.

    Returns:
      (N,) object, -1 for shares below SHARE_THRESHOLD, and (N,) its share; 0 without votes. Each row stands for itself.
    """
    columns = list(vote_columns(votes))
    owners = [jnp.where(region >= 0, objects[jnp.maximum(region, 0)], -1) for region, _, _ in columns]
    best_share = jnp.zeros(votes.total.shape, votes.weights.dtype)
    best = jnp.full(votes.total.shape, -1, jnp.int32)
    for owner in owners:
        weight = functools.reduce(
            jnp.add, (jnp.where(other == owner, columns[k][1], 0.0) for k, other in enumerate(owners))
        )
        seen = functools.reduce(
            jnp.maximum, (jnp.where(other == owner, columns[k][2], 0.0) for k, other in enumerate(owners))
        )
        share = jnp.nan_to_num(ratio(weight, seen))
        better = (owner >= 0) & (votes.views > 0) & (share > best_share)
        best, best_share = jnp.where(better, owner, best), jnp.where(better, share, best_share)
    return jnp.where(best_share >= SHARE_THRESHOLD, best, -1).astype(jnp.int32), best_share
