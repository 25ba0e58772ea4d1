"""What a text asks for: several texts, or a referring expression that tells things apart by where they are.

`parse_query` splits texts that are joined by words: "red mug" or "bowl" but not "handle". `parse_expression` reads a
small grammar. There is no language model.

    expression  [how many | count | find | show me | where is | which is] thing [relation thing [[and] relation thing]]
    relation    left of, on top of, near ...; between THING and THING, or between two THINGS
    thing       [the | a | all | both | NUMBER] [ORDINAL] [ORDER] object [ORDER]
    ORDER       before the object: largest, second tallest ...; behind it: "from the left", "on the right"
    object      any other words, which an embedder reads

The words are in lexicon.toml. Everyday names contain many of them: "first aid kit", "one way sign", "under cabinet
light", "carry on bag". A word of the grammar therefore belongs to a name where it does no work:

    a number or "all"     unless a plural follows, or where it binds the next word ("two way mirrors")
    an ordinal            without an order, or where it binds the next word ("first aid kit on the left")
    a preposition         at the beginning without "the" ("under cabinet light"), or after a verb ("carry on bag")

In "the mug on the table left of the bottle", the second relation may belong to the mug or to the table:
`Expression.readings` has both. With "and" before it, it belongs to the mug. Words in quotes are part of an object. A
word that looks like a relation or an order and is none of the grammar's is an error.
"""

import dataclasses
import re
import tomllib
from collections.abc import Container, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from jsecon.errors import InputError

_LEXICON = tomllib.loads(Path(__file__).with_name("lexicon.toml").read_text())
_WORDS = {name: tuple(words.split()) for name, words in _LEXICON["words"].items()}
RELATIONS, ORDERS = _LEXICON["relations"], _LEXICON["orders"]
"""Relation or order -> its spellings."""
ANCHORED_ORDERS = ("nearest to", "farthest from")
"""Relations that choose one thing by its distance from another."""
MAX_WORDS, MAX_RELATIONS = 60, 2
"""Of an expression."""
_OF_VIEW = {"left of", "right of", "in front of", "behind", "leftmost", "rightmost", "nearest", "farthest"}
"""Relations and orders that depend on the viewpoint."""
_ORDINALS, _NUMBERS = _WORDS["ordinals"], _WORDS["numbers"]
_QUOTED = re.compile(r"""(?<!\S)(?:"([^"]+)"|'(.+?)'|“([^”]+)”)(?=[\s,.?!]|$)""", re.DOTALL)
"""A text in quotes; an apostrophe within a word is not a quote."""
_REMEDY = 'For example "the red mug left of the bottle". Words of an object that look like these go in quotes.'


def parse_query(query: str) -> tuple[list[str], list[str]]:
    """Splits a query such as `"red mug" or "bowl" but not "handle"` into texts to include, and texts to exclude.

    Quotes are optional. They are removed, and "or" and "but not" between a pair of them belong to the text: "tea or
    coffee" in quotes is one text. Raises InputError for a part without words, or a query that is not UTF-8.
    """
    _require_utf8(query)
    query = query.strip()
    quoted = [match.span() for match in _QUOTED.finditer(query)]
    parts, side, start = ([], []), 0, 0
    for word in re.finditer(r"\s+(?:(but\s+not)|or)(?=\s)", query, re.IGNORECASE):
        if not any(first < word.start() < last for first, last in quoted):
            parts[side].append(query[start : word.start()])
            side, start = max(side, int(word[1] is not None)), word.end()
    parts[side].append(query[start:])
    included, excluded = ([part.strip().strip("\"'“”").strip() for part in texts] for texts in parts)
    if not all(included + excluded) or re.match(r"but not\b", query, re.IGNORECASE):
        remedy = 'For example: "red mug" or "bowl" but not "handle"'
        raise InputError(f"query {query!r}", "a part without words", 'texts joined by "or" and "but not"', remedy)
    return included, excluded


