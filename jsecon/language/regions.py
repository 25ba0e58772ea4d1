"""One embedding per region: the mean of its views' embeddings, weighted by its pixels in each view (paper: phi_bar)."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from scipy import sparse

from jsecon.errors import require, require_one_of, require_shape
from jsecon.numerics import normalize, require_labels
from jsecon.parallel import map_over_processes
from jsecon.types import Array, Parts, Regions

ALIKE_THRESHOLD = 0.9
"""on the cosine of what sets two regions apart from the scene (`mean_residuals`): above it they are one thing seen
twice, such as a track that broke. Over all pairs of simulated CLIP (medium and high noise, errors that views share) and
of colours, all that it joins are one object. On real words (ConSE, replica_apartment_0) it joins 0.008 of the pairs, of
which 0.36 are of one class, where a cosine of 0.95 of the embeddings themselves joins 0.027, of which 0.25 are"""

Embed = Callable[[int, np.ndarray], np.ndarray]
"""(frame's index, masks (M, H, W) bool) -> (M, E) unit, zero where there is nothing to embed"""


def region_embeddings(
    frames: UInt8[np.ndarray, "t h w 3"],
    labels: Shaped[np.ndarray, "t _ _"],
    embed: Callable[[np.ndarray, np.ndarray], np.ndarray],
    *,
    weighting: Literal["pixels", "uniform"] = "pixels",
    num_regions: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Regions:
    """Embeddings of the regions of a labelled sequence.

    frames (T, H, W, 3) uint8; labels (T, H, W) integers, -1 = none; `embed` is Embedder.embed_regions: (H, W, 3) and
    masks (M, H, W) -> (M, E) unit. phi_bar_r = sum_t omega_t phi_rt with omega_t = pixels of r in t / pixels of r in
    all views ("pixels"), or 1 / number of views of r ("uniform"); then scaled to unit length, since only cosines are
    used afterwards. A view whose embedding is zero (nothing to embed) does not count; a region without any view is
    zero.

    Returns Regions with R = `num_regions`, or the largest label + 1. Raises ValueError for shapes that disagree, a
    label beyond R, or an unknown weighting.
    """
    require_shape("labels", labels, frames.shape[:3], "Give one label image per frame, of the frame's own size.")
    of_frame = lambda t, masks: embed(frames[t], masks)
    return pooled(labels, of_frame, weighting=weighting, num_regions=num_regions, progress=progress)


def embeddings_of_masks(
    labels: Int[np.ndarray, "t h w"], masks: Int[np.ndarray, "_ _ _"], embeddings: Float[np.ndarray, "m e"], **how: Any
) -> Regions:
    """Embeddings of the regions of a labelled sequence, from those that masks of its frames have already.

    labels (T, H, W) integers, -1 = none; masks (T, H, W) rows of `embeddings` (M, E), -1 = none. In each view a region
    has the mean of the embeddings under its pixels, scaled to unit length; where it lies on no mask it does not count.
    Else as `region_embeddings`, whose keywords `how` holds.
    """
    require_shape("masks", masks, labels.shape, "Give one image of rows per frame, of the labels' size.")

    def under(t: int, regions: np.ndarray) -> np.ndarray:
        known = masks[t] >= 0
        rows, place = np.unique(masks[t][known], return_inverse=True)
        inside = [np.bincount(place[region[known]], minlength=len(rows)) for region in regions]
        found = np.asarray(inside, np.float64).reshape(len(regions), len(rows)) @ embeddings[rows].astype(np.float64)
        return found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-12)

    return pooled(labels, under, **how)


def pooled(
    labels: Shaped[np.ndarray, "t h w"],
    embed: Embed,
    *,
    weighting: Literal["pixels", "uniform"] = "pixels",
    num_regions: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Regions:
    """`region_embeddings` with what embeds the masks of the t-th frame given as a function of t. Over several processes
    (`jax.distributed`) the frames are dealt out."""
    require_one_of("weighting", weighting, ("pixels", "uniform"), "Use 'pixels', as the paper does.")
    count = int(labels.max(initial=-1)) + 1 if num_regions is None else num_regions
    require_labels(labels, count)
    areas = [np.bincount(image[image >= 0].reshape(-1), minlength=count)[:count] for image in labels]
    pixels = np.stack(areas, axis=1).astype(np.int32) if len(areas) else np.zeros((count, 0), np.int32)

    def rows(own: Sequence[int]) -> Iterator[np.ndarray | None]:
        for t in own:
            seen = np.flatnonzero(pixels[:, t])
            yield np.asarray(embed(t, labels[t][None] == seen[:, None, None]), np.float64) if len(seen) else None

    total: np.ndarray | None = None
    for t, found in enumerate(map_over_processes(len(labels), rows, progress)):
        if found is not None:
            seen = np.flatnonzero(pixels[:, t])
            require_shape("embed", found, (len(seen), "E"), "An embedder returns one row per mask.")
            total = np.zeros((count, found.shape[1])) if total is None else total
            weight = pixels[seen, t].astype(np.float64) if weighting == "pixels" else np.ones(len(seen))
            total[seen] += weight[:, None] * found
    if total is None:  # nothing is labelled: the embedder alone knows E
        total = np.zeros((count, np.asarray(embed(0, np.zeros((1, *labels.shape[1:]), bool))).shape[1]))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    unit = np.where(length > 0, total / np.where(length > 0, length, 1.0), 0.0)
    return Regions(embeddings=unit.astype(np.float32), pixels=pixels)


def mean_residuals(embeddings: Float[Array, "r e"]) -> tuple[Float[Array, "r e"], Bool[Array, " r"]]:
    """What sets each of R regions apart from the others (R, E), and which regions have an embedding (R,); 0 elsewhere.

        e_r - n / (n + 1) mean_q e_q

    with unit embeddings e of the n regions that have one. The factor keeps a region from being all that it is measured
    against: a single region keeps its own direction. Pure.
    """
    units = normalize(embeddings)
    known = jnp.all(jnp.isfinite(units), axis=-1) & jnp.any(units != 0, axis=-1)
    units = jnp.where(known[:, None], units, 0.0)
    total = jnp.sum(units, axis=0) / (jnp.sum(known, dtype=units.dtype) + 1)
    return jnp.where(known[:, None], units - total, 0.0), known


def scene_parts(part: Int[np.ndarray, " n"], cast: Any, embeddings: Float[np.ndarray, "m e"]) -> Parts:
    """Parts of a scene from the part (N,) of each Gaussian, 0 .. P-1, -1 = none, the weight (N, M) that each casts on
    each mask (a sparse matrix), and the masks' embeddings (M, E).

        e_p = unit(sum_m w_pm phi_m),  w_pm the weight of all Gaussians of p on m

    A part that lies in no mask has a zero embedding. Raises ValueError where sizes disagree.
    """
    fit = cast.shape == (len(part), len(embeddings))
    found, expected = f"cast {cast.shape}", f"({len(part)} Gaussians, {len(embeddings)} masks)"
    require(fit, "scene_parts", found, expected, "Give a row for each Gaussian and a column for each mask.")
    own = np.flatnonzero(part >= 0)
    count = int(part.max(initial=-1)) + 1
    gather = sparse.csr_matrix((np.ones(len(own), np.float32), (part[own], own)), shape=(count, len(part)))
    weight = gather @ cast
    total = np.asarray(weight @ np.asarray(embeddings, np.float32), np.float32).reshape(count, embeddings.shape[1])
    length = np.linalg.norm(total, axis=1, keepdims=True)
    units = np.where(length > 0, total / np.where(length > 0, length, 1.0), 0.0).astype(np.float32)
    return Parts(part.astype(np.int32), units, np.asarray(weight.sum(1), np.float32).reshape(count))
