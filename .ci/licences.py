"""The licences of what jsecon needs and of what its extras bring, as the installed packages tell them: LICENSES.md.

pip install '.[all,dev,docs]' && python .ci/licences.py > LICENSES.md
"""

import re
import sys
from collections.abc import Iterable, Iterator
from importlib import metadata
from pathlib import Path

EXTRAS = ("figures", "formats", "mcp", "serve", "sfm", "words", "dev", "docs")
SHARE_ALIKE = re.compile(r"\b(A?GPL|LGPL|MPL|EPL|CDDL|EUPL)\b|(?:GNU (?:LESSER |AFFERO )?GENERAL|Mozilla) Public", re.I)
"""licences that ask something of whoever passes the package on, changed or linked"""
_DATED = ",? Version [0-9.]+,? [0-9]+ [A-Z][a-z]+ [0-9]{4}"
TEXTS = {
    "GPL": "GNU GENERAL PUBLIC LICENSE" + _DATED,
    "LGPL": "GNU LESSER GENERAL PUBLIC LICENSE" + _DATED,
    "AGPL": "GNU AFFERO GENERAL PUBLIC LICENSE" + _DATED,
    "MPL": r"Mozilla Public License,? Version [0-9.]+\W+1\. Definitions",
}
"""how the whole text of a licence begins"""
LIBRARIES = {
    "libx265": "GPL-2.0",
    "libheif": "LGPL-3.0",
    "libde265": "LGPL-3.0",
    "libavcodec": "LGPL-2.1",
    "libgfortran": "GPL-3.0 with GCC's exception",
    "libgomp": "GPL-3.0 with GCC's exception",
    "libgcc_s": "GPL-3.0 with GCC's exception",
}
"""shared libraries that wheels bring along, by the beginning of a file's name"""
LINKED = {b"SuiteSparse": "SuiteSparse: LGPL-2.1, parts GPL-2.0", b"CGAL": "CGAL: LGPL-3.0, parts GPL-3.0"}
"""what stands in a module that has such a library linked in"""
HEAD = """# Licences

jsecon itself is under Apache-2.0 (LICENSE). What it needs, and what each extra brings, directly or by way of another
package, as the packages installed on {system} tell; written by `python .ci/licences.py`. "Within": copyleft
libraries that its wheel brings along or has linked in, and copyleft licences whose text lies in it.
"""

EXPORT = """\
The extra `export` is not installed for this table. By their own word torch and torchvision are under BSD-3-Clause
(on Linux they bring NVIDIA's proprietary libraries), open_clip_torch under MIT, transformers and onnx under
Apache-2.0. Nothing of it is needed to run jsecon."""


def _plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _needs(name: str, extras: Iterable[str]) -> Iterator[tuple[str, list[str]]]:
    """(package, its extras) that an installed package needs here, with those of its own extras."""
    from packaging.requirements import Requirement

    for line in metadata.requires(name) or ():
        need = Requirement(line)
        if need.marker is None or any(need.marker.evaluate({"extra": extra}) for extra in ("", *extras)):
            yield _plain(need.name), sorted(need.extras)


def brought(extra: str | None) -> set[str]:
    """The installed packages that jsecon needs, or an extra of it brings, one by way of the other."""
    found, wanted = set(), [("jsecon", [extra] if extra else [])]
    while wanted:
        name, extras = wanted.pop()
        for other, more in _needs(name, extras):
            try:
                metadata.distribution(other)
            except metadata.PackageNotFoundError:
                raise SystemExit(f"{other} is not installed: pip install '.[all,dev,docs]'") from None
            if other not in found:
                found.add(other)
                wanted.append((other, more))
    return found


def licence_of(name: str) -> str:
    """In a few words, as the package tells it."""
    told = metadata.metadata(name)
    named = [line.rpartition(" :: ")[2] for line in told.get_all("Classifier", []) if line.startswith("License ::")]
    text = told.get("License-Expression") or ""
    short = (told.get("License") or "").strip()
    if not text and short not in ("", "UNKNOWN") and len(short) < 60:
        text = short
    return text or ", ".join(named) or (short.splitlines() or ["not told"])[0]


def within(name: str) -> list[str]:
    """The copyleft libraries among and in a package's files, and the licences whose whole text lies there."""
    found = set()
    for file in metadata.files(name) or ():
        path = Path(str(file.locate()))
        found |= {f"{library} ({licence})" for library, licence in LIBRARIES.items() if path.name.startswith(library)}
        if not path.is_file():
            continue
        if path.suffix == ".so":
            data = path.read_bytes()
            found |= {licence for mark, licence in LINKED.items() if mark in data}
        elif re.search(r"licen[cs]e|copying|notice", str(file), re.I) and path.suffix not in (".py", ".pyc"):
            text = " ".join(path.read_text(encoding="utf-8", errors="replace").split())
            found |= {f"text of the {short}" for short, title in TEXTS.items() if re.search(title, text, re.I)}
    return sorted(found)


def table() -> Iterator[str]:
    """The lines of LICENSES.md."""
    yield HEAD.format(system=f"{sys.platform}, Python {sys.version_info.major}.{sys.version_info.minor}")
    own = brought(None)
    by = {name: ["jsecon"] for name in own}
    for extra in EXTRAS:
        for name in brought(extra) - own - {"jsecon"}:
            by.setdefault(name, []).append(extra)
    rows = {name: (licence_of(name), within(name)) for name in by}
    yield from ("| package | version | licence | within | for |", "|---|---|---|---|---|")
    for name, (licence, inside) in sorted(rows.items()):
        yield f"| {name} | {metadata.version(name)} | {licence} | {', '.join(inside)} | {', '.join(by[name])} |"
    yield ""
    asks = [f"{name} ({licence})" for name, (licence, _) in sorted(rows.items()) if SHARE_ALIKE.search(licence)]
    yield f"Copyleft itself: {', '.join(asks) or 'none'}."
    yield ""
    yield EXPORT


if __name__ == "__main__":
    print(*table(), sep="\n")