def _require_utf8(text: str) -> None:
    if re.search("[\ud800-\udfff]", text):
        remedy = "Type it in a terminal, or send it from a program, that uses UTF-8."
        raise InputError("", f"the text {text!r} is not UTF-8", remedy=remedy)


class _Token(NamedTuple):
    """A word, or words that are one name."""

    text: str
    key: str
    """The word in lower case; empty for words in quotes, and for a name that stands as it is."""


@dataclasses.dataclass(frozen=True)
class NounPhrase:
    """An object as it is named."""

    text: str
    """Words for the embedder."""
    order: str | None = None
    """One of ORDERS, or None."""
    rank: int = 1
    """Place in the order, 1 for the first."""
    number: int | None = None
    """How many there are said to be, or None."""
    every: bool = False
    """Whether all that match are meant, instead of one."""


@dataclasses.dataclass(frozen=True)
class Condition:
    """A relation to other objects."""

    relation: str
    """One of RELATIONS."""
    anchors: tuple[NounPhrase, ...]
    """The object, or the two objects of "between"; one with `every` stands for both of these."""
    conditions: tuple["Condition", ...] = ()
    """Conditions of the last anchor."""

    def __str__(self) -> str:
        """The condition in words."""
        words = f"{self.relation} {' and '.join(anchor.text for anchor in self.anchors)}"
        return words + "".join(f" that is {condition}" for condition in self.conditions)


@dataclasses.dataclass(frozen=True)
class Expression:
    """What a text asks for."""

    thing: NounPhrase
    """The object that is looked for."""
    conditions: tuple[Condition, ...] = ()
    """Its relations, in the order of the text."""
    joined: bool = False
    """Whether all conditions belong to the object for certain."""
    depends_on_view: bool = False
    """Whether a relation or an order depends on the viewpoint."""

    def readings(self) -> list[tuple[Condition, ...]]:
        """Lists the ways to attach the relations to the objects.

        The conditions of the object are all of them first; then, if the text allows it, the second is one of the first
        one's anchor.
        """
        readings = [self.conditions]
        if len(self.conditions) > 1 and not self.joined:
            first, second = self.conditions
            readings.append((dataclasses.replace(first, conditions=(second,)),))
        return readings

    def describe(self, conditions: Sequence[Condition]) -> str:
        """Describes one of the `readings`: the object, its conditions and its order, in words."""
        rank = "" if self.thing.rank == 1 else f"{_ORDINALS[self.thing.rank - 1]} "
        order = [] if self.thing.order is None else [f"{rank}{self.thing.order}"]
        return ", ".join([f"{self.thing.text!r}", *map(str, conditions), *order])


def _spellings(table: Mapping[str, str]) -> dict[tuple[str, ...], str]:
    """Returns words -> name of a table of spellings."""
    return {tuple(words.split()): name for name, row in table.items() for words in row.split("|")}


_RELATION_OF, _ORDER_OF = _spellings(RELATIONS), _spellings(ORDERS)
_SPELLED = {**_RELATION_OF, **_ORDER_OF}
_FIXED_NAMES = {tuple(words.split()): "" for words in re.split(r"[|\n]", _LEXICON["names"]["fixed"])}
_FITTED = frozenset(_LEXICON["names"]["fitted"].split())
_QUANTIFIERS = {*_WORDS["determiners"], *_WORDS["every"], *_ORDINALS, *_NUMBERS}
_INDEFINITE = ("a", "an", "any", "some", "of")
_PREPOSITIONS = {words[0] for words in _RELATION_OF if len(words) == 1} - {"nearest", "closest"}


def is_expression(text: str) -> bool:
    """Whether a text needs the grammar: it has a relation, an order or a number outside of quotes and names."""
    counted, tokens = _question(_tokens(text))
    if counted or not tokens:
        return counted
    parts, relations, _, problem = _split(tokens)
    phrase, quantified, _ = _noun_phrase(parts[0])
    return bool(relations or problem or quantified or phrase.order)


