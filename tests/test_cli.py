"""The command line: what each verb leaves behind, and one clear message and exit code 2 for each kind of bad input."""

import dataclasses
import io
import json
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import get_args, get_type_hints

import cv2
import numpy as np
import pytest
from browser import until
from capture_files import ROOM_FIT, refused, run_cli

from jsecon.app import cli, verbs
from jsecon.pipeline import progress
from jsecon.pipeline.options import Options, Range, check_ranges
from jsecon.pipeline.progress import Console
from jsecon.process import peak_memory_mib
from jsecon.read.splats.formats import load_gaussians
from jsecon.splat.transform import transform_gaussians

VERB_NAMES = [kind.__name__.lower() for kind in verbs.VERBS]
FITTED = [word for name, value in ROOM_FIT.items() for word in (f"--{name.replace('_', '-')}", value)]
"""options of `room_run`'s fit"""


# What the verbs do


def _object(capsys, *arguments):
    """What a verb prints with --json: one object and nothing else; and its words, on standard error."""
    assert run_cli(*arguments, "--json") == 0
    out, err = capsys.readouterr()
    assert out.count("\n") == 1
    return json.loads(out), err


def test_run_writes_field_metrics_and_report_and_tells_its_plan(room, room_run, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(progress, "QUIET_SECONDS", 60.0)  # a loaded machine is no reason for other lines
    run, out = room_run
    shutil.copytree(out / "cache", tmp_path / "out" / "cache")  # the stages are cached: only the verb itself is tested
    line = "run", room, "--out", tmp_path / "out", "--masks", room / "masks", *FITTED
    told, words = _object(capsys, *line, "--dry-run")
    assert {stage["status"] for stage in told["stages"]} == {"cached"}
    assert not (tmp_path / "out" / "field.safetensors").exists()
    plan = words.partition("Nothing was written.")[0].splitlines()[1:]
    assert len(plan) == 7
    told, words = _object(capsys, *line)
    assert words.splitlines()[1 : len(plan) + 1] == plan
    assert told["gaussians"] == run.field.gaussians.count
    assert all(Path(file).exists() for file in told["written"])
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["regions"] >= 10
    assert metrics["held_out_psnr"] > 10
    photo, scene = np.split(cv2.imread(str(tmp_path / "out" / "first_view.png"))[..., ::-1], 2, axis=1)
    np.testing.assert_array_equal(photo, run.capture.frames[np.argmax(run.capture.held_out)])
    assert np.abs(scene.astype(float) - photo).mean() < np.abs(scene.astype(float) - photo[:, ::-1]).mean()
    assert 0.5 < metrics["peak_memory_mib"] / peak_memory_mib() < 1.001  # tests before it may have taken more
    assert (tmp_path / "out" / "report.html").read_text().count("data:image/") >= 24
    assert (tmp_path / "out" / "field.safetensors").read_bytes() == (out / "field.safetensors").read_bytes()


def test_fit_writes_a_scene_in_the_captures_world_and_says_how_good_it_is(room, room_run, tmp_path, capsys):
    run, out = room_run
    shutil.copytree(out / "cache", tmp_path / "scene" / "cache")  # a run into the folder, gone on with
    told, words = _object(capsys, "fit", room, "--out", tmp_path / "scene.ply", *FITTED)
    assert "gaussians        cached" in words
    assert told["held_out_psnr"] == pytest.approx(run.held_out.psnr.mean(), abs=1e-3)
    scene = load_gaussians(told["written"]["scene"])
    assert scene.count == told["gaussians"]
    expected = transform_gaussians(run.field.gaussians, run.capture.source_from_scene)
    np.testing.assert_allclose(scene.means, expected.means, atol=1e-5)


def test_eval_prints_the_figures_and_writes_every_pair(room_run, room, tmp_path, capsys):
    label = sorted((room / "label").glob("*.json"))[0]
    content = json.loads(label.read_text())
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / label.name).write_text(json.dumps(content | {"objects": content["objects"][:4]}))
    line = "eval", room_run[1] / "field.safetensors", "--labels", tmp_path / "one", "--out", tmp_path
    told, words = _object(capsys, *line)
    found = json.loads((tmp_path / "evaluation.json").read_text())
    assert len(found["rows"]) == found["pairs"] > 0
    assert found["miou"] == pytest.approx(np.mean([row["iou"] for row in found["rows"]]), abs=1e-3)
    assert told["miou"] == found["miou"]
    assert f"mIoU {found['miou']:.3f}" in words


