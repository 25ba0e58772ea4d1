"""Table 4: what each component brings, one added or exchanged at a time.

    python -m experiments.ablation_components [--quick] [--root FOLDER] [--out FOLDER] [--processes N]

On LERF-OVS or its twins, under the protocol of `experiments.lerf`, whose cells are taken where a row is the same.
"""

from experiments import lerf, tables
from experiments.command import options_of
from experiments.methods import COMPONENTS

PLAN = lerf.beside(lerf.PLAN, "ablation_components", COMPONENTS)
QUICK = lerf.beside(lerf.QUICK, "ablation_components", COMPONENTS)


def main(plan: tables.Plan) -> str:
    """The table, written."""
    return tables.make(plan, COMPONENTS, lerf.FIGURES, notes=lerf.NOTES)


if __name__ == "__main__":
    main(options_of(PLAN, QUICK))