def parse_expression(text: str) -> Expression:
    """Parses a text by the grammar of this module, such as "the second red mug from the left".

    A text without relation, order or number is an object alone. Raises InputError for a text that is empty, too long or
    not UTF-8, has a relation without an object, or a word that looks like a relation and is none.
    """
    _require_utf8(text)
    tokens = _tokens(text)
    where = f"expression {text!r}"
    if not tokens:
        raise InputError("expression", "the text is empty", remedy=_REMEDY)
    if len(tokens) > MAX_WORDS:
        problem = f"the text has {len(tokens)} words, and an expression at most {MAX_WORDS}"
        raise InputError("expression", problem, remedy="Ask for one object and its relations to others.")
    if any(token.key == "or" for token in tokens):
        problem = '"or" cannot be combined with relations, orders and numbers'
        raise InputError(where, problem, remedy=f"Ask for each alone. {_REMEDY}")
    counted, tokens = _question(tokens)
    parts, relations, joined, problem = _split(tokens)
    if problem:
        raise InputError(where, problem, remedy=_REMEDY)

    def read(part: Sequence[_Token], related: bool) -> NounPhrase:
        phrase, _, problem = _noun_phrase(part, related)
        if problem:
            raise InputError(where, problem, remedy=_REMEDY)
        return phrase

    thing = read(parts[0], bool(relations))
    conditions = []
    for place, (relation, part) in enumerate(zip(relations, parts[1:])):
        anchors = _two_anchors(part) if relation == "between" else [part]
        things = [read(anchor, place + 1 < len(relations)) for anchor in anchors]
        if relation == "between" and len(things) == 1:
            things = [dataclasses.replace(things[0], every=True)]
        conditions.append(Condition(relation, tuple(things)))
    if counted:
        thing = dataclasses.replace(thing, every=True)
    phrases = [thing, *(anchor for condition in conditions for anchor in condition.anchors)]
    depends_on_view = not _OF_VIEW.isdisjoint([*relations, *(phrase.order for phrase in phrases)])
    return Expression(thing, tuple(conditions), joined, depends_on_view)


def _tokens(text: str) -> list[_Token]:
    """Splits a text into words, words in quotes, and names that stand as they are."""
    tokens, start = [], 0
    for match in [*_QUOTED.finditer(text), None]:
        end = len(text) if match is None else match.start()
        words = (word.strip(",;:.?!") for word in text[start:end].split())
        tokens += _with_names([_Token(word, word.lower()) for word in words if word])
        if match is not None:
            tokens.append(_Token(next(filter(None, match.groups())).strip(), ""))
            start = match.end()
    return [token for token in tokens if token.text]


def _with_names(tokens: list[_Token]) -> list[_Token]:
    """Joins the words of names that stand as they are, such as "jack in the box" and "two in one"."""
    result, place = [], 0
    while place < len(tokens):
        name = _longest(tokens, place, _FIXED_NAMES)
        length = 1 if name is None else len(name)
        several = _number(tokens[place].key) is not None and [t.key for t in tokens[place + 1 : place + 3]]
        if several in (["in", "one"], ["in", "1"]):
            length = 3
        words = tokens[place : place + length]
        result.append(words[0] if length == 1 else _Token(" ".join(word.text for word in words), ""))
        place += length
    return result


def _longest(tokens: Sequence[_Token], start: int, table: Container[tuple[str, ...]]) -> tuple[str, ...] | None:
    """Returns the longest spelling of a table that begins at a token, or None."""
    for length in range(min(5, len(tokens) - start), 0, -1):
        words = tuple(token.key for token in tokens[start : start + length])
        if words in table:
            return words
    return None


def _question(tokens: list[_Token]) -> tuple[bool, list[_Token]]:
    """Returns whether a text asks for a number, and its words without those of the question."""
    for words in _LEXICON["questions"]:
        length = len(words.split())
        if [token.key for token in tokens[:length]] == words.split() and len(tokens) > length:
            rest = tokens[length:]
            if words in ("count", "show") and rest[0].key not in _QUANTIFIERS and not _is_plural(rest):
                continue  # a count down timer, a show case
            return words.startswith(("how", "count")), rest
    return False, tokens


