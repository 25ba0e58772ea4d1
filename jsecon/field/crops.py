"""Which views of each region are embedded: a few that show most of it, uncut, from different directions. Pure.

An encoder needs a fifth of a second for each view (SigLIP 2, two cores), and the views of one object share most of its
errors (docs/models.md).
"""

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from jsecon.errors import require_shape
from jsecon.types import Camera

_NEARNESS_POWER = 8
"""power of the cosine that says how near two directions are: 0.5 at 23 degrees, 0.1 at 41"""


def crop_geometry(
    labels: Shaped[np.ndarray, "t h w"], cameras: Camera, num_regions: int
) -> tuple[Int[np.ndarray, "r t"], Float[np.ndarray, "r t"], Float[np.ndarray, "r t 3"]]:
    """Measures how each of T views shows each of R regions.

    Returns:
      Pixels; pixels on the frame's border over the side of a square with the region's area, at most 1; and the unit
      direction in the world from the camera to the middle of the region's pixels. All are 0 where a view does not show
      a region.
    """
    require_shape("labels", labels, (len(cameras), *labels.shape[1:]), "Give one camera per label image.")
    pixels, border, u, v = np.zeros((4, num_regions, len(labels)))
    for t, image in enumerate(labels):
        rows, columns = np.nonzero(image >= 0)
        ids = image[rows, columns]
        height, width = image.shape
        on_border = np.isin(rows, (0, height - 1)) | np.isin(columns, (0, width - 1))
        for total, weights in ((pixels, None), (border, on_border), (u, columns + 0.5), (v, rows + 0.5)):
            total[:, t] = np.bincount(ids, weights, minlength=num_regions)
    seen = pixels > 0
    count = np.maximum(pixels, 1)
    x = (u / count - np.asarray(cameras.cx)) / np.asarray(cameras.fx)
    y = (v / count - np.asarray(cameras.cy)) / np.asarray(cameras.fy)
    local = np.stack([x, y, np.ones_like(x)], axis=-1) / np.sqrt(x * x + y * y + 1)[..., None]
    rotation = np.asarray(cameras.world_to_camera, np.float64)[:, :3, :3]
    directions = np.where(seen[..., None], np.einsum("rti,tij->rtj", local, rotation), 0.0)
    return pixels.astype(np.int32), np.minimum(border / np.sqrt(count), 1.0), directions


def choose_crops(
    pixels: Int[np.ndarray, "r t"],
    cut: Float[np.ndarray, "r t"],
    directions: Float[np.ndarray, "r t 3"],
    most: int,
) -> Bool[np.ndarray, "r t"]:
    """Chooses at most `most` views of each region, one after the other, each time the one of the largest value.

        sqrt(pixels) (1 - cut / 2) (1 - n / 2),  n = max_c max(0, cos(direction, direction_c))^8 over the views c chosen

    So a view that the frame's border cuts counts half, and so does one from the direction of a chosen view. A region of
    many pixels tells an encoder little more than one of fewer, hence the root. Of equal views the first is taken.

    Args:
      pixels: Pixels of R regions in T views.
      cut: How much the border cuts off, 0 to 1.
      directions: Unit vectors.
      most: Largest number of views.
    """
    value = np.sqrt(pixels) * (1 - cut / 2)
    nearness = np.zeros(pixels.shape)
    chosen = np.zeros(pixels.shape, bool)
    every = np.arange(len(pixels))
    for _ in range(min(most, pixels.shape[1])):
        gain = np.where(chosen, 0.0, value * (1 - nearness / 2))
        best = gain.argmax(1)
        chosen[every, best] |= gain[every, best] > 0
        cosines = np.einsum("rtj,rj->rt", directions, directions[every, best])
        nearness = np.maximum(nearness, np.maximum(cosines, 0.0) ** _NEARNESS_POWER)
    return chosen
