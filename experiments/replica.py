"""Table 3: Replica at the points: mIoU and mean recall over the classes that occur.

    python -m experiments.replica [--quick] [--root FOLDER] [--out FOLDER] [--processes N]

The Gaussians are the ground-truth points, one each, never densified; each gets the class that fits it best, or none,
which is a miss. Without --root: twins of the eight scenes, three seeds, and `classes` are the shapes of their objects
and the table. With it NICE-SLAM's rendering with the original semantics, and the ten classes are ours: the paper does
not name its own.
"""

from experiments.datasets.replica import REPLICA_SCENES
from experiments.results import HOME
from experiments.tables import layout, published, twins
from experiments.tables.fill import Plan, options_of, quick_plan
from experiments.tables.methods import METHODS, RECOMMENDED

PLAN = Plan(
    twins.Data("replica", scenes=REPLICA_SCENES, size=(("views", 30), ("width", 240), ("height", 136))),
    tuple(METHODS),
    out=str(HOME / "results" / "replica"),
)
QUICK = quick_plan(PLAN, "room0", views=8, width=80, height=48, num_objects=4, fine_m=0.02, coarse_m=0.12)
FIGURES = ("miou", "macc")
NOTES = (
    "At the ground-truth points: miou and macc (mean recall) over the classes that occur; points without an answer are "
    "misses. Mean over seeds ± deviation."
)
WHY = {"miou": ""}


def main(plan: Plan) -> str:
    """The table, written."""
    beside = published.table("Replica", published.REPLICA, (*REPLICA_SCENES, "mean"))
    return layout.make(plan, METHODS, FIGURES, notes=NOTES, ours=RECOMMENDED, why=WHY, published=beside)


if __name__ == "__main__":
    main(options_of(PLAN, QUICK))
