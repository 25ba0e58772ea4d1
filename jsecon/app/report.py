"""Elements of a self-contained HTML page: pictures are data, and no resource lies outside.

The page is legible in light and dark, on a phone and on paper. Its style and its script are in report_page.html;
without the script only the enlarged pictures are missing. Each function returns HTML.
"""

import base64
import html
from collections.abc import Iterable
from importlib import resources

import cv2
import numpy as np


def page(title: str, lead: str, parts: Iterable[str]) -> str:
    """Makes the whole document; `lead` is a sentence under the title."""
    template = resources.files("jsecon.app").joinpath("report_page.html").read_text(encoding="utf-8")
    filled = template.replace("__TITLE__", _escaped(title)).replace("__LEAD__", _escaped(lead))
    return filled.replace("__PARTS__", "\n".join(parts))


def section(title: str, words: str, *parts: str) -> str:
    """Makes a section; `words` stand under its heading."""
    paragraph = f'<p class="soft">{_escaped(words)}</p>' if words else ""
    return f"<section><h2>{_escaped(title)}</h2>{paragraph}{''.join(parts)}</section>"


def figure(image: np.ndarray, caption: str, *, strong: str = "", sharp: bool = False) -> str:
    """Makes a figure of an RGB image, which a click enlarges; `sharp` keeps flat colours without loss."""
    bold = f"<b>{_escaped(strong)}</b> " if strong else ""
    picture = _image(image, f"{strong} {caption}".strip(), sharp, " tabindex=0")
    return f"<figure>{picture}<figcaption>{bold}{_escaped(caption)}</figcaption></figure>"


def grid(elements: Iterable[str], columns: int | None = None, *, folded: str = "") -> str:
    """Puts elements side by side: figures in so many columns on a wide screen, or cards in as many as there is room.

    A click on the title `folded`, if there is one, opens them.
    """
    kind = 'cards"' if columns is None else f'grid" style="--columns:{columns}"'
    whole = f'<div class="{kind}>{"".join(elements)}</div>'
    return f"<details><summary>{_escaped(folded)}</summary>{whole}</details>" if folded else whole


def card(image: np.ndarray, title: str, words: str, *parts: str) -> str:
    """Makes a card of an RGB image with words under it, which a click opens to show its elements."""
    summary = f"<summary>{_image(image, title, False)}<b>{_escaped(title)}</b><span>{_escaped(words)}</span></summary>"
    return f'<details class="card">{summary}{"".join(parts)}</details>'


def _image(image: np.ndarray, words: str, sharp: bool, attributes: str = "") -> str:
    """Returns the tag of an RGB image, whose data is a JPEG, or a PNG if `sharp`."""
    ending, kind, options = (".png", "png", []) if sharp else (".jpg", "jpeg", [cv2.IMWRITE_JPEG_QUALITY, 88])
    _, data = cv2.imencode(ending, cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2BGR), options)
    source = f"data:image/{kind};base64,{base64.b64encode(data.tobytes()).decode()}"
    return f'<img alt="{_escaped(words)}" src="{source}"{attributes}>'


def _escaped(value: object) -> str:
    """Returns a value as text of HTML."""
    return html.escape(str(value))
