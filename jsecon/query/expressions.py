"""Referring expressions: a small grammar for things that are told apart by where they are. No language model.

    expression  [how many | count | find | show me | where is | which is] thing [relation thing [[and] relation thing]]
    relation    left of, on top of, near ... (RELATIONS); between THING and THING, or between two THINGS
    thing       [the | a | all | both | NUMBER] [ORDINAL] [ORDER] object [ORDER]
    ORDER       before the object: largest, second tallest ...; behind it: "from the left", "on the right" (ORDERS)
    object      any other words, which an embedder reads

In "the mug on the table left of the bottle", the second relation may belong to the mug or to the table:
`Expression.readings` has both. With "and" before it, it belongs to the mug. Words in quotes are part of an object. A
word that looks like a relation or an order and is none of the grammar's is an error.
"""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from jsecon.errors import InputError


def _words(text: str) -> frozenset[str]:
    """Returns the words of a text."""
    return frozenset(text.split())


MAX_WORDS = 60
"""words of an expression"""
MAX_RELATIONS = 2
"""relations of an expression"""
RELATIONS = {
    "left of": "left of|to the left of|on the left of|on the left side of|at the left of",
    "right of": "right of|to the right of|on the right of|on the right side of|at the right of",
    "in front of": "in front of",
    "behind": "behind|in back of|at the back of",
    "above": "above|over",
    "below": "below",
    "on": "on|on top of|atop|upon|standing on|lying on|sitting on|resting on|placed on",
    "under": "under|underneath|beneath",
    "in": "in|inside|inside of|within|contained in",
    "next to": "next to|beside|alongside|adjacent to",
    "near": "near|near to|close to",
    "far from": "far from|far away from",
    "touching": "touching|in contact with",
    "between": "between|in between",
    "nearest to": "nearest to|nearest|closest to|closest",
    "farthest from": "farthest from|furthest from|farthest away from|furthest away from",
}
"""relation -> its spellings"""
ANCHORED_ORDERS = ("nearest to", "farthest from")
"""relations that choose one thing by its distance from another"""
ORDERS = {
    "largest": "largest|biggest",
    "smallest": "smallest|tiniest",
    "tallest": "tallest",
    "shortest": "shortest",
    "highest": "highest|topmost|uppermost|from the top|at the top",
    "lowest": "lowest|bottommost|lowermost|from the bottom|at the bottom",
    "leftmost": "leftmost|from the left|on the left|to the left|on the left side",
    "rightmost": "rightmost|from the right|on the right|to the right|on the right side",
    "nearest": "nearest|closest|frontmost|foremost|from the front|in front|at the front|in the front",
    "farthest": "farthest|furthest|rearmost|hindmost|from the back|at the back|in the back",
}
"""order -> its spellings: those of one word stand before the object, the others behind it"""
ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth")
NUMBERS = ("one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")
_UNKNOWN = _words(
    """across around along against among amongst amid beyond opposite outside through throughout toward towards facing
    past onto surrounding surrounded by left right front back top bottom middle centre center hanging leaning parallel
    perpendicular north south east west nearby before after away last next most least"""
)
"""words that look like relations or orders and are none of the grammar's"""
_NOUNS_IN_EST = _words("chest vest nest forest guest test rest crest harvest pest quest priest protest")
"""words that end like superlatives and are none"""
_DETERMINERS = _words("the a an any my your our this that these those some")
_EVERY = _words("all every each both")
_FILLERS = _words("that which is are there stands standing lies lying located placed sits sitting")
"""words before a relation that add nothing to it"""
_QUESTIONS = ("how many", "count of", "count", "where is", "where are", "which is", "which are", "which", "what is")
_QUESTIONS += ("find", "show me", "show", "select")
_QUOTED = re.compile(r"""(?<!\S)(?:"([^"]+)"|'(.+?)'|“([^”]+)”)(?=[\s,.?!]|$)""", re.DOTALL)
_REMEDY = 'For example "the red mug left of the bottle". Words of an object that look like these go in quotes.'


class _Token(NamedTuple):
    """A word, or words in quotes."""

    text: str
    key: str
    """the word in lower case; empty for words in quotes"""


