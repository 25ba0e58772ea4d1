"""Elements of a self-contained HTML page: pictures are data, and no resource lies outside.

The page is legible in light and dark, on a phone and on paper. Its style and its script are in report_page.html;
without the script only the enlarged pictures are missing.
"""

import base64
import html
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources

import cv2
import numpy as np

JPEG_QUALITY = 88


def page(title: str, lead: str, parts: Iterable[str]) -> str:
    """Makes the whole document.

    Args:
      title: Title of the page.
      lead: Sentence under the title.
      parts: Elements that the functions below return.

    Returns:
      The HTML.
    """
    template = resources.files("jsecon.app").joinpath("report_page.html").read_text(encoding="utf-8")
    filled = template.replace("__TITLE__", _escaped(title)).replace("__LEAD__", _escaped(lead))
    return filled.replace("__PARTS__", "\n".join(parts))


def section(title: str, words: str, *parts: str) -> str:
    """Makes a section.

    Args:
      title: Its heading.
      words: A sentence or two under the heading, or "".
      *parts: Its elements.

    Returns:
      Its HTML.
    """
    paragraph = f'<p class="soft">{_escaped(words)}</p>' if words else ""
    return f"<section><h2>{_escaped(title)}</h2>{paragraph}{''.join(parts)}</section>"


def tiles(figures: Mapping[str, str]) -> str:
    """Makes headline figures.

    Args:
      figures: Name -> value with its unit.

    Returns:
      Its HTML.
    """
    tile = '<div class="tile"><b>{}</b><span>{}</span></div>'
    return f'<div class="tiles">{"".join(tile.format(_escaped(v), _escaped(k)) for k, v in figures.items())}</div>'


def table(header: Sequence[str], rows: Iterable[Sequence[object]], *, numbers_from: int = 1) -> str:
    """Makes a table.

    Args:
      header: Names of the columns.
      rows: Values of each row.
      numbers_from: Index of the first column that is aligned to the right.

    Returns:
      Its HTML.
    """

    def cells(tag: str, row: Sequence[object]) -> str:
        kinds = ("" if i < numbers_from else " class=n" for i in range(len(row)))
        return "".join(f"<{tag}{kind}>{_escaped(cell)}</{tag}>" for kind, cell in zip(kinds, row))

    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return _scrolled(f"<table><thead><tr>{cells('th', header)}</tr></thead><tbody>{body}</tbody></table>")


def bars(seconds: Mapping[str, float]) -> str:
    """Makes a bar for each stage.

    Args:
      seconds: Stage -> its seconds.

    Returns:
      Its HTML, with a sum.
    """
    longest = max(seconds.values(), default=0.0) or 1.0
    rows = "".join(
        f'<tr><td>{_escaped(name)}</td><td class="n">{value:.1f} s</td><td class="length"><div class="bar" '
        f'style="width:{100 * value / longest:.1f}%"></div></td></tr>'
        for name, value in seconds.items()
    )
    total = f'<tr><td><b>all</b></td><td class="n"><b>{sum(seconds.values()):.1f} s</b></td><td></td></tr>'
    return _scrolled(f"<table><tbody>{rows}{total}</tbody></table>")


def figure(image: np.ndarray, caption: str, *, strong: str = "", sharp: bool = False, wide: bool = False) -> str:
    """Makes a figure, which a click enlarges.

    Args:
      image: (H, W, 3) uint8 RGB.
      caption: The caption.
      strong: Bold words before the caption.
      sharp: Keeps the image without loss, for masks and flat colours.
      wide: Lets a narrow screen scroll the image sideways.

    Returns:
      Its HTML.
    """
    picture = _image(image, f"{strong} {caption}", sharp, " tabindex=0")
    element = f"<figure>{picture}{_caption(caption, strong)}</figure>"
    return f'<div class="wide">{element}</div>' if wide else element


def pair(before: np.ndarray, after: np.ndarray, caption: str, *, strong: str = "") -> str:
    """Makes a figure of two pictures of one view on top of each other, with a slider between them.

    Args:
      before: (H, W, 3) uint8 RGB of the lower picture.
      after: (H, W, 3) uint8 RGB of the upper picture, of which the slider shows a part.
      caption: The caption.
      strong: Bold words before the caption.

    Returns:
      Its HTML.
    """
    both = _image(before, "before") + _image(after, f"{strong} {caption}", attributes=' class="after"')
    slider = '<input type="range" value="25" aria-label="how much of each picture is shown">'
    return f'<figure class="pair"><div>{both}{slider}</div>{_caption(caption, strong)}</figure>'


def grid(figures: Iterable[str], columns: int) -> str:
    """Puts figures side by side.

    Args:
      figures: The figures.
      columns: Number of columns on a wide screen.

    Returns:
      Its HTML.
    """
    return f'<div class="grid" style="--columns:{columns}">{"".join(figures)}</div>'


def cards(elements: Iterable[str], search: str = "") -> str:
    """Puts cards side by side.

    Args:
      elements: The cards (`card`).
      search: Hint in a search box above them; "" leaves the box out.

    Returns:
      Its HTML. The box hides the cards of the page whose `search` lacks one of its words.
    """
    words = _escaped(search)
    box = f'<input id="search" type="search" placeholder="{words}" aria-label="{words}">' if search else ""
    return f'{box}<div class="cards">{"".join(elements)}</div>'


def card(image: np.ndarray, title: str, words: str, *parts: str, search: str) -> str:
    """Makes a card, which a click opens to show its elements.

    Args:
      image: (H, W, 3) uint8 RGB of its picture.
      title: Its title.
      words: Words under the title.
      *parts: Its elements.
      search: Text in which a search box looks for its words.

    Returns:
      Its HTML.
    """
    summary = f"<summary>{_image(image, title)}<b>{_escaped(title)}</b><span>{_escaped(words)}</span></summary>"
    return f'<details class="card" data-search="{_escaped(search.lower())}">{summary}{"".join(parts)}</details>'


def folded(title: str, *parts: str) -> str:
    """Hides elements until a click on their title.

    Args:
      title: The title.
      *parts: The elements.

    Returns:
      Its HTML.
    """
    return f"<details><summary>{_escaped(title)}</summary>{''.join(parts)}</details>"


def data_uri(image: np.ndarray, *, sharp: bool = False) -> str:
    """Encodes an image.

    Args:
      image: (H, W, 3) uint8 RGB.
      sharp: Encodes without loss.

    Returns:
      A data URI: of a JPEG, or of a PNG if `sharp`.
    """
    ending, kind, options = (".png", "png", []) if sharp else (".jpg", "jpeg", [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    _, data = cv2.imencode(ending, cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2BGR), options)
    return f"data:image/{kind};base64,{base64.b64encode(data.tobytes()).decode()}"


def _image(image: np.ndarray, words: str, sharp: bool = False, attributes: str = "") -> str:
    """Returns the tag of an image."""
    return f'<img alt="{_escaped(words.strip())}" src="{data_uri(image, sharp=sharp)}"{attributes}>'


def _caption(caption: str, strong: str) -> str:
    """Returns the tag of a caption."""
    return f"<figcaption>{f'<b>{_escaped(strong)}</b> ' if strong else ''}{_escaped(caption)}</figcaption>"


def _scrolled(element: str) -> str:
    """Returns an element that scrolls sideways on a narrow screen."""
    return f'<div class="scroll">{element}</div>'


def _escaped(value: object) -> str:
    """Returns a value as text of HTML."""
    return html.escape(str(value))
