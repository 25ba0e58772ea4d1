"""One self-contained HTML page: pictures as data, no outside resource, legible in light and dark, on a phone and on
paper; its style and its few lines of script are report_page.html. Without the script nothing is missing but size."""

import base64
import html
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources

import cv2
import numpy as np

from jsecon.pipeline.progress import Step


def page(title: str, lead: str, parts: Iterable[str]) -> str:
    """The whole document; `parts` are what the functions below return."""
    template = resources.files("jsecon.app").joinpath("report_page.html").read_text(encoding="utf-8")
    filled = template.replace("__TITLE__", _text(title)).replace("__LEAD__", _text(lead))
    return filled.replace("__PARTS__", "\n".join(parts))


def section(title: str, words: str, *parts: str) -> str:
    """A heading, a sentence or two, and what belongs to it."""
    told = f'<p class="soft">{_text(words)}</p>' if words else ""
    return f"<section><h2>{_text(title)}</h2>{told}{''.join(parts)}</section>"


def tiles(figures: Mapping[str, str]) -> str:
    """Headline figures: what -> value."""
    tile = '<div class="tile"><b>{}</b><span>{}</span></div>'
    told = "".join(tile.format(_text(value), _text(what)) for what, value in figures.items())
    return f'<div class="tiles">{told}</div>'


def table(header: Sequence[str], rows: Iterable[Sequence[object]], *, numbers_from: int = 1) -> str:
    """A table; columns from `numbers_from` on are set to the right."""

    def cells(tag: str, row: Sequence[object]) -> str:
        kinds = ("" if i < numbers_from else " class=n" for i in range(len(row)))
        return "".join(f"<{tag}{kind}>{_text(cell)}</{tag}>" for kind, cell in zip(kinds, row))

    head, body = cells("th", header), "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def shades(header: Sequence[str], rows: Iterable[tuple[str, Sequence[float | None]]]) -> str:
    """A table of values from 0 to 1, the higher the deeper in colour; None is a gap."""

    def cell(value: float | None) -> str:
        return "<td></td>" if value is None else f'<td class="n" style="--v:{100 * value:.0f}%">{value:.2f}</td>'

    head = "".join(f"<th{' class=n' if k else ''}>{_text(name)}</th>" for k, name in enumerate(header))
    body = "".join(f"<tr><td>{_text(name)}</td>{''.join(map(cell, values))}</tr>" for name, values in rows)
    return (
        f'<div class="scroll"><table class="shades"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
    )


def bars(seconds: Mapping[str, float], beside: Mapping[str, str] | None = None) -> str:
    """A bar for each stage's seconds, and what there is to say `beside` it."""
    longest = max(seconds.values(), default=0.0) or 1.0
    rows = "".join(
        f'<tr><td>{_text(name)}</td><td class="n">{value:.1f} s</td><td class="length"><div class="bar" '
        f'style="width:{100 * value / longest:.1f}%"></div></td><td>{_text((beside or {}).get(name, ""))}</td></tr>'
        for name, value in seconds.items()
    )
    total = f'<tr><td><b>all</b></td><td class="n"><b>{sum(seconds.values()):.1f} s</b></td><td></td><td></td></tr>'
    return f'<div class="scroll"><table><tbody>{rows}{total}</tbody></table></div>'


def steps(found: Iterable[Step]) -> str:
    """The stages: what ran, what was cached, what was left out and why."""
    return table(("step", "", "how, or why not"), [(s.name, s.status, s.why) for s in found], numbers_from=9)


def figure(image: np.ndarray, caption: str, *, strong: str = "", sharp: bool = False) -> str:
    """(H, W, 3) uint8 RGB with its caption, larger at a click; `sharp` keeps it without loss (masks, flat colours)."""
    return f"<figure>{_image(image, f'{strong} {caption}', sharp, ' tabindex=0')}{_caption(caption, strong)}</figure>"


def wide(image: np.ndarray, caption: str, *, strong: str = "") -> str:
    """A strip of pictures, which a narrow screen scrolls sideways."""
    return f'<div class="wide">{figure(image, caption, strong=strong)}</div>'


def film(webp: bytes, caption: str) -> str:
    """An animated WebP with its caption."""
    data = base64.b64encode(webp).decode()
    image = f'<img alt="{_text(caption)}" src="data:image/webp;base64,{data}" tabindex=0>'
    return f'<figure class="film">{image}{_caption(caption, "")}</figure>'


def pair(before: np.ndarray, after: np.ndarray, caption: str, *, strong: str = "") -> str:
    """Two pictures of one view, one on the other, and a slider between them."""
    both = _image(before, "before") + _image(after, f"{strong} {caption}", more=' class="after"')
    slider = '<input type="range" value="25" aria-label="how much of each picture is shown">'
    return f'<figure class="pair"><div>{both}{slider}</div>{_caption(caption, strong)}</figure>'


def _image(image: np.ndarray, words: str, sharp: bool = False, more: str = "") -> str:
    return f'<img alt="{_text(words.strip())}" src="{data_uri(image, sharp=sharp)}"{more}>'


def _caption(caption: str, strong: str) -> str:
    return f"<figcaption>{f'<b>{_text(strong)}</b> ' if strong else ''}{_text(caption)}</figcaption>"


def grid(figures: Iterable[str], columns: int) -> str:
    """Figures side by side."""
    return f'<div class="grid" style="--columns:{columns}">{"".join(figures)}</div>'


def folded(title: str, *parts: str) -> str:
    """What opens at a click on its title."""
    return f"<details><summary>{_text(title)}</summary>{''.join(parts)}</details>"


def preformatted(text: str) -> str:
    """Text as it is."""
    return f"<pre>{_text(text)}</pre>"


def data_uri(image: np.ndarray, *, sharp: bool = False) -> str:
    """The picture inside the page itself: JPEG, or PNG where `sharp`."""
    ending, kind, options = (".png", "png", []) if sharp else (".jpg", "jpeg", [cv2.IMWRITE_JPEG_QUALITY, 88])
    _, data = cv2.imencode(ending, cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2BGR), options)
    return f"data:image/{kind};base64,{base64.b64encode(data.tobytes()).decode()}"


def _text(value: object) -> str:
    return html.escape(str(value))
