"""How well a rendering explains a photograph, pixel by pixel: colours and depth after exposure, light and small shifts.

Pure functions on NumPy arrays. Photographs are compared in the colours of the scene: `fit_exposure` brings them there.
A pixel may be lighter or darker by a factor, at a small cost, because light and shadows change what nothing moved.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

COLOUR_STEP = 22.0
"""CIELAB distance from which a pixel is not explained at all; half of it decides."""
_LIGHT_STEP = 40.0
"""CIELAB distance that a factor of e in lightness is worth."""
_DEPTH_STEP = 0.03
"""Difference of depth from which a pixel is not explained, as a share of the depth; a third of it is noise."""


def fit_exposure(
    photo: Float32[np.ndarray, "h w 3"], render: Float32[np.ndarray, "h w 3"], known: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w 3"]:
    """Brings a photograph to the colours of a rendering by a gain and an offset of each channel.

    The fit weighs pixels by how well they agree (Cauchy), so that what changed does not count.
    """
    known = known & (photo > 0.01).all(-1) & (photo < 0.99).all(-1)
    if known.sum() < 64:
        return photo
    source, target = photo[known].astype(np.float64), render[known].astype(np.float64)
    gain, offset = np.median(target, 0) / np.maximum(np.median(source, 0), 1e-3), np.zeros(3)
    for _ in range(12):
        error = source * gain + offset - target
        weight = 1 / (1 + (error**2).sum(1) / 0.04**2)
        mean, middle = (np.average(values, axis=0, weights=weight) for values in (source, target))
        spread = np.average((source - mean) ** 2, axis=0, weights=weight)
        both = np.average((source - mean) * (target - middle), axis=0, weights=weight)
        gain = np.clip((both + 1e-4 * gain) / (spread + 1e-4), 0.2, 5.0)
        offset = middle - gain * mean
    return np.clip(photo * gain + offset, 0, 1.5).astype(np.float32)


def find_shift(
    photo: Float32[np.ndarray, "h w 3"], render: Float32[np.ndarray, "h w 3"], known: Bool[np.ndarray, "h w"]
) -> tuple[int, int]:
    """Finds by how many rows and columns a photograph lies off the rendering of its pose, from edges of lightness."""

    def edges(image):
        grey = cv2.GaussianBlur(image.mean(-1), (0, 0), 1.0)
        return np.minimum(np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)), 0.5)

    reach = max(round(0.025 * photo.shape[1]), 1)  # px; errors of poses are smaller
    around = cv2.copyMakeBorder(edges(photo), reach, reach, reach, reach, cv2.BORDER_REPLICATE)
    errors = cv2.matchTemplate(around, edges(render), cv2.TM_SQDIFF, mask=known.astype(np.float32))
    row, column = np.unravel_index(errors.argmin(), errors.shape)
    return reach - int(row), reach - int(column)


def shifted(image: np.ndarray, shift: tuple[int, int]) -> np.ndarray:
    """Moves an image by (rows, columns), px; its edge is repeated."""
    (down, across), size = shift, image.shape[1::-1]
    motion = np.array([[1.0, 0, across], [0, 1, down]])
    return cv2.warpAffine(image, motion, size, flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)


def _shifts(image: np.ndarray) -> list[np.ndarray]:
    """An image moved by up to one px each way."""
    return [shifted(image, (y, x)) for y in (1, 0, -1) for x in (1, 0, -1)]


def colour_cost(
    photo: Float32[np.ndarray, "h w 3"], render: Float32[np.ndarray, "h w 3"]
) -> Float32[np.ndarray, "h w"]:
    """How little a rendering explains the colours of a photograph, 0 to 1: least over shifts of up to one px."""
    best = np.full(photo.shape[:2], np.inf, np.float32)
    lab = cv2.cvtColor(np.clip(photo, 0, 1), cv2.COLOR_RGB2LAB)
    for moved in _shifts(render):
        gain = (np.einsum("hwc,hwc->hw", photo, moved) + 1e-3) / (np.einsum("hwc,hwc->hw", moved, moved) + 1e-3)
        gain = np.clip(gain, 0.4, 2.5).astype(np.float32)
        apart = lab - cv2.cvtColor(np.clip(moved * gain[..., None], 0, 1), cv2.COLOR_RGB2LAB)
        best = np.minimum(best, np.einsum("hwc,hwc->hw", apart, apart) + (_LIGHT_STEP * np.log(gain)) ** 2)
    return np.minimum(np.sqrt(best) / COLOUR_STEP, 1.0)


def depth_cost(depth: Float[np.ndarray, "h w"], rendered: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """How little rendered depth explains a measured one, -1 to 1: negative where the measured surface is nearer.

    It is that of least size over shifts of up to one px; NaN where either is unknown (0).
    """
    known, best = (depth > 0) & (rendered > 0), np.full(depth.shape, np.inf)
    for moved in _shifts(rendered):
        difference = np.where(moved > 0, (depth - moved) / (_DEPTH_STEP * np.maximum(moved, 1e-9)), np.inf)
        best = np.where(np.abs(difference) < np.abs(best), difference, best)
    return np.where(known, np.sign(best) * np.clip(1.5 * np.abs(best) - 0.5, 0, 1), np.nan)
