"""What a text asks for: several texts, or a referring expression that tells things apart by where they are.

`parse_query` splits texts that are joined by words: "red mug" or "bowl" but not "handle". `parse_expression` reads a
small grammar. There is no language model.

    expression  [how many | is there | find | where is | which is ...] thing [relation thing [[and] relation thing]]
                | what is relation thing
    relation    left of, on top of, near ...; between THING and THING, or between two THINGS; within 2 m of
    thing       [the | a | all | both | NUMBER] [ORDINAL] [ORDER] object [ORDER]
    ORDER       before the object: largest, second tallest, left, smaller ...; behind it: "from the left"
    object      any other words, which an embedder reads; or "thing", "everything", which is any object

Behind it may stand "with everything on it" or "in it", which adds what stands on the objects, and on that.

The words are in lexicon.toml. Everyday names contain many of them: "first aid kit", "one way sign", "under cabinet
light", "carry on bag". A word of the grammar therefore belongs to a name where it does no work:

    a number or "all"     unless a plural follows, or where it binds the next word ("two way mirrors")
    an ordinal            where it binds the next word ("first aid kit on the left")
    "front", "upper" ...  where it binds the next word ("the front door")
    "top", "second" ...   without "the" ("top shelf"), unless a colour or a size follows ("second red ball")
    a preposition         at the beginning without "the" ("under cabinet light"), or after a verb ("carry on bag")

In "the mug on the table left of the bottle", the second relation may belong to the mug or to the table:
`_Expression.readings` has both. With "and" before it, it belongs to the mug. Words in quotes are part of an object.

No word of place is dropped: one that looks like a relation or an order and is none of the grammar's is an error that
names it, such as "opposite", "second" without an order, "other than" or "5 m left of".
"""

import dataclasses
import itertools
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
ANY_OBJECT = "any object"
"""Name of an object that may be any."""
MAX_WORDS, MAX_RELATIONS = 60, 2
"""Of an expression."""
_OF_VIEW = {"left of", "right of", "in front of", "behind", "leftmost", "rightmost", "nearest", "farthest"}
"""Relations and orders that depend on the viewpoint."""
_ORDINALS, _NUMBERS = _WORDS["ordinals"], _WORDS["numbers"]
_QUOTED = re.compile(r"""(?<!\S)(?:"([^"]+)"|'(.+?)'|“([^”]+)”)(?=[\s,.?!]|$)""", re.DOTALL)
"""A text in quotes; an apostrophe within a word is not a quote."""
_DISTANCES = "Distances may be within 2 m of, or at least 2 m from, an object"
_REMEDY = 'For example "the red mug left of the bottle". Words of an object that look like these go in quotes.'


def parse_query(query: str) -> tuple[list[str], list[str]]:
    """Splits a query such as `"red mug" or "bowl" but not "handle"` into texts to include, and texts to exclude.

    Quotes are optional. They are removed, and "or" and "but not" between a pair of them belong to the text: "tea or
    coffee" in quotes is one text. Raises InputError for a part without words, or a query that is not UTF-8.
    """
    _require_utf8(query)
    parts = [[part.strip("\"'“”").strip() for part in texts] for texts in _alternatives(query)]
    if not all(itertools.chain(*parts)) or re.match(r"\s*but not\b", query, re.IGNORECASE):
        remedy = 'For example: "red mug" or "bowl" but not "handle"'
        raise InputError(f"query {query!r}", "a part without words", 'texts joined by "or" and "but not"', remedy)
    tokens = _tokens(_alternatives(query)[0][0])
    rest = _question(tokens)[1]
    if len(rest) < len(tokens):  # "where is the mug"
        parts[0][0] = " ".join(token.text for token in rest)
    return parts[0], parts[1]


