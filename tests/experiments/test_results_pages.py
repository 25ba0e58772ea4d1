"""The figures on the pages of results are those of the committed results."""

import json
import re
from pathlib import Path

import pytest

HOME = Path(__file__).resolve().parent.parent.parent
RESULTS = HOME / "experiments" / "results"
GUIDE, SPEED = HOME / "experiments" / "README.md", HOME / "benchmarks" / "results.md"
TABLES = ("lerf", "ovs3d", "replica")
# fmt: off
WORLDS = (
    "none", "parts", "groups", "shadow", "azimuth", "gap", "names", "lvis", "levels", "kinds", "camouflage", "together",
)
# fmt: on
"""rows of the tables of robustness"""


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


def test_equal_rules():
    readings, untrained, trained, published, fresh, high, shared, levels, _ = page("equal_rules")
    assert readings[0][0] == "reading"
    chosen = metrics("fair") | metrics("fair_replica")
    fresh_runs = metrics("fair_fresh") | metrics("fair_fresh_replica")
    high_runs = metrics("fair_fresh_high") | {"replica high": metrics("fair_high")["replica high"]}
    names = {"back-projection": "weighted back-projection"}

    def rows(runs, table, level):
        for title, ours, *cells in table[1:]:
            data, figure = title.split(", ", 1)
            key = f"{dict(LERF='lerf', Replica='replica').get(data, 'ovs3d')} {level}"
            yield runs[key], "miou_vala" if figure == "> 10/255" else "miou", ours, cells

    for runs, table in ((chosen, untrained), (chosen, trained), (fresh_runs, fresh)):
        methods = [re.split(r", (?:ahead|by)", title)[0] for title in table[0][2:]]
        for run, figure, ours, cells in rows(runs, table, "medium"):
            own = "ours, consensus" if "ours, with parts, miou" not in run else "ours, with parts"
            assert ours.startswith(f"**{run[f'{own}, {figure}']['mean']:.3f}**")
            for method, cell in zip(methods, cells, strict=True):
                row = run[f"{names.get(method, method)}, {figure}"]
                mean, low, above = row["ahead"]
                assert cell == f"{row['mean']:.3f}, {mean:+.3f} [{low:+.3f}, {above:+.3f}]"
    for run, figure, _, (best, ahead) in rows(high_runs, high, "high"):
        method, told = best.rsplit(" ", 1)
        row = run[f"{names.get(method, method)}, {figure}"]
        mean, low, above = row["ahead"]
        assert (told, ahead) == (f"{row['mean']:.3f}", f"{mean:+.3f} [{low:+.3f}, {above:+.3f}]")
    of_shared = metrics("fair_shared")["lerf shared"]
    for method, *cells in shared[1:]:
        runs = [of_shared[f"{method}, {figure}"] for figure in ("miou", "miou_vala")]
        assert [cells[1].strip("*"), cells[3].strip("*")] == [f"{run['mean']:.3f}" for run in runs]
        if not method.startswith("ours"):
            assert cells[0] == f"{runs[0]['published']:.3f}"
            assert [cells[2], cells[4]] == ["{:+.3f} [{:+.3f}, {:+.3f}]".format(*run["ahead"]) for run in runs]
    of_levels = metrics("fair_thresholds")
    for level, *cells in levels[1:]:
        for figure, told in (("miou", cells[:3]), ("miou_vala", cells[3:])):
            row = of_levels[f"lerf {level}"][f"Occam's LGS, {figure}"]
            ahead = "{:+.3f} [{:+.3f}, {:+.3f}]".format(*row["ahead"])
            assert told == [f"{row['ours there']:.3f}", f"{row['mean']:.3f}", ahead]
    for method, *cells in published[1:]:
        runs = [chosen[f"{name} medium"][f"{method}, miou"]["published"] for name in TABLES]
        assert cells == [f"{value:.3f}" for value in runs]


def test_robustness():
    untrained, trained = page("robustness")
    worlds = [tables(RESULTS / "worlds" / "table.md")[n] for n in (0, 1, 2, 3)]
    for table, pair in ((untrained, worlds[:2]), (trained, worlds[2:])):
        rows = [{row[0]: row for row in t} for t in pair]
        titles = pair[0][0]
        for name, cells in zip(WORLDS, (row[1:] for row in table[1:]), strict=True):
            key = f"{name} {0 if name == 'none' else 1}"
            for method, cell in zip(table[0][1:], cells, strict=True):
                if method == "best without training":
                    columns = [titles.index(m) for m in ("Occam's LGS", "weighted back-projection", "VALA")]
                else:
                    columns = [titles.index(method.replace("back-projection", "weighted back-projection"))]
                told = cell.replace("*", "").split(" / ")
                assert told == [max(row[key][n] for n in columns) for row in rows], (key, method)


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
    assert len(GUIDE.read_text().split()) <= 2500
    assert len(SPEED.read_text().split()) <= 2000
