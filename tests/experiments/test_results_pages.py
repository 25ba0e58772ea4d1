"""The figures on the pages of results are those of the committed results."""

import json
import re
from pathlib import Path

import pytest

HOME = Path(__file__).resolve().parent.parent.parent
RESULTS = HOME / "experiments" / "results"
GUIDE = HOME / "experiments" / "README.md"
TABLES = ("lerf", "ovs3d", "replica")


def tables(path):
    """Tables of a Markdown file: lists of rows without the line under the header; jsecon is "ours" in the results."""
    blocks = re.findall(r"(?:^\|.*(?:\n|\Z))+", path.read_text(), re.MULTILINE)
    split = [[[cell.strip() for cell in line.strip().strip("|").split("|")] for line in b.splitlines()] for b in blocks]
    return [[[cell.replace("jsecon, ", "ours, ") for cell in row] for row in (t[0], *t[2:])] for t in split]


def page(name):
    return tables(HOME / "docs" / "results" / f"{name}.md")


def metrics(name):
    return json.loads((RESULTS / name / "metrics.json").read_text())


@pytest.mark.parametrize("name", TABLES)
def test_tables_1_to_3(name):
    """The pages repeat columns of the committed tables, which are what the committed cells give (test_tables)."""
    whole, noise = (next(t for t in tables(RESULTS / name / "table.md") if key in t[0]) for key in ("mean miou", "low"))
    columns = {"mIoU": "mean miou", "mAcc": "mean macc", "mIoU, > 10/255": "mean miou_vala"}
    by_mean, by_scene, by_noise = page(name)
    for table in (by_mean, by_scene):
        places = [whole[0].index(columns.get(title, f"{title} miou")) for title in table[0][1:]]
        assert [row[1:] for row in table[1:]] == [[row[n] for n in places] for row in whole[1:]]
        assert [row[0] for row in table] == [row[0] for row in whole]
    assert by_noise == noise


def test_tables_4_and_5_and_thresholds():
    components, queries, _, lost, _ = page("ablations")
    means = list(metrics("ablation_components")["means"].values())
    assert [row[1] for row in components[1:]] == [f"{mean:.3f}" for mean in means]
    by_query = metrics("ablation_query")["means"]
    told = sorted(figure for row in queries[1:] for figure in row[1:] if figure)
    assert told == sorted(f"{mean:.3f}" for mean in by_query.values())
    sweep = {row[0]: row for row in tables(RESULTS / "threshold_sweep" / "table.md")[1]}
    names = {"one-step": "one_step", "canonical": "canonical", "spread codes": "code", "share of the votes": "votes"}
    for row in lost[1:]:
        _, _, _, low, high, loss = sweep[names[row[0]]]
        assert row[2] == loss
        assert [abs(float(a) - float(b)) <= 0.0051 for a, b in zip(row[1].split(" to "), (low, high))] == [True, True]


def test_shared_errors_and_exports_and_real_captures():
    measured = {row[0]: row[1:] for row in tables(RESULTS / "shared_errors" / "table.md")[0]}
    for name, *cells in page("shared_errors")[0][1:]:
        known = measured.get(name, [])
        assert not known or cells[:6] == known[:6], name
    assert sum(row[0] in measured for row in page("shared_errors")[0]) >= 5
    assert page("exports")[0] == tables(RESULTS / "export_models" / "table.md")[0]
    assert page("real_captures")[0] == tables(RESULTS / "apc_bin" / "table.md")[0]
    assert page("real_captures")[1] == tables(RESULTS / "replica_apartment_0" / "table.md")[0]


def test_the_guide_repeats_the_pages():
    claims = {row[1].strip("`").split("`")[0]: row[3] for row in tables(GUIDE)[0][1:]}
    for name in TABLES:
        means = metrics(name)["means"]
        other = max(mean for method, mean in means.items() if not method.startswith("ours"))
        told = re.findall(r"0\.\d{3}", claims[f"python -m experiments.{name}"])
        assert told == [f"{means['ours, consensus']:.3f}", f"{other:.3f}"]