def _alternatives(query: str) -> tuple[list[str], list[str]]:
    """Splits a text at "or", and what follows "but not", outside of quotes."""
    query = query.strip()
    quoted = [match.span() for match in _QUOTED.finditer(query)]
    parts, side, start = ([], []), 0, 0
    for word in re.finditer(r"\s+(?:(but\s+not)|or)(?=\s)", query, re.IGNORECASE):
        if not any(first < word.start() < last for first, last in quoted):
            parts[side].append(query[start : word.start()].strip())
            side, start = max(side, int(word[1] is not None)), word.end()
    parts[side].append(query[start:].strip())
    return parts


def _require_utf8(text: str) -> None:
    if re.search("[\ud800-\udfff]", text):
        remedy = "Type it in a terminal, or send it from a program, that uses UTF-8."
        raise InputError("", f"the text {text!r} is not UTF-8", remedy=remedy)


class _Unreadable(ValueError):
    """What is wrong with an expression, in words."""


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
    among: int | None = None
    """Number of objects that the order chooses from, as in "the larger of the two mugs", or None."""


@dataclasses.dataclass(frozen=True)
class Condition:
    """A relation to other objects."""

    relation: str
    """One of RELATIONS, or "within" or "at least" of a distance."""
    anchors: tuple[NounPhrase, ...]
    """The object, or the two objects of "between"; one with `every` stands for both of these."""
    conditions: tuple["Condition", ...] = ()
    """Conditions of the last anchor."""
    length: float = 0.0
    """Distance of "within" and "at least"."""
    in_metres: bool = False
    """Whether the distance is in metres, instead of units of the capture's world."""

    def __str__(self) -> str:
        """The condition in words."""
        distance = f" {self.length:.4g} {'m' if self.in_metres else 'units'} from" if self.length else ""
        words = f"{self.relation}{distance} {' and '.join(anchor.text for anchor in self.anchors)}"
        return words + "".join(f" that is {condition}" for condition in self.conditions)


@dataclasses.dataclass(frozen=True)
class _Expression:
    """What a text asks for."""

    thing: NounPhrase
    """The object that is looked for."""
    conditions: tuple[Condition, ...] = ()
    """Its relations, in the order of the text."""
    joined: bool = False
    """Whether all conditions belong to the object for certain."""
    depends_on_view: bool = False
    """Whether a relation or an order depends on the viewpoint."""
    adds: str = ""
    """The relation of what is meant beside the objects, "on" or "in"; "" for the objects alone."""

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
        order += [f"with everything {self.adds} it"] if self.adds else []
        return ", ".join([f"{self.thing.text!r}", *map(str, conditions), *order])


def _spellings(table: Mapping[str, str]) -> dict[tuple[str, ...], str]:
    """Returns words -> name of a table of spellings."""
    return {tuple(words.split()): name for name, row in table.items() for words in re.split(r"[|\n]", row)}


