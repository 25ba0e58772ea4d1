"""Every option of every verb that takes a number refuses one that it cannot use, in one sentence, before any work."""

import dataclasses
import math
import types
import typing
from typing import get_args, get_origin, get_type_hints

import pytest

from jsecon.app import cli
from jsecon.app.verbs import VERBS
from jsecon.errors import InputError
from jsecon.pipeline.options import Range, check_ranges
from jsecon.pipeline.run import Options

VALUES = ["-1", "0", "nan", "inf", "1e12", str(10**12)]


def number_types(hint) -> list[type]:
    """The types of one value of an option, in order; of alternatives the first that has numbers."""
    if get_origin(hint) is typing.Annotated:
        return number_types(get_args(hint)[0])
    if get_origin(hint) in (typing.Union, types.UnionType):
        return next((kinds for kinds in map(number_types, get_args(hint)) if {int, float} & set(kinds)), [])
    if get_origin(hint) in (tuple, list):
        return [kind for part in get_args(hint) for kind in number_types(part)]
    return [hint] if hint in (int, float, str) else []


def numeric_options(kind, verb):
    """(verb, flag, types of its values, range) of a verb's options that take numbers, those of its groups too."""
    hints = get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        if dataclasses.is_dataclass(hints[field.name]):
            yield from numeric_options(hints[field.name], verb)
        elif {int, float} & set(kinds := number_types(hints[field.name])):
            (allowed,) = (mark for mark in hints[field.name].__metadata__ if isinstance(mark, Range))
            yield verb, f"--{field.name.replace('_', '-')}", kinds, allowed


OPTIONS = [option for kind in VERBS for option in numeric_options(kind, kind)]
REQUIRED = {"out": ["--out", "out"], "labels": ["--labels", "labels"]}


def command(verb) -> list[str]:
    """The least command line of a verb: its positional arguments and options without a default."""
    line = [verb.__name__.lower()]
    for field in dataclasses.fields(verb):
        if field.default is field.default_factory is dataclasses.MISSING:
            line += REQUIRED.get(field.name, ["list" if field.name == "action" else "input"])
    return line


@pytest.mark.parametrize(("verb", "flag", "kinds", "allowed"), OPTIONS, ids=lambda x: x if isinstance(x, str) else "")
def test_a_number_out_of_range_is_refused_at_once(verb, flag, kinds, allowed, capsys):
    for value in VALUES:
        is_whole = value.lstrip("-").isdigit()
        written = [value if kind in (int, float) else "frame" for kind in kinds]
        fits = float(value) in allowed
        if fits and (is_whole or int not in kinds):
            cli.parse([*command(verb), flag, *written])
        else:
            assert cli.main([*command(verb), flag, *written]) == 2
            error = capsys.readouterr().err
            assert error.startswith("jsecon")
            assert error.count("\n") == 1
            assert flag in error


def test_ranges_hold_for_options_in_python_too(room):
    for changes in ({"seed": -1}, {"minutes": math.inf}, {"agreement": 0.0}):
        with pytest.raises(InputError, match="expected"):
            check_ranges(Options(room, **changes))
