"""Region proposals without any weights: colour, texture and, where known, depth and normals, merged over a region graph.

The frame is smoothed, cut into small regions that follow its edges (graph segmentation: Felzenszwalb & Huttenlocher
2004), and neighbours are merged in order of dissimilarity (as in hierarchical grouping: Uijlings et al. 2013). Two
neighbours are alike if the colours on both sides of their common border are, or if their means are: shading makes the
means of one surface differ while its borders stay soft, and texture makes borders hard while the means agree.
"""

import dataclasses
import heapq
from collections.abc import Callable, Sequence

import cv2
import numpy as np

from jsecon.errors import require

Maps = Callable[[int], np.ndarray | None] | Sequence[np.ndarray] | np.ndarray | None
"""per-frame maps: a function of the frame's index, or an array or list with one map a frame, or None"""


@dataclasses.dataclass(frozen=True)
class ClassicalSegmenter:
    """Segmenter (jsecon.vision.protocols) from OpenCV alone. Thresholds are in CIELAB units (a just noticeable step is ~2)."""

    merge_distance: float = 13.0
    """neighbours less dissimilar than this are one region, CIELAB units"""
    lightness_weight: float = 0.5
    """weight of L beside a and b: shading and soft shadows change L"""
    smoothing: float = 20.0
    """colour radius of the mean-shift filter, 8-bit units; 0 leaves it out"""
    min_area: float = 0.0012
    """smaller regions are given to their most alike neighbour or dropped; share of the frame"""
    max_regions: int = 64
    """the best so many are returned"""
    depths: Maps = None
    """z-depth (H, W) of a frame, 0 = unknown: a jump between neighbours keeps them apart"""
    normals: Maps = None
    """unit normals (H, W, 3) of a frame, 0 = unknown: a crease keeps neighbours apart"""
    depth_jump: float = 0.04
    """relative step of depth that counts as much as `merge_distance`"""
    crease_degrees: float = 50.0
    """angle between normals that counts as much as `merge_distance`"""

    def __call__(self, frame: np.ndarray, index: int) -> np.ndarray:
        """frame (H, W, 3) uint8 -> masks (M, H, W) bool, a partition of the frame but for specks, best first."""
        labels = self.partition(frame, index)
        return masks_best_first(frame, labels, max_regions=self.max_regions, min_area=self.min_area)

    def partition(self, frame: np.ndarray, index: int) -> np.ndarray:
        """frame (H, W, 3) uint8 -> labels (H, W) int32, 0 .. M-1, every pixel labelled, each label connected."""
        require(frame.ndim == 3 and frame.shape[2] == 3 and frame.dtype == np.uint8, "frame", got=(frame.shape, frame.dtype),
                expected="(H, W, 3) uint8", remedy="Give RGB frames as 8-bit arrays.")
        features = colour_features(frame, lightness_weight=self.lightness_weight, smoothing=self.smoothing)
        depth = _map_of(self.depths, index, frame.shape[:2])
        normal = _map_of(self.normals, index, (*frame.shape[:2], 3))
        atoms = oversegment(features)
        pairs, barrier, length = borders(atoms, features, depth, normal, merge_distance=self.merge_distance,
                                         depth_jump=self.depth_jump, crease_degrees=self.crease_degrees)
        minimum = self.min_area * frame.shape[0] * frame.shape[1]
        return merge(atoms, features, pairs, barrier, length, distance=self.merge_distance, min_area=minimum)


def _map_of(maps: Maps, index: int, shape: tuple[int, ...]) -> np.ndarray | None:
    found = maps(index) if callable(maps) else None if maps is None else maps[index]
    if found is None:
        return None
    found = np.asarray(found, np.float32)
    require(found.shape == shape, "depth or normal map", got=found.shape, expected=str(shape),
            remedy="Give one map a frame, of the frame's own size.")
    return found


def colour_features(frame: np.ndarray, *, lightness_weight: float, smoothing: float) -> np.ndarray:
    """(H, W, 3) uint8 -> (H, W, 3) float32: weighted L, a and b of the smoothed frame, CIELAB units."""
    smooth = frame
    if smoothing > 0:
        smooth = cv2.pyrMeanShiftFiltering(np.ascontiguousarray(frame), 5, smoothing, maxLevel=0)
        smooth = cv2.bilateralFilter(smooth, 7, 2.0 * smoothing, 3.0)
    lab = cv2.cvtColor(smooth.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)
    return lab * np.asarray([lightness_weight, 1.0, 1.0], np.float32)


def oversegment(features: np.ndarray, *, scale: float = 30.0, min_size: int = 16) -> np.ndarray:
    """(H, W, 3) -> (H, W) int32 small connected regions that follow the edges (Felzenszwalb & Huttenlocher 2004)."""
    graph = cv2.ximgproc.segmentation.createGraphSegmentation(sigma=0.5, k=scale, min_size=min_size)
    return np.asarray(graph.processImage(np.ascontiguousarray(features)), np.int32)


