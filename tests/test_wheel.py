"""What is installed is the package whole: its source, its pages, its types. Built as for an index: an archive of the
source, and of that the wheel; takes the network, as every build in an environment of its own does."""

import email
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


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """(names in the source's archive, those in the wheel, the wheel's metadata)."""
    base = tmp_path_factory.mktemp("built")
    unwanted = shutil.ignore_patterns(".*", "__pycache__", "experiments", "benchmarks", "build", "*.egg-info")
    shutil.copytree(HOME, base / "tree", ignore=unwanted)
    command = [sys.executable, "-m", "build", "--outdir", str(base / "dist"), str(base / "tree")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    with tarfile.open(next((base / "dist").glob("*.tar.gz"))) as source:
        names = {member.name.partition("/")[2] for member in source.getmembers() if member.isfile()}
    with zipfile.ZipFile(next((base / "dist").glob("*-py3-none-any.whl"))) as wheel:
        told = next(name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
        return names, set(wheel.namelist()), email.message_from_bytes(wheel.read(told))


@pytest.mark.long
def test_the_wheel_holds_the_packages_files_and_nothing_else(built):
    source, wheel, _ = built
    own = {path for path in (HOME / "jsecon").rglob("*") if path.is_file() and "__pycache__" not in path.parts}
    names = {path.relative_to(HOME).as_posix() for path in own}
    assert {"jsecon/py.typed", "jsecon/__init__.pyi", "jsecon/app/viewer/static_page.html"} < names
    about = {name for name in wheel if name.partition("/")[0].endswith(".dist-info")}
    assert wheel - about == names
    assert any(name.endswith("licenses/LICENSE") for name in about)
    assert names | {"LICENSE", "README.md", "pyproject.toml"} <= source
    assert not any(name.startswith("tests/") for name in source)


@pytest.mark.long
def test_the_wheel_says_what_it_needs_and_offers(built):
    told = built[2]
    assert (told["Name"], told["License-Expression"]) == ("jsecon", PROJECT["license"])
    assert set(told.get_all("Provides-Extra")) == set(PROJECT["optional-dependencies"])
    plain = [line for line in told.get_all("Requires-Dist") if "extra ==" not in line]
    assert len(plain) == len(PROJECT["dependencies"])


def test_the_extra_all_brings_what_the_program_uses_and_no_torch():
    extras = PROJECT["optional-dependencies"]
    (all_,) = extras["all"]
    named = re.fullmatch(r"jsecon\[(.*)\]", all_)
    assert named is not None
    assert set(named[1].split(",")) == set(extras) - {"all", "dev", "docs", "export", "words"}
    assert "torch" in " ".join(extras["export"])


def test_the_licences_of_all_that_is_asked_for_are_listed():
    rows = re.findall(r"^\| ([a-z0-9-]+) \| [^|]+ \| ([^|]+) \|", (HOME / "LICENSES.md").read_text(), re.MULTILINE)
    listed, extras = dict(rows), PROJECT["optional-dependencies"]
    asked = [
        *PROJECT["dependencies"],
        *(need for name in extras if name not in ("all", "export") for need in extras[name]),
    ]
    names = {re.sub(r"[-_.]+", "-", re.split(r"[<>=\[]", need)[0]).lower() for need in asked}
    assert names - set(listed) == set()
    assert not {licence for licence in listed.values() if not licence.strip() or licence.strip() == "not told"}
