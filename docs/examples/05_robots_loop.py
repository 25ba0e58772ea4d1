"""A robot's loop: a frame with its pose comes in, the field grows by it, and the robot asks.

Run: python docs/examples/05_robots_loop.py [FIELD [CAPTURE]]
"""

import dataclasses
import sys
import time

import jsecon

path = sys.argv[1] if len(sys.argv) > 1 else "jsecon-demo/field.safetensors"
folder = sys.argv[2] if len(sys.argv) > 2 else "jsecon-demo/capture"
capture = jsecon.load_capture(folder, holdout=0)
whole = jsecon.open_scene(path)
seen = [name for name in whole.field.names if name in whole.ledger.views]
scene = whole.forget(seen[-2:])  # a field of the past: it has not seen the last two frames

for name in seen[-2:]:
    began = time.perf_counter()
    t = capture.names.index(name)
    frame = dataclasses.replace(
        capture, frames=capture.frames[[t]], cameras=capture.cameras[[t]], names=(name,), held_out=capture.held_out[[t]]
    )
    scene = scene.add(frame)
    answer = scene.ask("orange ball")
    print(f"{name}: {len(scene.field.names)} frames, {time.perf_counter() - began:.2f} s, {answer}")

assert set(scene.field.names) == set(whole.field.names)
assert answer.mask.any()
