"""Run-length encoding of masks: some hundred numbers per mask instead of an image. Host code (NumPy)."""

import dataclasses
import functools
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool
from scipy import sparse

from jsecon.association.scene import Sparse


@dataclasses.dataclass(frozen=True)
class RunLengthMasks:
    """R masks over P pixels, which may overlap."""

    starts: np.ndarray
    """(K,) int32 first pixel of each run, ascending within a mask."""
    stops: np.ndarray
    """(K,) int32 pixel after the last of each run."""
    counts: np.ndarray
    """(R,) int32 number of runs of each mask."""
    pixels: int
    """P, pixels of an image."""

    def rows(self) -> Sparse:
        """Decodes the masks as a sparse matrix (R, P) of float32 ones."""
        lengths = (self.stops - self.starts).astype(np.int64)
        ends = np.concatenate([[0], np.cumsum(lengths)])
        columns = np.arange(ends[-1]) + np.repeat(self.starts - ends[:-1], lengths)
        ends = ends[np.concatenate([[0], np.cumsum(self.counts)])]
        shape = (len(self.counts), self.pixels)
        return sparse.csr_matrix((np.ones(len(columns), np.float32), columns.astype(np.int32), ends), shape=shape)

    def concatenate(self, others: "RunLengthMasks") -> "RunLengthMasks":
        """Appends masks over the same pixels."""
        starts, stops = (np.concatenate(pair) for pair in zip((self.starts, self.stops), (others.starts, others.stops)))
        return RunLengthMasks(starts, stops, np.concatenate([self.counts, others.counts]), self.pixels)


def encode_rows(rows: Sparse) -> RunLengthMasks:
    """Encodes masks that are the nonzeros of the rows of a csr_matrix (R, P) with sorted indices."""
    new = np.ones(rows.nnz, bool)
    new[1:] = np.diff(rows.indices) != 1
    new[rows.indptr[:-1][np.diff(rows.indptr) > 0]] = True
    first = np.flatnonzero(new)
    last = np.append(first[1:], rows.nnz) - 1 if len(first) else first
    counts = np.diff(np.searchsorted(first, rows.indptr))
    starts, stops = rows.indices[first], rows.indices[last] + 1
    return RunLengthMasks(starts.astype(np.int32), stops.astype(np.int32), counts.astype(np.int32), rows.shape[1])


def encode_masks(masks: Bool[np.ndarray, "r h w"]) -> RunLengthMasks:
    """Encodes masks (R, H, W) over P = H W pixels."""
    return encode_rows(sparse.csr_matrix(masks.reshape(len(masks), masks.shape[1] * masks.shape[2])))


def cache_masks_as_rle(
    propose: Callable[[int], Bool[np.ndarray, "m h w"]],
) -> Callable[[int], Bool[np.ndarray, "m h w"]]:
    """Caches a function from the index of a frame to its masks, which it then calls once per index, in run lengths."""

    @functools.cache
    def encoded(index: int) -> tuple[RunLengthMasks, tuple[int, int, int]]:
        masks = propose(index)
        return encode_masks(masks), masks.shape

    def masks_of(index: int) -> Bool[np.ndarray, "m h w"]:
        runs, shape = encoded(index)
        return runs.rows().astype(bool).toarray().reshape(shape)

    return masks_of
