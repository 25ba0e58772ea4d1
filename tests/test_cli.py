"""The command line: what each verb leaves behind, and one clear message and exit code 2 for each kind of bad input."""

import json
import re
import shlex
import shutil
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from capture_files import ROOM_FIT, run_cli

from jsecon.app import cli, verbs
from jsecon.pipeline import progress
from jsecon.pipeline.options import Options
from jsecon.pipeline.progress import Console
from jsecon.process import peak_memory_mib
from jsecon.read.splats.files import load_gaussians
from jsecon.splat.transform import transform_gaussians

VERB_NAMES = [kind.__name__.lower() for kind in verbs.VERBS]
FITTED = [word for name, value in ROOM_FIT.items() for word in (f"--{name.replace('_', '-')}", value)]
"""options of `room_run`'s fit"""


@pytest.fixture
def capture(room, tmp_path):
    """A copy of the tiny room, to be damaged."""
    return shutil.copytree(room, tmp_path / "capture")


# What the verbs do


def _object(capsys, *arguments):
    """What a verb prints with --json: one object and nothing else; and its words, on standard error."""
    assert run_cli(*arguments, "--json") == 0
    out, err = capsys.readouterr()
    assert out.count("\n") == 1
    return json.loads(out), err


def test_run_writes_field_metrics_and_report_and_tells_its_plan(room, room_run, tmp_path, capsys):
    run, out = room_run
    shutil.copytree(out / "cache", tmp_path / "out" / "cache")  # the stages are cached: only the verb itself is tested
    options = "--masks", room / "masks", *FITTED
    line = "run", room, "--out", tmp_path / "out", *options
    told, words = _object(capsys, *line, "--dry-run")
    assert {stage["status"] for stage in told["stages"]} == {"cached", "skipped"}
    assert not (tmp_path / "out" / "field.safetensors").exists()
    plan = words.partition("Nothing was written.")[0].splitlines()[1:]
    assert len(plan) >= 8
    told, words = _object(capsys, *line)
    assert words.splitlines()[1 : len(plan) + 1] == plan
    assert told["gaussians"] == run.field.gaussians.count
    assert all(Path(file).exists() for file in told["written"])
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["regions"] >= 10
    assert metrics["held_out_psnr"] > 10
    assert set(metrics["seconds"]) >= {"load", "gaussians", "votes"}
    assert "segmenter" in metrics["skipped"]
    assert 0.5 < metrics["peak_memory_mib"] / peak_memory_mib() < 1.001  # tests before it may have taken more
    for text in ("gaussians        cached", "segmenter        skipped ", "held-out PSNR", "report.html"):
        assert text in words
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("data:image/") >= 24
    assert "Frames, masks, regions" in page
    assert (tmp_path / "out" / "field.safetensors").read_bytes() == (out / "field.safetensors").read_bytes()


def test_fit_writes_a_scene_in_the_captures_world_and_says_how_good_it_is(room, room_run, tmp_path, capsys):
    run, out = room_run
    shutil.copytree(out / "cache", tmp_path / "scene" / "cache")  # a run into the folder, gone on with
    line = "fit", room, "--out", tmp_path / "scene.ply", *FITTED
    assert run_cli(*line) == 0
    words = capsys.readouterr().out
    assert "gaussians        cached" in words
    assert f"held-out PSNR {run.held_out.psnr.mean():.2f} dB, SSIM 0." in words
    told, _ = _object(capsys, *line)
    assert told["held_out_psnr"] == pytest.approx(run.held_out.psnr.mean(), abs=1e-3)
    scene = load_gaussians(told["written"]["scene"])
    assert scene.count == told["gaussians"]
    expected = transform_gaussians(run.field.gaussians, run.capture.source_from_scene)
    np.testing.assert_allclose(scene.means, expected.means, atol=1e-5)


def test_query_writes_a_ply_a_json_and_masks_for_each_text(room_run, tmp_path, capsys):
    run, out = room_run
    names = list(json.loads((run.options.capture / "scene.json").read_text())["objects"].values())[:2]
    assert run_cli("query", out / "field.safetensors", *names, "--out", tmp_path, "--views", 2) == 0
    told = capsys.readouterr().out
    for name in names:
        slug = name.replace(" ", "-")
        answer = json.loads((tmp_path / f"{slug}.json").read_text())
        assert answer["query"] == name
        assert 0 <= answer["confidence"] <= 1
        assert repr(name) in told
        chosen = load_gaussians(tmp_path / answer["ply"])
        assert 0 < chosen.count == answer["count"] < answer["gaussians"]
        box, means = answer["place"]["bounding_box"], np.asarray(chosen.means)
        np.testing.assert_allclose(means.min(0), box["min"], atol=1e-5)
        np.testing.assert_allclose(means.mean(0), answer["place"]["centroid"], atol=1e-5)
        for file in answer["masks"].values():
            mask = cv2.imread(str(tmp_path / file), cv2.IMREAD_UNCHANGED)
            assert mask.shape == (120, 160)
            assert set(np.unique(mask)) <= {0, 255}
    assert "data:image/" in (tmp_path / "answers.html").read_text()


