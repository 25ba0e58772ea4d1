"""One question put to a field: a text, a pixel, or what somebody outlined. Its answer becomes files in app/answers.

Read on the way from a text to its .ply, without the ground; behind each file lies more of its own room, behind
splat/transform and query/masks the engine, behind `by="silhouette"` query/silhouette:

    ask     app/question, language/field, vision/colours, query/several, query/anchored, query/retrieval
    clean   language/shares, query/outliers
    write   app/answers, query/masks, splat/transform, data/gaussian_files
"""

import dataclasses
import functools
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

from jsecon.data.images import read_stored
from jsecon.errors import InputError, require
from jsecon.language.regions import ALIKE_THRESHOLD
from jsecon.language.shares import SHARE_THRESHOLD
from jsecon.query.anchored import query_anchored, query_region
from jsecon.query.direct import query_canonical, query_one_step
from jsecon.query.lift import box_mask, lift
from jsecon.query.neighbours import evened, nearest
from jsecon.query.outliers import outliers_removed
from jsecon.query.parts import query_parts
from jsecon.query.pixel import region_at
from jsecon.query.retrieval import PIECE_NEARNESS, best_presence
from jsecon.query.several import parts_of_question, query_several
from jsecon.query.silhouette import silhouette_members
from jsecon.types import LanguageField, Selection

METHODS = ("votes", "silhouette", "code", "one_step", "canonical")
"""votes, code: anchored, membership by a Gaussian's votes or its code; silhouette: by votes, then one by one by the
outline that they make; one_step, canonical: codes against the text"""
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

    @property
    def dropped(self) -> int:
        """Gaussians dropped as outliers."""
        return int(np.asarray(self.selection.mask).sum() - self.mask.sum())


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
    outliers: bool = True,
) -> list[Callable[[], "Answer"]]:
    """What the command line asks of a field, each to be called: texts, pixels (frame, column, row), outlines (frame,
    file, frame, file, ... of one thing), boxes (frame, left, upper, right, lower end)."""
    shape: dict[str, Any] = {"threshold": threshold, "outliers": outliers}
    how = shape | {"by": by, "near": nearest(field.gaussians.means) if even else None}
    found: list[Callable[[], Answer]] = []
    found += [functools.partial(ask_text, field, embedder, text, several=several, **how) for text in texts]
    found += [functools.partial(ask_pixel, field, *pixel, **how) for pixel in pixels]

    def outlined(pairs: Sequence[str]) -> Answer:
        files = dict(zip(pairs[::2], map(Path, pairs[1::2])))
        outlines = {frame: read_mask(file, field) for frame, file in files.items()}
        return ask_outline(field, Path(pairs[1]).stem, outlines, **shape)

    def boxed(frame: str, *ends: int) -> Answer:
        name = f"box {frame} {' '.join(map(str, ends))}"
        return ask_outline(field, name, {frame: box_mask(field, *ends)}, **shape)

    found += [functools.partial(outlined, pairs) for pairs in masks]
    return found + [functools.partial(boxed, *box) for box in boxes]


