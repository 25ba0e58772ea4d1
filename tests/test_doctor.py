"""`jsecon doctor`: a line for each thing that runs need."""

import json
import re

import jax

from jsecon import backend, process
from jsecon.app import cli, doctor


def _check(name, capsys):
    """What the doctor says of one thing."""
    cli.main(["doctor", "--json"])
    checks = json.loads(capsys.readouterr().out)["checks"]
    return next(check for check in checks if check["name"] == name)


def test_it_prints_what_is_here_and_what_is_not(capsys, monkeypatch):
    needs = ["numpy>=2", 'no-such-package>=1; extra == "sfm"', "numpy; extra == 'formats'"]
    monkeypatch.setattr(doctor.importlib.metadata, "requires", lambda name: needs)
    assert cli.main(["doctor"]) == 0
    printed = capsys.readouterr().out
    lines = {line[9:19].strip(): (line[:8].strip(), line[20:]) for line in printed.splitlines()}
    assert {status for status, _ in lines.values()} <= {"ok", "missing", "wrong"}
    assert jax.__version__ in lines["jax"][1]
    assert lines["jax"][1].endswith(f"{len(jax.devices())} cpu")
    assert lines["backend"][0] == "ok"
    assert re.match(r"all \d+ required packages can be imported", lines["packages"][1])
    assert lines["sfm"] == ("missing", 'pip install "jsecon[sfm]" (no-such-package)')
    assert lines["formats"] == ("ok", "installed")
    assert re.match(r"\d+(\.\d)? [GM]iB free", lines["memory"][1])


def test_what_every_run_needs_and_is_wrong_is_exit_code_2(capsys, monkeypatch):
    monkeypatch.setattr(doctor, "MIN_MEMORY", 1 << 60)

    def wrong():
        raise RuntimeError("cosines are off")

    monkeypatch.setattr(backend, "check_backend", wrong)
    assert cli.main(["doctor", "--json"]) == 2
    printed = json.loads(capsys.readouterr().out)
    assert {check["name"]: check["status"] for check in printed["checks"]}["backend"] == "wrong"
    assert [error["where"] for error in printed["errors"]] == ["backend", "memory"]
    assert printed["errors"][0]["remedy"] == backend.REMEDY


def test_a_package_that_lacks_a_part_is_named(capsys, monkeypatch):
    monkeypatch.delattr("cv2.ximgproc.createSuperpixelSLIC")
    check = _check("packages", capsys)
    assert check["status"] == "missing"
    assert "without ximgproc" in check["message"]
    assert check["remedy"]


def test_the_limit_of_a_cgroup_is_read(capsys, monkeypatch):
    files = {"memory.max": ["1073741824"], "memory.current": ["1000"]}
    monkeypatch.setattr(process, "_read_cgroup", lambda new, old: files.get(new, []))
    memory = _check("memory", capsys)
    assert memory["status"] == "wrong"
    assert "limit 1.0 GiB (cgroup)" in memory["message"]
