"""Measure the way between two things, and the size of one.

Run: python docs/examples/11_measure.py [FIELD]
"""

import sys

import numpy as np

import jsecon

scene = jsecon.open_scene(sys.argv[1] if len(sys.argv) > 1 else "jsecon-demo/field.safetensors")
way = scene.measure("orange ball", "white plate")
print(f"from the ball to the plate: {way['centers']:.3f} {way['unit']}, their surfaces {way['surfaces']:.3f} apart")

ball = scene.locate("orange ball").place
print("the ball is", (2 * ball.half_size).round(3), "large, its middle at", ball.center.round(3))

plate = scene.locate("white plate").place
assert abs(np.linalg.norm(ball.center - plate.center) - way["centers"]) < 0.1 * way["centers"]
assert 0 <= way["surfaces"] <= way["centers"]
