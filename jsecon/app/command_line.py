"""The command line: its verbs and what each takes. Bad input ends in one message and exit code 2, Ctrl-C in 130."""

import argparse
import dataclasses
import inspect
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jsecon
from jsecon.app.arguments import add_arguments, parsed
from jsecon.app.options import Options, SceneOptions, require_writable
from jsecon.app.verbs import Asking, Demo, Eval, Export, Fit, Models, Query, Run, Serve, View
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
  jsecon export my_field/field.npz --out scene.glb      the whole scene for other programs, codes included
  jsecon eval my_field/field.npz --labels my_capture/label --out evaluation
  jsecon run my_capture --out my_field --segmenter sam --embedder clip
                                                        with SAM and CLIP from model folders
  jsecon models check clip                              what a model folder holds and lacks

A run that is stopped goes on where it stopped when the same command is given again.
"""
RUN_GROUPS = {"downscale": "frames and scene", "masks": "masks", "segmenter": "models", "weighting": "field"}


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
    from jsecon.data.gaussian_files import require_written

    require_written(asked.out)
    console = Console()
    options = Options(**{field.name: getattr(asked, field.name) for field in dataclasses.fields(SceneOptions)})
    write_scene(*pipeline.fit(options, asked.out.with_suffix(""), listener=console), asked.out, console)


def _query(asked: Query) -> None:
    from jsecon.app import question
    from jsecon.app.progress import Console
    from jsecon.app.summary import write_answers
    from jsecon.data.gaussian_files import require_written
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
    require_written(asked.out / f"answer.{asked.format}")
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
        even=asked.even,
        by=asked.by,
        threshold=asked.threshold,
        outliers=not asked.keep_outliers,
    )
    answers, refused = question.asked_each(asking)
    if answers:
        write_answers(field, answers, asked.out, Console(), views=asked.views, ending=asked.format)
    _tell(refused)


def _tell(refused: Sequence[InputError]) -> None:
    """Raises the last of the errors, the others told."""
    for error in refused[:-1]:
        print(f"jsecon: {error}", file=sys.stderr)
    if refused:
        raise refused[-1]


def _export(asked: Export) -> None:
    from jsecon.app.answers import save_part
    from jsecon.app.progress import Console
    from jsecon.data.gaussian_files import require_written
    from jsecon.language.field import load_field

    require_written(asked.out)
    field = load_field(asked.field)
    save_part(field, asked.out)
    Console().say(f"{field.gaussians.count} Gaussians, {asked.out.stat().st_size / 2**20:.1f} MiB  {asked.out}")


def _view(asked: View) -> None:
    from jsecon.app import question
    from jsecon.app.progress import Console
    from jsecon.app.splat_page import write_page
    from jsecon.language.field import load_field

    if asked.export.suffix != ".html":
        raise InputError("--export", str(asked.export), "a file that ends in .html", "For example: --export page.html")
    require_writable(asked.export.parent)
    field = load_field(asked.field)
    embedder = _embedder(field, asked) if asked.texts else None
    answers, refused = question.asked_each(question.questions_of(field, embedder, texts=asked.texts))
    size = write_page(field, answers, asked.export, title=asked.field.resolve().parent.name)
    Console().say(f"{field.gaussians.count} Gaussians, {len(answers)} answers, {size / 2**20:.1f} MiB  {asked.export}")
    _tell(refused)


def _eval(asked: Eval) -> None:
    from jsecon.app.progress import Console
    from jsecon.app.summary import write_evaluation
    from jsecon.language.field import load_field

    out = asked.out or asked.field.parent
    require_writable(out)
    field = load_field(asked.field)
    write_evaluation(field, _embedder(field, asked), asked.labels, out, Console())


def _serve(asked: Serve) -> None:
    from jsecon.app.progress import Console
    from jsecon.app.server import serve

    token = asked.token or os.environ.get("JSECON_TOKEN", "")
    files = [Path(file) for file in asked.fields]
    serve(files, host=asked.host, port=asked.port, token=token, embedder=asked.embedder, say=Console().say)


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
    "export": (_export, Export),
    "view": (_view, View),
    "eval": (_eval, Eval),
    "serve": (_serve, Serve),
    "models": (_models, Models),
}
