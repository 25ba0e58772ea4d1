"""The viewer, from enter to changed pixels, and until a field can be asked.

    python benchmarks/view.py FIELD [--copies 3] [--asks 8] [--pixels 120] [--undrawn]

FIELD, copied side by side until it has as many Gaussians as are wanted, is opened by `jsecon view` in processes of
their own: the first compiles, the second finds what it compiled. Then Chromium without a window, with WebGL in
software, looks at it in a picture of few pixels, and texts are typed: new ones, and those that were asked before. Of
each the time from the enter key to the call that draws the changed colours, and the time of that frame itself, which
a graphics card would draw. With --undrawn the call that draws the splats does nothing: what is left is all that goes
before it (the server, the transfer, the page's own work), which is what a graphics card would leave to wait for.
"""

import argparse
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

from jsecon.process import prepare_process

prepare_process()
sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

import numpy as np
from browser import Page, opened, until
from serve import SHADES, WORDS, copied, free_port

from jsecon.app.scene import Scene
from jsecon.app.viewer.window import Viewer, ViewState, open_viewer
from jsecon.field.field import load_field, save_field

HOOK = """(undrawn => {
  const now = () => performance.timeOrigin + performance.now();
  const seen = (window.seen = { enter: 0, upload: 0, draws: 0, first: null });
  const canvas = [...document.querySelectorAll('canvas')].sort((a, b) => b.width - a.width)[0];
  const gl = canvas.getContext('webgl2'), pixel = new Uint8Array(4);
  window.addEventListener('keydown', e => { if (e.key === 'Enter') seen.enter = now(); }, true);
  for (const name of ['texSubImage2D', 'texImage2D']) {
    const was = gl[name].bind(gl);
    gl[name] = (...given) => { const data = given.at(-1) ?? given.at(-2);
      if (given.some(g => ArrayBuffer.isView(g) && g.byteLength > 1e6)) seen.upload = now();
      return was(...given); };
  }
  const draw = gl.drawElementsInstanced.bind(gl);
  gl.drawElementsInstanced = (...given) => {
    const began = now(), splats = given[4] >= 1000;
    if (!splats || !undrawn) draw(...given);
    if (!splats) return;
    if (seen.upload && !seen.first) {
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);  // returns when it is drawn
      seen.first = [began, now()];
    }
    seen.draws += 1;
  };
  window.settled = () => gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
  return [canvas.width, canvas.height];
})"""
FIND = """[...document.querySelectorAll('input')].find(e => {
  for (let p = e, k = 0; k < 6 && p; k++, p = p.parentElement) if (p.innerText?.trim() === 'find') return true; })"""


UPLOAD_SECONDS = 15.0
"""after the server's answer, after which the page has nothing to draw"""


def opening(file: Path) -> float:
    """Seconds until `jsecon view` says its address, when it can be asked and its page be loaded."""
    port, began = free_port(), time.perf_counter()
    command = [sys.executable, "-m", "jsecon", "view", str(file), "--port", str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("http://"):
                break
        seconds = time.perf_counter() - began
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=20) as answer:
            assert answer.status == 200
        process.terminate()
    return seconds


def quiet(page: Page) -> None:
    """Waits until the page has drawn all that it wanted to, 15 s at most: where it draws without an end."""
    count, until_then = -1, time.monotonic() + 15
    while page.js("settled(), seen.draws") != count and time.monotonic() < until_then:
        count = page.js("seen.draws")
        time.sleep(1.5)


def asked(page: Page, viewer: Viewer, text: str) -> dict[str, float]:
    """Milliseconds of one question, from enter: the server's share, the upload, the first picture that it changed.
    Nothing where the answer is the one before, which changes no picture."""
    quiet(page)
    page.js("seen.upload = seen.enter = 0, seen.first = null")
    told: dict[str, float] = {}
    paint, then = viewer.layer.paint, viewer.then

    def timed_paint(*given) -> None:
        paint(*given)
        told.setdefault("sent", 1000 * time.time())

    def timed_then(*given, **more) -> None:
        told.setdefault("heard", 1000 * time.time())
        then(*given, **more)

    viewer.layer.paint, viewer.then = timed_paint, timed_then
    cpu = time.process_time()
    page.type(FIND, text)
    until(lambda: "sent" in told, "the answer is sent", 60)
    cpu = 1000 * (time.process_time() - cpu)
    viewer.layer.paint, viewer.then = paint, then
    try:
        page.until("seen.upload", UPLOAD_SECONDS)
    except TimeoutError:
        return {}
    began, drawn = page.until("seen.first", 600)
    enter, upload = page.js("[seen.enter, seen.upload]")
    return {
        "server": told["sent"] - told["heard"],
        "server's CPU": cpu,
        "enter to upload": upload - enter,
        "enter to draw": began - enter,
        "the frame itself": drawn - began,
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("field", type=Path)
    parser.add_argument("--copies", type=int, default=3)
    parser.add_argument("--asks", type=int, default=8)
    parser.add_argument("--pixels", type=int, default=120)
    parser.add_argument("--undrawn", action="store_true", help="leave the drawing of splats out, slow in software")
    given = parser.parse_args()
    field = copied(load_field(given.field), given.copies)
    print(f"{field.gaussians.count} Gaussians, {field.regions.count} regions")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "field.safetensors"
        save_field(file, field)
        for name in ("first", "warm", "warm"):
            print(f"opened after {opening(file):.1f} s, {name}", flush=True)
        viewer = open_viewer(Scene(field), port=free_port(), state=ViewState())
        address = f"http://127.0.0.1:{viewer.server.get_port()}/"
        same = {"deviceScaleFactor": 1, "mobile": False}
        with opened(address, Path(folder), width=640, height=480) as page:
            page.send("Emulation.setDeviceMetricsOverride", width=given.pixels, height=given.pixels * 3 // 4, **same)
            page.until(f"{FIND} && document.querySelectorAll('canvas').length > 1", 60)
            time.sleep(2)
            print("canvas", page.js(f"{HOOK}({str(given.undrawn).lower()})"), flush=True)
            texts = [f"{shade} {word}" for shade in SHADES for word in WORDS][: given.asks]
            for name in ("new", "known"):
                rows = [row for text in texts if (row := asked(page, viewer, text))]
                for key in rows[0]:
                    values = [row[key] for row in rows]
                    print(f"{name:6} {key:16} median {np.median(values):7.1f} ms, worst {max(values):7.1f}", flush=True)
        viewer.stop()


if __name__ == "__main__":
    main()
