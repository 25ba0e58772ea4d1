"""Counts the programs that XLA compiles for a command of jsecon, and the seconds that it takes for them.

    python benchmarks/programs.py [--most N] VERB ARGUMENT ...      (exits 1 above N: `--most 45 demo --out DIR`)
    python benchmarks/programs.py --table FOLDER                    demo, run, query and view, nothing compiled before

A program that is read from disk counts, too. Programs compile side by side on all cores, so their seconds can add up to
more than those of the command.
"""

import argparse
import os
import re
import subprocess
import sys
import time
from pathlib import Path

from jsecon.__main__ import main as jsecon
from jsecon.process import prepare_process

TEXT = "orange ball"
"""a query of the demo's room"""
LINE = "{count} programs, {seconds:.1f} s of compilation, {total:.1f} s in all"


def count(arguments: list[str], most: int | None) -> int:
    """Runs a command of jsecon in this process, and prints its programs."""
    prepare_process()
    import jax

    compiled: list[float] = []

    def add(event: str, seconds: float, **_: object) -> None:
        if event.endswith("backend_compile_duration"):
            compiled.append(seconds)

    jax.monitoring.register_event_duration_secs_listener(add)
    sys.argv = ["jsecon", *arguments]
    start = time.perf_counter()
    code = jsecon()
    print(LINE.format(count=len(compiled), seconds=sum(compiled), total=time.perf_counter() - start))
    if most is not None and len(compiled) > most:
        print(f"more than the {most} programs that are allowed", file=sys.stderr)
        return 1
    return code


def table(folder: Path) -> None:
    """Prints a row for each command, each in a process of its own that has no program on disk."""
    demo, splat = folder / "demo", folder / "scene.ply"
    field = demo / "field.safetensors"
    commands = {
        "demo": ["demo", "--out", demo],
        "query of its field": ["query", field, TEXT, "--out", folder / "answers"],
        "view of its field, exported": ["view", field, TEXT, "--export", folder / "view"],
        "export of its scene": ["export", field, "--out", splat],
        "query of the splat alone": ["query", splat, TEXT, "--out", folder / "splat"],
        "run on the demo's frames, with a fit": ["run", demo / "capture", "--out", folder / "run"],
        "run with given Gaussians": ["run", demo / "capture", "--gaussians", splat, "--out", folder / "given"],
    }
    print("| command | programs | s of compilation | s |\n|---|---|---|---|")
    for number, (name, command) in enumerate(commands.items()):
        environ = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(folder / f"programs{number}")}
        words = [sys.executable, __file__, *map(str, command)]
        printed = subprocess.run(words, env=environ, check=True, stdout=subprocess.PIPE, text=True).stdout
        count, seconds, total = re.findall(r"[\d.]+", printed.splitlines()[-1])
        print(f"| {name} | {count} | {seconds} | {total} |", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--most", type=int, help="exit 1 where more programs are compiled")
    parser.add_argument("--table", type=Path, metavar="FOLDER", help="measure all commands in FOLDER")
    parser.add_argument("command", nargs=argparse.REMAINDER)
    arguments = parser.parse_args()
    if arguments.table is None:
        return count(arguments.command, arguments.most)
    table(arguments.table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