_RELATION_OF, _ORDER_OF = _spellings(RELATIONS), _spellings(ORDERS)
_SPELLED = {**_RELATION_OF, **_ORDER_OF}
_SIDES = ("left", "right", "left-hand", "right-hand", "top", "bottom", "front", "back", "rear")
_ADJECTIVES = {word: order for order, words in _LEXICON["adjectives"].items() for word in words.split()}
_METRES = {word: float(metres) for metres, words in _LEXICON["units"].items() for word in words.split()}
_LENGTH = rf"([0-9]+(?:[.,][0-9]+)?|half an?|half|an?|{'|'.join(_WORDS['numbers'])}) ?({'|'.join(_METRES)})"
_MOST, _LEAST = _LEXICON["distances"]["most"], _LEXICON["distances"]["least"]
_DISTANCE = re.compile(rf"(?:({_MOST})|(?:{_LEAST})) {_LENGTH}(?: away)? (?:from|of|to) ")
_BARE_LENGTH = re.compile(rf"(?<!\S){_LENGTH}(?= (?:from|away|apart|to the|of the)\b)")
_LENGTH_AT_END = re.compile(rf"(?<!\S){_LENGTH}$")
_FIXED_NAMES = {tuple(words.split()): "" for words in re.split(r"[|\n]", _LEXICON["names"]["fixed"])}
_FITTED = frozenset(_LEXICON["names"]["fitted"].split())
_QUANTIFIERS = {*_WORDS["determiners"], *_WORDS["every"], *_ORDINALS, *_NUMBERS}
_DESCRIBING = {*_QUANTIFIERS, *_WORDS["adjectives"], *_WORDS["anything"]}
_ARTICLE = "(?:the|a|an|this|that|my|your|our) "
_PART_OF = (
    re.compile(rf"(?:{_ARTICLE})?(?P<part>.+?) of {_ARTICLE}(?P<whole>.+)", re.IGNORECASE),
    re.compile(rf"(?:{_ARTICLE})?(?P<whole>.+?)'s (?P<part>.+)", re.IGNORECASE),
)
_ADDS = re.compile(
    r"(?P<things>.+?),? (?:with|and) (?:all|everything|whatever|what|(?:all )?the (?:things|objects))"
    r"(?: that)?(?:'s| is| are)? (?P<relation>on|in)(?:(?<=on) top of|side)? (?:it|them)",
    re.IGNORECASE,
)
_ABOUT_PROPERTY = re.compile(_LEXICON["about_property"])
_INDEFINITE = ("a", "an", "any", "some", "of")
_PREPOSITIONS = {words[0] for words in _RELATION_OF if len(words) == 1} - {"nearest", "closest"}


def split_part(text: str) -> tuple[str, str] | None:
    """Reads "handle of the red mug", "where is the red mug's handle": ("handle", "red mug").

    None if the text names no part of another thing, or several things. "Cup of tea" and "statue of liberty" are names:
    they lack an article after "of".
    """
    included, excluded = parse_query(text)
    if _QUOTED.search(text) or len(included) > 1 or excluded:
        return None
    plain = " ".join(included[0].replace("\N{RIGHT SINGLE QUOTATION MARK}", "'").split()).rstrip(".?!")
    for pattern in _PART_OF:
        if match := pattern.fullmatch(plain):
            return match["part"], match["whole"]
    return None


def is_expression(text: str) -> bool:
    """Whether a text needs the grammar: it has a word of place, an order or a number outside of quotes and names."""
    return any(map(_needs_grammar, itertools.chain(*_alternatives(text))))


def _split_added(text: str) -> tuple[str, str]:
    """Splits "the tray with everything on it" into "the tray" and "on"; the second is "" for any other text."""
    plain = " ".join(text.replace("\N{RIGHT SINGLE QUOTATION MARK}", "'").split()).rstrip(".?!")
    match = None if _QUOTED.search(text) else _ADDS.fullmatch(plain)
    return (text, "") if match is None else (match["things"], match["relation"].lower())


def _needs_grammar(text: str) -> bool:
    """Whether a text without "or" and "but not" needs the grammar."""
    if _split_added(text)[1]:
        return True
    counted, tokens = _question(_tokens(text))
    if counted or not tokens or _asks_for_property(text):
        return bool(tokens)
    try:
        parts, relations, _ = _split(tokens)
        phrase, quantified = _noun_phrase(parts[0])
    except _Unreadable:
        return True
    return bool(relations or quantified or phrase.order) or tokens[0].key in _WORDS["everything"]


