"""Show a scene and an answer in a notebook; as a script it writes the pictures.

Run: python docs/examples/12_notebook.py [FIELD]
"""

import sys

from PIL import Image

import jsecon

scene = jsecon.open_scene(sys.argv[1] if len(sys.argv) > 1 else "jsecon-demo/field.safetensors")
answer = scene.ask("red mug")

html = jsecon.to_html(scene.field)  # what a notebook shows for `scene.field` in the last line of a cell
picture = scene.render(scene.best_frames(answer, 1)[0], answer)  # an array: show it by matplotlib or PIL
Image.fromarray(picture).save("red-mug.png")
print(answer, picture.shape, len(html))

assert picture.shape[-1] == 3
assert picture.std() > 5
assert "<" in html
