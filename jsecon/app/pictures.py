"""Pictures of a run: regions in colours that stay the same in every view, selections, rendered views."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jsecon.app.catalogue import palette
from jsecon.field.columns import is_mapped
from jsecon.field.evidence import MAX_WHOLE
from jsecon.splat.render import render, render_rgb
from jsecon.splat.visible import render_in_blocks
from jsecon.types import Camera, Gaussians

SELECTED = (255, 64, 160)
"""RGB of a selection, which no natural object has"""


def label_overlay(frame: UInt8[np.ndarray, "h w 3"], labels: Int[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Paints regions (-1 for none) over a frame in grey, each in its colour (`palette`)."""
    grey = np.repeat(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2).astype(np.float32)
    colours = palette(int(labels.max(initial=0)) + 1)[np.maximum(labels, 0)]
    return np.where((labels >= 0)[..., None], 0.28 * grey + 0.72 * colours, 0.55 * grey).astype(np.uint8)


def selection_overlay(
    frame: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    truth: Bool[np.ndarray, "h w"] | None = None,
    *,
    tint: float = 0.45,
) -> UInt8[np.ndarray, "h w 3"]:
    """Shows a selection in a frame: outlined, dark outside, tinted inside; with the outline of the truth, if any."""
    image = frame.astype(np.float32)
    image = np.where(mask[..., None], (1 - tint) * image + tint * np.array(SELECTED, np.float32), 0.5 * image)
    image = outlined(image.astype(np.uint8), mask, SELECTED, 1)
    if truth is not None:
        image = outlined(outlined(image, truth, (0, 0, 0), 3), truth, (255, 255, 255), 1)
    return image


def outlined(image: np.ndarray, mask: np.ndarray, colour: tuple[int, ...], thickness: int) -> np.ndarray:
    """Draws the outline of a mask into an image."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    image = np.ascontiguousarray(image)
    cv2.drawContours(image, contours, -1, colour, thickness)
    return image


def render_picture(
    gaussians: Gaussians, camera: Camera, rgb: Float[np.ndarray, "n 3"] | None = None
) -> UInt8[np.ndarray, "h w 3"]:
    """Renders a view in the scene's colours, or in others, each in [0, 1]; a large scene in its own, by blocks."""
    if rgb is not None:
        image = render(gaussians, camera, np.asarray(rgb, np.float32)).features
    elif is_mapped(gaussians) or gaussians.count > MAX_WHOLE:
        image = render_in_blocks(gaussians, camera)
    else:
        image = render_rgb(gaussians, camera).features
    return (np.clip(np.asarray(image), 0.0, 1.0) * 255 + 0.5).astype(np.uint8)
