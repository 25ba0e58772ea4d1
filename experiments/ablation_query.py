"""Table 5: the ways to ask one and the same field.

    python -m experiments.ablation_query [--quick] [--root FOLDER] [--out FOLDER] [--processes N]

On LERF-OVS or its twins, under the protocol of `experiments.lerf`, whose cells are taken where a row is the same.
"""

from experiments import lerf, tables
from experiments.command import options_of
from experiments.methods import QUERIES

PLAN = lerf.beside(lerf.PLAN, "ablation_query", QUERIES)
QUICK = lerf.beside(lerf.QUICK, "ablation_query", QUERIES)


def main(plan: tables.Plan) -> str:
    """The table, written."""
    return tables.make(plan, QUERIES, lerf.FIGURES, notes=lerf.NOTES)


if __name__ == "__main__":
    main(options_of(PLAN, QUICK))
