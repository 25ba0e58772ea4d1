"""The README is true: its Python runs, its command lines parse, and the CI finds the test command in it."""

import ast
import contextlib
import io
import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path

from jsecon.app import cli

HOME = Path(__file__).resolve().parent.parent
README = (HOME / "README.md").read_text()


def _blocks(language, text=README):
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def test_the_python_blocks_run_one_after_the_other(room, room_run, tmp_path, monkeypatch):
    _, out = room_run
    (tmp_path / "jsecon-demo").mkdir()
    shutil.copy(out / "field.safetensors", tmp_path / "jsecon-demo")
    (tmp_path / "jsecon-demo" / "capture").symlink_to(room)
    monkeypatch.chdir(tmp_path)
    blocks, names, told = _blocks("python"), {}, io.StringIO()
    assert len(blocks) >= 3
    with contextlib.redirect_stdout(told):
        for block in blocks:
            exec(compile(block, "README.md", "exec"), names)
    lines = told.getvalue().splitlines()
    assert re.match(r"[1-9]\d* of \d+ Gaussians, region \d+, score 0\.\d+", lines[0]), lines
    assert sum(ast.literal_eval(lines[2].partition("}")[0] + "}").values()) > 0
    assert min(ast.literal_eval(lines[3]).values()) > 0  # metres
    assert "left out: 0" in lines[4]


def test_every_command_line_is_one_that_the_program_takes():
    lines = [line for block in _blocks("bash") for line in block.splitlines() if line.startswith("jsecon")]
    lines += [line.split("  ")[0] for line in re.findall(r"^  (jsecon .*?)(?:  .*)?$", cli.ABOUT, re.MULTILINE)]
    assert len(lines) >= 10
    for line in lines:
        cli.parse(shlex.split(line)[1:])


def test_the_ci_runs_exactly_the_second_command():
    script = (HOME / ".ci" / "run").read_text()
    function = script[script.index("block_after()") : script.index("\nwork=")]
    found = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", f'{function}\nblock_after "Run the tests:"'],
        cwd=HOME, check=True, capture_output=True, text=True,
    ).stdout  # fmt: skip
    assert found == _blocks("bash")[1]
    assert os.access(HOME / ".ci" / "run", os.X_OK)
