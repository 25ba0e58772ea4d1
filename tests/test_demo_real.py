"""`jsecon demo --real`: the demo's report of a capture that nobody labelled."""

import json

import numpy as np
import pytest

from jsecon.app import demo_real, film
from jsecon.errors import InputError
from jsecon.pipeline.networks import embedder_of_field
from jsecon.pipeline.progress import Listener


class Ears(Listener):
    def __init__(self):
        self.said = []

    def say(self, text):
        self.said.append(text)


@pytest.fixture(scope="module")
def finished(room, tmp_path_factory):
    """The demo of a room as somebody's own capture, its best colours asked."""
    out, ears = tmp_path_factory.mktemp("real") / "out", Ears()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(film, "SECONDS", 2)
        return demo_real.demo_real(room, out, steps=60, listener=ears), out, ears


def test_it_asks_the_colours_that_the_regions_answer_best(finished):
    metrics, out, _ = finished
    answers = metrics["answers"]
    assert 3 <= len(answers) <= demo_real.TEXTS
    scores = [told["score"] for told in answers.values()]
    assert scores == sorted(scores, reverse=True)
    regions = [told["region"] for told in answers.values()]
    assert len(set(regions)) == len(regions)
    assert all(told["count"] > 0 for told in answers.values())
    assert json.loads((out / "metrics.json").read_text()) == metrics
    assert len(list((out / "queries").glob("*.ply"))) == len(answers)


def test_the_report_knows_no_truth_and_shows_every_answer(finished):
    metrics, out, ears = finished
    page = (out / "report.html").read_text()
    assert "mIoU" not in page
    assert "IoU of each text" not in page
    assert page.count('class="pair"') == len(metrics["answers"])
    for words in ("Masklets through the frames", "Settings", "Seconds of each stage", "data:image/webp"):
        assert words in page
    assert (out / "demo.jpg").exists()
    assert any(f"jsecon view {out / 'field.npz'}" in line for line in ears.said)


def test_texts_are_asked_where_they_are_given_and_refused_before_any_work(finished, room, tmp_path, monkeypatch):
    monkeypatch.setattr(film, "SECONDS", 2)
    with pytest.raises(InputError, match="no colour word"):
        demo_real.demo_real(room, tmp_path / "none", texts=["teapot"], steps=60, listener=Listener())
    assert not (tmp_path / "none" / "cache").exists()
    _, out, _ = finished
    before = (out / "field.npz").read_bytes()
    texts = ["red mug", "dark green bottle"]
    again = demo_real.demo_real(room, out, texts=texts, steps=60, listener=Listener())
    assert list(again["answers"]) == texts
    assert (out / "field.npz").read_bytes() == before


def test_a_colour_is_the_best_of_all_for_its_region(finished):
    _, out, _ = finished
    from jsecon.language.field import load_field

    field = load_field(out / "field.npz")
    embedder = embedder_of_field(field)
    found = demo_real.colours_of(field, embedder)
    for answer in found.values():
        others = demo_real.answers_to(field, embedder, embedder.names)
        same = [o for o in others.values() if int(o.selection.region) == int(answer.selection.region)]
        best = max(float(o.selection.score) for o in same if np.asarray(o.mask).any())
        assert float(answer.selection.score) == pytest.approx(best)
