"""The graph of an image's small regions: who borders on whom and how hard, and its merging into large ones.

Neighbours are merged in order of dissimilarity (as in hierarchical grouping: Uijlings et al. 2013), which mixes the
step of colour across their common border with the difference of their means: shading makes the means of one surface
differ while its borders stay soft, and texture makes borders hard while the means agree.
"""

import dataclasses
import heapq
import math

import cv2
import numpy as np
from jaxtyping import Float32, Int, Int32, Int64

from jsecon.vision.surfaces import Surface

BORDER_SHARE = 0.4
"""of the step across the border in a dissimilarity; the rest is the difference of the means"""
GROWN_AREA = 0.006
"""share of the frame from which a region counts in full"""
SMALLEST_FACTOR = 0.22
"""least factor on the dissimilarity of a small region, which grows with the root of its area: texture is made of
these"""


@dataclasses.dataclass(frozen=True)
class RegionBorders:
    """The region graph's edges: one row a pair of neighbours."""

    pairs: np.ndarray
    """(E, 2) atoms, the smaller number first."""
    length: np.ndarray
    """(E,) px of common border."""
    colour: np.ndarray
    """(E,) step of colour across the border, summed over its length, CIELAB units."""
    shape: np.ndarray
    """(E,) step of depth and normal, likewise; at most twice the unit a pixel; 0 where nothing is known."""


def region_borders(
    atoms: Int32[np.ndarray, "h w"],
    features: Float32[np.ndarray, "h w d"],
    shape: Float32[np.ndarray, "h w c"] | Surface | None,
    *,
    steepness: float = 1.0,
    most: float = 40.0,
) -> RegionBorders:
    """Who borders on whom, and how hard.

    A step is measured between pixels two to either side of the border, so that the blur of an edge does not hide it. A
    step of shape is one of its channels (H, W, C), or `steepness` times how far a surface leaves its plane; it counts
    `most` at most: one far background does not outweigh the rest of an outline.
    """
    keys, colours, shapes = [], [], []
    for axis in (0, 1):
        n = atoms.shape[axis]
        near, far = np.arange(n - 1), np.arange(1, n)
        inner, outer = np.maximum(near - 2, 0), np.minimum(far + 2, n - 1)
        a, b = np.take(atoms, near, axis), np.take(atoms, far, axis)
        cut = a != b

        def step(values, axis=axis, inner=inner, outer=outer, cut=cut):
            return np.linalg.norm(np.take(values, outer, axis)[cut] - np.take(values, inner, axis)[cut], axis=-1)

        keys.append(np.sort(np.stack([a[cut], b[cut]], -1), axis=-1))
        colours.append(step(features))
        if shape is None:
            shapes.append(np.zeros(len(colours[-1])))
        elif isinstance(shape, Surface):
            shapes.append(np.minimum(steepness * shape.off_plane(axis, inner, outer)[cut], most))
        else:
            shapes.append(np.minimum(step(shape), most))
    count = int(atoms.max()) + 1
    first, second = np.concatenate(keys).T.astype(np.int64)
    pairs, inverse = np.unique(first * count + second, return_inverse=True)
    return RegionBorders(
        np.stack(np.divmod(pairs, count), -1),
        np.bincount(inverse, minlength=len(pairs)).astype(np.float64),
        np.bincount(inverse, np.concatenate(colours), len(pairs)),
        np.bincount(inverse, np.concatenate(shapes), len(pairs)),
    )


