"""Region proposals without any weights: colour, texture and, where known, depth and normals, merged over a region
graph.

The frame is smoothed, cut into small regions that follow its edges (graph segmentation: Felzenszwalb & Huttenlocher
2004), and neighbours are merged in order of dissimilarity (as in hierarchical grouping: Uijlings et al. 2013), which
mixes the step of colour across their common border with the difference of their means: shading makes the means of one
surface differ while its borders stay soft, and texture makes borders hard while the means agree.
"""

import dataclasses
import heapq
import math
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8

from jsecon.errors import require
from jsecon.vision.relief import geometry_features
from jsecon.vision.surfaces import Surface

BORDER_SHARE = 0.4
"""of the step across the border in a dissimilarity; the rest is the difference of the means"""
GROWN_AREA = 0.006
"""share of the frame from which a region counts in full"""
SMALLEST_FACTOR = 0.22
"""least factor on the dissimilarity of a small region, which grows with the root of its area: texture is made of
these"""

GRANULARITIES: dict[str, dict[str, float]] = {
    "fine": {"merge_distance": 10.0},
    "medium": {"merge_distance": 16.0},
    "coarse": {"merge_distance": 28.0, "depth_jump": 0.06},
}
"""settings of ClassicalSegmenter by how large its regions are; the coarse one joins the colours of one thing, and so
needs depth to part things"""
Maps = Callable[[int], np.ndarray | None] | Sequence[np.ndarray] | np.ndarray | None
"""per-frame maps: a function of the frame's index, or an array or list with one map a frame, or None"""


@dataclasses.dataclass(frozen=True)
class ClassicalSegmenter:
    """Segmenter (jsecon.vision.protocols) from OpenCV alone. Thresholds are in CIELAB units (a just noticeable step is
    ~2)."""

    merge_distance: float = 16.0
    """neighbours less dissimilar than this are one region, CIELAB units"""
    lightness_weight: float = 1.0
    """weight of L beside a and b: less joins more shading, and more things alike in hue"""
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
    surfaces: Callable[[int], Surface | None] | None = None
    """the surface of a frame, None = unknown, in place of `depths` and `normals`: then regions also keep apart by their
    mean normals, and a step of depth is one off the plane, since on a wall seen from its side depth jumps all along"""

    def __call__(self, frame: np.ndarray, index: int) -> Bool[np.ndarray, "m h w"]:
        """frame (H, W, 3) uint8 -> masks (M, H, W) bool, a partition of the frame but for specks, best first."""
        labels = self.partition(frame, index)
        return masks_best_first(frame, labels, max_regions=self.max_regions, min_area=self.min_area)

    def partition(self, frame: np.ndarray, index: int) -> Int32[np.ndarray, "h w"]:
        """frame (H, W, 3) uint8 -> labels (H, W) int32, 0 .. M-1, every pixel labelled, each label connected."""
        require(
            frame.ndim == 3 and frame.shape[2] == 3 and frame.dtype == np.uint8,
            "frame",
            got=(frame.shape, frame.dtype),
            expected="(H, W, 3) uint8",
            remedy="Give RGB frames as 8-bit arrays.",
        )
        features = colour_features(frame, lightness_weight=self.lightness_weight, smoothing=self.smoothing)
        minimum = self.min_area * frame.shape[0] * frame.shape[1]
        surface = None if self.surfaces is None else self.surfaces(index)
        if surface is not None:
            features, seeds = self._with_surface(features, surface)
            atoms = oversegment(seeds)
            edges = borders(atoms, features, surface, steepness=self.merge_distance / self.depth_jump)
            return merge(atoms, features, edges, distance=self.merge_distance, min_area=minimum)
        shape = geometry_features(
            _map_of(self.depths, index, frame.shape[:2]),
            _map_of(self.normals, index, frame.shape),
            unit=self.merge_distance,
            depth_jump=self.depth_jump,
            crease_degrees=self.crease_degrees,
        )
        atoms = oversegment(features if shape is None else np.concatenate([features, shape], -1))
        return merge(atoms, features, borders(atoms, features, shape), distance=self.merge_distance, min_area=minimum)

    def _with_surface(self, colour: np.ndarray, surface: Surface) -> tuple[np.ndarray, np.ndarray]:
        """(H, W, 6) colour and normal, in which a crease weighs as a step of `merge_distance`; and (H, W, 7) what small
        regions are cut by: the same, the normal at half its weight, with depth."""
        require(
            surface.points.shape == surface.normals.shape == colour.shape,
            "surface",
            got=(surface.points.shape, surface.normals.shape),
            expected=str(colour.shape),
            remedy="Give surfaces of the frame's own size.",
        )
        turned = surface.normals * np.float32(
            self.merge_distance / (2.0 * np.sin(np.radians(self.crease_degrees) / 2.0))
        )
        depth = np.log(np.maximum(surface.points[..., 2:], 1e-6)) * np.float32(
            0.5 * self.merge_distance / np.log1p(self.depth_jump)
        )
        return np.concatenate([colour, turned], -1), np.concatenate([colour, 0.5 * turned, depth], -1)