def parse_expression(text: str) -> _Expression:
    """Parses a text by the grammar of this module, such as "the second red mug from the left".

    A text without relation, order or number is an object alone. Raises InputError for a text that is empty, too long or
    not UTF-8, has a relation without an object, or a word that looks like a relation and is none.
    """
    _require_utf8(text)
    where = f"expression {text!r}"
    text, adds = _split_added(text)
    tokens = _tokens(text)
    if not tokens:
        raise InputError("expression", "the text is empty", remedy=_REMEDY)
    if words := _asks_for_property(text):
        remedy = "Ask for the thing alone, or put words that are its name in quotes; the catalogue has names and sizes."
        raise InputError(where, f"{words!r} asks for a property of a thing, and a text selects things", remedy=remedy)
    if len(tokens) > MAX_WORDS:
        problem = f"the text has {len(tokens)} words, and an expression at most {MAX_WORDS}"
        raise InputError("expression", problem, remedy="Ask for one object and its relations to others.")
    if len([*itertools.chain(*_alternatives(text))]) > 1:
        word = "but not" if _alternatives(text)[1] else "or"
        problem = f'"{word}" cannot be combined with relations, orders and numbers'
        raise InputError(where, problem, remedy=f"Ask for each alone. {_REMEDY}")
    try:
        return _read_tokens(tokens, adds)
    except _Unreadable as error:
        raise InputError(where, str(error), remedy=_REMEDY) from None


def _read_tokens(tokens: list[_Token], adds: str) -> _Expression:
    """Parses the words of an expression."""
    counted, tokens = _question(tokens)
    parts, relations, joined = _split(tokens)
    thing, _ = _noun_phrase(parts[0], bool(relations))
    conditions = []
    for place, (condition, part) in enumerate(zip(relations, parts[1:])):
        between = condition.relation == "between"
        anchors = _two_anchors(part) if between else [part]
        things = [_noun_phrase(words, place + 1 < len(relations), anchor=True)[0] for words in anchors]
        if between and len(things) == 1:
            things = [dataclasses.replace(things[0], every=True)]
        conditions.append(dataclasses.replace(condition, anchors=tuple(things)))
    if counted:
        thing = dataclasses.replace(thing, every=True)
    phrases = [thing, *(anchor for condition in conditions for anchor in condition.anchors)]
    named = [*(condition.relation for condition in conditions), *(phrase.order for phrase in phrases)]
    depends_on_view = not _OF_VIEW.isdisjoint(named)
    return _Expression(thing, tuple(conditions), joined, depends_on_view, adds)


def _tokens(text: str) -> list[_Token]:
    """Splits a text into words, words in quotes, and names that stand as they are."""
    tokens, start = [], 0
    for match in [*_QUOTED.finditer(text), None]:
        end = len(text) if match is None else match.start()
        words = (word.strip(",;:.?!") for word in text[start:end].split())
        tokens += _with_names([token for word in words if word for token in _of_word(word)])
        if match is not None:
            tokens.append(_Token(next(filter(None, match.groups())).strip(), ""))
            start = match.end()
    following = [*(token.key for token in tokens[1:]), ""]
    weak = [t.key in _WORDS["intensifiers"] and after in _SIDES for t, after in zip(tokens, following)]
    return [token for token, dropped in zip(tokens, weak) if token.text and not dropped]


def _of_word(word: str) -> list[_Token]:
    """The tokens of a word: parts that hyphens join where all are orders, as in "second-largest" and "top-left"."""
    key = word.lower().replace("\N{RIGHT SINGLE QUOTATION MARK}", "'")
    parts = key.split("-")
    if len(parts) == 1 or key in _SIDES:
        return [_Token(word, key)]
    if ("".join(parts),) in _ORDER_OF:  # left-most
        return [_Token(word, "".join(parts))]
    is_order = all(part in (*_ORDINALS, *_ADJECTIVES) or (part,) in _ORDER_OF for part in parts)
    return [_Token(part, part) for part in parts] if is_order else [_Token(word, key)]


def _with_names(tokens: list[_Token]) -> list[_Token]:
    """Joins the words of names that stand as they are, such as "jack in the box" and "two in one"."""
    result, place = [], 0
    while place < len(tokens):
        name = _longest(tokens, place, _FIXED_NAMES)
        length = 1 if name is None else len(name)
        words = tokens[place : place + length]
        result.append(words[0] if length == 1 else _Token(" ".join(word.text for word in words), ""))
        place += length
    return result


