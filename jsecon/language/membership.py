"""Votes made ready to be asked: the share that each region has of a Gaussian, which every query reads.

    p_nr = w_nr / max(W_nr, LABELLED_PART L_n, SEEN_PART W_n)

with w_nr the weight of region r on Gaussian n (`region_votes`), W_nr the weight with which n was seen in the views that
show r (`with_shown`), L_n that on pixels of any region, and W_n that on all pixels. A view in which the tracker lost a
region, or in which nothing was proposed, does not count against it. The two other terms ask for evidence: a Gaussian
behind the fridge, in the next room, has a trace of weight in the views that show the fridge and most of its weight in
views of its own room. Where the votes do not know which views show a region, all count: p_nr = w_nr / W_n. `share_of`
is the share of several regions together.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import betainc
from jaxtyping import Bool, Float, Int

from jsecon.errors import require
from jsecon.language.regions import ALIKE_THRESHOLD, mean_residuals
from jsecon.numerics import FULL_PRECISION, cosine_matrix
from jsecon.types import Array, Regions, Votes

SHARE_THRESHOLD = 0.5
"""on the share: most of what is seen of the Gaussian, in the views that show the region, lies inside it"""
LABELLED_PART = 0.4
"""least part of a Gaussian's weight in any region that its share is measured against. With SHARE_THRESHOLD a region is
selected where it has a fifth of that weight or more. Measured on replica_apartment_0, with masks as they are, lost in
30 to 90 % of the views, and swallowed by their neighbours (experiments/retired.md)"""
SEEN_PART = 0.05
"""the same of its weight on all pixels, for scenes of which only a few things have masks"""
CORRELATION = 0.05
"""between two views' errors: a tracker's loss or a proposal's cut lasts, so that views beyond about 20 add nothing"""
ROWS = 1 << 18
"""Gaussians at a time of columns that are mapped"""
_NO_COLUMNS = ("overflow", "num_regions", "by_view", "overlap")
"""of `Votes`: what has no row for each Gaussian"""
_BLOCK = 1 << 15
"""Gaussians at a time in `with_shown`: what is dense in the regions stays small"""
_WORD = 32
_MOST_WORDS = 8
"""a table of more words is looked up instead of selected from: a lookup costs as much as about eight selections"""


class Share(NamedTuple):
    """How much of each Gaussian lies in some regions."""

    share: Float[Array, " n"]
    """in [0, 1]; 0 where it is not known."""
    known: Bool[Array, " n"]
    """the Gaussian was seen and has votes for these regions, and they are finite."""


def finish_votes(votes: Votes, regions: Regions) -> Votes:
    """`votes` with all that queries read: `with_overlap(with_shown(votes, regions))`."""
    return with_overlap(with_shown(votes, regions))


def with_shown(votes: Votes, regions: Regions, *, alike_threshold: float = ALIKE_THRESHOLD) -> Votes:
    """`votes` with `shown` (N, K), for each vote the weight with which the views that show its region see the Gaussian,
    and without `by_view`, of which it is made.

    Regions that are alike, by `alike_threshold`, are shown together, as queries join them (`is_alike`). The share that
    follows is the object posterior of B3-Seg: weight inside over inside and outside, over the views that
    contain the object. Pure; `by_view` that is mapped is read in blocks. Raises ValueError where the votes were cast
    without `by_view`, or over other views than `regions` knows.
    """
    views = None if votes.by_view is None else votes.by_view.shape[0]
    remedy = "Cast them with region_votes(..., by_view=True)."
    require(views is not None, "with_shown", "votes without the weight of each view", "by_view (T, N)", remedy)
    found = f"{votes.num_regions} regions and {views} views voted, of {regions.pixels.shape}"
    expected = "the pixels (R, T) of the same regions in the same views"
    same = views == regions.pixels.shape[1] and votes.num_regions == regions.count
    require(same, "with_shown", found, expected, "Give the regions that were made from the labels that voted.")
    shows = views_that_show(regions, alike_threshold=alike_threshold)
    count, top = votes.regions.shape
    if not isinstance(votes.by_view, np.memmap):
        return _with_shown(votes, shows, min(_BLOCK, max(count, 1)))
    parts = [np.zeros((0, top), np.float32)]
    for rows in (slice(first, first + _BLOCK) for first in range(0, count, _BLOCK)):
        part = dataclasses.replace(votes_of_rows(votes, rows), by_view=np.asarray(votes.by_view[:, rows]))
        parts.append(np.asarray(_with_shown(part, shows, min(_BLOCK, count - rows.start)).shown))
    return dataclasses.replace(votes, by_view=None, shown=np.concatenate(parts))