def asked_each(questions: Sequence[Callable[[], "Answer"]]) -> tuple[list["Answer"], list[InputError]]:
    """The answers, and why the other questions have none: one that cannot be understood does not stop the rest."""
    answers, refused = [], []
    for ask in questions:
        try:
            answers.append(ask())
        except InputError as error:
            refused.append(error)
    return answers, refused


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
    piece_nearness: float = PIECE_NEARNESS,
) -> Answer:
    """The Gaussians that a text names; with `several`, of all regions that answer it (`query_several` has the rule).
    With `near` (N, K), the `nearest` of each Gaussian, shares of votes are evened out over them before they are cut.
    `piece_nearness`: how near to the text the pieces of a thing come, 1 for none (`regions_of_text`).

    A text may be composite: `"red mug" or "bowl" but not "handle"`. Raises InputError where the embedder has no words
    for a part, and for several regions or a composite text by anything but votes.
    """
    require(by in METHODS, "by", by, f"one of {METHODS}", "votes is the default.")
    if not len(field.canonical):  # its embeddings came from files, without phrases: those of who reads the text
        field = dataclasses.replace(field, canonical=np.asarray(embedder.canonical, np.float32))
    wanted, unwanted = parts_of_question(text)
    # Of an embedder trained to tell whether a text is true of an image; the cosines of all others only rank.
    logits = getattr(embedder, "logits", None) if by in ("votes", "silhouette", "code") else None
    if several or unwanted or len(wanted) > 1:
        if by not in ("votes", "silhouette"):
            remedy = "Leave out --by, or ask for one thing."
            raise InputError(text, f"several regions by {by}", "by votes or silhouette", remedy)
        given: dict[str, Any] = {} if threshold is None else {"similarity_threshold": threshold}
        embedded = jax.device_put(embedder.embed_text(wanted + unwanted))
        split = embedded[: len(wanted)], embedded[len(wanted) :]
        given |= {"piece_nearness": piece_nearness, "logits": logits}
        selection = query_several(field, *split, several=several, **given)
        if several and field.parts is not None:
            selection = query_parts(field, selection, split[0])
        answer = _answer(field, text, by, _shaped(field, selection, by, threshold, near), outliers, {}, keep="all")
        return dataclasses.replace(answer, there=best_presence(field.regions, split[0], selection.region, logits))
    embedding = jax.device_put(embedder.embed_text([text])[0])
    if by in ("votes", "silhouette", "code"):
        shape: dict[str, Any] = {"similarity_threshold": threshold, "piece_nearness": piece_nearness, "logits": logits}
        selection = query_anchored(field, embedding, by=_membership(by), **shape)
        selection = _shaped(field, selection, by, threshold, near)
    else:
        from jsecon.language.codes import encode

        code = encode(field.autoencoder, embedding)
        usual = ONE_STEP_THRESHOLD if by == "one_step" else CANONICAL_THRESHOLD
        least = usual if threshold is None else threshold
        if by == "one_step":
            selection = query_one_step(field.codes, code, least)
        else:
            canonical = encode(field.autoencoder, jnp.asarray(field.canonical))
            selection = query_canonical(field.codes, code, canonical, least)
    answer = _answer(field, text, by, selection, outliers, {})
    return dataclasses.replace(answer, there=best_presence(field.regions, embedding[None], selection.region, logits))


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

    Raises InputError for a frame or pixel that the field does not have, and where no region lies there.
    """
    index = frame_index(field, frame)
    region = region_at(field, index, x, y)
    name = field.names[index]
    if region < 0:
        remedy = "Choose another pixel or frame: report.html of the run shows the regions."
        raise InputError(f"--at {name} {x} {y}", "no region under that pixel", "a pixel of an object", remedy)
    by = by if by in ("silhouette", "code") else "votes"
    selection = query_region(field, region, by=_membership(by), similarity_threshold=threshold)
    selection = _shaped(field, selection, by, threshold, near)
    left = {"text encoder": "the region under the pixel is the anchor"}
    return _answer(field, f"at {name} {x} {y}", by, selection, outliers, left)


def ask_region(field: LanguageField, region: int, *, several: bool = False, **shape: Any) -> Answer:
    """The Gaussians of a region, with `several` of all that are alike; `shape` as for `query_region`."""
    selection = query_region(field, region, alike_threshold=ALIKE_THRESHOLD if several else None, **shape)
    left = {"text encoder": "the region is the anchor"}
    return _answer(field, f"region {region}", "votes", selection, True, left, keep="all" if several else "largest")


def ask_outline(
    field: LanguageField,
    name: str,
    outlines: Mapping[Any, np.ndarray],
    *,
    threshold: float | None = None,
    outliers: bool = True,
) -> Answer:
    """The Gaussians of one thing, outlined in one frame or several: frame -> mask (H, W), or what `box_mask` made.

    Raises InputError as `jsecon.query.lift.lift` does.
    """
    frames = [frame_index(field, frame) for frame in outlines]
    least = SHARE_THRESHOLD if threshold is None else threshold
    selection = lift(field, np.stack([np.asarray(m).astype(int) for m in outlines.values()]), frames, threshold=least)
    left = {"text encoder": "the outline says what is meant"}
    return _answer(field, name, "outline", selection, outliers, left)


def read_mask(file: Path, field: LanguageField) -> Bool[np.ndarray, "h w"]:
    """(H, W) bool of an image file, at the size of the field's frames: what is not black. Raises InputError where it is
    no image, or one of another shape."""
    image, size = read_stored(Path(file)), (field.cameras.width, field.cameras.height)
    mask = np.asarray(image[..., :3].any(-1) if image.ndim == 3 else image > 0, np.uint8)
    if abs(mask.shape[1] * size[1] - mask.shape[0] * size[0]) > max(size) + max(mask.shape):
        found, wanted = f"{mask.shape[1]}x{mask.shape[0]}", f"{size[0]}x{size[1]}, or the same shape at another size"
        raise InputError(file, found, wanted, "Outline the frame as the run used it.")
    return np.asarray(cv2.resize(np.asarray(mask), size, interpolation=cv2.INTER_NEAREST)) > 0


def _membership(by: str) -> str:
    return "code" if by == "code" else "votes"


def _shaped(
    field: LanguageField, selection: Selection, by: str, threshold: float | None, near: np.ndarray | None
) -> Selection:
    """By votes as it is, by "silhouette" the Gaussians whose outline fits the shares best in the field's views; with
    `near` the shares are evened out over these neighbours first."""
    least = SHARE_THRESHOLD if threshold is None else threshold
    if near is not None and by in ("votes", "silhouette"):
        share = evened(jnp.asarray(selection.similarity), jnp.asarray(near))
        inside = (share >= least) & (selection.region >= 0)
        selection = dataclasses.replace(selection, mask=inside, similarity=share)
    if by != "silhouette":
        return selection
    mask = silhouette_members(field.gaussians, field.cameras, selection.similarity, threshold=least)
    return dataclasses.replace(selection, mask=mask & (selection.region >= 0))


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
            found, wanted = f"{len(ends)} frames that end so", f"one, such as {field.names[ends[0]]}"
            raise InputError(f"frame {frame}", found, wanted, "Give more of the name.")
    place = int(str(frame).lstrip("#")) if re.fullmatch(r"#\d+", str(frame)) or isinstance(frame, int) else -1
    if 0 <= place < len(field.names):
        return place
    last = len(field.names) - 1
    known = f"a name ({field.names[0]} ... {field.names[-1]}), the end of one, or a place, #0 to #{last}"
    raise InputError(f"frame {frame}", "no such frame in the field", known, "report.html of the run shows the frames.")


def _answer(
    field: LanguageField,
    question: str,
    by: str,
    selection: Selection,
    outliers: bool,
    left: dict[str, str],
    keep: str = "largest",
) -> Answer:
    mask = np.asarray(selection.mask)
    if outliers:
        mask, why = outliers_removed(field.gaussians.means, mask, keep=keep)
        left = left | ({"DBSCAN": why} if why else {})
    else:
        left = left | {"DBSCAN": "not asked for"}
    return Answer(question, by, selection, mask, left)
