"""Table 4: what each component brings, one added or exchanged at a time.

    python -m experiments.ablation_components [--quick] [--root FOLDER] [--out FOLDER]

On LERF-OVS or its twins, under the protocol of `experiments.lerf`.
"""

import dataclasses

from experiments import lerf, tables
from experiments.command import options_of
from experiments.methods import COMPONENTS
from experiments.results import HOME

PLAN = dataclasses.replace(lerf.PLAN, methods=tuple(COMPONENTS), out=str(HOME / "results" / "ablation_components"))
QUICK = dataclasses.replace(
    lerf.QUICK, methods=tuple(COMPONENTS), out=str(HOME / "results" / "quick" / "ablation_components")
)


def main(plan: tables.Plan) -> str:
    """The table, written."""
    return tables.make(plan, COMPONENTS, lerf.FIGURES, notes=lerf.NOTES)


if __name__ == "__main__":
    main(options_of(PLAN, QUICK))
