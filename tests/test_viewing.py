"""The states of a viewer: what leads from one to the next, back, and through a link; and the colours that follow."""

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given, strategies as st

from jsecon.app.viewer.view_state import (
    MOST,
    PAINTS,
    Ask,
    History,
    ViewState,
    all_shown,
    asked,
    clicked,
    hidden,
    instead,
    line_of,
    link_of,
    lit,
    moved,
    scored,
    shown,
    shown_only,
    state_of,
    tints,
)
from jsecon.errors import InputError

MUG = asked(ViewState(), "red mug")

texts = st.text(min_size=1, max_size=30).filter(str.strip)
things = st.lists(texts | st.integers(0, 10_000), max_size=5).map(tuple)
part = st.floats(0, 1)
asks = st.lists(st.builds(Ask, texts | st.integers(0, 99), part, part, st.booleans()), max_size=3).map(tuple)
cameras = st.just(()) | st.lists(st.floats(-1e6, 1e6), min_size=9, max_size=9).map(tuple)
# A state is built in the test: beartype, which looks at a random entry of each tuple, would do so while drawing.
parts_of_states = st.tuples(things, part, part, st.booleans(), st.sampled_from(PAINTS), asks, asks, cameras)


def test_a_line_asks_for_each_text_once():
    state = asked(ViewState(things=(7,)), " red mug ;; blue bowl;red mug; ")
    assert state.things == ("red mug", "blue bowl")
    assert line_of(state) == "red mug; blue bowl"
    assert asked(state, " ; ").things == ()
    assert len(asked(state, ";".join(map(str, range(99)))).things) == MOST


def test_a_click_lights_up_takes_away_and_adds():
    state = clicked(MUG, 3)
    assert state.things == (3,)
    assert clicked(state, 3).things == ()
    assert clicked(MUG, 3, more=True).things == ("red mug", 3)
    both = clicked(state, 4, more=True)
    assert both.things == (3, 4)
    assert clicked(both, 3, more=True).things == (4,)
    assert clicked(both, 3).things == (3,)
    full = ViewState(things=tuple(range(MOST)))
    assert clicked(full, 99, more=True).things == (*range(1, MOST), 99)


def test_another_candidate_takes_the_place_of_its_thing():
    state = asked(ViewState(), "a; b; c")
    assert instead(state, 1, 5).things == ("a", 5, "c")
    assert instead(ViewState(things=("a", 5)), 0, 5).things == (5,)


def test_controls_apply_to_all_that_is_lit_up_and_stay_within_their_ends():
    state = moved(asked(MUG, "a; b"), threshold=0.7, whole=2, every=True, paint="code")
    assert state.asks == (Ask("a", 0.7, 1.0, True), Ask("b", 0.7, 1.0, True))
    assert state.paint == "code"
    assert moved(state, threshold=-1).threshold == 0


def test_only_and_hidden_keep_how_they_were_asked():
    only = shown_only(moved(MUG, threshold=0.7))
    assert only.only == (Ask("red mug", 0.7),)
    assert only.things == MUG.things
    assert moved(only, threshold=0.2).only == (Ask("red mug", 0.7),)
    assert shown_only(asked(only, "")) == asked(only, "")
    gone = hidden(MUG)
    assert gone.things == ()
    assert gone.hidden == (Ask("red mug"),)
    again = hidden(clicked(gone, 4))
    assert again.hidden == (Ask("red mug"), Ask(4))
    assert hidden(asked(again, "red mug")).hidden == again.hidden
    assert all_shown(shown_only(clicked(again, 1))) == ViewState(things=(1,))


def test_undo_leads_back_and_a_slider_is_one_step():
    history = History().then(MUG)
    for value in (0.6, 0.7, 0.8):
        history = history.then(moved(history.state, threshold=value))
    assert len(history.past) == 2
    assert history.then(history.state) is history
    for change in ({"whole": 0.1}, {"threshold": 0.9}, {"threshold": 0.7}):
        history = history.then(moved(history.state, **change))
    expected = [{"threshold": 0.8, "whole": 0.1}, {"threshold": 0.8}, {}]
    for state in (*(moved(MUG, **controls) for controls in expected), ViewState(), ViewState()):
        history = history.back()
        assert history.state == state
    long = History()
    for k in range(300):
        long = long.then(clicked(ViewState(), k))
    assert len(long.past) == History.LENGTH


