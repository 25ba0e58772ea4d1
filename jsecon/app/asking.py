"""All that the command line asks of a field, one after the other; or, of a field larger than memory, in blocks."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Bool

from jsecon.app.question import (
    POINTED,
    UNHELD,
    Answer,
    Sought,
    answer_of,
    ask_outline,
    ask_pixel,
    ask_text,
    frame_index,
    region_under,
    sought,
    unheld,
)
from jsecon.data.images import read_stored
from jsecon.data.mask_files import resize_nearest
from jsecon.errors import InputError
from jsecon.language.field import field_of_rows
from jsecon.process import MEMORY, memory_budget
from jsecon.query.anchored import Found, found_region
from jsecon.query.blocks import Chosen, chosen_in_blocks
from jsecon.query.lift import box_mask
from jsecon.query.neighbours import nearest
from jsecon.query.parts import InParts, query_parts
from jsecon.query.retrieval import QUANTILE
from jsecon.types import LanguageField, Selection

_T = TypeVar("_T")
_LEAST = 1 << 12
"""rows of an answer in blocks, some of them empty: programs are compiled for powers of two from there on"""


def questions_of(
    field: LanguageField,
    embedder: Any,
    *,
    texts: Sequence[str] = (),
    pixels: Sequence[tuple[Any, ...]] = (),
    masks: Sequence[Sequence[str]] = (),
    boxes: Sequence[tuple[Any, ...]] = (),
    several: bool = False,
    even: bool = False,
    by: str = "votes",
    threshold: float | None = None,
    quantile: float = QUANTILE,
    outliers: bool = True,
) -> list[Callable[[], Answer]]:
    """What the command line asks of a field, each to be called: texts, pixels (frame, column, row), outlines (frame,
    file, frame, file, ... of one thing), boxes (frame, left, upper, right, lower end)."""
    shape: dict[str, Any] = {"threshold": threshold, "outliers": outliers}
    how = shape | {"by": by, "near": nearest(field.gaussians.means) if even else None}
    found: list[Callable[[], Answer]] = []
    text_how = how | {"several": several, "quantile": quantile}
    found += [functools.partial(ask_text, field, embedder, text, **text_how) for text in texts]
    found += [functools.partial(ask_pixel, field, *pixel, **how) for pixel in pixels]

    def require_outline(name: str) -> None:
        if by != "votes" or even:
            found = "the outline alone decides, so --by and --even have no meaning"
            raise InputError(f"query {name!r}", found, remedy="Leave them out, or ask by a text.")

    def outlined(pairs: Sequence[str]) -> Answer:
        files = dict(zip(pairs[::2], map(Path, pairs[1::2])))
        outlines = {frame: read_mask(file, field) for frame, file in files.items()}
        names = [field.names[frame_index(field, frame)] for frame in pairs[::2]]
        if len(set(names)) < len(names):
            raise InputError("--mask", "a frame is given twice", remedy="Give one mask of a thing in each frame.")
        require_outline(Path(pairs[1]).stem)
        key = "\0".join(("mask", *(part for pair in zip(names, pairs[1::2]) for part in pair)))
        return ask_outline(field, Path(pairs[1]).stem, outlines, key=key, **shape)

    def boxed(frame: str, *ends: int) -> Answer:
        name = f"box {field.names[frame_index(field, frame)]} {' '.join(map(str, ends))}"
        require_outline(name)
        return ask_outline(field, name, {frame: box_mask(field, *ends)}, **shape)

    found += [functools.partial(outlined, pairs) for pairs in masks]
    return found + [functools.partial(boxed, *box) for box in boxes]


def asked_each(questions: Sequence[Callable[[], _T]]) -> tuple[list[_T], list[InputError]]:
    """The answers, and why the other questions have none: one that cannot be understood does not stop the rest."""
    answers, refused = [], []
    for ask in questions:
        try:
            answers.append(ask())
        except InputError as error:
            refused.append(error)
    return answers, refused


def read_mask(file: Path, field: LanguageField) -> Bool[np.ndarray, "h w"]:
    """(H, W) bool of an image file, at the size of the field's frames: what is not black. Raises InputError where it is
    no image, or one of another shape."""
    image, size = read_stored(Path(file)), (field.cameras.width, field.cameras.height)
    mask = np.asarray(image[..., :3].any(-1) if image.ndim == 3 else image > 0, np.uint8)
    if abs(mask.shape[1] * size[1] - mask.shape[0] * size[0]) > max(size) + max(mask.shape):
        found, wanted = (
            f"the mask is {mask.shape[1]}x{mask.shape[0]}",
            f"{size[0]}x{size[1]}, or the same shape at another size",
        )
        raise InputError(file, found, wanted, "Outline the frame as the run used it.")
    return resize_nearest(mask, *size) > 0


def larger_than_memory(file: Path) -> bool:
    """Whether the columns of a field file are more than memory should hold of them (`memory_budget`). Raises InputError
    for a budget that is no number."""
    return file.is_file() and file.stat().st_size > memory_budget()


def require_blocks(file: Path, *, by: str, even: bool, outlined: bool) -> None:
    """Raises InputError where a field larger than memory is asked what needs all of it at once."""
    needs = {f"--by {by}": by not in ("votes", "code"), "--even": even, "--mask, --box or --phrases": outlined}
    for option, given in needs.items():
        if given:
            size, most = file.stat().st_size / 2**30, memory_budget() / 2**30
            found = (
                f"the field has {size:.3g} GiB, memory has room for {most:.3g}, and {option} needs all of it at once"
            )
            remedy = (
                f"Ask by a text or --at, by votes or code, or read it into memory: {MEMORY}={1.1 * size:.2g} (GiB)."
            )
            raise InputError(file, found, remedy=remedy)


class _Asked(NamedTuple):
    """A question that has found its regions."""

    name: str
    by: str
    found: Found
    text: Sought | None = None


def answered_in_blocks(
    field: LanguageField,
    embedder: Any,
    *,
    texts: Sequence[str] = (),
    pixels: Sequence[tuple[Any, ...]] = (),
    several: bool = False,
    by: str = "votes",
    threshold: float | None = None,
    quantile: float = QUANTILE,
    outliers: bool = True,
) -> tuple[list[Answer], list[InputError]]:
    """What `asked_each` of `questions_of` would return of a mapped field, by votes or code, in one pass over its
    columns. The answers hold what is selected, and no number for any other Gaussian (`Answer.rows`)."""

    def of_text(text: str) -> _Asked:
        asked = sought(field, embedder, text, by=by, several=several, quantile=quantile)
        return _Asked(text, by, asked.found, asked)

    def at_pixel(*pixel: Any) -> _Asked:
        name, region = region_under(field, *pixel)
        return _Asked(name, by, found_region(field, region))

    asking = [functools.partial(of_text, text) for text in texts]
    asked, refused = asked_each(asking + [functools.partial(at_pixel, *pixel) for pixel in pixels])
    chosen = chosen_in_blocks(field, [each.found for each in asked], threshold, by=by)
    instead = [None if each.text is None else unheld(each.text, by, threshold) for each in asked]
    return [_answered(field, *each, several, outliers) for each in zip(asked, chosen, instead)], refused


def _answered(
    field: LanguageField, asked: _Asked, chosen: Chosen, instead: InParts | None, several: bool, outliers: bool
) -> Answer:
    if instead is not None:
        whole = jax.tree.map(np.asarray, instead.selection)
        rows = np.flatnonzero(whole.mask)
        chosen = Chosen(rows, whole.similarity[rows], -1, float(whole.score))
    count = len(chosen.gaussians)
    size = min(max(1 << max(count - 1, 0).bit_length(), _LEAST), field.gaussians.count)  # few sizes to compile for
    rows, similarity = np.zeros(size, np.int64), np.zeros(size, np.float32)
    rows[:count], similarity[:count] = chosen.gaussians, chosen.similarity
    own, mask = field_of_rows(field, rows), np.arange(size) < count
    told = asked.found.quantile if instead is None else instead.selection.quantile
    best = np.asarray(chosen.region, np.int32), np.asarray(chosen.score, np.float32)
    selection = Selection(mask, similarity, *best, np.asarray(told))
    if asked.text is None:
        answer = answer_of(own, asked.name, asked.by, selection, outliers, POINTED, key=asked.name)
        return dataclasses.replace(answer, rows=rows)
    if several and own.parts is not None:
        selection = query_parts(
            dataclasses.replace(own, canonical=asked.text.field.canonical), selection, asked.text.wanted
        )
    there, left = (asked.text.there, {}) if instead is None else (instead.there, UNHELD)
    answer = answer_of(own, asked.name, asked.by, selection, outliers, left, keep=asked.text.keep)
    return dataclasses.replace(answer, rows=rows, there=there)