@pytest.fixture(scope="module")
def largest(room_run, room):
    """(names of two frames, masks of the largest object of the first in them, number of its region)."""
    names = room_run[0].capture.names[1:3]
    ids = {path.stem: cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in (room / "masks").glob("*.png")}
    largest = np.bincount(ids[names[0]][ids[names[0]] > 0]).argmax()
    region = np.flatnonzero(np.unique(list(ids.values())) == largest)[0] - 1
    return names, [ids[name] == largest for name in names], region


def test_query_by_what_is_pointed_at(room_run, largest, tmp_path):
    """The largest object by its masks in two frames, by a box around one of them, and by its innermost pixel."""
    names, masks, region = largest
    files = []
    for name, mask in zip(names, masks):
        cv2.imwrite(str(tmp_path / f"thing {name}.png"), 255 * mask.astype(np.uint8))
        files += [name, tmp_path / f"thing {name}.png"]
    rows, columns = np.nonzero(masks[0])
    box = names[0][-3:], columns.min(), rows.min(), columns.max(), rows.max()
    inside = cv2.distanceTransform(masks[0].astype(np.uint8), cv2.DIST_L2, 5)
    y, x = np.unravel_index(inside.argmax(), inside.shape)
    field = room_run[1] / "field.safetensors"
    line = "query", field, "--mask", *files, "--box", *box, "--at", names[0], x, y, "--out", tmp_path
    assert run_cli(*line) == 0
    answers = [json.loads(file.read_text()) for file in sorted(tmp_path.glob("*.json"))]
    assert sorted(answer["by"] for answer in answers) == ["outline", "outline", "votes"]
    for answer in answers:
        assert "text encoder" in answer["skipped"]
        assert answer["region"] == region
        assert answer["count"] > 0
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((50, 160), np.uint8))
    assert run_cli("query", field, "--mask", names[0], tmp_path / "small.png", "--out", tmp_path) == 2


def test_eval_prints_the_table_and_writes_every_pair(room_run, room, tmp_path, capsys):
    _, out = room_run
    (tmp_path / "one").mkdir()
    label = sorted((room / "label").glob("*.json"))[0]
    content = json.loads(label.read_text())
    content["objects"] = content["objects"][:4]
    (tmp_path / "one" / label.name).write_text(json.dumps(content))
    line = "eval", out / "field.safetensors", "--labels", tmp_path / "one", "--out", tmp_path
    told, words = _object(capsys, *line)
    found = json.loads((tmp_path / "evaluation.json").read_text())
    assert set(found) == {"anchored", "all"}
    for kind, summary in found.items():
        assert kind in words
        assert len(summary["rows"]) == summary["pairs"] > 0
        assert summary["miou"] == pytest.approx(np.mean([row["iou"] for row in summary["rows"]]), abs=1e-3)
    assert "mAcc@0.25" in words
    assert "alpha > 0.7" in words
    assert 0 <= told["anchored"]["miou"] <= 1


