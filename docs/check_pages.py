"""Checks built pages of the documentation: `python docs/check_pages.py FOLDER`.

No page may ask another host for anything, and every link inside the pages must lead to an element that exists.
"""

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADED = {"link": "href"} | dict.fromkeys(("img", "script", "iframe", "source", "video", "embed"), "src")
"""elements whose target a browser loads by itself"""
REMOTE = re.compile(r"(?:https?:)?//", re.IGNORECASE)


class Page(HTMLParser):
    """The targets and the anchors of a page."""

    def __init__(self, path: Path):
        super().__init__()
        self.loaded: list[str] = []
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Notes the target and the anchors of an element."""
        values = {name: value or "" for name, value in attrs}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        target = values.get(LOADED.get(tag, ""), "")
        if target and values.get("rel") not in ("canonical", "search"):
            self.loaded.append(target)
        if tag == "a" and "href" in values:
            self.links.append(values["href"])


def faults(folder: Path) -> list[str]:
    """A sentence for each fault of the pages that sphinx-build wrote to a folder."""
    pages = {path.resolve(): Page(path) for path in folder.rglob("*.html")}
    found = []
    for style in folder.rglob("*.css"):
        urls = re.findall(r"""(?:url\(|@import)\s*["']?([^"')]+)""", style.read_text())
        found += [f"{style} loads {url}" for url in urls if REMOTE.match(url)]
    for path, page in pages.items():
        name = path.relative_to(folder.resolve())
        found += [f"{name} loads {target}" for target in page.loaded if REMOTE.match(target)]
        for target in {*page.links, *page.loaded}:
            parts = urlsplit(target)
            if parts.scheme or parts.netloc:
                continue
            file = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not file.exists():
                found.append(f"{name} links to {target}, which is missing")
            elif parts.fragment and file in pages and unquote(parts.fragment) not in pages[file].anchors:
                found.append(f"{name} links to {target}, which has no such element")
    return found


if __name__ == "__main__":
    messages = faults(Path(sys.argv[1]))
    print("\n".join(messages) or "No page asks another host, and every link inside the pages leads somewhere.")
    sys.exit(bool(messages))
