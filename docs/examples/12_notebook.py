"""Show a scene and an answer in a notebook; as a script it writes the pictures.

Run: python docs/examples/12_notebook.py [FIELD]
"""

import sys

from PIL import Image

import jsecon

scene = jsecon.open_scene(sys.argv[1] if len(sys.argv) > 1 else "jsecon-demo/field.safetensors")
answer = scene.ask("red mug")

picture = scene.render(scene.best_frames(answer, 1)[0], answer)  # an array
image = Image.fromarray(picture)  # which a notebook shows, in the last line of a cell
image.save("red-mug.png")
print(answer, picture.shape)

assert picture.shape[-1] == 3
assert picture.std() > 5
