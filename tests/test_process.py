"""What a program sets before jax starts."""

import ast
import json
import os
import re
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest

from jsecon import InputError, process
from jsecon.poses import sfm
from jsecon.process import _settings as settings
from jsecon.read.captures import build
from jsecon.read.captures.capture import load_capture

ROOT = Path(__file__).resolve().parent.parent


def test_settings_ask_for_every_core_and_wide_vectors_only_where_there_are_any():
    wide = settings({}, 3, frozenset({"avx2", "avx512f"}))["XLA_FLAGS"].split()
    assert wide == ["--xla_force_host_platform_device_count=3", "--xla_cpu_prefer_vector_width=512"]
    assert settings({}, 1, frozenset({"avx2"}))["XLA_FLAGS"] == "--xla_force_host_platform_device_count=1"


def test_settings_give_way_to_the_user(tmp_path):
    environ = {
        "XLA_FLAGS": "--xla_force_host_platform_device_count=1 --xla_cpu_prefer_vector_width=256",
        "JAX_COMPILATION_CACHE_DIR": "/elsewhere",
        "HOME": str(tmp_path),
    }
    assert settings(environ, 8, frozenset({"avx512f"})) == {"XLA_FLAGS": environ["XLA_FLAGS"]}
    kept = settings({"HOME": str(tmp_path)}, 1, frozenset())["JAX_COMPILATION_CACHE_DIR"]
    assert kept.startswith(str(tmp_path / ".cache" / "jsecon"))
    assert "JAX_COMPILATION_CACHE_DIR" not in settings({}, 1, frozenset())


def test_a_home_that_cannot_be_written_leaves_out_the_compiled_programs(tmp_path):
    (tmp_path / "file").write_text("")
    assert "JAX_COMPILATION_CACHE_DIR" not in settings({"XDG_CACHE_HOME": str(tmp_path / "file" / "x")}, 1, frozenset())


def run(program, home):
    """A program in a process of its own, whose compiled programs are kept in `home`."""
    environ = {key: value for key, value in os.environ.items() if key not in ("XLA_FLAGS", "JAX_COMPILATION_CACHE_DIR")}
    environ |= {"PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(home)}
    return subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True, env=environ)


@pytest.mark.parametrize("kept", [True, pytest.param(False, marks=pytest.mark.long)])
def test_a_prepared_process_has_a_device_a_core(tmp_path, kept):
    program = (
        "from jsecon.process import prepare_process\n"
        f"prepare_process(keep_programs={kept})\n"
        "import os, jax\n"
        "print(jax.local_device_count(), 'JAX_COMPILATION_CACHE_DIR' in os.environ)"
    )
    assert run(program, tmp_path).stdout.split() == [str(len(os.sched_getaffinity(0))), str(kept)]


