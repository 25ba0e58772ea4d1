"""One question put to a field: a text, a pixel, or what somebody outlined. Its answer becomes files in app/outputs.

Read on the way from a text to its .ply, without the ground; behind each file lies more of its own room, behind
splat/transform and query/render the engine, behind silhouettes query/silhouette:

    ask     app/ask, language/field, vision/colours, query/several, query/anchored, query/match
    clean   language/membership, query/outliers
    write   app/outputs, query/masks, splat/transform, data/gaussian_files
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
from jaxtyping import Bool, Float, Int

from jsecon.data.images import read_pixels
from jsecon.data.masks import resize_nearest
from jsecon.errors import InputError, require
from jsecon.language.field import subset_field
from jsecon.language.membership import SHARE_THRESHOLD
from jsecon.language.regions import ALIKE_THRESHOLD
from jsecon.process import MEMORY, memory_budget
from jsecon.query.anchored import RegionMatch, found_of, found_region, query_region, select_gaussians
from jsecon.query.baselines import query_canonical, query_one_step
from jsecon.query.blocks import SparseSelection, select_in_blocks
from jsecon.query.match import PIECE_THRESHOLD, QUANTILE, Refusal, best_presence
from jsecon.query.outliers import split_outliers
from jsecon.query.outline import box_mask, lift
from jsecon.query.parts import InParts, parts_instead, query_parts
from jsecon.query.pixel import region_at
from jsecon.query.several import found_of_several, parts_of_question
from jsecon.query.silhouette import SILHOUETTE_WEIGHTS, fit_silhouette
from jsecon.query.smoothing import nearest_neighbours, smooth_over_neighbours
from jsecon.types import Array, LanguageField, Selection

BY_VOTES = ("votes", *SILHOUETTE_WEIGHTS)
"""anchored, membership by a Gaussian's votes; of SILHOUETTE_WEIGHTS then one by one by the outline that they make"""
BY_CODES = ("one_step", "canonical")
"""every Gaussian's code against the text, without regions"""
METHODS = (*BY_VOTES, "code", *BY_CODES)
"""code: anchored, membership by a Gaussian's code"""
ONE_STEP_THRESHOLD = 0.8
"""on the cosine of a Gaussian's code and the text's"""
CANONICAL_THRESHOLD = 0.5
"""on the relevancy: closer to the text than to every canonical phrase"""


@dataclasses.dataclass(frozen=True)
class Answer:
    """What a question selected."""

    question: str
    by: str
    """one of METHODS, or "outline", or "phrase"."""
    selection: Selection
    """as the query gave it."""
    mask: np.ndarray
    """(N,) bool: the selection without outliers."""
    left_out: dict[str, str]
    """part -> why it was not needed."""
    there: float | None = None
    """probability that the text is true of the region that answers it, or of the likeliest where none does; None of
    embedders without one (`Logits`)."""
    frames: Mapping[str, list[float]] | None = None
    """of a phrase: frame -> the score of each mask found there, best first; None of other questions."""
    rows: np.ndarray | None = None
    """(M,) int64 the Gaussians that selection and mask have a row for, where those are not all N of the field."""
    key: str | None = None
    """what tells the question from every other in the names of its files; None: `question` alone does, a text."""
    clusters: tuple[int, int] = (0, 0)
    """clusters that DBSCAN kept and dropped; (0, 0) where it was not needed or found none."""

    @property
    def quantile(self) -> float | None:
        """Share of unrelated words that are less similar to the scene than the text is; None where it is not known."""
        share = self.selection.quantile
        return None if share is None or np.isnan(share) else round(float(share), 4)

    @property
    def dropped(self) -> int:
        """Gaussians dropped as outliers."""
        return int(np.asarray(self.selection.mask).sum() - self.mask.sum())


def quantile_message(quantile: float) -> str:
    """What a quantile among unrelated words means, in whole percent, rounded down."""
    return f"more similar than {int(100 * quantile + 1e-6)} % of unrelated words"


