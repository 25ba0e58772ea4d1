"""How a verb ends: words on standard error or one JSON object on standard output, and the exit code."""

import json
import os
from pathlib import Path

import pytest

from jsecon.app import cli, models
from jsecon.errors import InputError, describe_error

PARTS = {"where": "mug.png", "problem": "text", "expected": "a picture", "remedy": "Draw one."}
ERROR = PARTS | {"message": "mug.png: text, expected a picture. Draw one."}


@pytest.fixture
def end(monkeypatch):
    """Runs a verb that has a given result or raises a given error."""

    def run(outcome, *options):
        def act(verb, console):
            if isinstance(outcome, BaseException):
                raise outcome
            return dict(outcome)

        monkeypatch.setattr(models, "_models", act)
        return cli.main(["models", "list", *options])

    return run


def test_figures_and_paths_are_one_object(end, capsys):
    assert end({"written": {"field": Path("out/field.safetensors")}, "gaussians": 3}, "--json") == 0
    assert json.loads(capsys.readouterr().out) == {"written": {"field": "out/field.safetensors"}, "gaussians": 3}
    assert end({"gaussians": 3}) == 0
    assert capsys.readouterr() == ("", "")


def test_what_was_refused_is_told_beside_what_was_not(end, capsys):
    errors = [InputError("cup.png", "nothing", "a picture", "Draw it."), InputError(*PARTS.values())]
    assert end({"answers": [1], "errors": errors}, "--json") == 2
    out, err = capsys.readouterr()
    told = json.loads(out)
    assert told["error"] == told["errors"][1] == ERROR
    assert (told["errors"][0]["where"], told["answers"], err) == ("cup.png", [1], "")
    assert end({"errors": errors}) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert [line.split(":")[1] for line in err.splitlines()] == [" cup.png", " mug.png"]


@pytest.mark.parametrize(
    "line", [["run", "--json"], ["fly", "--json"], ["query", "f", "x", "--threshold", "a", "--json"]]
)
def test_wrong_usage_is_an_error_object_too(capsys, line):
    assert cli.main(line) == 2
    out, err = capsys.readouterr()
    assert "--help" in json.loads(out)["error"]["remedy"]
    assert err == ""


def test_debug_shows_where_an_error_came_from(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("JAX_TRACEBACK_FILTERING", "auto")  # what the user has set stays
    line = ["eval", str(tmp_path / "none.safetensors"), "--labels", str(tmp_path), "--out", str(tmp_path)]
    assert cli.main(line) == 2
    assert "Traceback" not in capsys.readouterr().err
    assert cli.main([*line, "--debug"]) == 2
    err = capsys.readouterr().err
    assert "Traceback" in err
    assert "in load_field" in err
    assert err.splitlines()[-1].startswith("jsecon: ")
    assert os.environ["JAX_TRACEBACK_FILTERING"] == "auto"
    monkeypatch.delenv("JAX_TRACEBACK_FILTERING")
    assert cli.main([*line, "--debug"]) == 2
    assert os.environ["JAX_TRACEBACK_FILTERING"] == "off"


def test_a_stop_and_a_bug_are_error_objects_with_their_own_codes(end, capsys):
    def within(stop):  # as a library that tidies up after a stop, and fails in that
        error = InputError("a file", "half of it", "all of it", "Fetch it again.")
        error.__context__ = RuntimeError("cannot release un-acquired lock")
        error.__context__.__context__ = stop
        return error

    for error in (KeyboardInterrupt(), within(KeyboardInterrupt())):
        assert end(error, "--json") == 130
        message = json.loads(capsys.readouterr().out)["error"]["message"]
        assert message == "interrupted. Run the same command again to resume."
    assert end(within(None), "--json") == 2
    assert json.loads(capsys.readouterr().out)["error"]["problem"] == "half of it"
    with pytest.raises(ZeroDivisionError):
        end(ZeroDivisionError("a bug"), "--json")
    assert json.loads(capsys.readouterr().out)["error"]["problem"] == "internal error: a bug"


@pytest.mark.parametrize(("error", "message"), [
    (InputError("images.txt", "line 7 has 9 fields", "10", "Export."), "line 7 has 9 fields, expected 10."),
    (InputError("mug.png", "the file is cut short.", remedy="Copy it again."), "mug.png: the file is cut short. C"),
    (InputError("", "interrupted", remedy="Run it again."), "interrupted. Run it again."),
])  # fmt: skip
def test_an_error_reads_as_sentences(error, message):
    assert message in str(error)
    assert ";" not in str(error)


@pytest.mark.parametrize(("error", "words"), [
    (OSError(28, "No space left on device"), "No space left on device"),
    (KeyError("counts"), "'counts' is missing"),
    (TypeError("'NoneType' object is not subscriptable"), "its values are of another kind or number"),
    (EOFError(), "it ends early"), (UnicodeDecodeError("utf-8", b"\xe9", 0, 1, "invalid"), "its text is not UTF-8"),
    (ValueError("odd header.\n  at line 3"), "odd header"),
])  # fmt: skip
def test_the_reason_of_a_failure_is_in_words(error, words):
    assert describe_error(error) == words
