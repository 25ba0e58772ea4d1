"""Chromium without a window, driven over its debugging port: keys, clicks, pictures, and what it asked for."""

import contextlib
import itertools
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
OPTIONS = (
    "--headless=new", "--no-sandbox", "--enable-unsafe-swiftshader", "--use-gl=angle", "--use-angle=swiftshader",
    "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--disable-extensions", "--disable-dev-shm-usage", "--remote-debugging-port=0", "--remote-allow-origins=*",
)  # fmt: skip


class Page:
    """One page. Positions are CSS pixels."""

    def __init__(self, socket: Any):
        self._socket, self._ids = socket, itertools.count(1)
        self.asked: list[str] = []
        """addresses of everything that it loaded or connected to"""

    def send(self, method: str, **given: Any) -> dict:
        """Sends a command of the DevTools protocol; returns what it gave."""
        own = next(self._ids)
        self._socket.send(json.dumps({"id": own, "method": method, "params": given}))
        while True:
            told = json.loads(self._socket.recv(timeout=600))
            if told.get("method") in ("Network.requestWillBeSent", "Network.webSocketCreated"):
                self.asked.append(told["params"].get("url") or told["params"]["request"]["url"])
            if told.get("id") == own:
                if "error" in told:
                    raise RuntimeError(f"{method}: {told['error']}")
                return told["result"]

    def js(self, code: str) -> Any:
        """The value of an expression, awaited."""
        told = self.send("Runtime.evaluate", expression=code, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in told:
            raise RuntimeError(told["exceptionDetails"])
        return told["result"].get("value")

    def until(self, code: str, seconds: float = 20.0) -> Any:
        """The value of an expression as soon as it is true; a page whose script has not run yet is waited for."""

        def value() -> Any:
            try:
                return self.js(code)
            except RuntimeError as error:
                if "ReferenceError" in str(error):
                    return None
                raise

        return until(value, code, seconds)

    def click(self, x: float, y: float) -> None:
        self.send("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        for kind in ("mousePressed", "mouseReleased"):
            self.send("Input.dispatchMouseEvent", type=kind, button="left", clickCount=1, x=x, y=y)

    def key(self, name: str, code: int, text: str = "") -> None:
        given: dict[str, Any] = {"key": name, "windowsVirtualKeyCode": code}
        self.send("Input.dispatchKeyEvent", type="keyDown", text=text, **given)
        self.send("Input.dispatchKeyEvent", type="keyUp", **given)

    def type(self, element: str, text: str) -> None:
        """Replaces what stands in an input (an expression for it), and presses enter."""
        self.js(f"(() => {{ const e = {element}; e.focus(); e.select(); }})()")
        self.send("Input.insertText", text=text)
        time.sleep(0.12)  # the page tells the server of a text at most every 50 ms
        self.key("Enter", 13, "\r")


def until(found: Callable[[], Any], told: str, seconds: float = 20.0) -> Any:
    """What `found` returns as soon as it is true; TimeoutError with `told` where that takes too long."""
    end = time.monotonic() + seconds
    while not (value := found()):
        if time.monotonic() > end:
            raise TimeoutError(f"not within {seconds:g} s: {told}")
        time.sleep(0.05)
    return value


@contextlib.contextmanager
def opened(address: str, folder: Path, *, width: int = 960, height: int = 640) -> Iterator[Page]:
    """A page at an address; `folder` keeps what the browser writes."""
    from websockets.sync.client import connect

    assert CHROMIUM is not None
    command = [CHROMIUM, *OPTIONS, f"--user-data-dir={folder / 'browser'}", f"--window-size={width},{height}"]
    with subprocess.Popen([*command, "about:blank"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            told = folder / "browser" / "DevToolsActivePort"
            port = until(lambda: told.exists() and told.read_text().partition("\n")[0], "Chromium starts")
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=20) as answer:
                target = next(t for t in json.load(answer) if t["type"] == "page")
            patient = {"max_size": None, "ping_interval": None}  # a frame may take the software a minute
            with connect(target["webSocketDebuggerUrl"], **patient) as socket:
                page = Page(socket)
                page.send("Network.enable")
                page.send("Page.navigate", url=address)
                yield page
        finally:
            process.terminate()


def driven(text: str, script: str, folder: Path, **size: int) -> dict:
    """What a script notes of a page, in its object `found`."""
    (folder / "page.html").write_text(text)
    with opened(f"file://{folder / 'page.html'}", folder, **size) as page:
        page.until("document.readyState === 'complete'")
        return page.js(f"(async () => {{ const found = {{}}; {script} return found; }})()")
