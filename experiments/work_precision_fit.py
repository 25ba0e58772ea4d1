"""Held-out error of a photometric fit against its minutes: one curve for each knob, and what each part adds.

    python -m experiments.work_precision_fit [--capture FOLDER] [--long-side PX] [--minutes M ...] [--only NAME ...]

Every row is a fit of its own to the frames that are not held out, of so many minutes (compilation apart), on all cores;
PSNR and SSIM are means over the held-out frames. Rows that are in the output folder already are not run again.
"""

import argparse
import dataclasses
import functools
import json
from pathlib import Path
from typing import Any

import jax

from experiments import results
from jsecon.data.capture import load_capture
from jsecon.fit.optimise import fit_gaussians
from jsecon.fit.quality import measure_quality
from jsecon.fit.schedule import LearningRates, Schedule
from jsecon.fit.start import Start, starting_gaussians
from jsecon.process import clear_programs, cores


@dataclasses.dataclass(frozen=True)
class Knobs:
    """One way to fit."""

    schedule: Schedule = dataclasses.field(default_factory=Schedule)
    rates: LearningRates = dataclasses.field(default_factory=LearningRates)
    sh_degree: int = 2
    start: Start = "auto"
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class Asked:
    """What the last call was about; the cells say the rest."""

    capture: str
    long_side: int


def _with(**changes: Any) -> Knobs:
    """The default with some fields of its schedule, its rates or its own changed."""
    knobs = Knobs()
    for name, value in changes.items():
        for part in ("schedule", "rates"):
            if hasattr(getattr(knobs, part), name):
                knobs = dataclasses.replace(knobs, **{part: dataclasses.replace(getattr(knobs, part), **{name: value})})
                break
        else:
            knobs = dataclasses.replace(knobs, **{name: value})
    return knobs


WAYS: dict[str, Knobs] = {
    "as it is": _with(),
    "no growth": _with(growth="none"),
    "MCMC": _with(growth="mcmc"),
    "full size only": _with(sizes=((1.0, 1.0),)),
    "three sizes": _with(sizes=((0.25, 0.2), (0.5, 0.5), (1.0, 1.0))),
    "50,000 Gaussians": _with(max_gaussians=50_000),
    "200,000 Gaussians": _with(max_gaussians=200_000),
    "dense start": _with(start="dense"),
    "dense start, no growth": _with(start="dense", growth="none"),
    "random start": _with(start="random"),
    "SH degree 0": _with(sh_degree=0),
    "SH degree 1": _with(sh_degree=1),
    "SH degree 3": _with(sh_degree=3),
    "positions' rate halved": _with(means=2.5e-4, means_last=2.5e-6),
    "positions' rate doubled": _with(means=1e-3, means_last=1e-5),
}


def fit(capture, knobs: Knobs, minutes: float) -> dict:
    """The figures of one fit."""
    start, _ = starting_gaussians(capture, sh_degree=knobs.sh_degree, start=knobs.start)
    states = []
    gaussians, losses = fit_gaussians(
        capture,
        key=jax.random.key(knobs.seed),
        seconds=60 * minutes,
        start=start,
        schedule=knobs.schedule,
        rates=knobs.rates,
        on_checkpoint=lambda state: states.append((float(state.seconds), float(state.done))),
    )
    found = measure_quality(gaussians, capture)
    return {
        "psnr": float(found.psnr.mean()),
        "ssim": float(found.ssim.mean()),
        "gaussians": gaussians.count,
        "start": start.count,
        "steps": len(losses),
        "seconds": states[-1][0],
    }


def layout(cells: list[dict]) -> str:
    """A table for each capture and size: the ways in rows, PSNR and SSIM for each number of minutes."""
    parts = []
    for capture, size in dict.fromkeys((cell["capture"], cell["long_side"]) for cell in cells):
        own = [cell for cell in cells if (cell["capture"], cell["long_side"]) == (capture, size)]
        minutes = sorted({cell["minutes"] for cell in own})
        rows = []
        for way in dict.fromkeys(cell["way"] for cell in own):
            at = {cell["minutes"]: cell for cell in own if cell["way"] == way}
            told = (f"{at[m]['psnr']:.2f} dB, {at[m]['ssim']:.3f}" if m in at else "" for m in minutes)
            rows.append((way, *told, max(cell["gaussians"] for cell in at.values())))
        header = (f"{capture}, long side {size} px", *(f"{m:g} min" for m in minutes), "Gaussians")
        parts.append(results.table(header, rows))
    return "\n\n".join(parts)


def curves(cells: list[dict]):
    """PSNR against minutes, a line for each way, a panel for each capture."""
    from matplotlib.figure import Figure

    captures = list(dict.fromkeys(cell["capture"] for cell in cells))
    figure = Figure(figsize=(5.2 * len(captures), 3.6))
    for n, capture in enumerate(captures):
        axes = figure.add_subplot(1, len(captures), n + 1, title=capture, xlabel="minutes", ylabel="held-out PSNR, dB")
        axes.set_xscale("log")
        for way in dict.fromkeys(cell["way"] for cell in cells if cell["capture"] == capture):
            found = sorted((c["minutes"], c["psnr"]) for c in cells if (c["capture"], c["way"]) == (capture, way))
            axes.plot(*zip(*found, strict=True), marker="o", markersize=3, label=way)
        axes.legend(fontsize=6)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--capture", default="../shared/captures/bonsai")
    parser.add_argument("--long-side", type=int, default=400)
    parser.add_argument("--minutes", type=float, nargs="+", default=[2, 5, 15])
    parser.add_argument("--only", nargs="+", default=list(WAYS), help=", ".join(WAYS))
    parser.add_argument("--out", default=str(results.HOME / "results" / "work_precision_fit"))
    asked = parser.parse_args()
    place = Path(asked.out) / "cells.jsonl"
    place.parent.mkdir(parents=True, exist_ok=True)
    cells = [json.loads(line) for line in place.read_text().splitlines()] if place.exists() else []
    load = functools.cache(lambda: load_capture(asked.capture, long_side=asked.long_side))
    for way in asked.only:
        for minutes in asked.minutes:
            key = {"capture": Path(asked.capture).name, "long_side": asked.long_side, "way": way, "minutes": minutes}
            cell = next((cell for cell in cells if key.items() <= cell.items()), None)
            if cell is None:
                cell = key | {"cores": cores()} | fit(load(), WAYS[way], minutes)
                clear_programs()
                with place.open("a") as file:
                    file.write(json.dumps(cell) + "\n")
                cells.append(cell)
            print(json.dumps(cell), flush=True)
    results.save(place.parent, Asked(asked.capture, asked.long_side), {"cells": cells}, layout(cells), curves(cells))


if __name__ == "__main__":
    from jsecon.process import prepare_process

    prepare_process()
    main()
