"""`jsecon doctor`: checks what runs need of this machine."""

import dataclasses
import importlib
import importlib.util
import os
import platform
import shutil
from pathlib import Path
from typing import Literal

from jsecon.app import verbs
from jsecon.errors import InputError, describe_error
from jsecon.pipeline.progress import Console
from jsecon.process import available_memory, cores, read_cgroup

MIN_MEMORY = 2 << 30
"""bytes that `jsecon demo` takes, rounded up"""
MIN_DISK = 200 << 20
"""bytes that `jsecon demo` writes, rounded up"""
MIN_CACHE_DISK = 32 << 20
"""bytes of the compiled programs of `jsecon demo`, rounded up"""
# fmt: off
PACKAGES = (
    "numpy", "filelock", "scipy", "sklearn", "cv2", "PIL", "jaxtyping", "optax", "onnxruntime",
    "tokenizers", "safetensors", "tyro", "lazy_loader", "huggingface_hub",
)
# fmt: on
"""modules of the packages that jsecon requires; jax has another check"""
EXTRAS = {
    "sfm": (("pycolmap",), "poses of photographs and videos"),
    "formats": (("gsply", "pillow_heif"), ".spz, .sog and compressed .ply, HEIC photographs"),
    "serve": (("fastapi", "uvicorn"), "jsecon serve"),
    "viewer": (("viser",), "jsecon view"),
    "mcp": (("mcp",), "jsecon mcp"),
    "docs": (("sphinx", "myst_nb", "furo"), "building the documentation"),
    "figures": (("matplotlib",), "figures of the experiments"),
    "words": (("ai_edge_litert",), "the experiment on real words"),
    "export": (("torch", "open_clip", "transformers", "onnx"), "CLIP, SigLIP and SAM 2.1 from checkpoints"),
}
"""extra -> the modules that it installs, and what it is for"""


@dataclasses.dataclass(frozen=True)
class Check:
    """Result of one check.

    Attributes:
      name: What is checked.
      status: Whether it is fine.
      message: What the check measured.
      remedy: What to do about it, if every run depends on it.
    """

    name: str
    status: Literal["ok", "missing", "wrong"]
    message: str
    remedy: str = ""


def run_checks(models: Path | None = None) -> list[Check]:
    """Runs all checks.

    Args:
      models: Folder with .onnx files, or of such folders; None examines no models.

    Returns:
      The results.

    Raises:
      InputError: There is no such folder.
    """
    checks = [Check("python", "ok", f"{platform.python_version()}, {platform.platform(terse=True)}"), _check_packages()]
    checks += [*_check_jax(), _check_cores(), _check_memory(), _check_disk(), _check_programs()]
    return [*checks, *_check_models(models), *map(_check_extra, EXTRAS)]


