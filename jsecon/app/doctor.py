"""`jsecon doctor`: checks what every run needs of this machine, or describes the ledger of a field."""

import collections
import importlib
import importlib.metadata
import platform
import re
from pathlib import Path

from jsecon.app import verbs
from jsecon.errors import InputError, describe_error
from jsecon.pipeline.progress import Console

REINSTALL = 'Run: pip install --force-reinstall "jsecon"'
"""remedy of a broken package"""


def _doctor(verb: verbs.Doctor, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon doctor`; the result has what each check measured, and the errors of those that fail."""
    if verb.field is not None:
        return _describe_ledger(verb.field, console)
    checks = {"python": f"{platform.python_version()}, {platform.platform(terse=True)}"}
    errors = []
    with console.progress("checks"):
        for name, check in {"packages": _check_packages, "jax": _check_jax}.items():
            try:
                checks[name] = check()
            except InputError as error:
                errors.append(error)
    console.print_line("\n".join(f"{name:<10} {message}" for name, message in checks.items()))
    return {"checks": checks, "errors": errors}


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


def _check_packages() -> str:
    """Imports the packages that jsecon requires."""
    needs = [need for need in importlib.metadata.requires("jsecon") or [] if "extra" not in need]
    names = [re.split(r"[<>=!~; \[]", need)[0].replace("-", "_") for need in needs]  # without the version
    modules = {"opencv_contrib_python_headless": "cv2", "pillow": "PIL", "scikit_learn": "sklearn"}
    broken = []
    for name in names:
        try:
            importlib.import_module(modules.get(name, name))
            if name.startswith("opencv"):
                importlib.import_module("jsecon.vision.classical").require_contrib()
        except Exception as error:  # a broken wheel raises anything
            broken.append(f"{name} ({error})")
    if broken:
        raise InputError("packages", ", ".join(broken), remedy=REINSTALL)
    return f"all {len(names)} required packages can be imported"


def _check_jax() -> str:
    """Checks the devices of jax, and whether it computes right numbers on them."""
    try:
        import jax

        from jsecon.backend import REMEDY, check_backend, start_backend

        start_backend()
        kinds = collections.Counter(device.platform for device in jax.devices())
    except InputError:
        raise
    except Exception as error:  # whatever a driver or a wheel raises
        raise InputError("jax", str(error) or describe_error(error), remedy=REINSTALL) from error
    devices = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
    try:
        return f"{jax.__version__}, devices: {devices}, cosines are right to {check_backend():.0e}"
    except RuntimeError as error:
        raise InputError("jax", str(error), remedy=REMEDY) from error
