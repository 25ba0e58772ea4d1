"""What is installed is the package whole: its source, its pages, its types. Built as for an index: an archive of the
source, and of that the wheel; takes the network, as every build in an environment of its own does."""

import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

HOME = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((HOME / "pyproject.toml").read_text())["project"]


@pytest.mark.long
def test_the_wheel_holds_the_packages_files_and_nothing_else(tmp_path):
    unwanted = shutil.ignore_patterns(".*", "__pycache__", "experiments", "benchmarks", "build", "*.egg-info")
    shutil.copytree(HOME, tmp_path / "tree", ignore=unwanted)
    command = [sys.executable, "-m", "build", "--outdir", str(tmp_path), str(tmp_path / "tree")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    with tarfile.open(next(tmp_path.glob("*.tar.gz"))) as archive:
        source = {member.name.partition("/")[2] for member in archive.getmembers() if member.isfile()}
    with zipfile.ZipFile(next(tmp_path.glob("*-py3-none-any.whl"))) as archive:
        wheel = set(archive.namelist())
    own = {path for path in (HOME / "jsecon").rglob("*") if path.is_file() and "__pycache__" not in path.parts}
    names = {path.relative_to(HOME).as_posix() for path in own}
    assert {"jsecon/py.typed", "jsecon/__init__.pyi", "jsecon/app/viewer/page.html"} < names
    about = {name for name in wheel if name.partition("/")[0].endswith(".dist-info")}
    assert wheel - about == names
    assert any(name.endswith("licenses/LICENSE") for name in about)
    assert names | {"LICENSE", "README.md", "pyproject.toml"} <= source
    assert not any(name.startswith("tests/") for name in source)


def test_the_extra_all_brings_what_the_program_uses_and_no_torch():
    extras = PROJECT["optional-dependencies"]
    (named,) = extras["all"]
    left_out = {"all", "dev", "docs", "export", "words"}
    assert set(named.removeprefix("jsecon[").removesuffix("]").split(",")) == set(extras) - left_out
    assert "torch" in " ".join(extras["export"])


def test_the_licences_of_all_that_is_asked_for_are_listed():
    rows = re.findall(r"^\| ([a-z0-9-]+) \| [^|]+ \| ([^|]+) \|", (HOME / "LICENSES.md").read_text(), re.MULTILINE)
    listed, extras = dict(rows), PROJECT["optional-dependencies"]
    asked = [need for name in extras if name not in ("all", "export") for need in extras[name]]
    needs = (re.split(r"[<>=\[]", need)[0] for need in [*PROJECT["dependencies"], *asked])
    names = {re.sub(r"[-_.]+", "-", need).lower() for need in needs}
    assert names - set(listed) == set()
    assert not {licence for licence in listed.values() if not licence.strip() or licence.strip() == "not told"}
