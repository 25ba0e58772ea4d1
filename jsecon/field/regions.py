"""One embedding per region: the mean of its views' embeddings, weighted by its pixels in each view (paper: phi_bar).

`choose_crops` chooses which views of each region are embedded: a few that show most of it, uncut, from different
directions. An encoder needs a fifth of a second for each view (SigLIP 2, two cores), and the views of one object mostly
share its errors. `views_needed` finds the regions whose views do not (docs/results/vision.md).
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from scipy import sparse

from jsecon.errors import require_shape
from jsecon.numerics import array_module, inline_jit, normalize, require_labels
from jsecon.parallel import map_over_processes
from jsecon.types import Array, Camera, Progress, Regions

DUPLICATE_COSINE = 0.9
"""Cosine of what sets two regions apart from the mean region (`mean_residuals`), from which they are one object seen
twice, such as a track that broke. Over all pairs of simulated CLIP (medium and high noise, errors that views share) and
of colours, all that it joins are one object. On real words (ConSE, replica_apartment_0) it joins 0.008 of the pairs, of
which 0.36 are of one class; a cosine of 0.95 of the embeddings themselves joins 0.027, of which 0.25 are."""

SCATTER = 0.1
"""Largest error of a region's embedding that its views may leave, as a squared distance over that of a region from the
mean region. Chosen on twins of seed 71 and on apc_bin: docs/results/vision.md."""


def region_embeddings(
    frames: UInt8[np.ndarray, "t h w 3"],
    labels: Shaped[np.ndarray, "t _ _"],
    embed: Callable[[np.ndarray, np.ndarray], np.ndarray],
    *,
    num_regions: int | None = None,
    views: Bool[np.ndarray, "r t"] | None = None,
    progress: Progress | None = None,
) -> Regions:
    """Embeds the regions of a labelled sequence: the mean over the views, scaled to unit length. Host code.

    Several processes share the frames.

        phi_r = sum_t omega_t phi_rt,  omega_t = pixels of r in t / pixels of r in all views that are embedded

    Args:
      frames: (T, H, W, 3) uint8.
      labels: (T, H, W) integer region ids, -1 where a pixel belongs to no region.
      embed: `Embedder.embed_regions`: (H, W, 3) and masks (M, H, W) -> (M, E) unit embeddings.
      num_regions: R; None takes the largest label + 1.
      views: (R, T) views of each region that are embedded (`choose_crops`); None embeds all.
      progress: Called as progress(done, total), in frames.

    Returns:
      Regions, with the pixels in all views. A view whose embedding is zero does not count; a region without any view
      has a zero embedding.

    Raises:
      ValueError: Shapes disagree, or a label is out of range.
    """
    require_shape("labels", labels, frames.shape[:3], "Give one label image per frame, of the frame's size.")

    largest = int(labels.max()) if labels.size else -1
    count = largest + 1 if num_regions is None else num_regions
    require_labels(labels, count)
    areas = [np.bincount(image[image >= 0].reshape(-1), minlength=count)[:count] for image in labels]
    pixels = np.stack(areas, axis=1).astype(np.int32) if len(areas) else np.zeros((count, 0), np.int32)
    embedded = pixels > 0
    if views is not None:
        require_shape("views", views, pixels.shape, "Give a row per region and a column per frame.")
        embedded &= views

    def embed_frames(indices: Sequence[int]) -> Iterator[np.ndarray | None]:
        for t in indices:
            seen = np.flatnonzero(embedded[:, t])
            masks = labels[t][None] == seen[:, None, None]
            yield np.asarray(embed(frames[t], masks), np.float32) if len(seen) else None

    places, single = [np.zeros((0, 2), np.int32)], []
    for t, rows in enumerate(map_over_processes(len(labels), embed_frames, progress)):
        if rows is not None:
            seen = np.flatnonzero(embedded[:, t])
            require_shape("embed", rows, (len(seen), "E"), "An embedder returns one row per mask.")
            places.append(np.stack([seen, np.full(len(seen), t)], axis=1).astype(np.int32))
            single.append(rows)
    if not single:  # without a label the embedder alone knows E
        rows = embed(frames[0], np.zeros((1, *labels.shape[1:]), bool)) if len(labels) else np.zeros((1, 0))
        single.append(np.zeros((0, np.shape(rows)[1]), np.float32))
    return _mean_of_views(pixels, np.concatenate(places), np.concatenate(single))


def _mean_of_views(
    pixels: Int[np.ndarray, "r t"], places: Int[np.ndarray, "c 2"], rows: Float[np.ndarray, "c e"]
) -> Regions:
    region, view = places.T
    weights = sparse.csr_array((pixels[region, view], (region, np.arange(len(rows)))), (len(pixels), len(rows)))
    return Regions(unit_rows(weights @ rows.astype(np.float64)), pixels, places, rows)


def join_views(first: Regions, second: Regions) -> Regions:
    """Joins two `region_embeddings` of the same labels by different views: the same as by all of them at once."""
    places, rows = (
        np.concatenate([np.asarray(getattr(regions, name)) for regions in (first, second)])
        for name in ("embedded", "view_embeddings")
    )
    order = np.lexsort(places.T)
    return _mean_of_views(np.asarray(first.pixel_counts), places[order], rows[order])


def views_needed(regions: Regions, *, scatter: float = SCATTER) -> Int[np.ndarray, " r"]:
    """Computes how many views each of R regions needs, from the scatter of those that are embedded.

        s_r / n <= scatter mean_q |m_q - m|^2

    with the unbiased variance s_r of the views' embeddings of a region, their mean m_r, and the mean m of these means:
    the error of a mean of n views is s_r / n. A region with fewer than two embedded views needs no more.
    """
    rows = np.asarray(regions.view_embeddings, np.float64)
    known = (rows != 0).any(axis=1)
    rows, region = rows[known], np.asarray(regions.embedded)[known, 0]
    gather = sparse.csr_array((np.ones(len(rows)), (region, np.arange(len(rows)))), (regions.count, len(rows)))
    count = gather.sum(axis=1)
    means = (gather @ rows) / np.maximum(count, 1)[:, None]
    variance = (gather @ ((rows - means[region]) ** 2).sum(axis=1)) / np.maximum(count - 1, 1)
    means = means[count > 0]
    apart = ((means - means.sum(axis=0) / max(len(means), 1)) ** 2).sum() / max(len(means), 1)
    return np.ceil(variance / (scatter * apart)).astype(np.int64) if apart > 0 else count.astype(np.int64)


def crop_geometry(
    labels: Shaped[np.ndarray, "t h w"], cameras: Camera, num_regions: int
) -> tuple[Int[np.ndarray, "r t"], Float[np.ndarray, "r t"], Float[np.ndarray, "r t 3"]]:
    """Measures how each of T views shows each of R regions.

    Returns:
      Pixels; pixels on the frame's border over the side of a square with the region's area, at most 1; and the unit
      direction in the world from the camera to the middle of the region's pixels. All are 0 where a view does not show
      a region.
    """
    require_shape("labels", labels, (len(cameras), *labels.shape[1:]), "Give one camera per label image.")
    pixels, border, u, v = np.zeros((4, num_regions, len(labels)))
    for t, image in enumerate(labels):
        rows, columns = np.nonzero(image >= 0)
        ids = image[rows, columns]
        height, width = image.shape
        on_border = np.isin(rows, (0, height - 1)) | np.isin(columns, (0, width - 1))
        for total, weights in ((pixels, None), (border, on_border), (u, columns + 0.5), (v, rows + 0.5)):
            total[:, t] = np.bincount(ids, weights, minlength=num_regions)
    seen = pixels > 0
    count = np.maximum(pixels, 1)
    x = (u / count - np.asarray(cameras.cx)) / np.asarray(cameras.fx)
    y = (v / count - np.asarray(cameras.cy)) / np.asarray(cameras.fy)
    local = np.stack([x, y, np.ones_like(x)], axis=-1) / np.sqrt(x * x + y * y + 1)[..., None]
    rotation = np.asarray(cameras.world_to_camera, np.float64)[:, :3, :3]
    directions = np.where(seen[..., None], np.einsum("rti,tij->rtj", local, rotation), 0.0)
    return pixels.astype(np.int32), np.minimum(border / np.sqrt(count), 1.0), directions


def choose_crops(
    pixels: Int[np.ndarray, "r t"],
    cut: Float[np.ndarray, "r t"],
    directions: Float[np.ndarray, "r t 3"],
    most: int | Int[np.ndarray, " r"],
) -> Bool[np.ndarray, "r t"]:
    """Chooses at most `most` views of each region, one after the other, each time the one of the largest value.

        sqrt(pixels) (1 - cut / 2) (1 - n / 2),  n = max_c max(0, cos(direction, direction_c))^8 over the views c chosen

    So a view that the frame's border cuts counts half, and so does one from the direction of a chosen view. A region of
    many pixels tells an encoder little more than one of fewer, hence the root. Of equal views the first is taken.

    Args:
      pixels: Pixels of R regions in T views.
      cut: How much the border cuts off, 0 to 1.
      directions: Unit vectors.
      most: Largest number of views, of all regions or of each.
    """
    value = np.sqrt(pixels) * (1 - cut / 2)
    redundancy = np.zeros(pixels.shape)
    chosen = np.zeros(pixels.shape, bool)
    every = np.arange(len(pixels))
    for n in range(min(np.max(most, initial=0), pixels.shape[1])):
        gain = np.where(chosen | (np.asarray(most)[..., None] <= n), 0.0, value * (1 - redundancy / 2))
        best = gain.argmax(1)
        chosen[every, best] |= gain[every, best] > 0
        cosines = np.einsum("rtj,rj->rt", directions, directions[every, best])
        redundancy = np.maximum(redundancy, np.maximum(cosines, 0.0) ** 8)  # 0.5 at 23 degrees, 0.1 at 41
    return chosen


def unit_rows(rows: np.ndarray) -> np.ndarray:
    """Rows scaled to unit length, float32; zero rows stay zero."""
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.where(length > 0, rows / np.where(length > 0, length, 1.0), 0.0).astype(np.float32)


@inline_jit
def mean_residuals(embeddings: Float[Array, "r e"]) -> tuple[Float[Array, "r e"], Bool[Array, " r"]]:
    """Computes what sets each of R regions apart from the others, and which regions have an embedding. Pure.

        e_r - n / (n + 1) mean_q e_q

    with unit embeddings e of the n regions that have one. The factor lets a single region keep its own direction.
    """
    units, xp = normalize(embeddings), array_module(embeddings)
    known = xp.isfinite(units).all(axis=-1) & (units != 0).any(axis=-1)
    units = xp.where(known[:, None], units, 0.0)
    total = units.sum(axis=0) / (known.sum(dtype=units.dtype) + 1)
    return xp.where(known[:, None], units - total, 0.0), known
