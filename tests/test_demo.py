"""`jsecon demo`, whole, on a room as small as it can be: what it writes, and that a second call finds it all done."""

import json
import time

import cv2
import numpy as np
import pytest
from PIL import Image

from jsecon import load_field, load_ply
from jsecon.app import pictures
from jsecon.demo import demo, film as film_of
from jsecon.pipeline.progress import Listener
from jsecon.process import peak_memory_mib

pytestmark = pytest.mark.long  # .ci/run makes the whole demo
ROOM = {"views": 8, "width": 160, "height": 120, "points": 1200, "holdout": 4}


class Ears(Listener):
    """Keeps what is said."""

    def __init__(self):
        self.said, self.fresh = [], {}

    def say(self, text):
        self.said.append(text)

    def done(self, name, seconds, fresh):
        self.fresh[name] = self.fresh.get(name, False) or fresh


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out, ears, began = tmp_path_factory.mktemp("demo"), Ears(), time.monotonic()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(film_of, "SECONDS", 2)
        metrics = demo.run_demo(out, steps=150, listener=ears, room=ROOM)
    assert any("jsecon view" in line for line in ears.said)
    return metrics, out, time.monotonic() - began


def test_metrics_have_every_figure_that_is_promised(finished):
    metrics, out, seconds = finished
    assert json.loads((out / "metrics.json").read_text()) == metrics
    for kind in ("anchored", "all", "true_masks"):
        assert set(metrics[kind]) >= {"miou", "macc", "loc_acc"}
        assert all(0 <= metrics[kind][name] <= 1 for name in ("miou", "macc", "loc_acc"))
    assert metrics["true_masks"]["miou"] > 0.25  # a tiny room and a short fit: far from the figures and from chance
    assert metrics["anchored"]["pairs"] == metrics["true_masks"]["pairs"] >= 15
    assert {"gaussians", "masklets", "votes", "votes (true masks)", "field"} <= set(metrics["seconds"])
    assert 0 < sum(metrics["seconds"].values()) <= seconds
    assert metrics["total_seconds"] == pytest.approx(sum(metrics["seconds"].values()), abs=0.2)
    assert {"segmenter (true masks)", "DBSCAN"} <= set(metrics["skipped"])
    assert metrics["peak_memory_mib"] == pytest.approx(peak_memory_mib(), rel=0.05)


def test_both_fields_and_the_answers_are_on_disk(finished):
    """The two runs share frames and Gaussians; the default one knows nothing of masks."""
    metrics, out, _ = finished
    field, true = (load_field(out / name / "field.safetensors") for name in (".", "true_masks"))
    assert field.regions.count == metrics["regions"]
    assert true.regions.count >= 10
    np.testing.assert_array_equal(field.gaussians.means, true.gaussians.means)
    for stage in ("gaussians", "load"):
        assert len(list((out / "cache").glob(f"{stage}-*.safetensors"))) == 1
    options = json.loads(field.provenance)["options"]
    assert options["masks"] is None
    assert options["gaussians"] is None
    told = [json.loads(path.read_text()) for path in (out / "queries").glob("*.json")]
    assert len(told) >= 10
    for answer in told:
        if answer["count"]:
            assert load_ply(out / "queries" / answer["ply"]).count == answer["count"]


def test_the_report_shows_every_query_and_stands_alone(finished):
    _, out, _ = finished
    page = (out / "report.html").read_text()
    queries = [json.loads(path.read_text())["query"] for path in (out / "queries").glob("*.json")]
    words = "true masks given", "Seconds of each stage", "this scene does not need", "Held-out frames", "Settings"
    for text in (*queries, *words, "mAcc@0.25"):
        assert text in page
    assert page.count('class="pair"') == len(queries)
    assert page.count('class="wide"') > 3  # masklets through the frames
    assert "http" not in page


def test_the_pictures_show_the_room_and_turn_around_it(finished):
    _, out, _ = finished
    image = cv2.imread(str(out / "demo.jpg"))
    assert image.shape == (120 + 26, 4 * 160 + 3 * 6, 3)
    with Image.open(out / "demo.webp") as film:
        assert film.n_frames == 2 * film_of.FRAMES_PER_SECOND
        assert film.size == (320, 240)
    assert (out / "demo.webp").stat().st_size < 2 * 2**20


def test_a_second_call_finds_it_all_done(finished, monkeypatch):
    monkeypatch.setattr(film_of, "SECONDS", 2)
    metrics, out, _ = finished
    before, ears = (out / "field.safetensors").read_bytes(), Ears()
    again = demo.run_demo(out, steps=150, listener=ears, room=ROOM)
    assert {name for name, fresh in ears.fresh.items() if fresh} == {"field"}
    assert (out / "field.safetensors").read_bytes() == before
    assert again["anchored"] == metrics["anchored"]


def test_regions_are_shown_in_colours_that_tell_them_apart(finished):
    _, out, _ = finished
    field = load_field(out / "field.safetensors")
    colours = pictures.region_colours(field)
    known = pictures.main_regions(field) >= 0
    assert colours.shape == (field.gaussians.count, 3)
    assert ((colours >= 0) & (colours <= 1)).all()
    np.testing.assert_array_equal(colours[~known], np.full((int((~known).sum()), 3), pictures.UNKNOWN))
    assert colours[known].std(0).max() > 0.05