def _longest(tokens: Sequence[_Token], start: int, table: Container[tuple[str, ...]]) -> tuple[str, ...] | None:
    """Returns the longest spelling of a table that begins at a token, or None."""
    for length in range(min(6, len(tokens) - start), 0, -1):
        words = tuple(token.key for token in tokens[start : start + length])
        if words in table:
            return words
    return None


def _question(tokens: list[_Token]) -> tuple[bool, list[_Token]]:
    """Returns whether a text asks for all that match, and its words without those of the question.

    A question without an object, such as "what is on the table", asks for any object.
    """
    for words in _LEXICON["questions"]:
        length = len(words.split())
        if [token.key for token in tokens[:length]] != words.split() or len(tokens) <= length:
            continue
        rest = tokens[length:]
        if words in ("how many", "what", "who", "which"):
            while len(rest) > 1 and rest[0].key in _WORDS["fillers"]:
                rest = rest[1:]
        word = words.split()[0].removesuffix("'s")
        spelled = _longest(_after_adverbs(rest), 0, _SPELLED)
        if word in ("what", "who", "how", "which") and spelled and (len(spelled) > 1 or spelled in _RELATION_OF):
            word = "people" if word == "who" else "things"
            return True, [_Token(word, word), *rest]
        if words in ("what", "who") and rest[0].key not in _WORDS["anything"]:
            continue
        if words in ("is", "are") and rest[0].key not in (*_WORDS["determiners"], *_WORDS["anything"]):
            continue
        if words in ("what is", "what are", "what's", "who is", "who are", "who's") and rest[0].key not in _DESCRIBING:
            continue  # a "what is love" poster
        if words in ("count", "show", "list", "locate") and rest[0].key not in _QUANTIFIERS and not _is_plural(rest):
            continue  # a count down timer, a show case
        return word in ("how", "count", "is", "are") or words in ("what", "who", "list"), rest
    return False, tokens


def _asks_for_property(text: str) -> str:
    """Returns the words of a question for more than which things there are, such as "what colour is", or ""."""
    question = _ABOUT_PROPERTY.match(" ".join(token.key for token in _tokens(text)))
    return question[0] if question else ""


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


def _split(tokens: list[_Token]) -> tuple[list[list[_Token]], list[Condition], bool]:
    """Splits words into those of the objects and the relations between them; and whether "and" joins these.

    The relations come without their anchors.
    """
    parts: list[list[_Token]] = [[]]
    relations: list[Condition] = []
    joined, place = False, 0
    while place < len(tokens):
        named = any(t.key not in _QUANTIFIERS and (t.key,) not in _ORDER_OF for t in parts[-1])
        condition, length = _relation_at(tokens, place, named)
        if condition is None:
            parts[-1] += tokens[place : place + length]
            place += length
            continue
        words = " ".join(token.text for token in tokens[place : place + length])
        if exact := _LENGTH_AT_END.search(" ".join(token.key for token in parts[-1])):
            raise _Unreadable(f"the distance '{exact[0]} {words}' is not understood. {_DISTANCES}")
        parts[-1] = _without_fillers(parts[-1])
        if relations and parts[-1] and parts[-1][-1].key == "and":
            parts[-1].pop()
            joined = True
        if not named or not parts[-1]:
            raise _Unreadable(f"no object stands before {words!r}")
        relations.append(condition)
        parts.append([])
        place += length
    if len(relations) > MAX_RELATIONS:
        names = ", ".join(condition.relation for condition in relations)
        raise _Unreadable(f"it has {len(relations)} relations ({names}), and {MAX_RELATIONS} are understood")
    return (*_with_late_anchor(parts, relations), joined)


