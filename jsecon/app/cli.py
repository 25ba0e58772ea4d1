"""The command line: finds the verb, lets tyro read its options, and runs it.

Bad input ends in one message and exit code 2, Ctrl-C in exit code 130. verbs.py has the options of each verb, and names
the module that does its work.
"""

import contextlib
import dataclasses
import difflib
import importlib
import inspect
import io
import json
import os
import re
import shutil
import sys
import textwrap
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any, Union, get_type_hints

import docstring_parser
import tyro

import jsecon
from jsecon.app.models import help_table
from jsecon.app.verbs import VERBS, Completion, Output, Run, Verb, VerbResult
from jsecon.errors import InputError, describe_error
from jsecon.pipeline.options import ADVANCED
from jsecon.pipeline.progress import Console

ABOUT = """Finds things in 3D Gaussian scenes by text, at the level of points, on a plain CPU.

examples
  jsecon demo                                           a made-up room, from frames to answers and a report
  jsecon run my_capture --out my_field                  COLMAP or nerfstudio folder -> my_field/field.safetensors
  jsecon run my_photos --out my_field                   photographs or a video: finds their poses first (extra sfm)
  jsecon run my_capture --out my_field --gaussians point_cloud.ply
                                                        the same on a scene that is already splatted
  jsecon query scene.ply "red mug" --out answers        a splat without photographs: plans and renders views of it
  jsecon fit my_capture --out scene.ply --minutes 5     only the Gaussians, the best that five minutes give
  jsecon query my_field/field.safetensors "red mug" "dark green bottle" --out answers
  jsecon query my_field/field.safetensors --at frame_00012 310 145 --out answers
  jsecon objects my_field/field.safetensors --out catalogue
                                                        what is in it: names, boxes, sizes, a page of pictures
  jsecon export my_field/field.safetensors --out scene.glb
                                                        the whole scene for other programs, codes included
  jsecon view my_field/field.safetensors "red mug"      in a browser; --export page.html writes a page
  jsecon eval my_field/field.safetensors --labels my_capture/label --out evaluation
  jsecon run my_capture --out my_field --models auto
                                                        with EdgeTAM and SigLIP 2, fetched after asking
  jsecon models list                                    models by name, sizes, licences; get NAME fetches
  jsecon run my_capture --out my_field --dry-run        what would run, and why
  jsecon doctor                                         whether this machine has what runs need

jsecon VERB --help has the options of a verb. Repeat the command of a stopped run to resume it. jsecon --version prints
the version."""

