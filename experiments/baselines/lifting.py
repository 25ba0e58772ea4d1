"""The training-free baselines: a Gaussian's feature is a weighted mean of the embeddings of the masks that it lies in.

They differ in the weights alone. Occam's LGS (Cheng et al. 2024; insait-institute/OccamLGS): alpha T at the pixel of
the centre. Weighted back-projection (LUDVIG without its diffusion, Marrie et al. 2025, naver/ludvig; gradient-weighted
back-projection, JojiJoseph/3dgs-gradient-backprojection, is the same sum): alpha T at all pixels. VALA (2025): as
Occam's, gated in each view.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.spatial import KDTree

from experiments.baselines.evidence import Evidence, local_masks
from jsecon.field.evidence import view_evidence
from jsecon.paper.queries import _relevancies
from jsecon.splat.fusion import compute_once
from jsecon.splat.plan import ViewPlan, plan_view
from jsecon.splat.scan import blend_weights, make_batches, make_table, scan_tiles
from jsecon.types import Array, Selection

MASS, LEAST_WEIGHT, QUANTILE, SURE = 0.75, 0.13, 0.85, 0.15
"""VALA's gate of a view: the Gaussians that make up this part of its weight, each at least so heavy, and either above
this quantile of the view's or heavier than the last"""
PRUNED_BELOW = 0.01
"""VALA drops Gaussians whose weight in all views is below this part of the median"""
NEIGHBOURS = 10
READOUT = 0.6
"""VALA's threshold on the smoothed, normalised relevancy"""

_relevancies = jax.jit(_relevancies)


@dataclasses.dataclass(frozen=True)
class Lifted:
    """Features of the Gaussians and the weights that made them."""

    features: np.ndarray
    """(N, E) float32 unit; zero for a Gaussian that no mask ever held."""
    weights: sparse.csr_matrix
    """(N, M) of each mask on each Gaussian."""


def train_occam(evidence: Evidence) -> Lifted:
    """Occam's LGS: features of never activated Gaussians are zero, which is their pruning."""
    return _lifted(_centres(evidence, lambda weight: weight > 0), evidence)


def train_vala(evidence: Evidence, **gate_of: float) -> Lifted:
    """VALA: gated in each view by `gate`, whose keywords `gate_of` holds; its cosine median of the streamed views has
    the normalised weighted mean as its closed form, and is taken as that. Then Gaussians of little weight are
    dropped."""
    weights = _centres(evidence, functools.partial(gate, **gate_of))
    total = np.asarray(weights.sum(1)).ravel()
    seen = total[total > 0]
    kept = total >= max(1e-5, PRUNED_BELOW * float(np.median(seen)) if len(seen) else 0.0)
    return _lifted(sparse.diags(kept.astype(np.float32)) @ weights, evidence)


def train_backprojection(evidence: Evidence) -> Lifted:
    """The full sum, a pass of votes over each view; exact: no mask of a view is left out."""
    local, names = local_masks(evidence)
    gaussians, cameras = jax.tree.map(jnp.asarray, (evidence.gaussians, evidence.cameras))
    blocks = []
    for t, image in enumerate(local):
        count = int(image.max()) + 1
        cast = view_evidence(gaussians, cameras[t], image, count).matrix(gaussians.count, count)[:, :count].tocoo()
        blocks.append((cast.data, cast.row, names[t][cast.col]))
    return _lifted(_sparse(blocks, evidence), evidence)


def gate(
    weight: Float[np.ndarray, " n"], *, mass: float = MASS, least: float = LEAST_WEIGHT, quantile: float = QUANTILE
) -> Bool[np.ndarray, " n"]:
    """VALA's gate of one view: which of the weights at the centres' pixels count."""
    order = np.argsort(-weight, kind="stable")
    before = np.cumsum(weight[order]) - weight[order]
    kept = np.zeros(len(weight), bool)
    kept[order[before < mass * weight.sum()]] = True
    visible = weight[weight > 0]
    high = np.quantile(visible, quantile) if len(visible) else 0.0
    return kept & (weight >= least) & ((weight >= high) | (weight > SURE))


