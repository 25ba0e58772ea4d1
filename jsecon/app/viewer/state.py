"""What the viewer shows, as a value, and the colours in which it shows it."""

import colorsys
import dataclasses
from collections.abc import Sequence
from typing import Literal, TypeAlias, get_args

import numpy as np
from jaxtyping import Bool, Float, UInt8

from jsecon.app.records import Query, Region
from jsecon.field.membership import SHARE_THRESHOLD

Colouring: TypeAlias = Literal["photo", "region"]
COLOURINGS: tuple[Colouring, ...] = get_args(Colouring)
"""What the colours of the Gaussians show: the photographs, or regions."""


@dataclasses.dataclass(frozen=True)
class ViewState:
    """What the viewer shows. Two equal states look the same."""

    questions: tuple[str | Region, ...] = ()
    """Texts and clicked regions whose answers are highlighted, in the order of their colours."""
    threshold: float = SHARE_THRESHOLD
    """Smallest share of a selected Gaussian."""
    all_of_class: bool = False
    """Whether to select all regions that match instead of the best one."""
    colouring: Colouring = "photo"
    isolated: tuple[Query, ...] = ()
    """If any, only their Gaussians are visible."""
    hidden: tuple[Query, ...] = ()
    """Their Gaussians are invisible."""

    @property
    def queries(self) -> tuple[Query, ...]:
        """The highlighted questions with their options."""
        options = {"threshold": self.threshold, "all_of_class": self.all_of_class}
        return tuple(Query(question, **options) for question in self.questions)

    def with_question(self, question: str | Region | None, *, add: bool = False) -> "ViewState":
        """Highlights a question in place of the others, or beside them; None and a blank text highlight nothing."""
        if question is None or not str(question).strip():
            return dataclasses.replace(self, questions=())
        others = tuple(other for other in self.questions if other != question) if add else ()
        return dataclasses.replace(self, questions=(*others, question))

    def toggle_region(self, region: int, *, add: bool = False) -> "ViewState":
        """Highlights a region, or removes it where it is highlighted."""
        if Region(region) not in self.questions:
            return self.with_question(Region(region), add=add)
        return dataclasses.replace(self, questions=tuple(q for q in self.questions if add and q != Region(region)))

    def isolate(self) -> "ViewState":
        """Shows only the highlighted Gaussians; the same state if no question is highlighted."""
        return dataclasses.replace(self, isolated=self.queries) if self.questions else self

    def hide(self) -> "ViewState":
        """Hides the highlighted Gaussians, and highlights no question."""
        hidden = dict.fromkeys((*self.hidden, *self.queries))
        return dataclasses.replace(self, questions=(), hidden=tuple(hidden))

    def show_all(self) -> "ViewState":
        """Shows all Gaussians again."""
        return dataclasses.replace(self, isolated=(), hidden=())


def answer_colours(count: int) -> UInt8[np.ndarray, "k 3"]:
    """RGB of answers 0 .. count-1: strong hues a golden angle apart, each of which does not depend on `count`."""
    hues = (0.91 + 0.61803398875 * np.arange(count)) % 1.0
    return (255 * np.array([colorsys.hls_to_rgb(h, 0.6, 1.0) for h in hues]).reshape(count, 3)).astype(np.uint8)


def highlight(
    base: UInt8[np.ndarray, "n 3"],
    masks: Sequence[Bool[np.ndarray, " n"]],
    similarities: Sequence[Float[np.ndarray, " n"]],
) -> UInt8[np.ndarray, "n 3"]:
    """Tints the Gaussians of each answer in its colour, and dims the others; without answers the colours stay."""
    if not masks:
        return base
    grey = base.mean(1, keepdims=True, dtype=np.float32)
    colours = (0.4 * (0.4 * base + 0.6 * grey)).astype(np.uint8)  # darker, and less of its hue
    best = np.full(len(base), -np.inf, np.float32)
    for mask, similarity, tint in zip(masks, similarities, answer_colours(len(masks)), strict=True):
        rows = np.flatnonzero(mask & (np.nan_to_num(similarity) > best))
        best[rows] = similarity[rows]
        colours[rows] = (0.45 * base[rows] + 0.55 * tint).astype(np.uint8)
    return colours
