"""Queries of a field: a text, a pixel, or a region. app/outputs writes the answers to files.

A text passes these modules on the way to its .ply; splat/ renders for them.

    ask     app/ask, language/field, vision/colours, query/match, query/select, language/membership, query/outliers
    write   app/outputs, splat/transform, data/gaussians/files
"""

import dataclasses
import functools
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

from jsecon.errors import InputError, require
from jsecon.field.columns import is_mapped
from jsecon.field.field import subset_field
from jsecon.field.regions import ALIKE_THRESHOLD
from jsecon.query import edits
from jsecon.query.answer import ONE_REGION, RegionMatch, match_region, match_regions, select_gaussians
from jsecon.query.blocks import SparseSelection, select_in_blocks
from jsecon.query.composite import parse_query
from jsecon.query.grouping import join_fragments, parts_fallback
from jsecon.query.outliers import split_outliers
from jsecon.query.pixel import region_at
from jsecon.query.rules import FRAGMENT_SCORE, MIN_RANK, QueryRules
from jsecon.query.select import select_by_code
from jsecon.read.captures.images import read_pixels
from jsecon.read.masks.masks import resize_nearest
from jsecon.types import LanguageField, Selection

T = TypeVar("T")
METHODS = ("votes", "code")
"""how a region selects Gaussians: by their votes, or by their codes"""
PARTS_ANSWER = {"regions": "no region holds the object, so the parts that match the text were selected"}
"""why a text is answered by parts"""
MIN_BLOCK_ROWS = 1 << 12
"""rows of an answer to a mapped field are padded to powers of two from here on, so that few sizes are compiled"""


@dataclasses.dataclass(frozen=True)
class Answer:
    """What a query selected.

    Attributes:
      query: The text, or the name of the pixel, region or outline.
      by: One of METHODS, "outline" or "relation".
      selection: The Gaussians as the query selects them.
      mask: (N,) bool, the selection without outliers.
      skipped: Part of the work -> why it was not needed.
      presence: Probability that the text is true of the best region; None for embedders without `Logits`.
      rows: (M,) int64 ids of the Gaussians that selection and mask have rows for; None if these are all.
      key: What tells the query from any other in the names of its files; None for a text, which does so itself.
      clusters: Number of clusters that DBSCAN kept and dropped, (0, 0) if it was not needed.
      relation: Of a referring expression, what `RelationAnswer.as_dict` has.
      objects: Number of separate objects that the selection shows: groups of regions that overlap, at most as many as
        there are clusters. It is 1 where the selection does not tell.
    """

    query: str
    by: str
    selection: Selection
    mask: np.ndarray
    skipped: dict[str, str]
    presence: float | None = None
    rows: np.ndarray | None = None
    key: str | None = None
    clusters: tuple[int, int] = (0, 0)
    relation: Mapping[str, Any] | None = None
    objects: int = 1

    @property
    def rank(self) -> float | None:
        """Share of unrelated words that are less similar to the scene than the text; None if it is unknown."""
        rank = self.selection.rank
        return None if rank is None or np.isnan(rank) else round(float(rank), 4)

    @property
    def rank_words(self) -> str:
        """The rank in words, in whole percent and rounded down; "" if it is unknown."""
        if self.rank is None:
            return ""
        return f"more similar than {int(100 * self.rank + 1e-6)} % of unrelated words"

    @property
    def confidence(self) -> float | None:
        """Estimated probability that the answer shows what the text names; None if it is unknown."""
        confidence = self.selection.confidence
        return None if confidence is None or np.isnan(confidence) else round(float(confidence), 4)

    @property
    def dropped(self) -> int:
        """Number of Gaussians that were dropped as outliers."""
        return int(np.asarray(self.selection.mask).sum() - self.mask.sum())


class _Match(NamedTuple):
    """The regions that match a query, before Gaussians are selected."""

    name: str
    regions: RegionMatch
    skipped: dict[str, str]
    key: str | None = None
    keep: str = "supported"
    """clusters to keep of the selection (`split_outliers`)"""
    parts: Selection | None = None
    """answer in place of the regions"""


