"""What the viewer's panel says of answers, and the candidates as HTML."""

import dataclasses
import re

import numpy as np
import pytest
from small_field import colour_field

from jsecon import Region, Scene
from jsecon.app.viewer.candidates import Candidate
from jsecon.app.viewer.panel import candidate_grid, messages
from jsecon.app.viewer.view_state import ViewState
from jsecon.errors import InputError
from jsecon.vision.colours import ColourEmbedder

EMBEDDER = ColourEmbedder()


@pytest.fixture(scope="module")
def field(scene, cameras):
    return colour_field(scene, cameras)


def test_an_answer_is_told_with_how_many_and_how_sure(field):
    answer = Scene(field, EMBEDDER).ask(Region(1))
    text = messages(field, ViewState((1,)), [answer])
    assert f"<b>region 1</b>: {answer.mask.sum()} Gaussians, membership" in text
    assert 50 <= int(re.search(r"membership (\d+) %", text).group(1)) <= 100
    assert "score" not in text  # of what was pointed at: it is no similarity


def test_what_has_no_answer_is_told_and_why(field):
    nothing, answer = (Scene(field, EMBEDDER).ask(Region(region)) for region in (99, 1))
    assert "no match: the best score is 0.00, and 0.2" in messages(field, ViewState(("x",)), [nothing])
    none_left = dataclasses.replace(answer, mask=np.zeros(64, bool))
    assert "no Gaussian reaches the threshold 0.50" in messages(field, ViewState((1,)), [none_left])
    with pytest.raises(InputError) as error:
        Scene(field, EMBEDDER).ask("<b>a thing")
    text = messages(field, ViewState(("<b>a thing",)), [error.value])
    assert "no colour word" in text
    assert "<b>&lt;b&gt;a thing</b>" in text


def test_several_answers_have_swatches_of_their_own(field):
    text = messages(
        field, ViewState((0, 1)), [Scene(field, EMBEDDER).ask(Region(0)), Scene(field, EMBEDDER).ask(Region(1))]
    )
    first, second = re.findall(r"background:(#\w{6})", text)
    assert first != second


def test_the_candidate_that_was_taken_is_marked(field):
    answer, picture = Scene(field, EMBEDDER).ask(Region(1)), np.full((20, 40, 3), (200, 30, 30), np.uint8)
    found = [(0, Candidate(1, 0.5, 0), picture), (0, Candidate(3, 0.25, 0), picture)]
    text = candidate_grid([answer], found)
    assert re.findall(r"(\d): (\d\.\d+)(, selected)?", text) == [("1", "0.50", ", selected"), ("2", "0.25", "")]
    assert text.count("data:image/jpeg;base64,") == 2
    assert text.count("solid transparent") == 1
    assert 'style="display:grid' in candidate_grid([], [])
