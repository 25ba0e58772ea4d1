"""`jsecon query`: its checks, the answers to its texts, pixels and outlines, and their files."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jsecon.app import ask, verbs
from jsecon.app.ask import Answer
from jsecon.app.models import open_embedder, with_models
from jsecon.app.outputs import write_answers
from jsecon.errors import InputError
from jsecon.field.field import check_field, load_field
from jsecon.field.membership import SHARE_THRESHOLD
from jsecon.pipeline.options import Options, is_bare_scene, require_writable
from jsecon.pipeline.progress import Console
from jsecon.process import MEMORY, memory_budget
from jsecon.query.expressions import is_expression
from jsecon.query.outline import box_mask, lift
from jsecon.read.splats.files import require_writable_format
from jsecon.types import LanguageField


def _query(verb: verbs.Query, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon query`; the result has the records of the answers, and the errors of failed queries."""
    _check_query(verb)
    require_writable(verb.out)
    verb = with_models(verb, console, yes=verb.yes)
    require_writable_format(verb.out / f"answer.{verb.format}")
    if is_bare_scene(verb.field):
        verb = dataclasses.replace(verb, field=_field_of_scene(verb, console))
    with console.progress("field"):
        large = verb.field.is_file() and verb.field.stat().st_size > memory_budget()
        if large:
            _require_blocks(verb)
            check_field(verb.field)
        field = load_field(verb.field, mapped=large)
        embedder = open_embedder(field, verb, console) if verb.texts else None
    expression = next(filter(is_expression, verb.texts), None)
    if expression is not None and large:
        problem = f"{expression!r} has a relation, an order or a number, which needs the whole field in memory"
        raise InputError(verb.field, problem, remedy="Raise JSECON_MEMORY (GiB), or put the text in quotes.")
    outline: dict[str, Any] = {"threshold": verb.threshold, "outliers": not verb.keep_outliers}
    options = outline | {"by": verb.by, "several": verb.all, "min_rank": verb.min_rank}
    options |= {"pixels": verb.at, "frame": verb.from_frame, "up": verb.up}
    outlines = [lambda pairs=pairs: _ask_masks(field, pairs, **outline) for pairs in verb.mask]
    outlines += [lambda box=box: _ask_box(field, *box, **outline) for box in verb.box]
    answers, errors = ask_texts(field, embedder, verb.texts, console, **options)
    with console.progress("answers"):
        outlined, failed = ask.collect(outlines)
        answers += outlined
        errors += failed
        answers = ask.edit_answers(field, answers, grow=verb.grow, shrink=verb.shrink, invert=verb.invert)
    files = {"views": verb.views, "ending": verb.format}
    result = write_answers(field, answers, verb.out, console, **files) if answers else {"answers": []}
    return result | {"errors": errors}


def ask_texts(
    field: LanguageField,
    embedder: Any,
    texts: Sequence[str],
    console: Console,
    *,
    frame: str | None = None,
    up: Sequence[float] | None = None,
    **options: Any,
) -> tuple[list[Answer], list[InputError]]:
    """Answers texts. Of those with relations, orders or numbers it prints how each was read.

    Args:
      field: The field.
      embedder: Its embedder.
      texts: The texts.
      console: Receives progress and how texts were read.
      frame: Frame from which directions are seen, as for `query_relation`.
      up: Up axis in the capture's world, as for `query_relation`.
      **options: Options of `ask_each` for the other texts.

    Returns:
      The answers, those with relations first, and the errors of the other texts.
    """
    expressions = [text for text in texts if is_expression(text)]
    answers, errors = [], []
    if expressions:
        with console.progress("relations"):
            from jsecon.app import relations  # late: plain texts need none of it

            scene = relations.open_scene(field, embedder, up)
            queries = [lambda text=text: relations.query_relation(scene, text, frame=frame) for text in expressions]
            found, errors = ask.collect(queries)
        for answer in found:
            console.say(f"{answer.text!r}: {answer.describe()}")
            console.note("Words in quotes are searched for as they stand, without relations.")
        answers = [relations.relation_answer(answer) for answer in found]
    with console.progress("answers"):
        plain = [text for text in texts if text not in expressions]
        more, refused = ask.ask_each(field, embedder, texts=plain, **options)
    return answers + more, errors + refused


def _field_of_scene(verb: verbs.Query, console: Console) -> Path:
    """Returns the field of a scene without photographs, which is made in OUT/field unless it is there."""
    from jsecon.pipeline import run as pipeline  # late: queries of a field need none of it

    options = Options(verb.field, embedder=verb.embedder, up=verb.up)
    folder = verb.out / "field"
    with console.progress("plan"):
        path = pipeline.current_field(options, folder)
    if path is None:
        pipeline.run(options, folder, listener=console)
        path = folder / pipeline.FIELD_FILE
        console.say(f"field   {path}")
    return path


