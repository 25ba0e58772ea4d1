"""Masklets: one identity an object through all frames (Algorithm 1 of the paper), over any segmenter and tracker."""

from collections.abc import Callable

import numpy as np

from jsecon.errors import require
from jsecon.vision.protocols import Segmenter, Tracker

Progress = Callable[[int, int], None]


def masklets(frames: np.ndarray, segment: Segmenter, track: Tracker, *, iou_threshold: float = 0.5, min_area: float = 0.001,
             max_masklets: int = 1000, min_views: int = 2, min_support: float = 0.5,
              progress: Progress | None = None) -> np.ndarray:
    """Labels (T, H, W) int16 of the masklets of a sequence, -1 = none.

    frames (T, H, W, 3) uint8. For each frame t in order, each proposal that fills at least `min_area` (share of the
    frame) and whose IoU with every masklet's mask at t is at most `iou_threshold` (the paper's kappa; IoU taken at frame
    t itself, REFERENCE 0.1) becomes a prompt, and the frame's prompts are tracked through the whole sequence. Proposals
    of one frame that repeat each other (IoU above kappa) count once, the better first.

    Overlaps: a masklet's support is the mean, over the frames in which it is seen, of its best IoU with that frame's
    proposals. A pixel belongs to the smallest masklet there (in mean area) whose support is at least `min_support`,
    else to the best supported one. So what the segmenter finds again and again is cut out of what surrounds it, and a
    fragment or a merger that it found once gives way.

    Then masklets seen in fewer than `min_views` frames (with `min_area` in each) are dropped and the rest renumbered in
    order of appearance; at most `max_masklets` are kept, the first found. `progress(done, total)` counts frames.
    """
    require(frames.ndim == 4 and frames.shape[3] == 3 and frames.dtype == np.uint8, "frames",
            got=(frames.shape, frames.dtype), expected="(T, H, W, 3) uint8", remedy="Stack RGB frames of one size.")
    count, height, width = frames.shape[:3]
    proposals = []
    layers = _Layers(count, height, width)
    support: list[np.ndarray] = []
    for t in range(count):
        masks = np.asarray(segment(frames[t], t), bool)
        require(masks.ndim == 3 and masks.shape[1:] == (height, width), "segment", got=masks.shape,
                expected=f"(M, {height}, {width})", remedy="A segmenter returns masks of the frame's own size.")
        masks = masks[masks.sum((1, 2)) >= max(min_area * height * width, 1)]
        proposals.append(np.packbits(masks.reshape(len(masks), -1), axis=1))
        prompts = _new(masks, layers.at(t), iou_threshold)[:max(max_masklets - layers.count, 0)]
        if len(prompts):
            labels = np.asarray(track(frames, t, prompts))
            require(labels.shape == (count, height, width), "track", got=labels.shape,
                    expected=str((count, height, width)), remedy="A tracker returns one label image a frame.")
            layers.add(labels, len(prompts))
        if progress is not None:
            progress(t + 1, count)
    for t in range(count):
        masks = np.unpackbits(proposals[t], axis=1, count=height * width).astype(bool)
        support.append(iou_matrix(layers.at(t).reshape(-1, height * width), masks).max(1, initial=0.0))
    area = np.stack([layers.area(t) for t in range(count)]) if layers.count else np.zeros((count, 0))
    views = np.maximum((area > 0).sum(0), 1)
    mean_support = (np.stack(support) * (area > 0)).sum(0) / views
    trusted = mean_support >= min_support
    order = np.lexsort((np.where(trusted, area.sum(0) / views, -mean_support), ~trusted))
    return clean_masklets(layers.flatten(order), min_area=min_area, min_views=min_views)


def iou_matrix(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(A, P) and (B, P) bool masks over P pixels -> (A, B) intersection over union; 0 where both are empty."""
    a, b = first.astype(np.float32), second.astype(np.float32)
    shared = a @ b.T
    union = a.sum(1)[:, None] + b.sum(1) - shared
    return np.where(union > 0, shared / np.maximum(union, 1.0), 0.0)


def clean_masklets(labels: np.ndarray, *, min_area: float = 0.001, min_views: int = 2) -> np.ndarray:
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
    order = np.lexsort((np.arange(count), first))[:kept.sum()]
    number = np.full(count + 1, -1, np.int16)  # the last entry answers for label -1
    number[order] = np.arange(len(order))
    table = np.where(np.concatenate([shown, np.zeros((len(labels), 1), bool)], 1), number, -1).astype(np.int16)
    return np.stack([row[image] for row, image in zip(table, labels)])


def _new(masks: np.ndarray, known: np.ndarray, threshold: float) -> np.ndarray:
    """The masks (M, H, W) whose IoU with all `known` (R, H, W), and with the better masks taken, is at most `threshold`."""
    pixels = masks.shape[1] * masks.shape[2]
    flat = masks.reshape(-1, pixels)
    free = iou_matrix(flat, known.reshape(-1, pixels)).max(1, initial=0.0) <= threshold
    among = iou_matrix(flat, flat)
    taken: list[int] = []
    for m in np.flatnonzero(free):
        if all(among[m, other] <= threshold for other in taken):
            taken.append(int(m))
    return masks[taken]


class _Layers:
    """Masklets before their overlaps are resolved: one bit a pixel, since hundreds of them overlap."""

    def __init__(self, count: int, height: int, width: int):
        self.shape = (height, width)
        self.count = 0
        self._bits: list[list[np.ndarray]] = [[] for _ in range(count)]

    def add(self, labels: np.ndarray, number: int) -> None:
        for t, image in enumerate(labels):
            masks = image.reshape(-1)[None] == np.arange(number)[:, None]
            self._bits[t].append(np.packbits(masks, axis=1))
        self.count += number

    def at(self, t: int) -> np.ndarray:
        """(R, H, W) bool masks of all masklets at frame t."""
        if not self._bits[t]:
            return np.zeros((0, *self.shape), bool)
        bits = np.concatenate(self._bits[t])
        return np.unpackbits(bits, axis=1, count=self.shape[0] * self.shape[1]).astype(bool).reshape(-1, *self.shape)

    def area(self, t: int) -> np.ndarray:
        """(R,) pixels of all masklets at frame t."""
        return self.at(t).sum((1, 2))

    def flatten(self, best_first: np.ndarray) -> np.ndarray:
        """(T, H, W) int16 labels: the first in `best_first` that covers a pixel owns it."""
        labels = np.full((len(self._bits), *self.shape), -1, np.int16)
        for t, image in enumerate(labels):
            masks = self.at(t)
            for masklet in best_first[::-1]:
                image[masks[masklet]] = masklet
        return labels
