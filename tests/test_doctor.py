"""`jsecon doctor`: a line for each thing that runs need."""

import json

from jsecon import backend
from jsecon.app import cli, doctor


def test_what_is_here_is_told_and_what_every_run_needs_and_is_wrong_is_exit_code_2(capsys, monkeypatch):
    def wrong():
        raise RuntimeError("cosines are off")

    needs = ["opencv-contrib-python-headless>=4", 'no-such-package>=1; extra == "sfm"', "numpy; extra == 'formats'"]
    monkeypatch.setattr(doctor.importlib.metadata, "requires", lambda name: needs)
    assert cli.main(["doctor"]) == 0
    assert 'pip install "jsecon[sfm]" (no-such-package)' in capsys.readouterr().out
    monkeypatch.setattr(backend, "check_backend", wrong)
    monkeypatch.delattr("cv2.ximgproc.createSuperpixelSLIC")
    assert cli.main(["doctor", "--json"]) == 2
    printed = json.loads(capsys.readouterr().out)
    checks = {check["name"]: (check["status"], check["message"]) for check in printed["checks"]}
    found = [checks[name][0] for name in ("backend", "packages", "sfm", "formats")]
    assert found == ["wrong", "missing", "missing", "ok"]
    assert "without ximgproc" in checks["packages"][1]
    assert {error["where"] for error in printed["errors"]} == {"packages", "backend"}
    assert all(error["remedy"] for error in printed["errors"])
