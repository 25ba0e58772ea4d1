"""Masklets by Algorithm 1 of the paper: one identity per object, from any segmenter and tracker. Host code.

A masklet S_r is the masks of one object in all frames. The paper leaves the overlaps of masklets open; how they are
decided here stands in `masklets`.
"""

import numpy as np
from jaxtyping import Int16
from scipy import sparse

from jsecon.association.consensus import MIN_AREA, clean_tracks
from jsecon.association.frame_superpixels import Sparse, one_hot
from jsecon.errors import require, require_shape
from jsecon.types import Progress
from jsecon.vision.protocols import Segmenter, Tracker


def _encode(rows: Sparse) -> Sparse:
    """Encodes the runs of ones in rows (R, P): (R, P + 1) with 1 where a run begins, and -1 behind its end."""
    size = rows.shape[1], rows.shape[1] + 1
    runs = (rows @ (sparse.eye(*size) - sparse.eye(*size, k=1))).tocsr()
    runs.eliminate_zeros()
    runs.sort_indices()
    return runs


def _decode(runs: Sparse) -> Sparse:
    """Decodes what `_encode` encoded, to rows (R, P) of float32 ones."""
    starts, stops = runs.indices[::2], runs.indices[1::2]
    ends = np.concatenate([[0], np.cumsum(stops - starts, dtype=np.int64)])
    columns = np.arange(ends[-1]) + np.repeat(starts - ends[:-1], stops - starts)
    entries = np.ones(len(columns), np.float32), columns.astype(np.int32), ends[runs.indptr // 2]
    return sparse.csr_matrix(entries, shape=(runs.shape[0], runs.shape[1] - 1))


def masklets(
    frames: np.ndarray,
    segment: Segmenter,
    track: Tracker,
    *,
    iou_threshold: float = 0.5,
    max_masklets: int = 1000,
    progress: Progress | None = None,
) -> Int16[np.ndarray, "t h w"]:
    """Makes the masklets of a sequence by Algorithm 1 of the paper.

    For each frame t in order, a proposal becomes a prompt if it fills at least MIN_AREA of the frame and its IoU with
    the mask of every masklet in frame t is at most `iou_threshold`; of those that repeat each other the best does. The
    prompts of a frame are tracked through the whole sequence.

    Two masklets are joined if most of the frames that show both (at least two) have a proposal that contains both. A
    pixel under several belongs to the smallest (in mean area) with a support of at least a half, else to the best
    supported; support is the mean best IoU with the proposals of the frames that show a masklet. So objects that are
    proposed repeatedly are cut out of their surroundings, and single fragments and mergers have no influence. Masklets
    that only one frame shows are removed (`clean_tracks`).

    Args:
      frames: (T, H, W, 3) uint8 RGB.
      segment: Proposes masks of a frame.
      track: Follows masks through all frames.
      iou_threshold: The paper's kappa.
      max_masklets: Maximum number of tracked prompts.
      progress: Called with the number of frames done and of all.

    Returns:
      (T, H, W) int16 labels, -1 for no masklet.

    Raises:
      ValueError: Frames, masks or labels have a wrong shape.
    """
    rgb = frames.ndim == 4 and frames.shape[3] == 3 and frames.dtype == np.uint8
    require(rgb, "frames", (frames.shape, frames.dtype), "(T, H, W, 3) uint8", "Stack RGB frames of one size.")
    count, height, width = frames.shape[:3]
    proposals, layers = _Layers(count, height, width), _Layers(count, height, width)
    for t in range(count):
        masks = np.asarray(segment(frames[t], t), bool)
        require_shape("segment", masks, ("M", height, width), "A segmenter returns masks of the size of the frame.")
        masks = masks[masks.sum((1, 2)) >= max(MIN_AREA * height * width, 1)]
        proposals.add(t, sparse.csr_matrix(masks.reshape(len(masks), height * width)))
        prompts = masks[_new(proposals.at(t), layers.at(t), iou_threshold)[: max(max_masklets - layers.size(t), 0)]]
        if len(prompts):
            labels = np.asarray(track(frames, t, prompts))
            require_shape("track", labels, (count, height, width), "A tracker returns one label image per frame.")
            for other, image in enumerate(labels):
                known = np.where((image >= 0) & (image < len(prompts)), image, -1).astype(np.int32)
                layers.add(other, one_hot(known.reshape(-1), len(prompts)).T)
        if progress is not None:
            progress(t + 1, count)
    if not count or not layers.size(0):
        return np.full((count, height, width), -1, np.int16)
    whole, area, support = _joined(layers, proposals)
    order = np.lexsort((np.where(support >= 0.5, area, -support), support < 0.5))
    return clean_tracks(whole.flatten(order), whole.size(0))[0]


def _joined(layers: "_Layers", proposals: "_Layers") -> tuple["_Layers", np.ndarray, np.ndarray]:
    """Joins masklets that are parts of one object; returns them, their mean areas (R,) in px and their support (R,).

    In a frame two are one object if a proposal covers more than half of each: view consensus (Yan et al., CVPR 2024)
    between tracks instead of single masks.
    """
    tables: list[tuple[np.ndarray, ...]] = [_overlaps(layers.at(t), proposals.at(t)) for t in range(layers.count)]
    while True:
        together, both, area, support = _agreement(tables)
        rate = np.where(both >= 2, together / np.maximum(both, 1), 0.0)
        np.fill_diagonal(rate, 0.0)
        groups = np.arange(len(rate))
        free = np.ones(len(rate), bool)
        rows, columns = np.nonzero(np.triu(rate > 0.5))
        for k in np.lexsort((-both[rows, columns], -rate[rows, columns])):
            a, b = rows[k], columns[k]
            if free[a] and free[b]:  # one join per round: the next round counts again with the union
                groups[b] = a
                free[a] = free[b] = False
        if np.array_equal(groups, np.arange(len(rate))):
            return layers, area, support
        layers = layers.grouped(groups)
        _, first, members = np.unique(groups, return_index=True, return_counts=True)
        united = np.flatnonzero(members > 1)
        for t, table in enumerate(tables):  # rows of the other masklets stay the same
            tables[t] = tuple(rows[first] for rows in table)
            for rows, new in zip(tables[t], _overlaps(layers.at(t)[united], proposals.at(t))):
                rows[united] = new


def _agreement(tables: list[tuple[np.ndarray, ...]]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(R, R) frames with both masklets in one proposal, and that show both; (R,) mean area; (R,) support."""
    count = len(tables[0][0])
    together, both = np.zeros((count, count)), np.zeros((count, count))
    area, support, views = np.zeros(count), np.zeros(count), np.zeros(count)
    for size, shared, overlap in tables:
        shown = (size > 0).astype(np.float64)
        covered = (shared > 0.5 * size[:, None]).astype(np.float32)
        together += covered @ covered.T > 0
        both += shown[:, None] * shown
        area, views = area + size, views + shown
        support += overlap.max(1, initial=0.0)
    return together, both, area / np.maximum(views, 1.0), support / np.maximum(views, 1.0)


def _overlaps(first: Sparse, second: Sparse) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Areas (A,) of the first masks, shared pixels (A, B), IoU (A, B): one product of sparse one-hot rows."""
    shared = (first @ second.T).toarray()
    size, other = np.diff(first.indptr), np.diff(second.indptr)
    return size, shared, shared / np.maximum(size[:, None] + other - shared, 1.0)


def _new(masks: Sparse, known: Sparse, threshold: float) -> np.ndarray:
    """Rows (K,) of masks (M, P) whose IoU with all `known` and with all better chosen masks is at most `threshold`."""
    free = _overlaps(masks, known)[2].max(1, initial=0.0) <= threshold
    among = _overlaps(masks, masks)[2]
    chosen: list[int] = []
    for m in np.flatnonzero(free):
        if all(among[m, other] <= threshold for other in chosen):
            chosen.append(int(m))
    return np.asarray(chosen, np.int64)


class _Layers:
    """Masks of many objects in every frame, which may overlap, in run-length encoding."""

    def __init__(self, count: int, height: int, width: int):
        self.count, self.shape = count, (height, width)
        self.runs = [_encode(sparse.csr_matrix((0, height * width), dtype=np.float32))] * count

    def size(self, t: int) -> int:
        return self.runs[t].shape[0]

    def at(self, t: int) -> Sparse:
        """(R, H W) ones at frame t."""
        return _decode(self.runs[t])

    def add(self, t: int, rows: Sparse) -> None:
        """Appends masks to frame t, the ones of rows (M, H W)."""
        self.runs[t] = sparse.vstack([self.runs[t], _encode(rows)], "csr")

    def grouped(self, groups: np.ndarray) -> "_Layers":
        """Unites the masks of each group (R,), in the order of the groups."""
        names, number = np.unique(groups, return_inverse=True)
        unite = one_hot(number, len(names)).T
        result = _Layers(self.count, *self.shape)
        for t in range(self.count):
            result.add(t, (unite @ self.at(t)).sign())
        return result

    def flatten(self, best_first: np.ndarray) -> np.ndarray:
        """(T, H, W) int16 labels: the first in `best_first` that covers a pixel owns it."""
        labels = np.full((self.count, self.shape[0] * self.shape[1]), -1, np.int16)
        for t, image in enumerate(labels):
            rows = self.at(t)
            for masklet in best_first[::-1]:
                image[rows.indices[rows.indptr[masklet] : rows.indptr[masklet + 1]]] = masklet
        return labels.reshape(self.count, *self.shape)
