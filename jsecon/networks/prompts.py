"""Guided prompts for SAM: a tenth of the points of its grid, each where something is. Host code."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64, UInt8

from jsecon.vision.classical import ClassicalSegmenter

MAX_PROMPTS = 96
"""guided prompts of an image: a tenth of SAM's grid"""
_MAX_ROUNDS = 4
"""rounds of guided prompts; those after the first go to what the masks so far do not explain"""


class GuidedPrompts:
    """Chooses points of an image, round by round: where its regions by colour are, then where masks explain too little.

    A pixel is explained at a level if a mask of that level holds it that was prompted within the pixel's own region. A
    mask of the table therefore does not explain the mug that stands on it.

    The regions are fine ones: a region that covers two objects costs a further round, and two regions of one object
    cost a prompt.
    """

    def __init__(self, image: UInt8[np.ndarray, "h w 3"], levels: int):
        self._regions = ClassicalSegmenter(merge_distance=10.0).partition(image, 0)
        self._explained = np.zeros((levels, *self._regions.shape), bool)
        self._prompted = np.zeros(self._regions.shape, bool)
        self._rounds = 0
        self._left = MAX_PROMPTS

    def next_points(self) -> Float32[np.ndarray, "p 2"]:
        """Chooses the points x, y in px of the next round, largest patches first; none when no round is left."""
        patches = np.asarray(self._regions, np.int32)
        min_radius = 0.0
        if self._rounds:
            open_pixels = ~self._explained.all(0) & ~self._prompted
            borders = np.zeros_like(open_pixels)
            borders[:, 1:] |= self._regions[:, 1:] != self._regions[:, :-1]
            borders[1:] |= self._regions[1:] != self._regions[:-1]
            _, patches = cv2.connectedComponents((open_pixels & ~borders).astype(np.uint8), connectivity=4)
            patches = patches - 1
            min_radius = 0.008 * min(patches.shape)  # thinner patches lie along outlines
        remaining = self._left if self._rounds < _MAX_ROUNDS else 0
        pixels = _innermost_pixels(patches, min_radius)[:remaining]
        self._rounds += 1
        self._left -= len(pixels)
        self._prompted[pixels[:, 1], pixels[:, 0]] = True
        return pixels.astype(np.float32) + np.float32(0.5)

    def explain(self, level: int, point: Float32[np.ndarray, " 2"], mask: Bool[np.ndarray, "h w"]) -> None:
        """Takes a mask that a point x, y gave at a level."""
        column, row = point.astype(int)
        self._explained[level] |= mask & (self._regions == self._regions[row, column])


def _innermost_pixels(patches: Int32[np.ndarray, "h w"], min_radius: float = 0.0) -> Int64[np.ndarray, "p 2"]:
    """Finds the pixel (column, row) of each patch that is farthest from its outline, the farthest first.

    Args:
      patches: Numbers of patches, negative outside.
      min_radius: px; a patch whose pixels are all nearer to its outline is left out.
    """
    padded = np.pad(patches, 1, constant_values=-1)
    inner = padded >= 0
    for axis in (0, 1):
        for shift in (-1, 1):
            inner &= padded == np.roll(padded, shift, axis)
    distance = cv2.distanceTransform(inner.astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    order = np.argsort(-distance, axis=None, kind="stable")
    order = order[(patches.ravel()[order] >= 0) & (distance.ravel()[order] >= min_radius)]
    _, first = np.unique(patches.ravel()[order], return_index=True)
    chosen = order[np.sort(first)]
    return np.stack([chosen % patches.shape[1], chosen // patches.shape[1]], -1)
