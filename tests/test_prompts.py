"""Guided prompts: a point in each region by colour, then in what the masks of these do not explain."""

import numpy as np

from jsecon.networks.sam import _MAX_PROMPTS, _GuidedPrompts, _innermost_pixels


def frame_of_two_things():
    """Two things of one colour that touch, so that they are one region, on a wall."""
    frame = np.full((90, 120, 3), 200, np.uint8)
    things = np.zeros((2, 90, 120), bool)
    things[0, 20:60, 20:60] = things[1, 30:50, 60:80] = True
    frame[things.any(0)] = (200, 30, 30)
    return frame, things


def test_each_patch_has_its_pixel_farthest_from_the_outline():
    patches = np.full((40, 60), -1, np.int32)
    patches[5:26, 10:31] = 7  # 21 px a side
    patches[30:33, 40:49] = 2
    assert _innermost_pixels(patches).tolist() == [[20, 15], [41, 31]]
    assert _innermost_pixels(patches, min_radius=2.0).tolist() == [[20, 15]]
    assert _innermost_pixels(np.full((4, 4), -1, np.int32)).shape == (0, 2)


def test_what_the_masks_of_a_region_leave_gets_the_next_points():
    frame, things = frame_of_two_things()
    prompts = _GuidedPrompts(frame, 1)
    first = prompts.next_points().astype(int)
    inside = [point for point in first if things[:, point[1], point[0]].any()]
    assert len(first) == 2
    assert [things[:, row, column].tolist() for column, row in inside] == [[True, False]]
    for point in first:
        own = things[0] if things[0, point[1], point[0]] else np.ones_like(things[0])  # a mask of all, from the wall
        prompts.explain(0, np.float32(point), own)
    second = prompts.next_points().astype(int)
    assert [things[:, row, column].tolist() for column, row in second] == [[False, True]]
    prompts.explain(0, np.float32(second[0]), things[1])
    assert len(prompts.next_points()) == 0


def test_prompts_end_where_no_mask_explains_anything():
    frame = np.random.default_rng(0).integers(0, 256, (12, 16, 3), dtype=np.uint8).repeat(20, 0).repeat(20, 1)
    prompts = _GuidedPrompts(frame, 3)
    rounds = []
    while len(points := prompts.next_points()):
        rounds.append(points)
    every = np.concatenate(rounds)
    assert len(rounds) <= 4
    assert len(np.unique(every, axis=0)) == len(every) <= _MAX_PROMPTS