def _relation_at(tokens: Sequence[_Token], place: int, named: bool) -> tuple[Condition | None, int]:
    """Returns the relation that begins at a word, without its anchor, or None; and how many words belong together.

    `named` says whether words of the object stand before it.
    """
    keys = " ".join(token.key for token in tokens[place : place + 9])
    if named and (distance := _DISTANCE.match(keys)):
        most, number, unit = distance.groups()
        value = 0.5 if number.startswith("half") else 1.0 if number in ("a", "an") else _number(number)
        metres = _METRES[unit]
        length = (float(number.replace(",", ".")) if value is None else value) * (metres or 1.0)
        name = "within" if most else "at least"
        return Condition(name, (), length=length, in_metres=metres > 0), len(distance[0].split())
    words = _longest(tokens, place, _SPELLED)
    if words in _ORDER_OF and len(words) > 1 and _goes_on(tokens[place + len(words) :]):
        words = _longest(tokens, place, _RELATION_OF)  # on the left shelf
    relation = None if words is None else _RELATION_OF.get(words)
    length = len(words) if words is not None and len(words) > 1 else 1
    following = [token.key for token in tokens[place + length : place + length + 2]]
    if relation in ANCHORED_ORDERS and length == 1 and not named:
        relation = None  # "the nearest mug": an order before the object
    elif relation in ("left of", "right of") and not named and any(map(_number, following)):
        return None, 1  # the left of the two mugs
    if relation is not None and length == 1 and (in_name := _length_in_name(tokens, place, named)):
        return None, in_name
    return None if relation is None else Condition(relation, ()), length


def _goes_on(tokens: Sequence[_Token]) -> bool:
    """Whether an object goes on after words that may be an order behind it: the "shelf" of "on the left shelf"."""
    tokens = _after_adverbs(tokens)
    ends = ("and", *_WORDS["fillers"])
    return bool(tokens) and tokens[0].key not in ends and _longest(tokens, 0, _RELATION_OF) is None


def _after_adverbs(tokens: Sequence[_Token]) -> Sequence[_Token]:
    """Returns words without the adverbs at their beginning."""
    while len(tokens) > 1 and tokens[0].key in _WORDS["adverbs"] and _longest(tokens, 0, _SPELLED) is None:
        tokens = tokens[1:]
    return tokens


def _length_in_name(tokens: Sequence[_Token], place: int, named: bool) -> int:
    """Returns how many words from a preposition on belong to a name; 0 if it is a relation.

    `named` says whether words of the object stand before it.
    """
    following = [token.key for token in tokens[place + 1 :]]
    key = tokens[place].key
    if key not in _PREPOSITIONS:
        return 0
    phrasal = named and tokens[place - 1].key in _WORDS["phrasal"] and key in ("in", "on", "over")
    if phrasal or key in ("nearer", "closer"):
        return int(not following or following[0] not in _QUANTIFIERS)
    if key == "near" and place and not named and tokens[place - 1].key in _WORDS["determiners"]:
        return 1  # the near mug
    if named or len(following) < 2:
        return 0
    if following[0] not in _WORDS["determiners"]:
        return 1
    return 3 if following[1] in _FITTED and len(following) > 2 else 0


def _without_fillers(tokens: Sequence[_Token], *more: str, adverbs: bool = True) -> list[_Token]:
    """Returns words without those at their end that add nothing, `more` among them."""
    tokens = list(tokens)
    fillers = {*_WORDS["fillers"], *(_WORDS["adverbs"] if adverbs else ()), *more}
    while tokens:
        if adverbs and [token.key for token in tokens[-2:]] in (["a", "bit"], ["a", "little"]):
            del tokens[-2:]
        elif tokens[-1].key in fillers and not (tokens[-1].key == "right" and tokens[-2:][0].key == "the"):
            tokens.pop()
        else:
            break
    return tokens


def _two_anchors(part: list[_Token]) -> list[list[_Token]]:
    """Splits "the plate and the salt and pepper shaker" into two objects, or returns one."""
    places = [i for i, token in enumerate(part) if token.key == "and"]
    clear = [i for i in places if i + 1 < len(part) and part[i + 1].key in _QUANTIFIERS]
    place = next(iter(clear or places), None)
    return [part] if place is None else [part[:place], part[place + 1 :]]