def ask_text(
    field: LanguageField,
    embedder: Any,
    text: str,
    *,
    by: str = "votes",
    threshold: float | None = None,
    outliers: bool = True,
    several: bool = False,
    fragment_score: float = FRAGMENT_SCORE,
    min_rank: float = MIN_RANK,
) -> Answer:
    """Selects the Gaussians that a text names.

    Args:
      field: The field.
      embedder: Its embedder.
      text: The text. It may be composite: `"red mug" or "bowl" but not "handle"`.
      by: One of METHODS.
      threshold: Threshold of the method; None is its default.
      outliers: Whether to drop outliers.
      several: Whether to select all regions that match instead of the best one.
      fragment_score: How near to the text other fragments of the object must be; 1 adds no fragment.
      min_rank: Share of unrelated words that must be less similar to the scene than the text, else it has no match.

    Returns:
      The answer. If a field has parts, they answer a plain text that no region matches.

    Raises:
      InputError: The embedder has no words for the text, or several regions are selected by codes.
    """
    rules = QueryRules(min_rank=min_rank, fragment_score=fragment_score, all_of_class=several)
    match = _match_text(field, embedder, text, rules, by=by, threshold=threshold)
    return _select(field, match, by, threshold, outliers)


def ask_pixel(
    field: LanguageField, frame: int | str, x: int, y: int, *, by: str = "votes", threshold: float | None = None
) -> Answer:
    """Selects the Gaussians of what lies under a pixel.

    Args:
      field: The field.
      frame: Index or name of a frame (`frame_index`).
      x: Column.
      y: Row.
      by: One of METHODS.
      threshold: Threshold of the method; None is its default.

    Returns:
      The answer, without outliers.

    Raises:
      InputError: The field has no such frame or pixel, or no region lies there.
    """
    return _select(field, _match_pixel(field, frame, x, y), by, threshold, True)


def ask_region(
    field: LanguageField,
    region: int,
    *,
    several: bool = False,
    threshold: float | None = None,
    fragment_score: float | None = None,
) -> Answer:
    """Selects the Gaussians of a region by votes.

    Args:
      field: The field.
      region: Its id. A region that the field does not have selects no Gaussians.
      several: Whether to select all regions that are alike.
      threshold: Threshold on the share of votes; None is its default.
      fragment_score: How near to the region other fragments of the object must be; None adds no fragment.

    Returns:
      The answer.
    """
    duplicate = ALIKE_THRESHOLD if several else None
    rules = dataclasses.replace(ONE_REGION, duplicate_cosine=duplicate, fragment_score=fragment_score)
    regions = match_region(field, region, rules)
    name = f"region {region}"
    skipped = {"text encoder": "the region is the query"}
    match = _Match(name, regions, skipped, key=name, keep="all" if several else "supported")
    return _select(field, match, "votes", threshold, True)


def _match_text(
    field: LanguageField, embedder: Any, text: str, rules: QueryRules, *, by: str, threshold: float | None
) -> _Match:
    """Finds the regions that match a text, or the parts that answer in place of them."""
    require(by in METHODS, "by", by, f"one of {METHODS}", "votes is the default.")
    _require_codes(field, by)
    field = with_phrases(field, embedder)
    included, excluded = parse_query(text)
    # Of an embedder trained to tell whether a text is true of an image; the cosines of all others only rank.
    rules = dataclasses.replace(rules, logits=getattr(embedder, "logits", None))
    several = rules.all_of_class or len(included + excluded) > 1
    included = narrow_texts(field, embedder, included, rules, every=rules.all_of_class or bool(excluded))
    excluded = narrow_texts(field, embedder, excluded, rules, every=True)
    if several and by == "code":
        problem = "codes cannot select several regions"
        raise InputError(f"query {text!r}", problem, remedy="Ask by votes, or for one thing.")
    embedded = embedder.embed_text(included + excluded)  # NumPy's slices need no compilation
    texts, without = jax.device_put((embedded[: len(included)], embedded[len(included) :]))
    regions = match_regions(field, texts, rules, excluded=without)
    if several:
        return _Match(text, regions, {}, keep="all")
    if field.parts is not None and by != "code":
        parts = parts_fallback(field, texts[0], regions.score, _with_share(rules, threshold))
        if parts is not None:
            return _Match(text, regions, PARTS_ANSWER, parts=parts)
    return _Match(text, regions, {})


def _with_share(rules: QueryRules, threshold: float | None) -> QueryRules:
    """Returns rules with a threshold on the share; None is the default."""
    return rules if threshold is None else dataclasses.replace(rules, min_share=threshold)


