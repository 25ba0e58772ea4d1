"""Queries of several texts in words: `"red mug" or "bowl" but not "handle"`. Host code."""

import re
from typing import NamedTuple

from jsecon.errors import InputError

_QUOTES = "\"'“”"
_QUOTED = re.compile(r"""(?<!\S)(?:"[^"]+"|'.+?'|“[^”]+”)(?!\S)""", re.DOTALL)
"""A text in quotes; an apostrophe within a word is not a quote."""
_JOINED = re.compile(r"\s+(?:(but\s+not)|or)(?=\s)", re.IGNORECASE)
"""What stands between the texts of a query."""


class QueryTexts(NamedTuple):
    """The texts of a query."""

    included: list[str]
    """Texts whose regions match; at least one."""
    excluded: list[str]
    """Texts whose regions are left out."""


def parse_query(query: str) -> QueryTexts:
    """Splits a query such as `"red mug" or "bowl" but not "handle"` into its texts.

    Args:
      query: Quotes are optional. They are removed, and "or" and "but not" between a pair of them belong to the text:
        "tea or coffee" in quotes is one text.

    Returns:
      The texts to include, and those to exclude.

    Raises:
      InputError: A part is empty, or the query is not UTF-8.
    """
    if re.search("[\ud800-\udfff]", query):
        remedy = "Type it in a terminal, or send it from a program, that uses UTF-8."
        raise InputError("", f"the text {query!r} is not UTF-8", remedy=remedy)
    query = query.strip()
    quoted = [match.span() for match in _QUOTED.finditer(query)]
    parts, side, start = ([], []), 0, 0
    for word in _JOINED.finditer(query):
        if not any(first < word.start() < last for first, last in quoted):
            parts[side].append(query[start : word.start()])
            side, start = max(side, int(word[1] is not None)), word.end()
    parts[side].append(query[start:])
    included, excluded = ([part.strip().strip(_QUOTES).strip() for part in texts] for texts in parts)
    if not all(included + excluded) or re.match(r"but not\b", query, re.IGNORECASE):
        remedy = 'For example: "red mug" or "bowl" but not "handle"'
        raise InputError(f"query {query!r}", "a part without words", 'texts joined by "or" and "but not"', remedy)
    return QueryTexts(included, excluded)
