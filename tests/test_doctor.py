"""`jsecon doctor`: a line for each thing that runs need."""

import json
import re
import tomllib
from pathlib import Path

import jax
import pytest
from clip_files import write_clip

from jsecon import InputError, backend, process
from jsecon.app import cli, doctor

PROJECT = tomllib.loads((Path(__file__).resolve().parent.parent / "pyproject.toml").read_text())["project"]


def _lines(capsys, *options):
    code = cli.main(["doctor", *map(str, options)])
    out = capsys.readouterr().out
    return code, {line[9:19].strip(): (line[:8].strip(), line[20:]) for line in out.splitlines()}


def _check(name):
    return next(check for check in doctor.run_checks() if check.name == name)


def test_it_tells_what_is_here_and_what_is_not(tmp_path, capsys, monkeypatch):
    write_clip(tmp_path / "clip", "immich")
    monkeypatch.setitem(doctor.EXTRAS, "sfm", (("no_such_module",), "poses"))
    code, lines = _lines(capsys, "--models", tmp_path)
    assert code == 0
    assert {status for status, _ in lines.values()} <= {"ok", "missing", "wrong"}
    assert jax.__version__ in lines["jax"][1]
    assert lines["jax"][1].endswith(f"{len(jax.devices())} cpu")
    assert lines["backend"][0] == "ok"
    assert lines["CLIP"] == ("ok", lines["CLIP"][1])
    assert "--embedder" in lines["CLIP"][1]
    assert lines["SAM"][0] == "missing"
    assert lines["sfm"] == ("missing", 'poses: pip install "jsecon[sfm]" (no_such_module)')
    assert re.match(r"\d+(\.\d)? [GM]iB free", lines["memory"][1])


def test_what_every_run_needs_and_is_wrong_is_exit_code_2(capsys, monkeypatch):
    monkeypatch.setattr(doctor, "MIN_MEMORY", 1 << 60)

    def wrong():
        raise RuntimeError("cosines are off")

    monkeypatch.setattr(backend, "check_backend", wrong)
    assert cli.main(["doctor", "--json"]) == 2
    told = json.loads(capsys.readouterr().out)
    assert {check["name"]: check["status"] for check in told["checks"]}["backend"] == "wrong"
    assert [error["where"] for error in told["errors"]] == ["backend", "memory"]
    assert told["errors"][0]["remedy"] == backend.REMEDY
    with pytest.raises(InputError, match="no such folder"):
        doctor.run_checks(Path("nowhere"))


def test_a_package_that_cannot_be_imported(monkeypatch):
    monkeypatch.setattr(doctor, "PACKAGES", ("numpy", "no_such_module"))
    check = _check("packages")
    assert check.status == "missing"
    assert "no_such_module (No module named" in check.message
    assert check.remedy
    monkeypatch.setattr(doctor, "PACKAGES", ("cv2",))
    assert _check("packages").status == "ok"
    monkeypatch.delattr("cv2.ximgproc.createSuperpixelSLIC")
    assert "without ximgproc" in _check("packages").message


def test_it_knows_the_packages_and_extras_of_the_project():
    assert set(doctor.EXTRAS) == set(PROJECT["optional-dependencies"]) - {"dev", "all"}
    wanted = next(need for need in PROJECT["dependencies"] if need.startswith("jax>"))
    assert f'"{wanted}"' in Path(doctor.__file__).read_text()
    assert len(doctor.PACKAGES) == len(PROJECT["dependencies"]) - 1  # jax has a line of its own


def test_limits_of_a_cgroup_are_told(monkeypatch):
    files = {"memory.max": ["1073741824"], "memory.current": ["1000"], "cpu.max": ["50000", "100000"]}
    for module in (doctor, process):
        monkeypatch.setattr(module, "read_cgroup", lambda new, old: files.get(new, []))
    memory, cores = _check("memory"), _check("cores")
    assert (memory.status, "limit 1.0 GiB (cgroup)" in memory.message) == ("wrong", True)
    assert "the time of 0.5 (cgroup)" in cores.message


def test_a_disk_without_room_for_programs_is_told(tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "not" / "yet"))
    assert _check("programs").status == "ok"
    monkeypatch.setattr(doctor, "MIN_CACHE_DISK", 1 << 60)
    check = _check("programs")
    assert (check.status, "every run compiles further ones" in check.message) == ("missing", True)