def _map_of(maps: Maps, index: int, shape: tuple[int, ...]) -> np.ndarray | None:
    found = maps(index) if callable(maps) else None if maps is None else maps[index]
    if found is None:
        return None
    found = np.asarray(found, np.float32)
    require(
        found.shape == shape,
        "depth or normal map",
        got=found.shape,
        expected=str(shape),
        remedy="Give one map a frame, of the frame's own size.",
    )
    return found


def colour_features(
    frame: UInt8[np.ndarray, "h w 3"], *, lightness_weight: float, smoothing: float
) -> Float32[np.ndarray, "h w 3"]:
    """(H, W, 3) uint8 -> (H, W, 3) float32: weighted L, a and b of the smoothed frame, CIELAB units."""
    smooth = adapted(frame)
    if smoothing > 0:
        smooth = cv2.pyrMeanShiftFiltering(smooth, 5, smoothing, maxLevel=0)
        smooth = cv2.bilateralFilter(smooth, 7, 2.0 * smoothing, 3.0)
    lab = cv2.cvtColor(smooth.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)
    return lab * np.asarray([lightness_weight, 1.0, 1.0], np.float32)


def adapted(
    frame: UInt8[np.ndarray, "h w 3"], *, dark: float = 0.22, light: float = 0.3, most: float = 8.0
) -> UInt8[np.ndarray, "h w 3"]:
    """(H, W, 3) uint8 with lifted shadows or lowered lights, where the median of linear luminance is below `dark` (a
    mid grey) or above `light`.

    CIELAB's steps are those of an eye adapted to the scene's white; in a dark photograph those between dark things are
    too small, in a bright one those between white walls. x -> g x / (1 + (g - 1) x) multiplies the odds by g, at most
    `most` or its inverse, and leaves black and white where they are.
    """
    linear = (np.arange(256, dtype=np.float32) / 255.0) ** 2.2
    luminance = linear[frame] @ np.asarray([0.2126, 0.7152, 0.0722], np.float32)
    middle = min(max(float(np.median(luminance)), 1e-6), 1.0 - 1e-6)
    target = min(max(middle, dark), light)
    gain = min(max(target * (1.0 - middle) / (middle * (1.0 - target)), 1.0 / most), most)
    table = np.round(255.0 * (gain * linear / (1.0 + (gain - 1.0) * linear)) ** (1.0 / 2.2)).astype(np.uint8)
    return table[frame]


def oversegment(
    features: Float32[np.ndarray, "h w c"], *, scale: float = 30.0, min_size: int = 16
) -> Int32[np.ndarray, "h w"]:
    """(H, W, C) -> (H, W) int32 small connected regions that follow the edges (Felzenszwalb & Huttenlocher 2004)."""
    graph = cv2.ximgproc.segmentation.createGraphSegmentation(sigma=0.5, k=scale, min_size=min_size)
    return np.asarray(graph.processImage(np.ascontiguousarray(features)), np.int32)


@dataclasses.dataclass(frozen=True)
class Borders:
    """The region graph's edges: one row a pair of neighbours."""

    pairs: np.ndarray
    """(E, 2) atoms, the smaller number first."""
    length: np.ndarray
    """(E,) px of common border."""
    colour: np.ndarray
    """(E,) step of colour across the border, summed over its length, CIELAB units."""
    shape: np.ndarray
    """(E,) step of depth and normal, likewise; at most twice the unit a pixel; 0 where nothing is known."""


