"""Region proposals without any weights: colour, texture and, where known, depth and normals.

The frame is smoothed, cut into small regions that follow its edges (graph segmentation: Felzenszwalb & Huttenlocher
2004), and neighbours are merged over the graph of these regions (`region_graph`).
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8

from jsecon.errors import InputError, require, require_shape
from jsecon.vision.region_graph import merge_regions, region_borders
from jsecon.vision.surfaces import Surface, log_depth

GRANULARITIES: dict[str, dict[str, Any]] = {
    "fine": {"merge_distance": 10.0},
    "medium": {"merge_distance": 16.0},
    "coarse": {"merge_distance": 28.0, "depth_jump": 0.06},
}
"""settings of ClassicalSegmenter by how large its regions are; the coarse one joins the colours of one thing, and so
needs depth to part things"""


def require_contrib() -> None:
    """Raises InputError where OpenCV has no contrib modules: its packages write to one folder, one over the other."""
    if not hasattr(getattr(cv2, "ximgproc", None), "createSuperpixelSLIC"):
        remedy = (
            "Run: pip uninstall opencv-python opencv-python-headless opencv-contrib-python; then: "
            "pip install --force-reinstall opencv-contrib-python-headless"
        )
        found = f"version {cv2.__version__} without ximgproc, as another of its packages leaves it"
        raise InputError("OpenCV", found, "the package opencv-contrib-python-headless alone", remedy)


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
    depths: Callable[[int], np.ndarray] | None = None
    """z-depth (H, W) of a frame, 0 = unknown: a jump between neighbours keeps them apart"""
    depth_jump: float = 0.04
    """relative step of depth that counts as much as `merge_distance`"""
    crease_degrees: float = 50.0
    """angle between normals that counts as much as `merge_distance`"""
    surfaces: Callable[[int], Surface | None] | None = None
    """the surface of a frame, None = unknown, in place of `depths`: a crease keeps neighbours apart, too, and a step of
    depth is one off the plane, since on a wall seen from its side depth jumps all along"""

    def __call__(self, frame: np.ndarray, index: int) -> Bool[np.ndarray, "m h w"]:
        """frame (H, W, 3) uint8 -> masks (M, H, W) bool, a partition of the frame but for specks, best first."""
        labels = self.partition(frame, index)
        return masks_best_first(frame, labels, max_regions=self.max_regions, min_area=self.min_area)

    def partition(self, frame: np.ndarray, index: int) -> Int32[np.ndarray, "h w"]:
        """frame (H, W, 3) uint8 -> labels (H, W) int32, 0 .. M-1, every pixel labelled, each label connected."""
        fits = frame.ndim == 3 and frame.shape[2] == 3 and frame.dtype == np.uint8
        require(fits, "frame", (frame.shape, frame.dtype), "(H, W, 3) uint8", "Give RGB frames as 8-bit arrays.")
        features = colour_features(frame, lightness_weight=self.lightness_weight, smoothing=self.smoothing)
        minimum = self.min_area * frame.shape[0] * frame.shape[1]
        surface = None if self.surfaces is None else self.surfaces(index)
        if surface is not None:
            features, seeds = self._with_surface(features, surface)
            atoms = oversegment(seeds)
            edges = region_borders(atoms, features, surface, steepness=self.merge_distance / self.depth_jump)
            return merge_regions(atoms, features, edges, distance=self.merge_distance, min_area=minimum)
        shape = None
        if self.depths is not None:
            depth = self.depths(index)
            require_shape("depths", depth, frame.shape[:2], "Give depth of the frame's own size.")
            shape = log_depth(depth) * np.float32(self.merge_distance / np.log1p(self.depth_jump))
        atoms = oversegment(features if shape is None else np.concatenate([features, shape], -1))
        return merge_regions(
            atoms, features, region_borders(atoms, features, shape), distance=self.merge_distance, min_area=minimum
        )

    def _with_surface(self, colour: np.ndarray, surface: Surface) -> tuple[np.ndarray, np.ndarray]:
        """(H, W, 6) colour and normal, in which a crease weighs as a step of `merge_distance`; and (H, W, 7) what small
        regions are cut by: the same, the normal at half its weight, with depth."""
        for array in (surface.points, surface.normals):
            require_shape("surface", array, colour.shape, "Give surfaces of the frame's own size.")
        crease = 2.0 * np.sin(np.radians(self.crease_degrees) / 2.0)
        turned = surface.normals * np.float32(self.merge_distance / crease)
        jump = np.float32(0.5 * self.merge_distance / np.log1p(self.depth_jump))
        depth = np.log(np.maximum(surface.points[..., 2:], 1e-6)) * jump
        return np.concatenate([colour, turned], -1), np.concatenate([colour, 0.5 * turned, depth], -1)


def colour_features(
    frame: UInt8[np.ndarray, "h w 3"], *, lightness_weight: float, smoothing: float
) -> Float32[np.ndarray, "h w 3"]:
    """(H, W, 3) uint8 -> (H, W, 3) float32: weighted L, a and b of the smoothed frame, CIELAB units."""
    smooth = adapt_exposure(frame)
    if smoothing > 0:
        smooth = cv2.pyrMeanShiftFiltering(smooth, 5, smoothing, maxLevel=0)
        smooth = cv2.bilateralFilter(smooth, 7, 2.0 * smoothing, 3.0)
    lab = cv2.cvtColor(smooth.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)
    return lab * np.asarray([lightness_weight, 1.0, 1.0], np.float32)


def adapt_exposure(
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
