"""The command line: demo, run, query, eval, models. Bad input ends in one message and exit code 2, Ctrl-C in 130."""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from typing import Any

from jsecon.errors import InputError
from jsecon.grammar import parser
from jsecon.options import Options, require_writable


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit code."""
    try:
        arguments = parser().parse_args(argv)
    except SystemExit as stop:  # argparse has said why
        return int(stop.code or 0)
    try:
        _ACTS[arguments.verb](arguments)
    except InputError as error:
        print(f"jsecon: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\njsecon: stopped. Give the same command again and it goes on where it stopped.", file=sys.stderr)
        return 130
    return 0


def _act_demo(arguments: argparse.Namespace) -> None:
    from jsecon.console import Console
    from jsecon.demo import demo

    demo(
        arguments.out,
        seed=arguments.seed,
        reporter=Console(),
        **({} if arguments.steps is None else {"steps": arguments.steps}),
    )


def _act_run(arguments: argparse.Namespace) -> None:
    from jsecon import pipeline
    from jsecon.console import Console
    from jsecon.summary import write_run

    console = Console()
    given = vars(arguments)
    options = Options(**{f.name: given[f.name] for f in dataclasses.fields(Options) if f.name in given})
    finished = pipeline.run(options, arguments.out, reporter=console)
    write_run(finished, arguments.out, console)


def _act_query(arguments: argparse.Namespace) -> None:
    from jsecon import answer
    from jsecon.console import Console
    from jsecon.language.field import load_field
    from jsecon.query.several import parts_of_question
    from jsecon.summary import write_answers

    if not arguments.texts and not arguments.at:
        raise InputError(
            "query",
            found="nothing to find",
            expected="a TEXT, or --at FRAME X Y",
            remedy='For example: jsecon query field.npz "red mug" --out answers',
        )
    pixels = [(frame, _whole("X", x), _whole("Y", y)) for frame, x, y in arguments.at]
    require_writable(arguments.out)
    field = load_field(arguments.field)
    embedder = _embedder(field, arguments) if arguments.texts else None
    if embedder is not None:
        # a text that cannot be understood: say so before any work
        embedder.embed_text([part for text in arguments.texts for side in parts_of_question(text) for part in side])
    how = {"by": arguments.by, "threshold": arguments.threshold, "outliers": not arguments.keep_outliers}
    answers = [answer.ask_text(field, embedder, text, several=arguments.several, **how) for text in arguments.texts]
    answers += [answer.ask_pixel(field, frame, x, y, **how) for frame, x, y in pixels]
    write_answers(field, answers, arguments.out, Console(), views=arguments.views)


def _act_eval(arguments: argparse.Namespace) -> None:
    from jsecon.console import Console
    from jsecon.language.field import load_field
    from jsecon.summary import write_evaluation

    out = arguments.out or arguments.field.parent
    require_writable(out)
    field = load_field(arguments.field)
    write_evaluation(field, _embedder(field, arguments), arguments.labels, out, Console())


def _embedder(field: Any, arguments: argparse.Namespace) -> Any:
    from jsecon import eyes

    for template in arguments.template or ():
        if "{}" not in template:
            raise InputError(
                "--template", found=template, expected="a phrase that holds {}", remedy='"a photo of a {}."'
            )
    return eyes.embedder_of_field(field, arguments.embedder, templates=arguments.template or ("{}",))


def _act_models(arguments: argparse.Namespace) -> None:
    from jsecon.console import Console
    from jsecon.models import examine, report_lines, require_usable

    findings = examine(arguments.folder)
    console = Console()
    for line in report_lines(findings):
        console.say(line)
    require_usable(findings)


def _whole(name: str, text: str) -> int:
    if not text.isdecimal():
        raise InputError(
            f"--at {name}",
            found=text,
            expected="a whole number of pixels",
            remedy="For example: --at frame_00012 310 145",
        )
    return int(text)


_ACTS = {"demo": _act_demo, "run": _act_run, "query": _act_query, "eval": _act_eval, "models": _act_models}