def _with_late_anchor(
    parts: list[list[_Token]], relations: list[Condition]
) -> tuple[list[list[_Token]], list[Condition]]:
    """Makes a relation of an order whose anchor follows the object, as in "the nearest mug to the bottle"."""
    head = parts[0]
    words = {"nearer": "nearest", "closer": "nearest", "farther": "farthest", "further": "farthest"}
    named = [_ORDER_OF.get((token.key,), words.get(token.key)) for token in head]
    orders = [i for i, order in enumerate(named) if order in ("nearest", "farthest")]
    ends = [i for i, token in enumerate(head) if token.key in ("to", "from")]
    late = [i for i in ends if orders and i > orders[0] + 1 and _longest(head, i, _ORDER_OF) is None]
    if not late or relations:
        return parts, relations
    relation = "nearest to" if named[orders[0]] == "nearest" else "farthest from"
    anchor = head[late[0] + 1 :]
    return [head[: orders[0]] + head[orders[0] + 1 : late[0]], anchor], [Condition(relation, ())]


def _noun_phrase(tokens: Sequence[_Token], related: bool = False, anchor: bool = False) -> tuple[NounPhrase, bool]:
    """Reads an object with its determiner, number and order; `related` if a relation follows, `anchor` if one precedes.

    Also returns whether it has a number or a word such as "all".
    """
    order, number, among, rank, every, definite, partitive = None, None, None, 1, False, False, False
    ordinal = ""
    tokens = _without_fillers(tokens, "and", adverbs=False)
    for start in range(1, len(tokens)):  # an order behind the object
        words = _longest(tokens, start, _ORDER_OF)
        if words is not None and len(words) > 1 and start + len(words) == len(tokens):
            order, tokens = _ORDER_OF[words], _without_fillers(tokens[:start])
            break
    while len(tokens) > 1:
        key, rest = tokens[0].key, tokens[1:]
        binds = rest[0].key
        ordered = order is not None or any((t.key,) in _ORDER_OF or t.key in _ADJECTIVES for t in rest[:2])
        adjective = order is None and key in _ADJECTIVES and _tells_apart([t.key for t in tokens], 0, definite)
        side = rest[1:] if binds in _WORDS["sides"] else rest  # the top of the box, the left side of the box
        if side and side[0].key == "of" and not key.endswith("er") and not any(_number(t.key) for t in side[1:3]):
            adjective = False
        if key in _WORDS["every"]:
            several = key in ("every", "each") or binds in _WORDS["determiners"] or _is_plural(rest, counted=True)
            if binds in _WORDS["after_numbers"] or not several:
                break  # all purpose cleaner
            every, number = True, 2 if key == "both" else number
        elif (count := _number(key)) is not None and (number is None or partitive):
            objects = rest[1:] if binds == "of" else rest
            if binds in _WORDS["after_numbers"] or not _is_plural(objects, counted=True):
                break  # one way sign, seven up can
            number, among = (number, count) if partitive else (count, among)
        elif key in _ORDINALS or re.fullmatch("([1-9]|10)(st|nd|rd|th)", key):
            if not ordered or binds in _WORDS["after_ordinals"]:
                break  # first aid kit
            rank, ordinal = _ORDINALS.index(key) + 1 if key in _ORDINALS else int(key[:-2]), key
        elif order is None and ((key,) in _ORDER_OF or adjective):
            order = _ADJECTIVES[key] if adjective else _ORDER_OF[(key,)]
            if binds == "one" and len(rest) > 1 and rest[1].key == "of":
                rest = rest[1:]
        elif key == "of" and (every or number or order):
            partitive = True
        elif key not in _WORDS["determiners"]:
            break
        definite |= key not in _INDEFINITE
        tokens = rest
    quantified = every or number is not None
    keys = [token.key for token in tokens]
    if not tokens or (len(tokens) == 1 and keys[0] in {*_WORDS["determiners"], *_WORDS["every"]}):
        raise _Unreadable("an object is missing")
    if exact := _BARE_LENGTH.search(" ".join(keys)):
        raise _Unreadable(f"the distance {exact[0]!r} is not understood. {_DISTANCES}")
    if (len(keys) == 1 and keys[0] in _WORDS["pronouns"]) or (keys[-1] == "one" and keys[-2] in _WORDS["adjectives"]):
        raise _Unreadable(f"the word {keys[-1]!r} names no object")
    if unknown := _unknown_word(keys, definite, related, anchor) or (ordinal if order is None else ""):
        understood = ", ".join([*RELATIONS, *ORDERS])
        problem = f"the word {unknown!r} is not understood as a relation or an order. Understood are {understood}"
        raise _Unreadable(problem)
    several = (number or 0) > 1
    if number == 1 and not every and order is not None:
        number = None
    anything = len(keys) == 1 and keys[0] in _WORDS["anything"]
    every = every or several or _is_plural(tokens) or (anything and keys[0] in _WORDS["everything"])
    every = every and (order is None or several)
    text = ANY_OBJECT if anything else " ".join(token.text for token in tokens)
    return NounPhrase(text, order, rank, number, every, among), quantified


