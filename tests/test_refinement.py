"""`--refine` of a run: which captures it looks at by default, what it decides, and what the plan tells of it."""

import dataclasses

import pytest
from capture_files import context_of, write_transforms
from test_alignment import in_a_corner, moved
from test_corrections import capture as capture, truth as truth  # fixtures
from test_fit import same

from jsecon.pipeline.run import _compute_stages
from jsecon.pipeline.scene_stages import plan_capture


def load(folder, out, **options):
    """What the first stage of a run makes of a capture, and what it told."""
    work = context_of(folder, out, holdout=6, steps=2000, **options)
    done = _compute_stages(work, plan_capture(work))
    return done.results.load, " ".join(done.notes), done.steps[0].status


@pytest.mark.long
@pytest.mark.parametrize(("exact", "says"), [(False, "refined by colour and depth"), (True, "stay as they are")])
def test_by_default_a_rough_capture_with_depth_is_corrected_once(tmp_path, exact, says):
    told = tmp_path / "told"
    write_transforms(in_a_corner() if exact else moved(in_a_corner(), 2.0, 1.0), told)
    as_it_is, _, _ = load(told, tmp_path / "none", refine="never")
    found = []
    for status in ("run", "cached"):
        better, notes, how = load(told, tmp_path / "out")
        assert how == status
        assert says in notes
        found.append(dataclasses.replace(better, notes=as_it_is.notes))
    assert same(*found)
    assert same(found[0], as_it_is) == exact


def test_without_depth_or_with_gaussians_nothing_is_tried(capture, tmp_path):
    def how(folder, **options):
        return plan_capture(context_of(folder, tmp_path / "out", **options))[-1]

    plain, deep = tmp_path / "plain", tmp_path / "deep"
    write_transforms(dataclasses.replace(capture, depths=None), plain)
    write_transforms(capture, deep)
    for one, other in (
        (how(plain), how(plain, refine="never")),
        (how(deep, gaussians=plain), how(deep, refine="never")),
    ):
        assert one.task == other.task
        assert one.key_options == other.key_options
    assert how(deep).key_options != how(deep, steps=300).key_options
    assert "corrected by short fits in about half" in how(deep).task
    assert how(deep, refine="always").task.endswith("corrected by short fits")
    assert "corrected" not in how(deep, refine="never").task
