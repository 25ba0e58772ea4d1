"""A run by several processes of Open MPI: the same field as by one, and one message if one of them fails."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from jsecon import save_gaussians

JSECON = [sys.executable, "-m", "jsecon", "run"]
MPIRUN = ["mpirun", "--allow-run-as-root", "--oversubscribe", "--bind-to", "none"]
needs_mpirun = pytest.mark.skipif(shutil.which("mpirun") is None, reason="Open MPI is not installed")


@pytest.fixture(scope="module")
def small_run(room, room_run, tmp_path_factory) -> list[str]:
    """The arguments of a small run without a fit, on true masks."""
    scene = tmp_path_factory.mktemp("processes") / "scene.ply"
    save_gaussians(scene, room_run[0].field.gaussians)
    return [str(room), "--gaussians", str(scene), "--masks", str(room / "masks"), "--long-side", "96"]


def start(arguments, out, launcher=("-n", "2")):
    """Starts a run of two processes."""
    line = [*MPIRUN, *launcher, *JSECON, *arguments, "--out", str(out), "--distributed"]
    return subprocess.Popen(line, stdout=-1, stderr=-1, text=True)


@needs_mpirun
@pytest.mark.long
def test_two_processes_end_in_the_field_of_one(small_run, tmp_path):
    one = subprocess.Popen([*JSECON, *small_run, "--out", str(tmp_path / "one")], stdout=-1, stderr=-1, text=True)
    two = start(small_run, tmp_path / "two")
    for running in (one, two):
        out, error = running.communicate(timeout=300)
        assert running.returncode == 0, error
        assert out.count("next    jsecon query") == 1
    a, b = (load_file(tmp_path / name / "field.safetensors") for name in ("one", "two"))
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


def rank_of(out: Path, index: int) -> int | None:
    """Process id of one of the processes of a run into `out`, if it has started."""
    for place in Path("/proc").glob("[0-9]*"):
        try:
            environ, line = (place / "environ").read_bytes(), (place / "cmdline").read_bytes()
        except OSError:
            continue
        if f"OMPI_COMM_WORLD_RANK={index}\0".encode() in environ and os.fsencode(out) in line:
            return int(place.name)
    return None


@needs_mpirun
@pytest.mark.long
@pytest.mark.parametrize("index", [0, 1])
def test_a_process_that_is_killed_ends_the_run(small_run, tmp_path, index):
    running = start(small_run, tmp_path / "out")
    until = time.monotonic() + 120
    while not (tmp_path / "out" / ".lock").exists():
        assert running.poll() is None
        assert time.monotonic() < until
        time.sleep(0.05)
    os.kill(rank_of(tmp_path / "out", index), signal.SIGKILL)
    _, error = running.communicate(timeout=120)
    assert running.returncode != 0
    assert f"rank {index}" in error  # mpirun says which
    assert "Traceback" not in error
    assert rank_of(tmp_path / "out", 1 - index) is None


@needs_mpirun
@pytest.mark.long
def test_wrong_input_and_other_options_are_reported_once(small_run, tmp_path):
    (tmp_path / "empty").mkdir()
    _, error = start([str(tmp_path / "empty")], tmp_path / "out").communicate(timeout=120)
    assert error.count(f"jsecon: {tmp_path / 'empty'}") == 1
    rank = [*JSECON, *small_run, "--out", str(tmp_path / "out"), "--distributed", "--paper"]
    running = start(small_run, tmp_path / "out", ["-n", "1", *rank, ":", "-n", "1"])
    _, error = running.communicate(timeout=120)
    assert running.returncode != 0
    assert error.count("Give all processes the same options and version.") == 1


def test_without_a_launcher_the_remedy_names_one(room, tmp_path):
    environ = {name: value for name, value in os.environ.items() if not name.startswith(("OMPI_", "SLURM_"))}
    line = [*JSECON, str(room), "--out", str(tmp_path / "out"), "--distributed"]
    done = subprocess.run(line, capture_output=True, text=True, env=environ, timeout=120)
    assert (done.returncode, done.stderr.count("jsecon:")) == (2, 1)
    assert "mpirun -n 2 jsecon run" in done.stderr
