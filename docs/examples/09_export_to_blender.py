"""Export each object as a file, with a table of their names, for Blender or another editor.

Run: python docs/examples/09_export_to_blender.py [FIELD [FOLDER]]
"""

import json
import sys
from pathlib import Path

import jsecon

scene = jsecon.open_scene(sys.argv[1] if len(sys.argv) > 1 else "jsecon-demo/field.safetensors")
folder = Path(sys.argv[2] if len(sys.argv) > 2 else "jsecon-demo/objects")
folder.mkdir(parents=True, exist_ok=True)

catalogue, table = scene.objects(), {}
for number, name in enumerate(catalogue.names):
    mask = catalogue.labels == number
    if mask.any() and not catalogue.surroundings[number]:
        file = folder / f"{number:03d}.ply"
        scene.export(file, mask)  # for an add-on that opens Gaussians
        table[file.name] = {"name": name, "gaussians": int(mask.sum())}
(folder / "names.json").write_text(json.dumps(table, indent=1))
print(len(table), "objects in", folder)

for file, row in table.items():
    assert jsecon.load_gaussians(folder / file).count == row["gaussians"]
assert table
