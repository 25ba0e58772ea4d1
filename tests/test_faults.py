"""Faults of the machine end in one message: no room, no memory, another run in the same folder, a request to stop."""

import contextlib
import errno
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from capture_files import context_of, refused, small_capture, write_images, write_text_model, write_transforms
from fuzz_readers import tiny_field
from test_pipeline import Recorder

from jsecon import load_capture, load_field, load_gaussians, save_field, save_gaussians
from jsecon.files import exclusive_lock, reading, write_text
from jsecon.pipeline import cache, run as pipeline
from jsecon.pipeline.scene_stages import plan_capture
from jsecon.read.captures.images import write_image

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def no_room():
    """Files end after 1000 bytes, as on a full disk."""
    own = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, own[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, own)


@pytest.mark.parametrize(("name", "write"), [
    ("a.safetensors", lambda path: save_field(path, tiny_field())),
    ("a.safetensors", lambda path: cache.save(path, np.zeros(9999))),
    ("a.ply", lambda path: save_gaussians(path, tiny_field().gaussians)),
    ("a.png", lambda path: write_image(path, np.random.default_rng(0).integers(0, 255, (99, 99, 3), np.uint8))),
    ("a.txt", lambda path: write_text(path, "x" * 5000)),
])  # fmt: skip
def test_a_full_disk_is_told_and_leaves_nothing(tmp_path, no_room, name, write):
    with refused(name, f"on writing to {tmp_path}", "free some room"):
        write(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def capture(tmp_path):
    folder = tmp_path / "Fotos aus Köln 日本 #1 %20"
    write_transforms(small_capture(), folder)
    return folder


def test_an_opencv_without_its_contrib_modules_is_told_before_anything_runs(capture, tmp_path, monkeypatch):
    monkeypatch.delattr("cv2.ximgproc")
    with refused("OpenCV", "without ximgproc", "--force-reinstall opencv-contrib-python-headless"):
        pipeline.run(pipeline.Options(capture), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_frames_that_lie_on_a_full_disk_are_told(capture, no_room, monkeypatch):
    """They are mapped: a page without a place on the disk would end the process."""
    monkeypatch.setenv("JSECON_MEMORY", "1e-9")
    with refused("for 0.0 GiB", "TMPDIR"):
        load_capture(capture)


class Meddler(Recorder):
    """Writes to a file while the captures are loaded."""

    def __init__(self, file):
        super().__init__()
        self.file = file

    @contextlib.contextmanager
    def progress(self, name):
        def meddle(done, total):
            if name == "load" and done == 1 and self.file is not None:
                with self.file.open("ab") as file:  # grows at once: rewritten, it would be empty for a moment
                    file.write(b"more")

        yield meddle


def test_a_file_that_changes_while_it_is_read_is_told_and_nothing_of_it_is_kept(capture, tmp_path):
    work = context_of(capture, tmp_path / "out")
    (tmp_path / "out").mkdir()

    def loaded_by(console):
        pipeline._compute_stages(work, plan_capture(work), console)
        return console.fresh["load"]

    with refused(capture, "files that changed while stage load read them", "same command again"):
        loaded_by(Meddler(sorted((capture / "images").iterdir())[-1]))
    assert list((tmp_path / "out" / "cache").glob("load-*")) == []
    assert loaded_by(Meddler(None))
    assert not loaded_by(Meddler(None))


def test_two_runs_in_one_folder_are_told_apart(capture, tmp_path):
    (tmp_path / "out").mkdir()
    with exclusive_lock(tmp_path / "out"), refused(tmp_path / "out", "another run"):
        pipeline.run(pipeline.Options(capture), tmp_path / "out")
    with exclusive_lock(tmp_path / "out"):
        pass
    (tmp_path / "file").touch()
    with refused(".lock", "on writing to", "free some room"), exclusive_lock(tmp_path / "file"):
        pass


@pytest.mark.parametrize("moment", ["load ", pytest.param("gaussians: ", marks=pytest.mark.long)])
def test_a_program_that_is_told_to_end_says_how_to_go_on(tmp_path, moment):
    """At its first word; and amid the fit, that jax compiles and computes in threads of its own."""
    capture, folder, out = small_capture(), tmp_path / "Fotos aus Köln 日本 #1 %20", tmp_path / "Ausgabe für Ä"
    write_images(capture, folder / "images")
    write_text_model(capture, folder / "sparse" / "0")
    command = [sys.executable, "-m", "jsecon", "run", str(folder), "--out", str(out), "--steps", "100000"]
    environ = {key: value for key, value in os.environ.items() if key not in ("XLA_FLAGS", "JAX_COMPILATION_CACHE_DIR")}
    to = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "env": environ | {"XDG_CACHE_HOME": str(tmp_path)}}
    with subprocess.Popen(command, text=True, cwd=ROOT, **to) as run:
        assert run.stdout is not None
        for line in run.stdout:
            if moment in line:
                break
        run.send_signal(signal.SIGTERM)
        told, _ = run.communicate(timeout=60)
    assert run.returncode == 130, told
    assert "again to resume" in told
    assert not list(out.rglob("*.partial*"))


def test_a_stop_is_exit_code_130_wherever_it_falls(tmp_path):
    """Amid the imports, when nothing has begun; and within an exec, for which CPython would end by SIGINT. Python does
    not take itself apart, in which jax may end by SIGSEGV."""
    (tmp_path / "sitecustomize.py").write_text(
        "import atexit, os, signal, sys\n"
        "atexit.register(lambda: print('taken apart', file=sys.stderr))\n"
        "class Import:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name == 'jsecon.app.cli':\n"
        "            exec('os.kill(os.getpid(), signal.SIGTERM)')\n"
        "sys.meta_path.insert(0, Import())"
    )
    command = [sys.executable, "-m", "jsecon", "doctor"]
    environ = {**os.environ, "PYTHONPATH": f"{tmp_path}:{ROOT}"}
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environ)
    assert (done.returncode, done.stderr) == (130, "\njsecon: interrupted.\n")