@dataclasses.dataclass(frozen=True)
class Thing:
    """An object as it is named.

    Attributes:
      text: Words for the embedder.
      order: One of ORDERS, or None.
      rank: Place in the order, 1 for the first.
      number: How many there are said to be, or None.
      every: Whether all that match are meant, instead of one.
    """

    text: str
    order: str | None = None
    rank: int = 1
    number: int | None = None
    every: bool = False


@dataclasses.dataclass(frozen=True)
class Condition:
    """A relation to other objects.

    Attributes:
      relation: One of RELATIONS.
      anchors: The object, or the two objects of "between"; one with `every` stands for both of these.
      conditions: Conditions of the last anchor.
    """

    relation: str
    anchors: tuple[Thing, ...]
    conditions: tuple["Condition", ...] = ()

    def __str__(self) -> str:
        """The condition in words."""
        own = f"{self.relation} {' and '.join(anchor.text for anchor in self.anchors)}"
        return own + "".join(f" that is {condition}" for condition in self.conditions)


@dataclasses.dataclass(frozen=True)
class Expression:
    """What a text asks for.

    Attributes:
      text: The text.
      thing: The object that is looked for.
      conditions: Its relations, in the order of the text.
      joined: Whether all conditions belong to the object for certain.
      counted: Whether the text asks for the number of objects.
    """

    text: str
    thing: Thing
    conditions: tuple[Condition, ...] = ()
    joined: bool = False
    counted: bool = False

    @property
    def words(self) -> set[str]:
        """The relations and orders of the expression."""
        things = [self.thing, *(anchor for condition in self.conditions for anchor in condition.anchors)]
        return {c.relation for c in self.conditions} | {thing.order for thing in things if thing.order is not None}

    def readings(self) -> list[tuple[Condition, ...]]:
        """Lists the ways to attach the relations to the objects.

        Returns:
          The conditions of the object: all of them first; then, if the text allows it, the second as one of the first
          one's anchor.
        """
        readings = [self.conditions]
        if len(self.conditions) > 1 and not self.joined:
            first, second = self.conditions
            readings.append((dataclasses.replace(first, conditions=(second,)),))
        return readings

    def describe(self, conditions: Sequence[Condition] | None = None) -> str:
        """Describes how the text is read.

        Args:
          conditions: One of `readings`, by default the first.

        Returns:
          The object, its conditions and its order, in words.
        """
        thing = self.thing
        order = [] if thing.order is None else [f"{_ordinal(thing.rank)}{thing.order}"]
        conditions = self.conditions if conditions is None else conditions
        return ", ".join([f"{thing.text!r}", *map(str, conditions), *order])


def _ordinal(rank: int) -> str:
    """Returns the rank as a word before an order, "" for the first."""
    return "" if rank == 1 else f"{ORDINALS[rank - 1]} "


def _spellings(table: Mapping[str, str]) -> dict[tuple[str, ...], str]:
    """Returns words -> name of a table of spellings."""
    return {tuple(words.split()): name for name, row in table.items() for words in row.split("|")}


_RELATION_OF = _spellings(RELATIONS)
_ORDER_OF = _spellings(ORDERS)


def is_expression(text: str) -> bool:
    """Finds out whether a text needs the grammar.

    Args:
      text: Any text.

    Returns:
      True if it has a relation, an order or a number of the grammar outside of quotes.
    """
    tokens = _tokens(text)
    _, rest = _question(tokens)
    counted = len(rest) < len(tokens) and tokens[0].key in ("how", "count")
    numbered = len(rest) > 1 and (rest[0].key in _EVERY or _number(rest[0].key) is not None)
    spelled = any(_longest(rest, i, {**_RELATION_OF, **_ORDER_OF}) for i in range(len(rest)))
    return counted or numbered or spelled


