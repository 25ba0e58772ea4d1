"""`jsecon doctor`: a line for each thing that runs need."""

import json

from jsecon import backend
from jsecon.app import cli, doctor


def test_what_every_run_needs_is_told_and_what_is_wrong_is_exit_code_2(capsys, monkeypatch):
    def wrong():
        raise RuntimeError("cosines are off")

    needs = ["opencv-contrib-python-headless>=4", 'no-such-package>=1; extra == "sfm"']
    monkeypatch.setattr(doctor.importlib.metadata, "requires", lambda name: needs)
    assert cli.main(["doctor"]) == 0
    assert "all 1 required packages" in capsys.readouterr().out
    monkeypatch.setattr(backend, "check_backend", wrong)
    monkeypatch.delattr("cv2.ximgproc.createSuperpixelSLIC")
    assert cli.main(["doctor", "--json"]) == 2
    printed = json.loads(capsys.readouterr().out)
    assert set(printed["checks"]) == {"python"}
    errors = {error["where"]: error for error in printed["errors"]}
    assert set(errors) == {"packages", "jax"}
    assert "without ximgproc" in errors["packages"]["problem"]
    assert all(error["remedy"] for error in errors.values())
