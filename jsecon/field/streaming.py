"""Votes of a scene that need not fit into memory. Host code.

Each view is cast on the Gaussians that it can see, whose geometry alone is read. What it casts goes to disk, and is
added up for one block of Gaussians after the other, so that no array of N rows is ever held. The shares that
follow are functions of rows, applied block by block.
"""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy import sparse

from jsecon.errors import InputError, require, require_shape
from jsecon.field.columns import ROWS
from jsecon.field.view_votes import view_votes
from jsecon.files import map_npy
from jsecon.numerics import NEAR, require_labels
from jsecon.splat.capacity import plan_capacity
from jsecon.splat.visible import geometry_of_rows, visible_rows
from jsecon.types import Camera, Gaussians, Progress, Votes

_PAIR = np.dtype([("gaussian", "<u4"), ("region", "<i4"), ("weight", "<f4")])
"""The weight that a view's region casts on a Gaussian."""
_SEEN = np.dtype([("gaussian", "<u4"), ("weight", "<f4"), ("peak", "<f4")])
"""The weight that a view casts on a Gaussian in all, and the largest of a pixel."""
_MAX_CASTS = 1 << 26
"""Weights, each of a view on a Gaussian, that are added up at once."""


def region_votes_in_blocks(
    gaussians: Gaussians,
    cameras: Camera,
    labels: Any,
    num_regions: int,
    *,
    folder: str | os.PathLike,
    top: int = 8,
    by_view: bool = False,
    centre: float = 0.0,
    near: float = NEAR,
    rows: int = ROWS,
    progress: Progress | None = None,
) -> Votes:
    """Casts the votes of `region_votes` on memory-mapped Gaussians, equal up to float32's rounding of the sums.

    Memory: the geometry of the Gaussians that one view sees, their tile lists with the weights of each entry, and one
    block of rows. Disk, until it returns: 12 bytes for each view, Gaussian and region with weight, and 12 for each view
    and Gaussian. One device, one process.

    Args:
      gaussians: Scene of N Gaussians, such as `load_field(path, mapped=True).gaussians`.
      cameras: Batch of T cameras.
      labels: T label images (H, W), of which `labels[t]` reads one at a time; -1 where a pixel belongs to no region.
      num_regions: R. Labels must be smaller.
      folder: New or empty folder for the columns of the votes; they stay as long as its files do.
      top: Number of strongest regions, of the sums over all views, that each Gaussian keeps.
      by_view: Whether to keep each view's total too, as `normalise_votes_in_blocks` needs it.
      centre: In [0, 1]. A weight away from the pixel that holds the Gaussian's centre counts 1 - `centre`.
      near: Near plane, world units.
      rows: Maximum number of Gaussians that are added up at once.
      progress: Called as progress(done, total), in views.

    Returns:
      Votes whose columns are memory maps.

    Raises:
      ValueError: Shapes disagree, or labels are no integers or too large.
      InputError: The folder cannot be written, or is not empty.
    """
    count, views = gaussians.count, len(cameras.world_to_camera)
    poses, remedy = cameras.world_to_camera, "Add a leading axis to all arrays of a single camera."
    require_shape("cameras.world_to_camera", poses, ("T", 4, 4), remedy)
    require(len(labels) == views, "labels", f"{len(labels)} images", f"{views}, one per view", "Give one per view.")
    require(num_regions >= 0, "num_regions", num_regions, ">= 0", "Count the regions.")
    require(count < 1 << 32, "region_votes_in_blocks", count, "fewer than 2^32 Gaussians", "Split the scene.")
    cameras = jax.tree.map(np.asarray, cameras)
    rows, overflow = max(min(rows, _MAX_CASTS // max(views, 1)), 1), 0
    with _scratch_folder(Path(folder)) as scratch:
        for t in range(views):
            image = np.asarray(labels[t])
            require_shape(f"labels[{t}]", image, (cameras.height, cameras.width), "Give images of the camera's size.")
            require_labels(image, num_regions)
            overflow += _cast_view(
                gaussians, cameras[t], image, num_regions, scratch / str(t), centre=centre, near=near
            )
            if progress is not None:
                progress(t + 1, views)
        kinds = {"regions": ("<i4", (top_kept := min(top, max(num_regions, 1)),)), "weights": ("<f4", (top_kept,))}
        kinds |= {name: ("<f4", ()) for name in ("labelled", "total", "max_pixel_weight")} | {"views": ("<i4", ())}
        blocks = (slice(first, min(first + rows, count)) for first in range(0, count, rows))
        sums = (_sum_block(scratch, views, block, num_regions, top_kept, by_view) for block in blocks)
        columns = _write_columns(Path(folder), sums, kinds | ({"by_view": ("<f4", (views,))} if by_view else {}), count)
    return Votes(**columns, overflow=np.asarray(overflow, np.int32), num_regions=num_regions)


@contextlib.contextmanager
def _scratch_folder(folder: Path) -> Iterator[Path]:
    """A folder inside `folder` that is removed afterwards."""
    remedy, scratch = "Name a new folder on a disk with room for the votes.", None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise InputError(folder, "a folder that is not empty", "an empty or a new one", remedy)
        scratch = Path(tempfile.mkdtemp(prefix=".scratch-", dir=folder))
        yield scratch
    except OSError as error:
        problem = f"{error.strerror or error} on writing votes to it"
        raise InputError(folder, problem, "a folder that can be written, and has room", remedy) from error
    finally:
        if scratch is not None:
            shutil.rmtree(scratch, ignore_errors=True)


def _cast_view(
    gaussians: Gaussians, camera: Camera, labels: np.ndarray, regions: int, path: Path, *, centre: float, near: float
) -> int:
    """Casts one view into PATH-seen.npy and PATH-cast.npy, in the order of Gaussians; returns the overflow."""
    ids = visible_rows(gaussians, camera, near=near)
    part = geometry_of_rows(gaussians, ids)
    capacity = max(plan_capacity(part, camera, margin=1.0, devices=1, near=near), 1)
    options = {"centre": centre, "near": near, "capacity": capacity, "with_peak": True}
    weights, peak, overflow = view_votes(part, camera, labels, regions, **options)
    assert peak is not None
    total = np.asarray(weights.sum(1)).ravel()
    cast = weights.indices < regions
    pairs = np.empty(np.count_nonzero(cast), _PAIR)
    pairs["gaussian"] = np.repeat(ids, np.diff(weights.indptr)[: len(ids)])[cast]
    pairs["region"], pairs["weight"] = weights.indices[cast], weights.data[cast]
    np.save(f"{path}-cast.npy", pairs)
    rows = np.flatnonzero(total)
    seen = np.empty(len(rows), _SEEN)
    seen["gaussian"], seen["weight"], seen["peak"] = ids[rows], total[rows], peak[rows]
    np.save(f"{path}-seen.npy", seen)
    return overflow


def _rows_of(path: Path, rows: slice) -> np.ndarray:
    """The records of a block of Gaussians in a file of `_cast_view`."""
    records = np.load(path, mmap_mode="r")
    first, last = np.searchsorted(records["gaussian"], [rows.start, rows.stop])
    return np.array(records[first:last])


def _sum_block(scratch: Path, views: int, rows: slice, regions: int, top: int, by_view: bool) -> dict[str, Any]:
    """The columns of one block of Gaussians, summed over the views."""
    count = rows.stop - rows.start
    cast = (_rows_of(scratch / f"{t}-cast.npy", rows) for t in range(views))
    pairs = np.concatenate([np.zeros(0, _PAIR), *cast])
    place = (pairs["gaussian"] - rows.start).astype(np.int64), pairs["region"]
    votes = sparse.csr_array((pairs["weight"].astype(np.float64), place), shape=(count, max(regions, 1)))
    votes.sum_duplicates()
    sums: dict[str, Any] = dict(zip(("regions", "weights"), strongest(votes, top)))
    sums |= {"labelled": np.asarray(votes.sum(1)).reshape(-1), "total": np.zeros(count)}
    sums |= {"views": np.zeros(count, np.int32), "max_pixel_weight": np.zeros(count, np.float32)}
    sums |= {"by_view": np.zeros((count, views), np.float32)} if by_view else {}
    for t in range(views):
        seen = _rows_of(scratch / f"{t}-seen.npy", rows)
        row = (seen["gaussian"] - rows.start).astype(np.int64)
        sums["total"][row] += seen["weight"]
        sums["views"][row] += 1
        sums["max_pixel_weight"][row] = np.maximum(sums["max_pixel_weight"][row], seen["peak"])
        if by_view:
            sums["by_view"][row, t] = seen["weight"]
    return sums


def strongest(votes: Any, top: int) -> tuple[np.ndarray, np.ndarray]:
    """Finds the largest weights of each row of a sparse matrix.

    Args:
      votes: (N, R) scipy CSR array of weights.
      top: Number of weights of a row.

    Returns:
      Column ids (N, top) int32, largest first as float32, equal ones by id, -1 where a row has fewer; and weights (N,
      top) float32.
    """
    lengths, weights = np.diff(votes.indptr), votes.data.astype(np.float32)
    row = np.repeat(np.arange(votes.shape[0]), lengths)
    order = np.lexsort((votes.indices, -weights, row))
    rank = np.arange(len(order)) - np.repeat(votes.indptr[:-1], lengths)
    kept = (rank < top) & (weights[order] > 0)
    ids, largest = np.full((votes.shape[0], top), -1, np.int32), np.zeros((votes.shape[0], top), np.float32)
    ids[row[kept], rank[kept]] = votes.indices[order][kept]
    largest[row[kept], rank[kept]] = weights[order][kept]
    return ids, largest


def _write_columns(
    folder: Path, blocks: Iterator[dict[str, Any]], kinds: dict[str, tuple[str, tuple[int, ...]]], count: int
) -> dict[str, Any]:
    """Memory maps of FOLDER/<name>.npy, written block after block; `by_view` (T, N) in Fortran's order."""
    # Written, not mapped: a full disk is then an error, not a signal.
    with contextlib.ExitStack() as stack:
        files = {name: stack.enter_context(open(folder / f"{name}.npy", "wb")) for name in kinds}
        for name, (dtype, rest) in kinds.items():
            turned = name == "by_view"
            header = {"descr": dtype, "fortran_order": turned, "shape": (*rest, count) if turned else (count, *rest)}
            np.lib.format.write_array_header_1_0(files[name], header)
        for sums in blocks:
            for name, (dtype, _) in kinds.items():
                files[name].write(np.ascontiguousarray(sums[name], dtype).tobytes())
    return {"by_view": None} | {name: map_npy(folder / f"{name}.npy") for name in kinds}
