"""`jsecon doctor`: checks what runs need of this machine, or describes the ledger of a field."""

import collections
import dataclasses
import importlib
import importlib.metadata
import platform
import re
from pathlib import Path
from typing import Literal

from jsecon.app import verbs
from jsecon.errors import InputError, describe_error
from jsecon.pipeline.progress import Console

REINSTALL = 'Run: pip install --force-reinstall "jsecon"'
"""remedy of a broken package"""


@dataclasses.dataclass(frozen=True)
class _Check:
    """Result of one check."""

    name: str
    status: Literal["ok", "missing", "wrong"]
    message: str
    """What the check measured."""
    remedy: str = ""
    """What to do about it, if every run depends on it."""


def _doctor(verb: verbs.Doctor, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon doctor`; a check that fails and that every run depends on is an error."""
    if verb.field is not None:
        return _describe_ledger(verb.field, console)
    with console.progress("checks"):
        checks = [_Check("python", "ok", f"{platform.python_version()}, {platform.platform(terse=True)}")]
        checks += [_check_packages(), *_check_jax(), *_check_extras()]
    console.print_line("\n".join(f"{check.status:<8} {check.name:<10} {check.message}" for check in checks))
    failed = [check for check in checks if check.remedy and check.status != "ok"]
    return {"checks": checks, "errors": [InputError(c.name, c.message, remedy=c.remedy) for c in failed]}


def _describe_ledger(field: Path, console: Console) -> verbs.VerbResult:
    """Prints what the ledger of a field holds, and how large each kind is."""
    from jsecon.app.opening import locate_field  # late: what these import may be what is broken
    from jsecon.field.field import load_field
    from jsecon.field.ledger_file import load_ledger

    path = locate_field(field).file
    ledger = load_ledger(path, load_field(path, mapped=True))
    views = list(ledger.views.values())
    sizes = {name: sum(getattr(view, name).nbytes for view in views) for name in views[0]._fields} if views else {}
    console.print_line(f"ledger of {path}: {len(views)} views, {ledger.num_regions} regions")
    for name, size in sizes.items():
        console.print_line(f"{size / 2**20:9.2f} MiB  {name.replace('_', ' ')}")
    return {"views": list(ledger.views), "regions": ledger.num_regions, "bytes": sizes}


def _check_packages() -> _Check:
    """Imports the packages that jsecon requires."""
    needs = [need for need in importlib.metadata.requires("jsecon") or [] if "extra" not in need]
    names = [_package(need).replace("-", "_") for need in needs]
    modules = {"opencv_contrib_python_headless": "cv2", "pillow": "PIL", "scikit_learn": "sklearn"}
    broken = []
    for name in names:
        try:
            importlib.import_module(modules.get(name, name))
            if name.startswith("opencv"):
                importlib.import_module("jsecon.vision.classical").require_contrib()
        except Exception as error:  # a broken wheel raises anything
            broken.append(f"{name} ({error})")
    if not broken:
        return _Check("packages", "ok", f"all {len(names)} required packages can be imported")
    return _Check("packages", "missing", ", ".join(broken), REINSTALL)


def _check_jax() -> list[_Check]:
    """Checks the devices of jax, and whether it computes right numbers on them."""
    try:
        import jax

        from jsecon.backend import REMEDY, check_backend, start_backend

        start_backend()
        kinds = collections.Counter(device.platform for device in jax.devices())
    except InputError as error:
        return [_Check("jax", "wrong", f"{error.where}: {error.sentence}", error.remedy)]
    except Exception as error:  # whatever a driver or a wheel raises
        return [_Check("jax", "wrong", str(error) or describe_error(error), REINSTALL)]
    devices = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
    jax_check = _Check("jax", "ok", f"{jax.__version__}, devices: {devices}")
    try:
        report = check_backend()
    except RuntimeError as error:
        return [jax_check, _Check("backend", "wrong", str(error), REMEDY)]
    return [jax_check, _Check("backend", "ok", f"cosines are right to {report.cosine_error:.0e}")]


def _check_extras() -> list[_Check]:
    """Checks whether the packages of each extra are installed."""
    absent: dict[str, list[str]] = {}
    for need in importlib.metadata.requires("jsecon") or []:
        name, _, extra = need.partition("extra == ")
        package = _package(name)
        if (extra := extra.strip("\"'")) not in ("", "dev", "all"):
            found = any(True for _ in importlib.metadata.distributions(name=package))
            absent.setdefault(extra, []).extend([] if found else [package])
    words = {name: f'pip install "jsecon[{name}]" ({", ".join(packages)})' for name, packages in absent.items()}
    return [_Check(n, "missing" if absent[n] else "ok", words[n] if absent[n] else "installed") for n in absent]


def _package(need: str) -> str:
    """Returns the name in a requirement such as "numpy>=2"."""
    return re.split(r"[<>=!~; \[]", need)[0]
