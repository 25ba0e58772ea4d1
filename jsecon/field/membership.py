"""The share that each region has in a Gaussian, from its votes: what every query by votes reads. Pure functions.

    p_nr = w_nr / max(W_nr, LABELLED_PART L_n, SEEN_PART W_n)

with w_nr the weight of region r on Gaussian n (`region_votes`), W_nr the weight with which n was seen in the views that
show r (`normalise_votes`), L_n that on pixels of any region, and W_n that on all pixels. A view in which the tracker
lost a region, or in which nothing was proposed, does not count against it. The two other terms ask for evidence: a
Gaussian behind the fridge, in the next room, has a trace of weight in the views that show the fridge and most of its
weight in views of its own room. Where the votes do not know which views show a region, all count: p_nr = w_nr / W_n.
`inside_fraction` is the share of several regions together.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax import lax
from jaxtyping import Bool, Float, Int

from jsecon.errors import require
from jsecon.field.columns import ROWS, is_mapped, row_slices, votes_of_rows
from jsecon.field.regions import DUPLICATE_COSINE, mean_residuals
from jsecon.numerics import FULL_PRECISION, array_module, cosine_matrix, inline_jit
from jsecon.process import cores
from jsecon.programs import stored_jit
from jsecon.types import Array, Regions, Votes

SHARE_THRESHOLD = 0.5
"""Share from which a Gaussian is selected: most of what the views of the region see of it lies inside."""
LABELLED_PART = 0.4
"""Smallest part of a Gaussian's weight in any region that its share is measured against. With SHARE_THRESHOLD a region
is selected where it has a fifth of that weight or more. Measured on replica_apartment_0, with masks as they are, lost
in 30 to 90 % of the views, and swallowed by their neighbours."""
SEEN_PART = 0.05
"""The same of its weight on all pixels, for scenes of which only a few objects have masks."""
VIEWS = 16
"""Number of which that of views is made a multiple."""
CORRELATION = 0.05
"""Correlation of two views' errors: a tracker's loss or a proposal's cut lasts, so views beyond about 20 add little."""


class _InsideFraction(NamedTuple):
    """How much of each Gaussian lies in some regions."""

    fraction: Float[Array, " n"]
    """In [0, 1]; 0 where it is not known."""
    known: Bool[Array, " n"]
    """The Gaussian was seen, and has finite votes for these regions."""


def normalise_votes(votes: Votes, regions: Regions) -> Votes:
    """Adds what queries read to votes that were cast `by_view`. Pure; memory-mapped votes are read in blocks.

    Args:
      votes: Votes of N Gaussians, cast `by_view`.
      regions: Regions made from the labels that voted.

    Returns:
      The votes with `weight_where_region_visible` (N, K) and `overlap` (R, R), without `by_view`.

    Raises:
      ValueError: The votes have no `by_view`, or other views than `regions`.
    """
    if not is_mapped(votes):
        return with_overlap(_add_visible_weight(*_pad_views(votes, regions)))
    shows = _views_that_show(regions)
    sums = jnp.zeros((regions.count, regions.count), jnp.float32)
    visible = [np.zeros((0, votes.regions.shape[1]), np.float32)]
    for rows in row_slices(votes, len(votes.views)):
        block = dataclasses.replace(votes_of_rows(votes, rows), by_view=np.asarray(_by_view(votes, regions)[:, rows]))
        block = _sum_visible_weight(block, shows)
        sums += _overlap_sums(jnp.asarray(block.regions), vote_shares(block), regions.count)
        visible.append(np.asarray(block.weight_where_region_visible))
    visible = np.concatenate(visible)
    return dataclasses.replace(votes, by_view=None, weight_where_region_visible=visible, overlap=_soft_iou(sums))


def _pad_views(votes: Votes, regions: Regions) -> tuple[Votes, Regions]:
    """Adds views that show nothing, up to a multiple of VIEWS: fields of about as many views share their programs."""
    by_view = _by_view(votes, regions)
    missing = -by_view.shape[0] % VIEWS
    by_view = array_module(by_view).pad(by_view, [(0, missing), (0, 0)])
    pixels = array_module(regions.pixel_counts).pad(regions.pixel_counts, [(0, 0), (0, missing)])
    return dataclasses.replace(votes, by_view=by_view), dataclasses.replace(regions, pixel_counts=pixels)