def views_that_show(regions: Regions, *, alike_threshold: float = ALIKE_THRESHOLD) -> Bool[Array, "r t"]:
    """(R, T) which views show a region, or one alike to it."""
    apart, known = mean_residuals(jnp.asarray(regions.embeddings))
    alike = cosine_matrix(apart, apart) >= alike_threshold
    alike = (alike & known[:, None] & known[None]) | jnp.eye(regions.count, dtype=bool)
    return (alike.astype(jnp.float32) @ (jnp.asarray(regions.pixels) > 0).astype(jnp.float32)) > 0


@functools.partial(jax.jit, static_argnums=2)
def _with_shown(votes: Votes, shows: Array, block: int) -> Votes:
    by_view, regions = jnp.asarray(votes.by_view), jnp.asarray(votes.regions)
    count = regions.shape[0]

    def one_block(i, shown):
        first = jnp.minimum(i * block, count - block)  # the last block overlaps the one before it
        seen = lax.dynamic_slice_in_dim(by_view, first, block, axis=1)
        wanted = lax.dynamic_slice_in_dim(regions, first, block, axis=0)
        of_regions = jnp.einsum("tn,rt->nr", seen, shows.astype(seen.dtype), precision=FULL_PRECISION)
        rows = jnp.take_along_axis(of_regions, jnp.maximum(wanted, 0), axis=1)
        return lax.dynamic_update_slice_in_dim(shown, jnp.where(wanted >= 0, rows, 0.0), first, axis=0)

    shown = jnp.zeros(regions.shape, by_view.dtype)
    if count and shows.shape[0]:
        shown = lax.fori_loop(0, -(-count // block), one_block, shown)
    return dataclasses.replace(votes, by_view=None, shown=shown)


def with_overlap(votes: Votes) -> Votes:
    """`votes` with `overlap` (R, R), the soft IoU of two regions' Gaussians.

        o_rs = sum_n min(p_nr, p_ns) / sum_n max(p_nr, p_ns)

    with p the shares; 0 for a region without votes. Two pieces that masks cut out of one object in different views
    overlap in its Gaussians; two objects meet only where they touch, and what lies behind all of them is far larger
    than any. Pure; votes that are mapped are read in blocks.
    """
    count = votes.num_regions
    if not isinstance(votes.regions, np.memmap):
        return dataclasses.replace(votes, overlap=_iou(_overlap(jnp.asarray(votes.regions), vote_shares(votes), count)))
    both = jnp.zeros((count, count), jnp.float32)
    for block in vote_blocks(votes):
        both += _overlap(jnp.asarray(block.regions), vote_shares(block), count)
    return dataclasses.replace(votes, overlap=_iou(both))


def vote_blocks(votes: Votes) -> Iterator[Votes]:
    """The votes of ROWS Gaussians after the other, on jax's device; without `by_view` and `overlap`."""
    for first in range(0, votes.regions.shape[0], ROWS):
        yield jax.tree.map(jnp.asarray, votes_of_rows(votes, slice(first, first + ROWS)))


def votes_of_rows(votes: Votes, rows: slice | Int[np.ndarray, " m"]) -> Votes:
    """The votes of some Gaussians, NumPy; without `by_view` and `overlap`."""
    columns = [own.name for own in dataclasses.fields(votes) if own.name not in _NO_COLUMNS]
    own = {name: getattr(votes, name) for name in columns}
    own = {name: None if a is None else np.asarray(a)[rows] for name, a in own.items()}
    return dataclasses.replace(votes, **own, by_view=None, overlap=None)


@functools.partial(jax.jit, static_argnums=2)
def _overlap(regions: Array, share: Array, count: int) -> Array:
    """(R, R) sum_n min(p_nr, p_ns), of each n at [r, s] where r is the stronger of the two."""
    sound = (regions >= 0) & (regions < count) & jnp.isfinite(share)
    place, share = jnp.where(sound, regions, count).T, jnp.where(sound, share, 0.0).T  # one past the end: dropped
    first, second = jnp.triu_indices(regions.shape[1])

    def add(n, both):
        j, k = first[n], second[n]
        return both.at[place[j], place[k]].add(jnp.minimum(share[j], share[k]), mode="drop")

    return lax.fori_loop(0, len(first), add, jnp.zeros((count, count), share.dtype))


@jax.jit
def _iou(both: Array) -> Array:
    size = jnp.diagonal(both)
    both = jnp.where(jnp.eye(len(both), dtype=bool), both, both + both.T)
    either = size[:, None] + size - both
    return jnp.where(either > 0, jnp.minimum(both / jnp.where(either > 0, either, 1.0), 1.0), 0.0)


@jax.jit
def vote_shares(votes: Votes) -> Float[Array, "n k"]:
    """The share p_nr of each vote (N, K), in [0, 1]: 0 where there is none, NaN where its numbers are not finite."""
    seen = votes.total[:, None] if votes.shown is None else jnp.maximum(votes.shown, _least_seen(votes)[:, None])
    return ratio(jnp.where(votes.regions >= 0, votes.weights, 0.0), jnp.where(votes.regions >= 0, seen, 0.0))


def vote_columns(votes: Votes) -> Iterator[tuple[Int[Array, " n"], Float[Array, " n"], Float[Array, " n"]]]:
    """r (N,), w_nr (N,) and what that is a share of (N,), for every Gaussian's k-th vote, k = 1 to K. r is -1 where
    there is no vote. For compiled code.

    Column by column: a reduction over short rows does not vectorise (1 million Gaussians of 8 votes: 27 ms against 4).
    """
    least = _least_seen(votes)
    for k in range(votes.regions.shape[1]):
        seen = votes.total if votes.shown is None else jnp.maximum(votes.shown[:, k], least)
        yield votes.regions[:, k], votes.weights[:, k], seen


def _least_seen(votes: Votes) -> Array:
    """(N,) the least weight that any share of a Gaussian is measured against."""
    return jnp.maximum(LABELLED_PART * votes.labelled, SEEN_PART * votes.total)


def ratio(weight: Array, seen: Array) -> Array:
    """weight / seen in [0, 1]; 0 where nothing was seen, NaN where a number is not finite."""
    share = jnp.where(seen > 0, jnp.clip(weight / jnp.where(seen > 0, seen, 1.0), 0.0, 1.0), 0.0)
    return jnp.where(jnp.isfinite(weight) & jnp.isfinite(seen), share, jnp.nan)


@jax.jit
def share_of(votes: Votes, chosen: Bool[Array, " r"]) -> Share:
    """The share (N,) of the chosen regions (R,) in each Gaussian, and where it is known (N,).

        p_n = min(sum_r w_nr / max(max_r W_nr, LABELLED_PART L_n, SEEN_PART W_n), 1)

    with r the chosen regions among the K that n has votes for. The largest W_nr is that of all views that show any of
    them, where one is shown wherever the others are, and no more elsewhere. Not known are Gaussians that no view sees,
    without a vote for a chosen region, or with one that is not finite. Pure; differentiable in the votes' weights.
    """
    inside, weight = _lookup(chosen), jnp.zeros(votes.total.shape, votes.weights.dtype)
    seen = jnp.zeros_like(weight)
    for region, own_weight, own_seen in vote_columns(votes):
        here = inside(region)
        weight += jnp.where(here, own_weight, 0.0)
        seen = jnp.maximum(seen, jnp.where(here, own_seen, 0.0))
    known = (votes.views > 0) & (seen > 0) & jnp.isfinite(seen) & jnp.isfinite(weight)
    # Written out, not by `ratio`: XLA then keeps the two sums instead of gathering them anew for each use.
    return Share(jnp.where(known, jnp.clip(weight / jnp.where(known, seen, 1.0), 0.0, 1.0), 0.0), known)


def _lookup(chosen: Bool[Array, " r"]) -> Callable[[Array], Array]:
    """Tells of regions (N,) which are chosen. The chosen ones are bits of a few words that stay in registers: half the
    time of a table."""
    count = chosen.shape[0]
    words = -(-max(count, 1) // _WORD)
    bits = jnp.pad(chosen, (0, words * _WORD - count)).reshape(words, _WORD).astype(jnp.uint32)
    table = jnp.sum(bits << jnp.arange(_WORD, dtype=jnp.uint32), axis=-1, dtype=jnp.uint32)

    def inside(region: Array) -> Array:
        place = jnp.clip(region, 0, max(count - 1, 0))
        if words <= _MOST_WORDS:
            word = jnp.full(place.shape, table[0])
            for i in range(1, words):
                word = jnp.where(place >= _WORD * i, table[i], word)
        else:
            word = table[place // _WORD]
        return (((word >> (place % _WORD).astype(jnp.uint32)) & 1) > 0) & (region == place)

    return inside


def membership_probability(
    share: Float[Array, " n"], votes: Votes, *, correlation: float = CORRELATION
) -> Float[Array, " n"]:
    """(N,) probability that most of a Gaussian belongs to what was selected, in [0, 1]; 0 where it was never seen.

    `share` (N,) is what a query by votes returns as similarity (`share_of`). Taken as draws of views, of which n count
    as independent (of all that see the Gaussian), the true part has the posterior
    Beta(1 + n share, 1 + n (1 - share)) under a flat prior, and the probability is what of it lies above one half. n is
    the number of views, at most the Gaussian's weight in pixels (a glimpse of a tenth of a pixel is no whole look),
    damped by `correlation` r to n / (1 + (n - 1) r). So 0.9 of one view's weight and 0.9 of twenty views' are not the
    same answer. Pure; under jit and vmap.
    """
    return _probability(jnp.asarray(share), jnp.asarray(votes.views), jnp.asarray(votes.total), correlation)


def probability_inside(share: Float[Array, " n"], votes: Votes, mask: Bool[Array, " n"]) -> Float[np.ndarray, " m"]:
    """`membership_probability` of the M Gaussians of `mask` (N,) alone. Host code; a few sizes are compiled for."""
    chosen = np.flatnonzero(np.asarray(mask))
    rows = np.resize(chosen, 1 << max(len(chosen) - 1, 0).bit_length()) if len(chosen) else np.zeros(1, int)
    picked = (np.asarray(a)[rows] for a in (share, votes.views, votes.total))
    return np.asarray(_probability(*picked, CORRELATION))[: len(chosen)]


@jax.jit
def _probability(share: Array, views: Array, total: Array, correlation: Array | float) -> Array:
    sound = (views > 0) & jnp.isfinite(share) & jnp.isfinite(total) & (total > 0)
    looks = jnp.where(sound, jnp.minimum(views.astype(share.dtype), total), 1.0)
    looks = looks / (1 + jnp.maximum(looks - 1, 0.0) * correlation)
    inside = jnp.clip(jnp.where(sound, share, 0.5), 0.0, 1.0) * looks
    # 1 - I_{1/2}(a, b) = I_{1/2}(b, a), without the cancellation.
    return jnp.where(sound, betainc(1 + looks - inside, 1 + inside, 0.5), 0.0)
