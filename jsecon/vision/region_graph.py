"""Region adjacency graph of an image, and its merging into large regions. Host code.

Neighbours are merged in order of dissimilarity (as in hierarchical grouping: Uijlings et al. 2013), which mixes the
step of colour across their common border with the difference of their means: shading makes the means of one surface
differ while its borders stay soft, and texture makes borders hard while the means agree.
"""

import dataclasses
import heapq
import math

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, Int32, Int64

from jsecon.vision.surfaces import Surface

_MAX_STEP = 40.0
"""Largest step of shape per pixel, so that one distant background does not outweigh the rest of an outline."""
_BORDER_SHARE = 0.4
"""Weight of the step across the border in a dissimilarity; the rest is the difference of the means."""
_FULL_AREA, _SMALLEST_FACTOR = 0.006, 0.22
"""Area from which a region has full dissimilarity, as a share of the frame; and the factor on the dissimilarity of the
smallest regions, which texture consists of. The factor grows with the root of the area."""


@dataclasses.dataclass(frozen=True)
class _RegionBorders:
    """Edges of the graph, one row per pair of neighbours."""

    pairs: np.ndarray
    """(E, 2) regions, the smaller number first."""
    length: np.ndarray
    """(E,) length of the common border, px."""
    colour: np.ndarray
    """(E,) sum of the step of colour across the border, CIELAB units."""
    shape: np.ndarray
    """(E,) sum of the step of shape across the border; 0 if the surface is unknown."""


def _region_borders(
    superpixels: Int32[np.ndarray, "h w"],
    features: Float32[np.ndarray, "h w d"],
    surface: Surface | None,
    steepness: float,
) -> _RegionBorders:
    """Measures the borders between regions.

    Steps are measured between pixels two px to either side of a border, so that the blur of an edge does not hide them.
    """
    keys, colours, shapes = [], [], []
    for axis in (0, 1):
        n = superpixels.shape[axis]
        near, far = np.arange(n - 1), np.arange(1, n)
        inner, outer = np.maximum(near - 2, 0), np.minimum(far + 2, n - 1)
        a, b = np.take(superpixels, near, axis), np.take(superpixels, far, axis)
        cut = a != b

        def step(values, axis=axis, inner=inner, outer=outer, cut=cut):
            return np.linalg.norm(np.take(values, outer, axis)[cut] - np.take(values, inner, axis)[cut], axis=-1)

        keys.append(np.sort(np.stack([a[cut], b[cut]], -1), axis=-1))
        colours.append(step(features))
        if surface is None:
            shapes.append(np.zeros(len(colours[-1])))
        else:
            shapes.append(np.minimum(steepness * _off_plane(surface, axis, inner, outer)[cut], _MAX_STEP))
    count = int(superpixels.max()) + 1
    first, second = np.concatenate(keys).T.astype(np.int64)
    pairs, inverse = np.unique(first * count + second, return_inverse=True)
    return _RegionBorders(
        np.stack(np.divmod(pairs, count), -1),
        np.bincount(inverse, minlength=len(pairs)).astype(np.float64),
        np.bincount(inverse, np.concatenate(colours), len(pairs)),
        np.bincount(inverse, np.concatenate(shapes), len(pairs)),
    )


def _off_plane(
    surface: Surface, axis: int, near: Int[np.ndarray, " n"], far: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "_ _"]:
    """Computes the distance of pixels from each other's planes, 0 along any plane however steeply it is seen.

    The pixels are those of two indices along an image axis. The distance is the smaller one, as a share of the
    smaller z.
    """
    a, b = np.take(surface.points, near, axis), np.take(surface.points, far, axis)
    off = [np.abs(np.einsum("...k,...k", b - a, np.take(surface.normals, which, axis))) for which in (near, far)]
    return np.minimum(*off) / np.maximum(np.minimum(a[..., 2], b[..., 2]), 1e-6)


def merge_regions(
    superpixels: Int32[np.ndarray, "h w"],
    features: Float32[np.ndarray, "h w d"],
    surface: Surface | None,
    *,
    distance: float,
    min_area: float,
    steepness: float = 1.0,
) -> Int32[np.ndarray, "h w"]:
    """Merges the most similar neighbours first, until all are at least `distance` apart.

    The dissimilarity mixes the step of colour across the border with the difference of the mean colours, with a lower
    weight for small regions, which texture consists of; the step of shape is the other leg of a right triangle. Finally
    regions that are too small or too thin join their most similar neighbour.
    """
    edges = _region_borders(superpixels, features, surface, steepness)
    # Numbered by first appearance, so that ties do not depend on the numbers of the superpixels.
    flat = relabel_sequential(superpixels.reshape(-1))
    count = int(flat.max()) + 1
    first = np.empty(count, np.int64)
    first[flat[::-1]] = np.arange(flat.size)[::-1]
    number = np.argsort(np.argsort(first))
    superpixels, pairs = number[flat].reshape(superpixels.shape), np.sort(number[edges.pairs], axis=-1)
    flat = superpixels.reshape(-1)
    sums_of = np.stack([edges.colour, edges.shape, edges.length], -1)
    # Python numbers from here on: they are faster than small NumPy arrays.
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

    full = _FULL_AREA * superpixels.size

    def dissimilarity(a: int, b: int) -> float:
        colour, shape, border = links[a][b]
        gap = math.dist(means[a], means[b])
        grown = min(max((min(area[a], area[b]) / full) ** 0.5, _SMALLEST_FACTOR), 1.0)
        return math.hypot(grown * (_BORDER_SHARE * colour / border + (1.0 - _BORDER_SHARE) * gap), shape / border)

    def absorb(a: int, b: int) -> None:
        """Joins b to a."""
        parent[b] = a
        area[a] += area[b]
        sums[a] = [x + y for x, y in zip(sums[a], sums[b])]
        means[a] = [value / area[a] for value in sums[a]]
        version[a] += 1
        for other, (colour, shape, border) in links[b].items():
            del links[other][b]
            if other != a:
                sums_a = links[a].get(other, (0.0, 0.0, 0.0))
                links[a][other] = links[other][a] = (sums_a[0] + colour, sums_a[1] + shape, sums_a[2] + border)
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
    thin = ~np.isin(np.arange(count), _cores(_roots(parent)[superpixels]))
    for a in sorted((a for a in range(count) if parent[a] == a), key=lambda a: area[a]):
        if parent[a] == a and (area[a] < min_area or thin[a]) and links[a]:
            absorb(min(links[a], key=lambda other: dissimilarity(a, other)), a)
    return relabel_sequential(_roots(parent)[superpixels]).astype(np.int32)


def relabel_sequential(ids: Int[np.ndarray, "*shape"]) -> Int64[np.ndarray, "*shape"]:
    """Renumbers small ids >= 0 without gaps, in the same order: the inverse of np.unique without sorting."""
    used = np.zeros(int(ids.max()) + 1, bool)
    used[ids] = True
    return (np.cumsum(used) - 1)[ids]


def _roots(parents: list[int]) -> np.ndarray:
    """Root of each chain of parents; each pass halves the chains."""
    parent = np.asarray(parents)
    while not np.array_equal(parent, parent[parent]):
        parent = parent[parent]
    return parent


def _cores(labels: np.ndarray) -> np.ndarray:
    """Labels that contain a 5x5 square; the others are slivers along a blurred edge."""
    image = labels.astype(np.float32)
    square = np.ones((5, 5), np.uint8)
    return np.unique(labels[cv2.dilate(image, square) == cv2.erode(image, square)])