def narrow_texts(
    field: LanguageField, embedder: Any, texts: Sequence[str], rules: QueryRules, *, every: bool
) -> list[str]:
    """Replaces texts that no region matches by narrower ones that some region does.

    Among colours "blue" is a family, and a room may have nothing of its typical colour but a dark and a light blue
    thing. Each is far from the word and near to its own shade.

    Args:
      field: The field.
      embedder: Its embedder. Its `narrower(text)`, if it has one, lists texts that name a part of what the text names.
      texts: The texts.
      rules: How texts match. Each of n narrower texts may lose to an n-th of the unrelated words that one may lose to.
      every: Whether all narrower texts that match replace a text, instead of the best of them.

    Returns:
      The texts, in order.

    Raises:
      InputError: The embedder has no words for a text.
    """
    if not hasattr(embedder, "narrower"):
        return list(texts)

    def score(text: str, rules: QueryRules) -> float:
        match = match_regions(field, jnp.asarray(embedder.embed_text([text])), rules)
        return float(match.score) if int(match.region) >= 0 else -np.inf

    replaced: list[str] = []
    for text in texts:
        narrower = embedder.narrower(text)
        best: list[str] = []
        if narrower and np.isinf(score(text, rules)):
            # Of n attempts one succeeds by chance as often as one attempt that is n times as strict.
            strict = dataclasses.replace(rules, min_rank=1 - (1 - rules.min_rank) / len(narrower))
            scores = {option: score(option, strict) for option in narrower}
            best = [option for option in sorted(narrower, key=scores.__getitem__) if scores[option] > -np.inf]
        replaced.extend(best[0 if every else -1 :] or [text])
    return replaced


def _match_pixel(field: LanguageField, frame: int | str, x: int, y: int) -> _Match:
    """Finds the region under a pixel."""
    index = frame_index(field, frame)
    region = region_at(field, index, x, y)
    if region < 0:
        remedy = "Choose another pixel or frame: report.html of the run shows the regions."
        raise InputError(f"frame {field.names[index]}", f"no region lies under column {x}, row {y}", remedy=remedy)
    name = f"at {field.names[index]} {x} {y}"
    skipped = {"text encoder": "the region under the pixel is the query"}
    return _Match(name, match_region(field, region), skipped, key=name)


def _select(field: LanguageField, match: _Match, by: str, threshold: float | None, outliers: bool) -> Answer:
    """Selects the Gaussians of matching regions."""
    require(by in METHODS, "by", by, f"one of {METHODS}", "votes is the default.")
    _require_codes(field, by)
    if match.parts is not None:
        selection = match.parts
    elif by == "code":
        selection = select_by_code(field, match.regions, *(() if threshold is None else (threshold,)))
    else:
        selection = select_gaussians(field, match.regions, _with_share(QueryRules(), threshold))
    return _finish(field, match, selection, by, outliers)


def _require_codes(field: LanguageField, by: str) -> None:
    """Raises InputError if a query by codes meets a field that has none."""
    if by == "code" and field.codes is None:
        raise InputError("", "This field has no codes", remedy="Run jsecon run --paper, or ask by votes.")


def _finish(field: LanguageField, match: _Match, selection: Selection, by: str, outliers: bool) -> Answer:
    """Trims a selection by outliers."""
    presence = None if selection.presence is None else float(selection.presence)
    answer = Answer(match.name, by, selection, np.asarray(selection.mask), match.skipped, presence, key=match.key)
    answer = drop_outliers(field, answer, outliers, keep=match.keep)
    overlap = field.votes.overlap
    if match.parts is not None or overlap is None:
        return answer
    groups = join_fragments(np.flatnonzero(match.regions.chosen), np.asarray(overlap))
    return dataclasses.replace(answer, objects=max(1, min(len(groups), answer.clusters[0])))


