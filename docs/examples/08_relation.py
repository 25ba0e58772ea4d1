"""Tell things apart by where they are.

Run: python docs/examples/08_relation.py [FIELD]
"""

import sys

import jsecon

scene = jsecon.open_scene(sys.argv[1] if len(sys.argv) > 1 else "jsecon-demo/field.safetensors")
answer = scene.ask("the orange ball on the white plate")
print(answer)
plain = scene.ask("orange ball")
print(plain)

try:
    scene.ask("the orange ball betwixt the plates")
except jsecon.InputError as error:
    print("refused:", error)

assert answer.count <= plain.count
assert not (answer.mask & ~plain.mask).any()
