"""Table 2: 3D-OVS at the points.

    python -m experiments.ovs3d [--quick] [--root FOLDER] [--out FOLDER] [--processes N]

Every class of every labelled frame is a query of its own, as LangSplat and the paper ask; protocol and options as in
`experiments.lerf`. Without --root: twins of the five scenes, three seeds.
"""

from experiments.datasets.ovs3d import OVS3D_PAIRS
from experiments.lerf import FIGURES, NOTES, WHY
from experiments.results import HOME
from experiments.tables import layout, published, twins
from experiments.tables.fill import Plan, options_of, quick_plan
from experiments.tables.methods import METHODS, RECOMMENDED

PLAN = Plan(
    twins.Data("ovs3d", scenes=tuple(OVS3D_PAIRS), size=(("views", 28), ("width", 256), ("height", 192))),
    tuple(METHODS),
    out=str(HOME / "results" / "ovs3d"),
)
QUICK = quick_plan(PLAN, "bed", views=8, width=80, height=60, num_objects=4, labelled_frames=2)


def main(plan: Plan) -> str:
    """The table, written."""
    beside = published.table("3D-OVS", published.OVS3D, (*published.OVS3D_SCENES, "mean"), published.OVS3D_REMARKS)
    return layout.make(plan, METHODS, FIGURES, notes=NOTES, ours=RECOMMENDED, why=WHY, published=beside)


if __name__ == "__main__":
    main(options_of(PLAN, QUICK))
