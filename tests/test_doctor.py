"""`jsecon doctor`: a line for each thing that runs need."""

import json
import re

import jax

from jsecon import backend, process
from jsecon.app import cli, doctor


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
    def wrong():
        raise RuntimeError("cosines are off")

    files = {"memory.max": ["1073741824"], "memory.current": ["1000"]}
    monkeypatch.setattr(process, "_read_cgroup", lambda new, old: files.get(new, []))
    monkeypatch.setattr(backend, "check_backend", wrong)
    monkeypatch.delattr("cv2.ximgproc.createSuperpixelSLIC")
    assert cli.main(["doctor", "--json"]) == 2
    printed = json.loads(capsys.readouterr().out)
    checks = {check["name"]: (check["status"], check["message"]) for check in printed["checks"]}
    assert (checks["backend"][0], checks["memory"][0], checks["packages"][0]) == ("wrong", "wrong", "missing")
    assert "limit 1.0 GiB (cgroup)" in checks["memory"][1]
    assert "without ximgproc" in checks["packages"][1]
    assert {error["where"] for error in printed["errors"]} == {"packages", "backend", "memory"}
    assert all(error["remedy"] for error in printed["errors"])
