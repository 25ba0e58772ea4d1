"""The export's command line and its verdicts; the export itself needs torch (extra `export`) and is no part of CI."""

import pytest

from experiments.export_models import Options, parsed, table


def test_options_come_from_the_command_line():
    assert parsed([]) == Options()
    found = parsed(["--only", "sam2", "tracking", "--frames", "5", "--sam2", "sam2.1_hiera_s", "--out", "there"])
    assert (found.only, found.frames, found.sam2, found.out) == (("sam2", "tracking"), 5, ("sam2.1_hiera_s",), "there")
    with pytest.raises(SystemExit):
        parsed(["--only", "sam3"])


def test_the_table_says_what_is_within_the_bounds():
    graph = {"graph": "a.onnx", "outputs": {"x": 1e-6}, "scales": {"x": 3.0}, "same_signs": {"x": 1.0}}
    clip = {"frames": 12, "objects": 3, "largest_logit_present": 9.0}
    metrics = {
        "sam2": {"tiny": [graph, graph | {"outputs": {"x": 1e-6, "y": 2e-3}}, graph | {"same_signs": {"x": 0.998}}]},
        "tracking": {"tiny": clip | {"largest_difference": [1e-5, 2e-4], "masks_same_pixels_least": 0.9995}},
    }
    rows = table(metrics).splitlines()[2:]
    assert [row.split("|")[-2].strip() for row in rows] == ["yes", "no", "no", "yes"]
    assert "2.0e-04" in rows[3]
    assert "99.95000%" in rows[3]
