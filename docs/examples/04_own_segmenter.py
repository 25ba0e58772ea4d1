"""Use a segmenter of your own: masks of single frames, which the views bring together to objects.

Run: python docs/examples/04_own_segmenter.py [FIELD [CAPTURE]]
"""

import sys

import cv2
import jax
import jax.numpy as jnp
import numpy as np

import jsecon
from jsecon.association.consensus import track_masks
from jsecon.association.frame_superpixels import SceneSuperpixels


def segment(frame, index):
    """Proposes masks (M, H, W) of a frame: what hangs together in one of eight hues, and the rest."""
    hue, saturation, _ = np.moveaxis(cv2.cvtColor(frame, cv2.COLOR_RGB2HSV), -1, 0)
    bins = np.where(saturation > 90, hue // 23, 8)
    masks = []
    for value in np.unique(bins):
        count, pieces = cv2.connectedComponents((bins == value).astype(np.uint8))
        masks += [pieces == piece for piece in range(1, count) if (pieces == piece).mean() >= 0.001]
    return np.array(masks).reshape(-1, *hue.shape)


field = jsecon.load_field(sys.argv[1] if len(sys.argv) > 1 else "jsecon-demo/field.safetensors")
capture = jsecon.load_capture(sys.argv[2] if len(sys.argv) > 2 else "jsecon-demo/capture", downscale=2, holdout=0)
cameras = jax.tree.map(jnp.asarray, capture.cameras)
scene = SceneSuperpixels(field.gaussians, cameras, lambda t: segment(capture.frames[t], t))
found = track_masks(capture.frames, scene)
shown = [len(np.unique(image[image >= 0])) for image in found.labels]
print(f"{found.labels.max() + 1} objects; {min(shown)} to {max(shown)} of them in a frame")

assert 2 <= found.labels.max() + 1 <= 200
assert (found.labels >= 0).mean() > 0.5