MAX_WIDTH = 100
"""columns that a description takes at most"""
MARKERS = (tyro.conf.DisallowNone, tyro.conf.FlagCreatePairsOff, tyro.conf.PositionalMetavarFromFieldName)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line.

    Args:
      argv: Arguments behind the program's name; by default those of the process.

    Returns:
      The exit code.
    """
    argv = sys.argv[1:] if argv is None else list(argv)
    output = Output("--json" in argv, "--debug" in argv)  # also for a line that cannot be read
    try:
        if argv == ["--version"]:
            print(f"jsecon {jsecon.__version__}")
            return 0
        verb = parse(argv)
        output = verb.output
        if output.debug:
            os.environ.setdefault("JAX_TRACEBACK_FILTERING", "off")  # before jax is imported
        act, _ = _VERBS[argv[0]]
        console = Console(sys.stderr if output.json else None)
        result = act(verb, console)
    except SystemExit as stop:  # --help
        return int(stop.code or 0)
    except (KeyboardInterrupt, Exception) as error:
        if any(isinstance(cause, KeyboardInterrupt) for cause in _causes(error)):  # libraries make errors of stops
            remedy = "Run the same command again to resume."
            print(f"\njsecon: interrupted. {remedy}", file=sys.stderr)
            result = {"error": InputError("", "interrupted", remedy=remedy)}
            return _finish(output, result, 130)
        if isinstance(error, InputError):
            return _finish(output, {"errors": [error]})
        # a bug, whose trace the interpreter prints
        remedy = "Report it with the trace on standard error."
        _finish(output, {"error": InputError("jsecon", f"internal error: {describe_error(error)}", remedy=remedy)})
        raise
    then = result.pop("then", lambda: None)
    code = _finish(output, result)
    with contextlib.suppress(KeyboardInterrupt):  # so a server ends
        then()
    return code


def parse(argv: Sequence[str]) -> Verb:
    """Reads a command line.

    Args:
      argv: Arguments behind the program's name, the verb first.

    Returns:
      The verb with its options.

    Raises:
      InputError: The command line is wrong.
      SystemExit: It asks for help, which is printed.
    """
    if argv and argv[0] in _VERBS:
        kind, prog = _VERBS[argv[0]][1], f"jsecon {argv[0]}"
        if "--help-all" in argv:
            return _read(kind, prog, ["--help"], description=_description(kind, whole=True))
        if {"-h", "--help"} & set(argv):
            shown = _common_options(kind)
            return _read(shown, prog, ["--help"], description=_description(kind, whole=False))
        return _read(kind, prog, argv[1:])
    if argv and not argv[0].startswith("-"):
        similar = "".join(f"Did you mean {name}? " for name in difflib.get_close_matches(argv[0], _VERBS, 1))
        raise InputError("jsecon", f"{argv[0]} is not a verb", remedy=f"{similar}jsecon --help lists the verbs.")
    return _read(_all_verbs(), "jsecon", argv, description=ABOUT)


def _description(kind: Any, *, whole: bool) -> str:
    """Describes a verb: what it does, in one sentence or as a `whole`, examples, and how to see all options."""
    width = min(shutil.get_terminal_size().columns, MAX_WIDTH)
    parsed = docstring_parser.parse(inspect.getdoc(kind) or "", docstring_parser.DocstringStyle.GOOGLE)
    paragraphs = [parsed.short_description or "", *((parsed.long_description or "").split("\n\n") if whole else [])]
    filled = [textwrap.fill(" ".join(paragraph.split()), width) for paragraph in paragraphs if paragraph]
    examples = "\n".join(["examples", *(f"  {line}" for line in kind.examples)])
    verb = kind.examples[0].split()[1]
    more = [help_table()] if whole and kind is Run else []
    if not whole:
        more = [f"jsecon {verb} --help-all describes every option."]
    return "\n\n".join([*filled, examples, *more])


def _common_options(kind: Any) -> Any:
    """Makes a dataclass of the options of a verb that are not `Advanced`, with the first sentence of each.

    tyro prints its help, which fits a screen. The options of the verb's groups come after its own.
    """
    fields: list[tuple[str, Any, dataclasses.Field]] = []
    sentences: list[str] = []
    for owner in (kind, *_groups(kind)):
        hints = get_type_hints(owner, include_extras=True)
        for field in dataclasses.fields(owner):
            if dataclasses.is_dataclass(hints[field.name]) or ADVANCED in getattr(
                hints[field.name], "__metadata__", ()
            ):
                continue
            default = {"default": field.default, "default_factory": field.default_factory}
            fields.append((field.name, hints[field.name], dataclasses.field(**default, kw_only=True)))
            sentences.append(f"  {field.name}: {_first_sentence(_help_text(owner, field.name))}")
    made = dataclasses.make_dataclass(kind.__name__, fields, frozen=True)
    made.__doc__ = "\n".join(["Options.", "", "Attributes:", *sentences])
    return made


def _groups(kind: Any) -> list[Any]:
    """The classes of a verb's groups of options, but for those of the output, which every verb has."""
    hints = get_type_hints(kind, include_extras=True)
    groups = [hints[field.name] for field in dataclasses.fields(kind) if field.name != "output"]
    return [group for group in groups if dataclasses.is_dataclass(group)]


def _help_text(owner: Any, name: str) -> str:
    """The help text of an option, from the docstring of its class or of a base of it."""
    for cls in owner.__mro__:
        for parameter in docstring_parser.parse(cls.__doc__ or "", docstring_parser.DocstringStyle.GOOGLE).params:
            if parameter.arg_name == name:
                return " ".join((parameter.description or "").split())
    raise LookupError(f"{owner.__name__}.{name} has no help text")


def _first_sentence(text: str) -> str:
    """The text up to the first full stop that ends a sentence; a stop before a small letter or a digit ends none."""
    end = re.search(r"[.:](?= [A-Z`])", text)
    return text if end is None else text[: end.start()] + "."


def _all_verbs() -> Any:
    """Returns the union of the verbs, of which tyro makes subcommands, with the first line of each description."""
    kinds = []
    for name, (_, kind) in _VERBS.items():
        summary = (inspect.getdoc(kind) or "").partition("\n")[0]
        kinds.append(Annotated[kind, tyro.conf.subcommand(name=name, description=summary, prefix_name=False)])
    return Union[tuple(kinds)]  # noqa: UP007


