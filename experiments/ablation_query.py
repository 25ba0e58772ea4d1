"""Table 5: the ways to ask one and the same field.

    python -m experiments.ablation_query [--quick] [--root FOLDER] [--out FOLDER] [--processes N]

On LERF-OVS or its twins, under the protocol of `experiments.lerf`, whose cells are taken where a row is the same.
"""

from experiments import lerf
from experiments.tables import layout, published
from experiments.tables.answers import Method
from experiments.tables.fill import Plan, options_of
from experiments.tables.methods import METHODS
from experiments.tables.ours import BY_COSINE, asked

QUERIES: dict[str, Method] = {
    "one-step": asked("one_step"),
    "canonical": asked("canonical"),
    "anchored by code": asked("code", **BY_COSINE),
    "anchored by code, the region apart from words": asked("code"),
    "anchored by votes of all views": asked("all_views", **BY_COSINE),
    "anchored by votes": asked("votes", **BY_COSINE),
    "the region apart from words": asked("votes"),
    "ours, tracks": METHODS["ours, tracks"],
}
"""the rows of Table 5, of one field of the tracks with spread codes; the last by votes, the region apart from words,
then with its pieces"""
PLAN = lerf.beside(lerf.PLAN, "ablation_query", QUERIES)
QUICK = lerf.beside(lerf.QUICK, "ablation_query", QUERIES)


def main(plan: Plan) -> str:
    """The table, written."""
    beside = published.table("seconGS's queries", published.QUERIES, ("figurines",))
    return layout.make(plan, QUERIES, lerf.FIGURES, notes=lerf.NOTES, published=beside)


if __name__ == "__main__":
    main(options_of(PLAN, QUICK))