@pytest.mark.parametrize("verb", VERB_NAMES)
def test_examples_of_a_verb_parse(verb, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert run_cli(verb, "--help") == 0
    printed = capsys.readouterr().out
    examples = re.findall(rf"^  (jsecon {verb}\b.*)$", printed, re.MULTILINE)
    assert examples
    for line in examples:
        cli.parse(shlex.split(line)[1:])
    assert "--json" in printed


def test_help_lists_the_verbs_and_tyro_prints_a_completion_script(capsys):
    assert run_cli("--help") == 0
    printed = capsys.readouterr().out
    assert all(re.search(rf"^\W+{verb} +[A-Z]", printed, re.MULTILINE) for verb in VERB_NAMES)
    assert run_cli("--tyro-print-completion", "bash") == 0
    assert "vision-frames" in capsys.readouterr().out


def test_what_is_not_given_has_the_default_of_the_dataclass():
    assert cli.parse(["run", "room", "--out", "out"]).options == Options(Path("room"))
    changed = ["--paper", "--masks", "m", "--steps", "7", "--long-side", "64"]
    expected = Options(Path("room"), paper=True, masks=Path("m"), steps=7, long_side=64)
    assert cli.parse(["run", "room", "--out=out", *changed]).options == expected


@pytest.mark.parametrize(("line", "says"), [
    ("run", "CAPTURE --out PATH"), ("fly", "fly is not a verb"), ("qurey f x", "Did you mean query?"),
    ("", "{demo, run,"), ("query f x --out o --thresold 3", "Perhaps you meant: --threshold FLOAT"),
    ("run c --out o --steps 1.5", "--steps does not take '1.5'"),
    ("query f x --out o --by magic", "'votes'"), ("query f --out o --at 0 1", "--at'. Expected 3"),
    ("query f x --out", "--out'. Expected 1"), ("models look x", "'get'"),
])  # fmt: skip
def test_a_wrong_line_is_one_sentence_and_exit_code_2(capsys, line, says):
    assert run_cli(*line.split()) == 2
    told = capsys.readouterr().err
    assert told.startswith("jsecon: jsecon")
    assert told.count("\n") == 1
    assert re.search("--help(-all)? lists the", told)
    assert says in told


# Numbers out of their ranges

VALUES = ["-1", "0", "nan", "inf", "1e12", str(10**12)]


def number_types(hint) -> list[type]:
    """The types of the values of an option, in order."""
    parts = get_args(hint)
    return [kind for part in parts for kind in number_types(part)] if parts else [hint] * (hint in (int, float, str))


def numeric_options(kind, verb):
    """(verb, flag, types of its values, range) of a verb's options that take numbers, those of its groups too."""
    hints = get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        if dataclasses.is_dataclass(hints[field.name]):
            yield from numeric_options(hints[field.name], verb)
        elif {int, float} & set(kinds := number_types(hints[field.name])):
            (allowed,) = (mark for mark in hints[field.name].__metadata__ if isinstance(mark, Range))
            yield verb, f"--{field.name.replace('_', '-')}", kinds, allowed


OPTIONS = [option for kind in verbs.VERBS for option in numeric_options(kind, kind)]
REQUIRED = {"out": ["--out", "out"], "labels": ["--labels", "labels"]}


def command(verb) -> list[str]:
    """The least command line of a verb: its positional arguments and options without a default."""
    line = [verb.__name__.lower()]
    for field in dataclasses.fields(verb):
        if field.default is field.default_factory is dataclasses.MISSING:
            line += REQUIRED.get(field.name, ["list" if field.name == "action" else "input"])
    return line


@pytest.mark.parametrize(("verb", "flag", "kinds", "allowed"), OPTIONS, ids=lambda x: x if isinstance(x, str) else "")
def test_a_number_out_of_range_is_refused_at_once(verb, flag, kinds, allowed, capsys):
    for value in VALUES:
        is_whole = value.lstrip("-").isdigit()
        written = [value if kind in (int, float) else "frame" for kind in kinds]
        fits = float(value) in allowed
        if fits and (is_whole or int not in kinds):
            cli.parse([*command(verb), flag, *written])
        else:
            assert run_cli(*command(verb), flag, *written) == 2
            error = capsys.readouterr().err
            assert error.startswith("jsecon")
            assert error.count("\n") == 1
            assert flag in error


def test_ranges_hold_for_options_in_python_too(room):
    for changes in ({"seed": -1}, {"minutes": math.inf}, {"long_side": 0}, {"up": (0.0, 0.0, 0.0)}):
        with refused("expected"):
            check_ranges(Options(room, **changes))


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


def test_an_output_folder_that_cannot_be_written(room, room_run, tmp_path, capsys):
    (tmp_path / "file").write_text("not a folder")
    field, out = room_run[1] / "field.safetensors", tmp_path / "file" / "out"
    for line in (("run", room), ("demo",), ("query", field, "red"), ("eval", field, "--labels", room)):
        _refused(capsys, *line, "--out", out, says=["out"])


@pytest.mark.parametrize(("options", "says"), [
    (["--at", "nowhere", 3, 3], "nowhere"), (["--at", "#0", 160, 3], "159"), (["--at", "#0", "left", 3], "left"),
    (["zzz"], "zzz"), ([], "there is no query"),
])  # fmt: skip
def test_queries_that_cannot_be(room_run, tmp_path, capsys, monkeypatch, options, says):
    monkeypatch.chdir(tmp_path)
    _refused(capsys, "query", room_run[1] / "field.safetensors", *options, "--out", "out", says=[says])


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


# What is said while it works


def test_a_terminal_that_lacks_some_of_the_letters_shows_them_by_number(room_run, tmp_path):
    command = [sys.executable, "-m", "jsecon", "export", room_run[1], "--out", tmp_path / "Szene ö 図.ply"]
    environ = {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent), "PYTHONIOENCODING": "latin-1"}
    done = subprocess.run(command, capture_output=True, env=environ, check=True)
    assert r"Szene ö \u56f3.ply" in done.stdout.decode("latin-1")
    assert load_gaussians(tmp_path / "Szene ö 図.ply").count == room_run[0].field.gaussians.count


class Terminal(io.StringIO):
    def __init__(self, tty):
        super().__init__()
        self.isatty = lambda: tty


def show(err, steps, sign):
    """Progress of a step that reports these counts, and goes on until `sign` is shown."""
    with Console(err=err).progress("votes") as progress:
        for done, total in steps:
            progress(done, total)
        until(lambda: sign in err.getvalue(), sign)


@pytest.mark.parametrize("tty", [True, False])
def test_progress_is_one_line_on_a_terminal_and_several_elsewhere(monkeypatch, tty):
    monkeypatch.setattr(progress, "QUIET_SECONDS", 0.01)
    counted, unknown = Terminal(tty), Terminal(tty)
    show(counted, [(1, 4), (4, 4), (1, 3), (2, 3)], "votes: 2 of 3, about 0 s left")
    show(unknown, [], "votes: 0 s so far")  # a step that reports no count
    for terminal in (counted, unknown):
        assert terminal.getvalue().endswith("\r\x1b[K" if tty else "\n")  # the line is gone
        assert ("\r" in terminal.getvalue()) == tty
