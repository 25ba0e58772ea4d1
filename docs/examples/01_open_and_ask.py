"""Open a field, ask for a thing, and use its Gaussians.

Run: python docs/examples/01_open_and_ask.py [FIELD]
"""

import sys

import numpy as np

import jsecon

scene = jsecon.open_scene(sys.argv[1] if len(sys.argv) > 1 else "jsecon-demo/field.safetensors")
answer = scene.ask("orange ball")
print(answer)

means = np.asarray(scene.field.gaussians.means)[answer.rows]
print("centres lie within", np.ptp(means, axis=0).round(3))
frame = scene.best_frames(answer, 1)[0]
print("seen best in", scene.field.names[frame])

assert answer.state in ("found", "unsure")
assert len(answer.rows) == answer.mask.sum() > 0
assert scene.mask(answer, frame).any()