@given(parts_of_states)
def test_a_link_keeps_the_state(parts):
    state = ViewState(*parts)
    assert state_of(link_of(state)) == state
    assert "\n" not in link_of(state)


def test_a_link_holds_only_what_is_not_as_usual():
    assert link_of(ViewState()) == "{}"
    assert json.loads(link_of(asked(ViewState(), "blaue Tasse ä"))) == {"things": ["blaue Tasse ä"]}


@pytest.mark.parametrize(
    "line",
    ["", "red mug", "[]", "7", "null", "{", '{"things": "red"}', '{"things": [-1]}', '{"things": [1.5]}',
     '{"things": [true]}', '{"things": [""]}', '{"things": [["a"]]}', '{"threshold": 2}', '{"threshold": "a"}',
     '{"whole": NaN}', '{"every": 1}', '{"paint": "red"}', '{"paint": []}', '{"camera": [1, 2]}', '{"only": [1]}',
     '{"camera": [1, 1, 1, 1, 1, 1, 1, 1, Infinity]}', '{"only": [{"thing": -2}]}', '{"hidden": [{"text": "a"}]}',
     '{"file": "/etc/passwd"}', '{"things": 4}', "[" * 100_000, json.dumps({"things": list(range(MOST + 1))})],
)  # fmt: skip
def test_what_is_no_link_is_refused(line):
    with pytest.raises(InputError, match="link"):
        state_of(line)


def test_tints_differ_and_stay():
    assert tints(0).shape == (0, 3)
    many = tints(12).astype(int)
    np.testing.assert_array_equal(tints(3), many[:3])
    apart = np.abs(many[:, None] - many[None]).sum(-1)
    assert apart[~np.eye(12, dtype=bool)].min() > 40


def test_what_is_seen():
    a, b = np.array([1, 1, 0, 0], bool), np.array([0, 1, 1, 0], bool)
    np.testing.assert_array_equal(shown(4, [], []), [1, 1, 1, 1])
    np.testing.assert_array_equal(shown(4, [a, b], []), [1, 1, 1, 0])
    np.testing.assert_array_equal(shown(4, [], [b]), [1, 0, 0, 1])
    np.testing.assert_array_equal(shown(4, [a, b], [b]), [1, 0, 0, 0])


def test_what_answers_lights_up_and_the_rest_dims():
    base = np.array([[200, 100, 0]] * 4, np.uint8)
    assert lit(base, [], []) is base
    a, b = np.array([1, 1, 0, 0], bool), np.array([0, 1, 1, 0], bool)
    first, second = np.array([0.9, 0.6, 0.1, 0], np.float32), np.array([0, 0.8, np.nan, 0], np.float32)
    colours = lit(base, [a, b], [first, second]).astype(int)
    own = (0.45 * base[0] + 0.55 * tints(2)).astype(int)
    np.testing.assert_allclose(colours[:3], [own[0], own[1], own[1]], atol=1)
    assert 0 < colours[3].max() < 0.5 * 200
    assert np.ptp(colours[3]) < 0.6 * colours[3].max()  # of a colour whose least channel is 0
    np.testing.assert_array_equal(base, [[200, 100, 0]] * 4)


def test_scores_as_colours():
    most = scored([np.array([0, 0.5, np.nan, 1], np.float32), np.array([0, 0.2, 0, 0.3], np.float32)], 4)
    assert most[0].tolist() == [18, 20, 60]
    assert most[2].tolist() == most[0].tolist()
    assert most[3].tolist() == [252, 250, 190]
    assert np.argmax(most[1]) == 0
    assert (scored([], 3) == 110).all()


def test_states_are_values():
    assert len({MUG, asked(ViewState(), "red mug"), ViewState()}) == 2
    with pytest.raises(dataclasses.FrozenInstanceError):
        MUG.paint = "code"  # type: ignore[misc]
