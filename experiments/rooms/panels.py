"""Pictures for the pages: answers in a frame, and panels side by side."""

from collections.abc import Mapping

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

_FONT = (cv2.FONT_HERSHEY_SIMPLEX, 0.36)


def answers_overlay(
    frame: UInt8[np.ndarray, "h w 3"], masks: Mapping[str, Bool[np.ndarray, "h w"]]
) -> UInt8[np.ndarray, "h w 3"]:
    """Shows the answers to several texts in one frame.

    Args:
      frame: The frame.
      masks: Text -> mask of its answer.

    Returns:
      The frame in dark grey, and in its colours inside the masks, with each text above or beneath its mask. Of masks
      that overlap, or whose texts would, the largest is shown.
    """
    image = np.repeat(0.35 * frame.mean(-1, keepdims=True), 3, axis=-1).astype(np.uint8)
    occupied = np.zeros(frame.shape[:2], bool)
    places: dict[str, tuple[int, int]] = {}
    for text in sorted((text for text, mask in masks.items() if mask.any()), key=lambda text: -masks[text].sum()):
        rows, columns = np.nonzero(masks[text])
        (width, height), _ = cv2.getTextSize(text, *_FONT, 1)
        left = int(np.clip(columns.mean() - width / 2, 1, max(image.shape[1] - width - 1, 1)))
        above = max(int(rows.min()) - 4, height + 1)
        beneath = min(int(rows.max()) + height + 5, len(image) - 3)
        for base in (above, beneath):
            area = masks[text].copy()
            area[base - height - 1 : base + 4, left : left + width] = True
            if text not in places and not (occupied & area).any():
                places[text] = (left, base)
                occupied |= area
    for text in places:
        image[masks[text]] = frame[masks[text]]
    for text, at in places.items():
        for grey, thickness in ((0, 3), (255, 1)):
            image = cv2.putText(image, text, at, *_FONT, (grey,) * 3, thickness, cv2.LINE_AA)
    return image


def side_by_side(panels: Mapping[str, UInt8[np.ndarray, "h w 3"]]) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Puts pictures side by side on white.

    Args:
      panels: Caption -> picture; all have one height.

    Returns:
      One picture, with the caption under each panel.
    """
    caption_height = 26
    columns = []
    for caption, image in panels.items():
        under = np.full((caption_height, image.shape[1], 3), 255, np.uint8)
        under = cv2.putText(under, caption, (2, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (40, 40, 40), 1, cv2.LINE_AA)
        columns += [np.concatenate([image, under]), np.full((len(image) + caption_height, 6, 3), 255, np.uint8)]
    return np.concatenate(columns[:-1], axis=1)
