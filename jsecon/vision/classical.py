"""Region proposals without a network, by colour, texture and, if known, depth and normals. Host code.

The frame is smoothed, cut into small regions that follow its edges (graph segmentation: Felzenszwalb & Huttenlocher
2004), and neighbours are merged over the graph of these regions (`region_graph`).
"""

import dataclasses
from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8

from jsecon.errors import InputError, require, require_shape
from jsecon.vision.region_graph import merge_regions
from jsecon.vision.surfaces import Surface


def require_contrib() -> None:
    """Raises InputError if OpenCV lacks its contrib modules, because its packages overwrite each other's folder."""
    if not hasattr(getattr(cv2, "ximgproc", None), "createSuperpixelSLIC"):
        remedy = (
            "Run: pip uninstall opencv-python opencv-python-headless opencv-contrib-python; then: "
            "pip install --force-reinstall opencv-contrib-python-headless"
        )
        problem = f"version {cv2.__version__} without ximgproc, because another OpenCV package overwrote it"
        raise InputError("OpenCV", problem, remedy=remedy)


@dataclasses.dataclass(frozen=True)
class ClassicalSegmenter:
    """Segmenter (jsecon.vision.protocols) from OpenCV alone.

    Thresholds are in CIELAB units, of which two are just noticeable.
    """

    merge_distance: float = 16.0
    """Dissimilarity below which neighbours are joined, CIELAB units."""
    layers: tuple[float, ...] = (1.0, 0.5)
    """Shares of `merge_distance`, each of which makes a layer of masks: the finer ones have the small things that the
    others join to what they stand on."""
    min_area: float = 0.0012
    """Least area of a region, as a share of the frame; smaller ones join their most similar neighbour or are
    dropped."""
    max_regions: int = 64
    """Maximum number of regions of a layer, best first."""
    depth_jump: float = 0.04
    """Relative step of depth equivalent to `merge_distance`."""
    surfaces: Callable[[int], Surface | None] | None = None
    """Returns the surface of a frame, None = unknown. Creases separate neighbours, and steps of depth, measured from
    the plane, because the depth of a wall seen from the side changes everywhere."""

    def __call__(self, frame: np.ndarray, index: int) -> Bool[np.ndarray, "m h w"]:
        """Segments a frame (H, W, 3) uint8 into masks (M, H, W) bool without specks, best first in each layer."""
        layers = self.partitions(frame, index)
        limits = {"max_regions": self.max_regions, "min_area": self.min_area}
        return np.concatenate([_masks_best_first(frame, labels, **limits) for labels in layers])

    def partitions(self, frame: np.ndarray, index: int) -> list[Int32[np.ndarray, "h w"]]:
        """Partitions a frame (H, W, 3) uint8 into connected regions, labels 0 .. M-1 of each layer."""
        fits = frame.ndim == 3 and frame.shape[2] == 3 and frame.dtype == np.uint8
        require(fits, "frame", (frame.shape, frame.dtype), "(H, W, 3) uint8", "Pass RGB frames as 8-bit arrays.")
        colour, surface = _colour_features(frame), None if self.surfaces is None else self.surfaces(index)
        turned, seeds = (None, colour) if surface is None else self._with_surface(colour, surface)
        superpixels, least = _oversegment(seeds), self.min_area * frame.shape[0] * frame.shape[1]
        layers = []
        for share in self.layers:  # of colours alone: creases and steps of depth separate alike in all layers
            features = colour if turned is None else np.concatenate([colour, np.float32(share) * turned], -1)
            distance = share * self.merge_distance
            limits = {"distance": distance, "min_area": least, "steepness": distance / self.depth_jump}
            layers.append(merge_regions(superpixels, features, surface, **limits))
        return layers

    def _with_surface(self, colour: np.ndarray, surface: Surface) -> tuple[np.ndarray, np.ndarray]:
        """Makes features of pixels of colours and a surface.

        Returns (H, W, 3) normals, of which a crease of 50 degrees equals a step of `merge_distance`; and (H, W, 7)
        features for the oversegmentation: colours, normals at half weight, and depth.
        """
        for array in (surface.points, surface.normals):
            require_shape("surface", array, colour.shape, "Pass surfaces of the size of the frame.")
        crease = 2.0 * np.sin(np.radians(50.0) / 2.0)
        turned = surface.normals * np.float32(self.merge_distance / crease)
        jump = np.float32(0.5 * self.merge_distance / np.log1p(self.depth_jump))
        depth = np.log(np.maximum(surface.points[..., 2:], 1e-6)) * jump
        return turned, np.concatenate([colour, 0.5 * turned, depth], -1)


def _colour_features(frame: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
    """Computes L, a and b (H, W, 3) float32, CIELAB units, of a smoothed frame (H, W, 3) uint8."""
    radius = 20.0  # of colours that are joined, 8-bit units
    smooth = cv2.pyrMeanShiftFiltering(_adapt_exposure(frame), 5, radius, maxLevel=0)
    smooth = cv2.bilateralFilter(smooth, 7, 2.0 * radius, 3.0)
    return cv2.cvtColor(smooth.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)


def _adapt_exposure(frame: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Brightens dark frames and darkens bright ones, by the median of their linear luminance.

    Steps in CIELAB are those of an eye adapted to the white of the scene: they are too small between dark objects of a
    dark photograph and between white walls of a bright one. The map x -> g x / (1 + (g - 1) x) multiplies the odds by g
    and keeps black and white.
    """
    linear = (np.arange(256, dtype=np.float32) / 255.0) ** 2.2
    luminance = linear[frame] @ np.asarray([0.2126, 0.7152, 0.0722], np.float32)
    middle = min(max(float(np.median(luminance)), 1e-6), 1.0 - 1e-6)
    target = min(max(middle, 0.22), 0.3)
    gain = min(max(target * (1.0 - middle) / (middle * (1.0 - target)), 1.0 / 8.0), 8.0)
    table = np.round(255.0 * (gain * linear / (1.0 + (gain - 1.0) * linear)) ** (1.0 / 2.2)).astype(np.uint8)
    return table[frame]


def _oversegment(features: Float32[np.ndarray, "h w c"]) -> Int32[np.ndarray, "h w"]:
    """Segments features (H, W, C) into small connected regions (H, W) int32 (Felzenszwalb & Huttenlocher 2004)."""
    graph = cv2.ximgproc.segmentation.createGraphSegmentation(sigma=0.5, k=30.0, min_size=16)
    return np.asarray(graph.processImage(np.ascontiguousarray(features)), np.int32)


def _masks_best_first(
    frame: UInt8[np.ndarray, "h w 3"], labels: Int32[np.ndarray, "h w"], *, max_regions: int, min_area: float
) -> Bool[np.ndarray, "m h w"]:
    """Returns masks of regions, by mean edge strength along their borders times the root of their area, no specks."""
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