@jax.jit
def centre_weights(plan: ViewPlan) -> tuple[Float[Array, " n"], Int[Array, " n"]]:
    """alpha T (N,) of each Gaussian at the pixel that its projected centre lies in, and that pixel (N,), row * width +
    column; -1, with weight 0, where it lies outside the image or the Gaussian is not visible.

    The same weights that a render composites with, picked out of the same walk over the tiles.
    """
    splats, lists = plan.splats, plan.lists
    batches, tile = make_batches(lists, plan.width), lists.tile
    table = make_table(splats)
    column, row = (jnp.floor(splats[:, k]).astype(jnp.int32) for k in range(2))
    inside = (splats[:, 5] > 0) & (column >= 0) & (column < plan.width) & (row >= 0) & (row < plan.height)

    def one_batch(found, tiles):
        corner_x, corner_y = (corner[:, None] for corner in batches.corners(tiles, splats.dtype))

        def body(transmittance, found, chunk):
            weight, transmittance = compute_once(chunk.always, blend_weights, transmittance, chunk.alpha)
            x, y = (
                jnp.floor(chunk.attributes[..., k]).astype(jnp.int32) - corner.astype(jnp.int32)
                for k, corner in enumerate((corner_x, corner_y))
            )
            here = (x >= 0) & (x < tile) & (y >= 0) & (y < tile)
            pixel = jnp.where(here, y * tile + x, 0)
            own = jnp.take_along_axis(weight, pixel[..., None], axis=-1)[..., 0]
            return transmittance, found.at[chunk.ids].add(jnp.where(here, own, 0.0))

        return scan_tiles(table, lists, batches, tiles, body, found)[0], None

    found, _ = lax.scan(one_batch, jnp.zeros_like(splats[:, 0]), batches.tiles)
    return jnp.where(inside, found, 0.0), jnp.where(inside, row * plan.width + column, -1)


def _centres(evidence: Evidence, chosen: Callable[[np.ndarray], np.ndarray]) -> sparse.csr_matrix:
    gaussians, cameras = jax.tree.map(jnp.asarray, (evidence.gaussians, evidence.cameras))
    blocks, masks = [], np.asarray(evidence.masks)
    for t, image in enumerate(masks):
        weight, pixel = (np.asarray(a) for a in centre_weights(plan_view(gaussians, cameras[t])))
        mask = np.where(pixel >= 0, image.reshape(-1)[pixel], -1)
        rows = np.flatnonzero(chosen(weight) & (mask >= 0) & (weight > 0))
        blocks.append((weight[rows], rows, mask[rows]))
    return _sparse(blocks, evidence)


def _sparse(blocks: list, evidence: Evidence) -> sparse.csr_matrix:
    values, rows, columns = (np.concatenate(parts) for parts in zip(*blocks))
    shape = evidence.gaussians.count, len(evidence.embeddings)
    return sparse.csr_matrix((values.astype(np.float32), (rows, columns)), shape=shape)


def _lifted(weights: sparse.csr_matrix, evidence: Evidence) -> Lifted:
    summed = np.asarray(weights @ np.asarray(evidence.embeddings, np.float32), np.float32)
    length = np.linalg.norm(summed, axis=1, keepdims=True)
    return Lifted(np.where(length > 0, summed / np.where(length > 0, length, 1.0), 0.0), weights)


def smoothed(means: Float[Array, "n 3"], score: Float[Array, "*texts n"]) -> Float[np.ndarray, "*texts n"]:
    """VALA's readout of a score: the mean with that over the NEIGHBOURS nearest Gaussians, brought to 0 .. 1 over the
    scene, 2 r - 1 clipped at 0. Where a score is not finite: 0, and nobody's neighbour."""
    score = np.asarray(score)
    similarity = np.zeros(score.shape, np.float32)
    there = np.flatnonzero(np.isfinite(score).reshape(-1, score.shape[-1]).all(0))
    if len(there):
        points, own = np.asarray(means, np.float64)[there], score[..., there]
        near = KDTree(points).query(points, k=min(NEIGHBOURS + 1, len(there)))[1].reshape(len(there), -1)[:, 1:]
        smooth = 0.5 * (own + own[..., near].mean(-1)) if near.shape[1] else own
        low, spread = smooth.min(-1, keepdims=True), np.ptp(smooth, axis=-1, keepdims=True)
        similarity[..., there] = np.clip(2 * (smooth - low) / np.maximum(spread, 1e-9) - 1, 0, 1)
    return similarity


def query_relevancy(
    features: Float[Array, "n e"],
    means: Float[Array, "n 3"],
    text: Float[Array, " e"],
    canonical: Float[Array, "c e"],
    *,
    threshold: float = READOUT,
) -> Selection:
    """VALA's readout at the points: relevancy averaged with the mean over the ten nearest Gaussians, brought to 0 .. 1
    over the scene, 2 r - 1 clipped at 0, above `threshold`.

    Gaussians with a zero feature take no part, neither as answers nor as neighbours. Host code for the neighbours.
    """
    relevancy, known = (
        np.asarray(a) for a in _relevancies(jnp.asarray(features), jnp.asarray(text), jnp.asarray(canonical))
    )
    similarity = smoothed(means, np.where(known, relevancy, np.nan))
    mask = similarity > threshold
    score = jnp.asarray(relevancy.max(initial=0.0))
    return Selection(jnp.asarray(mask), jnp.asarray(similarity), jnp.asarray(-1, jnp.int32), score)