@pytest.mark.long
def test_a_program_that_was_cut_short_on_disk_is_compiled_and_kept_anew_without_a_word(tmp_path):
    """As a full disk leaves it, or a stop while jax writes it."""
    program = (
        "from jsecon.process import prepare_process, compilation_counts\n"
        "prepare_process()\n"
        "compilation_counts()\n"
        "import jax, warnings\n"
        "print(jax.jit(lambda x: 3 * x)(7), compilation_counts())\n"
        "warnings.warn('of another kind')"
    )
    first = run(program, tmp_path)
    kept = {file: file.read_bytes() for file in tmp_path.rglob("*-cache")}
    assert len(kept) == ast.literal_eval(first.stdout.split(" ", 1)[1])["all"] > 0
    for file, data in kept.items():
        file.write_bytes(data[: len(data) // 2])
    for from_disk in (0, len(kept)):
        done = run(program, tmp_path)
        assert done.stdout == f"21 { ({'all': len(kept), 'from_disk': from_disk}) }\n"
        assert re.findall(r"\w+Warning: .*", done.stderr) == ["UserWarning: of another kind"]
        assert set(tmp_path.rglob("*-cache")) == set(kept)


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="counts memory maps, which Linux tells")
def test_programs_are_forgotten_where_there_are_too_many_maps(tmp_path):
    program = (
        "import jax\n"
        "from experiments.memory_maps import clear_programs\n"
        "double = jax.jit(lambda x: 2 * x)\n"
        "for above in (10**9, 0):\n"
        "    double(1)\n"
        "    clear_programs(above=above)\n"
        "    print(double._cache_size())"
    )
    assert run(program, tmp_path).stdout.split() == ["1", "0"]


def test_programs_that_nothing_has_read_for_months_are_deleted(tmp_path):
    """Those of any machine that shares the folder, and no other file."""
    names = ("xla-old/a-cache", "xla-old/b-cache", "xla-old/c.trace", "models/d")
    paths = [tmp_path / "jsecon" / name for name in names]
    for path, days in zip(paths, (100, 10, 100, 100)):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("kept")
        os.utime(path, (time.time() - 86400 * days,) * 2)
    run("from jsecon.process import prepare_process\nprepare_process()", tmp_path)
    assert [path.exists() for path in paths] == [False, True, False, True]


def test_room_for_columns_is_half_of_what_is_free_or_what_the_user_says(monkeypatch):
    monkeypatch.delenv("JSECON_MEMORY", raising=False)
    monkeypatch.setattr(process, "available_memory", lambda: (6 << 30, None))
    assert process.memory_budget() == 3 << 30
    monkeypatch.setattr(process, "available_memory", lambda: (None, None))
    assert process.memory_budget() == float("inf")
    monkeypatch.setenv("JSECON_MEMORY", "0.5")
    assert process.memory_budget() == 1 << 29
    monkeypatch.setenv("JSECON_MEMORY", "a lot")
    with pytest.raises(InputError, match="export JSECON_MEMORY=4"):
        process.memory_budget()


def test_a_stop_that_python_drops_comes_again():
    """It falls into a destructor, of which Python only tells that its exception was ignored."""
    program = (
        "import os, signal, sys, time\n"
        "from jsecon.process import stop_by_signals\n"
        "signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        "stop_by_signals()\n"
        "class Gone:\n"
        "    def __init__(self, act): self.act = act\n"
        "    def __del__(self): self.act()\n"
        "Gone(lambda: 1 / 0)\n"
        "Gone(lambda: os.kill(os.getpid(), signal.SIGTERM))\n"
        "print('went on', flush=True)\n"
        "try:\n"
        "    time.sleep(600)\n"
        "except KeyboardInterrupt:\n"
        "    sys.exit(130)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT)
    assert (done.returncode, done.stdout) == (130, "went on\n")
    assert "ZeroDivisionError" in done.stderr
    assert "KeyboardInterrupt" not in done.stderr


@pytest.mark.parametrize("module", [build, sfm])
def test_images_are_read_by_as_many_threads_as_the_process_has_cores(module, tmp_path, monkeypatch):
    workers = []

    class CountedThreads(ThreadPoolExecutor):
        def __init__(self, count):
            workers.append(count)
            super().__init__(count)

    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2})
    monkeypatch.setattr(module, "ThreadPoolExecutor", CountedThreads)
    photos = [tmp_path / f"{n}.png" for n in range(3)]
    noise = np.random.default_rng(0).integers(0, 256, (32, 32, 3), np.uint8)
    for photo in photos:
        photo.write_bytes(cv2.imencode(".png", noise)[1].tobytes()[:1000])  # its header tells the size, then it ends
    lens = {"fl_x": 8.0, "fl_y": 8.0, "cx": 4.0, "cy": 4.0, "w": 32, "h": 32}
    frames = [{"file_path": photo.name, "transform_matrix": np.eye(4).tolist()} for photo in photos]
    (tmp_path / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    read = {build: lambda: load_capture(tmp_path), sfm: lambda: sfm.find_poses(photos, tmp_path / "work")}
    with pytest.raises(InputError):
        read[module]()
    assert workers == [3]
