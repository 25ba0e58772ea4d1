"""The export's command line and its verdicts; the export itself needs torch (extra `export`) and is no part of CI."""

import pytest

from experiments.export_models import Options, parsed, table


def test_options_come_from_the_command_line():
    assert parsed([]) == Options()
    found = parsed(["--only", "sam", "siglip", "--threads", "2", "--sam", "vit_l", "--out", "there"])
    assert (found.only, found.threads, found.sam, found.out) == (("sam", "siglip"), 2, "vit_l", "there")
    with pytest.raises(SystemExit):
        parsed(["--only", "sam3"])


def test_the_table_says_what_is_within_the_bounds():
    graph = {"graph": "a.onnx", "outputs": {"x": 1e-6}, "scales": {"x": 3.0}, "same_signs": {"x": 1.0}}
    graphs = [graph, graph | {"outputs": {"x": 1e-6, "y": 2e-3}}, graph | {"same_signs": {"x": 0.998}}]
    metrics = {"sam_images": {"tiny": {"graphs": graphs}}}
    rows = table(metrics).splitlines()[2:]
    assert [row.split("|")[-2].strip() for row in rows] == ["yes", "no", "no"]
    assert "2.0e-03" in rows[1]
    assert "99.80000%" in rows[2]
