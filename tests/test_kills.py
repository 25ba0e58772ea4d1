"""Runs that are stopped by SIGKILL or by a full disk end in the same field when the same command is started again.

`jsecon add` and `jsecon update` that are killed leave the old field or have written the new one, whole; test_ledger.py
and test_faults.py stop them by a full disk.

KILLS=30 DISKS=10 pytest -m long tests/test_kills.py
"""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from jsecon import open_scene

pytestmark = pytest.mark.long
HOME = Path(__file__).resolve().parent.parent
KILLS, DISKS = int(os.environ.get("KILLS", 2)), int(os.environ.get("DISKS", 1))
FREQUENT = """
from jsecon.process import prepare_process
prepare_process()
from jsecon.__main__ import main
from jsecon.pipeline import stages
stages.CHECKPOINT_SECONDS = 0.5
raise SystemExit(main())
"""
"""`jsecon` with frequent checkpoints"""
LARGE_DISK = 64 << 20
"""bytes that suffice for a run"""


def start(room, out, programs, kill_at=None):
    """(exit code or None if killed, stderr without progress) of `jsecon run`, killed `kill_at` seconds after start."""
    return execute(["run", room, "--out", out, "--steps", "50"], programs, kill_at)


def execute(arguments, programs, kill_at=None):
    """The same of any command."""
    command = [sys.executable, "-c", FREQUENT, *map(str, arguments)]
    environ = {**os.environ, "PYTHONPATH": str(HOME), "XDG_CACHE_HOME": str(programs)}
    environ.pop("JAX_COMPILATION_CACHE_DIR", None)
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env=environ, start_new_session=True, **pipes) as run:
        try:
            _, error = run.communicate(timeout=kill_at)
            code = run.returncode
        except subprocess.TimeoutExpired:
            os.killpg(run.pid, signal.SIGKILL)
            _, error = run.communicate()
            code = None
    return code, "\n".join(line for line in error.splitlines() if not line.startswith("  ")).strip()


def check_resumed(room, out, programs, expected):
    assert start(room, out, programs) == (0, "")
    assert (out / "field.safetensors").read_bytes() == expected
    assert not list(out.rglob("*.checkpoint*"))


@pytest.fixture(scope="module")
def straight(room, tmp_path_factory):
    """(bytes of the field of a run that nothing stops, its seconds, the bytes of its folder, compiled programs)."""
    base = tmp_path_factory.mktemp("straight")
    assert start(room, base / "warm", base / "programs") == (0, "")
    began = time.monotonic()
    assert start(room, base / "out", base / "programs") == (0, "")
    seconds = time.monotonic() - began
    size = sum(-(-path.stat().st_size // 4096) * 4096 for path in (base / "out").rglob("*") if path.is_file())
    return (base / "out" / "field.safetensors").read_bytes(), seconds, size, base / "programs"


@pytest.mark.parametrize("number", range(KILLS))
def test_a_killed_run_resumes_to_the_same_field(room, straight, tmp_path, number):
    expected, seconds, _, programs = straight
    moments = np.random.default_rng(number)
    if cold := number % 10 == 1:  # killed while jax writes its compiled programs, too
        programs = tmp_path / "programs"
    code = 0
    while code is not None:
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        code, _ = start(room, tmp_path / "out", programs, kill_at=moments.uniform(0, (1 + cold) * seconds))
    check_resumed(room, tmp_path / "out", programs, expected)


def mount(folder, options):
    return subprocess.run(["mount", "-o", options, "-t", "tmpfs", "tmpfs", str(folder)], capture_output=True).returncode


@pytest.mark.parametrize("number", range(DISKS))
def test_a_run_on_a_full_disk_resumes_once_there_is_room(room, straight, tmp_path, number):
    expected, _, size, programs = straight
    size = int(np.random.default_rng(number).uniform(0, size)) // 4096 * 4096 + 4096
    if mount(tmp_path, f"size={size}"):
        pytest.skip("no disk can be mounted here")
    try:
        code, error = start(room, tmp_path / "out", programs)
        assert code == 2
        assert re.fullmatch("jsecon: .*No space left.*", error)
        assert not list((tmp_path / "out").rglob("*.partial*"))
        assert mount(tmp_path, f"remount,size={LARGE_DISK}") == 0
        check_resumed(room, tmp_path / "out", programs, expected)
    finally:
        subprocess.run(["umount", "-l", str(tmp_path)], check=True)


@pytest.fixture(scope="module")
def changing(room_run, room, tmp_path_factory):
    """(folder of a field that lacks a frame, programs, {command: (arguments behind the field, seconds, files)})."""
    base = tmp_path_factory.mktemp("changing")
    shutil.copytree(room_run[1], base / "old")
    scene, commands = open_scene(base / "old"), {}
    scene.forget([scene.field.names[1]]).save(base / "old" / "field.safetensors")
    for name, options in (("add", ()), ("update", ("--date", "2026-11-28"))):
        for folder in ("warm", name):
            shutil.copytree(base / "old", base / folder)
            began = time.monotonic()
            assert execute((name, base / folder, room, *options), base / "programs") == (0, "")
        commands[name] = (room, *options), time.monotonic() - began, fields_of(base / name)
        shutil.rmtree(base / "warm")
    return base / "old", base / "programs", commands


def fields_of(folder):
    """The bytes of a field and of its ledger."""
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*.safetensors")}


@pytest.mark.parametrize("verb", ["add", "update"])
@pytest.mark.parametrize("number", range(KILLS))
def test_a_killed_change_leaves_the_old_field(changing, tmp_path, verb, number):
    old, programs, commands = changing
    rest, seconds, expected = commands[verb]
    folder, moments = shutil.copytree(old, tmp_path / "field"), np.random.default_rng(number)
    code, _ = execute((verb, folder, *rest), programs, kill_at=moments.uniform(0.3, 1) * seconds)
    if code is None:
        field = folder / "field.safetensors"
        assert field.read_bytes() in (fields_of(old)[Path(field.name)], expected[Path(field.name)])
        assert open_scene(folder).ledger.views
        if field.read_bytes() != expected[Path(field.name)]:
            assert execute((verb, folder, *rest), programs) == (0, "")
    assert fields_of(folder) == expected
