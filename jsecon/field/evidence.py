"""Evidence: the weight that each region casts on each Gaussian, view by view, and its sum over the views, the votes.

With the geometry fixed, rendering is linear in the features of the Gaussians (image = W f, W the weights alpha T), and
the labels of the pixels take only R values. So the votes, W^T onto one-hot labels, hold all that a later choice of
embeddings or codes needs (Eq. 3 of the paper with one-hot labels).

A view gives one sparse list of (Gaussian, region, weight), and the votes are the sum of the lists. Weights of a view
are rounded to multiples of 2^-24 px, which float64 adds up without error: the votes do not depend, to the last bit, on
the order of the views, nor on how devices, processes or blocks of Gaussians share the work. They are also rounded to 17
bits, which packs them to half the room (`pack_evidence`).
"""

import contextlib
import dataclasses
import functools
import os
import shutil
import tempfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Float32, Int, Int32, Shaped, UInt8
from scipy import sparse

from jsecon.errors import InputError, require, require_shape
from jsecon.files import map_npy
from jsecon.numerics import FULL_PRECISION, NEAR, array_module, is_traced, require_labels
from jsecon.parallel import MESH_OPTIONS, map_views
from jsecon.process import cores
from jsecon.programs import stored_jit
from jsecon.splat.capacity import plan_capacity
from jsecon.splat.fusion import compute_once
from jsecon.splat.plan import ViewPlan, plan_view
from jsecon.splat.scan import CHUNK, blend_weights, make_batches, make_table, scan_tiles, to_tiles
from jsecon.splat.visible import visible_part
from jsecon.types import Array, Camera, Gaussians, Progress, Votes

_RESOLUTION = 2.0**24
"""Weights of a view are multiples of its inverse, px. The faintest weight of a pixel is 4e-7 (1/255 of the last
transmittance), and float64 adds up 2^29 px of weight without error."""
IGNORED = -2
"""Label of a pixel that counts neither for a region nor against one."""
TOP = 8
"""Strongest regions that a Gaussian keeps."""
_BITS = 17
"""Significant bits of a weight: an error of 4e-6 of it, where float32's sums of pixels have 1e-6."""
_SLOTS = 4
"""Labels of a tile that are summed at once. A tile of 8x8 pixels seldom shows more; then its batch is scanned again."""
_RANDOM_PLANES = (13, 14, 17, 18)
"""Planes of a packed list that deflate does not shrink: the middle bytes of its floats."""
_HEAD = 23
"""numbers at the start of a packed list: its Gaussians, entries and overflow, and the bytes of each of 20 planes"""
MAX_WHOLE = 1 << 21
"""Gaussians of a scene above which each view is planned for those alone that it can see."""
_MAX_ENTRIES = 1 << 24
"""Entries, at most one a view and Gaussian on average, that are added up at once."""


class ViewEvidence(NamedTuple):
    """What one view casts on the Gaussians: a sparse list, by Gaussian and then by region."""

    gaussians: Int[np.ndarray, " m"]
    """(M,) int32 the Gaussians with any weight, ascending."""
    starts: Int[np.ndarray, " m+1"]
    """(M + 1,) int32 where the entries of each begin, and the end of the last."""
    regions: Int32[np.ndarray, " e"]
    """(E,) region of each entry; R for pixels of no region."""
    weights: Float32[np.ndarray, " e"]
    """(E,) sum of alpha T over the pixels of that region."""
    max_pixel_weights: Float32[np.ndarray, " m"]
    """(M,) largest alpha T of each Gaussian at any pixel."""
    overflow: int = 0
    """Pairs beyond the capacity; 0 if the list is exact."""

    def _of_rows(self, rows: slice) -> "ViewEvidence":
        """Takes the Gaussians of a slice, which are then counted from its start."""
        first, last = np.searchsorted(self.gaussians, [rows.start, rows.stop])
        starts = np.asarray(self.starts[first : last + 1])
        entries = slice(starts[0], starts[-1])
        columns = self.gaussians[first:last] - rows.start, starts - starts[0]
        columns = *columns, self.regions[entries], self.weights[entries], self.max_pixel_weights[first:last]
        gaussians, starts, regions, weights, largest = map(np.asarray, columns)
        return ViewEvidence(gaussians, starts, regions, weights, largest)

    def matrix(self, count: int, num_regions: int) -> Any:
        """Lays the list out as a scipy.sparse.csr_matrix (N, R + 1)."""
        lengths = np.zeros(count + 1, np.int32)
        lengths[1 + self.gaussians] = np.diff(self.starts)
        columns = self.weights, self.regions, np.cumsum(lengths, dtype=np.int32)
        return sparse.csr_matrix(columns, shape=(count, num_regions + 1))


