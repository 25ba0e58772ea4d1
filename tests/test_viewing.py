"""The states of a viewer: what leads from one to the next, back, and through a link; and the colours that follow."""

import json

import numpy as np
import pytest
from hypothesis import given, strategies as st

from jsecon.app.viewer.view_state import (
    COLOURINGS,
    MAX_QUERIES,
    MAX_UNDO,
    History,
    ViewQuery,
    ViewState,
    answer_colours,
    from_link,
    highlight,
    score_colours,
)
from jsecon.errors import InputError

MUG = ViewState().with_texts("red mug")

texts = st.text(min_size=1, max_size=30).filter(str.strip)
things = st.lists(texts | st.integers(0, 10_000), max_size=5).map(tuple)
part = st.floats(0, 1)
asks = st.lists(st.builds(ViewQuery, texts | st.integers(0, 99), part, part, st.booleans()), max_size=3).map(tuple)
cameras = st.just(()) | st.lists(st.floats(-1e6, 1e6), min_size=9, max_size=9).map(tuple)
# A state is built in the test: beartype, which looks at a random entry of each tuple, would do so while drawing.
parts_of_states = st.tuples(things, part, part, st.booleans(), st.sampled_from(COLOURINGS), asks, asks, cameras)


def test_a_line_asks_for_each_text_once():
    state = ViewState(queries=(7,)).with_texts(" red mug ;; blue bowl;red mug; ")
    assert state.queries == ("red mug", "blue bowl")
    assert state.text_line == "red mug; blue bowl"
    assert state.with_texts(" ; ").queries == ()
    assert len(state.with_texts(";".join(map(str, range(99)))).queries) == MAX_QUERIES


def test_a_click_lights_up_takes_away_and_adds():
    state = MUG.toggle_region(3)
    assert state.queries == (3,)
    assert state.toggle_region(3).queries == ()
    assert MUG.toggle_region(3, add=True).queries == ("red mug", 3)
    both = state.toggle_region(4, add=True)
    assert both.queries == (3, 4)
    assert both.toggle_region(3, add=True).queries == (4,)
    assert both.toggle_region(3).queries == (3,)
    full = ViewState(queries=tuple(range(MAX_QUERIES)))
    assert full.toggle_region(99, add=True).queries == (*range(1, MAX_QUERIES), 99)


def test_another_candidate_takes_the_place_of_its_thing():
    state = ViewState().with_texts("a; b; c")
    assert state.replace_match(1, 5).queries == ("a", 5, "c")
    assert ViewState(queries=("a", 5)).replace_match(0, 5).queries == (5,)


def test_controls_apply_to_all_that_is_lit_up_and_stay_within_their_ends():
    state = MUG.with_texts("a; b").with_controls(threshold=0.7, part_vs_whole=2, all_matches=True, colouring="region")
    assert state.view_queries == (ViewQuery("a", 0.7, 1.0, True), ViewQuery("b", 0.7, 1.0, True))
    assert state.colouring == "region"
    assert state.with_controls(threshold=-1).threshold == 0
    grown = MUG.with_controls(shells=-2)
    assert from_link(grown.link).view_queries == (ViewQuery("red mug", shells=-2),)


def test_only_and_hidden_keep_how_they_were_asked():
    only = MUG.with_controls(threshold=0.7).isolate()
    assert only.isolated == (ViewQuery("red mug", 0.7),)
    assert only.queries == MUG.queries
    assert only.with_controls(threshold=0.2).isolated == (ViewQuery("red mug", 0.7),)
    assert only.with_texts("").isolate() == only.with_texts("")
    gone = MUG.hide()
    assert gone.queries == ()
    assert gone.hidden == (ViewQuery("red mug"),)
    again = gone.toggle_region(4).hide()
    assert again.hidden == (ViewQuery("red mug"), ViewQuery(4))
    assert again.with_texts("red mug").hide().hidden == again.hidden
    assert again.toggle_region(1).isolate().show_all() == ViewState(queries=(1,))


