"""`jsecon doctor`: what of this machine a run needs, and whether it is there."""

import dataclasses
import importlib
import importlib.util
import os
import platform
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from jsecon.errors import InputError, describe_error
from jsecon.process import available_memory, cores, read_cgroup

LEAST_MEMORY, LEAST_DISK = 2 << 30, 200 << 20
"""bytes that `jsecon demo` takes, rounded up"""
LEAST_FOR_PROGRAMS = 32 << 20
"""bytes of its compiled programs, rounded up"""
PACKAGES = (
    "numpy",
    "filelock",
    "psutil",
    "scipy",
    "sklearn",
    "cv2",
    "PIL",
    "jaxtyping",
    "optax",
    "flax",
    "onnxruntime",
    "tokenizers",
    "safetensors",
    "ftfy",
    "tqdm",
    "tyro",
    "shtab",
    "lazy_loader",
)
EXTRAS = {
    "sfm": (("pycolmap",), "poses of photographs and videos"),
    "formats": (("gsply", "pillow_heif"), ".sog, .spz of version 4, HEIC photographs"),
    "serve": (("fastapi", "uvicorn"), "jsecon serve"),
    "viewer": (("viser",), "jsecon view"),
    "figures": (("matplotlib",), "jsecon.show, figures of the experiments"),
    "words": (("ai_edge_litert",), "the experiment on real words"),
    "export": (("torch", "open_clip", "segment_anything", "sam2", "onnx"), "SAM, SAM 2 and CLIP from checkpoints"),
}
"""extra -> the modules that it installs, what it gives"""


@dataclasses.dataclass(frozen=True)
class Check:
    """One line."""

    name: str
    status: Literal["ok", "missing", "wrong"]
    told: str
    remedy: str = ""
    """what mends it, where every run needs it."""


def run_checks(models: Path | None = None) -> list[Check]:
    """All lines; `models`: a folder to look for models in. Raises InputError where there is no such folder."""
    checks = [Check("python", "ok", f"{platform.python_version()}, {platform.platform(terse=True)}"), _packages()]
    checks += [*_backend(), _cores(), _memory(), _disk(), _programs(), *_models(models), *map(_extra, EXTRAS)]
    return [*checks, Check("browser", "ok", "none is needed: pages open in any, Chromium is for the tests")]


def wrong(checks: Iterable[Check]) -> list[InputError]:
    """What every run needs and is not there."""
    broken = [check for check in checks if check.remedy and check.status != "ok"]
    return [InputError(check.name, check.told, remedy=check.remedy) for check in broken]


def _packages() -> Check:
    broken = {}
    for name in PACKAGES:
        try:
            importlib.import_module(name)
            if name == "cv2":
                importlib.import_module("jsecon.vision.classical").require_contrib()
        except Exception as error:  # a broken wheel raises anything
            broken[name] = f"{name} ({error})"
    if not broken:
        return Check("packages", "ok", f"{len(PACKAGES)} that jsecon is built on can be imported")
    return Check("packages", "missing", ", ".join(broken.values()), 'Run: pip install --force-reinstall "jsecon"')


def _backend() -> list[Check]:
    """The devices of jax, and whether it computes right numbers."""
    try:
        import jax

        from jsecon.backend import REMEDY, check_backend

        kinds = [device.platform for device in jax.devices()]
        devices = ", ".join(f"{kinds.count(kind)} {kind}" for kind in sorted(set(kinds)))
    except Exception as error:  # whatever a driver or a wheel raises
        told = str(error) or describe_error(error)
        return [Check("jax", "wrong", told, 'Run: pip install --force-reinstall "jax>=0.10.2,<0.13"')]
    found = [Check("jax", "ok", f"{jax.__version__}, devices: {devices}")]
    try:
        report = check_backend()
    except RuntimeError as error:
        return [*found, Check("backend", "wrong", str(error), REMEDY)]
    told = f"cosines right to {report.cosine_error:.0e}"
    if report.has_jax_39103:
        told += "; jax issue 39103 is present, in a form that jsecon avoids and your own code may not"
    return [*found, Check("backend", "ok", told)]


def _cores() -> Check:
    quota = read_cgroup("cpu.max", "cpu/cpu.cfs_quota_us")
    period = (quota[1:] or read_cgroup("", "cpu/cpu.cfs_period_us") or ["100000"])[0]
    told = f"{cores()} of {os.cpu_count()} may be used"
    if quota and quota[0].isdecimal() and int(quota[0]) < cores() * int(period):
        told += f", but the time of only {int(quota[0]) / int(period):.3g} (cgroup)"
    return Check("cores", "ok", told)


def _memory() -> Check:
    free, limit = available_memory()
    if free is None:
        return Check("memory", "ok", "this system does not tell how much is free")
    told = f"{_size(free)} free" + ("" if limit is None else f", limit {_size(limit)} (cgroup)")
    enough = free >= LEAST_MEMORY
    told += "" if enough else f"; jsecon demo takes {_size(LEAST_MEMORY)}"
    return Check("memory", "ok" if enough else "wrong", told, "End other programs, or raise the limit.")


def _disk() -> Check:
    free, writable = shutil.disk_usage(".").free, os.access(".", os.W_OK)
    told = f"{_size(free)} free in {Path.cwd()}{'' if writable else ', which cannot be written: give --out'}"
    return Check("disk", "ok" if writable and free >= LEAST_DISK else "wrong", told)


def _programs() -> Check:
    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    if folder is None:
        return Check("programs", "missing", "no folder that can be written: every run compiles anew (set HOME)")
    files = [file for file in Path(folder).rglob("*") if file.is_file()]
    told = f"{len(files)} compiled, {_size(sum(f.stat().st_size for f in files))} in {folder}"
    made = next(place for place in (Path(folder), *Path(folder).parents) if place.is_dir())
    if (free := shutil.disk_usage(made).free) < LEAST_FOR_PROGRAMS:
        return Check("programs", "missing", f"{told}, {_size(free)} free: what more there is is compiled in every run")
    return Check("programs", "ok", told)


def _models(folder: Path | None) -> list[Check]:
    if folder is None:
        return [Check("models", "missing", "no folder given (--models DIR): without CLIP, texts name colours")]
    from jsecon.pipeline.models import inspect_models

    found = [inspect_models(place) for place in (folder, *sorted(p for p in folder.glob("*") if p.is_dir()))]
    usable = {use.model: use.summary for findings in reversed(found) for use in findings.uses if use.usable}
    missing = "none in {}: jsecon models check says what is missing"
    return [
        Check(use.model, "ok", usable[use.model])
        if use.model in usable
        else Check(use.model, "missing", missing.format(folder))
        for use in found[0].uses
    ]


def _extra(name: str) -> Check:
    modules, gives = EXTRAS[name]
    absent = [module for module in modules if importlib.util.find_spec(module) is None]
    told = f'{gives}: pip install "jsecon[{name}]" ({", ".join(absent)})' if absent else gives
    return Check(name, "missing" if absent else "ok", told)


def _size(count: int) -> str:
    return f"{count / 2**30:.1f} GiB" if count >= 1 << 30 else f"{count / 2**20:.0f} MiB"
