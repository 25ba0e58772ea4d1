"""What else an answer might be, with pictures, and the region that a ray meets."""

import dataclasses

import jax
import numpy as np
import pytest
from small_field import make_field

from jsecon import InputError, Scene, region_at
from jsecon.app.pictures import Renderer, main_regions
from jsecon.app.viewer.candidates import candidates, region_along
from jsecon.vision.colours import BASIC, ColourEmbedder

EMBEDDER = ColourEmbedder()


@pytest.fixture(scope="module")
def field(scene, cameras):
    return make_field(scene, cameras, dim=EMBEDDER.dim)[0]


def test_the_answer_is_the_first_candidate(field):
    for word in BASIC:
        found = candidates(field, EMBEDDER, word)
        selection = Scene(field, EMBEDDER).ask(word).selection
        assert len(found) == 5
        assert found[0].score == pytest.approx(float(selection.score), abs=1e-6)
        assert int(selection.region) in (-1, found[0].region)
        assert found[0].frame == int(np.asarray(field.regions.pixel_counts)[found[0].region].argmax())


def test_candidates_of_a_composite_text_are_those_of_its_wanted_parts(field):
    each = {word: {c.region: c.score for c in candidates(field, EMBEDDER, word)} for word in ("red", "blue", "green")}
    both = candidates(field, EMBEDDER, "red or blue but not green")
    near = {region: max(each["red"][region], each["blue"][region]) for region in each["red"]}
    assert {found.region for found in both} == {region for region in near if near[region] > each["green"][region]}
    assert 0 < len(both) < len(near)
    for found in both:
        assert found.score == pytest.approx(near[found.region])
    assert candidates(field, EMBEDDER, "red but not red") == []
    with pytest.raises(InputError, match="no colour word"):
        candidates(field, EMBEDDER, "the meaning of life")


def test_candidates_of_a_region_are_the_others_that_are_like_it(field):
    found = candidates(field, EMBEDDER, 2)
    assert {c.region for c in found} == {0, 1, 3, 4}
    assert [c.score for c in found] != sorted(c.score for c in found)  # the nearest first
    twin = np.array(field.regions.embeddings)
    twin[4] = twin[2]
    twins = dataclasses.replace(field, regions=dataclasses.replace(field.regions, embeddings=twin))
    assert candidates(twins, EMBEDDER, 2, 1)[0].region == 4
    assert candidates(twins, EMBEDDER, 2, 1)[0].score == pytest.approx(1, abs=1e-5)
    assert candidates(field, EMBEDDER, 99) == []  # of a region that is not there
    regions = jax.tree.map(lambda a: np.asarray(a)[:0], field.regions)
    assert candidates(dataclasses.replace(field, regions=regions), EMBEDDER, "red") == []


def test_a_region_is_pictured_where_its_gaussians_are(field):
    renderer, regions = Renderer(field.gaussians, field.cameras), main_regions(field)
    photo = renderer.photo(1)
    for region in range(5):
        part = renderer.crop(1, regions == region)
        height, width = part.shape[:2]
        assert height <= photo.shape[0]
        assert width <= photo.shape[1]
        windows = np.lib.stride_tricks.sliding_window_view(photo, part.shape)[..., 0, :, :, :]
        assert (windows == part).all((-3, -2, -1)).any(), "a part of the frame"
    np.testing.assert_array_equal(renderer.crop(1, regions == 99), photo)


@pytest.mark.parametrize("frame", [0, 2])
def test_a_ray_meets_the_region_of_its_pixel(field, frame):
    """Against the pixel's own region in the field's frame: the same ray, seen by another camera."""
    camera = jax.tree.map(np.asarray, field.cameras)[frame]
    turn, seen = camera.world_to_camera[:3, :3], np.ones(64, bool)
    agree = []
    for x, y in ((24, 20), (18, 14), (30, 26), (20, 28), (28, 12), (24, 30)):
        ray = turn.T @ [(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, 1]
        found = region_along(field, np.asarray(camera.centres), ray, focal=float(camera.fx), visible=seen)
        agree.append(found == region_at(field, frame, x, y))
    assert sum(agree) >= 5, agree  # the frame's own Jacobian differs off its axis


def test_a_ray_passes_what_is_hidden(field):
    camera = jax.tree.map(np.asarray, field.cameras)[0]
    ahead, centre = camera.world_to_camera[2, :3], np.asarray(camera.centres)
    everything = np.ones(64, bool)
    first = region_along(field, centre, ahead, focal=45.0, visible=everything)
    assert first >= 0
    behind = region_along(field, centre, ahead, focal=45.0, visible=main_regions(field) != first)
    assert behind != first
    assert region_along(field, centre, ahead, focal=45.0, visible=~everything) == -1
    assert region_along(field, centre, -ahead, focal=45.0, visible=everything) == -1