def _add_visible_weight(votes: Votes, regions: Regions) -> Votes:
    """Replaces `by_view` by the weight with which the views that show a vote's region see the Gaussian. Pure.

    The share that follows is the object posterior of B3-Seg: weight inside over inside and outside, over the views that
    contain the object.
    """
    return _sum_visible_weight(dataclasses.replace(votes, by_view=_by_view(votes, regions)), _views_that_show(regions))


def _by_view(votes: Votes, regions: Regions) -> Array:
    """The weight of each view; ValueError without it, or if other regions or views voted."""
    views = None if votes.by_view is None else votes.by_view.shape[0]
    remedy = "Cast them with region_votes(..., by_view=True)."
    require(views is not None, "normalise_votes", "votes without the weight of each view", "by_view (T, N)", remedy)
    sizes = f"{votes.num_regions} regions and {views} views voted, of {regions.pixel_counts.shape}"
    expected = "the pixels (R, T) of the same regions in the same views"
    same = views == regions.pixel_counts.shape[1] and votes.num_regions == regions.count
    require(same, "normalise_votes", sizes, expected, "Give the regions that were made from the labels that voted.")
    return cast(Array, votes.by_view)


@inline_jit
def _views_that_show(regions: Regions) -> Bool[Array, "r t"]:
    """Finds the views (R, T) that show a region, or one that is alike: regions that queries join are shown together."""
    apart, known = mean_residuals(regions.embeddings)
    alike = cosine_matrix(apart, apart) >= DUPLICATE_COSINE
    alike = (alike & known[:, None] & known[None]) | np.eye(regions.count, dtype=bool)
    return (alike.astype(np.float32) @ (regions.pixel_counts > 0).astype(np.float32)) > 0


def _sum_visible_weight(votes: Votes, shows: Bool[Array, "r t"]) -> Votes:
    """Replaces `by_view` by `weight_where_region_visible`, with the (R, T) views that show a region."""
    visible = _visible_weight(jnp.asarray(votes.by_view), jnp.asarray(votes.regions), shows)
    return dataclasses.replace(votes, by_view=None, weight_where_region_visible=visible)


