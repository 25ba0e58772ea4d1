"""Table 5: the ways to ask one and the same field.

    python -m experiments.ablation_query [--quick] [--root FOLDER] [--out FOLDER]

On LERF-OVS or its twins, under the protocol of `experiments.lerf`.
"""

import dataclasses

from experiments import lerf, tables
from experiments.command import options_of
from experiments.methods import QUERIES
from experiments.results import HOME

PLAN = dataclasses.replace(lerf.PLAN, methods=tuple(QUERIES), out=str(HOME / "results" / "ablation_query"))
QUICK = dataclasses.replace(lerf.QUICK, methods=tuple(QUERIES), out=str(HOME / "results" / "quick" / "ablation_query"))


def main(plan: tables.Plan) -> str:
    """The table, written."""
    return tables.make(plan, QUERIES, lerf.FIGURES, notes=lerf.NOTES)


if __name__ == "__main__":
    main(options_of(PLAN, QUICK))
