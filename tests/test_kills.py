"""A few of the runs that tests/kills.py stops, and that it tells what is wrong."""

import time
from pathlib import Path

import kills
import pytest


@pytest.mark.long
def test_two_runs_killed_and_one_on_a_full_disk_end_in_the_same_field(room, tmp_path):
    """Thirty and ten: python -m tests.kills."""
    given = {"kills": 2, "cold": 0, "steps": 50, "seed": 1}
    try:
        found = list(kills.trials(room, tmp_path, disks=1, **given))
    except kills.NoDisk as error:
        pytest.skip(f"no disk can be mounted here: {error}")
    assert [trial.how.split()[0].rstrip(",") for trial in found] == ["straight", "straight", "kill", "kill", "disk"]
    assert [str(trial) for trial in found if trial.wrong] == []


@pytest.mark.parametrize(
    ("ends", "told"),
    [
        ("import sys; print('x', file=sys.stderr)", "then said: x"),
        ("raise SystemExit(3)", "then exit code 3"),
        ("open(out / 'field.safetensors', 'wb').write(b'other')", "ANOTHER FIELD"),
        ("open(out / 'a.checkpoint.safetensors', 'wb')", "left ['a.checkpoint.safetensors']"),
        ("pass", ""),
    ],
)
def test_each_kind_of_ill_is_told(tmp_path, monkeypatch, ends, told):
    """Of what goes on in place of a run."""
    program = "import sys, pathlib; out = pathlib.Path(sys.argv[4]); "
    program += f"open(out / 'field.safetensors', 'wb').write(b'same'); {ends}"
    monkeypatch.setattr(kills, "OFTEN", program)
    out = tmp_path / "out"
    out.mkdir()
    (out / "field.safetensors").write_bytes(b"same")
    place = kills.Place(out, tmp_path, often=True)
    wrong, _ = kills._went_on(tmp_path, place, 1, kills._digest(out))
    assert wrong.startswith(told)
    assert bool(wrong) == bool(told)


def test_a_process_and_its_children_are_killed_at_the_moment_asked_for(tmp_path, monkeypatch):
    program = (
        "import subprocess, sys, time; child = subprocess.Popen(['sleep', '99']);"
        "print('  load             done      0.1 s', flush=True);"
        "print(child.pid, file=sys.stderr, flush=True); time.sleep(99)"
    )
    monkeypatch.setattr(kills, "OFTEN", program)
    stopped = kills.ended(tmp_path, kills.Place(tmp_path, tmp_path, often=True), 1, kill_at=1.5)
    assert (stopped.code, stopped.stage) == (None, "load")
    assert 1.5 <= stopped.seconds < 30
    until, state = time.monotonic() + 20, Path(f"/proc/{int(stopped.said)}/stat")
    while state.exists() and state.read_text().split()[2] != "Z":
        assert time.monotonic() < until, "a child that lives on"
        time.sleep(0.05)
