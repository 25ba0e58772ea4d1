"""What a program sets before jax starts."""

import os
import re
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from capture_files import refused, small_capture, write_transforms

from jsecon import InputError, load_capture, process
from jsecon.poses import sfm
from jsecon.process import _settings as settings
from jsecon.read.captures import build

ROOT = Path(__file__).resolve().parent.parent


def test_settings_give_way_to_the_user_and_to_a_home_that_cannot_be_written(tmp_path):
    environ = {
        "XLA_FLAGS": "--xla_force_host_platform_device_count=1 --xla_cpu_prefer_vector_width=256",
        "JAX_COMPILATION_CACHE_DIR": "/elsewhere",
        "HOME": str(tmp_path),
    }
    assert settings(environ, 8, frozenset({"avx512f"})) == {"XLA_FLAGS": environ["XLA_FLAGS"]}
    flags = [settings({}, n, frozenset(cpu))["XLA_FLAGS"] for n, cpu in ((1, {"avx2"}), (3, {"avx2", "avx512f"}))]
    assert [flag.partition("device_count=")[2] for flag in flags] == ["1", "3 --xla_cpu_prefer_vector_width=512"]
    kept = settings({"HOME": str(tmp_path)}, 1, frozenset())["JAX_COMPILATION_CACHE_DIR"]
    assert kept.startswith(str(tmp_path / ".cache" / "jsecon"))
    assert "JAX_COMPILATION_CACHE_DIR" not in settings({}, 1, frozenset())
    (tmp_path / "file").write_text("")
    assert "JAX_COMPILATION_CACHE_DIR" not in settings({"XDG_CACHE_HOME": str(tmp_path / "file" / "x")}, 1, frozenset())


def test_a_prepared_process_has_a_device_a_core_and_deletes_programs_that_nothing_has_read_for_months(tmp_path):
    """Those of any machine that shares the folder, and no other file."""
    names = ("xla-old/a-cache", "xla-old/b-cache", "xla-old/c.trace", "models/d")
    paths = [tmp_path / "jsecon" / name for name in names]
    for path, days in zip(paths, (100, 10, 100, 100)):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("kept")
        os.utime(path, (time.time() - 86400 * days,) * 2)
    program = (
        "from jsecon.process import prepare_process\n"
        "prepare_process()\n"
        "import os, jax\n"
        "print(jax.local_device_count(), 'JAX_COMPILATION_CACHE_DIR' in os.environ)"
    )
    environ = {key: value for key, value in os.environ.items() if key not in ("XLA_FLAGS", "JAX_COMPILATION_CACHE_DIR")}
    environ |= {"PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True, env=environ)
    assert done.stdout.split() == [str(len(os.sched_getaffinity(0))), "True"]
    assert [path.exists() for path in paths] == [False, True, False, True]


def test_room_for_columns_is_half_of_what_is_free_or_what_the_user_says(monkeypatch):
    monkeypatch.delenv("JSECON_MEMORY", raising=False)
    monkeypatch.setattr(process, "_available_memory", lambda: float(6 << 30))
    assert process.memory_budget() == 3 << 30
    monkeypatch.setenv("JSECON_MEMORY", "0.5")
    assert process.memory_budget() == 1 << 29
    monkeypatch.setenv("JSECON_MEMORY", "a lot")
    with pytest.raises(InputError, match="export JSECON_MEMORY=4"):
        process.memory_budget()


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="Linux tells it there")
def test_peak_memory_is_in_mebibytes():
    (peak,) = re.findall(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert process.peak_memory_mib() == pytest.approx(int(peak) / 2**10, rel=0.01)


@pytest.mark.parametrize("module", [build, sfm])
def test_images_are_read_by_as_many_threads_as_the_process_may_use_cores(module, tmp_path, monkeypatch):
    """As under taskset, and not by as many as the machine has; the first image that is cut ends the reading."""
    workers = []

    class CountedThreads(ThreadPoolExecutor):
        def __init__(self, count):
            workers.append(count)
            super().__init__(count)

    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2})
    monkeypatch.setattr(module, "ThreadPoolExecutor", CountedThreads)
    monkeypatch.setattr(sfm, "require_pycolmap", lambda where: None)
    write_transforms(small_capture(), tmp_path)
    images = sorted((tmp_path / "images").iterdir())
    for image in images:
        image.write_bytes(image.read_bytes()[:-20])
    with refused("cannot be read"):
        load_capture(tmp_path) if module is build else sfm.find_poses(images, tmp_path / "work", where=tmp_path)
    assert workers == [3]
