"""What the viewer shows, as a value, and the colours in which it shows it."""

import dataclasses
from collections.abc import Sequence
from typing import Literal, TypeAlias, get_args

import numpy as np
from jaxtyping import UInt8

from jsecon.app.pictures import palette
from jsecon.app.records import Answer, Query, Region
from jsecon.errors import InputError
from jsecon.field.membership import SHARE_THRESHOLD

Colouring: TypeAlias = Literal["photo", "region"]
COLOURINGS: tuple[Colouring, ...] = get_args(Colouring)
"""What the colours of the Gaussians show: the photographs, or regions."""
ANSWER_HUE = 0.91
"""hue of the first answer in `palette`, pink: few natural objects have it"""


@dataclasses.dataclass(frozen=True)
class ViewState:
    """What the viewer shows. Two equal states look the same."""

    questions: tuple[str | Region, ...] = ()
    """Texts and clicked regions whose answers are highlighted, in the order of their colours."""
    threshold: float = SHARE_THRESHOLD
    """Smallest share of a selected Gaussian."""
    all_of_class: bool = False
    """Whether to select all regions that match instead of the best one."""
    only_selected: bool = False
    """Whether the selected Gaussians alone are visible, if there are any."""
    colouring: Colouring = "photo"

    @property
    def queries(self) -> tuple[Query, ...]:
        """The highlighted questions with their options."""
        options = {"threshold": self.threshold, "all_of_class": self.all_of_class}
        return tuple(Query(question, **options) for question in self.questions)

    def with_question(self, question: str | Region, *, add: bool = False) -> "ViewState":
        """Highlights a question in place of the others, or beside them.

        A blank text highlights nothing. A region that is highlighted is removed.
        """
        others = tuple(other for other in self.questions if add and other != question)
        removed = isinstance(question, Region) and question in self.questions
        new = () if removed or not str(question).strip() else (question,)
        return dataclasses.replace(self, questions=(*others, *new))


def highlight(base: UInt8[np.ndarray, "n 3"], answers: Sequence[Answer | InputError]) -> UInt8[np.ndarray, "n 3"]:
    """Tints the Gaussians of each answer in its colour, and dims the others; if none is selected the colours stay."""
    tints = palette(len(answers), ANSWER_HUE)
    found = [(tint, answer) for tint, answer in zip(tints, answers) if isinstance(answer, Answer) and len(answer.rows)]
    if not found:
        return base
    grey = base.mean(1, keepdims=True, dtype=np.float32)
    colours = (0.4 * (0.4 * base + 0.6 * grey)).astype(np.uint8)  # darker, and less of its hue
    best = np.full(len(base), -np.inf, np.float32)
    for tint, answer in found:
        similarity = np.asarray(answer.selection.similarity)
        rows = np.flatnonzero(answer.mask & (np.nan_to_num(similarity) > best))
        best[rows] = similarity[rows]
        colours[rows] = (0.45 * base[rows] + 0.55 * tint).astype(np.uint8)
    return colours