CastLabels: TypeAlias = Callable[[Shaped[np.ndarray, "h w"], int], ViewEvidence]
"""Lists what a view casts on some label image of so many regions."""


def region_votes(
    gaussians: Gaussians,
    cameras: Camera,
    labels: Any,
    num_regions: int,
    *,
    top: int = TOP,
    by_view: bool = False,
    centre_pixel_weight: float = 0.0,
    capacity: int | None = None,
    near: float = NEAR,
    folder: str | os.PathLike | None = None,
    progress: Progress | None = None,
) -> Votes:
    """Adds up the weight that each region casts on each Gaussian over all views.

    Host code: the views are spread over the cores, and over processes that all make the same call
    (`jax.distributed`), to the same bits on any number of them. Inside a trace it is a pure function that scans the
    views on one device, with arrays that are dense in the regions: for small scenes.

    Args:
      gaussians: Scene of N Gaussians; its columns may be memory-mapped.
      cameras: Batch of T cameras.
      labels: (T, H, W) integers below `num_regions`, -1 where a pixel belongs to no region, IGNORED where it is no part
        of the scene; or T images (H, W), of which `labels[t]` reads one, in several threads. Inside a trace R and more
        count as -1.
      num_regions: R.
      top: Number of strongest regions that each Gaussian keeps.
      by_view: Whether to keep each view's total too (`Votes.by_view`), as `normalise_votes` needs it.
      centre_pixel_weight: In [0, 1]. A weight away from the pixel that holds the Gaussian's centre counts
        1 - `centre_pixel_weight`: at 1 a Gaussian is what its centre is, at 0 what its whole footprint is.
      capacity: Number of (block, Gaussian) pairs of a view, see `render`. By default, outside of a trace, a view that
        overflows is planned again with enough.
      near: Near plane, world units.
      folder: New or empty folder that keeps the views' lists while they are added up, and the columns of the votes as
        long as they are used: for scenes larger than memory.
      progress: Called as progress(done, total), in views.

    Returns:
      Votes of the N Gaussians; memory maps with `folder`. `overflow` is 0 if they are exact.

    Raises:
      ValueError: Shapes disagree, or labels are no integers or too large.
      InputError: The folder cannot be written, or is not empty.
    """
    views, top = len(cameras.world_to_camera), min(top, max(num_regions, 1))
    remedy = "Add a leading axis to all arrays of a single camera."
    require_shape("cameras.world_to_camera", cameras.world_to_camera, ("T", 4, 4), remedy)
    require(len(labels) == views, "labels", f"{len(labels)} images", f"{views}, one per view", "Give one per view.")
    require(num_regions >= 0, "num_regions", num_regions, ">= 0", "Count the regions.")
    require(gaussians.count < 1 << 31, "region_votes", gaussians.count, "fewer than 2^31 Gaussians", "Split the scene.")
    options = {"centre_pixel_weight": centre_pixel_weight, "capacity": capacity, "near": near}
    if hasattr(labels, "ndim"):
        expected = views, cameras.height, cameras.width
        require_shape("labels", labels, expected, "Give one label image per view, of the camera's size.")
        require_labels(labels, num_regions)
    if is_traced((gaussians, cameras, labels)):
        return _scan_votes(gaussians, cameras, labels, num_regions, top, by_view, **options)
    with scratch_folder(folder) as scratch:
        lists = list_evidence(gaussians, cameras, labels, num_regions, folder=scratch, progress=progress, **options)
        return sum_evidence(lists, gaussians.count, num_regions, top=top, by_view=by_view, folder=folder)