def _check_query(verb: verbs.Query) -> None:
    """Raises InputError for options of a query that are out of range, or that cannot be combined."""
    if not (verb.texts or verb.at or verb.mask or verb.box):
        remedy = 'For example: jsecon query field.safetensors "red mug" --out answers'
        raise InputError("query", "there is no query", "a TEXT, --at FRAME X Y, --mask or --box", remedy)
    for pairs in verb.mask:
        if len(pairs) % 2:
            remedy = "For example: --mask frame_00012 mug.png"
            raise InputError("--mask", " ".join(pairs), "FRAME PNG, in pairs", remedy)
    if verb.from_frame is not None and not any(map(is_expression, verb.texts)):
        remedy = 'For example: "the red mug left of the bottle" --from frame_00012'
        raise InputError("--from", "no text has a relation that is seen from a frame", remedy=remedy)
    if verb.up is not None and not any(map(is_expression, verb.texts)) and not is_bare_scene(verb.field):
        problem = "no text has a relation, and the field has its views"
        raise InputError("--up", problem, remedy="Leave it out, or make the field again: jsecon run --up.")
    if not 0 <= verb.min_rank <= 1:
        remedy = f"{verbs.Query.min_rank:g} is the default; 0 refuses no text."
        raise InputError("--min-rank", f"{verb.min_rank:g}", "a share of words, 0 to 1", remedy)
    for name, shells in (("--grow", verb.grow), ("--shrink", verb.shrink)):
        if shells < 0:
            raise InputError(name, f"{shells}", "a number of shells, 0 or more", "1 is a small step.")
    if (verb.mask or verb.box) and verb.by != "votes":
        problem = "--mask and --box select by the outline alone"
        raise InputError("--by", problem, remedy="Leave --by out, or ask by a text.")


def _require_blocks(verb: verbs.Query) -> None:
    """Raises InputError if queries of a field that is larger than memory need the whole field there."""
    needs_all = {
        "--mask or --box": verb.mask or verb.box,
        "--grow, --shrink or --invert": verb.grow or verb.shrink or verb.invert,
    }
    for option, used in needs_all.items():
        if used:
            size, budget = verb.field.stat().st_size / 2**30, memory_budget() / 2**30
            problem = f"the field has {size:.3g} GiB, memory has room for {budget:.3g}, and {option} needs all of it"
            remedy = f"Ask by a text or --at, or set {MEMORY}={1.1 * size:.2g} (GiB) to read it whole."
            raise InputError(verb.field, problem, remedy=remedy)


def _ask_masks(field: LanguageField, pairs: Sequence[str], **options: Any) -> Answer:
    """Answers a frame, a mask file, a frame, a file ...: the object that they outline, named after the first file."""
    frames, files = pairs[::2], pairs[1::2]
    names = [field.names[ask.frame_index(field, frame)] for frame in frames]
    if len(set(names)) < len(names):
        raise InputError("--mask", "a frame has two masks", remedy="Give one mask of an object in each frame.")
    outlines = {name: ask.read_mask(Path(file), field) for name, file in zip(names, files)}
    key = "\0".join(("mask", *(part for pair in zip(names, files) for part in pair)))
    return _ask_outline(field, Path(files[0]).stem, key, outlines, **options)


def _ask_box(field: LanguageField, frame: str, *ends: int, **options: Any) -> Answer:
    """Answers a box: the left, upper, right and lower end in a frame, px."""
    name = f"box {field.names[ask.frame_index(field, frame)]} {' '.join(map(str, ends))}"
    return _ask_outline(field, name, name, {frame: box_mask(field, *ends)}, **options)


def _ask_outline(
    field: LanguageField,
    name: str,
    key: str,
    outlines: Mapping[str, np.ndarray],
    *,
    threshold: float | None,
    outliers: bool,
) -> Answer:
    """Answers an object that is outlined in frames, by the masks (H, W) or `box_mask` of each frame."""
    frames = [ask.frame_index(field, frame) for frame in outlines]
    masks = np.stack([np.asarray(mask).astype(int) for mask in outlines.values()])
    selection = lift(field, masks, frames, threshold=SHARE_THRESHOLD if threshold is None else threshold)
    skipped = {"text encoder": "the outline is the query"}
    answer = Answer(name, "outline", selection, np.asarray(selection.mask), skipped, key=key)
    return ask.drop_outliers(field, answer, outliers)


VERBS = {verbs.Query: _query}
"""what does the work of each verb"""
