"""The command line. Bad input ends in one message and exit code 2, Ctrl-C in 130; what a verb takes is in verbs.py,
what it does in actions.py."""

import argparse
import contextlib
import inspect
import sys
from collections.abc import Iterator, Sequence
from typing import NoReturn

import jsecon
from jsecon.app.actions import VERBS
from jsecon.app.ending import Told, ended
from jsecon.app.verbs import Completion, Output, Run
from jsecon.errors import InputError, why
from jsecon.pipeline.arguments import add_arguments, parsed
from jsecon.pipeline.progress import Console
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
  jsecon run my_capture --out my_field --dry-run        what would run, and why
  jsecon doctor                                         whether this machine has what runs need

A run that is stopped goes on where it stopped when the same command is given again.
"""
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
    except (KeyboardInterrupt, Exception) as error:
        if any(isinstance(cause, KeyboardInterrupt) for cause in _causes(error)):  # libraries make errors of stops
            remedy = "Run the same command again to resume."
            print(f"\njsecon: interrupted. {remedy}", file=sys.stderr)
            told = {"error": InputError("", "interrupted", remedy=remedy)}
            return ended(output, told, 130)
        if isinstance(error, InputError):
            return ended(output, {"refused": [error]})
        # a bug, whose trace the interpreter prints
        remedy = "Report it with the trace on standard error."
        ended(output, {"error": InputError("jsecon", f"internal error: {why(error)}", remedy=remedy)})
        raise
    then = told.pop("then", lambda: None)
    code = ended(output, told)
    with contextlib.suppress(KeyboardInterrupt):  # so a server ends
        then()
    return code


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """An error, and those amid which it was raised."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


class _Parser(argparse.ArgumentParser):
    """Raises what is wrong with a command line as InputError, behind the usage."""

    def error(self, message: str) -> NoReturn:
        self.print_usage(sys.stderr)
        raise InputError(self.prog, message, remedy=f"{self.prog} --help lists the options.")


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


def _completion(asked: Completion, console: Console) -> Told:
    from jsecon.app.completion import script_of

    console.say(script := script_of(parser(), asked.shell))
    return {"shell": asked.shell, "script": script}


_VERBS = VERBS | {"completion": (_completion, Completion)}
