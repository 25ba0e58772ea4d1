"""The command line: its verbs and what each takes. Bad input ends in one message and exit code 2, Ctrl-C in 130."""

import argparse
import dataclasses
import inspect
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import jsecon
from jsecon.app.arguments import add_arguments, parsed
from jsecon.app.options import Folder, Options, SceneOptions, require_writable
from jsecon.errors import InputError

EPILOG = """
examples
  jsecon demo                                           a made-up room, from frames to answers and a report
  jsecon run my_capture --out my_field                  COLMAP or nerfstudio folder -> my_field/field.npz
  jsecon run my_photos --out my_field                   photographs or a video: finds their poses first (extra sfm)
  jsecon run my_capture --out my_field --gaussians point_cloud.ply
                                                        the same on a scene that is already splatted
  jsecon fit my_capture --out scene.ply --minutes 5     only the Gaussians, the best that five minutes give
  jsecon query my_field/field.npz "red mug" "dark green bottle" --out answers
  jsecon query my_field/field.npz --at frame_00012 310 145 --out answers
  jsecon eval my_field/field.npz --labels my_capture/label --out evaluation
  jsecon run my_capture --out my_field --segmenter sam --embedder clip
                                                        with SAM and CLIP from model folders
  jsecon models check clip                              what a model folder holds and lacks

A run that is stopped goes on where it stopped when the same command is given again.
"""
RUN_GROUPS = {"downscale": "frames and scene", "masks": "masks", "segmenter": "models", "weighting": "field"}