def ask_text(
    field: LanguageField,
    embedder: Any,
    text: str,
    *,
    by: str = "votes",
    threshold: float | None = None,
    outliers: bool = True,
    several: bool = False,
    near: Int[np.ndarray, "n k"] | None = None,
    piece_threshold: float = PIECE_THRESHOLD,
    quantile: float = QUANTILE,
) -> Answer:
    """The Gaussians that a text names; with `several`, of all regions that answer it (`query_several` has the rule).
    With `near` (N, K), the `nearest` of each Gaussian, shares of votes are evened out over them before they are cut.
    `piece_threshold`: how near to the text the pieces of a thing come, 1 for none (`regions_of_text`). `quantile`: a
    text selects nothing unless it is more similar to the scene than this share of unrelated words (`query_anchored`).

    A text may be composite: `"red mug" or "bowl" but not "handle"`. Of a field with parts, those answer a plain text
    that no region does (`parts_instead`). Raises InputError where the embedder has no words for a part, and for several
    regions or a composite text by anything but votes.
    """
    require(by in METHODS, "by", by, f"one of {METHODS}", "votes is the default.")
    wanted, unwanted = parts_of_question(text)
    if by in BY_CODES and not several and len(wanted + unwanted) == 1:
        return answer_of(field, text, by, _compared(field, embedder, wanted[0], by, threshold), outliers, {})
    given: dict[str, Any] = {"piece_threshold": piece_threshold, "quantile": quantile}
    asked = sought(field, embedder, text, by=by, several=several, **given)
    if (found := unheld(asked, by, threshold)) is not None:
        selection, asked, left = found.selection, asked._replace(there=found.there), UNHELD
    else:
        selection, left = select_gaussians(field, asked.found, threshold, by="code" if by == "code" else "votes"), {}
        if several and field.parts is not None:
            selection = query_parts(asked.field, selection, asked.wanted)
    selection = _shaped(field, selection, by, threshold, near)
    answer = answer_of(field, text, by, selection, outliers, left, keep=asked.keep)
    return dataclasses.replace(answer, there=asked.there)


class Sought(NamedTuple):
    """What a text asks of a field's regions."""

    field: LanguageField
    """with canonical phrases."""
    wanted: Float[Array, "q e"]
    """embeddings of what is wanted."""
    found: RegionMatch
    keep: str
    """of the selection's clusters: "largest", or "all" where there may be several things."""
    there: float | None
    """as in `Answer`."""
    refused_by: Refusal


UNHELD = {"regions": "none holds what the text names: the parts that answer it were taken"}


def unheld(asked: Sought, by: str, threshold: float | None) -> InParts | None:
    """`parts_instead` for a plain text by votes; None of other questions, and where the field has no parts."""
    if asked.field.parts is None or asked.keep != "largest" or by not in BY_VOTES:
        return None
    how: dict[str, Any] = {"similarity_threshold": threshold, "logits": asked.refused_by.logits}
    how["quantile"] = asked.refused_by.quantile
    region = found_of(asked.field, asked.wanted[0], quantile=0.0, retrieval="contrast")  # as parts are measured
    return parts_instead(asked.field, asked.wanted[0], region.score, **how)


def sought(
    field: LanguageField,
    embedder: Any,
    text: str,
    *,
    by: str = "votes",
    several: bool = False,
    piece_threshold: float = PIECE_THRESHOLD,
    quantile: float = QUANTILE,
) -> Sought:
    """The regions that a text names; options and errors as for `ask_text`."""
    field = with_phrases(field, embedder)
    wanted, unwanted = parts_of_question(text)
    # Of an embedder trained to tell whether a text is true of an image; the cosines of all others only rank.
    logits = getattr(embedder, "logits", None)
    how: dict[str, Any] = {"piece_threshold": piece_threshold, "logits": logits, "quantile": quantile}
    keep = "largest"
    if several or unwanted or len(wanted) > 1:
        if by not in BY_VOTES:
            found = f"by {by} it has no answer of several regions"
            raise InputError(f"query {text!r}", found, remedy="Ask by votes or a silhouette, or for one thing.")
        embedded, keep = jax.device_put(embedder.embed_text(wanted + unwanted)), "all"
        texts = embedded[: len(wanted)]
        found = found_of_several(field, texts, embedded[len(wanted) :], several=several, **how)
    else:
        texts = jax.device_put(embedder.embed_text(wanted))
        found = found_of(field, texts[0], **how)
    there = best_presence(field.regions, texts, found.region, logits)
    return Sought(field, texts, found, keep, there, Refusal(None, quantile, logits))


def _compared(field: LanguageField, embedder: Any, text: str, by: str, threshold: float | None) -> Selection:
    """The Gaussians whose codes are like the text's."""
    from jsecon.language.codes import encode

    code = encode(field.autoencoder, jax.device_put(embedder.embed_text([text])[0]))
    if by == "one_step":
        return query_one_step(field.codes, code, ONE_STEP_THRESHOLD if threshold is None else threshold)
    canonical = encode(field.autoencoder, jnp.asarray(with_phrases(field, embedder).canonical))
    return query_canonical(field.codes, code, canonical, CANONICAL_THRESHOLD if threshold is None else threshold)


