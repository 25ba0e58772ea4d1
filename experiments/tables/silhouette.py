"""The Gaussians whose silhouette fits an object best. Host code around compiled parts.

A Gaussian's share (`jsecon.field.membership`) says how much of it belongs to the object; many Gaussians make a
silhouette. A splat that is half the object's fills a hole of it, and spills over at its rim. Here each one is taken or
left by what the outline gains, in expectation, over the views.
"""

import functools
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float

from experiments.protocols.rendered import VALA_THRESHOLD
from jsecon.errors import require_shape
from jsecon.field.membership import SHARE_THRESHOLD
from jsecon.fit.resize import scale_cameras
from jsecon.numerics import MAX_ALPHA, MIN_ALPHA
from jsecon.process import cores
from jsecon.query.selection_masks import ALPHA_THRESHOLD
from jsecon.splat.plan import plan_view, render_plan
from jsecon.splat.scan import pixel_centres, to_tiles
from jsecon.splat.visible import HIDDEN_LOGIT
from jsecon.types import Array, Camera, Gaussians

SILHOUETTE_WEIGHTS = {"silhouette": (2.0, 1.0), "strict_silhouette": (1.0, 0.0), "lenient_silhouette": (0.0, 1.0)}
"""Weights of the expected IoU at ALPHA_THRESHOLD, of what is opaque, and at VALA_THRESHOLD, of all that is visible."""
WEIGHTS = SILHOUETTE_WEIGHTS["silhouette"]
"""The default."""
MIN_CANDIDATE_SHARE = 0.1
"""Share above which a Gaussian may be taken."""
SWEEPS = 3
"""Passes over the candidates."""
VIEWS = 12
"""Views that are rendered, at most."""
LONG_SIDE = 192
"""Largest side of a rendered view, px."""
MAX_CANDIDATES = 8192
"""Gaussians that are decided on, at most: those whose shares are nearest to the threshold."""
_BLOCK = 16
"""(tile, Gaussian) pairs at a time."""


class Footprints(NamedTuple):
    """What C Gaussians absorb, alone, in the pixels of V views: P pairs of a tile and a Gaussian, Gaussian by Gaussian.

    Tiles of all views are counted through; the last is an empty one, to which pairs beyond a Gaussian's last belong.
    """

    absorbed: Float[Array, "p 64"]
    """-log(1 - alpha) of each of the tile's pixels: what several Gaussians absorb together is the sum."""
    tiles: Array
    """(P,) int32."""
    starts: Array
    """(C + 1,) int32 where each Gaussian's pairs begin."""
    inside: Float[Array, "tiles 64"]
    """Expected part of the pixel that is the object's; 0 beyond the image."""
    outside: Float[Array, "tiles 64"]
    """1 - inside; 0 beyond the image."""
    base: Float[Array, "tiles 64"]
    """What Gaussians absorb that are certainly taken."""


