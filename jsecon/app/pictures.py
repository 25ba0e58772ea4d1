"""Pictures of a run: regions in colours that stay the same in every view, selections."""

import colorsys
import functools

import cv2
import jax
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jsecon.app.catalogue import main_regions
from jsecon.splat.render import render, render_rgb
from jsecon.splat.visible import render_in_blocks
from jsecon.types import Array, Camera, Gaussians, LanguageField

SELECTED = (255, 64, 160)
"""RGB of a selection, which no natural object has"""
UNKNOWN = 0.25
"""grey of Gaussians without a region, 0 to 1"""


def palette(count: int, hue: float = 0.11) -> UInt8[np.ndarray, "n 3"]:
    """Chooses RGB of regions 0 .. count-1, none of which depends on `count`: golden angles apart, from a hue on."""
    hues = (hue + 0.61803398875 * np.arange(count)) % 1.0
    colours = [colorsys.hls_to_rgb(h, (0.62, 0.42, 0.72)[i % 3], 0.85) for i, h in enumerate(hues)]
    return (np.asarray(colours, np.float64).reshape(count, 3) * 255).astype(np.uint8)


def label_overlay(frame: UInt8[np.ndarray, "h w 3"], labels: Int[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Paints regions (-1 for none) over a frame in grey: each in its colour (`palette`), a dark line between them."""
    grey = np.repeat(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2).astype(np.float32)
    colours = palette(int(labels.max(initial=0)) + 1)[np.maximum(labels, 0)]
    image = np.where((labels >= 0)[..., None], 0.28 * grey + 0.72 * colours, 0.55 * grey)
    border = np.zeros(labels.shape, bool)
    border[1:] |= labels[1:] != labels[:-1]
    border[:, 1:] |= labels[:, 1:] != labels[:, :-1]
    image[border] *= 0.35
    return image.astype(np.uint8)


def selection_overlay(
    frame: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], truth: Bool[np.ndarray, "h w"] | None = None
) -> UInt8[np.ndarray, "h w 3"]:
    """Shows a selection in a frame: dark outside, tinted inside, with the outline of the ground truth, if any."""
    image = frame.astype(np.float32)
    image = np.where(mask[..., None], 0.55 * image + 0.45 * np.array(SELECTED, np.float32), 0.5 * image)
    image = _outlined(image.astype(np.uint8), mask, SELECTED, 1)
    if truth is not None:
        image = _outlined(_outlined(image, truth, (0, 0, 0), 3), truth, (255, 255, 255), 1)
    return image


def _outlined(image: np.ndarray, mask: np.ndarray, colour: tuple[int, ...], thickness: int) -> np.ndarray:
    """Draws the outline of a mask into an image."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    image = np.ascontiguousarray(image)
    cv2.drawContours(image, contours, -1, colour, thickness)
    return image


def region_colours(field: LanguageField) -> Float[np.ndarray, "n 3"]:
    """Returns the colour of each Gaussian's main region in [0, 1]; grey without a region."""
    return np.concatenate([palette(field.regions.count) / 255, np.full((1, 3), UNKNOWN)])[main_regions(field)]


class Renderer:
    """Renders one scene in its views.

    Args:
      gaussians: The scene.
      cameras: Its T views.
      in_blocks: Renders a scene that is larger than memory, in the colours of the scene only.

    Attributes:
      photo: Renders a view in the scene's colours, (H, W, 3) uint8. It keeps the pictures.
    """

    def __init__(self, gaussians: Gaussians, cameras: Camera, *, in_blocks: bool = False):
        self._gaussians = gaussians if in_blocks else jax.device_put(gaussians)
        self._in_blocks = in_blocks
        self._cameras = jax.tree.map(np.asarray, cameras)  # whose items need no compilation
        self.photo = functools.cache(self._photo)

    def _photo(self, view: int) -> UInt8[np.ndarray, "h w 3"]:
        """Renders a view in the scene's colours."""
        if self._in_blocks:
            return _to_bytes(render_in_blocks(self._gaussians, self._cameras[view]))
        return _to_bytes(render_rgb(self._gaussians, self._cameras[view]).features)

    def colours(self, view: int, rgb: Float[Array, "n 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """Renders a view in other colours than the scene's, each in [0, 1]."""
        return _to_bytes(render(self._gaussians, self._cameras[view], np.asarray(rgb, np.float32)).features)

    def crop(self, view: int, mask: Bool[np.ndarray, " n"]) -> UInt8[np.ndarray, "h2 w2 3"]:
        """Cuts out the part of a view that shows some Gaussians; the whole view if it shows none of them.

        A square with a margin around all but 3 % of their centres on each side, as far as the view reaches.
        """
        photo, camera = self.photo(view), self._cameras[view]
        pose = np.asarray(camera.world_to_camera)
        points = np.asarray(self._gaussians.means)[mask] @ pose[:3, :3].T + pose[:3, 3]
        points = points[points[:, 2] > 1e-6]
        u = float(camera.fx) * points[:, 0] / points[:, 2] + float(camera.cx)
        v = float(camera.fy) * points[:, 1] / points[:, 2] + float(camera.cy)
        inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        if not inside.any():
            return photo
        (left, right), (top, bottom) = (np.quantile(a[inside], (0.03, 0.97)) for a in (u, v))
        half = 0.8 * max(right - left, bottom - top, 16)  # px; the margin is 0.3 of the object's size
        x, y = (left + right) / 2, (top + bottom) / 2
        rows = slice(int(max(y - half, 0)), int(min(y + half, camera.height)) + 1)
        return photo[rows, int(max(x - half, 0)) : int(min(x + half, camera.width)) + 1]


def _to_bytes(image: Array) -> np.ndarray:
    """Returns an image in [0, 1] as uint8."""
    return (np.clip(np.asarray(image), 0.0, 1.0) * 255 + 0.5).astype(np.uint8)
