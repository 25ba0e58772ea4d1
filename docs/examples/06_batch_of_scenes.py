"""Ask many scenes the same texts, and write a table.

Run: python docs/examples/06_batch_of_scenes.py [FIELD ...]
"""

import csv
import sys

import jsecon

TEXTS = ["red mug", "orange ball", "white plate", "purple elephant"]

rows = []
for path in sys.argv[1:] or ["jsecon-demo/field.safetensors"]:
    scene = jsecon.open_scene(path)
    for text, answer in zip(TEXTS, scene.ask_all(TEXTS)):
        if isinstance(answer, jsecon.InputError):  # such as a word that the embedder does not know
            rows.append((path, text, "refused", 0, 0))
        else:
            rows.append((path, text, answer.state, answer.count, len(answer.rows)))

out = csv.writer(sys.stdout)
out.writerow(("field", "text", "state", "objects", "Gaussians"))
out.writerows(rows)

assert len(rows) % len(TEXTS) == 0
assert any(row[4] > 0 for row in rows)
