"""Masklets: one identity an object through all frames (Algorithm 1 of the paper), over any segmenter and tracker."""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int, Int16
from scipy import sparse

from jsecon.association.atoms import Sparse, one_hot
from jsecon.association.run_lengths import RunLengthMasks, encode_masks, encode_rows
from jsecon.errors import require, require_shape
from jsecon.vision.protocols import Segmenter, Tracker

Progress = Callable[[int, int], None]


@dataclasses.dataclass(frozen=True)
class MaskletState:
    """How far a sequence has come: all that `masklets` needs to go on in the middle of it. Arrays only."""

    done: int
    """frames whose proposals were prompted and tracked."""
    proposals: dict[str, np.ndarray]
    """masks of every frame: `rows` (T,) masks per frame; `counts`, `starts`, `stops` of their runs, as in
    `RunLengthMasks`."""
    layers: dict[str, np.ndarray]
    """the same of what was tracked."""


def masklets(
    frames: np.ndarray,
    segment: Segmenter,
    track: Tracker,
    *,
    iou_threshold: float = 0.5,
    min_area: float = 0.001,
    max_masklets: int = 1000,
    min_views: int = 2,
    min_support: float = 0.5,
    join_rate: float = 0.5,
    state: MaskletState | None = None,
    on_checkpoint: Callable[[Callable[[], MaskletState]], None] | None = None,
    progress: Progress | None = None,
) -> Int16[np.ndarray, "t h w"]:
    """Labels (T, H, W) int16 of the masklets of a sequence, -1 = none.

    frames (T, H, W, 3) uint8. For each frame t in order, each proposal that fills at least `min_area` (share of the
    frame) and whose IoU with every masklet's mask at t is at most `iou_threshold` (the paper's kappa; IoU taken at
    frame t itself) becomes a prompt, and the frame's prompts are tracked through the whole sequence.
    Proposals of one frame that repeat each other (IoU above kappa) count once, the better first. At most
    `max_masklets`, the first found, are tracked. `progress(done, total)` counts frames.

    Parts: of the frames that show two masklets, if more than `join_rate` hold both in one proposal, they are joined
    (`joined`; 1 leaves that out). Overlaps: a masklet's support is the mean, over the frames that show it, of its best
    IoU with that frame's proposals. A pixel belongs to the smallest masklet there (in mean area) whose support is at
    least `min_support`, else to the best supported one. So what the segmenter finds again and again is cut out of what
    surrounds it, and a fragment or a merger that it found once gives way. Last, `clean_masklets`.

    `on_checkpoint` gets, after each frame, a function that makes the state (of the size of all masks: not for nothing);
    given back as `state`, with the same frames and options, the sequence goes on behind that frame to the same result.
    """
    rgb = frames.ndim == 4 and frames.shape[3] == 3 and frames.dtype == np.uint8
    require(rgb, "frames", (frames.shape, frames.dtype), "(T, H, W, 3) uint8", "Stack RGB frames of one size.")
    count, height, width = frames.shape[:3]
    proposals, layers = _Layers(count, height, width), _Layers(count, height, width)
    if state is not None:
        done, known = state.done, len(state.layers["rows"])
        fits, remedy = known == count and 0 <= done <= count, "Give the state of this sequence, or none."
        require(fits, "state", f"{done} of {known} frames", f"a state of {count} frames", remedy)
        proposals.restore(state.proposals)
        layers.restore(state.layers)
    for t in range(0 if state is None else state.done, count):
        masks = np.asarray(segment(frames[t], t), bool)
        require_shape("segment", masks, ("M", height, width), "A segmenter returns masks of the frame's own size.")
        masks = masks[masks.sum((1, 2)) >= max(min_area * height * width, 1)]
        proposals.add_masks(t, masks)
        prompts = masks[_new(proposals.at(t), layers.at(t), iou_threshold)[: max(max_masklets - layers.size(t), 0)]]
        if len(prompts):
            labels = np.asarray(track(frames, t, prompts))
            require_shape("track", labels, (count, height, width), "A tracker returns one label image per frame.")
            for other, image in enumerate(labels):
                layers.add_labels(other, image, len(prompts))
        if on_checkpoint is not None:
            on_checkpoint(lambda done=t + 1: MaskletState(done, proposals.record(), layers.record()))
        if progress is not None:
            progress(t + 1, count)
    if not layers.size(0):
        return np.full((count, height, width), -1, np.int16)
    whole, area, support = joined(layers, proposals, join_rate=join_rate)
    order = np.lexsort((np.where(support >= min_support, area, -support), support < min_support))
    return clean_masklets(whole.flatten(order), min_area=min_area, min_views=min_views)