def list_evidence(
    gaussians: Gaussians,
    cameras: Camera,
    labels: Any,
    num_regions: int,
    *,
    folder: Path | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> list[ViewEvidence]:
    """Lists what each view casts on the Gaussians, on all cores and processes; `folder` keeps the lists on disk."""
    cameras = jax.tree.map(np.asarray, cameras)
    if gaussians.count <= MAX_WHOLE:  # once for all views
        gaussians = jax.device_put(dataclasses.replace(gaussians, sh=None))

    def view(t: int) -> tuple:  # a plain one, which processes can exchange
        evidence = view_evidence(gaussians, cameras[t], np.asarray(labels[t]), num_regions, **options)
        return tuple(evidence if folder is None else _on_disk(evidence, folder / str(t)))

    return [ViewEvidence(*evidence) for evidence in map_views(len(labels), view, progress)]


def view_evidence(
    gaussians: Gaussians, camera: Camera, labels: Shaped[np.ndarray, "h w"], num_regions: int, **options: Any
) -> ViewEvidence:
    """Lists what one view casts on N Gaussians; options as for `region_votes`. Host code."""
    return plan_evidence(gaussians, camera, **options)(labels, num_regions)


def plan_evidence(
    gaussians: Gaussians,
    camera: Camera,
    *,
    centre_pixel_weight: float = 0.0,
    capacity: int | None = None,
    near: float = NEAR,
) -> CastLabels:
    """Plans a view once; the function that it returns lists what the view casts on N Gaussians. Host code.

    Options as for `region_votes`.
    """
    rows = None
    if not gaussians.count:
        nothing, weightless = np.zeros(0, np.int32), np.zeros(0, np.float32)
        return lambda labels, num_regions: ViewEvidence(nothing, np.zeros(1, np.int32), nothing, weightless, weightless)
    if gaussians.count > MAX_WHOLE and capacity is None:
        rows, gaussians = visible_part(gaussians, camera, near=near)
        capacity = plan_capacity(gaussians, camera, margin=1.0, devices=1, near=near)
    plan = plan_view(gaussians, camera, capacity=capacity, near=near)

    def cast(labels: Shaped[np.ndarray, "h w"], num_regions: int) -> ViewEvidence:
        require_shape("labels", labels, (camera.height, camera.width), "Give images of the camera's size.")
        require_labels(labels, num_regions)
        evidence = _walk_plan(plan, _named(np.asarray(labels, np.int32), num_regions), num_regions, centre_pixel_weight)
        return evidence if rows is None else evidence._replace(gaussians=rows[evidence.gaussians].astype(np.int32))

    return cast


def _walk_plan(plan: ViewPlan, labels: Array, num_regions: int, centre_pixel_weight: float) -> ViewEvidence:
    """Lists what the Gaussians of a plan cast on labels up to `num_regions`."""
    count = plan.depths.shape[0]
    tiles, names, steps = _tile_labels(plan, labels)
    steps = int(steps)
    room = 1 << 2 * max(-(-(steps - 1).bit_length() // 2), 5)  # powers of 4 from 1,024 on: views share a program
    done, *chunks = _list_chunks(plan, (tiles, names), room, centre_pixel_weight)
    ids, slots, sums, largest = (np.asarray(chunk)[: int(done)] for chunk in chunks)
    entries = np.flatnonzero(sums > 0)
    pairs = entries // _SLOTS
    regions = slots.reshape(-1, _SLOTS)[pairs // CHUNK, entries % _SLOTS]
    columns = sums.reshape(-1)[entries].astype(np.float64), (ids.reshape(-1)[pairs], regions)
    weights = sparse.csr_matrix(columns, shape=(count, num_regions + 1))
    peaks = np.zeros(count, np.float32)
    np.maximum.at(peaks, ids.reshape(-1), largest.reshape(-1))
    seen = np.flatnonzero(np.diff(weights.indptr))
    rounded = np.rint(weights.data.astype(np.float32) * np.float32(_RESOLUTION)) / np.float32(_RESOLUTION)
    rounded, peaks = _round_mantissa(rounded), _round_mantissa(peaks)
    starts = np.append(weights.indptr[seen], len(rounded)).astype(np.int32)
    overflow = int(np.asarray(plan.lists.overflow).sum())
    regions = weights.indices.astype(np.int32)
    return ViewEvidence(seen.astype(np.int32), starts, regions, rounded, peaks[seen], overflow)


def _round_mantissa(values: Float32[np.ndarray, " e"]) -> Float32[np.ndarray, " e"]:
    """Rounds non-negative numbers to _BITS significant bits: multiples of 2^-24 stay such."""
    dropped = 24 - _BITS
    return ((values.view(np.uint32) + np.uint32(1 << dropped - 1)) >> dropped << dropped).view(np.float32)


def each_view(count: int, views: int, view: Callable[[int], Any], progress: Progress | None = None) -> Iterator[Any]:
    """Yields what each view of N Gaussians gives: computed on all cores, or one by one of a large scene."""
    if count <= MAX_WHOLE:
        yield from map_views(views, view, progress)
        return
    for t in range(views):
        yield view(t)
        if progress is not None:
            progress(t + 1, views)


def _named(labels: Array, num_regions: int) -> Array:
    """Gives pixels of no region the label `num_regions`, and ignored ones -1, as those outside of the image have."""
    xp = array_module(labels)
    known = (labels >= 0) & (labels < num_regions)
    return xp.where(labels == IGNORED, -1, xp.where(known, labels, num_regions)).astype(np.int32)


@stored_jit
def _tile_labels(plan: ViewPlan, labels: Array) -> tuple[Array, Array, Array]:
    """Finds the labels of the pixels of each tile, -1 outside of the image; the distinct ones; and a number of chunks.

    `_list_chunks` lists no more chunks than that.
    """
    batches = make_batches(plan.lists, plan.width)
    tiles = to_tiles(labels + 1, plan.lists.tile) - 1
    names = _distinct_labels(tiles, _SLOTS)
    chunks = -(-batches.lengths[batches.tiles].max(1) // CHUNK)
    passes = -(-(names[batches.tiles] >= 0).sum(2).max(1) // _SLOTS)
    return tiles, names, (chunks * passes).sum()


# Views run side by side, each on one core.
@functools.partial(stored_jit, static_argnums=(2, 3), compiler_options=MESH_OPTIONS)
def _list_chunks(
    plan: ViewPlan, labels: tuple[Array, Array], room: int, centre_pixel_weight: float
) -> tuple[Array, ...]:
    """Lists the chunks of all tiles one after the other, in room for `room` of them, by `_tile_labels`.

    Returns their number, and for each the Gaussians (B, CHUNK), the labels of the slots (B, _SLOTS), the weights on
    them (B, CHUNK, _SLOTS) and the largest weight of a pixel (B, CHUNK), for the B tiles of a batch.
    """
    dtype, tiles = plan.splats.dtype, make_batches(plan.lists, plan.width).tiles.shape[1]
    shapes = (
        ((tiles, CHUNK), np.int32),
        ((tiles, _SLOTS), np.int32),
        ((tiles, CHUNK, _SLOTS), dtype),
        ((tiles, CHUNK), dtype),
    )

    def emit(state, chunk, slots, sums, largest):
        done, *columns = state
        rows = chunk.ids, slots, sums, largest
        return done + 1, *(lax.dynamic_update_index_in_dim(a, row, done, 0) for a, row in zip(columns, rows))

    empty = (lax.empty((room, *shape), kind) for shape, kind in shapes)
    return _scan_regions(plan, labels, centre_pixel_weight, (jnp.int32(0), *empty), emit)


def _scan_regions(
    plan: ViewPlan, labels: tuple[Array, Array], centre_pixel_weight: float, state: Any, emit: Callable
) -> Any:
    """Sums each chunk's weights on the labels of its tiles: `state = emit(state, chunk, slots, sums, largest)`."""
    splats, lists = plan.splats, plan.lists
    integer = jnp.int32 if splats.dtype == jnp.float32 else jnp.int64
    batches, (tiles, distinct) = make_batches(lists, plan.width), labels
    table = make_table(splats)

    def one_batch(state, ids_of_tiles):
        local, names = tiles[ids_of_tiles], distinct[ids_of_tiles]
        corners = batches.corners(ids_of_tiles, splats.dtype)
        needed = (names >= 0).sum(1).max()

        def one_pass(carry):
            first, state = carry
            slots = lax.dynamic_slice_in_dim(names, first, _SLOTS, axis=1)
            is_slot = (slots[:, :, None] == local[:, None, :]).astype(splats.dtype)

            def body(transmittance, state, chunk):
                weight, transmittance = compute_once(chunk.always, blend_weights, transmittance, chunk.alpha)
                if centre_pixel_weight:
                    at_centre = _centre_pixels(chunk.attributes, corners, lists.tile)
                    weight = weight * (1 - centre_pixel_weight + centre_pixel_weight * at_centre)
                sums = jnp.einsum("bcp,bsp->bcs", weight, is_slot, precision=FULL_PRECISION)
                # Weights are not negative, so their bits are ordered as they are; a maximum of integers is vectorised.
                bits = lax.bitcast_convert_type(jnp.where(local[:, None] >= 0, weight, 0.0), integer)
                largest = lax.bitcast_convert_type(bits.max(-1), splats.dtype)
                return transmittance, emit(state, chunk, slots, sums, largest)

            return first + _SLOTS, scan_tiles(table, lists, batches, ids_of_tiles, body, state)[0]

        return lax.while_loop(lambda carry: carry[0] < needed, one_pass, (jnp.int32(0), state))[1], None

    return lax.scan(one_batch, state, batches.tiles)[0]


def _scan_votes(
    gaussians: Gaussians,
    cameras: Camera,
    labels: Array,
    num_regions: int,
    top: int,
    by_view: bool,
    *,
    centre_pixel_weight: float,
    capacity: int | None,
    near: float | Array,
) -> Votes:
    """Adds up votes as a pure function, dense in the regions; R and more count as no region."""
    count, dtype = gaussians.count, gaussians.means.dtype

    def one_view(state, view):
        camera, image = view
        plan = plan_view(gaussians, camera, capacity=capacity, near=near)

        def emit(state, chunk, slots, sums, largest):
            view_weights, peak = state
            target = jnp.where(slots >= 0, slots, num_regions + 1)[:, None]  # an empty slot's are dropped
            view_weights = view_weights.at[chunk.ids[:, :, None], target].add(sums, mode="drop")
            return view_weights, peak.at[chunk.ids].max(largest)

        weights, total, peak, views, overflow = state
        names = _tile_labels(plan, _named(image.astype(jnp.int32), num_regions))[:2]
        view_weights, peak = _scan_regions(plan, names, centre_pixel_weight, (jnp.zeros_like(weights), peak), emit)
        seen = view_weights.sum(1)
        state = weights + view_weights, total + seen, peak, views + (seen > 0), overflow + plan.overflow
        return state, seen if by_view else None

    nothing = jnp.zeros(count, dtype)
    state = jnp.zeros((count, num_regions + 1), dtype), nothing, nothing, jnp.zeros(count, jnp.int32), jnp.int32(0)
    each = jnp.zeros((len(labels), count), dtype) if by_view else None
    if count:
        state, each = lax.scan(one_view, state, (cameras, labels))
    weights, total, peak, views, overflow = state
    weights = weights[:, :num_regions] if num_regions else weights * 0
    largest, ids = lax.top_k(weights, top)
    ids = jnp.where(largest > 0, ids, -1)
    return Votes(ids, largest, weights.sum(1), total, peak, views, overflow, num_regions, each)


def sum_evidence(
    views: Sequence[ViewEvidence],
    count: int,
    num_regions: int,
    *,
    top: int = TOP,
    by_view: bool = False,
    folder: str | os.PathLike | None = None,
) -> Votes:
    """Adds up the lists of views to votes of `count` Gaussians, a block of rows at a time; see `region_votes`."""
    if folder is None:
        votes = _sum_views(views, count, num_regions, by_view).votes(top)
    else:
        columns = (_cut_sum(each, top) for each in _sum_blocks(views, count, num_regions, by_view))
        votes = _make_votes(_write_columns(Path(folder), columns, count), sum(v.overflow for v in views), num_regions)
    return votes if by_view else dataclasses.replace(votes, by_view=None)


class EvidenceSum(NamedTuple):
    """The sum of the lists of views before it is cut to the strongest regions: further views add up exactly."""

    weights: Any
    """csr_matrix (N, R) float64 weight on each region."""
    total: Float[np.ndarray, " n"]
    """(N,) float64 weight on all pixels."""
    views: Int32[np.ndarray, " n"]
    """(N,) views with any weight."""
    max_pixel_weight: Float32[np.ndarray, " n"]
    """(N,) largest alpha T at any pixel."""
    by_view: Float32[np.ndarray, "n t"]
    """(N, T) weight in each view."""
    overflow: int = 0
    """Pairs beyond the capacity."""

    def votes(self, top: int, least: Float32[np.ndarray, " n"] | None = None) -> Votes:
        """Cuts the sum to the `top` strongest regions of each Gaussian; weights below `least` are known not to be."""
        return _make_votes(_cut_sum(self, top, least), self.overflow, self.weights.shape[1])


def _make_votes(columns: dict[str, np.ndarray], overflow: int, num_regions: int) -> Votes:
    columns = columns | {"by_view": columns["by_view"].T}
    return Votes(**columns, overflow=np.asarray(overflow, np.int32), num_regions=num_regions)


def _sum_blocks(views: Sequence[ViewEvidence], count: int, num_regions: int, by_view: bool) -> Iterator[EvidenceSum]:
    """Sums the lists of views, a block of Gaussians at a time."""
    size = max(_MAX_ENTRIES // max(len(views), num_regions, 1), 1)
    for first in range(0, max(count, 1), size):
        rows = slice(first, min(first + size, count))
        yield _sum_rows([view._of_rows(rows) for view in views], rows, num_regions, by_view)


def _sum_rows(views: Sequence[ViewEvidence], rows: slice, num_regions: int, by_view: bool) -> EvidenceSum:
    """Sums a block of rows over all views."""
    count = rows.stop - rows.start
    total, seen, peak = np.zeros(count), np.zeros(count, np.int32), np.zeros(count, np.float32)
    each = np.zeros((len(views) if by_view else 0, count), np.float32).T
    dense = np.zeros((count, num_regions + 1) if len(views) != 1 else (0, 0))
    for t, view in enumerate(views):
        shape = len(view.gaussians), num_regions + 1
        view_totals = sparse.csr_matrix((view.weights, view.regions, view.starts), shape) @ np.ones(num_regions + 1)
        total[view.gaussians] += view_totals
        seen[view.gaussians] += 1
        peak[view.gaussians] = np.maximum(peak[view.gaussians], view.max_pixel_weights)
        if by_view:
            each[view.gaussians, t] = view_totals
        if dense.size:
            cells = np.repeat(view.gaussians.astype(np.int64) * (num_regions + 1), np.diff(view.starts)) + view.regions
            np.add.at(dense.reshape(-1), cells, view.weights.astype(np.float64))
    weights = views[0].matrix(count, num_regions) if len(views) == 1 else sparse.csr_matrix(dense)
    weights = weights[:, :num_regions].astype(np.float64)
    return EvidenceSum(weights, total, seen, peak, each, sum(view.overflow for view in views))


def _cut_sum(evidence: EvidenceSum, top: int, least: Float32[np.ndarray, " n"] | None = None) -> dict[str, np.ndarray]:
    """Computes the columns of votes."""
    weights, columns = evidence.weights, evidence._asdict()
    columns["regions"], columns["weights"] = _strongest(weights, min(top, max(weights.shape[1], 1)), least)
    columns["labelled"] = np.asarray(weights.sum(1)).reshape(-1).astype(np.float32)
    columns["total"] = evidence.total.astype(np.float32)
    return {name: column for name, column in columns.items() if name != "overflow"}


def _strongest(
    votes: Any, top: int, least: Float32[np.ndarray, " n"] | None
) -> tuple[Int32[np.ndarray, "n k"], Float32[np.ndarray, "n k"]]:
    """Finds the `top` largest weights of each row of a csr_matrix (N, R), equal ones by id; then -1 and 0."""
    weights, count = votes.data.astype(np.float32), votes.shape[0]
    rows = np.repeat(np.arange(count), np.diff(votes.indptr))
    candidates = np.flatnonzero((weights > 0) & (weights >= (np.float32(0) if least is None else least[rows])))
    weights, rows = weights[candidates], rows[candidates]
    # One key of row and falling weight: positive float32 sort like their bits.
    order = np.argsort((rows << 32) | (0xFFFFFFFF - weights.view(np.uint32).astype(np.int64)), kind="stable")
    rank = np.arange(len(order)) - np.searchsorted(rows, np.arange(count))[rows]
    kept = np.flatnonzero(rank < top)
    ids, largest = np.full((count, top), -1, np.int32), np.zeros((count, top), np.float32)
    places, order = rows[kept] * top + rank[kept], order[kept]
    ids.reshape(-1)[places] = votes.indices[candidates[order]]
    largest.reshape(-1)[places] = weights[order]
    return ids, largest


def add_evidence(
    evidence: EvidenceSum, views: Sequence[UInt8[np.ndarray, " _"]], places: Sequence[int], num_regions: int
) -> EvidenceSum:
    """Adds packed views to a sum, to the same bits as all at once; `places` are their columns of `by_view`."""
    more, count = sum_packed(views, len(evidence.total), num_regions), len(evidence.views)
    old = evidence.weights
    weights = sparse.csr_matrix((old.data, old.indices, old.indptr), shape=(count, num_regions)) + more.weights
    by_view = np.empty((count, evidence.by_view.shape[1] + len(views)), np.float32, order="F")
    is_new = np.isin(np.arange(by_view.shape[1]), places)
    by_view[:, ~is_new], by_view[:, is_new] = evidence.by_view, more.by_view
    peak = np.maximum(evidence.max_pixel_weight, more.max_pixel_weight)
    sums = evidence.total + more.total, evidence.views + more.views
    return EvidenceSum(weights, *sums, peak, by_view, evidence.overflow + more.overflow)


def sum_packed(views: Sequence[UInt8[np.ndarray, " _"]], count: int, num_regions: int) -> EvidenceSum:
    """Unpacks the lists of views (`pack_evidence`) on all cores, and adds them up."""
    with ThreadPoolExecutor(cores()) as pool:
        lists = list(pool.map(lambda view: _unpack_evidence(view, count, num_regions), views))
    return _sum_views(lists, count, num_regions, by_view=True)


def _sum_views(views: Sequence[ViewEvidence], count: int, num_regions: int, by_view: bool) -> EvidenceSum:
    """Adds up the lists of views, before the cut to the strongest regions."""
    weights, *columns, overflow = zip(*_sum_blocks(views, count, num_regions, by_view))
    return EvidenceSum(sparse.vstack(weights, "csr"), *map(np.concatenate, columns), overflow=overflow[0])


def pack_evidence(evidence: ViewEvidence, num_regions: int) -> UInt8[np.ndarray, " b"]:
    """Packs a list of a view to bytes, some 5 an entry, without loss; no region is -1, whatever their number is."""
    columns = (
        np.diff(evidence.gaussians, prepend=np.int32(0)),
        np.diff(evidence.starts),
        np.where(evidence.regions == num_regions, 0, evidence.regions + 1),
        evidence.weights.view(np.uint32),
        evidence.max_pixel_weights.view(np.uint32),
    )
    # The bytes of each place together: those that are 0 throughout are left out, and deflate shrinks most others.
    planes = [plane for column in columns for plane in np.asarray(column, "<u4").view(np.uint8).reshape(-1, 4).T]
    levels = [0 if n in _RANDOM_PLANES else 1 for n in range(len(planes))]
    parts = [zlib.compress(plane.tobytes(), level) if plane.any() else b"" for plane, level in zip(planes, levels)]
    sizes = len(evidence.gaussians), len(evidence.regions), int(evidence.overflow)
    head = np.array([*sizes, *map(len, parts)], "<u4")
    return np.frombuffer(b"".join([head.tobytes(), *parts]), np.uint8)


def _unpack_evidence(packed: UInt8[np.ndarray, " b"], count: int, num_regions: int) -> ViewEvidence:
    """Unpacks what `pack_evidence` packed of `count` Gaussians; ValueError if it is damaged."""
    head = packed[: 4 * _HEAD].view("<u4").astype(np.int64)
    (seen, entries, overflow), ends = head[:3], 4 * _HEAD + np.cumsum(head[3:])
    columns = [np.zeros(size, np.uint32) for size in (seen, seen, entries, entries, seen)]
    for n, (end, size) in enumerate(zip(ends, head[3:])):
        if size:
            plane = np.frombuffer(zlib.decompress(packed[end - size : end].data), np.uint8)
            columns[n // 4].view(np.uint8)[n % 4 :: 4] = plane
    gaussians, lengths, regions, weights, peaks = columns
    starts = np.cumsum(np.append(np.uint32(0), lengths), dtype=np.int32)
    ids = np.cumsum(gaussians, dtype=np.int64)
    regions = np.where(regions == 0, num_regions, regions.astype(np.int32) - 1).astype(np.int32)
    if starts[-1] != entries or (len(ids) and ids[-1] >= count) or (regions > num_regions).any():
        raise ValueError("the evidence of a view is damaged")
    rows = ids.astype(np.int32), starts, regions, weights.view(np.float32), peaks.view(np.float32)
    return ViewEvidence(*rows, int(overflow))


def _centre_pixels(
    splats: Float[Array, "b c 6"], corners: tuple[Array, Array], tile: int
) -> Float[Array, "b c pixels"]:
    """Marks the pixel of a tile that holds the centre of a splat: 1 there, 0 elsewhere."""
    x, y = (jnp.floor(splats[..., k] - corners[k][:, None]) for k in range(2))
    inside = (x >= 0) & (x < tile) & (y >= 0) & (y < tile)
    pixel = jnp.where(inside, y * tile + x, -1).astype(jnp.int32)
    return (pixel[..., None] == lax.iota(jnp.int32, tile * tile)).astype(splats.dtype)


def _distinct_labels(tiles: Int[Array, "n p"], slots: int) -> Int[Array, "n q"]:
    """Finds the distinct labels of each tile, ascending, -2 after the last and in `slots` more columns.

    `tiles` are the labels of the pixels, -1 for none.
    """
    ordered = jnp.sort(tiles, axis=1)
    first = jnp.ones_like(ordered[:, :1], bool)
    new = jnp.concatenate([first, ordered[:, 1:] != ordered[:, :-1]], axis=1) & (ordered >= 0)
    place = jnp.where(new, jnp.cumsum(new, axis=1) - 1, tiles.shape[1] + slots)
    table = jnp.full((tiles.shape[0], tiles.shape[1] + slots), -2, tiles.dtype)
    return table.at[jnp.arange(tiles.shape[0])[:, None], place].set(ordered, mode="drop")


@contextlib.contextmanager
def scratch_folder(folder: str | os.PathLike | None) -> Iterator[Path | None]:
    """A folder inside `folder` that is removed afterwards; None if there is none."""
    if folder is None:
        yield None
        return
    home, remedy, scratch = Path(folder), "Name a new folder on a disk with room for the votes.", None
    try:
        home.mkdir(parents=True, exist_ok=True)
        if any(home.iterdir()):
            raise InputError(home, "a folder that is not empty", "an empty or a new one", remedy)
        scratch = Path(tempfile.mkdtemp(prefix=".scratch-", dir=home))
        yield scratch
    except OSError as error:
        problem = f"{error.strerror or error} on writing votes to it"
        raise InputError(home, problem, "a folder that can be written, and has room", remedy) from error
    finally:
        if scratch is not None:
            shutil.rmtree(scratch, ignore_errors=True)


def _on_disk(view: ViewEvidence, path: Path) -> ViewEvidence:
    """Writes a list to PATH-<column>.npy and maps it."""
    columns = {name: column for name, column in view._asdict().items() if name != "overflow"}
    for name, column in columns.items():
        np.save(f"{path}-{name}.npy", column)
    return view._replace(**{name: map_npy(Path(f"{path}-{name}.npy")) for name in columns})


def _write_columns(folder: Path, blocks: Iterator[dict[str, np.ndarray]], count: int) -> dict[str, np.ndarray]:
    """Memory maps of FOLDER/<name>.npy, written block after block."""
    # Written, not mapped: a full disk is then an error, not a signal.
    with contextlib.ExitStack() as stack:
        files: dict[str, Any] = {}
        for block in blocks:
            for name, column in block.items():
                if name not in files:
                    files[name] = stack.enter_context(open(folder / f"{name}.npy", "wb"))
                    header = {"descr": column.dtype.str, "fortran_order": False, "shape": (count, *column.shape[1:])}
                    np.lib.format.write_array_header_1_0(files[name], header)
                files[name].write(np.ascontiguousarray(column).tobytes())
    return {name: map_npy(folder / f"{name}.npy") for name in files}