@pytest.mark.parametrize(("variable", "value"), [("JAX_PLATFORMS", "cpu,tpu"), ("JAX_PLATFORM_NAME", "rocm")])
def test_a_platform_that_jax_lacks_is_named_by_every_verb(tmp_path, variable, value):
    """And no file is called damaged; twice in one process, as a server that opens two fields."""
    save_field(tmp_path / "field.safetensors", tiny_field())
    save_gaussians(tmp_path / "scene.ply", tiny_field().gaussians)
    program = (
        "from jsecon.app import cli\n"
        "cli.main(['query', 'field.safetensors', 'red', '--out', 'a'])\n"
        "cli.main(['objects', 'field.safetensors'])\n"
        "cli.main(['run', 'scene.ply', '--out', 'b', '--dry-run'])\n"
        "cli.main(['doctor'])"
    )
    environ = {key: text for key, text in os.environ.items() if not key.startswith("JAX_PLATFORM")}
    environ |= {variable: value, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=tmp_path, env=environ)
    expected = f"{variable}: it asks for '{value}', which this jax does not have. Unset it, or set"
    errors = [line for line in done.stderr.splitlines() if line.startswith("jsecon: ")]
    assert len(errors) == 4, done.stderr
    assert all(expected in line for line in errors)
    assert "Traceback" not in done.stderr


def test_faults_of_the_machine_are_no_damage_of_a_file(tmp_path):
    save_field(tmp_path / "field.safetensors", tiny_field())
    save_gaussians(tmp_path / "scene.ply", tiny_field().gaussians)
    own = resource.getrlimit(resource.RLIMIT_NOFILE)
    lowest = os.open(os.devnull, os.O_RDONLY)
    os.close(lowest)
    for read, name in ((load_field, "field.safetensors"), (load_gaussians, "scene.ply")):
        read(tmp_path / name)  # with the modules that it imports
        try:
            resource.setrlimit(resource.RLIMIT_NOFILE, (lowest, own[1]))
            with refused(tmp_path / name, "Too many open files", "ulimit -n"):
                read(tmp_path / name)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, own)
    for code, words in ((errno.EACCES, "permissions"), (errno.EIO, "disk"), (errno.ENOMEM, "more memory")):
        with refused("a.ply", os.strerror(code), words), reading("a.ply", remedy="Export it again."):
            raise OSError(code, os.strerror(code))
    with pytest.raises(MemoryError), reading("a.ply"):
        raise MemoryError
