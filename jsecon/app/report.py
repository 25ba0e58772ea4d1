"""One self-contained HTML page: pictures as data, no script, no outside resource, legible in light and dark."""

import base64
import html
from collections.abc import Iterable, Mapping, Sequence

import cv2
import numpy as np

from jsecon.app.progress import Step

_STYLE = """
:root { color-scheme: light dark; --ink: #1c2024; --soft: #60656c; --line: #e0e2e6; --paper: #fcfcfd; --card: #f3f4f6;
  --mark: #c2185b; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #eceef0; --soft: #9ba1a8; --line: #33373c; --paper: #121416; --card: #1c1f23; --mark: #ff5fa2; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1180px; padding: 2rem 1.5rem 4rem; background: var(--paper); color: var(--ink);
  font: 15px/1.5 system-ui, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 .2rem; } h2 { font-size: 1.15rem; margin: 2.4rem 0 .6rem; }
p { max-width: 75ch; margin: .3rem 0 .8rem; } .soft { color: var(--soft); }
.tiles { display: flex; flex-wrap: wrap; gap: .75rem; margin: 1.2rem 0; }
.tile { background: var(--card); border-radius: 8px; padding: .7rem 1rem; min-width: 8.5rem; }
.tile b { display: block; font-size: 1.5rem; line-height: 1.2; font-variant-numeric: tabular-nums; }
.tile span { color: var(--soft); font-size: .82rem; }
table { border-collapse: collapse; margin: .4rem 0 1rem; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: .3rem .9rem .3rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
th { font-weight: 600; color: var(--soft); font-size: .85rem; } td.n, th.n { text-align: right; }
.grid { display: grid; gap: .9rem; grid-template-columns: repeat(var(--columns), minmax(0, 1fr)); }
@media (max-width: 720px) { .grid { grid-template-columns: repeat(2, minmax(0, 1fr)); } }
figure { margin: 0; } figure img { width: 100%; display: block; border-radius: 6px; background: #000; }
figcaption { font-size: .85rem; color: var(--soft); padding-top: .25rem; } figcaption b { color: var(--ink); }
.bar { background: var(--mark); height: .75rem; margin-top: .3rem; border-radius: 3px; min-width: 2px; }
pre { background: var(--card); border-radius: 8px; padding: .8rem 1rem; overflow-x: auto; font-size: .8rem;
  white-space: pre-wrap; }
.scroll { overflow-x: auto; }
"""


def page(title: str, lead: str, parts: Iterable[str]) -> str:
    """The whole document; `parts` are what the functions below return."""
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><meta name="viewport" '
        f'content="width=device-width, initial-scale=1"><title>{_text(title)}</title><style>{_STYLE}</style></head>\n'
        f'<body><h1>{_text(title)}</h1><p class="soft">{_text(lead)}</p>\n' + "\n".join(parts) + "\n</body></html>\n"
    )


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


def bars(seconds: Mapping[str, float]) -> str:
    """A bar for each stage's seconds."""
    longest = max(seconds.values(), default=0.0) or 1.0
    rows = "".join(
        f'<tr><td>{_text(name)}</td><td class="n">{value:.1f} s</td><td style="width:24rem"><div class="bar" '
        f'style="width:{100 * value / longest:.1f}%"></div></td></tr>'
        for name, value in seconds.items()
    )
    total = f'<tr><td><b>all</b></td><td class="n"><b>{sum(seconds.values()):.1f} s</b></td><td></td></tr>'
    return f'<div class="scroll"><table><tbody>{rows}{total}</tbody></table></div>'


def steps(found: Iterable[Step]) -> str:
    """The stages: what ran, what was cached, what was left out and why."""
    return table(("step", "", "how, or why not"), [(s.name, s.status, s.why) for s in found], numbers_from=9)


def figure(image: np.ndarray, caption: str, *, strong: str = "", sharp: bool = False) -> str:
    """(H, W, 3) uint8 RGB with its caption; `sharp` keeps it without loss (masks, flat colours)."""
    told = (f"<b>{_text(strong)}</b> " if strong else "") + _text(caption)
    words = _text(f"{strong} {caption}".strip())
    return f'<figure><img alt="{words}" src="{data_uri(image, sharp=sharp)}"><figcaption>{told}</figcaption></figure>'


def grid(figures: Iterable[str], columns: int) -> str:
    """Figures side by side."""
    return f'<div class="grid" style="--columns:{columns}">{"".join(figures)}</div>'


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
