"""Compare a field with photographs of another day: what moved, what is gone, what is new.

Run: python docs/examples/07_changes_of_two_dates.py [FIELD [CAPTURE]]

The other day is made up: pictures of the scene without its orange ball.
"""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np

import jsecon

scene = jsecon.open_scene(sys.argv[1] if len(sys.argv) > 1 else "jsecon-demo/field.safetensors")
folder = sys.argv[2] if len(sys.argv) > 2 else "jsecon-demo/capture"
ball = scene.locate("orange ball")

gaussians = scene.field.gaussians
logits = jnp.where(ball.mask, -20.0, gaussians.opacity_logits)
later = dataclasses.replace(gaussians, opacity_logits=logits)
capture = jsecon.load_capture(folder, holdout=0)
seen = [t for t in scene.best_frames(ball, 3) if scene.field.names[t] in capture.names]
rows = [capture.names.index(scene.field.names[t]) for t in seen]
cameras = capture.cameras[rows]
pictures = [jsecon.render_rgb(later, jax.tree.map(jnp.asarray, camera)).features for camera in cameras]
frames = (255 * np.clip(np.stack(pictures), 0, 1)).astype(np.uint8)
names, nothing = tuple(f"later_{row}" for row in rows), np.zeros(len(rows), bool)
photos = dataclasses.replace(capture, frames=frames, cameras=cameras, names=names, held_out=nothing, depths=None)

changes = scene.changes(photos).records()
for change in changes:
    if change["kind"] not in ("same", "not seen"):
        print(change["kind"], change["name"], change["probability"])

gone = [change["name"] for change in changes if change["kind"] == "gone"]
assert any("orange" in name for name in gone), gone