def _read(kind: Any, prog: str, argv: Sequence[str], description: str | None = None) -> Any:
    """Lets tyro read `argv`. What it prints on standard error about a wrong line becomes an InputError."""
    printed = io.StringIO()
    try:
        with contextlib.redirect_stderr(printed):
            return tyro.cli(kind, prog=prog, args=argv, description=description, config=MARKERS)
    except SystemExit as stop:
        if not stop.code:
            raise
        remedy = f"{prog} --help-all lists the options." if " " in prog else f"{prog} --help lists the verbs."
        raise InputError(prog, _sentence(printed.getvalue(), prog), remedy=remedy) from None


def _sentence(box: str, prog: str) -> str:
    """Returns the message of a box that tyro draws: its first part, and the options that were perhaps meant."""
    parts = [""]
    for row in re.sub(r"\x1b\[[0-9;]*m", "", box).splitlines()[1:]:  # without colours and title
        row = row.strip("│").rstrip("╯╰ ")
        if set(row) <= set(" ─-"):
            parts.append("")
        elif not row.startswith(" " * 9):  # a help text
            parts[-1] += f" {row.strip()}"
    message, *more = filter(None, parts)
    message = message.strip().replace(f"Missing from {prog}:", "Missing:")
    if (values := re.match(r"Error parsing (\S+):.*?(\['.*?'\]|'[^']*')", message)) is not None:
        words = " ".join(re.findall("'([^']*)'", values[2]))
        message = f"{values[1]} does not take {words!r}"
    more = [part.strip() for part in more if part.startswith((" Perhaps", " Unrecognized"))]
    return ". ".join([message.rstrip("."), *more])


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """Yields an error, and those during whose handling it was raised."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _finish(output: Output, result: VerbResult, code: int = 0) -> int:
    """Prints errors, and with --json the result, with the last error as "error"; returns 2 if there are any."""
    errors = result.get("errors", ())
    for error in errors:
        if output.debug:
            traceback.print_exception(error)
        if not output.json:
            print(f"jsecon: {error}", file=sys.stderr)
    if output.json:
        fields = {name: value for name, value in result.items() if name != "errors" or len(errors) > 1}
        if errors:
            fields["error"] = errors[-1]
        print(json.dumps(fields, default=_to_json), flush=True)
    return 2 if errors else code


def _to_json(value: Any) -> Any:
    """Returns an error, a record or a path as JSON takes it."""
    if isinstance(value, InputError):
        parts = {name: getattr(value, name) for name in ("where", "problem", "expected", "remedy")}
        return {"message": str(value)} | parts
    return vars(value) if dataclasses.is_dataclass(value) else str(value)


def _completion(verb: Completion, console: Console) -> VerbResult:
    """Prints the script that completes verbs, options, choices and paths in a shell.

    shtab makes it from tyro's parser. The scripts of tyro 1.0 itself do not complete positional arguments, such as the
    path of a capture, and start Python at each key press.
    """
    import shtab

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # tyro names no other way to a parser
        parser: Any = tyro.extras.get_parser(_all_verbs(), prog="jsecon", config=MARKERS)
    script = shtab.complete(parser, verb.shell)
    console.say(script)
    return {"shell": verb.shell, "script": script}


def _act(module: str) -> Callable[[Any, Console], VerbResult]:
    """Returns the function that does the work of a verb; its module is imported when it is called."""

    def act(verb: Verb, console: Console) -> VerbResult:
        name = type(verb).__name__.lower()
        with console.progress("start"):
            try:
                work = importlib.import_module(f"jsecon.{module}").VERBS[type(verb)]
            except ModuleNotFoundError as error:
                if not verb.extra:
                    raise
                problem = f"the package {str(error.name).partition('.')[0]} is missing"
                remedy = f'Run: pip install "jsecon[{verb.extra}]"'
                raise InputError(f"jsecon {name}", problem, remedy=remedy) from error
        return work(verb, console)

    return act


_VERBS: dict[str, tuple[Callable[[Any, Console], VerbResult], type[Verb]]] = {
    **{kind.__name__.lower(): (_act(module), kind) for kind, module in VERBS.items()},
    "completion": (_completion, Completion),
}
VERB_NAMES = tuple(_VERBS)
"""in the order of the help"""
