"""Remove floaters from a scene; here some that the script adds.

Run: python docs/examples/10_clean.py [FIELD]

The command `jsecon clean scene.ply --out clean.ply` does the same with files.
"""

import dataclasses
import sys

import numpy as np

import jsecon
from jsecon.views.clean import KINDS, find_litter

field = jsecon.load_field(sys.argv[1] if len(sys.argv) > 1 else "jsecon-demo/field.safetensors")
gaussians, draw = field.gaussians, np.random.default_rng(0)
count, extra = gaussians.count, gaussians.count // 50

# Copies of some Gaussians, halfway between where they are and a camera.
rows = draw.integers(count, size=extra)
poses = np.asarray(field.cameras.world_to_camera)[draw.integers(len(field.names), size=extra)]
eyes = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
columns = {f.name: np.asarray(getattr(gaussians, f.name)) for f in dataclasses.fields(gaussians)}
added = {name: column[rows] for name, column in columns.items()}
added["means"] = 0.5 * (added["means"] + eyes)
dirty = dataclasses.replace(gaussians, **{name: np.concatenate([columns[name], added[name]]) for name in columns})

kinds = find_litter(dirty, field.cameras)
print({kind: int((kinds == k).sum()) for k, kind in enumerate(KINDS)})
gone = kinds > 0
print(f"{gone[count:].mean():.0%} of what was added goes, {gone[:count].mean():.1%} of the scene")
jsecon.save_gaussians("clean.ply", dataclasses.replace(dirty, **{n: getattr(dirty, n)[~gone] for n in columns}))

assert gone[count:].mean() > 0.8
assert gone[:count].mean() < 0.2
assert jsecon.load_gaussians("clean.ply").count == (~gone).sum()