def borders(
    atoms: Int32[np.ndarray, "h w"],
    features: Float32[np.ndarray, "h w d"],
    shape: Float32[np.ndarray, "h w c"] | Surface | None,
    *,
    steepness: float = 1.0,
    most: float = 40.0,
) -> Borders:
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
    pairs, inverse = np.unique(np.concatenate(keys), axis=0, return_inverse=True)
    inverse = inverse.reshape(-1)
    return Borders(
        pairs,
        np.bincount(inverse, minlength=len(pairs)).astype(np.float64),
        np.bincount(inverse, np.concatenate(colours), len(pairs)),
        np.bincount(inverse, np.concatenate(shapes), len(pairs)),
    )


def merge(
    atoms: Int32[np.ndarray, "h w"],
    features: Float32[np.ndarray, "h w d"],
    edges: Borders,
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
    _, first, flat = np.unique(atoms.reshape(-1), return_index=True, return_inverse=True)
    number = np.argsort(np.argsort(first))
    flat = number[flat]
    atoms, pairs = flat.reshape(atoms.shape), np.sort(number[edges.pairs], axis=-1)
    sums_of = np.stack([edges.colour, edges.shape, edges.length], -1)
    count = len(first)
    area = np.bincount(flat, minlength=count).astype(np.float64)
    sums = np.stack([np.bincount(flat, features[..., c].reshape(-1), count) for c in range(features.shape[-1])], -1)
    # neighbour -> sums of the step of colour, of the step of shape, and length of the border
    links: list[dict[int, tuple[float, float, float]]] = [{} for _ in range(count)]
    for row in np.lexsort((pairs[:, 1], pairs[:, 0])):
        a, b = pairs[row].tolist()
        links[a][b] = links[b][a] = tuple(sums_of[row].tolist())
    parent = np.arange(count)
    version = np.zeros(count, np.int64)

    full = GROWN_AREA * atoms.size

    def dissimilarity(a: int, b: int) -> float:
        colour, shape, border = links[a][b]
        gap = float(np.linalg.norm(sums[a] / area[a] - sums[b] / area[b]))
        grown = min(max((min(area[a], area[b]) / full) ** 0.5, SMALLEST_FACTOR), 1.0)
        return math.hypot(grown * (BORDER_SHARE * colour / border + (1.0 - BORDER_SHARE) * gap), shape / border)

    def absorb(a: int, b: int) -> None:
        """b becomes part of a."""
        parent[b] = a
        area[a] += area[b]
        sums[a] += sums[b]
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
    for a in sorted(np.flatnonzero((parent == np.arange(count)) & (area > 0)).tolist(), key=lambda a: area[a]):
        if parent[a] == a and (area[a] < min_area or thin[a]) and links[a]:
            absorb(min(links[a], key=lambda other: dissimilarity(a, other)), a)
    return np.unique(_roots(parent)[flat], return_inverse=True)[1].reshape(atoms.shape).astype(np.int32)


def _roots(parent: np.ndarray) -> np.ndarray:
    """Where each chain of parents ends; each pass halves the chains."""
    while not np.array_equal(parent, parent[parent]):
        parent = parent[parent]
    return parent


def _cores(labels: np.ndarray) -> np.ndarray:
    """The labels that hold a 5x5 square: the others are slivers along an edge, blurred between its two sides."""
    image = labels.astype(np.float32)
    square = np.ones((5, 5), np.uint8)
    return np.unique(labels[cv2.dilate(image, square) == cv2.erode(image, square)])


def masks_best_first(
    frame: UInt8[np.ndarray, "h w 3"], labels: Int32[np.ndarray, "h w"], *, max_regions: int, min_area: float
) -> Bool[np.ndarray, "m h w"]:
    """labels (H, W) -> masks (M, H, W) bool, the most contrasted and the larger first; specks dropped.

    A region's rank is the mean edge strength along its border times the square root of its area: a long clear outline.
    """
    lab = cv2.cvtColor(frame.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)
    gradient = np.hypot(cv2.Sobel(lab, cv2.CV_32F, 1, 0), cv2.Sobel(lab, cv2.CV_32F, 0, 1)).sum(-1)
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