@dataclasses.dataclass(frozen=True)
class Demo:
    """make a room, build its field, query it and write a report

    Makes a procedural room of named, coloured objects, writes it to disk as an ordinary COLMAP capture, and runs on it
    what `jsecon run`, `query` and `eval` run: nothing of the ground truth but frames, poses and sparse points is used.
    Ends with report.html, metrics.json, field.npz and a .ply for each query. One to two minutes on two cores.
    """

    seed: int = 0
    """which room"""
    out: Path = Path("jsecon-demo")
    """folder for all of it"""
    steps: int = 550
    """of the photometric fit"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run(Options):
    """build the language field of a capture

    From frames to a language field: poses (found where the capture has none), Gaussians (fitted, or given as a .ply),
    masklets (found in the frames and brought together, or given as masks), one embedding per region, codes distilled
    into the Gaussians. Prints its stages first. Writes OUT/field.npz, OUT/report.html, OUT/metrics.json and OUT/cache.
    """

    out: Path
    """folder for the field, the report and the cache"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fit(SceneOptions):
    """fit Gaussians to a capture, and no more

    From posed frames to a scene of 3D Gaussians as a .ply (INRIA layout, in the capture's own world; SuperSplat opens
    it), with PSNR and SSIM of the frames held out. What it keeps lies in a folder of the same name without the ending,
    from which it goes on when it was stopped, and `jsecon run` into that folder too.
    """

    out: Annotated[Path, {"metavar": "PLY"}]
    """the .ply file to write"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Asking:
    """What `jsecon query` and `jsecon eval` take."""

    field: Annotated[Path, {"positional": True}]
    """field.npz of a run"""
    embedder: Folder = None
    """the CLIP model folder that the field was made with (default: where the run had it)"""
    template: Annotated[list[str] | None, {"action": "append", "metavar": "PHRASE"}] = None
    """CLIP: a phrase for the text, such as "a photo of a {}."; several are averaged (default: the bare text)"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Query(Asking):
    """the Gaussians that a text names, that lie under a pixel, or that somebody outlined

    For each text, pixel or outline, writes to OUT: the selected Gaussians as a .ply (INRIA layout, in the capture's own
    world; SuperSplat opens it), a .json with count, score, region, centroid and bounding box, masks of the frames that
    show it best, and answers.html with the pictures.
    """

    texts: Annotated[list[str], {"positional": True, "nargs": "*", "metavar": "TEXT"}]
    """what to find: "red mug" "dark green bottle" "mug or bowl but not handle" ..."""
    at: Annotated[list[list[str]] | None, {"action": "append", "nargs": 3, "metavar": ("FRAME", "X", "Y")}] = None
    """what lies under pixel (column X, row Y) of a frame, in the frames as the run used them; needs no text. A frame is
    named by its name, the end of it, or its place, #10"""
    mask: Annotated[list[list[str]] | None, {"action": "append", "nargs": "+", "metavar": ("FRAME", "PNG")}] = None
    """what a mask outlines in a frame, or one thing in several: FRAME PNG FRAME PNG; black is outside"""
    box: Annotated[
        list[list[str]] | None, {"action": "append", "nargs": 5, "metavar": ("FRAME", "X0", "Y0", "X1", "Y1")}
    ] = None
    """what lies in a box of a frame: the regions that are seen there by more than half"""
    out: Path
    """folder for the answers"""
    by: Literal["votes", "silhouette", "code", "one_step", "canonical"] = "votes"
    """votes, code: text -> the region that answers it -> the Gaussians with its votes, or with its code; silhouette: by
    votes, then each taken or left by what the outline of all gains in the views; one_step, canonical: each Gaussian's
    code against the text"""
    threshold: float | None = None
    """on what --by measures (default: 0.5 votes and silhouette, 0.9 code, 0.8 one_step, 0.5 canonical)"""
    all: bool = False
    """every region that answers a text, such as all the chairs, not only the best: those whose similarity has come 0.75
    of the way from the middle region's to the best one's (by votes or silhouette)"""
    keep_outliers: bool = False
    """leave out the last step, DBSCAN"""
    views: Annotated[int, {"metavar": "N"}] = 3
    """masks to write per query"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Eval(Asking):
    """measure a field against labels

    Point-level rendered protocol on LERF-style labels (one .json per frame): the selected Gaussians alone are rendered,
    alpha > 0.7, against each labelled mask; a missing prediction counts as 0. Prints mIoU, mAcc@0.25 and localisation
    accuracy of each kind of query, and writes OUT/evaluation.json with every pair.
    """

    labels: Annotated[Path, {"metavar": "DIR"}]
    """folder of LERF label files (frame.json)"""
    out: Path | None = None
    """folder for evaluation.json (default: the field's)"""


@dataclasses.dataclass(frozen=True)
class Models:
    """look into a folder of models

    check DIR: what models a folder holds, each graph's inputs and outputs, what it can be used for, what is missing,
    and where such exports are published. Exit code 2 where nothing in it can be used.
    """

    action: Annotated[str, {"positional": True, "choices": ("check",), "metavar": "check"}]
    """tell what a model folder holds"""
    folder: Annotated[Path, {"positional": True, "metavar": "DIR"}]
    """folder with .onnx files"""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit code."""
    try:
        arguments = parser().parse_args(argv)
    except SystemExit as stop:  # argparse has said why
        return int(stop.code or 0)
    act, kind = _VERBS[arguments.verb]
    try:
        act(parsed(kind, arguments))
    except InputError as error:
        print(f"jsecon: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\njsecon: stopped. Give the same command again and it goes on where it stopped.", file=sys.stderr)
        return 130
    return 0


def parser() -> argparse.ArgumentParser:
    """The whole command line."""
    raw = argparse.RawDescriptionHelpFormatter
    about = "Find things in 3D Gaussian scenes by text, at the level of points, on a plain CPU."
    top = argparse.ArgumentParser(prog="jsecon", formatter_class=raw, epilog=EPILOG, description=about)
    top.add_argument("--version", action="version", version=f"jsecon {jsecon.__version__}")
    verbs = top.add_subparsers(dest="verb", required=True, metavar="VERB")
    for name, (_, kind) in _VERBS.items():
        short, _, long = (inspect.getdoc(kind) or "").partition("\n\n")
        verb = verbs.add_parser(name, help=short, description=long, formatter_class=raw)
        add_arguments(verb, kind, RUN_GROUPS if kind is Run else None)
    return top


def _demo(asked: Demo) -> None:
    from jsecon.app.demo import demo
    from jsecon.app.progress import Console

    demo(asked.out, seed=asked.seed, steps=asked.steps, listener=Console())


def _run(asked: Run) -> None:
    from jsecon.app import pipeline
    from jsecon.app.progress import Console
    from jsecon.app.summary import write_run

    console = Console()
    options = Options(**{field.name: getattr(asked, field.name) for field in dataclasses.fields(Options)})
    write_run(pipeline.run(options, asked.out, listener=console), asked.out, console)


def _fit(asked: Fit) -> None:
    from jsecon.app import pipeline
    from jsecon.app.progress import Console
    from jsecon.app.summary import write_scene

    if asked.out.suffix != ".ply":
        raise InputError("--out", str(asked.out), "a file that ends in .ply", "For example: --out scene.ply")
    console = Console()
    options = Options(**{field.name: getattr(asked, field.name) for field in dataclasses.fields(SceneOptions)})
    write_scene(*pipeline.fit(options, asked.out.with_suffix(""), listener=console), asked.out, console)


def _query(asked: Query) -> None:
    from jsecon.app import question
    from jsecon.app.progress import Console
    from jsecon.app.summary import write_answers
    from jsecon.language.field import load_field

    if not (asked.texts or asked.at or asked.mask or asked.box):
        remedy = 'For example: jsecon query field.npz "red mug" --out answers'
        raise InputError("query", "nothing to find", "a TEXT, --at FRAME X Y, --mask or --box", remedy)
    pixels = [(frame, *_whole("--at", x, y)) for frame, x, y in asked.at or ()]
    boxes = [(frame, *_whole("--box", *ends)) for frame, *ends in asked.box or ()]
    for given in asked.mask or ():
        if len(given) % 2:
            remedy = "For example: --mask frame_00012 mug.png"
            raise InputError("--mask", " ".join(given), "FRAME PNG, in pairs", remedy)
    require_writable(asked.out)
    field = load_field(asked.field)
    embedder = _embedder(field, asked) if asked.texts else None
    asking = question.questions_of(
        field,
        embedder,
        texts=asked.texts,
        pixels=pixels,
        masks=asked.mask or (),
        boxes=boxes,
        several=asked.all,
        by=asked.by,
        threshold=asked.threshold,
        outliers=not asked.keep_outliers,
    )
    answers, refused = question.asked_each(asking)
    if answers:
        write_answers(field, answers, asked.out, Console(), views=asked.views)
    for error in refused[:-1]:
        print(f"jsecon: {error}", file=sys.stderr)
    if refused:
        raise refused[-1]


def _eval(asked: Eval) -> None:
    from jsecon.app.progress import Console
    from jsecon.app.summary import write_evaluation
    from jsecon.language.field import load_field

    out = asked.out or asked.field.parent
    require_writable(out)
    field = load_field(asked.field)
    write_evaluation(field, _embedder(field, asked), asked.labels, out, Console())


def _models(asked: Models) -> None:
    from jsecon.app.models import examine, report_lines, require_usable
    from jsecon.app.progress import Console

    findings = examine(asked.folder)
    console = Console()
    for line in report_lines(findings):
        console.say(line)
    require_usable(findings)


def _embedder(field: Any, asked: Asking) -> Any:
    from jsecon.app import networks

    return networks.embedder_of_field(field, asked.embedder, templates=asked.template or ("{}",))


def _whole(option: str, *texts: str) -> list[int]:
    for text in texts:
        if not text.isdecimal():
            raise InputError(option, text, "whole numbers of pixels", "For example: --at frame_00012 310 145")
    return [int(text) for text in texts]


_VERBS: dict[str, tuple[Any, type]] = {
    "demo": (_demo, Demo),
    "run": (_run, Run),
    "fit": (_fit, Fit),
    "query": (_query, Query),
    "eval": (_eval, Eval),
    "models": (_models, Models),
}