@pytest.mark.parametrize("verb", VERB_NAMES)
def test_examples_of_a_verb_parse_and_every_option_has_a_description(verb, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert run_cli(verb, "--help") == 0
    printed = capsys.readouterr().out
    examples = re.findall(rf"^  (jsecon {verb}\b.*)$", printed, re.MULTILINE)
    assert examples
    for line in examples:
        cli.parse(shlex.split(line)[1:])
    assert {"--json", "--debug"} <= set(re.findall(r"^\W+(--[a-z][a-z-]*)", printed, re.MULTILINE))
    rows = [line.strip("│| ") for line in printed.splitlines()]
    options = [n for n, row in enumerate(rows) if re.match("-h|--[a-z][a-z-]*( |,|$)|FIELD |CAPTURE ", row)]
    assert len(options) >= 3
    for n in options:  # words follow on the same row, or on the next one
        assert len(rows[n].split()) > 4 or len(rows[n + 1].split()) > 2, rows[n]
    assert not any("None" in row or "[STR" in row for row in rows)


def test_help_lists_the_verbs_and_tyro_prints_a_completion_script(capsys):
    assert run_cli("--help") == 0
    printed = capsys.readouterr().out
    assert "jsecon run my_capture --out my_field" in printed
    for verb in VERB_NAMES:
        assert re.search(rf"^\W+{verb} +[A-Z]", printed, re.MULTILINE)
    assert run_cli("--tyro-print-completion", "bash") == 0
    assert "granularity" in capsys.readouterr().out


def test_what_is_not_given_has_the_default_of_the_dataclass():
    run = cli.parse(["run", "room", "--out", "out"])
    assert run.options == Options(Path("room"))
    changed = ["--paper", "--masks", "m", "--long-side", "200", "--agreement", "1"]
    options = cli.parse(["run", "room", "--out=out", *changed]).options
    found = options.paper, options.masks, options.long_side, options.agreement
    assert found == (True, Path("m"), 200, 1.0)
    assert cli.parse(["fit", "room", "--out", "a.ply", "--steps", "7"]).options == Options(Path("room"), steps=7)


@pytest.mark.parametrize(("line", "options"), [
    ("f a b --all --at 0 1 2 --out o", {"texts": ["a", "b"], "at": [("0", 1, 2)], "all": True}),
    ("f --out o --at #1 2 3 --at x 4 5", {"texts": [], "at": [("#1", 2, 3), ("x", 4, 5)]}),
    ("f --mask 0 a.png 1 b.png --mask 2 c.png --out o", {"mask": [["0", "a.png", "1", "b.png"], ["2", "c.png"]]}),
    ("f --box x 1 2 3 4 --out o", {"box": [("x", 1, 2, 3, 4)]}),
    ("--out o f a --threshold -0.5 --by votes --by code", {"texts": ["a"], "threshold": -0.5, "by": "code"}),
    ("f a --out o --json", {"texts": ["a"], "output": verbs.OutputOptions(json=True)}),
    ("f --out o --keep_outliers -- -ish", {"texts": ["-ish"], "keep_outliers": True}),
])  # fmt: skip
def test_options_of_a_query_are_read(line, options):
    query = cli.parse(["query", *line.split()])
    assert (query.field, query.out) == (Path("f"), Path("o"))
    assert {name: getattr(query, name) for name in options} == options


@pytest.mark.parametrize(("line", "says"), [
    ("run", "CAPTURE --out PATH"), ("fly", "fly is not a verb"), ("qurey f x", "Did you mean query?"),
    ("", "{demo, run,"), ("query f x --out o --thresold 3", "Perhaps you meant: --threshold FLOAT"),
    ("query f x --out o --threshold a", "--threshold does not take 'a'"),
    ("run c --out o --steps 1.5", "--steps does not take '1.5'"),
    ("query f x --out o --by magic", "'votes'"), ("query f --out o --at 0 1", "--at'. Expected 3"),
    ("query f x --out", "--out'. Expected 1"), ("models look x", "'check'"),
])  # fmt: skip
def test_a_wrong_line_is_one_sentence_and_exit_code_2(capsys, line, says):
    assert run_cli(*line.split()) == 2
    told = capsys.readouterr().err
    assert told.startswith("jsecon: jsecon")
    assert told.count("\n") == 1
    assert re.search("--help(-all)? lists the", told)
    assert says in told


# Bad input: one message each, with file, found, expected, remedy


def _refused(capsys, *arguments, says=()):
    """Exit code 2, one message on standard error, no traceback, every one of `says` in it."""
    assert run_cli(*arguments) == 2
    told = capsys.readouterr().err
    message = [line for line in told.splitlines() if line.startswith("jsecon: ")]
    assert len(message) == 1
    assert "Traceback" not in told
    for word in says:
        assert word in message[0]


@pytest.mark.parametrize(("file", "options"), [
    ("images/frame_00003.png", []), ("sparse/0/images.bin", []), ("scene.ply", ["--gaussians", "scene.ply"]),
])  # fmt: skip
def test_a_damaged_capture_is_one_message(capture, tmp_path, capsys, monkeypatch, file, options):
    """The tests of each reader have all kinds of damage."""
    (capture / file).write_text("no such file")
    monkeypatch.chdir(capture)
    out = tmp_path / "out"
    _refused(capsys, "run", capture, "--out", out, "--holdout", 4, "--steps", 5, *options, says=[Path(file).name])
    left = {path.name for path in out.rglob("*.safetensors")}
    assert not any("partial" in name or name == "field.safetensors" for name in left)


def test_an_output_folder_that_cannot_be_written(capture, room_run, tmp_path, capsys):
    (tmp_path / "file").write_text("not a folder")
    field, out = room_run[1] / "field.safetensors", tmp_path / "file" / "out"
    for line in (("run", capture), ("demo",), ("query", field, "red"), ("eval", field, "--labels", capture)):
        _refused(capsys, *line, "--out", out, says=["out"])


def test_a_text_that_is_not_understood_does_not_stop_the_others(room_run, tmp_path, capsys):
    field, out = room_run[1] / "field.safetensors", tmp_path / "answers"
    texts = ["red ball", "the meaning of life", "zzz"]
    assert run_cli("query", field, *texts, "--out", out) == 2
    told = [line for line in capsys.readouterr().err.splitlines() if line.startswith("jsecon: ")]
    assert ["meaning of life" in line for line in told] == [True, False]
    assert "zzz" in told[1]
    assert [file.name for file in out.glob("*.json")] == ["red-ball.json"]
    _refused(capsys, "query", field, "zzz", "--out", tmp_path / "none", says=["zzz"])
    assert list((tmp_path / "none").iterdir()) == []


@pytest.mark.parametrize(("options", "says"), [
    (["--at", "nowhere", 3, 3], "nowhere"), (["--at", "#0", 160, 3], "159"), (["--at", "#0", "left", 3], "left"),
    (["--at", "", 3, 3], "no such frame"), (["--at", "#99", 3, 3], "a place, #0 to #"),
    (["--mask", "#0", "a.png", "#1"], "FRAME PNG, in pairs"), (["--mask", "#0", "nowhere.png"], "No such file"),
    (["--box", "#0", 3, 3, "x", 9], "--box does not take '#0 3 3 x 9'"),
    (["--box", "#0", 500, 3, 600, 9], "pixels of a frame of 160x120"), ([], "there is no query"),
])  # fmt: skip
def test_queries_that_cannot_be(room_run, tmp_path, capsys, options, says):
    _refused(capsys, "query", room_run[1] / "field.safetensors", *options, "--out", tmp_path, says=[says])


@pytest.mark.parametrize(("verb", "module", "package"), [
    ("serve", "jsecon.app.server", "uvicorn"), ("mcp", "jsecon.app.mcp_server", "mcp"),
])  # fmt: skip
def test_a_verb_without_its_extra_names_it(tmp_path, capsys, monkeypatch, verb, module, package):
    monkeypatch.delitem(sys.modules, module, raising=False)
    for name in [name for name in sys.modules if name.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    assert cli.main([verb, str(tmp_path / "field.safetensors")]) == 2
    said = capsys.readouterr().err
    assert f"the package {package} is missing" in said
    assert f'pip install "jsecon[{verb}]"' in said


def test_a_field_that_is_damaged_or_not_there(room_run, tmp_path, capsys):
    data = (room_run[1] / "field.safetensors").read_bytes()
    (tmp_path / "field.safetensors").write_bytes(data[: len(data) // 2])
    for name in ("field.safetensors", "none.safetensors"):
        _refused(capsys, "query", tmp_path / name, "red", "--out", tmp_path / "o", says=[name])


# What is said while it works


class _Terminal:
    def __init__(self, tty):
        self.text, self._tty = "", tty

    def isatty(self):
        return self._tty

    def write(self, text):
        self.text += text

    def flush(self):
        pass


def _wait_for(sign, err):
    for _ in range(200):
        if sign in err.text:
            break
        time.sleep(0.02)
    assert sign in err.text


def _drawn(err, steps, sign):
    """Progress of a step that reports these counts, and goes on until `sign` is shown."""
    with Console(err=err).progress("votes") as progress:
        for done, total in steps:
            progress(done, total)
        _wait_for(sign, err)


@pytest.fixture
def soon(monkeypatch):
    """Progress is shown after a hundredth of a second."""
    monkeypatch.setattr(progress, "QUIET_SECONDS", 0.01)


@pytest.mark.parametrize("tty", [True, False])
def test_progress_is_one_line_on_a_terminal_and_several_elsewhere(soon, tty):
    counted, unknown = _Terminal(tty), _Terminal(tty)
    _drawn(counted, [(1, 4), (4, 4), (1, 3), (2, 3)], "votes: 2 of 3, about 0 s left")
    _drawn(unknown, [], "votes: 0 s so far")  # a step that reports no count
    for terminal in (counted, unknown):
        assert terminal.text.endswith("\r\x1b[K" if tty else "\n")  # the line is gone
        assert ("\r" in terminal.text) == tty


def test_a_note_takes_the_place_of_the_line(soon):
    terminal = _Terminal(True)
    console = Console(terminal, terminal)
    with console.progress("votes") as count:
        count(1, 4)
        _wait_for("votes: ", terminal)
        console.note("a file is read again")
        assert "\r\x1b[K  note: a file is read again\n" in terminal.text


def test_short_steps_stay_silent():
    for tty in (True, False):
        err = _Terminal(tty)
        with Console(err=err).progress("votes") as count:
            for done in range(100):
                count(done + 1, 100)
        assert err.text == ""
