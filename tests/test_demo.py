"""`jsecon demo` on a small room: what it writes, and that a second call finds it all done; the room that is shipped."""

import json

import numpy as np
import pytest

from jsecon import load_capture, load_field, load_gaussians
from jsecon.app import pictures
from jsecon.app.catalogue import main_regions
from jsecon.demo import demo
from jsecon.pipeline.progress import Console
from jsecon.read.masks.labels import load_lerf_labels
from jsecon.read.masks.masks import load_labels

pytestmark = pytest.mark.long  # .ci/run makes the whole demo


class Ears(Console):
    """Keeps what is said."""

    def __init__(self):
        super().__init__()
        self.said, self.fresh = [], {}

    def print_line(self, text):
        self.said.append(text)

    def done(self, name, seconds, fresh):
        self.fresh[name] = self.fresh.get(name, False) or fresh


@pytest.fixture(scope="module")
def finished(room, tmp_path_factory):
    out, ears = tmp_path_factory.mktemp("demo"), Ears()
    metrics = demo.run_demo(out, steps=150, console=ears, room=room)
    assert any("jsecon view" in line for line in ears.said)
    return metrics, out


def test_field_answers_and_figures_are_on_disk(finished):
    metrics, out = finished
    assert json.loads((out / "metrics.json").read_text()) == metrics
    assert metrics["anchored"]["pairs"] >= 10
    assert all(0 <= metrics["anchored"][name] <= 1 for name in ("miou", "macc", "loc_acc"))
    field = load_field(out / "field.safetensors")
    assert (field.regions.count, field.gaussians.count) == (metrics["regions"], metrics["gaussians"])
    records = [json.loads(path.read_text()) for path in (out / "queries").glob("*.json")]
    assert {record["query"] for record in records} == {
        name for frame in load_lerf_labels(out / "capture" / "label") for name in frame.objects
    }
    for record in records:
        if record["count"]:
            assert load_gaussians(out / "queries" / record["ply"]).count == record["count"]
    page = (out / "report.html").read_text()
    for text in (*(record["query"] for record in records), "mAcc@0.25", "Stages"):
        assert text in page
    assert page.count("IoU ") > len(records)
    assert "http" not in page


def test_a_second_call_finds_it_all_done(finished, room):
    metrics, out = finished
    before, ears = (out / "field.safetensors").read_bytes(), Ears()
    again = demo.run_demo(out, steps=150, console=ears, room=room)
    assert {name for name, fresh in ears.fresh.items() if fresh} == {"field"}
    assert (out / "field.safetensors").read_bytes() == before
    assert again["anchored"] == metrics["anchored"]


def test_regions_are_shown_in_colours_that_tell_them_apart(finished):
    _, out = finished
    field = load_field(out / "field.safetensors")
    colours = pictures.region_colours(field)
    known = main_regions(field) >= 0
    assert colours.shape == (field.gaussians.count, 3)
    assert ((colours >= 0) & (colours <= 1)).all()
    np.testing.assert_array_equal(colours[~known], np.full((int((~known).sum()), 3), pictures.UNKNOWN))
    assert colours[known].std(0).max() > 0.05


def test_the_shipped_room_is_a_whole_capture_of_at_most_a_megabyte_and_a_half():
    files = [path for path in demo.ROOM.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= 1_500_000
    scene = json.loads((demo.ROOM / "scene.json").read_text())
    capture = load_capture(demo.ROOM, holdout=scene["holdout"], downscale=1.0)
    assert capture.frames.shape == (30, 240, 320, 3)
    assert len(capture.points) == scene["points"] == 6000
    labels = load_lerf_labels(demo.ROOM / "label")
    assert [frame.name for frame in labels] == [capture.names[t] for t in np.flatnonzero(capture.held_out)]
    masks, ids, _ = load_labels(demo.ROOM / "masks", capture.names, capture.frames.shape[1:3])
    assert masks.shape == capture.frames.shape[:3]
    for frame in labels:  # labels and masks are of the same objects
        objects = {scene["objects"][str(k)] for k in np.asarray(ids)[np.unique(masks[capture.names.index(frame.name)])]}
        assert set(frame.objects) <= objects