def fit_silhouette(
    gaussians: Gaussians,
    cameras: Camera,
    share: Float[Array, " n"],
    *,
    threshold: float = SHARE_THRESHOLD,
    weights: tuple[float, float] = WEIGHTS,
) -> Bool[Array, " n"]:
    """Chooses the Gaussians whose silhouette, rendered alone, fits best what their shares say is the object.

    With pi_v(p) = min(sum_i w_ip s_i, 1) the part of a pixel that is the object's, composited from the shares s through
    the whole scene, and alpha_S(p) the opacity of the Gaussians S rendered alone, it ascends

        mean_v (a E_v(0.7) + b E_v(10 / 255)),  E_v(t) = sum_p pi c / (sum_p pi + sum_p (1 - pi) c),  c = 1[alpha_S > t]

    E is the expected IoU up to the order of mean and ratio. From {s >= `threshold`}, Gaussians with a share above
    MIN_CANDIDATE_SHARE are taken or left one by one, lowest share first, wherever that raises it, SWEEPS times.

    Args:
      gaussians: Scene of N Gaussians.
      cameras: Batch of T views; VIEWS that see the object are rendered, LONG_SIDE px at most, in float32.
      share: (N,) in [0, 1].
      threshold: Smallest share of the Gaussians to start from.
      weights: (a, b). (0, 1) for an outline that must not touch other objects, (1, 0) for the solid core.

    Returns:
      (N,) bool. Not differentiable.

    Raises:
      ValueError: The share has another length.
    """
    require_shape("fit_silhouette", share, (gaussians.count,), "Give one share per Gaussian.")
    share = np.asarray(share, np.float32)
    chosen = share >= threshold
    candidates = np.flatnonzero(share > MIN_CANDIDATE_SHARE)
    if not chosen.any() or not len(candidates):
        return jnp.asarray(chosen)
    candidates = candidates[np.argsort(np.abs(share[candidates] - threshold), kind="stable")[:MAX_CANDIDATES]]
    candidates = candidates[np.argsort(share[candidates], kind="stable")]
    views = choose_views(gaussians, cameras, chosen)
    prints = footprints(gaussians, views, share, candidates, chosen)
    taken = np.zeros(len(prints.starts) - 1, bool)
    taken[: len(candidates)] = chosen[candidates]
    ascended = np.asarray(ascend(prints, jnp.asarray(taken), len(views.fx), len(candidates), jnp.asarray(weights)))
    chosen = chosen.copy()
    chosen[candidates] = ascended[: len(candidates)]
    return jnp.asarray(chosen)


def choose_views(gaussians: Gaussians, cameras: Camera, chosen: np.ndarray) -> Camera:
    """Chooses up to VIEWS cameras, evenly among those whose images hold the most centres of the chosen Gaussians.

    Args:
      gaussians: Scene of N Gaussians.
      cameras: Batch of T cameras.
      chosen: (N,) bool.

    Returns:
      Batch of cameras, LONG_SIDE px at most.
    """
    means = np.asarray(gaussians.means)[chosen]
    poses = np.asarray(cameras.world_to_camera)
    local = np.einsum("tij,nj->tni", poses[:, :3, :3], means) + poses[:, None, :3, 3]
    depth = np.maximum(local[..., 2], 1e-6)
    column = local[..., 0] / depth * np.asarray(cameras.fx)[:, None] + np.asarray(cameras.cx)[:, None]
    row = local[..., 1] / depth * np.asarray(cameras.fy)[:, None] + np.asarray(cameras.cy)[:, None]
    inside = (local[..., 2] > 0) & (column >= 0) & (column < cameras.width) & (row >= 0) & (row < cameras.height)
    count = inside.sum(1)
    good = np.flatnonzero(count >= 0.5 * count.max())
    picked = good[np.round(np.linspace(0, len(good) - 1, min(VIEWS, len(good)))).astype(int)]
    size = min(LONG_SIDE / max(cameras.width, cameras.height), 1.0)
    return scale_cameras(jax.tree.map(np.asarray, cameras)[picked], size)


