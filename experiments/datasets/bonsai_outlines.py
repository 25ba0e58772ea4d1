"""Things in eight held-out photographs of Mip-NeRF 360's bonsai, outlined by hand for this project."""

import json
from pathlib import Path

import cv2
import numpy as np

from jsecon.types import Capture

OUTLINES = Path(__file__).with_name("bonsai_outlines.json")
"""Polygons by frame and thing, and the order in which things hide each other."""


def outlines(capture: Capture) -> dict[str, dict[int, np.ndarray]]:
    """Masks of the visible parts of each thing.

    Args:
      capture: The capture, with frames of any size.

    Returns:
      (H, W) bool masks by thing and index of the frame.
    """
    drawn = json.loads(OUTLINES.read_text())
    height, width = capture.frames.shape[1:3]
    scale = np.array([width / drawn["width"], height / drawn["height"]])
    masks: dict[str, dict[int, np.ndarray]] = {}
    for name, things in drawn["frames"].items():
        t = capture.names.index(name)
        covered = np.zeros((height, width), bool)
        for thing in drawn["in_front"]:
            if thing in things:
                mask = np.zeros((height, width), np.uint8)
                for polygon in things[thing]:
                    cv2.fillPoly(mask, [np.rint(np.array(polygon) * scale).astype(np.int32)], 1)
                masks.setdefault(thing, {})[t] = (mask > 0) & ~covered
                covered |= mask > 0
    return masks
