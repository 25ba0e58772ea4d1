"""What a text asks for: several texts, referring expressions, and names that contain words of the grammar."""

from pathlib import Path

import pytest

from jsecon import InputError
from jsecon.query.expressions import _ADJECTIVES, RELATIONS, is_expression, parse_expression, parse_query

PHRASES = Path(__file__).with_name("noun_phrases.txt").read_text().split("\n")[:-1]
EXPRESSIONS = [
    # text, object, conditions, order and rank, number, whether all are meant
    ("red mug on table", "red mug", ["on table"], None, None, False),
    ("ball between two plates", "ball", ["between plates"], None, None, False),
    ("mug between the salt and pepper shaker and the plate", "mug", ["between salt and pepper shaker and plate"], None,
     None, False),
    ("the nearest mug to the bottle", "mug", ["nearest to bottle"], None, None, False),
    ("the nearest mug", "mug", [], ("nearest", 1), None, False),
    ("the first two mugs from the left", "mugs", [], ("leftmost", 1), 2, True),
    ("both mugs on the table", "mugs", ["on table"], None, 2, True),
    ("how many bottles are in the box?", "bottles", ["in box"], None, None, True),
    ("the mug on the table left of the bottle", "mug", ["on table", "left of bottle"], None, None, False),
    ("the mug on the table and left of the bottle", "mug", ["on table", "left of bottle"], None, None, False),
    ('"tea in a glass" on the "table left of it"', "tea in a glass", ["on table left of it"], None, None, False),
    ("find the first aid kit left of the top hat", "first aid kit", ["left of top hat"], None, None, False),
    ("two way radio next to the 2 liter bottle", "two way radio", ["next to 2 liter bottle"], None, None, False),
    ("the left bottle of wine", "bottle of wine", [], ("leftmost", 1), None, False),
    ("the larger of the two jars", "jars", [], ("largest", 1), None, False),
    ("the second-largest jar", "jar", [], ("largest", 2), None, False),
    ("the left-most jar", "jar", [], ("leftmost", 1), None, False),
    ("the jar a bit left of the lamp", "jar", ["left of lamp"], None, None, False),
    ("the stool on the far right", "stool", [], ("rightmost", 1), None, False),
    ("the jar on the left shelf", "jar", ["on shelf"], None, None, False),
    ("the jar within 40 cm of the lamp", "jar", ["within 0.4 m from lamp"], None, None, False),
    ("jars at least two metres away from the lamp", "jars", ["at least 2 m from lamp"], None, None, True),
    ("the jar less than 1.5 units from the lamp", "jar", ["within 1.5 units from lamp"], None, None, False),
    ("the jar right next to the lamp", "jar", ["next to lamp"], None, None, False),
    ("what's left of the lamp", "any object", ["left of lamp"], None, None, True),
    ("who is near the door", "people", ["near door"], None, None, True),
    ("everything in the box", "any object", ["in box"], None, None, True),
]  # fmt: skip


def test_names_of_everyday_objects_keep_their_words():
    """An ordinal, a number, "all", a preposition, a place or "-est" in a name is part of it, and it is one thing."""
    for phrase in PHRASES:
        thing = parse_expression(phrase).thing
        got = thing.text, thing.order, thing.number, thing.every, is_expression(phrase)
        assert got == (phrase, None, None, False, False)


def test_names_of_everyday_objects_stand_beside_relations():
    for phrase in PHRASES:
        if phrase.startswith(("show ", "count ")):  # these begin a question only
            continue
        expression = parse_expression(f"{phrase} near mug")
        assert (expression.thing.text, list(map(str, expression.conditions))) == (phrase, ["near mug"])


@pytest.mark.parametrize(("text", "thing", "conditions", "order", "number", "every"), EXPRESSIONS)
def test_the_grammar(text, thing, conditions, order, number, every):
    expression = parse_expression(text)
    assert is_expression(text)
    got = expression.thing
    assert (got.text, got.number, got.every) == (thing, number, every)
    assert list(map(str, expression.conditions)) == conditions
    assert (got.order, got.rank) == (order or (None, 1))
    assert len(expression.readings()) == (1 if expression.joined else max(1, len(conditions)))


@pytest.mark.parametrize(("text", "thing", "relation"), [
    ("the table with everything on it", "table", "on"), ("The red tray and all that is on it.", "red tray", "on"),
    ("where is the shelf with what's in it?", "shelf", "in"),
    ("the leftmost plate, with everything that is on top of it", "plate", "on"),
])  # fmt: skip
def test_what_is_on_a_thing_may_be_added(text, thing, relation):
    expression = parse_expression(text)
    assert is_expression(text)
    assert (expression.thing.text, expression.adds) == (thing, relation)
    assert expression.describe(()).endswith(f"with everything {relation} it")
    assert not is_expression(f'"{text}"')