def footprints(
    gaussians: Gaussians, views: Camera, share: np.ndarray, candidates: np.ndarray, chosen: np.ndarray
) -> Footprints:
    """Computes what Gaussians absorb in views, padded so that texts share their programs. Host code.

    Args:
      gaussians: Scene of N Gaussians.
      views: Batch of V cameras.
      share: (N,) in [0, 1].
      candidates: (C,) ids of the Gaussians that are decided on.
      chosen: (N,) bool; those of them that are not candidates are certainly taken.

    Returns:
      The footprints of the candidates.
    """
    # One precision for all: jax.enable_x64 holds in its own thread alone, and views are planned in several.
    gaussians, views = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), (gaussians, views))
    rows = _padded(len(candidates))
    certain = chosen.copy()
    certain[candidates] = False
    part = _rows(gaussians, candidates, rows)
    rest = np.flatnonzero(certain)
    rest_of = _rows(gaussians, rest, _padded(len(rest))) if len(rest) else None
    shares = jnp.broadcast_to(jnp.asarray(share)[:, None], (len(share), 3))

    def seen_from(t: int) -> tuple[np.ndarray, ...]:
        camera = views[t]
        image = jnp.clip(render_plan(plan_view(gaussians, camera), shares).features[..., 0], 0.0, 1.0)
        tile = plan_view(part, camera)
        edge, number = tile.lists.tile, len(tile.lists.lengths)
        lengths, starts = np.asarray(tile.lists.lengths), np.asarray(tile.lists.starts)
        of_tile = np.repeat(np.arange(number), lengths)
        place = np.arange(len(of_tile)) - np.repeat(np.cumsum(lengths) - lengths, lengths) + starts[of_tile]
        ids = np.asarray(tile.lists.gaussians)[place]
        size = _padded(len(ids))
        pairs = (np.pad(a, (0, size - len(a))) for a in (ids, of_tile))
        absorbed = np.asarray(_absorbed(tile.splats, *pairs, -(-views.width // edge), edge))[: len(ids)]
        seen = absorbed.max(1, initial=0) > 0
        in_image = np.asarray(to_tiles(jnp.ones_like(image), edge))[:-1]
        expected = np.asarray(to_tiles(image, edge))[:-1]
        certainly = np.zeros_like(expected)
        if rest_of is not None:
            alpha = render_plan(plan_view(rest_of, camera), jnp.zeros((rest_of.count, 1), jnp.float32)).alpha
            certainly = np.asarray(to_tiles(-jnp.log(jnp.maximum(1 - alpha, 1e-6)), edge))[:-1]
        return absorbed[seen], of_tile[seen] + t * number, ids[seen], expected, in_image - expected, certainly

    with ThreadPoolExecutor(cores()) as pool:  # a view's lists are sorted on one core
        values, tiles, owners, inside, outside, base = zip(*pool.map(seen_from, range(len(views.fx))), strict=True)
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    begin = np.searchsorted(owner[order], np.arange(rows + 1)).astype(np.int32)
    size, empty = _padded(len(order) + _BLOCK), len(views.fx) * len(inside[0])

    def fill(a, value):
        return np.concatenate([a, np.full((size - len(a), *a.shape[1:]), value, a.dtype)])

    def last(parts):
        return np.concatenate([*parts, np.zeros((1, parts[0].shape[1]), np.float32)])

    return Footprints(
        fill(np.concatenate(values)[order], 0.0),
        fill(np.concatenate(tiles)[order].astype(np.int32), empty),
        begin,
        last(inside),
        last(outside),
        last(base),
    )


def _padded(count: int) -> int:
    return 1 << max(count - 1, 255).bit_length()


def _rows(gaussians: Gaussians, chosen: np.ndarray, rows: int) -> Gaussians:
    """Only these Gaussians, then copies of the first that are not seen."""
    place = np.concatenate([chosen, np.full(rows - len(chosen), chosen[0])])
    taken = jax.tree.map(lambda a: np.asarray(a)[place], gaussians)
    taken.opacity_logits[len(chosen) :] = HIDDEN_LOGIT
    return taken


@functools.partial(jax.jit, static_argnums=(3, 4))
def _absorbed(splats: Array, ids: Array, tiles: Array, across: int, edge: int) -> Array:
    x, y, l11, l21, l22, opacity = (column[:, None] for column in splats[ids].T)
    columns, rows = pixel_centres(edge, splats.dtype)
    across_px, down_px = (tiles % across * edge)[:, None] + columns - x, (tiles // across * edge)[:, None] + rows - y
    alpha = opacity * jnp.exp(-((l11 * across_px + l21 * down_px) ** 2) - (l22 * down_px) ** 2)
    return -jnp.log1p(-jnp.where(alpha >= MIN_ALPHA, jnp.minimum(alpha, MAX_ALPHA), 0.0))


@functools.partial(jax.jit, static_argnums=2)
def ascend(
    prints: Footprints,
    taken: Bool[Array, " c"],
    views: int,
    count: int | Array,
    weights: Float[Array, " 2"] | tuple[float, float] = WEIGHTS,
) -> Bool[Array, " c"]:
    """Computes which candidates are selected after SWEEPS sweeps, see `fit_silhouette`. Pure.

    Args:
      prints: Footprints of C Gaussians.
      taken: (C,) those that are selected before.
      views: V, number of views.
      count: Number of Gaussians that the sweeps go over, the first ones.
      weights: (a, b) of `fit_silhouette`.

    Returns:
      (C,) bool.
    """
    prints = jax.tree.map(jnp.asarray, prints)
    levels = jnp.asarray([-np.log1p(-t) for t in (ALPHA_THRESHOLD, VALA_THRESHOLD)], prints.absorbed.dtype)
    worth = jnp.asarray(weights, levels.dtype)
    per_view = (prints.inside.shape[0] - 1) // views

    def by_view(image):
        return image[:-1].reshape(views, -1).sum(1)

    whole = by_view(prints.inside)

    def place(c, first):
        pair = first + lax.iota(jnp.int32, _BLOCK)
        inside = pair < prints.starts[c + 1]
        values = jnp.where(inside[:, None], lax.dynamic_slice_in_dim(prints.absorbed, first, _BLOCK), 0.0)
        return jnp.where(
            inside, lax.dynamic_slice_in_dim(prints.tiles, first, _BLOCK), prints.inside.shape[0] - 1
        ), values

    def blocks(c, step, carry):
        def onward(state):
            return (state[0] + _BLOCK, step(*place(c, state[0]), state[1]))

        return lax.while_loop(lambda state: state[0] < prints.starts[c + 1], onward, (prints.starts[c], carry))[1]

    def add_up(c, level):
        weight = jnp.where(taken[c], 1.0, 0.0).astype(level.dtype)
        return blocks(c, lambda tiles, values, level: level.at[tiles].add(weight * values), level)

    level = lax.fori_loop(0, taken.shape[0], add_up, prints.base)
    covered = [level > threshold for threshold in levels]
    hit = jnp.stack([by_view(jnp.where(c, prints.inside, 0.0)) for c in covered])  # (2, V)
    spilt = jnp.stack([by_view(jnp.where(c, prints.outside, 0.0)) for c in covered])

    def worth_of(hit, spilt):
        return (worth[:, None] * hit / jnp.maximum(whole + spilt, 1e-6)).sum()

    def flip(k, state):
        c = k % count
        level, hit, spilt, taken = state
        sign = jnp.where(taken[c], -1.0, 1.0).astype(level.dtype)

        def change(tiles, values, carry):
            hit, spilt = carry
            before = level[tiles]
            after, view = before + sign * values, jnp.minimum(tiles // per_view, views - 1)
            inside, outside = prints.inside[tiles], prints.outside[tiles]
            for n in range(2):
                moved = (after > levels[n]).astype(level.dtype) - (before > levels[n]).astype(level.dtype)
                hit = hit.at[n, view].add((moved * inside).sum(1))
                spilt = spilt.at[n, view].add((moved * outside).sum(1))
            return hit, spilt

        new_hit, new_spilt = blocks(c, change, (hit, spilt))
        better = worth_of(new_hit, new_spilt) > worth_of(hit, spilt) + 1e-7
        move = jnp.where(better, sign, 0.0)
        level = lax.cond(
            better,
            lambda level: blocks(c, lambda tiles, values, level: level.at[tiles].add(move * values), level),
            lambda level: level,
            level,
        )
        hit, spilt = jnp.where(better, new_hit, hit), jnp.where(better, new_spilt, spilt)
        return level, hit, spilt, taken.at[c].set(taken[c] ^ better)

    return lax.fori_loop(0, SWEEPS * count, flip, (level, hit, spilt, taken))[3]
