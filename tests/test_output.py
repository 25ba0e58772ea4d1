"""Output whose reader goes away, as in `jsecon query ... | head -1`, and texts that are not UTF-8."""

import io
import json
import os
import subprocess
import sys

import pytest
from small_field import colour_field

from jsecon import InputError, save_field
from jsecon.__main__ import UNREAD
from jsecon.app.cli import main
from jsecon.app.scene import Scene
from jsecon.vision.colours import ColourEmbedder


@pytest.fixture(scope="module")
def saved(scene, cameras, tmp_path_factory):
    """A small field whose texts are colours, and its file."""
    field = colour_field(scene, cameras)
    file = tmp_path_factory.mktemp("field") / "field.safetensors"
    save_field(file, field)
    return field, file


def closed_pipe() -> io.TextIOWrapper:
    """A text stream to a pipe that nobody reads."""
    read, write = os.pipe()
    os.close(read)
    return os.fdopen(write, "w", buffering=1)


@pytest.mark.skipif(os.name != "posix", reason="pipes of POSIX")
def test_the_program_ends_quietly_with_the_code_of_a_broken_pipe():
    with closed_pipe() as stream:
        command = [sys.executable, "-m", "jsecon", "run", "--help"]
        done = subprocess.run(command, stdout=stream, stderr=subprocess.PIPE, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (UNREAD, "")
    with open("/dev/full", "w") as stream:
        done = subprocess.run(command, stdout=stream, stderr=subprocess.PIPE, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (2, "jsecon: cannot write to standard output: No space left on device.\n")


def test_a_text_that_is_not_utf8_is_refused_in_one_sentence(saved, tmp_path, capsys):
    field, file = saved
    text = os.fsdecode(b"caf\xe9 red")
    asked = ["query", str(file), text, "red", "--out", str(tmp_path), "--views", "0"]
    assert main([*asked, "--json"]) == 2
    told = json.loads(capsys.readouterr().out)
    assert "is not UTF-8" in told["error"]["message"]
    assert [answer["query"] for answer in told["answers"]] == ["red"]
    assert main(asked) == 2
    line = next(line for line in capsys.readouterr().err.splitlines() if line.startswith("jsecon: "))
    assert line.isascii()
    for by in ("votes", "code"):
        with pytest.raises(InputError, match="not UTF-8"):
            Scene(field, ColourEmbedder()).ask(text, by=by)
