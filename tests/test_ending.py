"""How a verb ends: words on standard error or one JSON object on standard output, and the exit code."""

import json
import os
import subprocess
import sys

import pytest

from jsecon.__main__ import UNREAD
from jsecon.app import cli, models
from jsecon.errors import InputError

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


@pytest.mark.parametrize("line", ["run", "fly", "query f x --threshold a"])
def test_wrong_usage_is_an_error_object_too(capsys, line):
    assert cli.main([*line.split(), "--json"]) == 2
    out, err = capsys.readouterr()
    assert "--help" in json.loads(out)["error"]["remedy"]
    assert err == ""


@pytest.mark.skipif(os.name != "posix", reason="pipes of POSIX")
def test_the_program_ends_quietly_with_the_code_of_a_broken_pipe():
    read, write = os.pipe()
    os.close(read)  # as in `jsecon query ... | head -1`
    command = [sys.executable, "-m", "jsecon", "run", "--help"]
    with os.fdopen(write, "w") as unread, open("/dev/full", "w") as full:
        for stream, code, words in (
            (unread, UNREAD, ""),
            (full, 2, "jsecon: cannot write to standard output: No space left on device.\n"),
        ):
            done = subprocess.run(command, stdout=stream, stderr=subprocess.PIPE, text=True, timeout=120)
            assert (done.returncode, done.stderr) == (code, words)


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


@pytest.mark.parametrize("error", [MemoryError("Unable to allocate 8 PiB"), RuntimeError("RESOURCE_EXHAUSTED: 9 TB")])
def test_faults_of_the_machine_are_one_sentence(end, capsys, error):
    assert end(OSError(24, "Too many open files", "a.ply")) == 2
    assert capsys.readouterr().err.startswith("jsecon: a.ply: Too many open files. Raise the limit")
    assert end(error) == 2
    assert capsys.readouterr().err.startswith(f"jsecon: memory has no room left ({error}). End other")