def joined(layers: "_Layers", proposals: "_Layers", *, join_rate: float) -> tuple["_Layers", np.ndarray, np.ndarray]:
    """The masklets with the parts of one object joined, their mean area (R,) px and their support (R,).

    Two masklets count as one object in a frame if some proposal there covers more than half of each; they are joined,
    the most agreed pairs first, where that holds in more than `join_rate` of the frames (two at least) that show both:
    the view consensus of mask clustering (Yan et al., CVPR 2024), between tracks instead of single masks.
    """
    tables: list[tuple[np.ndarray, ...]] = [_overlaps(layers.at(t), proposals.at(t)) for t in range(layers.count)]
    while True:
        together, both, area, support = _agreement(tables)
        rate = np.where(both >= 2, together / np.maximum(both, 1), 0.0)
        np.fill_diagonal(rate, 0.0)
        groups = np.arange(len(rate))
        free = np.ones(len(rate), bool)
        rows, columns = np.nonzero(np.triu(rate > join_rate))
        for k in np.lexsort((-both[rows, columns], -rate[rows, columns])):
            a, b = rows[k], columns[k]
            if free[a] and free[b]:  # one join a round: the next round counts anew with the union
                groups[b] = a
                free[a] = free[b] = False
        if np.array_equal(groups, np.arange(len(rate))):
            return layers, area, support
        layers = layers.grouped(groups)
        _, first, members = np.unique(groups, return_index=True, return_counts=True)
        united = np.flatnonzero(members > 1)
        for t, table in enumerate(tables):  # the others' rows stay what they were
            tables[t] = tuple(rows[first] for rows in table)
            for rows, own in zip(tables[t], _overlaps(layers.at(t)[united], proposals.at(t))):
                rows[united] = own