def _tells_apart(keys: Sequence[str], place: int, definite: bool) -> bool:
    """Whether a place, a comparative or an ordinal does work, instead of being part of a name.

    `definite` if "the" or the like stands before it. "The front mug" is the nearest one, and "the front door" a name.
    """
    key, after = keys[place], keys[place + 1] if place + 1 < len(keys) else None
    sides, ordinal = key in _SIDES[:4], key in _ORDINALS or re.fullmatch("([1-9]|10)(st|nd|rd|th)", key)
    names = "after_sides" if sides else "after_ordinals" if ordinal else "after_places"
    if after is None or after in _WORDS[names]:
        return False
    lone = len(keys) == 2 and bool(ordinal or key in ("last", "next"))
    return definite or lone or key in _WORDS["always"] or after in _WORDS["adjectives"]


def _unknown_word(keys: Sequence[str], definite: bool, related: bool, anchor: bool) -> str:
    """Returns the first word of a name that looks like a relation or an order of the grammar and is none, or "".

    `definite` if "the" or the like stands before the name, `related` if a relation follows, `anchor` if one precedes.
    """
    for place, key in enumerate(keys):
        before, after = keys[place - 1] if place else "", keys[place + 1] if place + 1 < len(keys) else None
        phrasal = (before in _WORDS["phrasal"] and after not in _QUANTIFIERS) or _number(before) is not None
        ends = after in {*_QUANTIFIERS, "to", "from", "against", "with", "by"} or (after is None and related)
        article = before in _WORDS["determiners"] and before not in _INDEFINITE
        ordinal = key in _ORDINALS or bool(re.fullmatch("([1-9]|10)(st|nd|rd|th)", key))
        placed = ordinal or key in _WORDS["places"] or key in _ADJECTIVES
        chosen = placed and _tells_apart(keys, place, article if place else definite) and after not in _PREPOSITIONS
        if (
            (chosen and (place == 0 or article or key in _WORDS["always"]))
            or (placed and place > 0 and after == "of" and not article)
            or key in _WORDS["superlatives"]
            or (key,) in _ORDER_OF
            or (key in _WORDS["prepositions"] and place > 0 and not phrasal)
            or (key.endswith("n't") and place > 0)
            or (key in _WORDS["participles"] and place > 0 and ends and not phrasal)
            or (key == "not" and (before in _WORDS["fillers"] or (place == 0 and after in _DESCRIBING)))
            or (key == "as" and place > 0 and keys[place + 2 : place + 3] == ["as"])
            or (placed and after is None and before in _WORDS["fillers"])
            or (key in _SIDES[:2] and after is None and place > 0 and not phrasal)
            or (key in _WORDS["ranges"] and anchor and place > 0 and after in (None, "of"))
            or (key in _WORDS["sides"] and place == 0 and anchor and after in (None, "of"))
        ):
            return key
    return ""