def _doctor(verb: verbs.Doctor, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon doctor`; a check that fails and that every run depends on is an error."""
    with console.progress("checks"):
        checks = run_checks(verb.models)
    console.print_line("\n".join(f"{check.status:<8} {check.name:<10} {check.message}" for check in checks))
    failed = [check for check in checks if check.remedy and check.status != "ok"]
    return {"checks": checks, "errors": [InputError(c.name, c.message, remedy=c.remedy) for c in failed]}


def _check_packages() -> Check:
    """Imports the packages that jsecon requires."""
    broken = {}
    for name in PACKAGES:
        try:
            importlib.import_module(name)
            if name == "cv2":
                importlib.import_module("jsecon.vision.classical").require_contrib()
        except Exception as error:  # a broken wheel raises anything
            broken[name] = f"{name} ({error})"
    if not broken:
        return Check("packages", "ok", f"all {len(PACKAGES)} required packages can be imported")
    return Check("packages", "missing", ", ".join(broken.values()), 'Run: pip install --force-reinstall "jsecon"')


def _check_jax() -> list[Check]:
    """Checks the devices of jax, and whether it computes right numbers on them."""
    try:
        import jax

        from jsecon.backend import REMEDY, check_backend

        kinds = [device.platform for device in jax.devices()]
        devices = ", ".join(f"{kinds.count(kind)} {kind}" for kind in sorted(set(kinds)))
    except Exception as error:  # whatever a driver or a wheel raises
        remedy = 'Run: pip install --force-reinstall "jax>=0.10.2,<0.13"'
        return [Check("jax", "wrong", str(error) or describe_error(error), remedy)]
    jax_check = Check("jax", "ok", f"{jax.__version__}, devices: {devices}")
    try:
        report = check_backend()
    except RuntimeError as error:
        return [jax_check, Check("backend", "wrong", str(error), REMEDY)]
    message = f"cosines are right to {report.cosine_error:.0e}"
    if report.has_jax_39103:
        message += "; this jax has issue 39103, which jsecon avoids but your code may meet"
    return [jax_check, Check("backend", "ok", message)]


def _check_cores() -> Check:
    """Counts the cores that may be used, and the time limit of the cgroup."""
    quota = read_cgroup("cpu.max", "cpu/cpu.cfs_quota_us")
    period = (quota[1:] or read_cgroup("", "cpu/cpu.cfs_period_us") or ["100000"])[0]
    message = f"{cores()} of {os.cpu_count()} may be used"
    if quota and quota[0].isdecimal() and int(quota[0]) < cores() * int(period):
        message += f", limited to the time of {int(quota[0]) / int(period):.3g} (cgroup)"
    return Check("cores", "ok", message)


def _check_memory() -> Check:
    """Measures the free memory."""
    free, limit = available_memory()
    if free is None:
        return Check("memory", "ok", "this system does not report the free memory")
    message = f"{_size(free)} free" + ("" if limit is None else f", limit {_size(limit)} (cgroup)")
    if free < MIN_MEMORY:
        message += f"; jsecon demo takes {_size(MIN_MEMORY)}"
    return Check("memory", "ok" if free >= MIN_MEMORY else "wrong", message, "End other programs, or raise the limit.")


def _check_disk() -> Check:
    """Measures the free space of the current folder."""
    free = shutil.disk_usage(".").free
    writable = os.access(".", os.W_OK)
    message = f"{_size(free)} free in {Path.cwd()}{'' if writable else ', which cannot be written: use --out'}"
    return Check("disk", "ok" if writable and free >= MIN_DISK else "wrong", message)


def _check_programs() -> Check:
    """Examines the folder of compiled programs."""
    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    if folder is None:
        return Check("programs", "missing", "no folder can be written, so that every run compiles anew (set HOME)")
    files = [file for file in Path(folder).rglob("*") if file.is_file()]
    message = f"{len(files)} compiled, {_size(sum(f.stat().st_size for f in files))} in {folder}"
    existing = next(parent for parent in (Path(folder), *Path(folder).parents) if parent.is_dir())
    free = shutil.disk_usage(existing).free
    if free < MIN_CACHE_DISK:
        return Check("programs", "missing", f"{message}, {_size(free)} free: every run compiles further ones")
    return Check("programs", "ok", message)


def _check_models(folder: Path | None) -> list[Check]:
    """Examines a folder of models and the folders in it."""
    if folder is None:
        return [Check("models", "missing", "no folder to examine (--models DIR); without CLIP, texts name colours")]
    from jsecon.pipeline.model_loading import inspect_models

    reports = [inspect_models(place) for place in (folder, *sorted(p for p in folder.glob("*") if p.is_dir()))]
    usable = {kind: summary for report in reversed(reports) for kind, summary in report.usable.items()}
    missing = f"no usable model in {folder}; jsecon models check says what is missing"
    kinds = ("CLIP", "SAM", "SAM 2")
    return [Check(kind, "ok", usable[kind]) if kind in usable else Check(kind, "missing", missing) for kind in kinds]


def _check_extra(name: str) -> Check:
    """Checks whether the modules of an extra are installed."""
    modules, purpose = EXTRAS[name]
    absent = [module for module in modules if importlib.util.find_spec(module) is None]
    if not absent:
        return Check(name, "ok", purpose)
    return Check(name, "missing", f'{purpose}: pip install "jsecon[{name}]" ({", ".join(absent)})')


def _size(count: int) -> str:
    """Returns a number of bytes in GiB or MiB."""
    return f"{count / 2**30:.1f} GiB" if count >= 1 << 30 else f"{count / 2**20:.0f} MiB"


VERBS = {verbs.Doctor: _doctor}
"""what does the work of each verb"""