def with_phrases(field: LanguageField, embedder: Any) -> LanguageField:
    """The field with canonical phrases and unrelated words: those of who reads the text, where its embeddings came from
    files without; and such words in the templates that texts are put into, where those are the reader's own."""
    reference = None if field.reference is None else getattr(embedder, "reference", None)
    plain = getattr(embedder, "templates", ("{}",)) == ("{}",)
    if len(field.canonical) and (plain or reference is None):
        return field
    own: dict[str, Any] = {} if len(field.canonical) else {"canonical": np.asarray(embedder.canonical, np.float32)}
    own |= {} if reference is None else {"reference": np.asarray(reference, np.float16)}
    return dataclasses.replace(field, **own)


def ask_pixel(
    field: LanguageField,
    frame: int | str,
    x: int,
    y: int,
    *,
    by: str = "votes",
    threshold: float | None = None,
    outliers: bool = True,
    near: Int[np.ndarray, "n k"] | None = None,
) -> Answer:
    """The Gaussians of what lies under pixel (column x, row y) of a frame (its index or name); no text is embedded.
    `near` as for `ask_text`.

    Raises InputError for a frame or pixel that the field does not have, where no region lies there, and for a method
    that compares a text.
    """
    name, region = region_under(field, frame, x, y)
    if by in BY_CODES:
        remedy = "Ask for it by votes, code or a silhouette."
        raise InputError(f"query {name!r}", f"by {by} a text is compared, and a pixel has none", remedy=remedy)
    selection = query_region(field, region, by="code" if by == "code" else "votes", similarity_threshold=threshold)
    selection = _shaped(field, selection, by, threshold, near)
    return answer_of(field, name, by, selection, outliers, POINTED, key=name)


POINTED = {"text encoder": "the region under the pixel is the anchor"}


def region_under(field: LanguageField, frame: int | str, x: int, y: int) -> tuple[str, int]:
    """What the question at a pixel is called, and the region there. Raises InputError as `ask_pixel` does."""
    index = frame_index(field, frame)
    region, name = region_at(field, index, x, y), field.names[index]
    if region < 0:
        remedy = "Choose another pixel or frame: report.html of the run shows the regions."
        raise InputError(f"frame {name}", f"no region lies under column {x}, row {y}", remedy=remedy)
    return f"at {name} {x} {y}", region


def ask_region(field: LanguageField, region: int, *, several: bool = False, **shape: Any) -> Answer:
    """The Gaussians of a region, with `several` of all that are alike; `shape` as for `query_region`."""
    selection = query_region(field, region, alike_threshold=ALIKE_THRESHOLD if several else None, **shape)
    left, name = {"text encoder": "the region is the anchor"}, f"region {region}"
    return answer_of(field, name, "votes", selection, True, left, keep="all" if several else "largest", key=name)


def ask_outline(
    field: LanguageField,
    name: str,
    outlines: Mapping[Any, np.ndarray],
    *,
    threshold: float | None = None,
    outliers: bool = True,
    key: str | None = None,
) -> Answer:
    """The Gaussians of one thing, outlined in one frame or several: frame -> mask (H, W), or what `box_mask` made.

    Raises InputError as `jsecon.query.outline.lift` does.
    """
    frames = [frame_index(field, frame) for frame in outlines]
    least = SHARE_THRESHOLD if threshold is None else threshold
    selection = lift(field, np.stack([np.asarray(m).astype(int) for m in outlines.values()]), frames, threshold=least)
    left = {"text encoder": "the outline says what is meant"}
    return answer_of(field, name, "outline", selection, outliers, left, key=name if key is None else key)


def _shaped(
    field: LanguageField, selection: Selection, by: str, threshold: float | None, near: np.ndarray | None
) -> Selection:
    """As it is, or by a silhouette what fits the shares best in the views; with `near` shares are evened out first,
    where a view sees the Gaussian."""
    least = SHARE_THRESHOLD if threshold is None else threshold
    if near is not None and by in BY_VOTES:
        share = smooth_over_neighbours(jnp.asarray(selection.similarity), jnp.asarray(near))
        seen = jnp.asarray(field.votes.views) > 0
        share = jnp.where(seen, share, 0.0)
        inside = seen & (share >= least) & jnp.any(selection.mask)
        selection = dataclasses.replace(selection, mask=inside, similarity=share)
    if by not in SILHOUETTE_WEIGHTS:
        return selection
    given = field.gaussians, field.cameras, selection.similarity
    mask = fit_silhouette(*given, threshold=least, weights=SILHOUETTE_WEIGHTS[by]) & (
        jnp.asarray(field.votes.views) > 0
    )
    return dataclasses.replace(selection, mask=mask & jnp.any(selection.mask))