def parse_expression(text: str) -> Expression:
    """Parses a text by the grammar of this module.

    Args:
      text: For example "the second red mug from the left" or "two bottles between the plate and the bowl".

    Returns:
      The expression. A text without relation, order or number is an object alone.

    Raises:
      InputError: The text is empty, too long or not UTF-8, has a relation without an object, or a word that looks
        like a relation and is none.
    """
    if re.search("[\ud800-\udfff]", text):
        raise InputError("", f"the text {text!r} is not UTF-8", remedy="Send it from a program that uses UTF-8.")
    tokens = _tokens(text)
    if not tokens:
        raise InputError("expression", "the text is empty", remedy=_REMEDY)
    if len(tokens) > MAX_WORDS:
        problem = f"the text has {len(tokens)} words, and an expression at most {MAX_WORDS}"
        raise InputError("expression", problem, remedy="Ask for one object and its relations to others.")
    for token in tokens:
        if token.key == "or":
            problem = '"or" cannot be combined with relations, orders and numbers'
            raise InputError(f"expression {text!r}", problem, remedy=f"Ask for each alone. {_REMEDY}")
    counted, tokens = _question(tokens)
    parts, relations, joined = _split(tokens, text)
    thing = _thing(parts[0], text)
    conditions = []
    for relation, part in zip(relations, parts[1:]):
        anchors = [part]
        if relation == "between" and (middle := [i for i, token in enumerate(part) if token.key == "and"]):
            anchors = [part[: middle[0]], part[middle[0] + 1 :]]
        things = [_thing(anchor, text) for anchor in anchors]
        if relation == "between" and len(things) == 1:
            things = [dataclasses.replace(things[0], every=True)]
        conditions.append(Condition(relation, tuple(things)))
    if counted:
        thing = dataclasses.replace(thing, every=True)
    return Expression(text, thing, tuple(conditions), joined, counted)


def _tokens(text: str) -> list[_Token]:
    """Splits a text into words, and words in quotes."""
    tokens, start = [], 0
    for match in [*_QUOTED.finditer(text), None]:
        end = len(text) if match is None else match.start()
        words = (word.strip(",;:.?!") for word in text[start:end].split())
        tokens += [_Token(word, word.lower()) for word in words if word]
        if match is not None:
            tokens.append(_Token(next(filter(None, match.groups())).strip(), ""))
            start = match.end()
    return [token for token in tokens if token.text]


def _longest(tokens: Sequence[_Token], start: int, table: Mapping[tuple[str, ...], str]) -> tuple[str, ...] | None:
    """Returns the longest spelling of a table that begins at a token, or None."""
    for length in range(min(5, len(tokens) - start), 0, -1):
        words = tuple(token.key for token in tokens[start : start + length])
        if words in table:
            return words
    return None


def _question(tokens: list[_Token]) -> tuple[bool, list[_Token]]:
    """Returns whether a text asks for a number, and its words without those of the question."""
    keys = " ".join(token.key for token in tokens[:2])
    for words in _QUESTIONS:
        length = len(words.split())
        if keys == words or (keys.split()[:length] == words.split() and len(tokens) > length):
            return words.startswith(("how", "count")), tokens[length:]
    return False, tokens


def _number(key: str) -> int | None:
    """Returns the number that a word is, or None."""
    if key in NUMBERS:
        return NUMBERS.index(key) + 1
    return int(key) if re.fullmatch("[0-9]{1,3}", key) else None


def _split(tokens: list[_Token], text: str) -> tuple[list[list[_Token]], list[str], bool]:
    """Splits words into those of the objects and the relations between them."""
    parts: list[list[_Token]] = [[]]
    relations: list[str] = []
    joined = False
    place = 0
    while place < len(tokens):
        words = _longest(tokens, place, {**_RELATION_OF, **_ORDER_OF})
        relation = None if words is None else _RELATION_OF.get(words)
        named = any(token.key not in _DETERMINERS | _EVERY | set(ORDINALS) for token in parts[-1])
        if relation in ANCHORED_ORDERS and words is not None and len(words) == 1 and not named:
            relation = None  # "the nearest mug": an order before the object
        if relation is None:
            step = len(words) if words is not None and len(words) > 1 else 1
            parts[-1] += tokens[place : place + step]
            place += step
            continue
        assert words is not None
        while parts[-1] and parts[-1][-1].key in _FILLERS:
            parts[-1].pop()
        if relations and parts[-1] and parts[-1][-1].key == "and":
            parts[-1].pop()
            joined = True
        if not named or not parts[-1]:
            raise InputError(f"expression {text!r}", f"no object stands before {' '.join(words)!r}", remedy=_REMEDY)
        relations.append(relation)
        parts.append([])
        place += len(words)
    if len(relations) > MAX_RELATIONS:
        problem = f"it has {len(relations)} relations ({', '.join(relations)}), and {MAX_RELATIONS} are understood"
        raise InputError(f"expression {text!r}", problem, remedy=f"Ask for a part of it. {_REMEDY}")
    return (*_with_late_anchor(parts, relations), joined)


