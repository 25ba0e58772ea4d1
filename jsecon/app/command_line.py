"""The command line: its verbs and what each takes. Bad input ends in one message and exit code 2, Ctrl-C in 130.

A verb's function returns what it wrote and its figures, which is what --json prints (app/ending), and under "then" what
it does when that is told.
"""

import argparse
import contextlib
import dataclasses
import inspect
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import jsecon
from jsecon.app.arguments import add_arguments, parsed
from jsecon.app.ending import Told, ended
from jsecon.app.options import Options, SceneOptions, require_writable
from jsecon.app.progress import Console
from jsecon.app.verbs import (
    Asking,
    Completion,
    Demo,
    Doctor,
    Eval,
    Export,
    Fit,
    Models,
    Output,
    Query,
    Run,
    Serve,
    View,
)
from jsecon.errors import InputError
from jsecon.process import show_whole_traces

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
  jsecon view my_field/field.npz "red mug"              in a browser; --export page.html writes a page
  jsecon eval my_field/field.npz --labels my_capture/label --out evaluation
  jsecon run my_capture --out my_field --segmenter sam --embedder clip
                                                        with SAM and CLIP from model folders
  jsecon models check clip                              what a model folder holds and lacks

A run that is stopped goes on where it stopped when the same command is given again.
"""
_RUN_FILES = ("field.npz", "report.html", "metrics.json")
RUN_GROUPS = {"downscale": "frames and scene", "masks": "masks", "segmenter": "models", "weighting": "field"}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit code."""
    argv = sys.argv[1:] if argv is None else list(argv)
    output = Output("--json" in argv, "--debug" in argv)  # also of a line that cannot be parsed
    try:
        arguments = parser().parse_args(argv)
        output = parsed(Output, arguments)
        if output.debug:
            show_whole_traces()
        act, kind = _VERBS[arguments.verb]
        console = Console(sys.stderr if output.json else None)
        told = act(parsed(kind, arguments), console)
    except SystemExit as stop:  # --help, --version
        return int(stop.code or 0)
    except InputError as error:
        return ended(output, {"refused": [error]})
    except KeyboardInterrupt:
        remedy = "Give the same command again and it goes on where it stopped."
        print(f"\njsecon: stopped. {remedy}", file=sys.stderr)
        return ended(output, {"error": InputError("jsecon", "a stop by the user", "the end of the work", remedy)}, 130)
    except Exception as error:  # a bug, whose trace the interpreter prints
        found, remedy = f"{type(error).__name__}: {error}", "Report it with the trace on standard error."
        ended(output, {"error": InputError("jsecon", found, "no such error: it is a bug", remedy)})
        raise
    then = told.pop("then", lambda: None)
    code = ended(output, told)
    with contextlib.suppress(KeyboardInterrupt):  # so a server ends
        then()
    return code


class _Parser(argparse.ArgumentParser):
    """Raises what is wrong with a command line as InputError, behind the usage."""

    def error(self, message: str) -> NoReturn:
        self.print_usage(sys.stderr)
        raise InputError(self.prog, f"wrong usage ({message})", "what the usage says", f"See: {self.prog} --help")


def parser() -> argparse.ArgumentParser:
    """The whole command line."""
    raw = argparse.RawDescriptionHelpFormatter
    about = "Find things in 3D Gaussian scenes by text, at the level of points, on a plain CPU."
    top = _Parser(prog="jsecon", formatter_class=raw, epilog=EPILOG, description=about)
    top.add_argument("--version", action="version", version=f"jsecon {jsecon.__version__}")
    verbs = top.add_subparsers(dest="verb", required=True, metavar="VERB")
    for name, (_, kind) in _VERBS.items():
        short, _, long = (inspect.getdoc(kind) or "").partition("\n\n")
        verb = verbs.add_parser(name, help=short, description=long, formatter_class=raw)
        add_arguments(verb, kind, RUN_GROUPS if kind is Run else None)
        add_arguments(verb, Output, {"json": "what is said"})
    return top


def _demo(asked: Demo, console: Console) -> Told:
    with console.progress("start"):
        from jsecon.app.demo_real import asked_demo

    told = asked_demo(asked, console)
    return {"written": [asked.out / name for name in (*_RUN_FILES, "queries", "demo.jpg", "demo.webp")]} | told


def _run(asked: Run, console: Console) -> Told:
    with console.progress("start"):
        from jsecon.app import pipeline
        from jsecon.app.summary import write_run

    options = Options(**{field.name: getattr(asked, field.name) for field in dataclasses.fields(Options)})
    if asked.dry_run:
        return pipeline.dry_run(options, asked.out, listener=console)
    told = write_run(pipeline.run(options, asked.out, listener=console), asked.out, console)
    return {"written": [asked.out / name for name in _RUN_FILES]} | told


