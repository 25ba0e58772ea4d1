"""Pictures of a run: regions in colours that stay the same in every view, selections."""

import colorsys
import functools

import cv2
import jax
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jsecon.field.columns import vote_blocks
from jsecon.field.membership import SHARE_THRESHOLD, vote_shares
from jsecon.splat.render import render, render_rgb
from jsecon.splat.visible import render_in_blocks
from jsecon.types import Array, Camera, Gaussians, LanguageField

SELECTED = (255, 64, 160)
"""RGB of a selection, which no natural object has"""
TRUTH = (255, 255, 255)
"""RGB of the ground truth's outline, over a black line"""
UNKNOWN = 0.25
"""grey of Gaussians without a region, 0 to 1"""
GOLDEN_ANGLE = 0.61803398875
"""difference of neighbouring hues, in turns"""
MARGIN = 0.3
"""margin around an object in its picture, as a share of its size"""
MIN_CROP_PX = 16
"""smallest size of an object in its picture"""


def palette(count: int) -> UInt8[np.ndarray, "n 3"]:
    """Chooses the colours of regions: hues a golden angle apart, three lightnesses in turn.

    Args:
      count: Number of regions.

    Returns:
      RGB of regions 0 .. count-1, each of which does not depend on `count`.
    """
    hues = (0.11 + GOLDEN_ANGLE * np.arange(count)) % 1.0
    colours = [colorsys.hls_to_rgb(h, (0.62, 0.42, 0.72)[i % 3], 0.85) for i, h in enumerate(hues)]
    return (np.asarray(colours, np.float64).reshape(count, 3) * 255).astype(np.uint8)


def label_overlay(frame: UInt8[np.ndarray, "h w 3"], labels: Int[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Paints regions over a frame.

    Args:
      frame: RGB of the frame.
      labels: Region ids of its pixels, -1 outside of regions.

    Returns:
      The frame in grey, with each region in its colour (`palette`) and a dark line between regions.
    """
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
    """Shows a selection in a frame.

    Args:
      frame: RGB of the frame.
      mask: Pixels of the selection.
      truth: Pixels of the ground truth, if there is one.

    Returns:
      The frame, dark outside of the selection and tinted inside, with the outline of the ground truth.
    """
    image = frame.astype(np.float32)
    image = np.where(mask[..., None], 0.55 * image + 0.45 * np.array(SELECTED, np.float32), 0.5 * image)
    image = _outlined(image.astype(np.uint8), mask, SELECTED, 1)
    if truth is not None:
        image = _outlined(_outlined(image, truth, (0, 0, 0), 3), truth, TRUTH, 1)
    return image


def object_strip(
    frames: UInt8[np.ndarray, "t h w 3"], labels: Int[np.ndarray, "t h w"], region: int, *, side: int = 96
) -> UInt8[np.ndarray, "{side} w2 3"]:
    """Shows one region through frames.

    Args:
      frames: T frames.
      labels: Region ids of their pixels, -1 outside of regions.
      region: Id of the region.
      side: Side of a tile, px.

    Returns:
      T tiles side by side: the region cut out and outlined; dark if a frame does not show it.
    """
    tiles = []
    for frame, mask in zip(frames, labels == region):
        rows, columns = np.nonzero(mask)
        tile = np.full((side, side, 3), 40, np.uint8)
        if len(rows):
            (top, low), (left, right) = ((int(a.min()), int(a.max()) + 1) for a in (rows, columns))
            scale = side / (1.3 * max(low - top, right - left) + 8)
            shift = [side / 2 - scale * (left + right) / 2, side / 2 - scale * (top + low) / 2]
            matrix = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
            tile = cv2.warpAffine(_outlined(frame, mask, SELECTED, 1), matrix, (side, side), borderValue=(40, 40, 40))
        tiles += [tile, np.full((side, 3, 3), 128, np.uint8)]
    return np.concatenate(tiles[:-1], axis=1)


def fitted(image: UInt8[np.ndarray, "h w 3"], side: int) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Scales an image.

    Args:
      image: The image.
      side: Longer side of the result, px.

    Returns:
      The image at that size.
    """
    scale = side / max(image.shape[:2])
    size = max(round(scale * image.shape[1]), 1), max(round(scale * image.shape[0]), 1)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)


def _outlined(image: np.ndarray, mask: np.ndarray, colour: tuple[int, ...], thickness: int) -> np.ndarray:
    """Draws the outline of a mask into an image."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    image = np.ascontiguousarray(image)
    cv2.drawContours(image, contours, -1, colour, thickness)
    return image


def main_regions(field: LanguageField) -> Int[np.ndarray, " n"]:
    """Finds the region that has at least half of each Gaussian's weight, or -1. The votes are read in blocks."""
    blocks = [np.zeros(0, np.int32)]
    for votes in vote_blocks(field.votes):
        shares = np.nan_to_num(np.asarray(vote_shares(votes)))
        best = shares.argmax(1)
        rows = np.arange(len(best))
        blocks.append(np.where(shares[rows, best] >= SHARE_THRESHOLD, np.asarray(votes.regions)[rows, best], -1))
    return np.concatenate(blocks)


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
        """Renders a view in other colours than the scene's.

        Args:
          view: Index of the view.
          rgb: Colour of each Gaussian, in [0, 1].

        Returns:
          The picture, uint8.
        """
        return _to_bytes(render(self._gaussians, self._cameras[view], np.asarray(rgb, np.float32)).features)

    def crop(self, view: int, mask: Bool[np.ndarray, " n"]) -> UInt8[np.ndarray, "h2 w2 3"]:
        """Cuts out the part of a view that shows some Gaussians.

        Args:
          view: Index of the view.
          mask: The Gaussians.

        Returns:
          A square with a margin around all but 3 % of their centres on each side, as far as the view reaches; the whole
          view if it shows none of them.
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
        half = max(right - left, bottom - top, MIN_CROP_PX) * (0.5 + MARGIN)
        x, y = (left + right) / 2, (top + bottom) / 2
        rows = slice(int(max(y - half, 0)), int(min(y + half, camera.height)) + 1)
        return photo[rows, int(max(x - half, 0)) : int(min(x + half, camera.width)) + 1]


def _to_bytes(image: Array) -> np.ndarray:
    """Returns an image in [0, 1] as uint8."""
    return (np.clip(np.asarray(image), 0.0, 1.0) * 255 + 0.5).astype(np.uint8)