def _agreement(tables: list[tuple[np.ndarray, ...]]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(R, R) frames that hold both masklets in one proposal and frames that show both; (R,) mean area; (R,) support.
    `tables` holds each frame's `_overlaps` of masklets and proposals."""
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


def iou_matrix(first: Bool[np.ndarray, "a p"], second: Bool[np.ndarray, "b p"]) -> Float[np.ndarray, "a b"]:
    """(A, P) and (B, P) bool masks over P pixels -> (A, B) intersection over union; 0 where both are empty."""
    return _overlaps(sparse.csr_matrix(first, dtype=np.float32), sparse.csr_matrix(second, dtype=np.float32))[2]


def _overlaps(first: Sparse, second: Sparse) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Areas (A,) of the first masks, shared pixels (A, B), IoU (A, B): one product of sparse one-hot rows."""
    shared = (first @ second.T).toarray()
    size, other = np.diff(first.indptr), np.diff(second.indptr)
    return size, shared, shared / np.maximum(size[:, None] + other - shared, 1.0)


def clean_masklets(
    labels: Int[np.ndarray, "t h w"], *, min_area: float = 0.001, min_views: int = 2
) -> Int16[np.ndarray, "t h w"]:
    """labels (T, H, W) -> int16 labels without the masklets that fewer than `min_views` frames show, renumbered.

    A frame shows a masklet where it fills at least `min_area` of it; a smaller remnant is removed from that frame.
    """
    count = int(labels.max(initial=-1)) + 1
    if count == 0:
        return np.full(labels.shape, -1, np.int16)
    areas = np.stack([np.bincount(image[image >= 0].reshape(-1), minlength=count) for image in labels])  # (T, R)
    shown = areas >= max(min_area * labels[0].size, 1)
    kept = shown.sum(0) >= min_views
    first = np.where(kept, shown.argmax(0), len(labels))
    order = np.lexsort((np.arange(count), first))[: kept.sum()]
    number = np.full(count + 1, -1, np.int16)  # the last entry answers for label -1
    number[order] = np.arange(len(order))
    table = np.where(np.concatenate([shown, np.zeros((len(labels), 1), bool)], 1), number, -1).astype(np.int16)
    return np.stack([row[image] for row, image in zip(table, labels)])


def _new(masks: Sparse, known: Sparse, threshold: float) -> np.ndarray:
    """Rows (K,) of masks (M, P) whose IoU with all `known`, and with the better masks taken, is at most `threshold`."""
    free = _overlaps(masks, known)[2].max(1, initial=0.0) <= threshold
    among = _overlaps(masks, masks)[2]
    taken: list[int] = []
    for m in np.flatnonzero(free):
        if all(among[m, other] <= threshold for other in taken):
            taken.append(int(m))
    return np.asarray(taken, np.int64)


class _Layers:
    """Masks of many things in every frame, free to overlap, kept as runs of pixels."""

    def __init__(self, count: int, height: int, width: int):
        self.count, self.shape = count, (height, width)
        empty = np.zeros(0, np.int32)
        self._runs = [RunLengthMasks(empty, empty, empty, height * width) for _ in range(count)]

    def size(self, t: int) -> int:
        return len(self._runs[t].counts)

    def at(self, t: int) -> Sparse:
        """(R, H W) ones at frame t."""
        return self._runs[t].rows()

    def add_masks(self, t: int, masks: np.ndarray) -> None:
        """Appends masks (M, H, W) bool to frame t."""
        self._runs[t] = self._runs[t].followed_by(encode_masks(masks))

    def add_labels(self, t: int, labels: np.ndarray, number: int) -> None:
        """Appends `number` masks to frame t: the pixels (H, W) labelled 0, 1, ..."""
        pixels = np.flatnonzero((labels >= 0) & (labels < number))
        ones = np.ones(len(pixels), np.float32)
        rows = sparse.csr_matrix((ones, (labels.reshape(-1)[pixels], pixels)), shape=(number, labels.size))
        self._runs[t] = self._runs[t].followed_by(encode_rows(rows))

    def record(self) -> dict[str, np.ndarray]:
        """All masks as plain arrays (see MaskletState)."""
        return {"rows": np.array([len(runs.counts) for runs in self._runs], np.int64)} | {
            name: np.concatenate([getattr(runs, name) for runs in self._runs]) for name in ("counts", "starts", "stops")
        }

    def restore(self, record: dict[str, np.ndarray]) -> None:
        """Takes back what `record` gave."""
        counts = np.split(record["counts"], np.cumsum(record["rows"])[:-1])
        places = np.cumsum([own.sum() for own in counts])[:-1]
        starts, stops = (np.split(record[name], places) for name in ("starts", "stops"))
        pixels = self.shape[0] * self.shape[1]
        self._runs = [RunLengthMasks(*frame, pixels) for frame in zip(starts, stops, counts)]

    def grouped(self, groups: np.ndarray) -> "_Layers":
        """The layers with those of one group (R,) united, in the order of the groups."""
        names, number = np.unique(groups, return_inverse=True)
        unite = one_hot(number, len(names)).T.tocsr()
        result = _Layers(self.count, *self.shape)
        for t in range(self.count):
            united = unite @ self.at(t)
            united.sort_indices()
            result._runs[t] = encode_rows(united)
        return result

    def flatten(self, best_first: np.ndarray) -> np.ndarray:
        """(T, H, W) int16 labels: the first in `best_first` that covers a pixel owns it."""
        labels = np.full((self.count, self.shape[0] * self.shape[1]), -1, np.int16)
        for t, image in enumerate(labels):
            rows = self.at(t)
            for masklet in best_first[::-1]:
                image[rows.indices[rows.indptr[masklet] : rows.indptr[masklet + 1]]] = masklet
        return labels.reshape(self.count, *self.shape)
