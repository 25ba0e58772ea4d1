"""The viewer's page: until it is served, until its first picture, what a question takes, and a turned frame.

    python benchmarks/view.py FIELD [--copies 3] [--asks 8]

FIELD, copied side by side, is opened by `jsecon view` in processes of their own: the first compiles, the second finds
what it compiled. Then Chromium without a window, with WebGL in software, opens the page, texts are asked, and the scene
turns. A graphics card would draw the frames, so their time is told apart from that of the rest of the page.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from jsecon.process import prepare_process

prepare_process()
sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

import numpy as np
from browser import opened
from serve import SHADES, WORDS, copied, free_port

from jsecon.field.field import load_field, save_field

PAGE = """
const now = () => performance.now(), pixel = new Uint8Array(4);
const timed = async act => { const began = now(); await act(); return now() - began; };
const frame = () => { draw(); gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel); };
const found = { canvas: [canvas.width, canvas.height], asked: [], frames: [] };
window.requestAnimationFrame = () => 0;  // no frame while a question is measured
for (const text of TEXTS) found.asked.push(await timed(() => select([text])));
found.light = await timed(light);
found.sort = await timed(() => sort([0, 0, 0], [0, 0, 1]));
found.click = await timed(() => pick(canvas.width / 2, canvas.height / 2));
for (let k = 0; k < 5; k++) found.frames.push(await timed(() => { view.yaw += 0.1; frame(); }));
found.heap = performance.memory.usedJSHeapSize / 2 ** 20;
return found;
"""


def serve(file: Path) -> tuple[subprocess.Popen[str], str, float]:
    """The process of `jsecon view`, its address, and the seconds until it is told."""
    began = time.perf_counter()
    command = [sys.executable, "-u", "-m", "jsecon", "view", str(file), "--port", str(free_port())]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    address = next(line.strip() for line in process.stdout if line.startswith("http://"))
    return process, address, time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("field", type=Path)
    parser.add_argument("--copies", type=int, default=3)
    parser.add_argument("--asks", type=int, default=8)
    given = parser.parse_args()
    field = copied(load_field(given.field), given.copies)
    print(f"{field.gaussians.count} Gaussians, {field.regions.count} regions")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "field.safetensors"
        save_field(file, field)
        for name in ("first", "warm"):
            process, address, seconds = serve(file)
            print(f"served after {seconds:.1f} s, {name}", flush=True)
            if name == "first":
                process.terminate()
                process.wait()
        began = time.perf_counter()
        with opened(address, Path(folder), width=640, height=480) as page:
            page.until("document.readyState === 'complete' && typeof pick === 'function'", 120)
            print(f"page read after {time.perf_counter() - began:.1f} s, with the start of Chromium", flush=True)
            texts = [f"{shade} {word}" for shade in SHADES for word in WORDS][: given.asks]
            found = page.js(f"(async () => {{ const TEXTS = {texts}; {PAGE} }})()")
        process.terminate()
        process.wait()
    print(f"canvas {found['canvas']}, JavaScript's heap {found['heap']:.0f} MiB")
    for name in ("asked", "frames", "light", "sort", "click"):
        values = np.atleast_1d(found[name])
        print(f"{name:8} median {np.median(values):7.1f} ms, worst {values.max():7.1f}")


if __name__ == "__main__":
    main()