def test_every_spelling_is_understood_and_quotes_protect():
    for word, order in _ADJECTIVES.items():
        thing = parse_expression(f"the {word} jar").thing
        assert (thing.text, thing.order, thing.rank, thing.number) == ("jar", order, 1, None)
    for name, spellings in RELATIONS.items():
        for words in spellings.replace("\n", "|").split("|"):
            anchors = "the plate and the bowl" if name == "between" else "the plate"
            assert parse_expression(f"the mug {words} {anchors}").conditions[0].relation == name
            assert not is_expression(f'"the mug {words} the plate"')
    assert not is_expression("red mug or bowl but not handle")
    assert parse_expression("mugs").thing.every


@pytest.mark.parametrize(("text", "problem"), [
    ("", "is empty"), ("  ", "is empty"), ("word " * 5000, "5000 words"), ("mug across from the plate", "'across'"),
    ("the widest mug", "'widest'"), ("mug near the same plate", "'same'"), ("the middle mug on the plate", "'middle'"),
    ("mug by the plate", "'by'"), ("lamp hanging over the table", "'hanging'"), ("second green jar", "'second'"),
    ("left of the plate", "no object stands before 'left of'"), ("the jar facing the lamp", "'facing'"),
    ("mug between the plate and", "an object is missing"), ("mug in box on plate near bowl", "3 relations"),
    ("the jar 3 m right of the lamp", "'3 m right of'"), ("the jar two feet from the lamp", "'two feet'"),
    ("all jars except the lamp", "'except'"), ("another jar", "'another'"),
    ("the jar that is not on the shelf", "'not'"), ("the jar next to it", "'it'"),
    ("the one on the shelf", "no object stands before 'on'"),
    ("the jar on the side of the box", "'side'"), ("the jar and the left lamp", "'left'"),
    ("the left side of the jar", "'left'"), ("the jar closer to the lamp than to the door", "'than'"),
    ("the left jar or the lamp", '"or"'), ("the jar but not the jar on the shelf", '"but not"'),
    ("red mug or bowl on the plate", '"or"'), ("caf\udce9 on the plate", "not UTF-8"),
    ("the jar, left", "'left'"), ("the jar on the box's left", "'left'"),
    ("which jar is larger", "'larger'"), ("not the red jar", "'not'"), ("the jar as large as the lamp", "'as'"),
    ("the jar within arm's reach of the lamp", "'reach'"), ("the jar in the background", "'background'"),
    ("the top-left jar", "'left'"), ("the jar almost on the shelf", "'almost'"),
    ("what colour is the jar?", "'what colour is' asks for a property"),
    ("How far is the jar from the lamp", "'how far is'"),
])  # fmt: skip
def test_what_is_not_understood_is_named(text, problem):
    assert is_expression(text) or not text.strip() or text.startswith("word")
    with pytest.raises(InputError, match=problem):
        parse_expression(text)


@pytest.mark.parametrize("text", [
    "the front door", "the second hand clock", "left hand glove", "night stand", "door closer", "top shelf",
    "2 m tape measure", "the last supper painting", '"the jar opposite the lamp"', "lighter", "what is love poster",
    "who's who book", "'what colour is your parachute'",
])  # fmt: skip
def test_names_and_quotes_with_words_of_place_stay_names(text):
    assert not is_expression(text)
    assert parse_query(text) == ([text.strip("'\"")], [])


def test_a_question_without_words_of_place_asks_for_its_object():
    assert parse_query("where is the jar?") == parse_query("what is the jar") == (["the jar"], [])
    assert parse_query("find the lamp or the jar but not the lid") == (["the lamp", "the jar"], ["the lid"])


@pytest.mark.parametrize(("question", "wanted", "unwanted"), [
    ('"red mug"', ["red mug"], []),
    ("“tea or coffee” but not “a cup but not full”", ["tea or coffee"], ["a cup but not full"]),
    ("mug or 'bowl' But Not \"handle\" or lid", ["mug", "bowl"], ["handle", "lid"]), ("doorknob", ["doorknob"], []),
    ("kids' toys or dogs' bones", ["kids' toys", "dogs' bones"], []),
    ("'kid's cup or mug'", ["kid's cup or mug"], []), ('the "tea or coffee" pot', ['the "tea or coffee" pot'], []),
    ('"red', ["red"], []),
])  # fmt: skip
def test_questions_come_apart_but_within_quotes_which_are_removed(question, wanted, unwanted):
    assert parse_query(question) == (wanted, unwanted)


@pytest.mark.parametrize("question", ["", "but not handle", "mug but not ''"])
def test_a_question_without_a_part_is_refused(question):
    with pytest.raises(InputError, match="part"):
        parse_query(question)