def merge_regions(
    atoms: Int32[np.ndarray, "h w"],
    features: Float32[np.ndarray, "h w d"],
    edges: RegionBorders,
    *,
    distance: float,
    min_area: float,
) -> Int32[np.ndarray, "h w"]:
    """Merges neighbours, the most alike first, until none is nearer than `distance`; then gives away what is too small
    (below `min_area`, px) or too thin to its most alike neighbour.

    Dissimilarity: the step of colour across the border and the difference of the mean colours, mixed, less for small
    regions (they are what texture is made of); and the step of shape, as the other leg of a right triangle. Returns
    labels (H, W) int32 0 .. M-1.
    """
    # Numbered as a reader meets them, so that ties fall the same way whatever the atoms are called.
    flat = relabel_sequential(atoms.reshape(-1))
    count = int(flat.max()) + 1
    first = np.empty(count, np.int64)
    first[flat[::-1]] = np.arange(flat.size)[::-1]
    number = np.argsort(np.argsort(first))
    atoms, pairs = number[flat].reshape(atoms.shape), np.sort(number[edges.pairs], axis=-1)
    flat = atoms.reshape(-1)
    sums_of = np.stack([edges.colour, edges.shape, edges.length], -1)
    # Plain numbers from here on: NumPy takes longer over a handful of them than the sums themselves.
    area = np.bincount(flat, minlength=count).astype(np.float64).tolist()
    channels = [np.bincount(flat, features[..., c].reshape(-1), count) for c in range(features.shape[-1])]
    sums = np.stack(channels, -1).tolist()
    means = [[value / size for value in row] for row, size in zip(sums, area)]
    # neighbour -> sums of the step of colour, of the step of shape, and length of the border
    links: list[dict[int, tuple[float, float, float]]] = [{} for _ in range(count)]
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    for (a, b), steps in zip(pairs[order].tolist(), sums_of[order].tolist()):
        links[a][b] = links[b][a] = tuple(steps)
    parent = list(range(count))
    version = [0] * count

    full = GROWN_AREA * atoms.size

    def dissimilarity(a: int, b: int) -> float:
        colour, shape, border = links[a][b]
        gap = math.dist(means[a], means[b])
        grown = min(max((min(area[a], area[b]) / full) ** 0.5, SMALLEST_FACTOR), 1.0)
        return math.hypot(grown * (BORDER_SHARE * colour / border + (1.0 - BORDER_SHARE) * gap), shape / border)

    def absorb(a: int, b: int) -> None:
        """b becomes part of a."""
        parent[b] = a
        area[a] += area[b]
        sums[a] = [x + y for x, y in zip(sums[a], sums[b])]
        means[a] = [value / area[a] for value in sums[a]]
        version[a] += 1
        for other, (colour, shape, border) in links[b].items():
            del links[other][b]
            if other != a:
                known = links[a].get(other, (0.0, 0.0, 0.0))
                links[a][other] = links[other][a] = (known[0] + colour, known[1] + shape, known[2] + border)
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
    thin = ~np.isin(np.arange(count), _cores(_roots(parent)[atoms]))
    for a in sorted((a for a in range(count) if parent[a] == a), key=lambda a: area[a]):
        if parent[a] == a and (area[a] < min_area or thin[a]) and links[a]:
            absorb(min(links[a], key=lambda other: dissimilarity(a, other)), a)
    return relabel_sequential(_roots(parent)[atoms]).astype(np.int32)


def relabel_sequential(ids: Int[np.ndarray, "*shape"]) -> Int64[np.ndarray, "*shape"]:
    """Small ids >= 0 as 0 .. K-1 in their own order: np.unique's inverse by a table, which takes no sorting."""
    used = np.zeros(int(ids.max()) + 1, bool)
    used[ids] = True
    return (np.cumsum(used) - 1)[ids]


def _roots(parents: list[int]) -> np.ndarray:
    """Where each chain of parents ends; each pass halves the chains."""
    parent = np.asarray(parents)
    while not np.array_equal(parent, parent[parent]):
        parent = parent[parent]
    return parent


def _cores(labels: np.ndarray) -> np.ndarray:
    """The labels that hold a 5x5 square: the others are slivers along an edge, blurred between its two sides."""
    image = labels.astype(np.float32)
    square = np.ones((5, 5), np.uint8)
    return np.unique(labels[cv2.dilate(image, square) == cv2.erode(image, square)])