def drop_outliers(field: LanguageField, answer: Answer, enabled: bool = True, *, keep: str = "supported") -> Answer:
    """Drops the Gaussians of an answer that stand apart from the rest.

    Args:
      field: The field, with a row for each row of the answer.
      answer: The answer.
      enabled: False keeps all.
      keep: Clusters to keep (`split_outliers`): "supported" are those that the masks of the views support as much as
        the largest, since a mask may show one object in several pieces.

    Returns:
      The answer with its mask, its clusters, and in `skipped` why DBSCAN was not needed.
    """
    if not enabled:
        skipped = answer.skipped | {"DBSCAN": "outliers are kept"}
        return dataclasses.replace(answer, mask=np.asarray(answer.selection.mask), skipped=skipped)
    weight = np.clip(np.asarray(answer.selection.similarity), 0.0, 1.0) * np.asarray(field.votes.total)
    result = split_outliers(field.gaussians.means, np.asarray(answer.selection.mask), keep=keep, weight=weight)
    skipped = answer.skipped | ({"DBSCAN": result.skipped} if result.skipped else {})
    clusters = (result.clusters_kept, result.clusters_dropped)
    return dataclasses.replace(answer, mask=result.mask, skipped=skipped, clusters=clusters)


def edit_answers(
    field: LanguageField,
    answers: Sequence[Answer],
    *,
    grow: int = 0,
    shrink: int = 0,
    invert: bool = False,
    near: Int[np.ndarray, "n k"] | None = None,
) -> list[Answer]:
    """Grows the selections of answers, then shrinks them, then inverts them.

    Args:
      field: The field, with a row for each row of the answers.
      answers: The answers.
      grow: Number of shells of neighbours to add (`jsecon.query.edits`).
      shrink: Number of shells to remove.
      invert: Whether to select what is not selected.
      near: `mutual_neighbours` of the field's Gaussians, if they are at hand.

    Returns:
      The answers with other masks. Those that select no Gaussian stay.
    """
    if not (grow or shrink or invert):
        return list(answers)
    if near is None and (grow or shrink):
        near = edits.mutual_neighbours(field.gaussians.means)
    edited = []
    for answer in answers:
        if answer.mask.any():
            mask = answer.mask if near is None else edits.shrink(edits.grow(answer.mask, near, grow), near, shrink)
            mask = np.asarray(~mask if invert else mask)
            selection = dataclasses.replace(answer.selection, mask=mask)
            objects = 1 if invert else answer.objects
            answer = dataclasses.replace(answer, selection=selection, mask=mask, objects=objects)
        edited.append(answer)
    return edited


def with_phrases(field: LanguageField, embedder: Any) -> LanguageField:
    """Adds to a field what texts are compared with, unless it has that already.

    Args:
      field: The field.
      embedder: The embedder of the texts.

    Returns:
      The field with canonical phrases, and with unrelated words in the embedder's templates if it has any.
    """
    has_templates = getattr(embedder, "templates", ("{}",)) != ("{}",)
    if len(field.canonical_phrases) and (field.unrelated_words is None or not has_templates):
        return field
    reference = None if field.unrelated_words is None else getattr(embedder, "unrelated_words", None)
    canonical = field.canonical_phrases
    canonical = canonical if len(canonical) else np.asarray(embedder.canonical_phrases, np.float32)
    reference = field.unrelated_words if reference is None else np.asarray(reference, np.float16)
    return dataclasses.replace(field, canonical_phrases=canonical, unrelated_words=reference)


def frame_index(field: LanguageField, frame: int | str) -> int:
    """Finds a frame.

    Args:
      field: The field.
      frame: Its name, the end of a name that no other name has, or its index, an integer or "#10".

    Returns:
      Its index.

    Raises:
      InputError: The field has no such frame, or several.
    """
    if isinstance(frame, str):
        for name in (frame, Path(frame).stem):
            if name in field.names:
                return field.names.index(name)
        matches = [t for t, name in enumerate(field.names) if frame and name.endswith(frame)]
        if len(matches) == 1:
            return matches[0]
        if len(matches) > 1:
            problem = f"{len(matches)} frames have names that end so, such as {field.names[matches[0]]}"
            raise InputError(f"frame {frame}", problem, remedy="Give more of the name.")
    digits = re.fullmatch(r"#([0-9]{1,9})", frame) if isinstance(frame, str) else None
    index = int(digits[1]) if digits else frame if isinstance(frame, int) and not isinstance(frame, bool) else -1
    if 0 <= index < len(field.names):
        return index
    last = len(field.names) - 1
    known = f"a name ({field.names[0]} ... {field.names[-1]}), the end of one, or a place, #0 to #{last}"
    raise InputError(f"frame {frame}", "no such frame in the field", known, "report.html of the run shows the frames.")


