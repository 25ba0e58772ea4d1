"""Pictures of what a run found: regions in colours that stay the same in every view, codes as colours, selections."""

import colorsys
import functools
from collections.abc import Mapping

import cv2
import jax
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jsecon.splat.banded import render_in_blocks
from jsecon.splat.bands import block_bounds
from jsecon.splat.render import render, render_rgb
from jsecon.types import Array, Camera, Gaussians, LanguageField

SELECTED = (255, 64, 160)
"""RGB of a selection: no natural object's colour"""
TRUE = (255, 255, 255)
"""RGB of the ground truth's outline, over a black line"""
_FONT = cv2.FONT_HERSHEY_SIMPLEX, 0.36
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


def answers_overlay(
    frame: UInt8[np.ndarray, "h w 3"], masks: Mapping[str, Bool[np.ndarray, "h w"]]
) -> UInt8[np.ndarray, "h w 3"]:
    """The frame in dark grey, in its colours where masks are, their texts above or beneath them: of the masks, the
    largest first, those that leave each other and the texts room."""
    image = np.repeat(0.35 * frame.mean(-1, keepdims=True), 3, axis=-1).astype(np.uint8)
    taken, places = np.zeros(frame.shape[:2], bool), {}
    for text in sorted((text for text, mask in masks.items() if mask.any()), key=lambda text: -masks[text].sum()):
        rows, columns = np.nonzero(masks[text])
        (wide, high), _ = cv2.getTextSize(text, *_FONT, 1)
        left = int(np.clip(columns.mean() - wide / 2, 1, max(image.shape[1] - wide - 1, 1)))
        for base in (max(int(rows.min()) - 4, high + 1), min(int(rows.max()) + high + 5, len(image) - 3)):
            own = masks[text].copy()
            own[base - high - 1 : base + 4, left : left + wide] = True
            if text not in places and not (taken & own).any():
                places[text], taken = (left, base), taken | own
    for text in places:
        image[masks[text]] = frame[masks[text]]
    for text, at in places.items():
        for grey, thickness in ((0, 3), (255, 1)):
            image = cv2.putText(image, text, at, *_FONT, (grey,) * 3, thickness, cv2.LINE_AA)
    return image


def followed(
    frames: UInt8[np.ndarray, "t h w 3"], labels: Int[np.ndarray, "t h w"], region: int, *, side: int = 96
) -> UInt8[np.ndarray, "{side} w2 3"]:
    """One region through T frames: each cut out around it and outlined, dark where it is not seen."""
    tiles = []
    for frame, own in zip(frames, labels == region):
        rows, columns = np.nonzero(own)
        tile = np.full((side, side, 3), 40, np.uint8)
        if len(rows):
            (top, low), (left, right) = ((int(a.min()), int(a.max()) + 1) for a in (rows, columns))
            scale = side / (1.3 * max(low - top, right - left) + 8)
            shift = [side / 2 - scale * (left + right) / 2, side / 2 - scale * (top + low) / 2]
            matrix = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
            tile = cv2.warpAffine(_outlined(frame, own, SELECTED, 1), matrix, (side, side), borderValue=(40, 40, 40))
        tiles += [tile, np.full((side, 3, 3), 128, np.uint8)]
    return np.concatenate(tiles[:-1], axis=1)


def _outlined(image: np.ndarray, mask: np.ndarray, colour: tuple[int, ...], thickness: int) -> np.ndarray:
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
    """Pictures of one scene from its views; `in_blocks`, of one larger than memory, in its own colours alone."""

    def __init__(self, gaussians: Gaussians, cameras: Camera, *, in_blocks: bool = False):
        self._gaussians = gaussians if in_blocks else jax.device_put(gaussians)
        self._bounds = block_bounds(gaussians) if in_blocks else None
        self._cameras = jax.tree.map(np.asarray, cameras)  # whose items compile nothing
        self.photo = functools.cache(self._photo)

    def _photo(self, view: int) -> UInt8[np.ndarray, "h w 3"]:
        """The scene in its own colours."""
        if self._bounds is not None:
            return _to_bytes(render_in_blocks(self._gaussians, self._cameras[view], bounds=self._bounds))
        return _to_bytes(render_rgb(self._gaussians, self._cameras[view]).features)

    def colours(self, view: int, rgb: Float[Array, "n 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """The scene with one colour per Gaussian."""
        return _to_bytes(render(self._gaussians, self._cameras[view], np.asarray(rgb, np.float32)).features)


def _to_bytes(image: Array) -> np.ndarray:
    return (np.clip(np.asarray(image), 0.0, 1.0) * 255 + 0.5).astype(np.uint8)