def test_undo_leads_back_and_a_slider_is_one_step():
    history = History().then(MUG)
    for value in (0.6, 0.7, 0.8):
        history = history.then(history.state.with_controls(threshold=value))
    assert len(history.past) == 2
    assert history.then(history.state) is history
    for change in ({"part_vs_whole": 0.1}, {"threshold": 0.9}, {"threshold": 0.7}):
        history = history.then(history.state.with_controls(**change))
    expected = [{"threshold": 0.8, "part_vs_whole": 0.1}, {"threshold": 0.8}, {}]
    for state in (*(MUG.with_controls(**controls) for controls in expected), ViewState(), ViewState()):
        history = history.back()
        assert history.state == state
    long = History()
    for k in range(300):
        long = long.then(ViewState().toggle_region(k))
    assert len(long.past) == MAX_UNDO


@given(parts_of_states)
def test_a_link_keeps_the_state(parts):
    state = ViewState(*parts)
    assert from_link(state.link) == state
    assert "\n" not in state.link


def test_a_link_holds_only_what_is_not_as_usual():
    assert ViewState().link == "{}"
    assert json.loads(ViewState().with_texts("blaue Tasse ä").link) == {"queries": ["blaue Tasse ä"]}


@pytest.mark.parametrize(
    "line",
    ["", "red mug", "[]", "7", "null", "{", '{"queries": "red"}', '{"queries": [-1]}', '{"queries": [1.5]}',
     '{"queries": [true]}', '{"queries": [""]}', '{"queries": [["a"]]}', '{"threshold": 2}', '{"threshold": "a"}',
     '{"part_vs_whole": NaN}', '{"all_matches": 1}', '{"colouring": "red"}', '{"colouring": []}',
     '{"camera": [1, 2]}', '{"shells": 9}', '{"shells": 0.5}', '{"isolated": [1]}',
     '{"camera": [1, 1, 1, 1, 1, 1, 1, 1, Infinity]}', '{"isolated": [{"query": -2}]}', '{"hidden": [{"text": "a"}]}',
     '{"file": "/etc/passwd"}', '{"queries": 4}', "[" * 100_000, json.dumps({"queries": list(range(MAX_QUERIES + 1))})],
)  # fmt: skip
def test_what_is_no_link_is_refused(line):
    with pytest.raises(InputError, match="link"):
        from_link(line)


def test_tints_differ_and_stay():
    assert answer_colours(0).shape == (0, 3)
    many = answer_colours(12).astype(int)
    np.testing.assert_array_equal(answer_colours(3), many[:3])
    apart = np.abs(many[:, None] - many[None]).sum(-1)
    assert apart[~np.eye(12, dtype=bool)].min() > 40


def test_what_answers_lights_up_and_the_rest_dims():
    base = np.array([[200, 100, 0]] * 4, np.uint8)
    assert highlight(base, [], []) is base
    a, b = np.array([1, 1, 0, 0], bool), np.array([0, 1, 1, 0], bool)
    first, second = np.array([0.9, 0.6, 0.1, 0], np.float32), np.array([0, 0.8, np.nan, 0], np.float32)
    colours = highlight(base, [a, b], [first, second]).astype(int)
    own = (0.45 * base[0] + 0.55 * answer_colours(2)).astype(int)
    np.testing.assert_allclose(colours[:3], [own[0], own[1], own[1]], atol=1)
    assert 0 < colours[3].max() < 0.5 * 200
    assert np.ptp(colours[3]) < 0.6 * colours[3].max()  # of a colour whose least channel is 0
    np.testing.assert_array_equal(base, [[200, 100, 0]] * 4)


def test_scores_as_colours():
    most = score_colours([np.array([0, 0.5, np.nan, 1], np.float32), np.array([0, 0.2, 0, 0.3], np.float32)], 4)
    assert most[0].tolist() == [18, 20, 60]
    assert most[2].tolist() == most[0].tolist()
    assert most[3].tolist() == [252, 250, 190]
    assert np.argmax(most[1]) == 0
    assert (score_colours([], 3) == 110).all()