def _with_late_anchor(parts: list[list[_Token]], relations: list[str]) -> tuple[list[list[_Token]], list[str]]:
    """Makes a relation of an order whose anchor follows the object, as in "the nearest mug to the bottle"."""
    head = parts[0]
    orders = [i for i, token in enumerate(head) if _ORDER_OF.get((token.key,)) in ("nearest", "farthest")]
    ends = [i for i, token in enumerate(head) if token.key in ("to", "from")]
    late = [i for i in ends if orders and i > orders[0] + 1 and _longest(head, i, _ORDER_OF) is None]
    if not late or relations:
        return parts, relations
    relation = "nearest to" if _ORDER_OF[(head[orders[0]].key,)] == "nearest" else "farthest from"
    anchor = head[late[0] + 1 :]
    return [head[: orders[0]] + head[orders[0] + 1 : late[0]], anchor], [relation]


def _thing(tokens: list[_Token], text: str) -> Thing:
    """Reads an object with its determiner, number and order."""
    order, number, every, rank = None, None, False, None
    while tokens and tokens[-1].key in _FILLERS | {"and"}:
        tokens = tokens[:-1]
    for start in range(len(tokens)):  # an order behind the object
        words = _longest(tokens, start, _ORDER_OF)
        if words is not None and len(words) > 1 and start + len(words) == len(tokens) and start > 0:
            order, tokens = _ORDER_OF[words], tokens[:start]
            break
    while tokens and tokens[-1].key in _FILLERS:
        tokens = tokens[:-1]
    while len(tokens) > 1:
        key = tokens[0].key
        if key in _EVERY:
            every = True
            number = 2 if key == "both" else number
        elif _number(key) is not None and number is None:
            number = _number(key)
        elif rank is None and (key in ORDINALS or re.fullmatch("([1-9]|10)(st|nd|rd|th)", key)):
            rank = ORDINALS.index(key) + 1 if key in ORDINALS else int(key[:-2])
        elif order is None and (key,) in _ORDER_OF:
            order = _ORDER_OF[(key,)]
        elif key not in _DETERMINERS and not (key == "of" and (every or number or order)):
            break
        tokens = tokens[1:]
    where = f"expression {text!r}"
    for token in tokens:
        superlative = re.fullmatch("[a-z]+est", token.key) and len(token.key) > 4 and token.key not in _NOUNS_IN_EST
        if token.key in _UNKNOWN or superlative or (token.key,) in _ORDER_OF:
            problem = f"the word {token.text!r} is not understood as a relation or an order"
            raise InputError(where, problem, remedy=f"Understood are {', '.join([*RELATIONS, *ORDERS])}. {_REMEDY}")
    words = " ".join(token.text for token in tokens)
    if not tokens or (len(tokens) == 1 and tokens[0].key in _DETERMINERS | _EVERY):
        raise InputError(where, "an object is missing", remedy=_REMEDY)
    if rank is not None and order is None:
        problem = f"{ORDINALS[rank - 1]!r} needs an order, such as 'from the left' or 'largest'"
        raise InputError(where, problem, remedy=_REMEDY)
    if number == 1 and not every:
        number = None if order is not None else number
    keys = [token.key for token in tokens]
    last = keys[keys.index("of", 1) - 1 if "of" in keys[1:] else -1]
    plural = last.endswith("s") and not last.endswith(("ss", "us", "is"))
    chosen = order is not None and not (number or 0) > 1
    return Thing(words, order, rank or 1, number, not chosen and (every or plural or (number or 0) > 1))