def borders(atoms: np.ndarray, features: np.ndarray, depth: np.ndarray | None, normal: np.ndarray | None, *,
            merge_distance: float, depth_jump: float, crease_degrees: float
            ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Neighbouring atoms (E, 2), the mean dissimilarity across their border (E,), CIELAB units, and its length (E,), px.

    A border's step is measured between pixels two to either side, so that the blur of an edge does not hide it.
    """
    first, second, step = [], [], []
    for axis in (0, 1):
        n = atoms.shape[axis]
        near, far = np.arange(n - 1), np.arange(1, n)
        inner, outer = np.maximum(near - 2, 0), np.minimum(far + 2, n - 1)
        a, b = np.take(atoms, near, axis), np.take(atoms, far, axis)
        cut = a != b
        where_in, where_out = np.take(features, inner, axis), np.take(features, outer, axis)
        jump = np.linalg.norm(where_out[cut] - where_in[cut], axis=-1)
        if depth is not None:
            d0, d1 = np.take(depth, inner, axis)[cut], np.take(depth, outer, axis)[cut]
            known = (d0 > 0) & (d1 > 0)
            relative = np.abs(d1 - d0) / np.where(known, np.minimum(d0, d1), 1.0)
            jump = np.hypot(jump, np.where(known, np.minimum(relative / depth_jump, 2.0), 0.0) * merge_distance)
        if normal is not None:
            n0, n1 = np.take(normal, inner, axis)[cut], np.take(normal, outer, axis)[cut]
            known = (np.abs(n0).sum(-1) > 0) & (np.abs(n1).sum(-1) > 0)
            angle = np.degrees(np.arccos(np.clip((n0 * n1).sum(-1), -1.0, 1.0)))
            jump = np.hypot(jump, np.where(known, np.minimum(angle / crease_degrees, 2.0), 0.0) * merge_distance)
        first.append(np.minimum(a[cut], b[cut]))
        second.append(np.maximum(a[cut], b[cut]))
        step.append(jump)
    keys = np.stack([np.concatenate(first), np.concatenate(second)], -1)
    if len(keys) == 0:
        return np.zeros((0, 2), np.int32), np.zeros(0), np.zeros(0)
    pairs, inverse, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    total = np.bincount(inverse.reshape(-1), np.concatenate(step), len(pairs))
    return pairs, total / counts, counts.astype(np.float64)


def merge(atoms: np.ndarray, features: np.ndarray, pairs: np.ndarray, barrier: np.ndarray, length: np.ndarray, *,
          distance: float, min_area: float) -> np.ndarray:
    """Merges neighbours, the most alike first, until none is nearer than `distance`; then gives away what is too small.

    Returns labels (H, W) int32 0 .. M-1.
    """
    count = int(atoms.max()) + 1
    flat = atoms.reshape(-1)
    area = np.bincount(flat, minlength=count).astype(np.float64)
    sums = np.stack([np.bincount(flat, features[..., c].reshape(-1), count) for c in range(features.shape[-1])], -1)
    links: list[dict[int, tuple[float, float]]] = [{} for _ in range(count)]  # neighbour -> (sum of steps, length)
    for (a, b), step, border in zip(pairs.tolist(), barrier.tolist(), length.tolist()):
        links[a][b] = links[b][a] = (step * border, border)
    parent = np.arange(count)
    version = np.zeros(count, np.int64)

    def dissimilarity(a: int, b: int) -> float:
        steps, border = links[a][b]
        gap = float(np.linalg.norm(sums[a] / area[a] - sums[b] / area[b]))
        return 0.65 * steps / border + 0.35 * gap

    def absorb(a: int, b: int) -> None:
        """b becomes part of a."""
        parent[b] = a
        area[a] += area[b]
        sums[a] += sums[b]
        version[a] += 1
        for other, (steps, border) in links[b].items():
            del links[other][b]
            if other == a:
                continue
            known = links[a].get(other, (0.0, 0.0))
            links[a][other] = links[other][a] = (known[0] + steps, known[1] + border)
        links[b] = {}

    heap = [(dissimilarity(a, b), a, b, 0, 0) for a in range(count) for b in links[a] if a < b]
    heapq.heapify(heap)
    while heap:
        cost, a, b, version_a, version_b = heapq.heappop(heap)
        if parent[a] != a or parent[b] != b or version[a] != version_a or version[b] != version_b:
            continue
        if cost >= distance:
            break
        if area[a] < area[b]:
            a, b = b, a
        absorb(a, b)
        for other in links[a]:
            heapq.heappush(heap, (dissimilarity(a, other), a, other, version[a], version[other]))
    small = sorted((int(a) for a in np.flatnonzero((parent == np.arange(count)) & (area < min_area) & (area > 0))),
                   key=lambda a: area[a])
    for a in small:
        if parent[a] == a and area[a] < min_area and links[a]:
            absorb(min(links[a], key=lambda other: dissimilarity(a, other)), a)
    roots = parent
    while True:  # pointer jumping: each pass halves the paths
        further = roots[roots]
        if np.array_equal(further, roots):
            break
        roots = further
    return np.unique(roots[flat], return_inverse=True)[1].reshape(atoms.shape).astype(np.int32)


def masks_best_first(frame: np.ndarray, labels: np.ndarray, *, max_regions: int, min_area: float) -> np.ndarray:
    """labels (H, W) -> masks (M, H, W) bool, the most contrasted and the larger first; specks dropped.

    A region's rank is the mean edge strength along its border times the square root of its area: a long clear outline.
    """
    lab = cv2.cvtColor(frame.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)
    gradient = sum(np.hypot(cv2.Sobel(lab[..., c], cv2.CV_32F, 1, 0), cv2.Sobel(lab[..., c], cv2.CV_32F, 0, 1))
                   for c in range(3))
    count = int(labels.max()) + 1
    area = np.bincount(labels.reshape(-1), minlength=count)
    edge = np.zeros(labels.shape, bool)
    edge[:, 1:] |= labels[:, 1:] != labels[:, :-1]
    edge[:, :-1] |= labels[:, 1:] != labels[:, :-1]
    edge[1:] |= labels[1:] != labels[:-1]
    edge[:-1] |= labels[1:] != labels[:-1]
    rim = np.bincount(labels[edge], minlength=count)
    strength = np.bincount(labels[edge], gradient[edge], count) / np.maximum(rim, 1)
    rank = np.argsort(-strength * np.sqrt(area), kind="stable")
    rank = rank[area[rank] >= min_area * labels.size][:max_regions]
    return labels[None] == rank[:, None, None]
