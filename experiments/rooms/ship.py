"""Writes the capture that `jsecon demo` copies, jsecon/demo/room: room 0 as JPEG, COLMAP, masks and LERF labels.

    python -m experiments.rooms.ship

JPEG at quality 95 without subsampled colours is 42.4 dB from the ray-traced frames, WebP at its best 37.3; PNG takes
2.6 MB. The capture has at most 1.5 MB.
"""

import json
import shutil
from pathlib import Path

from PIL import Image

from experiments.rooms.capture import write_room
from experiments.rooms.room import crowded_room
from experiments.rooms.writers import write_colmap
from jsecon.app.running import ROOM
from jsecon.read.captures.capture import load_capture

MAX_BYTES = 1_500_000
HOLDOUT = 5


def main(folder: Path = ROOM) -> None:
    """Writes the folder anew and prints its size."""
    shutil.rmtree(folder, ignore_errors=True)
    write_room(folder, crowded_room(0), holdout=HOLDOUT)
    capture = load_capture(folder, holdout=HOLDOUT, downscale=1.0)
    shutil.rmtree(folder / "images")
    write_colmap(capture, folder, image_format="jpg")
    for name, frame in zip(capture.names, capture.frames):
        Image.fromarray(frame).save(folder / "images" / f"{name}.jpg", quality=95, subsampling=0, optimize=True)
    for file in (folder / "masks").glob("*.png"):
        Image.open(file).save(file, optimize=True)
    for file in (folder / "label").glob("*.json"):
        label = json.loads(file.read_text())
        label["info"]["name"] = f"{file.stem}.jpg"
        file.write_text(json.dumps(label, separators=(",", ":")) + "\n")
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    assert size <= MAX_BYTES, f"{size} bytes"
    print(f"{folder}: {size} bytes")


if __name__ == "__main__":
    main()
