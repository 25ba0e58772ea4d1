"""Help texts of the verbs: the short one of --help, which fits a screen, and the whole one of --help-all.

The short help has the options that are not `Advanced`, in one list, with the first sentence of each. tyro prints it
from a dataclass that is made for the purpose.
"""

import dataclasses
import inspect
import re
import shutil
import textwrap
from typing import Any, get_type_hints

import docstring_parser

from jsecon.app.models import help_table
from jsecon.app.verbs import Run
from jsecon.pipeline.options import ADVANCED

MAX_WIDTH = 100
"""columns that a description takes at most"""


def description(kind: Any, *, whole: bool) -> str:
    """Describes a verb: what it does, examples, and how to see all options.

    Args:
      kind: Class of the verb.
      whole: Whether the whole description follows the first sentence.
    """
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


def common_options(kind: Any) -> Any:
    """Makes a dataclass of the options of a verb that are not advanced, with one sentence for each.

    Args:
      kind: Class of the verb. The options of its groups come after its own.

    Returns:
      A class whose help text tyro prints. Its values are of no use.
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