def read_mask(file: Path, field: LanguageField) -> Bool[np.ndarray, "h w"]:
    """Reads a mask at the size of the field's frames.

    Args:
      file: An image. Black is outside.
      field: The field.

    Returns:
      (H, W) bool.

    Raises:
      InputError: The file is not an image, or has another shape.
    """
    image = read_pixels(Path(file))
    width, height = field.cameras.width, field.cameras.height
    mask = np.asarray(image[..., :3].any(-1) if image.ndim == 3 else image > 0, np.uint8)
    if abs(mask.shape[1] * height - mask.shape[0] * width) > max(width, height) + max(mask.shape):
        problem = f"the mask is {mask.shape[1]}x{mask.shape[0]}"
        expected = f"{width}x{height}, or the same shape at another size"
        raise InputError(file, problem, expected, "Outline the frame as the run used it.")
    return resize_nearest(mask, width, height) > 0


def ask_each(
    field: LanguageField,
    embedder: Any,
    *,
    texts: Sequence[str] = (),
    pixels: Sequence[tuple[str, int, int]] = (),
    by: str = "votes",
    threshold: float | None = None,
    outliers: bool = True,
    several: bool = False,
    min_rank: float = MIN_RANK,
) -> tuple[list[Answer], list[InputError]]:
    """Answers texts and pixels. An error of one does not stop the others.

    Args:
      field: The field. One from `load_field(mapped=True)` is read once, in blocks.
      embedder: Its embedder.
      texts: Texts (`ask_text`).
      pixels: Frame, column and row of each pixel (`ask_pixel`).
      by: One of METHODS; "votes" or "code" for a mapped field.
      threshold: Threshold of the method; None is its default.
      outliers: Whether to drop outliers.
      several: As for `ask_text`.
      min_rank: As for `ask_text`.

    Returns:
      The answers, and the errors of the other queries. Answers of a mapped field hold the rows of what they select.
    """
    rules = QueryRules(min_rank=min_rank, all_of_class=several)
    match_text = functools.partial(_match_text, field, embedder, rules=rules, by=by, threshold=threshold)
    queries: list[Callable[[], _Match]] = [
        *(functools.partial(match_text, text) for text in texts),
        *(functools.partial(_match_pixel, field, *pixel) for pixel in pixels),
    ]
    matches, errors = collect(queries)
    if not is_mapped(field.votes):
        return [_select(field, match, by, threshold, outliers) for match in matches], errors
    _require_codes(field, by)
    regions = [match.regions for match in matches]
    selections = select_in_blocks(field, regions, by, similarity_threshold=threshold)
    pairs = zip(matches, selections)
    return [_select_rows(field, match, selection, by, outliers) for match, selection in pairs], errors


def collect(queries: Sequence[Callable[[], T]]) -> tuple[list[T], list[InputError]]:
    """Calls functions. One that fails does not stop the others.

    Args:
      queries: Functions without arguments.

    Returns:
      The results, and the InputErrors of the functions that fail.
    """
    results: list[T] = []
    errors: list[InputError] = []
    for query in queries:
        try:
            results.append(query())
        except InputError as error:
            errors.append(error)
    return results, errors


def _select_rows(field: LanguageField, match: _Match, sparse: SparseSelection, by: str, outliers: bool) -> Answer:
    """Makes the answer of a mapped field from the rows that a match selects."""
    rank, presence = match.regions.rank, match.regions.presence
    if match.parts is not None:
        selection = jax.tree.map(np.asarray, match.parts)
        rows = np.flatnonzero(selection.mask)
        sparse = SparseSelection(rows, selection.similarity[rows], -1, float(selection.score))
        rank, presence = selection.rank, selection.presence
    count = len(sparse.gaussians)
    size = min(max(1 << max(count - 1, 0).bit_length(), MIN_BLOCK_ROWS), field.gaussians.count)
    rows = np.zeros(size, np.int64)
    similarity = np.zeros(size, np.float32)
    rows[:count] = sparse.gaussians
    similarity[:count] = sparse.similarity
    best = np.asarray(sparse.region, np.int32), np.asarray(sparse.score, np.float32)
    told = np.asarray(rank), match.regions.confidence, presence
    selection = Selection(np.arange(size) < count, similarity, *best, *told)
    answer = _finish(subset_field(field, rows), match, selection, by, outliers)
    return dataclasses.replace(answer, rows=rows)
