"""Command-line arguments made from a dataclass: the docstring beneath a field is its help, its type what it takes.

What a type does not say stands beside it: `Annotated[int, {"metavar": "N", "least": 1}]` holds keywords of
`add_argument`, and two of its own, `least` and `positional`.
"""

import argparse
import ast
import dataclasses
import functools
import inspect
import itertools
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any, Literal


@dataclasses.dataclass(frozen=True)
class Argument:
    """One field of a dataclass, as the command line takes it."""

    name: str
    help: str
    positional: bool
    least: int | float | None
    """the smallest number allowed; None: any."""
    keywords: Mapping[str, Any]
    """of `add_argument`."""

    @property
    def flag(self) -> str:
        """--sh-degree, for example; CAPTURE where it is positional."""
        return self.name.upper() if self.positional else f"--{self.name.replace('_', '-')}"


@functools.cache
def arguments_of(kind: type) -> tuple[Argument, ...]:
    """The fields of a dataclass as arguments, in order, those that must be given first."""
    hints, helps = typing.get_type_hints(kind, include_extras=True), _docstrings(kind)
    fields = sorted(dataclasses.fields(kind), key=lambda field: field.default is not dataclasses.MISSING)
    return tuple(_argument(field, hints[field.name], helps[field.name]) for field in fields)


def add_arguments(parser: argparse.ArgumentParser, kind: type, groups: Mapping[str, str] | None = None) -> None:
    """Gives a parser the fields of a dataclass; `groups` holds the heading above a field and those that follow it."""
    group: Any = parser
    for argument in arguments_of(kind):
        if argument.name in (groups or {}):
            group = parser.add_argument_group((groups or {})[argument.name])
        name = argument.name if argument.positional else argument.flag
        group.add_argument(name, help=argument.help, **argument.keywords)


def parsed(kind: type, arguments: argparse.Namespace) -> Any:
    """The dataclass with what was given on the command line."""
    return kind(**{field.name: getattr(arguments, field.name) for field in dataclasses.fields(kind)})


def _argument(field: dataclasses.Field, hint: Any, text: str) -> Argument:
    stated: dict[str, Any] = {}
    if typing.get_origin(hint) is typing.Annotated:
        hint, stated = typing.get_args(hint)
    positional = stated.get("positional", False)
    keywords: dict[str, Any] = {"metavar": field.name.upper()} if positional else {}
    if hint is bool:
        keywords["action"] = "store_true"
    elif typing.get_origin(hint) is Literal:
        keywords["choices"] = typing.get_args(hint)
    elif "nargs" not in stated and "action" not in stated:
        keywords["type"] = _reader([part for part in typing.get_args(hint) or [hint] if part is not types.NoneType])
    if field.default is dataclasses.MISSING:
        keywords |= {} if positional else {"required": True}
    else:
        keywords["default"] = field.default
        text += " (default %(default)s)" if field.default is not None and hint is not bool else ""
    keywords |= {name: value for name, value in stated.items() if name not in ("positional", "least")}
    return Argument(field.name, text, positional, stated.get("least"), keywords)


def _reader(parts: Sequence[Any]) -> Any:
    """str -> a value of the first type; words of a Literal among the types stand for themselves."""
    words = {word for part in parts[1:] for word in typing.get_args(part)}

    def read(text: str) -> Any:
        return text if text in words else parts[0](text)

    read.__name__ = parts[0].__name__  # what argparse calls it: "invalid int value"
    return read


def _docstrings(kind: type) -> dict[str, str]:
    """field -> the string beneath it, on one line; inherited ones too."""
    found: dict[str, str] = {}
    for base in kind.__mro__[-2::-1]:
        found |= _own_docstrings(base)
    return found


@functools.cache
def _own_docstrings(kind: type) -> dict[str, str]:
    found: dict[str, str] = {}
    body = typing.cast(ast.ClassDef, ast.parse(inspect.getsource(kind)).body[0]).body
    for field, beneath in itertools.pairwise(body):
        if isinstance(field, ast.AnnAssign) and isinstance(beneath, ast.Expr):
            found[ast.unparse(field.target)] = " ".join(ast.literal_eval(beneath.value).split())
    return found
