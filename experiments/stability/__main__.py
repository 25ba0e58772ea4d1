"""Stiff and extreme scenes: is every number finite, and how far from float64?

    python -m experiments.stability

Each row of `cases` is rendered in float32 and compared with float64, as `measure` describes.

"one ulp" is the yardstick: how far the float64 image and gradient move when every input moves by one float32 rounding.
No float32 engine can promise to be closer than that.
"""

import dataclasses
import time
from pathlib import Path

from experiments import results
from experiments.stability.case import GRADIENT
from experiments.stability.cases import cases
from experiments.stability.measure import Row, evaluate


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    only: str = ""
    """rows whose name contains this"""
    out: str = str(results.HOME / "results" / "stability")


def main(options: Options) -> dict[str, Row]:
    """Measures every row and writes the table."""
    start, rows = time.process_time(), {}
    header = ("scene", "finite", "error", "one ulp", "cuts in doubt", "gradient error: worst", "one ulp", "wider bound")
    lines = []
    for case in cases():
        if options.only not in case.name:
            continue
        row = rows[case.name] = evaluate(case)
        worst = max(row.gradient_errors, key=row.gradient_errors.__getitem__)
        lines.append(
            (
                case.name,
                ", ".join(
                    f"{what} {'yes' if good else 'NO'}"
                    for what, good in (("value", row.value_finite and row.contained), ("gradient", row.gradient_finite))
                ),
                f"{row.value_error:.1e}",
                f"{row.value_ulp:.1e}",
                f"{100 * row.in_doubt:.1f} %",
                f"{row.gradient_errors[worst]:.1e} {worst}",
                f"{row.gradient_ulps[worst]:.1e}",
                ", ".join(f"{k} {v:.0e}" for k, v in case.bounds.items()) + (f": {case.why}" if case.why else ""),
            )
        )
        print("|".join(lines[-1]), {k: f"{v:.0e}" for k, v in row.gradient_errors.items() if v > GRADIENT}, flush=True)
    seconds = time.process_time() - start
    metrics = {"cpu_s": round(seconds, 1), "rows": {k: dataclasses.asdict(r) for k, r in rows.items()}}
    results.save(Path(options.out), options, metrics, results.table(header, lines))
    return rows


if __name__ == "__main__":
    main(Options())
