"""`jsecon query`: its options as questions, and the files of the answers."""

from pathlib import Path
from typing import Any

from jsecon.app import verbs
from jsecon.app.outputs import write_answers
from jsecon.app.records import At, Box, Mask, Query, Question
from jsecon.app.scene import open_scene
from jsecon.errors import InputError
from jsecon.pipeline.options import is_bare_scene, require_writable
from jsecon.pipeline.progress import Console
from jsecon.query.expressions import is_expression
from jsecon.read.splats.files import require_writable_format


def _query(verb: verbs.Query, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon query`; the result has the records of the answers, and the errors of failed queries."""
    queries = _queries(verb)
    require_writable(verb.out)
    require_writable_format(verb.out / f"answer.{verb.format}")
    scene = open_scene(verb.field, embedder=verb.embedder, up=verb.up, out=verb.out / "field", console=console)
    with console.progress("answers"):
        if verb.texts:
            _ = scene.embedder  # without it one error stands for all texts
        results = scene.ask_all(queries)
    answers = [answer for answer in results if not isinstance(answer, InputError)]
    if any(answer.by == "relation" for answer in answers):
        console.note("Words in quotes are searched for as they stand, without relations.")
    files: dict[str, Any] = {"views": verb.views, "ending": verb.format}
    result = write_answers(scene, answers, verb.out, console, **files) if answers else {"answers": []}
    return result | {"errors": [error for error in results if isinstance(error, InputError)]}


def _queries(verb: verbs.Query) -> list[Query]:
    """The queries of a command, in order: texts, pixels, masks and boxes; InputError for options that do not fit."""
    masks = [Mask(_frames_of(pairs)) for pairs in verb.mask]
    boxes = [Box(*box) for box in verb.box]
    questions: list[Question] = [*verb.texts, *(At(*at) for at in verb.at), *masks, *boxes]
    if not questions:
        remedy = 'For example: jsecon query field.safetensors "red mug" --out answers'
        raise InputError("query", "there is no query", "a TEXT, --at FRAME X Y, --mask or --box", remedy)
    relates = any(map(is_expression, verb.texts))
    if verb.from_frame is not None and not relates:
        remedy = 'For example: "the red mug left of the bottle" --from frame_00012'
        raise InputError("--from", "no text has a relation that is seen from a frame", remedy=remedy)
    if verb.up is not None and not relates and not is_bare_scene(verb.field):
        problem = "no text has a relation, and the field has its views"
        raise InputError("--up", problem, remedy="Leave it out, or make the field again: jsecon run --up.")
    options: dict[str, Any] = {"by": verb.by, "threshold": verb.threshold, "min_rank": verb.min_rank}
    options |= {"all_of_class": verb.all, "outliers": not verb.keep_outliers, "frame": verb.from_frame}
    try:
        return [Query(question, **options) for question in questions]
    except InputError as error:  # of an option
        raise InputError(f"--{error.where}", error.problem, error.expected, error.remedy) from error


def _frames_of(pairs: list[str]) -> dict[int | str, Path]:
    """The masks of a frame, a file, a frame, a file ..."""
    if len(pairs) % 2:
        raise InputError("--mask", " ".join(pairs), "FRAME PNG, in pairs", "For example: --mask frame_00012 mug.png")
    frames: dict[int | str, Path] = dict(zip(pairs[::2], map(Path, pairs[1::2])))
    if 2 * len(frames) < len(pairs):
        raise InputError("--mask", "a frame has two masks", remedy="Give one mask of an object in each frame.")
    return frames
