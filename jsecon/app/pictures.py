"""Pictures of what a run found: regions in colours that stay the same in every view, codes as colours, selections."""

import colorsys
import functools
from collections.abc import Mapping

import cv2
import jax
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jsecon.splat.render import render, render_rgb
from jsecon.types import Array, Camera, Gaussians, LanguageField

SELECTED = (255, 64, 160)
"""RGB of a selection: no natural object's colour"""
TRUE = (255, 255, 255)
"""RGB of the ground truth's outline, over a black line"""
UNKNOWN = 0.25
"""grey of Gaussians without a code"""


def palette(count: int) -> UInt8[np.ndarray, "n 3"]:
    """RGB of regions 0 .. count-1: hues a golden angle apart, three lightnesses in turn; kept as count grows."""
    hues = (0.11 + 0.61803398875 * np.arange(count)) % 1.0
    colours = [colorsys.hls_to_rgb(h, (0.62, 0.42, 0.72)[i % 3], 0.85) for i, h in enumerate(hues)]
    return (np.asarray(colours, np.float64).reshape(count, 3) * 255).astype(np.uint8)


def label_overlay(
    frame: UInt8[np.ndarray, "h w 3"], labels: Int[np.ndarray, "h w"], *, opacity: float = 0.72
) -> UInt8[np.ndarray, "h w 3"]:
    """The frame in grey with each region in its colour and a dark line between regions; unlabelled pixels stay grey."""
    grey = np.repeat(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2).astype(np.float32)
    known = labels >= 0
    colours = palette(int(labels.max(initial=0)) + 1)[np.maximum(labels, 0)]
    image = np.where(known[..., None], (1 - opacity) * grey + opacity * colours, 0.55 * grey)
    image[_borders(labels)] *= 0.35
    return image.astype(np.uint8)


def _borders(labels: np.ndarray) -> np.ndarray:
    edge = np.zeros(labels.shape, bool)
    edge[1:] |= labels[1:] != labels[:-1]
    edge[:, 1:] |= labels[:, 1:] != labels[:, :-1]
    return edge


def selection_overlay(
    frame: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], truth: Bool[np.ndarray, "h w"] | None = None
) -> UInt8[np.ndarray, "h w 3"]:
    """The frame, darkened outside of the selection's mask and tinted inside, with the ground truth's outline on top."""
    image = frame.astype(np.float32)
    image = np.where(mask[..., None], 0.55 * image + 0.45 * np.array(SELECTED, np.float32), 0.5 * image)
    image = _outlined(image.astype(np.uint8), mask, SELECTED, 1)
    if truth is not None:
        image = _outlined(_outlined(image, truth, (0, 0, 0), 3), truth, TRUE, 1)
    return image


def _outlined(image: np.ndarray, mask: np.ndarray, colour: tuple[int, int, int], thickness: int) -> np.ndarray:
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    image = np.ascontiguousarray(image)
    cv2.drawContours(image, contours, -1, colour, thickness)
    return image


def code_colours(field: LanguageField) -> Float[np.ndarray, "n 3"]:
    """(N, 3) RGB in [0, 1]: the codes' first three principal components, stretched over the regions; grey = unknown."""
    table = np.asarray(field.region_codes, np.float64)
    codes = np.asarray(field.codes, np.float64)
    known = np.abs(codes).max(axis=1, initial=0.0) > 0
    used = table[np.abs(table).max(axis=1, initial=0.0) > 0]
    if len(used) == 0:
        return np.full((len(codes), 3), UNKNOWN)
    middle = used.mean(0)
    axes = np.linalg.svd(used - middle, full_matrices=False)[2][:3]
    axes = axes * np.sign(axes[np.arange(len(axes)), np.abs(axes).argmax(1)])[:, None]
    points, shown = (used - middle) @ axes.T, (codes - middle) @ axes.T
    low, high = points.min(0), points.max(0)
    rgb = np.full((len(codes), 3), 0.5)
    rgb[:, : len(axes)] = np.clip((shown - low) / np.where(high > low, high - low, 1.0), 0.0, 1.0)
    rgb[~known] = UNKNOWN
    return rgb


def strip(panels: Mapping[str, UInt8[np.ndarray, "h w 3"]], *, gap: int = 6) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Pictures of one height side by side on white, each over its caption."""
    foot, columns = 26, []
    for caption, image in panels.items():
        under = np.full((foot, image.shape[1], 3), 255, np.uint8)
        under = cv2.putText(under, caption, (2, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (40, 40, 40), 1, cv2.LINE_AA)
        columns += [np.concatenate([image, under]), np.full((len(image) + foot, gap, 3), 255, np.uint8)]
    return np.concatenate(columns[:-1], axis=1)


class Renderer:
    """Pictures of one scene from its views."""

    def __init__(self, gaussians: Gaussians, cameras: Camera):
        self._gaussians = jax.device_put(gaussians)
        self._cameras = jax.tree.map(np.asarray, cameras)  # whose items compile nothing
        self.photo = functools.cache(self._photo)

    def _photo(self, view: int) -> UInt8[np.ndarray, "h w 3"]:
        """The scene in its own colours."""
        return _to_bytes(render_rgb(self._gaussians, self._cameras[view]).features)

    def colours(self, view: int, rgb: Float[Array, "n 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """The scene with one colour per Gaussian."""
        return _to_bytes(render(self._gaussians, self._cameras[view], np.asarray(rgb, np.float32)).features)


def _to_bytes(image: Array) -> np.ndarray:
    return (np.clip(np.asarray(image), 0.0, 1.0) * 255 + 0.5).astype(np.uint8)
