"""A run by several processes: the same field as by one; and what is said where one dies or does not fit."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from jsecon import InputError, save_ply
from jsecon.pipeline.processes import launch
from jsecon.process import WORKER

COMMAND = [sys.executable, "-m", "jsecon"]


def members(out: Path) -> dict[int, int]:
    """index -> process id of the children of a run into `out`."""
    found = {}
    for place in Path("/proc").glob("[0-9]*"):
        try:
            environ, line = (place / "environ").read_bytes(), (place / "cmdline").read_bytes()
        except OSError:
            continue
        if (told := environ.partition(f"{WORKER}=".encode())[2]) and os.fsencode(out) in line:
            found[int(told.split(b" ")[0])] = int(place.name)
    return found


@pytest.fixture(scope="module")
def small_run(room, room_run, tmp_path_factory) -> list[str]:
    """The arguments of a small run without a fit, on true masks."""
    scene = tmp_path_factory.mktemp("processes") / "scene.ply"
    save_ply(scene, room_run[0].field.gaussians)
    return ["run", str(room), "--gaussians", str(scene), "--masks", str(room / "masks"), "--long-side", "96"]


@pytest.mark.long
def test_two_processes_end_in_the_field_of_one(small_run, tmp_path):
    alone, both = tmp_path / "alone", tmp_path / "both"
    one = subprocess.Popen([*COMMAND, *small_run, "--out", str(alone)], stdout=-1, stderr=-1)
    two = [*COMMAND, *small_run, "--out", str(both), "--processes", "2"]
    done = subprocess.run(two, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    assert "field" in done.stdout
    assert "Gloo" not in done.stdout + done.stderr
    _, error = one.communicate(timeout=200)
    assert one.returncode == 0, error
    a, b = (load_file(folder / "field.safetensors") for folder in (alone, both))
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


@pytest.mark.long
def test_a_dead_process_ends_the_other(small_run, tmp_path):
    line = [*COMMAND, *small_run, "--out", str(tmp_path / "out"), "--processes", "2"]
    killed = subprocess.Popen(line, stdout=-1, stderr=-1, text=True)
    until = time.monotonic() + 60
    while len(found := members(tmp_path / "out")) < 2 or not (tmp_path / "out" / ".lock").exists():
        assert killed.poll() is None
        assert time.monotonic() < until
        time.sleep(0.05)
    os.kill(found[1], signal.SIGKILL)
    _, error = killed.communicate(timeout=60)
    assert (killed.returncode, error.count("jsecon:")) == (2, 1)
    assert "process 1 of 2, signal SIGKILL" in error


def test_what_is_wrong_with_the_input_is_said_once(tmp_path):
    (tmp_path / "empty").mkdir()
    line = [*COMMAND, "run", str(tmp_path / "empty"), "--out", str(tmp_path / "out"), "--processes", "2"]
    ended = subprocess.run(line, capture_output=True, text=True, timeout=120)
    assert (ended.returncode, ended.stderr.count("jsecon:")) == (2, 1)
    assert "empty" in ended.stderr


@pytest.mark.parametrize(("count", "coordinator", "index", "where"), [
    (0, None, None, "processes"), (2, "127.0.0.1:7733", None, "processes"), (2, None, 1, "processes"),
    (2, "127.0.0.1:7733", 2, "processes"), (2, "nowhere", 0, "--coordinator"), (2, "host:port", 0, "--coordinator"),
])  # fmt: skip
def test_numbers_that_do_not_fit_are_refused(count, coordinator, index, where):
    with pytest.raises(InputError) as caught:
        launch([], count, coordinator, index)
    assert caught.value.where == where
