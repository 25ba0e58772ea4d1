"""README and documentation are true: their Python runs, their command lines parse, their links lead somewhere, and the
CI finds the test command in the README."""

import contextlib
import importlib.util
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import jsecon
from jsecon.app import cli, verbs

HOME = Path(__file__).resolve().parent.parent
PAGES = [HOME / "README.md", HOME / "CONTRIBUTING.md", *sorted((HOME / "docs").rglob("*.md"))]
PROJECT = tomllib.loads((HOME / "pyproject.toml").read_text())["project"]
TOOLS = {*("python3", "pip", "pytest", "ruff", "pyright", "deptry", "sphinx-build", "curl", "ssh", "hf")}
TOOLS |= {".ci/run", ".ci/newest"}
"""programs that command lines call besides jsecon and modules of this repository"""
NUMBERS = {"X", "Y", "X0", "Y0", "X1", "Y1", "S", "N"}
"""what stands for a number in a table"""


def _name(page):
    return str(page.relative_to(HOME))


def _blocks(language, text):
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def _commands(text):
    """The command lines of the bash blocks, and of code in tables, without comments."""
    lines = [line for block in _blocks("bash", text) for line in block.splitlines()]
    rows = "\n".join(line for line in text.splitlines() if line.startswith("|"))
    lines += [code for code in re.findall(r"`([^`]+)`", rows) if re.match(r"(jsecon|python -m|pytest) ", code)]
    parts = [part.strip() for line in lines for part in re.split(r"&&| \| ", line)]
    return [part for part in parts if part and not part.startswith("#")]


@pytest.fixture
def demo_folder(room, room_run, tmp_path, monkeypatch):
    """The current folder, with what the pages take from `jsecon demo`."""
    (tmp_path / "jsecon-demo").mkdir()
    shutil.copy(room_run[1] / "field.safetensors", tmp_path / "jsecon-demo")
    shutil.copytree(room_run[1] / "field.evidence", tmp_path / "jsecon-demo" / "field.evidence")
    (tmp_path / "jsecon-demo" / "capture").symlink_to(room)
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("page", [page for page in PAGES if _blocks("python", page.read_text())], ids=_name)
def test_the_python_of_a_page_runs_one_block_after_the_other(page, demo_folder, capsys):
    names: dict = {}
    for block in _blocks("python", page.read_text()):
        exec(compile(block, _name(page), "exec"), names)
    printed = capsys.readouterr().out
    assert printed or "print(" not in page.read_text()
    if page.name == "README.md":
        assert re.search(r"read as 'orange ball', on white plate: \d objects?.* \d+ of \d+ Gaussians, ", printed)


@pytest.mark.parametrize("script", sorted((HOME / "docs" / "examples").glob("*.py")), ids=_name)
def test_an_example_runs_and_passes_its_own_check(script, demo_folder, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [str(script)])
    runpy.run_path(str(script), run_name="__main__")
    assert capsys.readouterr().out
    assert len(script.read_text().splitlines()) <= 50


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_every_command_line_of_a_page_is_one_that_its_program_takes(page, capsys):
    text = page.read_text()
    whole = _commands(re.sub(r"^\|.*$", "", text, flags=re.MULTILINE))
    for line in _commands(text):
        words = shlex.split(line.partition(" > ")[0].partition("  #")[0])
        words = ["1" if word in NUMBERS else word for word in words if not re.fullmatch(r"[A-Z_]+=\S*", word)]
        if words[0] in ("taskset", "mpirun", "srun"):
            words = words[words.index("jsecon") :]
        if words[0] == "jsecon" and "..." not in words:
            _check_jsecon(words[1:], line in whole, capsys)
        elif words[:2] == ["python", "-m"] and words[2] != "venv":
            assert importlib.util.find_spec(words[2]) is not None, line
        elif words[0] == "python":
            assert (HOME / words[1]).is_file(), line
        elif words[0] not in ("jsecon", "cd", "."):
            assert words[0] in TOOLS, line
        for extras in re.findall(r"(?:jsecon|\.)\[([\w,]+)\]", line):
            assert set(extras.split(",")) <= set(PROJECT["optional-dependencies"]), line
        for file in re.findall(r"\b(?:tests|benchmarks|experiments|docs)/[\w./]+\.py", line):
            assert (HOME / file).is_file(), line


def _check_jsecon(words, whole, capsys):
    """Parses a command line of jsecon. In a table it may be part of one, such as `jsecon run --paper`."""
    try:
        with contextlib.suppress(SystemExit):
            cli.parse(words)
    except jsecon.InputError as error:
        if whole or "Missing:" not in error.problem:
            raise
    if not whole and words[0] in {kind.__name__.lower() for kind in verbs.VERBS}:
        capsys.readouterr()
        with contextlib.suppress(SystemExit):
            cli.parse([words[0], "--help"])
        options = {*capsys.readouterr().out.split(), "--help"}
        assert {word for word in words if word.startswith("--")} <= options


def _anchor(heading):
    """The anchor of a heading, as GitHub and MyST make it."""
    plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).strip().lower()
    return re.sub(r"[^\w\- ]", "", plain).replace(" ", "-")


LINKED = [HOME / name for name in ("CHANGELOG.md", "experiments/README.md", "benchmarks/results.md")]
"""pages outside of docs/ whose links are checked too"""


@pytest.mark.parametrize("page", [*PAGES, *LINKED], ids=_name)
def test_every_link_of_a_page_leads_somewhere(page):
    text = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith(("https://", "http://")):
            continue
        file, _, anchor = target.partition("#")
        path = page.parent / file if file else page
        assert path.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.*)$", path.read_text(), re.MULTILINE)
            assert anchor in {_anchor(heading) for heading in headings}, target


def test_every_public_name_has_an_entry_in_the_reference():
    pages = "".join(page.read_text() for page in (HOME / "docs" / "api").glob("*.md"))
    entries = set(re.findall(r"\.\. auto(?:function|class|exception):: jsecon\.(\w+)", pages))
    assert entries == set(jsecon.__all__) - {"__version__"}


def test_the_version_is_the_same_everywhere():
    assert PROJECT["version"] == jsecon.__version__
    assert f"version: {jsecon.__version__}\n" in (HOME / "CITATION.cff").read_text()
    assert f"\n## {jsecon.__version__}\n" in (HOME / "CHANGELOG.md").read_text()


def test_the_ci_runs_exactly_the_second_command():
    script = (HOME / ".ci" / "run").read_text()
    function = script[script.index("block_after()") : script.index("\nwork=")]
    found = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", f'{function}\nblock_after "Run the tests:"'],
        cwd=HOME, check=True, capture_output=True, text=True,
    ).stdout  # fmt: skip
    assert found == _blocks("bash", (HOME / "README.md").read_text())[1]
    assert os.access(HOME / ".ci" / "run", os.X_OK)


def test_a_figure_that_differs_from_its_results_or_has_no_source_is_named(tmp_path):
    results = "experiments/results/lerf"
    files = {
        f"{results}/metrics.json": '{"ours": 0.85}',
        f"{results}/table.md": "",
        "README.md": "It has 0.84\nin 12 s.\n",
    }
    files["docs/figures.csv"] = "figure,pages,kind,source\n0.84,README.md,result,lerf['ours']\n"
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    assert runpy.run_path(str(HOME / "docs/check_figures.py"))["faults"](tmp_path) == [
        "README.md:1: 0.84 is 0.85 by lerf['ours']",
        "README.md:2: no row of docs/figures.csv or of results has 12 s",
    ]
