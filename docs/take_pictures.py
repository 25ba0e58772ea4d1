"""Takes the pictures of the documentation, in Chromium without a window.

    python docs/take_pictures.py viewer jsecon-demo/field.safetensors
    python docs/take_pictures.py page objects/catalogue.html catalogue

`viewer` photographs `jsecon view` with three texts, `page` any page that jsecon wrote. They go to docs/pictures.
"""

import argparse
import base64
import io
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image

HOME = Path(__file__).resolve().parent.parent
OUT = HOME / "docs" / "pictures"
sys.path.insert(0, str(HOME / "tests"))
from browser import opened  # noqa: E402

TEXTS = ("orange ball", "dark green bottle", "purple vase")
"""what the viewer highlights"""
SECONDS = 12
"""s until the answers are there and the software has drawn them"""


def photograph(address: str, width: int, height: int, seconds: float) -> Image.Image:
    """Photographs a page.

    Args:
      address: Its address.
      width: Width of the window, px.
      height: Height of the window, px.
      seconds: Time to wait before, s.
    """
    with tempfile.TemporaryDirectory() as folder, opened(address, Path(folder), width=width, height=height) as page:
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        page.send("Emulation.setDeviceMetricsOverride", **size)
        time.sleep(seconds)
        shot = page.send("Page.captureScreenshot", format="png")["data"]
        return Image.open(io.BytesIO(base64.b64decode(shot))).convert("RGB")


def save(image: Image.Image, name: str) -> None:
    """Saves a picture as docs/pictures/NAME.webp."""
    OUT.mkdir(exist_ok=True)
    image.save(OUT / f"{name}.webp", quality=82, method=6)
    print(OUT / f"{name}.webp", image.size, f"{(OUT / f'{name}.webp').stat().st_size / 1e3:.0f} kB")


def picture_viewer(field: Path) -> None:
    """Pictures the viewer with the answers of three texts."""
    command = [sys.executable, "-u", "-m", "jsecon", "view", str(field), *TEXTS, "--port", "8799"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            for line in process.stdout:
                if "http://" in line:
                    address = line[line.index("http://") :].split()[0]
                    save(photograph(address, 1200, 720, SECONDS), "viewer")
                    break
        finally:  # it would wait for the page to close
            process.kill()


def main() -> None:
    """Runs one of the commands of the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True, dest="command")
    viewer = commands.add_parser("viewer")
    viewer.add_argument("field", type=Path)
    page = commands.add_parser("page")
    page.add_argument("page", type=Path)
    page.add_argument("name")
    page.add_argument("--size", type=int, nargs=2, default=(1200, 720))
    options = parser.parse_args()
    if options.command == "viewer":
        picture_viewer(options.field)
    else:
        save(photograph(options.page.resolve().as_uri(), *options.size, 2), options.name)


if __name__ == "__main__":
    main()