def _number(key: str) -> int | None:
    """Returns the number that a word is, or None."""
    if key in _NUMBERS:
        return _NUMBERS.index(key) + 1
    return int(key) if re.fullmatch("[0-9]{1,3}", key) else None


def _is_plural(tokens: Sequence[_Token], *, counted: bool = False) -> bool:
    """Whether the words of an object name several things, by the last word, or that before "of".

    "Scissors" are several only where they are counted, as in "two scissors".
    """
    keys = [token.key for token in tokens]
    head = keys[keys.index("of", 1) - 1 if "of" in keys[1:] else -1] if keys else ""
    ends = head.endswith("s") and not head.endswith(("ss", "us", "is", "'s"))
    singular = head in _WORDS["singular_s"] or (head in _WORDS["pairs"] and not counted)
    return head in _WORDS["plural"] or (ends and not singular)


def _split(tokens: list[_Token]) -> tuple[list[list[_Token]], list[str], bool, str]:
    """Splits words into those of the objects and the relations between them; and whether "and" joins these.

    The last value is what is wrong; empty if nothing is.
    """
    parts: list[list[_Token]] = [[]]
    relations: list[str] = []
    joined, place = False, 0
    while place < len(tokens):
        words = _longest(tokens, place, _SPELLED)
        named = any(t.key not in _QUANTIFIERS and (t.key,) not in _ORDER_OF for t in parts[-1])
        relation = None if words is None else _RELATION_OF.get(words)
        length = len(words) if words is not None and len(words) > 1 else 1
        if relation in ANCHORED_ORDERS and length == 1 and not named:
            relation = None  # "the nearest mug": an order before the object
        if relation is not None and length == 1:
            in_name = _length_in_name(tokens, place, named)
            relation, length = (None, in_name) if in_name else (relation, length)
        if relation is None:
            parts[-1] += tokens[place : place + length]
            place += length
            continue
        parts[-1] = _without_fillers(parts[-1])
        if relations and parts[-1] and parts[-1][-1].key == "and":
            parts[-1].pop()
            joined = True
        if not named or not parts[-1]:
            return parts, relations, joined, f"no object stands before {' '.join(words or ())!r}"
        relations.append(relation)
        parts.append([])
        place += length
    if len(relations) > MAX_RELATIONS:
        problem = f"it has {len(relations)} relations ({', '.join(relations)}), and {MAX_RELATIONS} are understood"
        return parts, relations, joined, problem
    return (*_with_late_anchor(parts, relations), joined, "")


def _length_in_name(tokens: Sequence[_Token], place: int, named: bool) -> int:
    """Returns how many words from a preposition on belong to a name; 0 if it is a relation.

    `named` says whether words of the object stand before it.
    """
    following = [token.key for token in tokens[place + 1 :]]
    if tokens[place].key not in _PREPOSITIONS:
        return 0
    if named and tokens[place - 1].key in _WORDS["phrasal"] and tokens[place].key in ("in", "on", "over"):
        return int(not following or following[0] not in _QUANTIFIERS)
    if named or len(following) < 2:
        return 0
    if following[0] not in _WORDS["determiners"]:
        return 1
    return 3 if following[1] in _FITTED and len(following) > 2 else 0


def _without_fillers(tokens: Sequence[_Token], fillers: Sequence[str] = _WORDS["fillers"]) -> list[_Token]:
    """Returns words without those at their end that add nothing."""
    tokens = list(tokens)
    while tokens and tokens[-1].key in fillers:
        tokens.pop()
    return tokens


def _two_anchors(part: list[_Token]) -> list[list[_Token]]:
    """Splits "the plate and the salt and pepper shaker" into two objects, or returns one."""
    places = [i for i, token in enumerate(part) if token.key == "and"]
    clear = [i for i in places if i + 1 < len(part) and part[i + 1].key in _QUANTIFIERS]
    place = next(iter(clear or places), None)
    return [part] if place is None else [part[:place], part[place + 1 :]]


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


