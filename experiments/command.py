"""The command lines that experiments share: of the tables (--quick, --root, --out, --processes), of those on rooms."""

import argparse
import dataclasses
from typing import Any

from experiments.methods import Steps
from jsecon.process import cores

QUICK_STEPS = Steps(
    langsplat=60,
    epochs=40,
    grouping=50,
    grouping_rates=(0.05, 0.02),
    instance=50,
    coarse=5,
    fine=5,
    roots=8,
    leaves=3,
    opengaussian_rate=0.05,
    paper=60,
)
"""for a look at every row in two minutes: too short for the trained methods to be judged by"""


def options_of(plan: Any, quick: Any) -> Any:
    """The plan that the command line asks for."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="one tiny scene, a few steps: at most two minutes")
    parser.add_argument("--root", default="", help="the real dataset; without it twins are made")
    parser.add_argument("--out", default="", help="where the results go")
    parser.add_argument("--processes", type=int, default=cores(), help="that share the settings; default: one a core")
    given = parser.parse_args()
    chosen = dataclasses.replace(quick if given.quick else plan, processes=given.processes)
    if given.root:
        data = dataclasses.replace(chosen.data, root=given.root, seeds=chosen.data.seeds[:1])
        chosen = dataclasses.replace(chosen, data=data)
    return dataclasses.replace(chosen, out=given.out, cells="") if given.out else chosen


def rooms_of(options: Any, quick: Any = None) -> Any:
    """The options of an experiment on demo rooms that the command line asks for: [--quick] [FOLDER_OF_DEMOS]."""
    parser = argparse.ArgumentParser()
    parser.add_argument("demos", nargs="?", help="where demo0 .. demo4 lie, or shall be made")
    if quick is not None:
        parser.add_argument("--quick", action="store_true", help="one scene, a few steps: at most two minutes")
    given = parser.parse_args()
    chosen = quick if quick is not None and given.quick else options
    return dataclasses.replace(chosen, demos=given.demos) if given.demos else chosen