def frame_index(field: LanguageField, frame: int | str) -> int:
    """A frame's index: from its name, from the end of a name that no other name has, or from its place, an integer or
    "#10". Raises InputError for one that the field does not have."""
    if isinstance(frame, str):
        for name in (frame, Path(frame).stem):
            if name in field.names:
                return field.names.index(name)
        ends = [t for t, name in enumerate(field.names) if frame and name.endswith(frame)]
        if len(ends) == 1:
            return ends[0]
        if len(ends) > 1:
            found = f"the names of {len(ends)} frames end so, such as that of {field.names[ends[0]]}"
            raise InputError(f"frame {frame}", found, remedy="Give more of the name.")
    digits = re.fullmatch(r"#([0-9]{1,9})", frame) if isinstance(frame, str) else None
    place = int(digits[1]) if digits else frame if isinstance(frame, int) and not isinstance(frame, bool) else -1
    if 0 <= place < len(field.names):
        return place
    last = len(field.names) - 1
    known = f"a name ({field.names[0]} ... {field.names[-1]}), the end of one, or a place, #0 to #{last}"
    raise InputError(f"frame {frame}", "no such frame in the field", known, "report.html of the run shows the frames.")


def answer_of(
    field: LanguageField,
    question: str,
    by: str,
    selection: Selection,
    outliers: bool,
    left: dict[str, str],
    keep: str = "largest",
    key: str | None = None,
) -> Answer:
    """A selection as the answer to a question, without outliers; `left`: what was not needed, and why; `key` as in
    `Answer`.

    With keep="largest", clusters that the views' masks support as much as MIN_CLUSTER_SUPPORT of the largest stay too:
    a mask may show one thing in several pieces.
    """
    if not outliers:
        left = left | {"DBSCAN": "not asked for"}
        return Answer(question, by, selection, np.asarray(selection.mask), left, key=key)
    seen = np.clip(np.asarray(selection.similarity), 0.0, 1.0) * np.asarray(field.votes.total)
    keep = "supported" if keep == "largest" else keep
    found = split_outliers(field.gaussians.means, np.asarray(selection.mask), keep=keep, weight=seen)
    left = left | ({"DBSCAN": found.skipped} if found.skipped else {})
    clusters = found.clusters_kept, found.clusters_dropped
    return Answer(question, by, selection, found.mask, left, clusters=clusters, key=key)


_T = TypeVar("_T")
_LEAST = 1 << 12
"""rows of an answer in blocks, some of them empty: programs are compiled for powers of two from there on"""


def queries_of(
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
    how = shape | {"by": by, "near": nearest_neighbours(field.gaussians.means) if even else None}
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


def answer_each(questions: Sequence[Callable[[], _T]]) -> tuple[list[_T], list[InputError]]:
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
    image, size = read_pixels(Path(file)), (field.cameras.width, field.cameras.height)
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
    found: RegionMatch
    text: Sought | None = None


def answer_in_blocks(
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
    """What `answer_each` of `queries_of` would return of a mapped field, by votes or code, in one pass over its
    columns. The answers hold what is selected, and no number for any other Gaussian (`Answer.rows`)."""

    def of_text(text: str) -> _Asked:
        asked = sought(field, embedder, text, by=by, several=several, quantile=quantile)
        return _Asked(text, by, asked.found, asked)

    def at_pixel(*pixel: Any) -> _Asked:
        name, region = region_under(field, *pixel)
        return _Asked(name, by, found_region(field, region))

    asking = [functools.partial(of_text, text) for text in texts]
    asked, refused = answer_each(asking + [functools.partial(at_pixel, *pixel) for pixel in pixels])
    chosen = select_in_blocks(field, [each.found for each in asked], threshold, by=by)
    instead = [None if each.text is None else unheld(each.text, by, threshold) for each in asked]
    return [_answered(field, *each, several, outliers) for each in zip(asked, chosen, instead)], refused


def _answered(
    field: LanguageField, asked: _Asked, chosen: SparseSelection, instead: InParts | None, several: bool, outliers: bool
) -> Answer:
    if instead is not None:
        whole = jax.tree.map(np.asarray, instead.selection)
        rows = np.flatnonzero(whole.mask)
        chosen = SparseSelection(rows, whole.similarity[rows], -1, float(whole.score))
    count = len(chosen.gaussians)
    size = min(max(1 << max(count - 1, 0).bit_length(), _LEAST), field.gaussians.count)  # few sizes to compile for
    rows, similarity = np.zeros(size, np.int64), np.zeros(size, np.float32)
    rows[:count], similarity[:count] = chosen.gaussians, chosen.similarity
    own, mask = subset_field(field, rows), np.arange(size) < count
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
