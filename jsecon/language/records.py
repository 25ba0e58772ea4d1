"""What views cast on Gaussians, kept on disk by blocks of Gaussians until it is summed: for language/blocks.py.

    SPOOL/votes-<block>     (Gaussian within the block, region, weight)     for each tile of a view in which it has any
    SPOOL/seen-<block>      (Gaussian within the block, view, weight, largest weight of a pixel)      for each view

A block's records are read back in pieces and summed as a sparse matrix: nothing is cut before all are summed.
"""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool
from scipy import sparse

from jsecon.files import map_npy

_KINDS = {
    "votes": np.dtype([("gaussian", "<u4"), ("region", "<i4"), ("weight", "<f4")]),
    "seen": np.dtype([("gaussian", "<u4"), ("view", "<i4"), ("weight", "<f4"), ("peak", "<f4")]),
}
_PIECE = 1 << 22
"""records that are read at once"""


def append(spool: Path, kind: str, rows: int, gaussians: np.ndarray, *columns: np.ndarray) -> None:
    """Adds records of Gaussians (M,), in any order, to the files of their blocks of `rows`."""
    block = gaussians // rows
    few = block.max(initial=0) < 1 << 16  # sixteen bits are sorted by radix, ten times faster
    order = np.argsort(block.astype(np.uint16 if few else np.int64), kind="stable")
    records = np.empty(len(order), _KINDS[kind])
    names = records.dtype.names or ()
    for name, column in zip(names, (gaussians - block * rows, *columns), strict=True):
        records[name] = column[order]
    present, first = np.unique(block[order], return_index=True)
    for own, start, stop in zip(present, first, [*first[1:], len(order)]):
        with open(spool / f"{kind}-{own}", "ab") as file:
            file.write(records[start:stop].tobytes())


def _pieces(spool: Path, kind: str, block: int) -> Iterator[np.ndarray]:
    path = spool / f"{kind}-{block}"
    if path.exists():
        with open(path, "rb") as file:
            while held := file.read(_PIECE * _KINDS[kind].itemsize):
                yield np.frombuffer(held, _KINDS[kind])


def summed_columns(
    spool: Path,
    folder: Path,
    count: int,
    regions: int,
    rows: int,
    top: int,
    shows: Bool[np.ndarray, "r t"] | None,
    views: int = 0,
) -> dict[str, Any]:
    """The columns of `Votes` by name, as memory maps of FOLDER/<name>.npy: summed block after block; `shown` where
    `shows`, which views show which region, is given, and `by_view` of so many views."""
    kinds = {"regions": ("<i4", (top,)), "weights": ("<f4", (top,)), "labelled": ("<f4", ()), "total": ("<f4", ())}
    kinds |= {"peak": ("<f4", ()), "views": ("<i4", ())} | ({} if shows is None else {"shown": ("<f4", (top,))})
    if views:  # written Gaussian after Gaussian: (T, N) in Fortran's order
        kinds["by_view"] = "<f4", (views,)
    # Written, not mapped: a disk that is full is an error then, and no signal.
    with contextlib.ExitStack() as stack:
        files = {name: stack.enter_context(open(folder / f"{name}.npy", "wb")) for name in kinds}
        for name, (dtype, rest) in kinds.items():
            turned = name == "by_view"
            header = {"descr": dtype, "fortran_order": turned, "shape": (*rest, count) if turned else (count, *rest)}
            np.lib.format.write_array_header_1_0(files[name], header)
        for first in range(0, count, rows):
            own = _block(spool, first // rows, min(rows, count - first), regions, top, shows, views)
            for name, (dtype, _) in kinds.items():
                files[name].write(np.ascontiguousarray(own[name], dtype).tobytes())
    return {"shown": None, "by_view": None} | {name: map_npy(folder / f"{name}.npy") for name in kinds}


def _block(spool: Path, block: int, count: int, regions: int, top: int, shows: np.ndarray | None, views: int):
    """The columns of one block."""
    cast: Any = sparse.csr_array((count, max(regions, 1)), dtype=np.float64)
    for piece in _pieces(spool, "votes", block):
        place = piece["gaussian"].astype(np.int32), piece["region"]
        cast = cast + sparse.coo_array((piece["weight"].astype(np.float64), place), shape=cast.shape).tocsr()
    own = dict(zip(("regions", "weights"), strongest(cast, top)))
    own |= {"labelled": np.asarray(cast.sum(1)).reshape(-1), "total": np.zeros(count), "views": np.zeros(count, int)}
    own |= {"peak": np.zeros(count, np.float32), "shown": np.zeros((count, top))}
    own["by_view"] = np.zeros((count, views), np.float32)
    for piece in _pieces(spool, "seen", block):
        gaussian, weight = piece["gaussian"].astype(np.int64), piece["weight"]
        own["total"] += np.bincount(gaussian, weight, count)
        own["views"] += np.bincount(gaussian, minlength=count)
        np.maximum.at(own["peak"], gaussian, piece["peak"])
        if views:
            own["by_view"][gaussian, piece["view"]] = weight  # a Gaussian is in one band of a view
        for k in range(0 if shows is None else top):
            region = own["regions"][gaussian, k]
            shown = (region >= 0) & np.asarray(shows)[np.maximum(region, 0), piece["view"]]
            own["shown"][:, k] += np.bincount(gaussian[shown], weight[shown], count)
    return own


def strongest(cast: Any, top: int) -> tuple[np.ndarray, np.ndarray]:
    """(N, top) int32 the regions with the largest weights of each row of a sparse matrix (N, R), largest first (as
    float32; equal ones by region), -1 = none; and (N, top) float32 the weights."""
    cast.sort_indices()
    weights, lengths = cast.data.astype(np.float32), np.diff(cast.indptr)
    ids, largest = np.full((cast.shape[0], top), -1, np.int32), np.zeros((cast.shape[0], top), np.float32)
    # Rows of one length at a time: they are short, and of few lengths.
    for length in np.unique(lengths[lengths > 0]):
        rows = np.flatnonzero(lengths == length)
        places = cast.indptr[rows][:, None] + np.arange(length)
        own = weights[places]
        order = np.argsort(-own, axis=1, kind="stable")[:, :top]
        own = np.take_along_axis(own, order, axis=1)
        kept = order.shape[1]
        ids[rows, :kept] = np.where(own > 0, np.take_along_axis(cast.indices[places], order, axis=1), -1)
        largest[rows, :kept] = own
    return ids, largest