def _fit(asked: Fit, console: Console) -> Told:
    with console.progress("start"):
        from jsecon.app import pipeline
        from jsecon.app.summary import write_scene
        from jsecon.data.gaussian_files import require_written
    require_written(asked.out)

    options = Options(**{field.name: getattr(asked, field.name) for field in dataclasses.fields(SceneOptions)})
    folder = asked.out.with_suffix("")
    if asked.dry_run:
        return pipeline.dry_run(options, folder, scene_only=True, listener=console)
    return write_scene(*pipeline.fit(options, folder, listener=console), asked.out, console)


def _query(asked: Query, console: Console) -> Told:
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
    with console.progress("field"):
        from jsecon.app import question
        from jsecon.app.summary import write_answers
        from jsecon.data.gaussian_files import require_written
        from jsecon.language.field import load_field

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
    with console.progress("answers"):
        answers, refused = question.asked_each(asking)
    how = {"views": asked.views, "ending": asked.format}
    told = write_answers(field, answers, asked.out, console, **how) if answers else {"answers": []}
    return told | {"refused": refused}


def _export(asked: Export, console: Console) -> Told:
    with console.progress("field"):
        from jsecon.app.answers import save_part
        from jsecon.data.gaussian_files import require_written
        from jsecon.language.field import load_field

        require_written(asked.out)
        field = load_field(asked.field)
        save_part(field, asked.out)
    count, size = field.gaussians.count, asked.out.stat().st_size
    console.say(f"{count} Gaussians, {size / 2**20:.1f} MiB  {asked.out}")
    return {"written": {"scene": asked.out}, "gaussians": count, "bytes": size}


def _view(asked: View, console: Console) -> Told:
    if asked.export is None:
        from jsecon.app.viewer import view

        return view(asked, _embedder, console.say)
    if asked.export.suffix != ".html":
        raise InputError("--export", str(asked.export), "a file that ends in .html", "For example: --export page.html")
    require_writable(asked.export.parent)
    with console.progress("page"):
        from jsecon.app import question
        from jsecon.app.splat_page import write_page
        from jsecon.language.field import load_field

        field = load_field(asked.field)
        embedder = _embedder(field, asked) if asked.texts else None
        answers, refused = question.asked_each(question.questions_of(field, embedder, texts=asked.texts))
        size = write_page(field, answers, asked.export, title=asked.field.resolve().parent.name)
    console.say(
        f"{(count := field.gaussians.count)} Gaussians, {len(answers)} answers, {size / 2**20:.1f} MiB  {asked.export}"
    )
    lit = [answer.question for answer in answers]
    return {"written": {"page": asked.export}, "refused": refused, "gaussians": count, "answers": lit, "bytes": size}


def _eval(asked: Eval, console: Console) -> Told:
    out = asked.out or asked.field.parent
    require_writable(out)
    with console.progress("field"):
        from jsecon.app.summary import write_evaluation
        from jsecon.language.field import load_field

        embedder = _embedder(field := load_field(asked.field), asked)
    return write_evaluation(field, embedder, asked.labels, out, console)


def _serve(asked: Serve, console: Console) -> Told:
    with console.progress("start"):
        from jsecon.app import server

    token = asked.token or os.environ.get("JSECON_TOKEN", "")
    given = {"host": asked.host, "port": asked.port, "token": token, "embedder": asked.embedder}
    with console.progress("fields"):
        told, answer = server.ready([Path(file) for file in asked.fields], **given)
    for scene in told["fields"]:
        console.say(f"{scene['name']}: {scene['gaussians']} Gaussians, {scene['regions']} regions")
    console.say(told["address"])
    return told | {"then": answer}


def _models(asked: Models, console: Console) -> Told:
    with console.progress("graphs"):
        from jsecon.app.models import examine, report_lines, unusable

        findings = examine(asked.folder)
    for line in report_lines(findings):
        console.say(line)
    return dataclasses.asdict(findings) | {"refused": unusable(findings)}


def _doctor(asked: Doctor, console: Console) -> Told:
    with console.progress("looking"):
        from jsecon.app.doctor import checks_of, wrong

        checks = checks_of(asked.models)
    console.say("\n".join(f"{check.status:<8} {check.name:<10} {check.told}" for check in checks))
    return {"checks": checks, "refused": wrong(checks)}


def _completion(asked: Completion, console: Console) -> Told:
    from jsecon.app.completion import script_of

    console.say(script := script_of(parser(), asked.shell))
    return {"shell": asked.shell, "script": script}


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
    "doctor": (_doctor, Doctor),
    "completion": (_completion, Completion),
}
