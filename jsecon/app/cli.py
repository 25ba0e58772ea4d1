"""The command line: finds the verb, lets tyro read its options, and runs it.

Bad input ends in one message and exit code 2, Ctrl-C in exit code 130. verbs.py has the options of each verb, and names
the module that does its work.
"""

import contextlib
import dataclasses
import difflib
import gc
import importlib
import inspect
import io
import json
import re
import sys
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Union

import tyro

import jsecon
from jsecon.app.verbs import VERBS, Verb, VerbResult
from jsecon.errors import InputError, describe_error, is_out_of_memory, machine_error
from jsecon.pipeline.options import check_ranges
from jsecon.pipeline.progress import Console


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line.

    Args:
      argv: Arguments behind the program's name; by default those of the process.

    Returns:
      The exit code.
    """
    argv = sys.argv[1:] if argv is None else list(argv)
    as_json = "--json" in argv  # also for a line that cannot be read
    try:
        if argv == ["--version"]:
            print(f"jsecon {jsecon.__version__}")
            return 0
        verb = parse(argv)
        as_json = verb.json
        result = _run_verb(verb, Console(sys.stderr if as_json else sys.stdout, sys.stderr))
    except SystemExit as stop:  # --help
        return int(stop.code or 0)
    except (KeyboardInterrupt, Exception) as error:
        if any(isinstance(cause, KeyboardInterrupt) for cause in _causes(error)):  # libraries make errors of stops
            remedy = "Run the same command again to resume."
            print(f"\njsecon: interrupted. {remedy}", file=sys.stderr)
            result = {"error": InputError("", "interrupted", remedy=remedy)}
            return _finish(as_json, result, 130)
        if is_out_of_memory(error):
            remedy = "End other programs, run with smaller or fewer frames (--long-side, --frames), or add memory."
            error = InputError("", f"memory has no room left ({str(error)[:200]})", remedy=remedy)
        error = machine_error(error, "") or error
        if isinstance(error, InputError):
            return _finish(as_json, {"errors": [error]})
        # a bug, whose trace the interpreter prints
        remedy = "Report it with the trace on standard error."
        _finish(as_json, {"error": InputError("jsecon", f"internal error: {describe_error(error)}", remedy=remedy)})
        raise
    then = result.pop("then", lambda: None)
    code = _finish(as_json, result)
    with contextlib.suppress(KeyboardInterrupt):  # so a server ends
        then()
    return code


def parse(argv: Sequence[str]) -> Verb:
    """Reads a command line: the arguments behind the program's name, the verb first."""
    if argv and argv[0] in _VERBS:  # one verb alone is read ten times faster than all
        kind = _VERBS[argv[0]]
        examples = "\n".join(["examples", *(f"  {line}" for line in kind.examples)])
        verb = _read(kind, f"jsecon {argv[0]}", argv[1:], description=f"{_summary(kind)}\n\n{examples}")
        check_ranges(verb)
        return verb
    if argv and not argv[0].startswith("-"):
        similar = "".join(f"Did you mean {name}? " for name in difflib.get_close_matches(argv[0], _VERBS, 1))
        raise InputError("jsecon", f"{argv[0]} is not a verb", remedy=f"{similar}jsecon --help lists the verbs.")
    about = "Finds things in 3D Gaussian scenes by text, at the level of points, on a plain CPU."
    ending = """jsecon VERB --help has the options of a verb. Repeat the command of a stopped run to resume it.
jsecon --version prints the version."""
    examples = "\n".join(["examples", *(f"  {kind.examples[0]}" for kind in VERBS)])
    return _read(_all_verbs(), "jsecon", argv, description=f"{about}\n\n{examples}\n\n{ending}")


def _summary(kind: type[Verb]) -> str:
    """Returns what a verb does: its docstring without the section of the options."""
    return (inspect.getdoc(kind) or "").partition("\n\nAttributes:")[0]


def _all_verbs() -> Any:
    """Returns the union of the verbs, of which tyro makes subcommands, with the first line of each description."""
    kinds = []
    for name, kind in _VERBS.items():
        first_line = _summary(kind).partition("\n")[0]
        kinds.append(Annotated[kind, tyro.conf.subcommand(name=name, description=first_line, prefix_name=False)])
    return Union[tuple(kinds)]  # noqa: UP007


def _read(kind: Any, prog: str, argv: Sequence[str], description: str | None = None) -> Any:
    """Lets tyro read `argv`. What it prints on standard error about a wrong line becomes an InputError."""
    printed = io.StringIO()
    try:
        with contextlib.redirect_stderr(printed):
            conf = tyro.conf
            markers = conf.DisallowNone, conf.FlagCreatePairsOff, conf.PositionalMetavarFromFieldName
            return tyro.cli(kind, prog=prog, args=argv, description=description, config=markers)
    except SystemExit as stop:
        if not stop.code:
            raise
        remedy = f"{prog} --help lists the options." if " " in prog else f"{prog} --help lists the verbs."
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


def _finish(as_json: bool, result: VerbResult, code: int = 0) -> int:
    """Prints errors, or as JSON the result, with the last error as "error"; returns 2 if there are any."""
    errors = result.get("errors", ())
    if as_json:
        fields = {name: value for name, value in result.items() if name != "errors" or len(errors) > 1}
        if errors:
            fields["error"] = errors[-1]
        print(json.dumps(fields, default=_to_json), flush=True)
    else:
        for error in errors:
            print(f"jsecon: {error}", file=sys.stderr)
    return 2 if errors else code


def _to_json(value: Any) -> Any:
    """Returns an error, a record or a path as JSON takes it."""
    if isinstance(value, InputError):
        parts = {name: getattr(value, name) for name in ("where", "problem", "expected", "remedy")}
        return {"message": str(value)} | parts
    return vars(value) if dataclasses.is_dataclass(value) else str(value)


def _run_verb(verb: Verb, console: Console) -> VerbResult:
    """Imports the module that does the work of a verb, and runs it."""
    name = type(verb).__name__.lower()
    module, function = VERBS[type(verb)].split(":")
    with console.progress("start"):
        gc.disable()  # imports make much and free little: a sixth of their time
        try:
            work = getattr(importlib.import_module(f"jsecon.{module}"), function)
        except ModuleNotFoundError as error:
            if not verb.extra:
                raise
            problem = f"the package {str(error.name).partition('.')[0]} is missing"
            raise InputError(f"jsecon {name}", problem, remedy=f'Run: pip install "jsecon[{verb.extra}]"') from error
        finally:
            gc.freeze()  # later collections need not look at modules
            gc.enable()
    return work(verb, console)


_VERBS: dict[str, type[Verb]] = {kind.__name__.lower(): kind for kind in VERBS}