@stored_jit
def _visible_weight(
    by_view: Float[Array, "t n"], regions: Int[Array, "n k"], shows: Bool[Array, "r t"]
) -> Float[Array, "n k"]:
    """Sums the weight of each Gaussian over the views that show each of its regions, Gaussian by Gaussian."""
    count = regions.shape[0]
    block = min(1 << 15, max(count, 1))  # its arrays are dense in the regions

    def one_block(i, shown):
        first = jnp.minimum(i * block, count - block)  # the last block overlaps the one before it
        seen = lax.dynamic_slice_in_dim(by_view, first, block, axis=1)
        ids = lax.dynamic_slice_in_dim(regions, first, block, axis=0)
        of_regions = jnp.einsum("tn,rt->nr", seen, shows.astype(seen.dtype), precision=FULL_PRECISION)
        rows = jnp.take_along_axis(of_regions, jnp.maximum(ids, 0), axis=1)
        return lax.dynamic_update_slice_in_dim(shown, jnp.where(ids >= 0, rows, 0.0), first, axis=0)

    shown = jnp.zeros(regions.shape, by_view.dtype)
    if count and shows.shape[0]:
        shown = lax.fori_loop(0, -(-count // block), one_block, shown)
    return shown


def with_overlap(votes: Votes) -> Votes:
    """Adds `overlap` (R, R), the soft IoU of two regions' Gaussians. Pure.

        o_rs = sum_n min(p_nr, p_ns) / sum_n max(p_nr, p_ns)

    with p the shares; 0 for a region without votes. Two pieces that masks cut out of one object in different views
    overlap in its Gaussians; two objects meet only where they touch, and what lies behind all of them is far larger
    than any.
    """
    sums = _overlap_sums(jnp.asarray(votes.regions), vote_shares(votes), votes.num_regions)
    return dataclasses.replace(votes, overlap=_soft_iou(sums))


@functools.partial(stored_jit, static_argnums=(2,))
def _overlap_sums(regions: Int[Array, "n k"], share: Float[Array, "n k"], count: int) -> Float[Array, "r r"]:
    """Sums min(p_nr, p_ns) over n to (R, R); for each n at [r, s] where r is the stronger of the two."""
    valid = (regions >= 0) & (regions < count) & jnp.isfinite(share)
    place, share = jnp.where(valid, regions, count).T, jnp.where(valid, share, 0.0).T  # one past the end: dropped
    first, second = jnp.triu_indices(regions.shape[1])

    def add(n, both):
        j, k = first[n], second[n]
        return both.at[place[j], place[k]].add(jnp.minimum(share[j], share[k]), mode="drop")

    return lax.fori_loop(0, len(first), add, jnp.zeros((count, count), share.dtype))


@stored_jit
def _soft_iou(both: Float[Array, "r r"]) -> Float[Array, "r r"]:
    """Computes the overlap of `with_overlap` from the sums, which add up over blocks of Gaussians."""
    size = jnp.diagonal(both)
    both = jnp.where(jnp.eye(len(both), dtype=bool), both, both + both.T)
    either = size[:, None] + size - both
    return jnp.where(either > 0, jnp.minimum(both / jnp.where(either > 0, either, 1.0), 1.0), 0.0)


@stored_jit
def vote_shares(votes: Votes) -> Float[Array, "n k"]:
    """Computes the share p_nr of each vote (N, K): 0 without a vote, NaN if its numbers are not finite. Pure."""
    visible = votes.weight_where_region_visible
    seen = votes.total[:, None] if visible is None else jnp.maximum(visible, _least_seen(votes)[:, None])
    return ratio(jnp.where(votes.regions >= 0, votes.weights, 0.0), jnp.where(votes.regions >= 0, seen, 0.0))


def vote_columns(votes: Votes) -> Iterator[tuple[Int[Array, " n"], Float[Array, " n"], Float[Array, " n"]]]:
    """Iterates over every Gaussian's k-th vote: region, -1 without a vote; weight w_nr; and what this is a share of.

    Column by column: a reduction over short rows does not vectorise (1 million Gaussians of 8 votes: 27 ms against 4).
    """
    least, visible = _least_seen(votes), votes.weight_where_region_visible
    for k in range(votes.regions.shape[1]):
        seen = votes.total if visible is None else array_module(visible).maximum(visible[:, k], least)
        yield votes.regions[:, k], votes.weights[:, k], seen


def _least_seen(votes: Votes) -> Array:
    """(N,) the least weight that any share of a Gaussian is measured against."""
    return array_module(votes.total).maximum(LABELLED_PART * votes.labelled, SEEN_PART * votes.total)


def ratio(weight: Array, seen: Array) -> Array:
    """Divides a weight by what it is a share of: in [0, 1], 0 if that is 0, NaN if a number is not finite. Pure."""
    share = jnp.where(seen > 0, jnp.clip(weight / jnp.where(seen > 0, seen, 1.0), 0.0, 1.0), 0.0)
    return jnp.where(jnp.isfinite(weight) & jnp.isfinite(seen), share, jnp.nan)


@jax.jit
def inside_fraction(votes: Votes, chosen: Bool[Array, " r"]) -> _InsideFraction:
    """Computes the share of several regions together in each Gaussian. Pure; differentiable in the votes' weights.

        p_n = min(sum_r w_nr / max(max_r W_nr, LABELLED_PART L_n, SEEN_PART W_n), 1)

    with r the chosen regions among the K that n has votes for. The largest W_nr is that of all views that show any of
    them, where one is shown wherever the others are, and no more elsewhere. It is not known for Gaussians that no view
    sees, that have no vote for a chosen region, or whose votes are not finite.
    """
    return _add_columns(votes, _lookup(chosen))


def _add_columns(votes: Votes, inside: Callable[[Array], Array]) -> _InsideFraction:
    """Computes `inside_fraction` of the regions that are `inside`."""
    xp = array_module(votes.weights)
    weight, seen = xp.zeros((2, *votes.total.shape), votes.weights.dtype)
    for region, region_weight, region_seen in vote_columns(votes):
        is_inside = inside(region)
        weight += xp.where(is_inside, region_weight, 0.0)
        seen = xp.maximum(seen, xp.where(is_inside, region_seen, 0.0))
    known = (votes.views > 0) & (seen > 0) & xp.isfinite(seen) & xp.isfinite(weight)
    # Written out, not by `ratio`: XLA then keeps the two sums instead of gathering them anew for each use.
    return _InsideFraction(xp.where(known, xp.clip(weight / xp.where(known, seen, 1.0), 0.0, 1.0), 0.0), known)


def inside_fraction_of_regions(votes: Votes, regions: Sequence[int] | np.ndarray) -> _InsideFraction:
    """Computes the same bits as `inside_fraction` with NumPy: it compiles no program. Host code.

    Mapped votes stay on disk: columns but that of the regions are read only where a Gaussian has a vote for one of
    these.
    """
    votes = jax.tree.map(np.asarray, votes)
    count, places = votes.regions.shape
    fraction, known = np.zeros(count, votes.weights.dtype), np.zeros(count, bool)
    chosen = np.zeros(votes.num_regions + 1, bool)  # the last is that of no vote, -1
    chosen[regions] = True

    def add(first: int) -> None:
        voted = np.take(chosen, votes.regions[first : first + ROWS], mode="wrap")  # any further id is looked at below
        rows = first + np.unique(np.flatnonzero(voted) // places)
        inside = _add_columns(votes_of_rows(votes, rows), lambda region: np.isin(region, regions))
        fraction[rows], known[rows] = inside

    with ThreadPoolExecutor(cores()) as pool:
        list(pool.map(add, range(0, count, ROWS)))
    return _InsideFraction(fraction, known)


def _lookup(chosen: Bool[Array, " r"]) -> Callable[[Array], Array]:
    """A function from region ids (N,) to whether they are chosen.

    The chosen ones are bits of a few words that stay in registers: half the time of a table.
    """
    count, word_size = chosen.shape[0], 32
    words = -(-max(count, 1) // word_size)
    bits = jnp.pad(chosen, (0, words * word_size - count)).reshape(words, word_size).astype(jnp.uint32)
    table = jnp.sum(bits << jnp.arange(word_size, dtype=jnp.uint32), axis=-1, dtype=jnp.uint32)

    def inside(region: Array) -> Array:
        place = jnp.clip(region, 0, max(count - 1, 0))
        if words <= 8:  # selections are cheaper than a lookup
            word = jnp.full(place.shape, table[0])
            for i in range(1, words):
                word = jnp.where(place >= word_size * i, table[i], word)
        else:
            word = table[place // word_size]
        return (((word >> (place % word_size).astype(jnp.uint32)) & 1) > 0) & (region == place)

    return inside


def membership_probability(share: Float[Array, " n"], votes: Votes) -> Float[np.ndarray, " n"]:
    """Computes the probability that most of a Gaussian belongs to what was selected. Host code.

    Views are draws, of which n count as independent. Under a flat prior the true part has the posterior Beta(1 + n
    share, 1 + n (1 - share)), and the probability is its mass above one half. n is the number of views, at most the
    Gaussian's weight in pixels, damped by r = CORRELATION to n / (1 + (n - 1) r). So 0.9 of one view's weight is less
    certain than 0.9 of twenty views'.

    Args:
      share: (N,) in [0, 1], similarity of a query by votes (`inside_fraction`).
      votes: Votes of the N Gaussians.

    Returns:
      (N,) in [0, 1]; 0 for Gaussians that were never seen.
    """
    share, views, total = (np.asarray(column) for column in (share, votes.views, votes.total))
    known = (views > 0) & np.isfinite(share) & np.isfinite(total) & (total > 0)
    count = np.where(known, np.minimum(views.astype(share.dtype), total), 1)
    count = count / (1 + np.maximum(count - 1, 0) * CORRELATION)
    inside = np.clip(np.where(known, share, 0.5), 0, 1) * count
    # 1 - I_{1/2}(a, b) = I_{1/2}(b, a), without the cancellation.
    return np.where(known, scipy.special.betainc(1 + count - inside, 1 + inside, 0.5), 0)