def _noun_phrase(tokens: Sequence[_Token], related: bool = False) -> tuple[NounPhrase, bool, str]:
    """Reads an object with its determiner, number and order; `related` if a relation follows.

    Also returns whether it has a number or a word such as "all", and what is wrong; empty if nothing is.
    """
    order, number, rank, every, definite = None, None, 1, False, False
    tokens = _without_fillers(tokens, (*_WORDS["fillers"], "and"))
    for start in range(1, len(tokens)):  # an order behind the object
        words = _longest(tokens, start, _ORDER_OF)
        if words is not None and len(words) > 1 and start + len(words) == len(tokens):
            order, tokens = _ORDER_OF[words], _without_fillers(tokens[:start])
            break
    while len(tokens) > 1:
        key, rest = tokens[0].key, tokens[1:]
        binds = rest[0].key
        ordered = order is not None or any((token.key,) in _ORDER_OF for token in rest[:2])
        if key in _WORDS["every"]:
            several = key in ("every", "each") or binds in _WORDS["determiners"] or _is_plural(rest, counted=True)
            if binds in _WORDS["after_numbers"] or not several:
                break  # all purpose cleaner
            every, number = True, 2 if key == "both" else number
        elif (count := _number(key)) is not None and number is None:
            objects = rest[1:] if binds == "of" else rest
            if binds in _WORDS["after_numbers"] or not _is_plural(objects, counted=True):
                break  # one way sign, seven up can
            number = count
        elif key in _ORDINALS or re.fullmatch("([1-9]|10)(st|nd|rd|th)", key):
            if not ordered or binds in _WORDS["after_ordinals"]:
                break  # first aid kit
            rank = _ORDINALS.index(key) + 1 if key in _ORDINALS else int(key[:-2])
        elif order is None and (key,) in _ORDER_OF:
            order = _ORDER_OF[(key,)]
        elif key not in _WORDS["determiners"] and not (key == "of" and (every or number or order)):
            break
        definite |= key not in _INDEFINITE
        tokens = rest
    quantified = every or number is not None
    keys = [token.key for token in tokens]
    if not tokens or (len(tokens) == 1 and keys[0] in {*_WORDS["determiners"], *_WORDS["every"]}):
        return NounPhrase(""), quantified, "an object is missing"
    unknown = _unknown_word(keys, definite, related)
    several = (number or 0) > 1
    if number == 1 and not every and order is not None:
        number = None
    every = not (order is not None and not several) and (every or several or _is_plural(tokens))
    phrase = NounPhrase(" ".join(token.text for token in tokens), order, rank, number, every)
    understood = ", ".join([*RELATIONS, *ORDERS])
    problem = f"the word {unknown!r} is not understood as a relation or an order. Understood are {understood}"
    return phrase, quantified, problem if unknown else ""


def _unknown_word(keys: Sequence[str], definite: bool, related: bool) -> str:
    """Returns the first word of a name that looks like a relation or an order of the grammar and is none, or "".

    `definite` if "the" or the like stands before the name, `related` if a relation follows.
    """
    for place, key in enumerate(keys):
        before, after = keys[place - 1] if place else "", keys[place + 1] if place + 1 < len(keys) else None
        phrasal = (before in _WORDS["phrasal"] and after not in _QUANTIFIERS) or _number(before) is not None
        ends = after in {*_QUANTIFIERS, "to", "from", "against", "with", "by"} or (after is None and related)
        article = before in _WORDS["determiners"] and before not in _INDEFINITE
        chosen = key in ("left", "right") or (definite if place == 0 else article)
        if (
            key in _WORDS["superlatives"]
            or (key,) in _ORDER_OF
            or (key in _WORDS["prepositions"] and place > 0 and not phrasal)
            or (key in _WORDS["participles"] and place > 0 and ends)
            or (key in _WORDS["places"] and chosen and after not in {*_WORDS["after_places"], *_PREPOSITIONS})
        ):
            return key
    return ""
